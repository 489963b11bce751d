# SPDX-License-Identifier: Apache-2.0
"""Bags against the independent readers rosbags and mcap, and against rclpy's own type hashes."""

from __future__ import annotations

import resource
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader
from sensor_msgs.msg import JointState

from bags_helpers import float64, topic
from iwm_power_manager.bags.metadata import DEFAULT_QOS, Topic
from iwm_power_manager.bags.reader import BagReader
from iwm_power_manager.bags.writer import BagWriter, MessageTooLarge, WriterOptions
from iwm_power_manager.errors import BagError

JOINT_STATE = "sensor_msgs/msg/JointState"


def test_rosbags_reads_topics_types_hashes_qos_messages_and_custom_data(make_bag: Callable[..., Path]) -> None:
    path = make_bag(
        [("/a", 10, 1.0), ("/b", 20, 2.0), ("/a", 30, 3.0)], custom_data={"policy_sha256": "abc", "text": "ü: 'x'\n"}
    )
    information = yaml.safe_load((path / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert information["custom_data"] == {"policy_sha256": "abc", "text": "ü: 'x'\n"}
    with Reader(path) as reader:
        assert reader.message_count == 3
        assert (reader.start_time, reader.duration) == (10, 21)  # rosbags ends a nanosecond after the last message
        assert {c.topic: c.msgcount for c in reader.connections} == {"/a": 2, "/b": 1}
        for connection in reader.connections:
            assert connection.msgtype == "std_msgs/msg/Float64"
            assert connection.ext.offered_qos_profiles[0].depth == 10
        assert [(c.topic, t, d) for c, t, d in reader.messages()] == [
            ("/a", 10, float64(1.0)),
            ("/b", 20, float64(2.0)),
            ("/a", 30, float64(3.0)),
        ]
    with AnyReader([path]) as reader:
        decoded = [reader.deserialize(data, c.msgtype).data for c, _, data in reader.messages()]
    assert decoded == [1.0, 2.0, 3.0]


def test_the_type_hash_is_the_one_rclpy_states(tmp_path: Path) -> None:
    import rclpy

    context = rclpy.Context()
    rclpy.init(context=context)
    try:
        node = rclpy.create_node("hash", context=context)
        node.create_publisher(JointState, "t", 1)
        stated = str(node.get_publishers_info_by_topic("/t")[0].topic_type_hash)
        node.destroy_node()
    finally:
        rclpy.shutdown(context=context)
    assert topic("/t", JOINT_STATE).type_hash == stated


def test_metadata_has_the_form_rosbag2_version_9_writes(make_bag: Callable[..., Path]) -> None:
    path = make_bag([("/a", 1_000_000_005, 1.0), ("/a", 3_000_000_005, 2.0)])
    information = yaml.safe_load((path / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert information["version"] == 9
    assert information["storage_identifier"] == "mcap"
    assert information["starting_time"] == {"nanoseconds_since_epoch": 1_000_000_005}
    assert information["duration"] == {"nanoseconds": 2_000_000_000}
    assert information["relative_file_paths"] == ["bag_0.mcap"]
    assert information["files"][0]["message_count"] == 2
    (entry,) = information["topics_with_message_count"]
    assert entry["message_count"] == 2
    profile = entry["topic_metadata"]["offered_qos_profiles"][0]
    assert profile["reliability"] == "reliable"
    assert profile["deadline"] == {"sec": 9223372036, "nsec": 854775807}
    assert entry["topic_metadata"]["type_description_hash"].startswith("RIHS01_")


def test_a_bag_is_split_by_size_and_reads_as_one(make_bag: Callable[..., Path]) -> None:
    path = make_bag([("/a", i, float(i)) for i in range(5000)], max_bytes=20_000, chunk_bytes=2048, compression="none")
    files = sorted(path.glob("*.mcap"))
    assert len(files) > 5
    assert all(file.stat().st_size < 30_000 for file in files)
    with AnyReader([path]) as reader:
        assert [t for _, t, _ in reader.messages()] == list(range(5000))


def test_what_waits_in_memory_counts_for_a_file_s_size(make_bag: Callable[..., Path]) -> None:
    path = make_bag(
        [("/a", i, float(i)) for i in range(5000)], max_bytes=20_000, chunk_bytes=1 << 20, compression="none"
    )
    files = sorted(path.glob("*.mcap"))
    assert len(files) > 5
    assert all(file.stat().st_size < 40_000 for file in files)


def test_a_bag_is_split_by_duration(make_bag: Callable[..., Path]) -> None:
    path = make_bag([("/a", i * 100, 0.0) for i in range(100)], max_duration_ns=1000)
    information = yaml.safe_load((path / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert [entry["message_count"] for entry in information["files"]] == [10] * 10
    assert [entry["starting_time"]["nanoseconds_since_epoch"] for entry in information["files"]] == [
        i * 1000 for i in range(10)
    ]


def test_every_file_of_a_split_bag_carries_schemas_and_custom_data(make_bag: Callable[..., Path]) -> None:
    path = make_bag([("/a", i * 100, 0.0) for i in range(20)], max_duration_ns=1000, custom_data={"key": "value"})
    with BagReader(path / "bag_1.mcap") as alone:
        assert alone.custom_data == {"key": "value"}
        assert alone.topics["/a"].definition.startswith("float64 data")
        assert sum(1 for _ in alone.messages()) == 10


def test_a_split_without_messages_begins_no_file(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        bag.split()
        bag.split()
    assert [p.name for p in sorted((tmp_path / "bag").iterdir())] == ["bag_0.mcap", "metadata.yaml"]


def test_a_topic_and_custom_data_may_come_late(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        first = bag.add_topic(topic("/a"))
        bag.write(first, 1, float64(1.0))
        second = bag.add_topic(topic("/b", JOINT_STATE))
        bag.set_custom_data({"late": "yes"})
        bag.write(second, 2, b"\0\1\0\0" + bytes(28))
    with BagReader(tmp_path / "bag") as reader:
        assert [m.topic for m in reader.messages()] == ["/a", "/b"]
        assert reader.custom_data == {"late": "yes"}


def test_a_message_over_the_limit_is_refused_and_the_bag_goes_on(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag", WriterOptions(max_message_bytes=100)) as bag:
        number = bag.add_topic(topic("/a"))
        bag.write(number, 1, bytes(100))
        with pytest.raises(MessageTooLarge, match=r"/a: a message of 101 bytes .* allowed: <= 100"):
            bag.write(number, 2, bytes(101))
        bag.write(number, 3, float64(1.0))
    with BagReader(tmp_path / "bag") as reader:
        assert [m.log_time_ns for m in reader.messages()] == [1, 3]


def test_an_existing_folder_is_never_overwritten(tmp_path: Path) -> None:
    (tmp_path / "bag").mkdir()
    with pytest.raises(BagError, match="exists already and is not overwritten"):
        BagWriter(tmp_path / "bag")
    assert list((tmp_path / "bag").iterdir()) == []


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BagError, match=r"file/bag: cannot be created: Not a directory"):
        BagWriter(tmp_path / "file" / "bag")


@pytest.mark.parametrize(
    ("option", "value"), [("compression", "gzip"), ("chunk_bytes", 10), ("max_bytes", -1), ("max_message_bytes", 0)]
)
def test_a_wrong_option_is_named_with_what_is_allowed(option: str, value: object) -> None:
    with pytest.raises(BagError, match=rf"{option}: .*{value}.* allowed: "):
        WriterOptions(**{option: value})  # type: ignore[arg-type]


def test_what_was_written_before_the_disk_was_full_stays_readable(tmp_path: Path) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    bag = BagWriter(tmp_path / "bag", WriterOptions(compression="none", chunk_bytes=8192))
    number = bag.add_topic(topic("/a"))
    resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, before[1]))
    try:
        with pytest.raises(BagError, match="bag: cannot be written: File too large"):
            for i in range(10_000):
                bag.write(number, i, float64(i), None, i)
        bag.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    with BagReader(tmp_path / "bag") as reader:
        times = [m.log_time_ns for m in reader.messages()]
        (line,) = reader.damage
    assert "ends without a footer" in line
    assert times == list(range(bag.message_count))
    assert len(times) > 500


def test_a_type_without_definition_is_still_recorded(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        number = bag.add_topic(Topic("/a", "other_msgs/msg/Thing", "", "", (DEFAULT_QOS,)))
        bag.write(number, 1, b"\0\1\0\0")
    with BagReader(tmp_path / "bag") as reader:
        assert [m.data for m in reader.messages()] == [b"\0\1\0\0"]
