# SPDX-License-Identifier: Apache-2.0
"""Bags as other people's recorders and other cars leave them: small, made anew for each test."""

from __future__ import annotations

import json
import math
import sqlite3
import struct
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import mcap.records
import yaml
from mcap.data_stream import RecordBuilder
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from iwm_power_manager.bags.reader import BagReader
from iwm_power_manager.errors import BagError

COUNT = 100
PERIOD_NS = 20_000_000
START_NS = 1_700_000_000_000_000_000
NAN = math.nan
LINE = "=" * 80

STAMPED = (
    f"std_msgs/Header header\n{{fields}}{LINE}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
)
STAMPED += f"{LINE}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
SPEED_TEXT = STAMPED.format(fields="float64 value\n")
JOINTS_TEXT = STAMPED.format(fields="string[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n")
IDL_TEXT = (
    f"{LINE}\nIDL: my_msgs/msg/Speed\n\nmodule std_msgs {{ module msg {{ struct Header {{\n"
    "builtin_interfaces::msg::Time stamp; string frame_id; }; }; };\n"
    "module builtin_interfaces { module msg { struct Time { long sec; unsigned long nanosec; }; }; };\n"
    "module my_msgs { module msg { struct Speed {\n"
    'std_msgs::msg::Header header; @unit (value="m/s") double value; }; }; };\n'
)
#: As rosidl writes it of a .msg: directives, comments, constants, and annotations whose text goes over several lines.
ROSIDL_TEXT = """\
================================================================================
IDL: my_msgs/msg/Speed
// generated from rosidl_adapter/resource/msg.idl.em

#include "std_msgs/msg/Header.idl"

module my_msgs {
  module msg {
    typedef double double__2[2];
    module Speed_Constants {
      const uint8 GOOD = 1;
      const string UNIT = "m/s";
    };
    @verbatim (language="comment", text=
      "# Speed of the car" "\\n"
      "as measured")
    struct Speed {
      std_msgs::msg::Header header;

      @default (value=0.0)
      @unit (value="m/s")
      double value;
    };
  };
};
================================================================================
IDL: std_msgs/msg/Header
#include "builtin_interfaces/msg/Time.idl"
module std_msgs { module msg { struct Header { builtin_interfaces::msg::Time stamp; string frame_id; }; }; };
================================================================================
IDL: builtin_interfaces/msg/Time
module builtin_interfaces { module msg { struct Time { int32 sec; uint32 nanosec; }; }; };
"""


class Channel(NamedTuple):
    """A topic of the bag: its name, its type, the encoding and text of its definition, and that of its messages."""

    topic: str
    type: str
    text: str
    encoding: str = "ros2msg"
    serialization: str = "cdr"


SPEED = Channel("/car/speed", "my_msgs/msg/Speed", SPEED_TEXT)
DEMAND = Channel("/demand", "std_msgs/msg/Float64", "float64 data\n")
JOINTS = Channel("/joint_states", "sensor_msgs/msg/JointState", JOINTS_TEXT)
CHANNELS = (SPEED, DEMAND, JOINTS)

MAPPING = """\
signals:
  speed: {topic: /car/speed, field: value, unit: m/s}
  wheel_speed: {topic: /joint_states, field: velocity, unit: rad/s, names: [fl, fr, rl, rr]}
  power_demand: {topic: /demand, field: data, unit: W}
"""

#: Log time, channel's number, bytes.
Entry = tuple[int, int, bytes]


def header(stamp_ns: int) -> bytes:
    """Encapsulation and a header without a frame, up to the next multiple of eight."""
    return b"\0\1\0\0" + struct.pack("<iII4x", stamp_ns // 10**9, stamp_ns % 10**9, 1)


def speed(stamp_ns: int, value: float) -> bytes:
    """CDR of `SPEED`."""
    return header(stamp_ns) + struct.pack("<d", value)


def joints(stamp_ns: int, velocity: Iterable[float]) -> bytes:
    """CDR of a JointState with the wheels fl, fr, rl, rr."""
    names = b"".join(struct.pack("<I3sx", 3, name + b"\0") for name in (b"fl", b"fr", b"rl", b"rr"))
    head = b"\0\1\0\0" + struct.pack("<iII4x", stamp_ns // 10**9, stamp_ns % 10**9, 1)[:13] + bytes(3)
    body = head + struct.pack("<I", 4) + names + struct.pack("<I", 0) + struct.pack("<I", 4)
    body += bytes(-(len(body) - 4) % 8)
    return body + struct.pack("<4d", *velocity) + struct.pack("<I", 0)


def drive(
    count: int = COUNT,
    stamp: Callable[[int], int] = lambda log_ns: log_ns,
    velocity: Callable[[int, float], tuple[float, ...]] = lambda _, w: (w, w, w, w),
    start_ns: int = START_NS,
) -> list[Entry]:
    """Speed, demand and wheel speeds of a car that drives 8 to 9.5 m/s, every 20 ms."""
    entries: list[Entry] = []
    for i in range(count):
        log_ns = start_ns + i * PERIOD_NS
        v = 8.0 + 1.5 * math.sin(math.pi * i / count)
        entries.append((log_ns, 0, speed(stamp(log_ns), v)))
        entries.append((log_ns + 1000, 1, b"\0\1\0\0" + struct.pack("<d", 3000.0)))
        entries.append((log_ns + 2000, 2, joints(stamp(log_ns), velocity(i, v / 0.33))))
    return entries


def write_mcap(
    path: Path,
    entries: Iterable[Entry],
    channels: Iterable[Channel] = CHANNELS,
    chunk_bytes: int = 8192,
    compression: str = "zstd",
    extras: Callable[[Writer], None] = lambda _: None,
) -> Path:
    """One MCAP file of another writer."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=chunk_bytes, compression=CompressionType[compression.upper()])
        writer.start("ros2", "foreign")
        extras(writer)
        numbers = []
        for channel in channels:
            schema = writer.register_schema(channel.type, channel.encoding, channel.text.encode())
            numbers.append(
                writer.register_channel(channel.topic, channel.serialization, schema, {"key": channel.topic})
            )
        for sequence, (log_ns, number, data) in enumerate(entries, 1):
            writer.add_message(numbers[number], log_ns, data, max(log_ns - 500, 0), sequence)
        writer.finish()
    return path


def record(content: Any) -> bytes:
    """A record of the `mcap` package as bytes."""
    builder = RecordBuilder()
    content.write(builder)
    return bytes(builder.end())


def announced(channels: Iterable[Channel] = CHANNELS) -> bytes:
    """Records of schemas and channels, numbered from 1 on."""
    channels = tuple(channels)
    return schema_records(channels) + channel_records(channels)


def schema_records(channels: Iterable[Channel] = CHANNELS) -> bytes:
    """Records of schemas, numbered from 1 on."""
    return b"".join(
        record(mcap.records.Schema(id=i, name=channel.type, encoding=channel.encoding, data=channel.text.encode()))
        for i, channel in enumerate(channels, 1)
    )


def channel_records(channels: Iterable[Channel] = CHANNELS) -> bytes:
    """Records of channels, numbered from 1 on."""
    return b"".join(
        record(mcap.records.Channel(i, channel.topic, channel.serialization, {}, i))
        for i, channel in enumerate(channels, 1)
    )


def statistics(entries: list[Entry]) -> bytes:
    """The record of a summary that counts messages."""
    counts = Counter(number + 1 for _, number, _ in entries)
    times = [log_ns for log_ns, _, _ in entries]
    return record(
        mcap.records.Statistics(
            attachment_count=0,
            channel_count=len(counts),
            channel_message_counts=counts,
            chunk_count=1,
            message_count=len(entries),
            message_end_time=max(times),
            message_start_time=min(times),
            metadata_count=0,
            schema_count=len(counts),
        )
    )


def message_records(entries: Iterable[Entry]) -> bytes:
    """Records of messages."""
    return b"".join(
        record(mcap.records.Message(number + 1, log_ns, data, log_ns, i))
        for i, (log_ns, number, data) in enumerate(entries)
    )


def chunk(records: bytes, compression: str = "", packed: bytes | None = None) -> bytes:
    """A chunk without a checksum; `packed` is what stands in it."""
    content = records if packed is None else packed
    return record(mcap.records.Chunk(compression, content, START_NS, START_NS, 0, len(records)))


def write_records(path: Path, *parts: bytes, summary: bytes = b"") -> Path:
    """A whole MCAP file of such records."""
    path.parent.mkdir(parents=True, exist_ok=True)
    content = b"".join([MCAP0_MAGIC, record(mcap.records.Header("ros2", "foreign")), *parts])
    content += record(mcap.records.DataEnd(0))
    footer = record(mcap.records.Footer(len(content) if summary else 0, 0, 0))
    path.write_bytes(content + summary + footer + MCAP0_MAGIC)
    return path


def write_metadata(folder: Path, channels: Iterable[Channel] = CHANNELS, **changes: Any) -> Path:
    """A `metadata.yaml` of rosbag2 version 5 for one file, with changes."""
    counts: Counter[str] = Counter()
    with suppress(BagError), BagReader(folder) as reader:
        for name, count in reader.counts.items():
            counts[reader.topics[name].name] += count
    information = {
        "version": 5,
        "storage_identifier": "mcap",
        "relative_file_paths": ["a_0.mcap"],
        "duration": {"nanoseconds": 1},
        "starting_time": {"nanoseconds_since_epoch": START_NS},
        "message_count": counts.total(),
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": channel.topic,
                    "type": channel.type,
                    "serialization_format": channel.serialization,
                    "offered_qos_profiles": "",
                },
                "message_count": counts[channel.topic],
            }
            for channel in channels
        ],
        "compression_format": "",
        "compression_mode": "",
        **changes,
    }
    (folder / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": information}))
    return folder


def write_bag(folder: Path, entries: Iterable[Entry], channels: Iterable[Channel] = CHANNELS, **options: Any) -> Path:
    """A bag's folder with one MCAP file and metadata."""
    write_mcap(folder / "a_0.mcap", entries, channels, **options)
    return write_metadata(folder, channels)


def write_sqlite(
    folder: Path, entries: Iterable[Entry], channels: Iterable[Channel] = CHANNELS, timestamps: str = "INTEGER"
) -> Path:
    """A bag as Eloquent wrote it: no quality of service, no definitions, paths with the folder's name in front."""
    folder.mkdir()
    with sqlite3.connect(folder / "a_0.db3") as database:
        database.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)")
        database.execute(
            f"CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp {timestamps}, data BLOB)"
        )
        for number, channel in enumerate(channels):
            database.execute("INSERT INTO topics VALUES(?, ?, ?, 'cdr')", (number, channel.topic, channel.type))
        database.executemany(
            "INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)",
            [(number, log_ns, data) for log_ns, number, data in entries],
        )
    database.close()
    paths = [f"{folder.name}/a_0.db3"]
    return write_metadata(folder, channels, version=2, storage_identifier="sqlite3", relative_file_paths=paths)


def log_channel() -> tuple[Channel, bytes]:
    """A topic in JSON beside those of ROS."""
    return Channel("/log", "foxglove.Log", '{"type":"object"}', "jsonschema", "json"), json.dumps({"a": 1}).encode()
