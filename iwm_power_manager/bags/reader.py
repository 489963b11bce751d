"""Read any rosbag2 bag: MCAP or sqlite3, one file or many, compressed or not, whole or damaged. Needs no ROS.

Messages come in the order of their log times. What cannot be read is counted and described in `BagReader.damage`;
it is never fatal as long as anything can be read.
"""

from __future__ import annotations

import heapq
import sqlite3
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, Self

import yaml

from iwm_power_manager.bags.mcap_scan import McapChannel, McapScan
from iwm_power_manager.bags.metadata import CUSTOM_METADATA, METADATA_FILE, Qos, Topic
from iwm_power_manager.errors import BagError

_SUFFIXES = (".mcap", ".db3")
_COMPRESSED_SUFFIX = ".zstd"


class Message(NamedTuple):
    """One recorded message.

    Attributes
    ----------
    log_time_ns : when it was received
    topic : full topic name
    data : CDR bytes
    publish_time_ns : when it was sent (the log time where the storage does not say)
    sequence : the publisher's counter, 0 if unknown
    """

    log_time_ns: int
    topic: str
    data: bytes
    publish_time_ns: int
    sequence: int


class BagReader:
    """A bag, opened for reading.

    Parameters
    ----------
    path : folder of the bag, or one `.mcap` or `.db3` file

    Attributes
    ----------
    topics : recorded topics by name
    counts : messages by topic where metadata or storage say it without reading all; may be empty
    custom_data : custom metadata
    start_ns, end_ns : log times the bag spans (0, 0 if it is empty)

    Raises
    ------
    BagError
        There is no bag, or nothing in it can be read.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self._stack = ExitStack()
        self._damage: list[str] = []
        information = self._information()
        self.custom_data: dict[str, str] = {
            str(key): str(value) for key, value in (information.get("custom_data") or {}).items()
        }
        self._unpack_message = _message_unpacker(information)
        self._files: list[_McapSource | _SqliteSource] = []
        problems = []
        try:
            for name in self._file_names(information):
                try:
                    self._files.append(self._open(name))
                except BagError as error:
                    problems.append(str(error))
            if not self._files:
                raise BagError(problems[0] if problems else f"{self.path}: holds no .mcap or .db3 file")
        except BagError:
            self.close()
            raise
        self._damage += problems
        self.topics: dict[str, Topic] = {}
        for file in self._files:
            for topic in file.topics():
                self.topics.setdefault(topic.name, topic)
            for key, value in file.custom_data().items():
                self.custom_data.setdefault(key, value)
        filled = [file for file in self._files if file.end_ns]
        self.start_ns = min((file.start_ns for file in filled), default=0)
        self.end_ns = max((file.end_ns for file in filled), default=0)
        self.counts: dict[str, int] = {}
        for entry in information.get("topics_with_message_count") or []:
            self.counts[str(entry["topic_metadata"]["name"])] = int(entry["message_count"])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the files."""
        self._stack.close()

    @property
    def damage(self) -> list[str]:
        """What could not be read so far, a line each; empty for a whole bag."""
        return self._damage + [f"{file.path}: {file.damage}" for file in self._files if file.damage]

    @property
    def size_bytes(self) -> int:
        """Size of all files."""
        return sum(file.path.stat().st_size for file in self._files)

    def messages(self) -> Iterator[Message]:
        """All messages in the order of their log times; equal times keep the order of the recording."""
        files = sorted(self._files, key=lambda file: file.start_ns)
        overlap = any(after.start_ns <= before.end_ns for before, after in pairwise(files))
        streams = [file.messages() for file in files]
        merged = heapq.merge(*streams, key=lambda message: message.log_time_ns) if overlap else _chain(streams)
        unpack = self._unpack_message
        if unpack is None:
            yield from merged
            return
        for message in merged:
            yield message._replace(data=unpack(message.data))

    # --- opening ----------------------------------------------------------------------------------------------------

    def _information(self) -> dict[str, Any]:
        if not self.path.is_dir():
            return {}
        try:
            text = (self.path / METADATA_FILE).read_text(encoding="utf-8")
            information = yaml.safe_load(text)["rosbag2_bagfile_information"]
            if not isinstance(information, dict):
                raise TypeError
            return information
        except FileNotFoundError:
            self._damage.append(f"{self.path}: has no metadata.yaml: the recorder did not finish")
        except (OSError, UnicodeDecodeError, yaml.YAMLError, KeyError, TypeError):
            self._damage.append(f"{self.path / METADATA_FILE}: cannot be read")
        return {}

    def _file_names(self, information: dict[str, Any]) -> list[Path]:
        if not self.path.exists():
            raise BagError(f"{self.path}: does not exist")
        if self.path.is_file():
            return [self.path]
        names = [self.path / str(name) for name in information.get("relative_file_paths") or []]
        present = [name for name in names if name.is_file()]
        for name in names:
            if name not in present:
                self._damage.append(f"{name}: is missing")
        return present or sorted(
            (entry for entry in self.path.iterdir() if entry.name.removesuffix(_COMPRESSED_SUFFIX).endswith(_SUFFIXES)),
            key=recording_order,
        )

    def _open(self, path: Path) -> _McapSource | _SqliteSource:
        if path.suffix == _COMPRESSED_SUFFIX:
            path = self._uncompressed(path)
        return (_SqliteSource if path.suffix == ".db3" else _McapSource)(path, self._stack)

    def _uncompressed(self, path: Path) -> Path:
        import zstandard

        folder = self._stack.enter_context(tempfile.TemporaryDirectory(prefix="iwm_bag_"))
        target = Path(folder) / path.stem
        try:
            with path.open("rb") as source, target.open("wb") as sink:
                zstandard.ZstdDecompressor().copy_stream(source, sink)
        except (OSError, zstandard.ZstdError) as error:
            self._damage.append(f"{path}: is damaged: {error}")
        return target


class _McapSource:
    """Messages of an MCAP file."""

    def __init__(self, path: Path, stack: ExitStack) -> None:
        self.path = path
        self._scan = stack.enter_context(McapScan(path))
        self.start_ns = self._scan.start_ns
        self.end_ns = self._scan.end_ns
        if not self._scan.channels:
            self._scan.read_definitions()  # no summary, and announced inside of chunks only

    @property
    def damage(self) -> str:
        return self._scan.damage

    def topics(self) -> list[Topic]:
        return [topic_of(channel) for channel in self._scan.channels.values() if channel.encoding == "cdr"]

    def custom_data(self) -> dict[str, str]:
        return custom_data_of(self._scan)

    def messages(self) -> Iterator[Message]:
        scan = self._scan
        names: dict[int, str] = {}
        make = Message
        for log_time, channel, data, publish_time, sequence in scan.messages():
            name = names.get(channel)
            if name is None:
                known = scan.channels.get(channel)
                name = names[channel] = known.topic if known is not None and known.encoding == "cdr" else ""
            if name:
                yield make(log_time, name, data, publish_time, sequence)


class _SqliteSource:
    """Messages of a rosbag2 sqlite3 file."""

    def __init__(self, path: Path, stack: ExitStack) -> None:
        self.path = path
        self.damage = ""
        self.start_ns = self.end_ns = 0
        self._topics: dict[int, Topic] = {}
        try:
            self._database = stack.enter_context(
                closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True))
            )
            try:
                self._read_topics()
            except sqlite3.DatabaseError:
                # A truncated file is refused as a whole, unless one says that one knows.
                self._database.execute("PRAGMA writable_schema = ON")
                self._read_topics()
                self.damage = "is truncated"
        except sqlite3.Error as error:
            raise BagError(f"{path}: is no readable sqlite3 bag: {error}") from None
        try:
            row = self._database.execute("SELECT min(timestamp), max(timestamp) FROM messages").fetchone()
            self.start_ns, self.end_ns = (row[0] or 0), (row[1] or 0)
        except sqlite3.Error as error:
            self.damage = str(error)

    def _read_topics(self) -> None:
        columns = {str(row[1]) for row in self._database.execute("PRAGMA table_info(topics)")}
        hash_column = "type_description_hash" if "type_description_hash" in columns else "''"
        definitions = self._definitions()
        for number, name, msgtype, qos, type_hash in self._database.execute(
            f"SELECT id, name, type, offered_qos_profiles, {hash_column} FROM topics"  # noqa: S608 - two constants
        ):
            self._topics[number] = Topic(
                name, msgtype, definitions.get(msgtype, ""), type_hash or "", parse_qos(qos or "")
            )

    def topics(self) -> list[Topic]:
        return list(self._topics.values())

    def custom_data(self) -> dict[str, str]:
        return {}

    def messages(self) -> Iterator[Message]:
        order = "id" if self.damage else "timestamp, id"  # a damaged index cannot sort
        delivered = 0
        try:
            for number, timestamp, data in self._database.execute(
                f"SELECT topic_id, timestamp, data FROM messages ORDER BY {order}"  # noqa: S608 - two constants
            ):
                topic = self._topics.get(number)
                if topic is not None:
                    delivered += 1
                    yield Message(timestamp, topic.name, data, timestamp, 0)
        except sqlite3.Error as error:
            self.damage = f"readable up to message {delivered}: {error}"

    def _definitions(self) -> dict[str, str]:
        try:
            rows = self._database.execute(
                "SELECT topic_type, encoded_message_definition FROM message_definitions WHERE encoding = 'ros2msg'"
            )
            return {str(name): str(text) for name, text in rows}
        except sqlite3.OperationalError:
            return {}  # bags older than Iron carry no definitions


def topic_of(channel: McapChannel) -> Topic:
    """The topic an MCAP channel stands for."""
    return Topic(
        channel.topic,
        channel.schema.name,
        channel.schema.text if channel.schema.encoding == "ros2msg" else "",
        channel.metadata.get("topic_type_hash", ""),
        parse_qos(channel.metadata.get("offered_qos_profiles", "")),
    )


def custom_data_of(scan: McapScan) -> dict[str, str]:
    """Custom metadata that our recorder put into an MCAP file."""
    values: dict[str, str] = {}
    for name, content in scan.metadata:
        if name == CUSTOM_METADATA:
            values.update(content)
    return values


def parse_qos(text: str) -> tuple[Qos, ...]:
    """Profiles from the YAML of a channel, of any rosbag2 version; empty where it cannot be understood."""
    try:
        entries = yaml.safe_load(text) if text else []
        return tuple(_qos(entry) for entry in entries or [])
    except (yaml.YAMLError, KeyError, TypeError, ValueError, AttributeError, IndexError):
        return ()


_HISTORY = ("system_default", "keep_last", "keep_all", "unknown")
_RELIABILITY = ("system_default", "reliable", "best_effort", "unknown", "best_available")
_DURABILITY = ("system_default", "transient_local", "volatile", "unknown", "best_available")
_LIVELINESS = ("system_default", "automatic", "manual_by_node", "manual_by_topic", "unknown", "best_available")


def _qos(entry: dict[str, Any]) -> Qos:
    def name(key: str, numbers: tuple[str, ...]) -> str:
        value = entry[key]
        return numbers[value] if isinstance(value, int) else str(value)

    def nanoseconds(key: str) -> int:
        return int(entry[key]["sec"]) * 1_000_000_000 + int(entry[key]["nsec"])

    return Qos(
        name("history", _HISTORY),
        int(entry["depth"]),
        name("reliability", _RELIABILITY),
        name("durability", _DURABILITY),
        nanoseconds("deadline"),
        nanoseconds("lifespan"),
        name("liveliness", _LIVELINESS),
        nanoseconds("liveliness_lease_duration"),
    )


def _message_unpacker(information: dict[str, Any]) -> Callable[[bytes], bytes] | None:
    if str(information.get("compression_mode") or "").lower() != "message":
        return None
    import zstandard

    context = zstandard.ZstdDecompressor()

    def unpack(data: bytes) -> bytes:
        try:
            return context.decompressobj().decompress(data)
        except zstandard.ZstdError:
            return b""  # decoders refuse an empty message, and count it

    return unpack


def _chain(streams: list[Iterator[Message]]) -> Iterator[Message]:
    for stream in streams:
        yield from stream


def recording_order(path: Path) -> tuple[int, str]:
    """`bag_10.mcap` comes after `bag_9.mcap`."""
    digits = path.name.split(".", 1)[0].rpartition("_")[2]
    return (int(digits) if digits.isdigit() else 0, path.name)
