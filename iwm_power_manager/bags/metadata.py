# SPDX-License-Identifier: Apache-2.0
"""What stands in a rosbag2 `metadata.yaml`, version 9, and how it is written."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import yaml

from iwm_power_manager.bags.limits import MAX_METADATA_BYTES, MAX_QOS_BYTES

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

    @classmethod
    def of_rosbags(cls, profile: Any) -> Qos:
        """From the profile rosbags reads."""

        def nanoseconds(time: Any) -> int:
            return int(time.sec) * _NANOSECONDS + int(time.nsec)

        return cls(
            profile.history.name.lower(),
            int(profile.depth),
            profile.reliability.name.lower(),
            profile.durability.name.lower(),
            nanoseconds(profile.deadline),
            nanoseconds(profile.lifespan),
            profile.liveliness.name.lower(),
            nanoseconds(profile.liveliness_lease_duration),
        )

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
    definition : the type's definition with all it depends on ("" if unknown)
    type_hash : the type's RIHS01 hash ("" if unknown)
    qos : profiles offered by the publishers
    encoding : of the definition: "ros2msg", "ros2idl", or another that is carried along
    serialization : of the messages
    """

    name: str
    type: str
    definition: str
    type_hash: str
    qos: tuple[Qos, ...] = ()
    encoding: str = "ros2msg"
    serialization: str = "cdr"


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
    *,
    distro: str = "",
    compression: str = "",
) -> dict[str, Any]:
    """The content of `rosbag2_bagfile_information`.

    Parameters
    ----------
    storage : "mcap" or "sqlite3"
    files : the bag's files in the order of recording
    topics : each topic with the number of its messages
    custom_data : free text by key
    distro : ROS distribution; "" for this one
    compression : "zstd" for compressed messages, "" for none
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
                    "serialization_format": topic.serialization,
                    "offered_qos_profiles": [profile.as_rosbag2() for profile in topic.qos],
                    "type_description_hash": topic.type_hash,
                },
                "message_count": count,
            }
            for topic, count in topics
        ],
        "compression_format": compression,
        "compression_mode": "MESSAGE" if compression else "",
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
        "ros_distro": distro or os.environ.get("ROS_DISTRO") or "jazzy",
    }


def information_of(text: str) -> dict[str, Any]:
    """What a `metadata.yaml`, or what rosbag2 keeps of it in a file, says; {} if that is nothing or unreadable."""
    if not text or len(text) > MAX_METADATA_BYTES:
        return {}
    try:
        # Aliases stay references to one object, and nothing here walks them. CSafeLoader builds plain values only.
        content = yaml.load(text, _Loader)  # noqa: S506
    except (yaml.YAMLError, ValueError, RecursionError, AttributeError, TypeError):
        return {}
    if isinstance(content, dict):
        content = content.get("rosbag2_bagfile_information", content)
    return content if isinstance(content, dict) else {}


def problem_with(information: Mapping[str, Any]) -> str:
    """The key of a `metadata.yaml` that is missing or holds something of the wrong kind; "" for none."""

    def wrong(content: Any, keys: Mapping[str, type]) -> list[str]:
        if not isinstance(content, Mapping):
            return ["an entry"]
        return [key for key, kind in keys.items() if not isinstance(content.get(key), kind)]

    bad = wrong(information, _INFORMATION)
    if not bad:
        bad = [key for key, part in _PARTS.items() if wrong(information[key], {part: int})]
        bad += [] if isinstance(information.get("custom_data") or {}, Mapping) else ["custom_data"]
        bad += (
            [] if all(isinstance(name, str) for name in information["relative_file_paths"]) else ["relative_file_paths"]
        )
        for entry in information["topics_with_message_count"]:
            bad += wrong(entry, {"topic_metadata": Mapping, "message_count": int}) or wrong(
                entry["topic_metadata"], {"name": str, "type": str, "serialization_format": str}
            )
    return bad[0] if bad else ""


_INFORMATION: dict[str, type] = {
    "version": int,
    "storage_identifier": str,
    "relative_file_paths": list,
    "duration": Mapping,
    "starting_time": Mapping,
    "message_count": int,
    "topics_with_message_count": list,
}
_PARTS = {"duration": "nanoseconds", "starting_time": "nanoseconds_since_epoch"}


def text_values(content: object) -> dict[str, str]:
    """The texts of a mapping from outside, such as `custom_data`; anything else is left out."""
    if not isinstance(content, dict):
        return {}
    plain = (str, int, float, bool)
    return {str(key): str(value) for key, value in content.items() if isinstance(key, str) and isinstance(value, plain)}


@lru_cache(maxsize=256)
def parse_qos(text: str) -> tuple[Qos, ...]:
    """Profiles from the YAML of a channel, of any rosbag2 version; empty where it cannot be understood."""
    if not text or len(text) > MAX_QOS_BYTES:
        return ()
    try:
        from rosbags.rosbag2.metadata import parse_qos as rosbags_qos

        profiles: Any = [{"avoid_ros_namespace_conventions": False, **entry} for entry in yaml.load(text, _Loader)]  # noqa: S506
        return tuple(Qos.of_rosbags(profile) for profile in rosbags_qos(profiles))
    except Exception:  # noqa: BLE001 - of no use to anybody but another recorder
        return ()


def metadata_text(information: Mapping[str, Any]) -> str:
    """Text of `metadata.yaml`."""
    return _dump({"rosbag2_bagfile_information": dict(information)})


def information_text(information: Mapping[str, Any]) -> str:
    """Text of the `serialized_metadata` that rosbag2 keeps inside an MCAP file."""
    return _dump(dict(information))


def _duration(nanoseconds: int) -> dict[str, int]:
    return {"sec": nanoseconds // _NANOSECONDS, "nsec": nanoseconds % _NANOSECONDS}


#: libyaml where PyYAML was built with it.
_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Dumper(yaml.SafeDumper):
    def ignore_aliases(self, data: Any) -> bool:
        return True  # rosbag2's reader wants each profile written out


def _dump(content: Any) -> str:
    return str(yaml.dump(content, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=1000))
