# SPDX-License-Identifier: Apache-2.0
"""The records of an MCAP file one by one, damaged or not, as the MCAP 1.0 specification lays them out.

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
from collections.abc import Iterator
from io import BytesIO
from typing import Any, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, Metadata, Schema, Statistics

from iwm_power_manager.bags.limits import MAX_CHANNELS, MAX_CHUNK_MESSAGES, MAX_RECORDS
from iwm_power_manager.errors import BagError

MAGIC = b"\x89MCAP0\r\n"

_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_U32, _U64 = struct.Struct("<I"), struct.Struct("<Q")
HEAD_BYTES = _HEAD.size
MESSAGE_OVERHEAD_BYTES = _MESSAGE.size
_MESSAGE_FIELDS_BYTES = MESSAGE_OVERHEAD_BYTES - HEAD_BYTES
#: Where in a chunk the name of its compression begins, and in a message index its entries.
_NAME_AT, _ENTRIES_AT = 28, 6
_FOOTER_BYTES = 20

#: A chunk's record from its first byte to the name of its compression: what to look for behind a damaged stretch.
_CHUNK_BEGIN = re.compile(b"\x06.{5}\\0\\0\\0.{28}(?:\\0\\0\\0\\0|\x03\\0\\0\\0lz4|\x04\\0\\0\\0zstd)", re.DOTALL)

FIRST_PRIVATE = 0x80
#: Records outside of chunks that are read to see whether they are what they say.
KINDS: dict[int, Any] = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.METADATA: Metadata,
    Opcode.ATTACHMENT: Attachment,
    Opcode.STATISTICS: Statistics,
}

#: Opcode of what is no record.
UNREADABLE = 0

Bytes = bytes | mmap.mmap


class Record(NamedTuple):
    """Where a record is: its first byte, its content's, and the one behind it."""

    opcode: int
    start: int
    body: int
    end: int


#: A message: log time, channel's number, bytes, publish time, sequence.
ChannelMessage = tuple[int, int, bytes, int, int]


def walk(data: Bytes, offset: int = len(MAGIC)) -> Iterator[Record]:
    """All records from `offset` to the footer; `UNREADABLE` for a stretch that holds none.

    Raises
    ------
    BagError
        There are more than any honest file has.
    """
    size = len(data)
    for _ in range(MAX_RECORDS):
        if offset >= size:
            return
        record = _record_at(data, offset) or Record(UNREADABLE, offset, offset, _next_chunk(data, offset + 1))
        yield record
        if record.opcode == Opcode.FOOTER:
            return
        offset = record.end
    raise BagError(f"holds more than {MAX_RECORDS} records")


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
        if opcode in KINDS:
            read_record(KINDS[opcode], data, record)
            return record
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


def _next_chunk(data: Bytes, offset: int) -> int:
    """Where the next chunk begins whose lengths agree with each other; the end of the file if there is none."""
    starts = (found.start() for found in _CHUNK_BEGIN.finditer(data, offset))
    return next((start for start in starts if _record_at(data, start) is not None), len(data))


class Definitions:
    """Schemas and channels by their numbers, as they are met."""

    def __init__(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}

    def take(self, data: Bytes, record: Record) -> None:
        """Read a schema's or a channel's record; `BagError` if it cannot be."""
        if record.opcode not in (Opcode.SCHEMA, Opcode.CHANNEL):
            return
        known: dict[int, Any] = self.schemas if record.opcode == Opcode.SCHEMA else self.channels
        found = read_record(KINDS[record.opcode], data, record)
        known.setdefault(found.id, found)
        if len(known) > MAX_CHANNELS:
            raise BagError(f"holds more than {MAX_CHANNELS} channels")

    def schema_of(self, channel: Channel) -> Schema:
        """A channel's schema; an empty one where there is none."""
        return self.schemas.get(channel.schema_id) or Schema(id=0, data=b"", encoding="", name="")


def read_record(kind: Any, data: Bytes, record: Record) -> Any:
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
    """The messages of an uncompressed chunk, as far as its records make sense; what it announces is added."""
    messages: list[ChannelMessage] = []
    append, unpack = messages.append, _MESSAGE.unpack_from
    offset, size = 0, len(raw)
    message = int(Opcode.MESSAGE)
    while offset + HEAD_BYTES <= size and len(messages) <= MAX_CHUNK_MESSAGES:
        if raw[offset] == message and offset + MESSAGE_OVERHEAD_BYTES <= size:
            _, length, channel, sequence, log_time, publish_time = unpack(raw, offset)
            end = offset + HEAD_BYTES + length
            if end > size or length < _MESSAGE_FIELDS_BYTES:
                break
            append((log_time, channel, raw[offset + MESSAGE_OVERHEAD_BYTES : end], publish_time, sequence))
        else:
            opcode, length = _HEAD.unpack_from(raw, offset)
            end = offset + HEAD_BYTES + length
            if end > size or opcode == UNREADABLE:
                break
            definitions.take(raw, Record(opcode, offset, offset + HEAD_BYTES, end))
        offset = end
    if len(messages) > MAX_CHUNK_MESSAGES:
        raise BagError(f"holds more than {MAX_CHUNK_MESSAGES} messages")
    return messages
