# SPDX-License-Identifier: Apache-2.0
"""The records and the messages of one MCAP file, whole or damaged, as the MCAP 1.0 specification lays them out.

One way for both: the records are gone through once (a chunk of a megabyte is one of them); the summary of a whole file
says what is in the chunks, else they are opened to see. Chunks are unpacked when their turn comes. Of a whole file
rosbags reads neither publish times nor sequence numbers, and a lock-step replay needs both (`msgsrc` in
https://gitlab.com/ternaris/rosbags/-/blob/master/src/rosbags/rosbag2/storage_mcap.py); the readers of `mcap` take what
a frame says for its size, see `bags.limits`.

What a record says is read by the `mcap` package (`mcap.records`). The way from one record to the next is our own,
because the package's `StreamReader` does not hold a record to its length: one damaged record takes all that follow with
it, and `breakup_chunk` loses a whole chunk with one record of it
(https://github.com/foxglove/mcap/blob/main/python/mcap/mcap/stream_reader.py). Messages are taken apart here, too:
it builds a dataclass for each, which costs more than the rest of reading (`benchmarks/bags.py`).
"""

from __future__ import annotations

import mmap
import re
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from io import BytesIO
from itertools import accumulate
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, Metadata, Schema, Statistics

from iwm_power_manager.bags import limits
from iwm_power_manager.bags.metadata import CUSTOM_METADATA, Topic, information_of, parse_qos, text_values
from iwm_power_manager.errors import BagError, system_errors

MAGIC = b"\x89MCAP0\r\n"

_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_U32, _U64 = struct.Struct("<I"), struct.Struct("<Q")
_ENTRY = struct.Struct("<QQ")  # of a message index: log time, place in the chunk
HEAD_BYTES = _HEAD.size
RECORD_OVERHEAD_BYTES = _MESSAGE.size
_MESSAGE_FIELDS_BYTES = RECORD_OVERHEAD_BYTES - HEAD_BYTES
#: Where in a chunk the name of its compression begins, and in a message index its entries.
_NAME_AT, _ENTRIES_AT = 28, 6
_FOOTER_BYTES = 20

#: A chunk's record from its first byte to the name of its compression: what to look for behind a damaged stretch.
_CHUNK_BEGIN = re.compile(b"\x06.{5}\\0\\0\\0.{28}(?:\\0\\0\\0\\0|\x03\\0\\0\\0lz4|\x04\\0\\0\\0zstd)", re.DOTALL)

#: The same, or a message's head: in a file that has messages outside of chunks.
_ANY_BEGIN = re.compile(b"\x05(?=.{4}\\0{4})|" + _CHUNK_BEGIN.pattern, re.DOTALL)
#: What may follow a message that is looked for, and costs nothing to look at.
_FOLLOWING = [bytes([code]) for code in (Opcode.MESSAGE, Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.DATA_END)]

FIRST_PRIVATE = 0x80
#: Records outside of chunks that are read where they are met: so one sees whether they are what they say.
_KINDS: dict[int, Any] = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.METADATA: Metadata,
    Opcode.ATTACHMENT: Attachment,
    Opcode.STATISTICS: Statistics,
}

#: How the notes of what cannot be carried over begin.
LEFT_OUT = "left out"

#: Opcode of what is no record.
UNREADABLE = 0

Bytes = bytes | mmap.mmap
_CHUNK_HEAD = struct.Struct("<QQQ")  # first and last log time, uncompressed size
#: Messages that stand outside of chunks are read in pieces of about this size.
_RUN_BYTES = 1024 * 1024
_NEVER = 2**64


class Record(NamedTuple):
    """Where a record is: its first byte, its body's, and the one behind it; and of some kinds what it says."""

    opcode: int
    start: int
    body: int
    end: int
    content: Any = None


#: A message: log time, channel's number, bytes, publish time, sequence.
ChannelMessage = tuple[int, int, bytes, int, int]


def walk(data: Bytes, offset: int = len(MAGIC)) -> Iterator[Record]:
    """All records from `offset` to the footer; `UNREADABLE` for a stretch that holds none.

    `BagError`: there are more than any honest file has.
    """
    size, begin = len(data), _CHUNK_BEGIN
    for _ in range(limits.MAX_RECORDS):
        if offset >= size:
            return
        check_whole(data)
        record = _record_at(data, offset) or Record(UNREADABLE, offset, offset, _next_record(data, offset + 1, begin))
        begin = _ANY_BEGIN if record.opcode == Opcode.MESSAGE else begin
        yield record
        if record.opcode == Opcode.FOOTER:
            return
        offset = record.end
    raise BagError(f"holds more than {limits.MAX_RECORDS} records")


def check_whole(data: Bytes) -> None:
    """`BagError` if a mapped file has become shorter: to look at what is gone ends the process."""
    if isinstance(data, mmap.mmap) and data.size() < len(data):
        raise BagError("was cut off while it was read")


def _record_at(data: Bytes, offset: int) -> Record | None:
    """The record that begins here; None if its length fits neither the file nor its own content."""
    body = offset + HEAD_BYTES
    if body > len(data):
        return None
    opcode, length = _HEAD.unpack_from(data, offset)
    if not (0 < opcode <= Opcode.DATA_END or opcode >= FIRST_PRIVATE) or length > len(data) - body:
        return None
    record = Record(opcode, offset, body, body + length)
    try:
        if opcode in _KINDS:
            return record._replace(content=_read(_KINDS[opcode], data, record))
        return record if _stated_length(data, opcode, body, length) == length else None
    except (BagError, struct.error):
        return None


def _stated_length(data: Bytes, opcode: int, body: int, length: int) -> int:
    """How long a record is by the lengths that stand in it."""
    if opcode == Opcode.CHUNK:
        packed_at = _NAME_AT + _U32.size + _U32.unpack_from(data, body + _NAME_AT)[0]
        return packed_at + _U64.size + int(_U64.unpack_from(data, body + packed_at)[0])
    if opcode == Opcode.MESSAGE_INDEX:
        return _ENTRIES_AT + int(_U32.unpack_from(data, body + 2)[0])
    if opcode == Opcode.FOOTER:  # nothing but the magic follows
        return _FOOTER_BYTES if body + _FOOTER_BYTES + len(MAGIC) >= len(data) else 0
    return max(length, _MESSAGE_FIELDS_BYTES) if opcode == Opcode.MESSAGE else length


def _goes_back(index: bytes) -> bool:
    """Whether a message index shows that the clock was set back between two messages of its channel."""
    entries = list(_ENTRY.iter_unpack(index[: len(index) // _ENTRY.size * _ENTRY.size]))
    if entries == sorted(entries):  # as nearly always
        return False
    times = [time_ns for time_ns, _ in sorted(entries, key=itemgetter(1))]
    newest = accumulate(times, max)
    return any(later < before - limits.SET_BACK_NS for before, later in zip(newest, times[1:], strict=False))


def _next_record(data: Bytes, offset: int, begin: re.Pattern[bytes]) -> int:
    """Where the next chunk, or message that a record follows, begins whose lengths agree; the file's end for none."""
    starts = (found.start() for found in begin.finditer(data, offset))
    return next((start for start in starts if _is_begin(data, start)), len(data))


def _is_begin(data: Bytes, start: int) -> bool:
    record = _record_at(data, start)
    if record is None or record.opcode != Opcode.MESSAGE:
        return record is not None
    return data[record.end : record.end + 1] in _FOLLOWING and _record_at(data, record.end) is not None


class Definitions:
    """Schemas and channels by their numbers, as they are met; `note` is told what is wrong with them."""

    def __init__(self, note: Callable[[str], object] = str) -> None:
        self.note = note
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}

    def take(self, found: Schema | Channel) -> None:
        """Add one; the first of a number counts. `BagError` if there are too many."""
        known: dict[int, Any] = self.schemas if isinstance(found, Schema) else self.channels
        if len(known) >= limits.MAX_CHANNELS and found.id not in known:
            raise BagError(f"holds more than {limits.MAX_CHANNELS} channels")
        if known.setdefault(found.id, found) != found:
            self.note(f"announces {type(found).__name__.lower()} {found.id} in more than one way: the first counts")


def _read(kind: Any, data: Bytes, record: Record) -> Any:
    """A record as the `mcap` package reads it; `BagError` if its content is none, or has another length."""
    stream = ReadDataStream(BytesIO(data[record.body : record.end]))
    try:
        found = kind.read(stream)
    except Exception:  # noqa: BLE001 - the package lets through whatever damaged bytes make it raise
        found = None
    if found is None or stream.count != record.end - record.body:
        raise BagError(f"holds a damaged {kind.__name__.lower()} record")
    return found


def split(raw: bytes, definitions: Definitions) -> list[ChannelMessage]:
    """The messages of an uncompressed chunk, as far as its records make sense; what it announces is added.

    What is left out is told to the definitions' `note`.
    """
    messages: list[ChannelMessage] = []
    append, unpack = messages.append, _MESSAGE.unpack_from
    offset, size = 0, len(raw)
    message = int(Opcode.MESSAGE)
    while offset + HEAD_BYTES <= size and len(messages) <= limits.MAX_CHUNK_MESSAGES:
        if raw[offset] == message and offset + RECORD_OVERHEAD_BYTES <= size:
            _, length, channel, sequence, log_time, publish_time = unpack(raw, offset)
            end = offset + HEAD_BYTES + length
            if end > size or length < _MESSAGE_FIELDS_BYTES:
                break
            append((log_time, channel, raw[offset + RECORD_OVERHEAD_BYTES : end], publish_time, sequence))
        else:
            opcode, length = _HEAD.unpack_from(raw, offset)
            end = offset + HEAD_BYTES + length
            if end > size or opcode == UNREADABLE:
                break
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                definitions.take(_read(_KINDS[opcode], raw, Record(opcode, offset, offset + HEAD_BYTES, end)))
            else:
                definitions.note(f"{LEFT_OUT}: records in a chunk that belong outside of it, as one of kind {opcode}")
        offset = end
    if offset < size:
        definitions.note(f"{LEFT_OUT}: {size - offset} bytes at the end of a chunk that are no record")
    if len(messages) > limits.MAX_CHUNK_MESSAGES:
        raise BagError(f"holds more than {limits.MAX_CHUNK_MESSAGES} messages")
    return messages


class Piece(NamedTuple):
    """Messages that are read at once, as a chunk is: their first and last log time, ns, and where they are."""

    start_ns: int
    end_ns: int
    source: Source
    place: Any


class Source:
    """One data file of a bag.

    Attributes
    ----------
    path : the file
    damage : what is wrong with the file, a line each; grows while messages are read
    topics, counts : topic and number of messages by channel, as far as they can be read
    pieces : all messages, in the order of the file
    custom_data : custom metadata inside of the file, our own recorder's or rosbag2's
    goes_back : log times of a channel go back within a piece, as a clock that is set back makes them
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage: list[str] = []
        self.topics: dict[int, Topic] = {}
        self.counts: Counter[int] = Counter()
        self.pieces: list[Piece] = []
        self.header = Header(profile="ros2", library="")
        self.custom_data: dict[str, str] = {}
        self.goes_back = False
        self._newest_ns: dict[int, int] = {}

    def _follow(self, channel: int, log_time_ns: int) -> None:
        """See whether this message, the next of its channel, was recorded with the clock set back."""
        newest_ns = self._newest_ns.setdefault(channel, log_time_ns)
        self.goes_back |= log_time_ns < newest_ns - limits.SET_BACK_NS
        self._newest_ns[channel] = max(newest_ns, log_time_ns)

    def unpack(self, piece: Piece) -> list[ChannelMessage]:
        """Messages of a piece in the order of the file, as far as they can be read; a line of damage for others."""
        raise NotImplementedError

    def messages(self) -> Iterator[ChannelMessage]:
        """All messages in the order of the file."""
        for piece in self.pieces:
            yield from self.unpack(piece)

    def note(self, line: str) -> None:
        """Add a line to the damage, if there is room for another."""
        line = line if len(self.damage) < limits.MAX_NOTES else "is damaged at more places"
        if line not in self.damage:
            self.damage.append(line)


class McapSource(Source):
    """An MCAP file, opened and surveyed; each piece is a chunk, or a stretch of messages outside of chunks.

    Parameters
    ----------
    path : the file
    stack : closes it

    Attributes
    ----------
    definitions : schemas and channels
    metadata : contents of metadata records, by name
    information : what rosbag2 keeps inside of the file of its `metadata.yaml`; {} if that is nothing or unreadable

    Raises
    ------
    BagError
        The file cannot be opened, is no MCAP file at all, or asks for more than `bags.limits` allow.
    """

    def __init__(self, path: Path, stack: ExitStack) -> None:
        super().__init__(path)
        self.definitions = Definitions(self.note)
        self.metadata: dict[str, dict[str, str]] = {}
        self._too_much_at = _NEVER  # byte from which on chunks are not unpacked
        if limits.regular_file(path) == 0:
            raise BagError(f"{path}: is empty")
        with system_errors(path, "cannot be read"), path.open("rb") as stream:
            self.data: Any = stack.enter_context(mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ))
        begins = self.data[: len(MAGIC)] == MAGIC
        statistics = self._survey()
        if not (begins or self.pieces):
            raise BagError(f"{path}: is no MCAP file")
        self.information = information_of(self.metadata.get("rosbag2", {}).get("serialized_metadata", ""))
        own = self.metadata.get(CUSTOM_METADATA, {})
        self.custom_data = text_values(self.information.get("custom_data")) | own
        self._count(statistics)
        for number, channel in self.definitions.channels.items():
            schema = self.definitions.schemas.get(channel.schema_id) or Schema(id=0, data=b"", encoding="", name="")
            self.topics[number] = Topic(
                channel.topic,
                schema.name,
                schema.data.decode("utf-8", "surrogateescape"),
                channel.metadata.get("topic_type_hash", ""),
                parse_qos(channel.metadata.get("offered_qos_profiles", "")),
                schema.encoding,
                channel.message_encoding,
            )

    def _survey(self) -> Statistics | None:
        """Go through all records; returns the summary's statistics, if the file was finished."""
        statistics: Statistics | None = None
        record, unpacked = None, 0
        for record in self.records():
            found = record.content
            if record.opcode == Opcode.CHUNK:
                start_ns, end_ns, size = _CHUNK_HEAD.unpack_from(self.data, record.body)
                self.pieces.append(Piece(start_ns, end_ns, self, record))
                unpacked += size if size <= limits.MAX_CHUNK_BYTES else 0  # more is refused by itself
                if unpacked > limits.MAX_CHUNK_BYTES + limits.MAX_RATIO * len(self.data):
                    self._too_much_at = min(self._too_much_at, record.start)
            elif record.opcode == Opcode.MESSAGE:
                self._add_to_run(record)
            elif record.opcode == Opcode.MESSAGE_INDEX:
                self.goes_back |= _goes_back(self.data[record.body + _ENTRIES_AT : record.end])
            elif record.opcode == UNREADABLE and record.end < len(self.data):
                self.note(f"holds no record from byte {record.start} to {record.end}")
                statistics = None
            elif isinstance(found, Metadata):
                self.metadata.setdefault(found.name, {}).update(found.metadata)
            elif isinstance(found, Statistics):
                statistics = found
            elif isinstance(found, Header):
                self.header = found
            elif isinstance(found, Schema | Channel):
                try:
                    self.definitions.take(found)
                except BagError as error:
                    self.note(f"{error} at byte {record.start}")
        if self.data[: len(MAGIC)] != MAGIC:
            self.note("does not begin as an MCAP file")
        if record is None or record.opcode != Opcode.FOOTER or self.data[record.end :] != MAGIC:
            self.note("ends without a footer: the recorder did not finish it")
            return None
        start, _, crc = struct.unpack_from("<QQI", self.data, record.body)
        if crc and (not start or zlib.crc32(self.data[start : record.end - 4]) != crc):
            self.note("its summary is damaged")
            return None
        return None if self.damage else statistics

    def records(self) -> Iterator[Record]:
        """All records; `BagError` if there are too many, or the file has become shorter."""
        try:
            yield from walk(self.data)
        except BagError as error:
            raise BagError(f"{self.path}: {error}") from None

    def _add_to_run(self, record: Record) -> None:
        """A message outside of chunks: the run it belongs to is read in one piece, like a chunk."""
        _, _, channel, _, log_time, _ = _MESSAGE.unpack_from(self.data, record.start)
        self._follow(channel, log_time)
        start_ns = end_ns = log_time
        last = self.pieces[-1].place if self.pieces else None
        if last and last.opcode == Opcode.MESSAGE and last.end == record.start and last.end - last.start < _RUN_BYTES:
            start_ns, end_ns, *_ = self.pieces.pop()
            record = last._replace(end=record.end)
        self.pieces.append(Piece(min(start_ns, log_time), max(end_ns, log_time), self, record))

    def _count(self, statistics: Statistics | None) -> None:
        """Take the summary's word, if all it counts is defined outside of chunks; else look into every chunk.

        Channels may be announced there and nowhere else, and its head may be wrong.
        """
        channels, counts = self.definitions.channels, statistics.channel_message_counts if statistics else {}
        schemas = {channel.schema_id for channel in channels.values()} - {0}
        if statistics and channels and channels.keys() >= counts.keys() and self.definitions.schemas.keys() >= schemas:
            self.counts.update(counts)
            return
        pieces, self.pieces = self.pieces, []
        for piece in pieces:
            messages = self.unpack(piece)
            self.counts.update(message[1] for message in messages)
            if messages:
                times = [message[0] for message in messages]
                self.pieces.append(piece._replace(start_ns=min(times), end_ns=max(times)))

    def unpack(self, piece: Piece) -> list[ChannelMessage]:
        """Messages of a chunk; none if it is damaged, or too large."""
        record: Record = piece.place
        try:
            check_whole(self.data)
            return split(
                self.raw(record) if record.opcode == Opcode.CHUNK else self.data[record.start : record.end],
                self.definitions,
            )
        except BagError as error:
            self.note(f"the chunk at byte {record.start} {error}")
            return []

    def raw(self, record: Record) -> bytes:
        """Content of a chunk; `BagError` if it is damaged or too large."""
        if record.start >= self._too_much_at:
            raise BagError(f"is left out: those before it hold {limits.MAX_RATIO} times what the file has")
        chunk: Chunk = _read(Chunk, self.data, record)
        size = chunk.uncompressed_size if chunk.compression else len(chunk.data)
        raw = limits.decompress(chunk.compression, chunk.data, size)
        if chunk.uncompressed_crc and zlib.crc32(raw) != chunk.uncompressed_crc:
            raise BagError("is damaged: its checksum is wrong")
        return raw
