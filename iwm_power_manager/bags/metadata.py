"""What stands in a rosbag2 `metadata.yaml`, version 9, and how it is written."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import yaml

METADATA_FILE = "metadata.yaml"
METADATA_VERSION = 9
#: Name of the MCAP metadata record that holds the custom metadata from the first byte on, for the case of a crash.
CUSTOM_METADATA = "iwm_power_manager"

#: A duration that never ends, as ROS writes it: the largest number of nanoseconds in an int64.
INFINITE_NS = 2**63 - 1
_NANOSECONDS = 1_000_000_000


class Qos(NamedTuple):
    """Quality of service a publisher offered, by the names rosbag2 writes."""

    history: str = "keep_last"
    depth: int = 10
    reliability: str = "reliable"
    durability: str = "volatile"
    deadline_ns: int = INFINITE_NS
    lifespan_ns: int = INFINITE_NS
    liveliness: str = "automatic"
    liveliness_lease_ns: int = INFINITE_NS

    def as_rosbag2(self) -> dict[str, Any]:
        """The mapping rosbag2 writes for one profile."""
        return {
            "history": self.history,
            "depth": self.depth,
            "reliability": self.reliability,
            "durability": self.durability,
            "deadline": _duration(self.deadline_ns),
            "lifespan": _duration(self.lifespan_ns),
            "liveliness": self.liveliness,
            "liveliness_lease_duration": _duration(self.liveliness_lease_ns),
            "avoid_ros_namespace_conventions": False,
        }


class Topic(NamedTuple):
    """A recorded topic: all that a reader needs to decode its messages.

    Attributes
    ----------
    name, type : full topic name, and type such as `std_msgs/msg/Float64`
    definition : the type's definition with all it depends on, as `ros2msg` text ("" if unknown)
    type_hash : the type's RIHS01 hash ("" if unknown)
    qos : profiles offered by the publishers
    """

    name: str
    type: str
    definition: str
    type_hash: str
    qos: tuple[Qos, ...] = ()


class FileSpan(NamedTuple):
    """One file of a bag: when it starts and ends (ns), and how many messages it holds."""

    name: str
    start_ns: int
    end_ns: int
    message_count: int


def qos_text(profiles: Sequence[Qos]) -> str:
    """Profiles as the YAML text rosbag2 puts into a channel's `offered_qos_profiles`."""
    return _dump([profile.as_rosbag2() for profile in profiles]) if profiles else ""


def bag_information(
    storage: str,
    files: Sequence[FileSpan],
    topics: Sequence[tuple[Topic, int]],
    custom_data: Mapping[str, str],
) -> dict[str, Any]:
    """The content of `rosbag2_bagfile_information`.

    Parameters
    ----------
    storage : "mcap" or "sqlite3"
    files : the bag's files in the order of recording
    topics : each topic with the number of its messages
    custom_data : free text by key
    """
    filled = [file for file in files if file.message_count]
    start = min((file.start_ns for file in filled), default=0)
    end = max((file.end_ns for file in filled), default=0)
    return {
        "version": METADATA_VERSION,
        "storage_identifier": storage,
        "duration": {"nanoseconds": end - start},
        "starting_time": {"nanoseconds_since_epoch": start},
        "message_count": sum(file.message_count for file in files),
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic.name,
                    "type": topic.type,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": [profile.as_rosbag2() for profile in topic.qos],
                    "type_description_hash": topic.type_hash,
                },
                "message_count": count,
            }
            for topic, count in topics
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file.name for file in files],
        "files": [
            {
                "path": file.name,
                "starting_time": {"nanoseconds_since_epoch": file.start_ns},
                "duration": {"nanoseconds": file.end_ns - file.start_ns},
                "message_count": file.message_count,
            }
            for file in files
        ],
        "custom_data": dict(custom_data) or None,
        "ros_distro": os.environ.get("ROS_DISTRO") or "jazzy",
    }


def metadata_text(information: Mapping[str, Any]) -> str:
    """Text of `metadata.yaml`."""
    return _dump({"rosbag2_bagfile_information": dict(information)})


def information_text(information: Mapping[str, Any]) -> str:
    """Text of the `serialized_metadata` that rosbag2 keeps inside an MCAP file."""
    return _dump(dict(information))


def _duration(nanoseconds: int) -> dict[str, int]:
    return {"sec": nanoseconds // _NANOSECONDS, "nsec": nanoseconds % _NANOSECONDS}


class _Dumper(yaml.SafeDumper):
    def ignore_aliases(self, data: Any) -> bool:
        return True  # rosbag2's reader wants each profile written out


def _dump(content: Any) -> str:
    return str(yaml.dump(content, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=1000))
