# SPDX-License-Identifier: Apache-2.0
"""Reading what this project, rosbags and mcap have written, whole or damaged."""

from __future__ import annotations

import os
import random
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path

import pytest
import zstandard
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

import foreign_bags as foreign
from bags_helpers import FLOAT64, float64, topic
from disk_helpers import private_folder
from iwm_power_manager.bags import limits
from iwm_power_manager.bags.metadata import parse_qos
from iwm_power_manager.bags.reader import BagReader
from iwm_power_manager.bags.recover import recover
from iwm_power_manager.bags.writer import BagWriter, WriterOptions
from iwm_power_manager.errors import BagError
from iwm_power_manager.signals.types import standard_types


def written_by_rosbags(
    path: Path, storage: StoragePlugin, mode: CompressionMode = CompressionMode.NONE, version: int = 9
) -> Path:
    writer = Writer(path, version=version, storage_plugin=storage)  # type: ignore[arg-type]
    writer.set_compression(mode, CompressionFormat.ZSTD)
    writer.set_custom_data("key", "value")
    with writer:
        connection = writer.add_connection("/a", FLOAT64, typestore=standard_types())
        for i in range(100):
            writer.write(connection, 1000 + i, float64(i))
    return path


def contents(path: Path) -> list[tuple[int, str, bytes]]:
    with BagReader(path) as reader:
        found = [(m.log_time_ns, m.topic, m.data) for m in reader.messages()]
        assert reader.damage == []
    return found


EXPECTED = [(1000 + i, "/a", float64(i)) for i in range(100)]


@pytest.mark.parametrize("storage", list(StoragePlugin))
@pytest.mark.parametrize("mode", list(CompressionMode))
@pytest.mark.parametrize("version", [8, 9])
def test_bags_of_rosbags_in_either_storage_and_every_compression(
    tmp_path: Path, storage: StoragePlugin, mode: CompressionMode, version: int
) -> None:
    if storage is StoragePlugin.SQLITE3 and mode is CompressionMode.STORAGE:
        pytest.skip("sqlite3 has no compression of its own")
    path = written_by_rosbags(tmp_path / "bag", storage, mode, version)
    assert contents(path) == EXPECTED
    with BagReader(path) as reader:
        assert reader.topics["/a"].type == FLOAT64
        assert reader.custom_data == {"key": "value"}
        assert (reader.start_ns, reader.end_ns) == (1000, 1099)
        assert reader.counts == {"/a": 100}


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("chunked", [True, False])
def test_a_single_file_of_the_mcap_package_chunked_or_not(
    tmp_path: Path, compression: CompressionType, chunked: bool
) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = McapWriter(stream, compression=compression, use_chunking=chunked, chunk_size=500)
        writer.start("ros2")
        schema = writer.register_schema(FLOAT64, "ros2msg", b"float64 data")
        channel = writer.register_channel("/a", "cdr", schema)
        for i in range(100):
            writer.add_message(channel, 1000 + i, float64(i), 1000 + i)
        writer.finish()
    assert contents(path) == EXPECTED


def test_many_files_read_as_one_in_the_order_of_log_times(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag", WriterOptions(chunk_bytes=1024)) as bag:
        number = bag.add_topic(topic("/a"))
        for part in range(12):
            for i in range(50):
                bag.write(number, part * 50 + i, float64(i))
            bag.split()
    assert [entry[0] for entry in contents(tmp_path / "bag")] == list(range(600))
    (tmp_path / "bag" / "metadata.yaml").unlink()  # the order then comes from the names: 9 before 10
    with BagReader(tmp_path / "bag") as reader:
        assert [m.log_time_ns for m in reader.messages()] == list(range(600))
        assert reader.damage == []
        assert reader.notes == [f"{tmp_path / 'bag'}: has no metadata.yaml: the recorder did not finish"]


def test_overlapping_chunks_and_files_are_merged_by_log_time(tmp_path: Path) -> None:
    times = list(range(2000))
    random.Random(1).shuffle(times)
    with BagWriter(tmp_path / "bag", WriterOptions(chunk_bytes=1024)) as bag:
        number = bag.add_topic(topic("/a"))
        for i, time_ns in enumerate(times):
            bag.write(number, time_ns, float64(time_ns))
            if i == 1000:
                bag.split()
    assert [entry[0] for entry in contents(tmp_path / "bag")] == list(range(2000))


@pytest.mark.parametrize(
    "storage", ["chunks", "one chunk", "no chunks", "two files", "split there", "cut off", "sqlite3"]
)
def test_a_bag_whose_clock_was_set_back_is_read_in_the_order_of_recording(tmp_path: Path, storage: str) -> None:
    drive = foreign.drive()
    shifted = [(log_ns - 3600 * 10**9 * (i >= 150), number, data) for i, (log_ns, number, data) in enumerate(drive)]
    path = tmp_path / "bag"
    if storage == "sqlite3":
        foreign.write_sqlite(path, shifted)
    elif storage in ("two files", "split there"):
        first = 150 if storage == "split there" else 200
        foreign.write_mcap(path / "a_0.mcap", shifted[:first])
        foreign.write_mcap(path / "a_1.mcap", shifted[first:])
        foreign.write_metadata(path, relative_file_paths=["a_0.mcap", "a_1.mcap"])
    elif storage == "no chunks":
        records = foreign.announced() + foreign.message_records(shifted)
        foreign.write_records(path / "a_0.mcap", records)
        foreign.write_metadata(path)
    else:
        foreign.write_bag(path, shifted, chunk_bytes=10**9 if storage == "one chunk" else 4096)
    if storage == "cut off":
        content = (path / "a_0.mcap").read_bytes()
        (path / "a_0.mcap").write_bytes(content[:-100])
    with BagReader(path) as reader:
        assert [(m.log_time_ns, m.data) for m in reader.messages()] == [(log_ns, data) for log_ns, _, data in shifted]
        (note,) = reader.notes
        assert note.endswith("the clock was set back meanwhile: it is read in the order of recording")


@pytest.mark.parametrize("storage", ["chunks", "no chunks", "sqlite3"])
def test_a_clock_that_was_set_back_within_what_is_read_at_once_is_seen_too(tmp_path: Path, storage: str) -> None:
    """Three messages fill a piece; what follows is later than all before, so that the pieces' times do not show it."""
    times = [0, 1, 2, 5, 7, 4, 8, 9, 10]
    shifted = [(foreign.START_NS + time * 10**9, 1, bytes(400_000)) for time in times]
    path = tmp_path / "bag"
    if storage == "sqlite3":
        foreign.write_sqlite(path, shifted)
    elif storage == "chunks":
        foreign.write_bag(path, shifted, chunk_bytes=2**20)
    else:
        foreign.write_records(path / "a_0.mcap", foreign.announced() + foreign.message_records(shifted))
        foreign.write_metadata(path)
    with BagReader(path) as reader:
        assert [m.log_time_ns for m in reader.messages()] == [time_ns for time_ns, *_ in shifted]
        (note,) = reader.notes
    assert note.endswith("the clock was set back meanwhile: it is read in the order of recording")


def test_a_file_beside_its_compressed_copy_is_read_once(tmp_path: Path) -> None:
    content = foreign.write_mcap(tmp_path / "bag" / "a_0.mcap", foreign.drive()).read_bytes()
    (tmp_path / "bag" / "a_0.mcap.zstd").write_bytes(zstandard.compress(content))
    with BagReader(tmp_path / "bag") as reader:
        assert len(list(reader.messages())) == len(foreign.drive())


def test_files_of_two_recorders_are_merged_by_their_log_times(tmp_path: Path) -> None:
    later, earlier = foreign.drive()[150:], foreign.drive()[:150]
    foreign.write_mcap(tmp_path / "bag" / "a_0.mcap", later)
    foreign.write_mcap(tmp_path / "bag" / "b_0.mcap", earlier)
    with BagReader(tmp_path / "bag") as reader:
        assert [(m.log_time_ns, m.data) for m in reader.messages()] == [(t, data) for t, _, data in earlier + later]


def test_a_lone_chunk_is_unpacked_once_however_long_its_drive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = foreign.write_mcap(tmp_path / "a.mcap", foreign.drive(), chunk_bytes=10**9)
    unpacked: list[int] = []
    decompress = limits.decompress

    def counted(compression: str, data: bytes, size: int | None = None) -> bytes:
        unpacked.append(len(data))
        return decompress(compression, data, size)

    monkeypatch.setattr(limits, "decompress", counted)
    with BagReader(path) as reader:
        assert reader.end_ns - reader.start_ns > limits.SET_BACK_NS
        assert len(list(reader.messages())) == len(foreign.drive())
    assert len(unpacked) == 1


def test_topics_written_one_after_the_other_are_read_by_their_log_times(tmp_path: Path) -> None:
    by_topic = sorted(foreign.drive(), key=lambda entry: entry[1])
    for path in (foreign.write_bag(tmp_path / "mcap", by_topic), foreign.write_sqlite(tmp_path / "sqlite3", by_topic)):
        with BagReader(path) as reader:
            times = [message.log_time_ns for message in reader.messages()]
            assert times == sorted(times)
            assert reader.notes == []


def test_times_with_a_decimal_point_are_times(tmp_path: Path) -> None:
    entries = [(log_ns // 256 * 256, number, data) for log_ns, number, data in foreign.drive(20)]
    path = foreign.write_sqlite(tmp_path / "bag", entries, timestamps="REAL")
    with BagReader(path) as reader:
        assert [m.log_time_ns for m in reader.messages()] == [log_ns for log_ns, _, _ in entries]
        assert (reader.start_ns, reader.counts.total(), reader.damage) == (entries[0][0], 60, [])


@pytest.mark.parametrize("announcing", ["summary", "chunk behind", "channels in the summary, schemas in a chunk"])
def test_definitions_behind_the_messages_that_need_them_are_found(tmp_path: Path, announcing: str) -> None:
    first, rest = (foreign.message_records(part) for part in (foreign.drive()[:150], foreign.drive()[150:]))
    schemas, channels = foreign.schema_records(), foreign.channel_records()
    body, summary = {
        "summary": (foreign.chunk(first + rest), schemas + channels),
        "chunk behind": (foreign.chunk(first) + foreign.chunk(schemas + channels + rest), b""),
        "channels in the summary, schemas in a chunk": (foreign.chunk(schemas + channels + first + rest), channels),
    }[announcing]
    path = foreign.write_records(tmp_path / "a.mcap", body, summary=summary + foreign.statistics(foreign.drive()))
    with BagReader(path) as reader:
        assert sum(1 for _ in reader.messages()) == 300
        assert {name: topic.definition for name, topic in reader.topics.items()} == {
            channel.topic: channel.text for channel in foreign.CHANNELS
        }
        assert reader.damage == []


def test_equal_log_times_keep_the_order_of_the_recording(make_bag: Callable[..., Path]) -> None:
    path = make_bag([("/a", 5, float(i)) for i in range(300)], chunk_bytes=1024)
    assert [entry[2] for entry in contents(path)] == [float64(i) for i in range(300)]


def test_a_missing_file_of_a_bag_is_reported_and_the_others_read(make_bag: Callable[..., Path]) -> None:
    path = make_bag([("/a", i * 100, float(i)) for i in range(30)], max_duration_ns=1000)
    (path / "bag_1.mcap").unlink()
    with BagReader(path) as reader:
        assert [m.log_time_ns for m in reader.messages()] == [*range(0, 1000, 100), *range(2000, 3000, 100)]
        assert reader.damage == [f"{path / 'bag_1.mcap'}: is missing"]


def test_a_file_that_is_no_bag_is_reported_and_the_others_read(make_bag: Callable[..., Path]) -> None:
    path = make_bag([("/a", i * 100, float(i)) for i in range(20)], max_duration_ns=1000)
    (path / "bag_1.mcap").write_bytes(b"")
    with BagReader(path) as reader:
        assert sum(1 for _ in reader.messages()) == 10
        assert reader.damage == [f"{path / 'bag_1.mcap'}: is empty"]


def test_a_truncated_sqlite_bag_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    path = tmp_path / "bag"
    writer = Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3)
    with writer:
        connection = writer.add_connection("/a", FLOAT64, typestore=standard_types())
        for i in range(20_000):
            writer.write(connection, 1000 + i, float64(i))
    database = path / "bag.db3"
    database.write_bytes(database.read_bytes()[: database.stat().st_size // 2])
    with BagReader(path) as reader:
        found = [m.log_time_ns for m in reader.messages()]
        assert found == list(range(1000, 1000 + len(found)))
        assert len(found) > 1000
        assert "bag.db3: is damaged: *** in database main" in reader.damage[0]


def test_every_row_before_damage_is_read(tmp_path: Path) -> None:
    path = foreign.write_sqlite(tmp_path / "bag", foreign.drive(400)) / "a_0.db3"
    with closing(sqlite3.connect(path)) as database:
        ((page_bytes,), (pages,)) = (
            database.execute(f"PRAGMA {name}").fetchone() for name in ("page_size", "page_count")
        )
    content = bytearray(path.read_bytes())
    content[page_bytes * (pages - 4) : page_bytes * (pages - 3)] = bytes([255]) * page_bytes
    path.write_bytes(content)
    readable = 0
    with closing(sqlite3.connect(path)) as database, suppress(sqlite3.DatabaseError):
        while database.execute("SELECT data FROM messages WHERE rowid = ?", (readable + 1,)).fetchone():
            readable += 1
    with BagReader(path) as reader:
        assert len(list(reader.messages())) == readable > 500
        assert reader.damage


def test_a_sqlite_bag_older_than_type_hashes_and_definitions(tmp_path: Path) -> None:
    path = tmp_path / "old.db3"
    database = sqlite3.connect(path)
    database.execute("CREATE TABLE topics(id INTEGER, name TEXT, type TEXT, serialization_format TEXT, "
                     "offered_qos_profiles TEXT)")  # fmt: skip
    database.execute("CREATE TABLE messages(id INTEGER, topic_id INTEGER, timestamp INTEGER, data BLOB)")
    database.execute("INSERT INTO topics VALUES(1, '/a', ?, 'cdr', '')", (FLOAT64,))
    database.executemany("INSERT INTO messages VALUES(?, 1, ?, ?)", [(i, 1000 + i, float64(i)) for i in range(100)])
    database.commit()
    database.close()
    assert contents(path) == EXPECTED


def test_a_truncated_compressed_file_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    path = tmp_path / "bag"
    writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.FILE, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/a", FLOAT64, typestore=standard_types())
        for i in range(5000):
            writer.write(connection, 1000 + i, random.Random(i).randbytes(1000))
    (packed,) = path.glob("*.zstd")
    packed.write_bytes(packed.read_bytes()[:-2_000_000])
    with BagReader(path) as reader:
        found = [m.log_time_ns for m in reader.messages()]
        assert found == list(range(1000, 1000 + len(found)))
        assert len(found) > 1000
        assert reader.damage
        assert all(line.startswith(f"{packed}: ") for line in reader.damage)


def test_metadata_that_cannot_be_read_is_reported_and_the_files_read(make_bag: Callable[..., Path]) -> None:
    path = make_bag([("/a", 1, 1.0)])
    (path / "metadata.yaml").write_text("rosbag2_bagfile_information: [")
    with BagReader(path) as reader:
        assert sum(1 for _ in reader.messages()) == 1
        assert reader.damage == [
            f"{path / 'metadata.yaml'}: version is missing or of the wrong kind; the data files are read"
        ]


@pytest.mark.parametrize(
    ("kind", "line"),
    [
        ("missing", "bag: does not exist"),
        ("empty", r"bag: holds no \.mcap or \.db3 file"),
        ("text", "bag: is no MCAP file"),
        ("database", r"bag\.db3: is no readable sqlite3 bag"),
    ],
)
def test_what_is_no_bag_gets_one_clear_line(tmp_path: Path, kind: str, line: str) -> None:
    path = tmp_path / ("bag.db3" if kind == "database" else "bag")
    if kind == "empty":
        path.mkdir()
    elif kind in ("text", "database"):
        path.write_text("this is a text, and not a short one either")
    with pytest.raises(BagError, match=line):
        BagReader(path)


def test_a_bag_that_is_not_there_is_answered_with_the_names_near_it(tmp_path: Path) -> None:
    (tmp_path / "drive_01").mkdir()
    with pytest.raises(BagError, match=r"drive_1: does not exist; did you mean \S*drive_01\?"):
        BagReader(tmp_path / "drive_1")


def test_a_folder_of_bags_is_answered_with_the_bags_in_it(make_bag: Callable[..., Path]) -> None:
    path = make_bag([("/a", 1, 1.0)])
    with pytest.raises(BagError, match=rf"holds no \.mcap or \.db3 file; did you mean {path}\?$"):
        BagReader(path.parent)


def test_a_folder_above_a_bag_that_is_not_there_is_answered_with_the_names_near_it(tmp_path: Path) -> None:
    (tmp_path / "drive" / "bag").mkdir(parents=True)
    (tmp_path / "drives").mkdir()
    with pytest.raises(BagError, match=r"drve/bag: does not exist; did you mean [^ ]*drive/bag\?$"):
        BagReader(tmp_path / "drve" / "bag")


def test_a_compressed_message_that_is_damaged_stays_as_it_is_and_is_reported(tmp_path: Path) -> None:
    torn = b"\x28\xb5\x2f\xfd" + bytes(3)
    with BagWriter(tmp_path / "bag") as bag:
        number = bag.add_topic(topic("/a"))
        bag.write(number, 1, torn)
    with BagReader(tmp_path / "bag") as reader:
        assert [message.data for message in reader.messages()] == [torn]
        assert reader.damage == [f"{tmp_path / 'bag' / 'bag_0.mcap'}: 1 compressed message(s) cannot be decompressed"]


def test_qos_of_every_rosbag2_version_is_understood() -> None:
    numbers = "- history: 1\n  depth: 5\n  reliability: 2\n  durability: 1\n  deadline: {sec: 0, nsec: 7}\n"
    numbers += "  lifespan: {sec: 1, nsec: 0}\n  liveliness: 1\n  liveliness_lease_duration: {sec: 0, nsec: 0}\n"
    (profile,) = parse_qos(numbers)
    assert (profile.history.name, profile.reliability.name) == ("KEEP_LAST", "BEST_EFFORT")
    assert profile.durability.name == "TRANSIENT_LOCAL"
    assert (profile.depth, profile.deadline, profile.lifespan) == (5, (0, 7), (1, 0))
    assert parse_qos("") == parse_qos("nonsense") == parse_qos("[1, 2]") == parse_qos("{") == ()


def test_a_file_that_is_cut_off_while_it_is_read_is_damage_and_no_end_of_the_process(
    make_bag: Callable[..., Path],
) -> None:
    path = make_bag([("/a", i, float(i)) for i in range(3000)], chunk_bytes=1024, compression="none")
    file = path / "bag_0.mcap"
    with BagReader(path) as reader:
        messages = reader.messages()
        before = [next(messages) for _ in range(100)]
        os.truncate(file, 8192)
        after = list(messages)
        assert 0 < len(before) + len(after) < 3000
        assert any("was cut off while it was read" in line for line in reader.damage)


def test_a_data_file_that_metadata_does_not_list_is_said_to_be_left_out(make_bag: Callable[..., Path]) -> None:
    path = make_bag([("/a", i, 0.0) for i in range(10)])
    shutil.copy(path / "bag_0.mcap", path / "bag_1.mcap")
    with BagReader(path) as reader:
        assert reader.damage == []
        assert reader.notes == [f"{path / 'bag_1.mcap'}: is not in metadata.yaml and left out"]
        assert len(list(reader.messages())) == 10


def test_a_bag_in_a_folder_that_may_be_entered_and_not_listed_is_read() -> None:
    with private_folder() as folder:
        with BagWriter(folder / "bag") as bag:
            bag.write(bag.add_topic(topic("/a")), 1, float64(1.0))
        (folder / "bag").chmod(0o111)
        with BagReader(folder / "bag") as reader:
            assert len(list(reader.messages())) == 1
            assert reader.damage == []
        (folder / "bag").chmod(0o755)


def test_a_database_without_its_last_byte_is_damaged(tmp_path: Path) -> None:
    path = written_by_rosbags(tmp_path / "bag", StoragePlugin.SQLITE3)
    (file,) = path.glob("*.db3")
    file.write_bytes(file.read_bytes()[:-1])
    with BagReader(path) as reader:
        assert any("ends within its last page" in line for line in reader.damage)


@pytest.mark.parametrize("opened", [BagReader, recover], ids=["read", "recovered"])
@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("locked/bag", "Permission denied"),
        ("n" * 300, "File name too long"),
        ("a\0b", "embedded null"),
        ("file/bag", "Not a directory"),
        ("nothing", "does not exist"),
    ],
)
def test_a_bag_that_nobody_may_look_at_is_refused_with_the_reason(
    opened: Callable[[Path], object], name: str, problem: str
) -> None:
    with private_folder() as folder:
        (folder / "locked").mkdir()
        (folder / "locked").chmod(0o000)
        (folder / "file").write_text("")
        with pytest.raises(BagError, match=problem):
            opened(folder / name)
