# SPDX-License-Identifier: Apache-2.0
"""The records of an MCAP file one by one, damaged or not, as the MCAP 1.0 specification lays them out.

What a record says is read by the `mcap` package (`mcap.records`). The way from one record to the next is our own,
because the package's `StreamReader` does not hold a record to its length: one damaged record takes all that follow with
it, and `breakup_chunk` loses a whole chunk with one record of it
(https://github.com/foxglove/mcap/blob/main/python/mcap/mcap/stream_reader.py). Messages are taken apart here, too:
it builds a dataclass for each, which costs more than the rest of reading.
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
from mcap.records import Attachment, Channel, Header, Metadata, Schema

from iwm_power_manager.bags.limits import MAX_CHANNELS, MAX_RECORDS
from iwm_power_manager.errors import BagError

MAGIC = b"\x89MCAP0\r\n"

_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_CHUNK = struct.Struct("<QQQI")
_INDEX = struct.Struct("<HI")
_U32, _U64 = struct.Struct("<I"), struct.Struct("<Q")
HEAD_BYTES = _HEAD.size
MESSAGE_OVERHEAD_BYTES = _MESSAGE.size
_MESSAGE_FIELDS_BYTES = MESSAGE_OVERHEAD_BYTES - HEAD_BYTES

#: A chunk's record from its first byte to the name of its compression: what to look for behind a damaged stretch.
_CHUNK_BEGIN = re.compile(b"\x06.{5}\\0\\0\\0.{28}(?:\\0\\0\\0\\0|\x03\\0\\0\\0lz4|\x04\\0\\0\\0zstd)", re.DOTALL)

_FIRST_PRIVATE = 0x80
#: Records outside of chunks that are read to see whether they are what they say.
_KINDS = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.METADATA: Metadata,
    Opcode.ATTACHMENT: Attachment,
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


class Chunk(NamedTuple):
    """A chunk's head: log times as stated, size and checksum uncompressed, compression, and where its data is."""

    start_ns: int
    end_ns: int
    size: int
    crc: int
    compression: str
    data: int
    end: int


class ChunkMessage(NamedTuple):
    """A message inside of a chunk; `offset` is where its record begins there."""

    log_time_ns: int
    channel_id: int
    data: bytes
    publish_time_ns: int
    sequence: int
    offset: int


def walk(data: Bytes, offset: int = len(MAGIC)) -> Iterator[Record]:
    """All records from `offset` to the end of the data section; `UNREADABLE` for a stretch that holds none.

    Raises
    ------
    BagError
        There are more than any honest file has.
    """
    size = len(data)
    for _ in range(MAX_RECORDS):
        if offset >= size:
            return
        record = _record_at(data, offset)
        if record is not None:
            yield record
            if record.opcode in (Opcode.DATA_END, Opcode.FOOTER):
                return
            offset = record.end
            continue
        end = _next_chunk(data, offset + 1)
        yield Record(UNREADABLE, offset, offset, end)
        offset = end
    raise BagError(f"holds more than {MAX_RECORDS} records")


def _record_at(data: Bytes, offset: int) -> Record | None:
    """The record that begins here; None if its length fits neither the file nor its own content."""
    body = offset + HEAD_BYTES
    if body > len(data):
        return None
    opcode, length = _HEAD.unpack_from(data, offset)
    if not (0 < opcode <= Opcode.DATA_END or opcode >= _FIRST_PRIVATE) or length > len(data) - body:
        return None
    end = body + length
    try:
        if opcode == Opcode.CHUNK:
            fits = chunk_head(data, body, end).end == end
        elif opcode == Opcode.MESSAGE:
            fits = length >= _MESSAGE_FIELDS_BYTES
        elif opcode == Opcode.MESSAGE_INDEX:
            fits = length >= _INDEX.size and length == _INDEX.size + _INDEX.unpack_from(data, body)[1]
        else:
            fits = True
            if opcode in _KINDS:
                read_record(_KINDS[opcode], bytes(data[body:end]))
    except BagError:
        return None
    return Record(opcode, offset, body, end) if fits else None


def _next_chunk(data: Bytes, offset: int) -> int:
    """Where the next chunk begins whose lengths agree with each other; the end of the file if there is none."""
    size = len(data)
    for found in _CHUNK_BEGIN.finditer(data, offset):
        start = found.start()
        (length,) = _U64.unpack_from(data, start + 1)
        name_bytes = found.end() - start - HEAD_BYTES - _CHUNK.size - _U32.size
        if found.end() + _U64.size > size or start + HEAD_BYTES + length > size:
            continue
        (packed,) = _U64.unpack_from(data, found.end())
        if length == _CHUNK.size + _U32.size + name_bytes + _U64.size + packed:
            return start
    return size


def chunk_head(data: Bytes, body: int, end: int) -> Chunk:
    """The head of the chunk at `body`; `BagError` if it is damaged. `end` may lie before the chunk's own."""
    try:
        start_ns, end_ns, size, crc = _CHUNK.unpack_from(data, body)
        (name_bytes,) = _U32.unpack_from(data, body + _CHUNK.size)
        at = body + _CHUNK.size + _U32.size
        if name_bytes > 16:
            raise BagError("is damaged")
        compression = bytes(data[at : at + name_bytes]).decode()
        (packed,) = _U64.unpack_from(data, at + name_bytes)
    except (struct.error, UnicodeDecodeError):
        raise BagError("is damaged") from None
    first = at + name_bytes + _U64.size
    if first > end:
        raise BagError("is damaged")
    return Chunk(start_ns, end_ns, size, crc, compression, first, first + packed)


class Definitions:
    """Schemas and channels by their numbers, as they are met."""

    def __init__(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}

    def take(self, opcode: int, body: bytes) -> None:
        """Read a schema's or a channel's record; `BagError` if it cannot be."""
        if opcode == Opcode.SCHEMA:
            schema = read_record(Schema, body)
            self.schemas.setdefault(schema.id, schema)
        elif opcode == Opcode.CHANNEL:
            channel = read_record(Channel, body)
            self.channels.setdefault(channel.id, channel)
        if len(self.channels) > MAX_CHANNELS:
            raise BagError(f"holds more than {MAX_CHANNELS} channels")

    def schema_of(self, channel: Channel) -> Schema:
        """A channel's schema; an empty one where there is none."""
        return self.schemas.get(channel.schema_id) or Schema(id=0, data=b"", encoding="", name="")


def read_record(kind: Any, body: bytes) -> Any:
    """A record of the `mcap` package from its content; `BagError` if the content is none."""
    stream = ReadDataStream(BytesIO(body))
    try:
        record = kind.read(stream)
    except Exception:  # noqa: BLE001 - the package lets through whatever damaged bytes make it raise
        record = None
    if record is None or stream.count != len(body):
        raise BagError(f"holds a damaged {kind.__name__.lower()} record")
    return record


def split(raw: bytes, definitions: Definitions) -> list[ChunkMessage]:
    """The messages of an uncompressed chunk, as far as its records make sense; what it announces is added."""
    messages: list[ChunkMessage] = []
    append, unpack = messages.append, _MESSAGE.unpack_from
    offset, size = 0, len(raw)
    message = int(Opcode.MESSAGE)
    while offset + HEAD_BYTES <= size:
        if raw[offset] == message and offset + MESSAGE_OVERHEAD_BYTES <= size:
            _, length, channel, sequence, log_time, publish_time = unpack(raw, offset)
            end = offset + HEAD_BYTES + length
            if end > size or length < _MESSAGE_FIELDS_BYTES:
                break
            append(
                ChunkMessage(
                    log_time, channel, raw[offset + MESSAGE_OVERHEAD_BYTES : end], publish_time, sequence, offset
                )
            )
        else:
            opcode, length = _HEAD.unpack_from(raw, offset)
            end = offset + HEAD_BYTES + length
            if end > size or opcode == UNREADABLE:
                break
            definitions.take(opcode, raw[offset + HEAD_BYTES : end])
        offset = end
    return messages
