# SPDX-License-Identifier: Apache-2.0
"""Recovery: from a cut at any byte, from any damaged byte, from kill -9 at any moment."""

from __future__ import annotations

import io
import os
import random
import signal
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from bags_helpers import float64, topic
from iwm_power_manager.bags.reader import BagReader
from iwm_power_manager.bags.recover import recover
from iwm_power_manager.bags.writer import BagWriter, WriterOptions
from iwm_power_manager.errors import BagError

COUNT = 400

#: Records one message a millisecond, its log time the machine's monotonic clock; says "recording" once it does. When it
#: has given which message, it notes in a file beside the bag that survives it.
CHILD = """
import mmap, struct, sys, time
from bags_helpers import float64, topic
from iwm_power_manager.bags.recording import Recording, RecordingOptions
from iwm_power_manager.bags.writer import WriterOptions
path, flush_s, compression = sys.argv[1], float(sys.argv[2]), sys.argv[3]
recording = Recording(
    path, RecordingOptions(WriterOptions(compression), flush_period_s=flush_s, sync=flush_s > 0.1), {"key": "value"}
)
recording.start()
number = recording.add_topic(topic("/a"))
with open(path + ".given", "w+b") as file:
    file.truncate(8 * 100_000)
    given = mmap.mmap(file.fileno(), 0)
print("recording", flush=True)
start = time.monotonic()
count = 0
while True:
    due = int((time.monotonic() - start) * 1000)
    now = time.monotonic_ns()
    recording.put([(number, now, float64(i), i, i + 1) for i in range(count, due)])
    for i in range(count, due):
        struct.pack_into("<q", given, 8 * i, now)
    count = due
    time.sleep(0.005)
"""


def publish_times(path: Path) -> list[int]:
    """As rosbags, which accepts only valid bags, reads them; publish time is the message's number here."""
    with AnyReader([path]) as reader:
        return [int(reader.deserialize(data, connection.msgtype).data) for connection, _, data in reader.messages()]


class WholeFile(bytes):
    """Bytes that do not fill the screen when a test fails."""

    def __repr__(self) -> str:
        return f"<{len(self)} bytes>"


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The bytes of a finished file of `COUNT` messages in several chunks."""
    from bags_helpers import float64, topic
    from iwm_power_manager.bags.writer import BagWriter, WriterOptions

    path = tmp_path_factory.mktemp("whole") / "bag"
    with BagWriter(path, WriterOptions(chunk_bytes=2048), {"key": "value"}) as bag:
        number = bag.add_topic(topic("/a"))
        for i in range(COUNT):
            bag.write(number, 1000 + i, float64(i), i, i + 1)
    return WholeFile((path / "bag_0.mcap").read_bytes())


def broken_bag(folder: Path, content: bytes) -> Path:
    path = Path(tempfile.mkdtemp(dir=folder))
    (path / "bag_0.mcap").write_bytes(content)
    return path


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(cut=st.floats(0.0, 1.0))
def test_a_file_cut_at_any_byte_gives_back_a_prefix_and_becomes_a_valid_bag(
    tmp_path: Path, whole: bytes, cut: float
) -> None:
    length = int(cut * (len(whole) - 1))
    path = broken_bag(tmp_path, whole[:length])
    try:
        report = recover(path)
    except BagError as error:
        assert length < 100  # not even the header is there
        assert str(path) in str(error)  # noqa: PT017
        return
    assert report.files[0].rebuilt
    found = publish_times(path) if report.files[0].message_count else []
    assert found == list(range(len(found)))
    assert len(found) >= COUNT * (length / len(whole) - 0.3)
    # What is valid now stays untouched.
    content = (path / "bag_0.mcap").read_bytes()
    assert not recover(path).metadata_written
    assert (path / "bag_0.mcap").read_bytes() == content


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(position=st.floats(0.0, 1.0, exclude_max=True), value=st.integers(1, 255))
def test_one_damaged_byte_anywhere_never_makes_up_a_message(
    tmp_path: Path, whole: bytes, position: float, value: int
) -> None:
    content = bytearray(whole)
    at = int(position * len(content))
    content[at] ^= value
    path = broken_bag(tmp_path, bytes(content))
    try:
        report = recover(path)
    except BagError:
        assert at < 100  # the file's head
        return
    if report.files[0].message_count == 0:
        return
    with BagReader(path) as reader:
        numbers = [message.sequence for message in reader.messages() if message.topic == "/a"]
        assert reader.damage == []
    assert len(numbers) == len(set(numbers))
    assert set(numbers) <= set(range(1, COUNT + 1))


def test_a_damaged_chunk_is_left_out_named_and_the_original_kept(tmp_path: Path, whole: bytes) -> None:
    content = bytearray(whole)
    summary = make_reader(io.BytesIO(whole)).get_summary()
    assert summary is not None
    chunk = summary.chunk_indexes[len(summary.chunk_indexes) // 2]
    content[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 0xFF
    path = broken_bag(tmp_path, bytes(content))
    report = recover(path)
    assert report.files[0].lost_chunks == 1
    assert (path / "bag_0.mcap.damaged").read_bytes() == bytes(content)
    found = publish_times(path)
    lost = COUNT - len(found)
    assert 0 < lost < COUNT // 3
    assert report.missing == {"/a": lost}
    text = "\n".join(report.lines())
    assert "1 chunk(s) or other stretch(es) unreadable" in text
    assert f"/a: {lost} messages missing in between" in text


def test_each_topic_s_messages_are_counted_by_its_own_publisher_in_files_and_between_them(tmp_path: Path) -> None:
    path = tmp_path / "bag"
    with BagWriter(path, WriterOptions(max_duration_ns=1000)) as bag:
        fast, slow = bag.add_topic(topic("/fast")), bag.add_topic(topic("/slow"))
        for step in range(35):
            if step not in (4, 5, 10):  # two within the first file, and the second file's first
                bag.write(fast, step * 100, float64(0.0), step * 100, step + 1)
            if step % 5 == 0:
                bag.write(slow, step * 100 + 1, float64(0.0), step * 100 + 1, 700 + step // 5)
    (path / "metadata.yaml").unlink()
    assert recover(path).missing == {"/fast": 3}


def test_a_whole_bag_is_left_as_it_is(make_bag: Callable[..., Path]) -> None:
    path = make_bag([("/a", i, 0.0) for i in range(10)])
    before = {file.name: file.read_bytes() for file in path.iterdir()}
    report = recover(path)
    assert "nothing to recover" in report.lines()[-1]
    assert {file.name: file.read_bytes() for file in path.iterdir()} == before


def test_missing_metadata_alone_is_made_anew(make_bag: Callable[..., Path]) -> None:
    path = make_bag([("/a", i * 100, 0.0) for i in range(120)], max_duration_ns=1000, custom_data={"key": "value"})
    before = (path / "metadata.yaml").read_text()
    (path / "metadata.yaml").unlink()
    report = recover(path)
    assert report.metadata_written
    assert not any(file.rebuilt for file in report.files)
    assert (path / "metadata.yaml").read_text() == before


def test_of_a_split_bag_only_the_last_file_is_rebuilt(make_bag: Callable[..., Path]) -> None:
    path = make_bag([("/a", i * 100, float(i)) for i in range(35)], max_duration_ns=1000)
    (path / "metadata.yaml").unlink()
    last = path / "bag_3.mcap"
    last.write_bytes(last.read_bytes()[:-40])
    report = recover(path)
    assert [file.rebuilt for file in report.files] == [False, False, False, True]
    assert publish_times(path) == list(range(35))


def test_a_file_that_holds_nothing_leaves_the_second_recovery_nothing_to_do(make_bag: Callable[..., Path]) -> None:
    path = make_bag([("/a", i * 100, float(i)) for i in range(35)], max_duration_ns=1000)
    (path / "bag_3.mcap").write_bytes(b"")
    assert recover(path).metadata_written
    report = recover(path)
    assert not report.metadata_written
    assert report.lines()[1:] == [
        "  bag_0.mcap: whole, 10 messages",
        "  bag_1.mcap: whole, 10 messages",
        "  bag_2.mcap: whole, 10 messages",
        f"  bag_3.mcap: left out: {path / 'bag_3.mcap'}: is empty",
        "  nothing to recover",
    ]


def test_a_file_of_another_writer_with_channels_inside_of_chunks_is_recovered(tmp_path: Path) -> None:
    from mcap.writer import Writer

    from bags_helpers import float64

    path = tmp_path / "bag"
    path.mkdir()
    with (path / "bag_0.mcap").open("wb") as stream:
        writer = Writer(stream, chunk_size=1000)
        writer.start("ros2")
        schema = writer.register_schema("std_msgs/msg/Float64", "ros2msg", b"float64 data")
        channel = writer.register_channel("/a", "cdr", schema)
        for i in range(100):
            writer.add_message(channel, 1000 + i, float64(i), 1000 + i)
        writer.flush()  # and then the process dies
    assert recover(path).files[0].message_count == 100
    assert publish_times(path) == list(range(100))


@pytest.mark.parametrize("kind", ["missing", "file", "empty"])
def test_what_is_no_bag_gets_one_clear_line(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "bag"
    if kind == "file":
        path.write_text("x")
    elif kind == "empty":
        path.mkdir()
    expected = {
        "missing": "does not exist",
        "file": "is no folder and no .mcap",
        "empty": r"holds no \.mcap or \.db3 file",
    }[kind]
    with pytest.raises(BagError, match=f"bag: {expected}"):
        recover(path)


def test_a_folder_that_cannot_take_the_rebuilt_file_keeps_the_damaged_one(
    tmp_path: Path, whole: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = broken_bag(tmp_path, whole[:3000])
    replace = os.replace

    def refuse(source: Path, target: Path) -> None:
        if Path(target).suffix == ".mcap":
            raise PermissionError(13, "Permission denied")
        replace(source, target)

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(BagError, match="Permission denied"):
        recover(path)
    assert (path / "bag_0.mcap").read_bytes() == whole[:3000]


def kill_campaign(folder: Path, runs: int, at_once: int) -> float:
    """Kill `runs` recorders at random moments; none may lose its last second. Returns the largest loss in seconds."""
    draw = random.Random(20150601)
    largest_s = 0.0
    for batch in range(0, runs, at_once):
        children = []
        for run in range(batch, min(batch + at_once, runs)):
            flush_s = (0.5, 0.01)[run % 2]
            compression = ("zstd", "none", "lz4")[run % 3]
            path = folder / f"bag{run}"
            arguments = [sys.executable, "-c", CHILD, str(path), str(flush_s), compression]
            environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
            child = subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True, env=environment)
            children.append((child, path, draw.uniform(0.0, 1.6)))
        for child, path, delay in sorted(children, key=lambda entry: entry[2]):
            assert child.stdout is not None
            assert child.stdout.readline() == "recording\n"
            time.sleep(delay)
            killed_ns = time.monotonic_ns()
            child.send_signal(signal.SIGKILL)
            child.wait()
            child.stdout.close()
            report = recover(path)
            numbers = publish_times(path) if report.files[0].message_count else []
            assert numbers == list(range(len(numbers))), path
            (given_ns,) = struct.unpack_from("<q", Path(f"{path}.given").read_bytes(), 8 * len(numbers))
            lost_s = (killed_ns - given_ns) * 1e-9 if given_ns else 0.0  # since the first that is missing was given
            assert lost_s < 1.0, path
            largest_s = max(largest_s, lost_s)
            with BagReader(path) as reader:
                assert reader.custom_data == {"key": "value"}
    return largest_s


def test_killed_at_random_moments_a_recording_loses_less_than_its_last_second(tmp_path: Path) -> None:
    kill_campaign(tmp_path, runs=4, at_once=4)


@pytest.mark.nightly
@pytest.mark.timeout(1800)
def test_killed_fifty_times_a_recording_loses_less_than_its_last_second(
    tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    largest_s = kill_campaign(tmp_path, runs=54, at_once=3)
    record_property("largest_loss_s", largest_s)
    print(f"largest loss of 54 kills: {largest_s:.3f} s")
