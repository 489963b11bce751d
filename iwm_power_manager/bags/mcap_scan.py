"""Read an MCAP file as far as it goes, whether its recorder finished it or was killed.

The summary at the end of a file is a convenience; all it says stands in the data section, too. So the file is scanned
once, record by record, skipping over the content of chunks, which takes milliseconds; where the scan ends, by the end
of data or by the first record that makes no sense, is where the file ends. Chunks are read when their turn comes.
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple, Self

from iwm_power_manager.bags.mcap_file import (
    CHANNEL,
    CHUNK,
    DATA_END,
    FOOTER,
    HEADER,
    MAGIC,
    MESSAGE,
    METADATA,
    SCHEMA,
)
from iwm_power_manager.errors import BagError

_RECORD_HEAD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQI")
_MESSAGE_FIELDS = struct.Struct("<HIQQ")
_MESSAGE_RECORD = struct.Struct("<BQHIQQ")
_U16 = struct.Struct("<H")
_U32 = struct.Struct("<I")
_U64 = struct.Struct("<Q")

#: No honest record is larger; a damaged length field almost always is.
_LARGEST_OPCODE = 0x0F


class McapMessage(NamedTuple):
    """One message as it stands in the file."""

    log_time_ns: int
    channel_id: int
    data: bytes
    publish_time_ns: int
    sequence: int


class McapSchema(NamedTuple):
    """A schema record."""

    name: str
    encoding: str
    text: str


class McapChannel(NamedTuple):
    """A channel record, with its schema where there is one."""

    id: int
    topic: str
    encoding: str
    schema: McapSchema
    metadata: dict[str, str]


class _Piece(NamedTuple):
    """A chunk, or a single message outside of chunks: where it is and the log times it spans."""

    start_ns: int
    end_ns: int
    offset: int
    length: int
    is_chunk: bool


class McapScan:
    """An MCAP file, opened and scanned.

    Parameters
    ----------
    path : the file

    Attributes
    ----------
    channels : by id; complete after reading all messages, because a chunk may announce more
    metadata : metadata records, in order: (name, values)
    damage : what is wrong with the file, "" for a whole one; grows while messages are read
    lost_chunks : chunks whose content could not be read
    end_offset : where the readable part ends

    Raises
    ------
    BagError
        The file cannot be opened, or is no MCAP file at all.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.channels: dict[int, McapChannel] = {}
        self.metadata: list[tuple[str, dict[str, str]]] = []
        self.damage = ""
        self.lost_chunks = 0
        self._schemas: dict[int, McapSchema] = {}
        self._pieces: list[_Piece] = []
        self._decompress: dict[str, Callable[[bytes, int], bytes]] = {"": lambda data, _: data}
        try:
            with open(path, "rb") as stream:
                size = stream.seek(0, 2)
                self._map: mmap.mmap | bytes = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) if size else b""
        except OSError as error:
            raise BagError(f"{path}: cannot be read: {error.strerror or error}") from None
        if self._map[: len(MAGIC)] != MAGIC:
            self.close()
            raise BagError(f"{path}: is no MCAP file" if size else f"{path}: is empty")
        self.end_offset = len(MAGIC)
        self._scan()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the file."""
        if isinstance(self._map, mmap.mmap):
            self._map.close()

    @property
    def start_ns(self) -> int:
        """Earliest log time, 0 if there is no message."""
        return min((piece.start_ns for piece in self._pieces), default=0)

    @property
    def end_ns(self) -> int:
        """Latest log time, 0 if there is no message."""
        return max((piece.end_ns for piece in self._pieces), default=0)

    @property
    def size_bytes(self) -> int:
        """Size of the file."""
        return len(self._map)

    def read_definitions(self) -> None:
        """Read all chunks for the channels they announce: what a file without a readable summary demands."""
        for piece in self._pieces:
            self._read(piece)
        self.lost_chunks = 0

    def messages(self) -> Iterator[McapMessage]:
        """All messages in the order of their log times; equal times keep the order of the file.

        Memory: the chunks that overlap in time, usually one.
        """
        pieces = sorted(self._pieces, key=lambda piece: piece.start_ns)
        pending: list[McapMessage] = []
        for index, piece in enumerate(pieces):
            fresh = self._read(piece)
            if pending:
                pending += fresh
                pending.sort(key=_log_time)
            else:
                pending = sorted(fresh, key=_log_time)
            horizon = pieces[index + 1].start_ns if index + 1 < len(pieces) else None
            if horizon is None or not pending or pending[-1].log_time_ns < horizon:
                yield from pending
                pending = []
            else:
                ready = _count_before(pending, horizon)
                yield from pending[:ready]
                pending = pending[ready:]

    # --- the scan ---------------------------------------------------------------------------------------------------

    def _scan(self) -> None:
        data = self._map
        size = len(data)
        offset = self.end_offset
        while True:
            if offset + _RECORD_HEAD.size > size:
                self.damage = "ends without a footer: the recorder did not finish it"
                break
            opcode, length = _RECORD_HEAD.unpack_from(data, offset)
            body = offset + _RECORD_HEAD.size
            if not 0 < opcode <= _LARGEST_OPCODE and opcode < 0x80:
                self.damage = f"holds no record at byte {offset}"
                break
            if length > size - body:
                self.damage = f"ends inside a record at byte {offset}"
                break
            if opcode in (DATA_END, FOOTER):
                if data[size - len(MAGIC) : size] != MAGIC:
                    self.damage = "its end is missing or damaged"
                self.end_offset = offset
                self._read_summary(offset)
                break
            try:
                self._note(opcode, body, length)
            except (struct.error, UnicodeDecodeError, IndexError):
                self.damage = f"holds a damaged record at byte {offset}"
                break
            offset = body + length
            self.end_offset = offset

    def _read_summary(self, offset: int) -> None:
        """Schemas and channels repeated after the data: other writers announce them inside of chunks only."""
        data = self._map
        crc_offset = len(data) - len(MAGIC) - _U32.size
        try:
            summary_start, _, crc = struct.unpack_from("<QQI", data, crc_offset - 2 * _U64.size)
            if crc and zlib.crc32(data[summary_start:crc_offset]) != crc:
                self.damage = self.damage or "its summary is damaged"
                return
            while offset + _RECORD_HEAD.size <= len(data):
                opcode, length = _RECORD_HEAD.unpack_from(data, offset)
                body = offset + _RECORD_HEAD.size
                if opcode == FOOTER:
                    break
                if opcode in (SCHEMA, CHANNEL):
                    self._definition(opcode, data[body : body + length])
                offset = body + length
        except (struct.error, UnicodeDecodeError):
            self.damage = self.damage or "its summary is damaged"

    def _note(self, opcode: int, body: int, length: int) -> None:
        data = self._map
        if opcode == CHUNK:
            start, end, _, _ = _CHUNK_HEAD.unpack_from(data, body)
            self._pieces.append(_Piece(start, end, body, length, True))
        elif opcode == MESSAGE:
            _, _, log_time, _ = _MESSAGE_FIELDS.unpack_from(data, body)
            self._pieces.append(_Piece(log_time, log_time, body, length, False))
        elif opcode in (SCHEMA, CHANNEL, METADATA, HEADER):
            self._definition(opcode, data[body : body + length])

    def _definition(self, opcode: int, body: bytes) -> None:
        if opcode == SCHEMA:
            (number,) = _U16.unpack_from(body)
            name, offset = _text(body, 2)
            encoding, offset = _text(body, offset)
            text, _ = _text(body, offset)
            self._schemas[number] = McapSchema(name, encoding, text)
        elif opcode == CHANNEL:
            number, schema = struct.unpack_from("<HH", body)
            topic, offset = _text(body, 4)
            encoding, offset = _text(body, offset)
            self.channels[number] = McapChannel(
                number, topic, encoding, self._schemas.get(schema, McapSchema("", "", "")), _text_map(body, offset)
            )
        elif opcode == METADATA:
            name, offset = _text(body, 0)
            self.metadata.append((name, _text_map(body, offset)))

    # --- messages ---------------------------------------------------------------------------------------------------

    def _read(self, piece: _Piece) -> list[McapMessage]:
        if not piece.is_chunk:
            channel, sequence, log_time, publish_time = _MESSAGE_FIELDS.unpack_from(self._map, piece.offset)
            start = piece.offset + _MESSAGE_FIELDS.size
            return [
                McapMessage(log_time, channel, self._map[start : piece.offset + piece.length], publish_time, sequence)
            ]
        try:
            return self._parse(self._unpack(piece))
        except BagError as error:
            self.lost_chunks += 1
            self.damage = str(error)
            return []

    def _unpack(self, piece: _Piece) -> bytes:
        data = self._map
        where = f"the chunk at byte {piece.offset - _RECORD_HEAD.size}"
        try:
            _, _, size, crc = _CHUNK_HEAD.unpack_from(data, piece.offset)
            compression, offset = _text(data, piece.offset + _CHUNK_HEAD.size)
            (packed_size,) = _U64.unpack_from(data, offset)
            offset += _U64.size
            if offset + packed_size > piece.offset + piece.length:
                raise BagError(f"{where} is damaged")
            raw = self._decompressor(compression)(data[offset : offset + packed_size], size)
        except (struct.error, UnicodeDecodeError):
            raise BagError(f"{where} is damaged") from None
        if len(raw) != size or (crc and zlib.crc32(raw) != crc):
            raise BagError(f"{where} is damaged: its checksum is wrong")
        return raw

    def _decompressor(self, compression: str) -> Callable[[bytes, int], bytes]:
        if compression not in self._decompress:
            self._decompress[compression] = _decompressor(compression)
        return self._decompress[compression]

    def _parse(self, raw: bytes) -> list[McapMessage]:
        messages: list[McapMessage] = []
        append, unpack, head = messages.append, _MESSAGE_RECORD.unpack_from, _MESSAGE_RECORD.size
        offset, size = 0, len(raw)
        try:
            while offset < size:
                if raw[offset] == MESSAGE:
                    _, length, channel, sequence, log_time, publish_time = unpack(raw, offset)
                    end = offset + 9 + length
                    append(McapMessage(log_time, channel, raw[offset + head : end], publish_time, sequence))
                else:
                    opcode, length = _RECORD_HEAD.unpack_from(raw, offset)
                    body = offset + _RECORD_HEAD.size
                    end = body + length
                    self._definition(opcode, raw[body:end])
                offset = end
        except (struct.error, UnicodeDecodeError):
            self.damage = "a chunk ends inside a record"
        return messages


def _log_time(message: McapMessage) -> int:
    return message.log_time_ns


def _count_before(messages: list[McapMessage], horizon_ns: int) -> int:
    from bisect import bisect_left

    return bisect_left(messages, horizon_ns, key=_log_time)


def _decompressor(compression: str) -> Callable[[bytes, int], bytes]:
    if compression == "zstd":
        import zstandard

        context = zstandard.ZstdDecompressor()

        def unzstd(data: bytes, size: int) -> bytes:
            try:
                return context.decompress(data, max_output_size=size)
            except zstandard.ZstdError:
                raise BagError("a chunk cannot be decompressed") from None

        return unzstd
    if compression == "lz4":
        import lz4.frame

        def unlz4(data: bytes, _: int) -> bytes:
            try:
                return lz4.frame.decompress(data)
            except (RuntimeError, EOFError):
                raise BagError("a chunk cannot be decompressed") from None

        return unlz4
    raise BagError(f"a chunk is compressed with {compression!r}; known: zstd, lz4")


def _text(data: bytes | mmap.mmap, offset: int) -> tuple[str, int]:
    (length,) = _U32.unpack_from(data, offset)
    start = offset + _U32.size
    end = start + length
    if end > len(data):
        raise struct.error("text longer than its record")
    return data[start:end].decode(), end


def _text_map(data: bytes, offset: int) -> dict[str, str]:
    (length,) = _U32.unpack_from(data, offset)
    offset += _U32.size
    end = offset + length
    values = {}
    while offset < end:
        key, offset = _text(data, offset)
        values[key], offset = _text(data, offset)
    return values
