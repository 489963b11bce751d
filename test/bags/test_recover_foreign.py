# SPDX-License-Identifier: Apache-2.0
"""Recovery of other recorders' bags: everything that was readable is there afterwards, as it was."""

from __future__ import annotations

import bz2
import gzip
import sqlite3
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lz4.frame
import pytest
import yaml
import zstandard
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Chunk
from mcap.writer import Writer
from rosbags.rosbag2 import Reader as RosbagsReader

import foreign_bags as foreign
from iwm_power_manager.bags.reader import BagReader, Message
from iwm_power_manager.bags.recover import recover
from iwm_power_manager.errors import BagError

CHANNELS = [
    foreign.SPEED._replace(text=foreign.IDL_TEXT, encoding="ros2idl"),
    foreign.DEMAND,
    foreign.JOINTS,
    foreign.log_channel()[0],
]


def entries() -> list[foreign.Entry]:
    found = foreign.drive(60)
    return sorted(found + [(t + 3, 3, foreign.log_channel()[1]) for t, n, _ in found if n == 0])


def extras(writer: Writer) -> None:
    writer.add_metadata("rosbag2", {"serialized_metadata": "version: 8\n", "ROS_DISTRO": "humble"})
    writer.add_metadata("trip", {"driver": "A. Example"})
    writer.add_attachment(7, 8, "calib.txt", "text/plain", b"wheel 0.3")


def messages(path: Path) -> list[Message]:
    with BagReader(path) as reader:
        return list(reader.messages())


def information(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = yaml.safe_load((folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    return found


def torn(folder: Path, **options: Any) -> Path:
    """A bag's folder with a file that ends in a chunk, without metadata."""
    path = foreign.write_mcap(folder / "a_0.mcap", entries(), CHANNELS, chunk_bytes=2000, extras=extras, **options)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) * 6 // 10])
    return folder


@pytest.mark.parametrize("damage", ["length", "missing", "more"])
def test_of_messages_outside_of_chunks_only_what_is_damaged_is_lost(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "bag" / "a_0.mcap"
    path.parent.mkdir()
    with path.open("wb") as stream:
        writer = Writer(stream, use_chunking=False)
        writer.start("ros2", "foreign")
        channel = writer.register_channel("/a", "cdr", 0)
        for i in range(300):
            writer.add_message(channel, 1000 + i, b"\0\1\0\0" + bytes([i % 256]) * 40, 1000 + i, i)
            if i == 200:
                writer.add_attachment(7, 8, "calib.txt", "text/plain", b"wheel 0.3")
        writer.finish()
    content = bytearray(path.read_bytes())
    at = content.index(bytes([100]) * 40)
    head = at - 4 - 31
    content[head : head + 9] = {"length": b"\5" + bytes([255]) * 8, "missing": b"\5", "more": b"\5" + bytes(20)}[damage]
    path.write_bytes(content)
    recover(path.parent)
    found = messages(path.parent)
    assert [message.sequence for message in found] == [i for i in range(300) if i != 100]
    with path.open("rb") as stream:
        assert [attachment.data for attachment in make_reader(stream).iter_attachments()] == [b"wheel 0.3"]


def test_schemas_attachments_metadata_and_messages_of_a_torn_file_are_carried_over(tmp_path: Path) -> None:
    folder = torn(tmp_path / "bag")
    before, original = messages(folder), (folder / "a_0.mcap").read_bytes()
    report = recover(folder)
    assert messages(folder) == before
    assert len(before) > 100
    with (folder / "a_0.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert reader.get_header().library == "foreign"
        assert [(m.name, m.metadata) for m in reader.iter_metadata()] == [
            ("rosbag2", {"serialized_metadata": "version: 8\n", "ROS_DISTRO": "humble"}),
            ("trip", {"driver": "A. Example"}),
        ]
        (attachment,) = reader.iter_attachments()
        assert (attachment.name, attachment.log_time, attachment.data) == ("calib.txt", 8, b"wheel 0.3")
        by_topic = {channel.topic: channel for channel in summary.channels.values()}
        for channel in CHANNELS:
            found = by_topic[channel.topic]
            schema = summary.schemas[found.schema_id]
            assert (schema.name, schema.encoding, schema.data) == (
                channel.type,
                channel.encoding,
                channel.text.encode(),
            )
            assert (found.message_encoding, found.metadata) == (channel.serialization, {"key": channel.topic})
    assert information(folder)["ros_distro"] == "humble"
    assert report.missing == {}  # other recorders count something else
    assert report.files[0].discarded_bytes > 0
    assert (folder / "a_0.mcap.damaged").read_bytes() == original  # a torn chunk is not carried over


def test_a_torn_file_of_compressed_messages_keeps_them_and_they_can_be_decoded(tmp_path: Path) -> None:
    packed = [(t, n, zstandard.compress(data)) for t, n, data in foreign.drive(60)]
    folder = foreign.write_bag(tmp_path / "bag", packed, chunk_bytes=2000)
    foreign.write_metadata(folder, compression_format="zstd", compression_mode="MESSAGE", ros_distro="iron")
    path = folder / "a_0.mcap"
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    before = messages(folder)
    recover(folder)
    assert messages(folder) == before
    found = information(folder)
    assert (found["compression_mode"], found["compression_format"], found["ros_distro"]) == ("MESSAGE", "zstd", "iron")
    with RosbagsReader(folder) as reader:
        assert [data for _, _, data in reader.messages()] == [message.data for message in before]


def test_a_bag_of_ros_1_says_what_to_do(tmp_path: Path) -> None:
    bag = tmp_path / "drive.bag"
    bag.write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    for path in (bag, tmp_path):
        for read in (BagReader, recover):
            with pytest.raises(BagError, match=f"{bag}: is a bag of ROS 1: rosbags-convert makes one of ROS 2 of it"):
                read(path)


@pytest.mark.parametrize("single", [True, False], ids=["file", "folder"])
@pytest.mark.parametrize("whole", [True, False], ids=["whole", "torn"])
@pytest.mark.parametrize("suffix", [".zstd", ".zst"])
def test_a_compressed_file_becomes_one_beside_it(tmp_path: Path, single: bool, whole: bool, suffix: str) -> None:
    folder = tmp_path / "bag"
    # More than one block of zstd, so that half of it is something.
    path = foreign.write_mcap(folder / "a_0.mcap", foreign.drive(2000), chunk_bytes=2000, compression="none")
    packed = folder / f"a_0.mcap{suffix}"
    content = zstandard.compress(path.read_bytes())
    packed.write_bytes(content if whole else content[: len(content) // 2])
    path.unlink()
    before, original = messages(packed if single else folder), packed.read_bytes()
    report = recover(packed if single else folder)
    assert report.files[0].kept == packed.name
    assert packed.read_bytes() == original
    assert messages(path) == before
    assert len(before) > 50
    if not single:
        assert messages(folder) == before
        assert recover(folder).lines()[-1] == "  nothing to recover"
        with BagReader(folder) as reader:  # the original beside it is no damage
            assert reader.damage == []


@pytest.mark.parametrize("packer", [gzip, bz2])
@pytest.mark.parametrize("listed", [True, False])
def test_a_file_that_another_program_packed_says_what_to_do(tmp_path: Path, packer: Any, listed: bool) -> None:
    folder = tmp_path / "bag"
    path = foreign.write_mcap(folder / "a_0.mcap", foreign.drive())
    packed = folder / f"a_0.mcap.{'gz' if packer is gzip else 'bz2'}"
    packed.write_bytes(packer.compress(path.read_bytes()))
    path.unlink()
    if listed:
        foreign.write_metadata(folder, relative_file_paths=[packed.name])
    for bag in (folder, packed):
        line = f"{packed}: is packed by {'gzip' if packer is gzip else 'bzip2'}: unpack it first"
        with pytest.raises(BagError, match=line):
            BagReader(bag)
        with pytest.raises(BagError, match=line):
            recover(bag)


@pytest.mark.parametrize("single", [True, False], ids=["file", "folder"])
def test_a_damaged_sqlite_file_becomes_an_mcap_file_beside_it(tmp_path: Path, single: bool) -> None:
    folder = foreign.write_sqlite(tmp_path / "bag", foreign.drive(400))
    database = folder / "a_0.db3"
    database.write_bytes(database.read_bytes()[: database.stat().st_size // 2])
    before, original = messages(folder), database.read_bytes()
    report = recover(database if single else folder)
    assert (report.files[0].rebuilt, report.files[0].kept) == (True, "a_0.db3")
    assert database.read_bytes() == original
    assert messages(folder / "a_0.mcap") == before
    assert len(before) > 200
    if not single:
        assert information(folder)["storage_identifier"] == "mcap"
        assert messages(folder) == before


def test_what_stands_in_the_journal_of_a_killed_recorder_is_recovered(tmp_path: Path) -> None:
    folder = foreign.write_sqlite(tmp_path / "bag", foreign.drive(10))
    database = sqlite3.connect(folder / "a_0.db3")
    database.execute("PRAGMA journal_mode = WAL")
    database.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES(1, 5, x'0001000000000000000000f03f')")
    database.commit()
    copy = tmp_path / "killed"
    copy.mkdir()
    for path in folder.iterdir():
        (copy / path.name).write_bytes(path.read_bytes())
    database.close()
    assert (copy / "a_0.db3-wal").stat().st_size > 0
    recover(copy)
    assert len(messages(copy)) == 31
    assert (copy / "a_0.db3-wal").exists()


def test_a_whole_sqlite_file_without_metadata_gets_metadata_of_its_own_kind(tmp_path: Path) -> None:
    folder = foreign.write_sqlite(tmp_path / "bag", foreign.drive(10))
    (folder / "metadata.yaml").unlink()
    report = recover(folder)
    assert (report.metadata_written, report.files[0].rebuilt) == (True, False)
    assert information(folder)["storage_identifier"] == "sqlite3"
    assert len(messages(folder)) == 30


@pytest.mark.parametrize(
    "changes",
    [
        {"topics_with_message_count": [{"topic_metadata": {"name": "/a"}, "message_count": None}]},
        {"custom_data": "x"},
        {"message_count": "many"},
        {"duration": 7},
        {"relative_file_paths": [3]},
    ],
)
def test_metadata_of_the_wrong_kind_is_damage_and_the_data_is_read(tmp_path: Path, changes: dict[str, Any]) -> None:
    folder = foreign.write_bag(tmp_path / "bag", foreign.drive(10))
    foreign.write_metadata(folder, **changes)
    with BagReader(folder) as reader:
        assert sum(1 for _ in reader.messages()) == 30
        assert any("metadata.yaml: " in line for line in reader.damage)
    assert recover(folder).metadata_written
    with BagReader(folder) as reader:
        assert reader.damage == []


def test_an_empty_chunk_has_no_say_in_when_a_bag_begins(tmp_path: Path) -> None:
    folder = foreign.write_bag(tmp_path / "bag", foreign.drive(10), chunk_bytes=500)
    path = folder / "a_0.mcap"
    content = path.read_bytes()
    at = content.index(b"\x0f\x04\0\0\0\0\0\0\0")
    from mcap.data_stream import RecordBuilder

    builder = RecordBuilder()
    Chunk("", b"", 0, 0, 0, 0).write(builder)
    path.write_bytes(content[:at] + builder.end())
    report = recover(folder)
    assert (report.start_ns, report.files[0].message_count) == (foreign.START_NS, 30)
    with BagReader(folder) as reader:
        assert (reader.start_ns, reader.damage) == (foreign.START_NS, [])


def test_a_record_nobody_knows_is_carried_over_as_it_is(tmp_path: Path) -> None:
    path = foreign.write_mcap(tmp_path / "a.mcap", foreign.drive(10))
    content = path.read_bytes()
    at = content.index(b"\x0f\x04\0\0\0\0\0\0\0")
    private = b"\x90\x05\0\0\0\0\0\0\0hello"
    path.write_bytes(content[:at] + private + b"\0" * 5)
    recover(path)
    assert private in path.read_bytes()
    assert len(messages(path)) == 30


@pytest.mark.parametrize("packer", [zstandard.compress, lz4.frame.compress], ids=["zstd", "lz4"])
def test_a_chunk_of_several_frames_is_read_to_its_end(tmp_path: Path, packer: Callable[[bytes], bytes]) -> None:
    records = foreign.message_records(foreign.drive(30))
    packed = packer(records[:1000]) + packer(records[1000:1001]) + packer(records[1001:])
    compression = "zstd" if packer is zstandard.compress else "lz4"
    path = foreign.write_records(tmp_path / "a.mcap", foreign.announced(), foreign.chunk(records, compression, packed))
    assert len(messages(path)) == 90
    assert recover(path).files[0].damage == ""


def test_a_plain_chunk_is_read_whatever_it_says_of_its_size_unpacked(tmp_path: Path) -> None:
    records = foreign.message_records(foreign.drive(10))
    said = foreign.record(Chunk("", records, foreign.START_NS, foreign.START_NS, 0, 7))
    path = foreign.write_records(tmp_path / "a.mcap", foreign.announced(), said)
    assert len(messages(path)) == 30
    assert recover(path).files[0].damage == ""


def test_a_message_of_several_frames_is_read_to_its_end(tmp_path: Path) -> None:
    plain = foreign.drive(10)
    packed = [(t, n, zstandard.compress(data[:9]) + zstandard.compress(data[9:])) for t, n, data in plain]
    path = foreign.write_mcap(tmp_path / "a.mcap", packed)
    assert [message.data for message in messages(path)] == [data for _, _, data in plain]


@pytest.mark.parametrize("what", ["chunk", "attachment", "torn record"])
def test_what_stands_in_a_chunk_and_cannot_be_read_is_said_and_the_original_kept(tmp_path: Path, what: str) -> None:
    found = foreign.drive(20)
    inner = {
        "chunk": foreign.chunk(foreign.message_records(found[30:])),
        "attachment": foreign.record(Attachment(1, 2, "a", "text/plain", b"x")),
        "torn record": b"\5" + bytes([255]) * 8,
    }[what]
    whole = foreign.announced() + foreign.message_records(found[:30])
    path = foreign.write_records(tmp_path / "bag" / "a_0.mcap", foreign.chunk(whole + inner))
    with BagReader(path) as reader:
        assert len(list(reader.messages())) == 30
        assert [line.partition(": ")[2][:8] for line in reader.damage] == ["left out"]
    original = path.read_bytes()
    report = recover(path.parent).files[0]
    assert (report.message_count, report.kept) == (30, "a_0.mcap.damaged")
    assert (path.parent / report.kept).read_bytes() == original


def test_a_channel_that_is_announced_anew_as_another_is_said_and_becomes_another(tmp_path: Path) -> None:
    found = foreign.drive(20)
    anew = foreign.record(Channel(2, "/other", "cdr", {}, 2))
    path = foreign.write_records(
        tmp_path / "a.mcap",
        foreign.chunk(foreign.announced() + foreign.message_records(found[:30])),
        foreign.chunk(anew + foreign.message_records(found[30:])),
    )
    with BagReader(path) as reader:
        assert reader.damage == [f"{path}: announces channel 2 in more than one way: the first counts"]
    assert recover(path).files[0].message_count == 60
    with BagReader(path) as reader:
        assert reader.damage == []
        assert (reader.counts["/demand"], reader.counts["/other"]) == (10, 10)


@pytest.mark.parametrize("wrong", ["in all", "of a topic", "topic that is not there"])
def test_wrong_counts_in_metadata_are_said_and_made_right(tmp_path: Path, wrong: str) -> None:
    folder = foreign.write_bag(tmp_path / "bag", foreign.drive(10))
    listed = information(folder)
    topics = listed["topics_with_message_count"]
    if wrong == "in all":
        listed["message_count"] = 77
    elif wrong == "of a topic":
        topics[0]["message_count"], topics[1]["message_count"] = 5, 15
    else:
        del topics[2]
    foreign.write_metadata(folder, **{key: listed[key] for key in ("message_count", "topics_with_message_count")})
    with BagReader(folder) as reader:
        assert reader.notes == [f"{folder}: metadata.yaml miscounts the messages: 30 are there"]
        assert reader.damage == []
    assert recover(folder).metadata_written
    listed = information(folder)
    assert listed["message_count"] == 30
    assert [topic["message_count"] for topic in listed["topics_with_message_count"]] == [10, 10, 10]
    with BagReader(folder) as reader:
        assert (reader.notes, reader.damage) == ([], [])


def test_a_file_whose_summary_miscounts_is_rebuilt(tmp_path: Path) -> None:
    drive = foreign.drive(10)
    body = foreign.announced() + foreign.chunk(foreign.message_records(drive))
    path = foreign.write_records(
        tmp_path / "a.mcap", body, summary=foreign.announced() + foreign.statistics(drive[:12])
    )
    assert recover(path).files[0].damage == "says of itself that it holds 12 messages"
    with BagReader(path) as reader:
        assert reader.counts.total() == sum(1 for _ in reader.messages()) == 30


def test_rows_of_topics_that_a_database_lacks_get_a_topic(tmp_path: Path) -> None:
    folder = foreign.write_sqlite(tmp_path / "bag", foreign.drive(10))
    with sqlite3.connect(folder / "a_0.db3") as database:
        database.execute("DELETE FROM topics WHERE id = 1")
    database.close()
    assert "nowhere announced" in recover(folder).files[0].damage
    assert Counter(message.topic for message in messages(folder)) == {
        "/car/speed": 10,
        "/recovered/channel_1": 10,
        "/joint_states": 10,
    }


@pytest.mark.parametrize("packer", [zstandard.compress, lz4.frame.compress], ids=["zstd", "lz4"])
def test_compressed_messages_are_read_and_stay_compressed(tmp_path: Path, packer: Callable[[bytes], bytes]) -> None:
    drive = foreign.drive(10)
    path = foreign.write_mcap(tmp_path / "bag" / "a_0.mcap", [(t, n, packer(data)) for t, n, data in drive])
    assert [message.data for message in messages(path)] == [data for _, _, data in drive]
    recover(path.parent)
    assert information(path.parent)["compression_format"] == ("zstd" if packer is zstandard.compress else "lz4")


def test_messages_of_channels_that_are_nowhere_announced_get_a_topic(tmp_path: Path) -> None:
    path = foreign.write_records(tmp_path / "a.mcap", foreign.chunk(foreign.message_records(foreign.drive(10))))
    assert "holds messages of channels that are nowhere announced" in recover(path).files[0].damage
    assert len(messages(path)) == 30
    with BagReader(path) as reader:
        assert set(reader.topics) == {f"/recovered/channel_{i}" for i in (1, 2, 3)}


def test_a_second_recovery_keeps_the_original_of_the_first(tmp_path: Path) -> None:
    path = foreign.write_mcap(tmp_path / "bag" / "a_0.mcap", entries(), CHANNELS, chunk_bytes=2000)
    originals = []
    for _ in range(2):
        content = bytearray(path.read_bytes())
        content[len(content) // 2 :] = bytes(100)
        path.write_bytes(content)
        originals.append(bytes(content))
        recover(path.parent)
    assert [(path.parent / f"a_0.mcap.damaged{end}").read_bytes() for end in ("", "_1")] == originals


def test_a_database_with_a_journal_says_that_it_is_not_read(tmp_path: Path) -> None:
    folder = foreign.write_sqlite(tmp_path / "bag", foreign.drive(5))
    (folder / "a_0.db3-wal").write_bytes(b"x" * 4096)
    with BagReader(folder) as reader:
        assert any("has a journal, which is not read: recorder --recover" in line for line in reader.damage)


def test_a_topic_without_a_definition_in_an_older_file_is_read_by_that_of_the_next(tmp_path: Path) -> None:
    folder = foreign.write_sqlite(tmp_path / "bag", foreign.drive(10)[:15])
    foreign.write_mcap(folder / "a_1.mcap", foreign.drive(10)[15:])
    foreign.write_metadata(folder, relative_file_paths=["a_0.db3", "a_1.mcap"])
    with BagReader(folder) as reader:
        assert set(reader.topics) == {"/car/speed", "/demand", "/joint_states"}
        assert reader.topics["/car/speed"].definition == foreign.SPEED.text


def test_a_file_whose_first_block_was_never_written_is_recovered_from_its_first_chunk_on(tmp_path: Path) -> None:
    found = foreign.drive(20)
    chunks = [foreign.announced() + foreign.message_records(found[i : i + 15]) for i in range(0, 60, 15)]
    path = foreign.write_records(tmp_path / "a.mcap", *map(foreign.chunk, chunks))
    path.write_bytes(bytes(512) + path.read_bytes()[512:])
    report = recover(path).files[0]
    assert (report.message_count, report.kept) == (45, "a.mcap.damaged")
    assert "does not begin as an MCAP file" in report.damage
    assert [message.data for message in messages(path)] == [data for _, _, data in found[15:]]


def test_of_a_file_with_too_many_channels_the_messages_are_recovered(tmp_path: Path) -> None:
    many = b"".join(foreign.record(Channel(i, f"/t{i}", "cdr", {}, 2)) for i in range(10, 65_536))
    records = foreign.message_records(foreign.drive(5))
    path = foreign.write_records(tmp_path / "a.mcap", foreign.announced(), foreign.chunk(many), foreign.chunk(records))
    assert recover(path).files[0].message_count == 15
    assert {message.topic for message in messages(path)} == {"/car/speed", "/demand", "/joint_states"}


def test_behind_a_stretch_that_a_power_cut_has_left_empty_reading_goes_on(tmp_path: Path) -> None:
    folder = foreign.write_bag(tmp_path / "bag", foreign.drive(100), chunk_bytes=1000)
    path = folder / "a_0.mcap"
    content = bytearray(path.read_bytes()[:-40])
    content[len(content) // 3 : len(content) // 3 + 600] = bytes(600)
    path.write_bytes(bytes(content))
    report = recover(folder)
    assert report.files[0].lost_chunks > 0
    found = messages(folder)
    assert 200 < len(found) < 300
    assert {message.data for message in found} <= {data for _, _, data in foreign.drive(100)}
    assert (folder / "a_0.mcap.damaged").read_bytes() == bytes(content)


@pytest.mark.parametrize("name", ["drive", "drive.MCAP", "drive.mcap.zst", "drive.bag"])
@pytest.mark.parametrize("listed", [True, False])
def test_what_is_read_under_another_name_is_recovered_under_it(tmp_path: Path, name: str, listed: bool) -> None:
    folder = torn(tmp_path / "bag")
    content = (folder / "a_0.mcap").read_bytes()
    (folder / "a_0.mcap").unlink()
    (folder / name).write_bytes(zstandard.compress(content) if name.endswith(".zst") else content)
    foreign.write_metadata(folder, relative_file_paths=[name])
    path = folder if listed else folder / name
    before = messages(path)
    report = recover(path)
    assert report.files[0].rebuilt
    assert (folder / name).is_file()
    assert messages(folder if listed else folder / report.files[0].name) == before != []


def test_a_file_that_another_one_would_be_recovered_over_is_left_alone(tmp_path: Path) -> None:
    other = torn(tmp_path / "bag") / "a_0.mcap"
    packed = other.with_name("a_0.mcap.zstd")
    packed.write_bytes(zstandard.compress(other.read_bytes()))
    before = other.read_bytes()
    for path in (packed, foreign.write_sqlite(tmp_path / "sqlite", entries()[:20], CHANNELS) / "a_0.db3"):
        path.with_name("a_0.mcap").write_bytes(before)
        if path.suffix == ".db3":
            path.write_bytes(path.read_bytes()[:-100])
        with pytest.raises(BagError, match=r"a_0\.mcap: exists, and what is recovered of a_0\..* would go there"):
            recover(path)
        assert path.with_name("a_0.mcap").read_bytes() == before


def test_definitions_that_a_database_holds_as_bytes_are_read(tmp_path: Path) -> None:
    folder = foreign.write_sqlite(tmp_path / "bag", foreign.drive(3))
    with sqlite3.connect(folder / "a_0.db3") as database:
        database.execute("CREATE TABLE message_definitions(topic_type, encoding, encoded_message_definition)")
        text = foreign.SPEED.text.encode()
        database.execute("INSERT INTO message_definitions VALUES(?, ?, ?)", (foreign.SPEED.type, b"ros2msg", text))
    database.close()
    with BagReader(folder) as reader:
        topic = reader.topics[foreign.SPEED.topic]
    assert (topic.definition, topic.encoding) == (foreign.SPEED.text, "ros2msg")


def test_the_types_of_channels_without_a_schema_are_those_that_metadata_states(tmp_path: Path) -> None:
    channels = b"".join(
        foreign.record(Channel(i, channel.topic, "cdr", {}, 0)) for i, channel in enumerate(foreign.CHANNELS, 1)
    )
    kept = foreign.chunk(foreign.message_records(foreign.drive(5)))
    path = foreign.write_records(tmp_path / "bag" / "a_0.mcap", channels, kept)
    path.write_bytes(path.read_bytes()[:-20])
    foreign.write_metadata(path.parent)
    stated = {channel.topic: channel.type for channel in foreign.CHANNELS}
    with BagReader(path.parent) as reader:
        assert {name: topic.type for name, topic in reader.topics.items()} == stated
    assert recover(path.parent).files[0].rebuilt
    with BagReader(path.parent) as reader:
        assert {name: topic.type for name, topic in reader.topics.items()} == stated
        assert reader.damage == []
