# SPDX-License-Identifier: Apache-2.0
"""The MCAP files against the independent reader of the `mcap` package."""

from __future__ import annotations

import errno
import io
from pathlib import Path
from typing import IO

import mcap
import pytest
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from iwm_power_manager.bags.mcap_file import COMPRESSIONS, McapFile
from iwm_power_manager.bags.recover import recover


def fill(path: Path, count: int, **options: object) -> McapFile:
    file = McapFile(path, library="test", **options)  # type: ignore[arg-type]
    schema = file.schema_id("pkg/msg/A", "ros2msg", b"float64 data")
    channels = [file.writer.register_channel(f"/t{i}", "cdr", schema, {"key": "value"}) for i in range(3)]
    for i in range(count):
        file.writer.add_message(channels[i % 3], 1000 + i, bytes([i % 256]) * (i % 50), 900 + i, i)
    return file


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_a_finished_file_holds_every_message_with_valid_checksums_and_index(tmp_path: Path, compression: str) -> None:
    file = fill(tmp_path / "a.mcap", 2000, compression=compression, chunk_bytes=4096)
    file.writer.add_metadata("extra", {"a": "1", "b": ""})
    file.finish()
    with (tmp_path / "a.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary is not None
        statistics = summary.statistics
        assert statistics is not None
        assert statistics.message_count == 2000
        assert statistics.channel_message_counts == {1: 667, 2: 667, 3: 666}
        assert (statistics.message_start_time, statistics.message_end_time) == (1000, 2999)
        assert statistics.chunk_count == len(summary.chunk_indexes) > 5
        for i, (schema, channel, message) in enumerate(reader.iter_messages()):
            assert schema is not None
            assert (schema.name, channel.topic, message.data) == (
                "pkg/msg/A",
                f"/t{i % 3}",
                bytes([i % 256]) * (i % 50),
            )
            assert (message.log_time, message.publish_time, message.sequence) == (1000 + i, 900 + i, i)
        # One topic in a span of time: found by the message index alone.
        found = [m.log_time for _, _, m in reader.iter_messages(topics=["/t1"], starting_at=1500, ending_before=1510)]
        assert found == [1502, 1505, 1508]
        assert [(m.name, m.metadata) for m in reader.iter_metadata()] == [("extra", {"a": "1", "b": ""})]


@pytest.mark.parametrize("version", [mcap.__version__, "of another release"])
@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_the_bytes_are_those_of_the_package_alone(
    tmp_path: Path, compression: str, version: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mcap, "__version__", version)
    file = McapFile(tmp_path / "a.mcap", library="test", compression=compression, chunk_bytes=4096)
    alone = Writer(plain := io.BytesIO(), chunk_size=4096, compression=CompressionType[compression.upper()])
    alone.start("ros2", "test")
    for writer in (file.writer, alone):
        schema = writer.register_schema("pkg/msg/A", "ros2msg", b"float64 data")
        for i in range(3):
            writer.register_channel(f"/t{i}", "cdr", schema)
        for i in range(500):
            writer.add_message(
                1 + i % 3, 10**9 + (i * 7919) % 1000, bytes([i % 256]) * (i % 50), 2**63 + i, 2**32 - 1 - i
            )
            if i % 100 == 50:
                writer.flush()
    file.finish()
    alone.finish()
    assert (tmp_path / "a.mcap").read_bytes() == plain.getvalue()


def test_log_times_out_of_order_are_found_by_the_index(tmp_path: Path) -> None:
    file = McapFile(tmp_path / "a.mcap", library="test")
    channel = file.writer.register_channel("/t", "cdr", 0)
    for time_ns in (5, 3, 9, 1, 7):
        file.writer.add_message(channel, time_ns, b"x", time_ns)
    file.finish()
    with (tmp_path / "a.mcap").open("rb") as stream:
        assert [m.log_time for _, _, m in make_reader(stream).iter_messages()] == [1, 3, 5, 7, 9]


def test_a_file_without_messages_is_valid(tmp_path: Path) -> None:
    McapFile(tmp_path / "a.mcap", library="test").finish()
    with (tmp_path / "a.mcap").open("rb") as stream:
        summary = make_reader(stream, validate_crcs=True).get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == 0


def test_everything_flushed_is_readable_from_the_unfinished_file(tmp_path: Path) -> None:
    file = fill(tmp_path / "a.mcap", 500)
    assert file.counts.total() == 0
    file.writer.flush()
    assert (file.counts.total(), file.start_time_ns, file.end_time_ns) == (500, 1000, 1499)
    with (tmp_path / "a.mcap").open("rb") as stream:
        count = 0
        with pytest.raises(Exception, match=r".*"):  # mcap has several for a missing end
            for record in StreamReader(stream).records:
                count += type(record).__name__ == "Message"
    assert count == 500
    file.abandon()


def test_an_existing_file_is_never_touched(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"precious")
    with pytest.raises(FileExistsError):
        McapFile(tmp_path / "a.mcap", library="test")
    assert (tmp_path / "a.mcap").read_bytes() == b"precious"


class FullDisk:
    """A file on a disk that takes `room` bytes more, then none."""

    def __init__(self, stream: IO[bytes], room: int) -> None:
        self.stream = stream
        self.room = room

    def write(self, data: memoryview) -> int:
        if not self.room:
            raise OSError(errno.ENOSPC, "No space left on device")
        written = self.stream.write(data[: self.room])
        self.room -= written
        return written

    def __getattr__(self, name: str) -> object:
        return getattr(self.stream, name)


@pytest.mark.parametrize("room", [0, 1, 100, 500, 1000, 1500])  # a chunk has some 300 bytes, the index of it 1600
def test_a_chunk_that_is_not_written_with_its_index_is_cut_off_and_what_was_written_before_is_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room: int
) -> None:
    file = fill(tmp_path / "a.mcap", 100)
    file.writer.flush()
    stream = file.stream
    monkeypatch.setattr(file, "stream", FullDisk(stream, room))
    for i in range(100):
        file.writer.add_message(1, 5000 + i, bytes(range(100)), 0)
    with pytest.raises(OSError, match="No space left"):
        file.writer.flush()
    monkeypatch.setattr(file, "stream", stream)
    assert (file.counts.total(), file.broken) == (100, True)
    with pytest.raises(OSError, match="an earlier write has failed"):
        file.writer.flush()
    file.abandon()
    assert (tmp_path / "a.mcap").stat().st_size == file.size_bytes
    report = recover(tmp_path / "a.mcap").files[0]
    assert (report.rebuilt, report.message_count, report.discarded_bytes, report.kept) == (True, 100, 0, "")


def test_a_file_removed_while_it_is_written_is_noticed_at_the_next_flush(tmp_path: Path) -> None:
    file = fill(tmp_path / "a.mcap", 10)
    (tmp_path / "a.mcap").unlink()
    with pytest.raises(FileNotFoundError, match="removed"):
        file.writer.flush()
    file.abandon()


def test_a_channel_that_closes_a_chunk_counts_no_message_that_is_still_in_memory(tmp_path: Path) -> None:
    file = McapFile(tmp_path / "a.mcap", library="test", chunk_bytes=200)
    channel = file.writer.register_channel("/a", "cdr", 0)
    file.writer.add_message(channel, 1, bytes(60), 1)
    other = file.writer.register_channel("/b" * 100, "cdr", 0)
    assert file.counts == {channel: 1}
    file.writer.add_message(other, 2, b"", 2)
    assert file.counts == {channel: 1}
    file.abandon()
