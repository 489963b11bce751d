"""One MCAP file being written: chunks, indexes and summary as the MCAP 1.0 specification asks for them.

Only what a recorder needs, and nothing per message but two appends: schemas and channels go straight into the data
section (so that they survive whatever happens to a chunk), messages into a chunk in memory, and a finished chunk
together with its indexes into the file by a single unbuffered `write`. After every `flush` the file can be read by a
streaming reader up to its last byte, which is what makes a killed recorder's bag recoverable.
"""

from __future__ import annotations

import errno
import os
import struct
import zlib
from array import array
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO

MAGIC = b"\x89MCAP0\r\n"
PROFILE = "ros2"
COMPRESSIONS = ("none", "lz4", "zstd")

(
    HEADER,
    FOOTER,
    SCHEMA,
    CHANNEL,
    MESSAGE,
    CHUNK,
    MESSAGE_INDEX,
    CHUNK_INDEX,
    _ATTACHMENT,
    _ATTACHMENT_INDEX,
    STATISTICS,
    METADATA,
    METADATA_INDEX,
    SUMMARY_OFFSET,
    DATA_END,
) = range(1, 16)

_U16 = struct.Struct("<H")
_U32 = struct.Struct("<I")
_MESSAGE_HEAD = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_MESSAGE_FIELDS_BYTES = 22
MESSAGE_OVERHEAD_BYTES = _MESSAGE_HEAD.size


def _text(value: str) -> bytes:
    encoded = value.encode()
    return _U32.pack(len(encoded)) + encoded


def _text_map(values: Mapping[str, str]) -> bytes:
    body = b"".join(_text(key) + _text(value) for key, value in values.items())
    return _U32.pack(len(body)) + body


def _record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def compressor(compression: str, level: int = 1) -> Callable[[bytes], bytes]:
    """Function that compresses one chunk; imports a codec only when it is asked for."""
    if compression == "zstd":
        import zstandard

        return zstandard.ZstdCompressor(level=level).compress
    if compression == "lz4":
        import lz4.frame

        return lambda data: lz4.frame.compress(data, compression_level=0)
    return lambda data: data


class McapFile:
    """A new MCAP file, opened for writing.

    Parameters
    ----------
    path : file to create; it must not exist
    library : who wrote it, for the header
    compression : "none", "lz4" or "zstd"
    chunk_bytes : uncompressed size at which a chunk is closed

    Attributes
    ----------
    size_bytes : what is in the file so far
    message_count, start_time_ns, end_time_ns : of the messages in closed chunks; times are 0 while there are none

    Raises
    ------
    OSError
        From any writing method. Whatever is in the file then ends with a whole record: a half-written one is cut off.
    """

    def __init__(self, path: Path, *, library: str, compression: str = "zstd", chunk_bytes: int = 786_432) -> None:
        self.path = path
        self.size_bytes = 0
        self.message_count = 0
        self.start_time_ns = 0
        self.end_time_ns = 0
        self.channel_counts: dict[int, int] = {}
        self._compression = "" if compression == "none" else compression
        self._compress = compressor(compression)
        self._chunk_bytes = chunk_bytes
        self._chunk = bytearray()
        self._index: dict[int, array[int]] = {}
        self._schemas: list[bytes] = []
        self._schema_ids: dict[str, int] = {}
        self._channels: list[bytes] = []
        self._chunk_indexes: list[bytes] = []
        self._metadata_indexes: list[bytes] = []
        self._stream: IO[bytes] = open(path, "xb", buffering=0)  # noqa: SIM115 - closed by finish() or abandon()
        try:
            self._append(MAGIC + _record(HEADER, _text(PROFILE) + _text(library)))
        except OSError:
            self.remove()
            raise

    @property
    def pending_bytes(self) -> int:
        """Bytes of messages that are in memory only."""
        return len(self._chunk)

    @property
    def pending_count(self) -> int:
        """Messages that are in memory only."""
        return sum(len(index) for index in self._index.values()) // 2

    def schema_id(self, name: str, encoding: str, text: str) -> int:
        """Id of a schema; its record is written at the first call with this name. Id 0 means there is no schema."""
        if not encoding:
            return 0
        if name in self._schema_ids:
            return self._schema_ids[name]
        schema_id = len(self._schemas) + 1
        record = _record(SCHEMA, _U16.pack(schema_id) + _text(name) + _text(encoding) + _text(text))
        self._append(record)
        self._schemas.append(record)
        self._schema_ids[name] = schema_id
        return schema_id

    def add_channel(self, topic: str, schema_id: int, metadata: Mapping[str, str], encoding: str = "cdr") -> int:
        """Write a channel record; returns its id."""
        channel_id = len(self._channels) + 1
        body = struct.pack("<HH", channel_id, schema_id) + _text(topic) + _text(encoding) + _text_map(metadata)
        record = _record(CHANNEL, body)
        self._append(record)
        self._channels.append(record)
        self._index[channel_id] = array("Q")
        self.channel_counts[channel_id] = 0
        return channel_id

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a metadata record now, outside of any chunk."""
        record = _record(METADATA, _text(name) + _text_map(values))
        offset = self.size_bytes
        self._append(record)
        self._metadata_indexes.append(_record(METADATA_INDEX, struct.pack("<QQ", offset, len(record)) + _text(name)))

    def write(self, channel: int, log_time_ns: int, publish_time_ns: int, sequence: int, data: bytes) -> None:
        """Add a message to the chunk in memory; all numbers >= 0."""
        chunk = self._chunk
        head = _MESSAGE_HEAD.pack(
            MESSAGE, _MESSAGE_FIELDS_BYTES + len(data), channel, sequence, log_time_ns, publish_time_ns
        )
        self._index[channel].extend((log_time_ns, len(chunk)))
        chunk += head
        chunk += data
        if len(chunk) >= self._chunk_bytes:
            self.flush()

    def flush(self, sync: bool = False) -> None:
        """Write the chunk in memory, if it holds a message; with `sync` wait until the disk has it."""
        if self._chunk:
            self._write_chunk()
            if os.fstat(self._stream.fileno()).st_nlink == 0:
                raise FileNotFoundError(errno.ENOENT, "the file was removed while it was being written")
        if sync:
            os.fdatasync(self._stream.fileno())

    def duplicate_descriptor(self) -> int:
        """A descriptor of the open file that stays valid when this one is closed."""
        return os.dup(self._stream.fileno())

    def _write_chunk(self) -> None:
        raw = bytes(self._chunk)
        used = {channel: index for channel, index in self._index.items() if index}
        start = min(min(index[::2]) for index in used.values())
        end = max(max(index[::2]) for index in used.values())
        packed = self._compress(raw)
        times = struct.pack("<QQ", start, end)
        sizes = struct.pack("<QI", len(raw), zlib.crc32(raw))
        name = _text(self._compression)
        body_bytes = len(times) + len(sizes) + len(name) + 8 + len(packed)
        chunk_record_bytes = 9 + body_bytes
        parts = [
            struct.pack("<BQ", CHUNK, body_bytes),
            times,
            sizes,
            name,
            struct.pack("<Q", len(packed)),
            packed,
        ]
        offsets = []
        chunk_offset = self.size_bytes
        index_offset = chunk_offset + chunk_record_bytes
        index_bytes = 0
        for channel, index in used.items():
            entries = index.tobytes()
            offsets.append(struct.pack("<HQ", channel, index_offset + index_bytes))
            record = _record(MESSAGE_INDEX, struct.pack("<HI", channel, len(entries)) + entries)
            index_bytes += len(record)
            parts.append(record)
        offset_map = b"".join(offsets)

        counts = {channel: len(index) // 2 for channel, index in used.items()}
        self._chunk = bytearray()
        for channel in used:
            self._index[channel] = array("Q")
        self._append(b"".join(parts))

        self._chunk_indexes.append(
            _record(
                CHUNK_INDEX,
                times
                + struct.pack("<QQ", chunk_offset, chunk_record_bytes)
                + _U32.pack(len(offset_map))
                + offset_map
                + struct.pack("<Q", index_bytes)
                + name
                + struct.pack("<QQ", len(packed), len(raw)),
            )
        )
        self.start_time_ns = min(self.start_time_ns, start) if self.message_count else start
        self.end_time_ns = max(self.end_time_ns, end)
        for channel, count in counts.items():
            self.channel_counts[channel] += count
            self.message_count += count

    def finish(self) -> None:
        """Write the last chunk and the summary, and close the file."""
        try:
            self.flush()
            self._append(self._end())
            os.fsync(self._stream.fileno())
        finally:
            self._stream.close()

    def abandon(self) -> None:
        """Close the file as it is; what is in it can be recovered."""
        self._stream.close()

    def remove(self) -> None:
        """Close the file and delete it."""
        self._stream.close()
        self.path.unlink(missing_ok=True)

    def _end(self) -> bytes:
        data_end = _record(DATA_END, _U32.pack(0))
        counts = b"".join(struct.pack("<HQ", channel, count) for channel, count in self.channel_counts.items() if count)
        statistics = _record(
            STATISTICS,
            struct.pack(
                "<QHIIIIQQ",
                self.message_count,
                len(self._schemas),
                len(self._channels),
                0,
                len(self._metadata_indexes),
                len(self._chunk_indexes),
                self.start_time_ns,
                self.end_time_ns,
            )
            + _U32.pack(len(counts))
            + counts,
        )
        groups = (
            (SCHEMA, self._schemas),
            (CHANNEL, self._channels),
            (STATISTICS, [statistics]),
            (CHUNK_INDEX, self._chunk_indexes),
            (METADATA_INDEX, self._metadata_indexes),
        )
        summary_start = self.size_bytes + len(data_end)
        summary = bytearray()
        summary_offsets = bytearray()
        for opcode, records in groups:
            if not records:
                continue
            start = summary_start + len(summary)
            group = b"".join(records)
            summary += group
            summary_offsets += _record(SUMMARY_OFFSET, struct.pack("<BQQ", opcode, start, len(group)))
        offset_start = summary_start + len(summary)
        summary += summary_offsets
        footer = struct.pack("<BQQQ", FOOTER, 20, summary_start, offset_start)
        crc = zlib.crc32(footer, zlib.crc32(summary))
        return data_end + bytes(summary) + footer + _U32.pack(crc) + MAGIC

    def _append(self, data: bytes) -> None:
        view = memoryview(data)
        try:
            while view:
                written = self._stream.write(view)
                view = view[written or 0 :]
        except OSError:
            self._cut()
            raise
        self.size_bytes += len(data)

    def _cut(self) -> None:
        try:
            self._stream.truncate(self.size_bytes)
            self._stream.seek(self.size_bytes)
        except OSError:
            pass  # a reader that goes as far as it can stops at the torn record
