# SPDX-License-Identifier: Apache-2.0
"""What stands in a rosbag2 `metadata.yaml`, version 9, and how it is written.

Profiles of quality of service are those of rosbags, and it reads and writes them. The rest of the file it writes in the
middle of its `Writer.close` and reads in that of `DirectoryReader.open`, which stops at the first thing that is wrong
(https://gitlab.com/ternaris/rosbags/-/blob/master/src/rosbags/rosbag2/reader.py).
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2.metadata import dump_qos_v9
from rosbags.rosbag2.metadata import parse_qos as rosbags_qos

from iwm_power_manager.bags.limits import MAX_METADATA_BYTES, MAX_QOS_BYTES, regular_file
from iwm_power_manager.errors import BagError

METADATA_FILE = "metadata.yaml"
METADATA_VERSION = 9
#: Name of the MCAP metadata record that holds the custom metadata from the first byte on, for the case of a crash.
CUSTOM_METADATA = "iwm_power_manager"

_NS_PER_S = 1_000_000_000
#: A duration that never ends, as ROS writes it: the largest number of nanoseconds in an int64.
INFINITE = QosTime(*divmod(2**63 - 1, _NS_PER_S))
DEFAULT_QOS = Qos(
    QosHistory.KEEP_LAST,
    10,
    QosReliability.RELIABLE,
    QosDurability.VOLATILE,
    INFINITE,
    INFINITE,
    QosLiveliness.AUTOMATIC,
    INFINITE,
    False,
)


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

    def span(start_ns: int, end_ns: int, count: int) -> dict[str, Any]:
        return {
            "starting_time": {"nanoseconds_since_epoch": start_ns},
            "duration": {"nanoseconds": end_ns - start_ns},
            "message_count": count,
        }

    filled = [file for file in files if file.message_count]
    start_ns = min((file.start_ns for file in filled), default=0)
    end_ns = max((file.end_ns for file in filled), default=0)
    return {
        "version": METADATA_VERSION,
        "storage_identifier": storage,
        **span(start_ns, end_ns, sum(file.message_count for file in files)),
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic.name,
                    "type": topic.type,
                    "serialization_format": topic.serialization,
                    "offered_qos_profiles": qos_entries(topic.qos),
                    "type_description_hash": topic.type_hash,
                },
                "message_count": count,
            }
            for topic, count in topics
        ],
        "compression_format": compression,
        "compression_mode": "MESSAGE" if compression else "",
        "relative_file_paths": [file.name for file in files],
        "files": [{"path": file.name, **span(*file[1:])} for file in files],
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
    except Exception:  # noqa: BLE001 - constructors of dates, numbers and booleans raise anything at a text that is none
        return {}
    if isinstance(content, dict):
        content = content.get("rosbag2_bagfile_information", content)
    return content if isinstance(content, dict) else {}


def read_metadata(folder: Path) -> tuple[dict[str, Any], str]:
    """What the `metadata.yaml` of a folder says ({} for nothing), and a line of what is wrong with it ("" for nothing).

    Whatever is wrong, the data files can be read without it.
    """
    path = folder / METADATA_FILE
    if not os.path.lexists(path):
        return {}, f"{folder}: has no metadata.yaml: the recorder did not finish"
    try:
        if regular_file(path, folder) <= MAX_METADATA_BYTES:
            found = information_of(path.read_text(encoding="utf-8-sig"))
            key = _wrong_key(found, _KINDS, "")
            return found, f"{path}: {key} is missing or of the wrong kind; the data files are read" if key else ""
    except (BagError, OSError, UnicodeDecodeError):
        pass
    return {}, f"{path}: cannot be read; the data files are"


#: What has to stand in a `metadata.yaml`, and of which kind.
_KINDS = {
    "version": int,
    "storage_identifier": str,
    "relative_file_paths": [str],
    "message_count": int,
    "duration": {"nanoseconds": int},
    "starting_time": {"nanoseconds_since_epoch": int},
    "custom_data": dict | None,
    "topics_with_message_count": [
        {"message_count": int, "topic_metadata": {"name": str, "type": str, "serialization_format": str}}
    ],
}


def topic_counts(files: Iterable[Any]) -> Counter[str]:
    """Messages by the name of their topic, from the `topics` and the `counts` of each file, by channel."""
    counts: Counter[str] = Counter()
    for file in files:
        for number, topic in file.topics.items():
            counts[topic.name] += file.counts[number]
    return counts


def typed(topic: Topic, information: Mapping[str, Any]) -> Topic:
    """A topic with its type: where the file has no schema for it, the one that a `metadata.yaml` states."""
    entries: Any = information.get("topics_with_message_count")
    if topic.type or _wrong_key(entries, _KINDS["topics_with_message_count"], "topics"):
        return topic
    listed = {entry["topic_metadata"]["name"]: entry["topic_metadata"]["type"] for entry in entries}
    return topic._replace(type=listed.get(topic.name, ""))


def miscounted(information: Mapping[str, Any], topics: Mapping[str, int]) -> bool:
    """Whether a `metadata.yaml` without another problem states other numbers of messages than the files hold."""
    entries = information["topics_with_message_count"]
    listed = {entry["topic_metadata"]["name"]: entry["message_count"] for entry in entries}
    wrong = any(listed.get(name, 0) != count for name, count in topics.items())
    return wrong or bool(information["message_count"] != sum(topics.values()))


def _wrong_key(content: object, kind: Any, key: str) -> str:
    """The first key that is missing or holds something of another kind; "" for none."""
    if isinstance(kind, dict):
        inner = [(content.get(name), of, name) for name, of in kind.items()] if isinstance(content, dict) else None
    elif isinstance(kind, list):
        inner = [(item, kind[0], key) for item in content] if isinstance(content, list) else None
    else:
        inner = [] if isinstance(content, kind) else None
    return key if inner is None else next(filter(None, (_wrong_key(*one) for one in inner)), "")


def text_values(content: object) -> dict[str, str]:
    """The texts of a mapping from outside, such as `custom_data`; anything else is left out."""
    if not isinstance(content, dict):
        return {}
    plain = (str, int, float, bool)
    return {str(key): str(value) for key, value in content.items() if isinstance(key, str) and isinstance(value, plain)}


def qos_entries(profiles: Sequence[Qos]) -> list[Any]:
    """Profiles as rosbag2 writes them."""
    return list(dump_qos_v9(list(profiles)))


@lru_cache(maxsize=256)
def parse_qos(text: str) -> tuple[Qos, ...]:
    """Profiles from the YAML of a channel, of any rosbag2 version; empty where it cannot be understood."""
    if not text or len(text) > MAX_QOS_BYTES:
        return ()
    try:
        profiles: Any = [{"avoid_ros_namespace_conventions": False, **entry} for entry in yaml.load(text, _Loader)]  # noqa: S506
        return tuple(rosbags_qos(profiles))
    except Exception:  # noqa: BLE001 - of no use to anybody but another recorder
        return ()


def yaml_text(content: Any) -> str:
    """YAML as rosbag2 reads it."""
    return str(yaml.dump(content, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=1000))


#: libyaml where PyYAML was built with it.
_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Dumper(getattr(yaml, "CSafeDumper", yaml.SafeDumper)):  # type: ignore[misc]
    def ignore_aliases(self, data: Any) -> bool:
        return True  # rosbag2's reader wants each profile written out
