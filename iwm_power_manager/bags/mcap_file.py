# SPDX-License-Identifier: Apache-2.0
"""One MCAP file being written by the `mcap` package, so that whatever happens to it, it ends with a whole record.

The package's writer hands its bytes to this file, and they go to the disk by unbuffered writes. So a chunk is in the
file when it is closed, which is what makes a killed recorder's bag recoverable, and a write that the disk refuses is
cut off again. After that the package's writer is of no use: it has taken up what is not in the file. What is there
stays readable without an index, and `recover` gives it one.

rosbags' writer ends a chunk by its size alone, writes neither publish times nor sequence numbers, and one file
(`McapWriter` in https://gitlab.com/ternaris/rosbags/-/blob/master/src/rosbags/rosbag2/storage_mcap.py).
"""

from __future__ import annotations

import errno
import os
import struct
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from functools import cache, partial
from itertools import chain
from pathlib import Path
from typing import IO, Any, cast

import mcap
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Message, MessageIndex
from mcap.writer import CompressionType, Writer

from iwm_power_manager.bags.mcap_source import walk
from iwm_power_manager.bags.metadata import FileSpan

COMPRESSIONS = ("none", "lz4", "zstd")
_SPAN = struct.Struct("<QQ")
_INDEX = struct.Struct("<HI")
_INDEX_ENTRY_BYTES = 16
#: Whose chunk is known inside: others do it themselves, slower.
_PACKED_BY_US = "1.6.0"
_MESSAGE_HEAD = struct.Struct("<BQHIQQ")
_MESSAGE_FIELDS_BYTES = 22
_INDEX_HEAD = struct.Struct("<BQHI")


class _Index(MessageIndex):
    """The package's, which writes its entries at once instead of number by number."""

    def write(self, stream: RecordBuilder) -> None:
        """Append the record."""
        entries = struct.pack(f"<{2 * len(self.records)}Q", *chain.from_iterable(self.records))
        stream.write(_INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, _INDEX.size + len(entries), self.channel_id, len(entries)))
        stream.write(entries)


def _add_message(chunk: Any, message: Message) -> None:
    """As the package's chunk does, with the numbers packed at once: the same bytes in two thirds of the time."""
    time_ns, channel, size = message.log_time, message.channel_id, _MESSAGE_FIELDS_BYTES + len(message.data)
    head = _MESSAGE_HEAD.pack(Opcode.MESSAGE, size, channel, message.sequence, time_ns, message.publish_time)
    chunk.message_start_time = min(time_ns, chunk.message_start_time) if chunk.num_messages else time_ns
    chunk.message_end_time = max(time_ns, chunk.message_end_time)
    chunk.num_messages += 1
    index = chunk.message_indices.get(channel)
    if index is None:
        index = chunk.message_indices[channel] = _Index(channel, [])
    index.records.append((time_ns, chunk.record_writer.count))
    chunk.record_writer.write(head)
    chunk.record_writer.write(message.data)


class McapFile:
    """A new MCAP file, opened for writing; chunks are closed when they are large enough, and by `flush`.

    Parameters
    ----------
    path : file to create; it must not exist
    library : who wrote it, for the header
    compression : "none", "lz4" or "zstd"
    chunk_bytes : uncompressed size beyond which a chunk is closed
    profile : whose conventions the file follows

    Attributes
    ----------
    writer : the package's, which takes messages, definitions and metadata
    schema_id : its `register_schema`, which gives the same id for the same schema
    stream : the file itself, unbuffered
    size_bytes : what is in the file so far
    counts, start_time_ns, end_time_ns : messages by channel, and their log times, in the file; 0 while there are none
    broken : a write has failed

    Raises
    ------
    OSError
        From whatever writes. What is in the file then ends with a whole record: a half-written one is cut off. Of the
        messages in memory nothing is left, what comes later is refused, and the file gets no index.
    """

    def __init__(
        self, path: Path, *, library: str, compression: str = "zstd", chunk_bytes: int = 786_432, profile: str = "ros2"
    ) -> None:
        self.path = path
        self.size_bytes = 0
        self.start_time_ns = 0
        self.end_time_ns = 0
        self.counts: Counter[int] = Counter()
        self.broken = False
        self._chunk = b""
        self.writer = Writer(
            cast("IO[bytes]", self), chunk_size=chunk_bytes, compression=CompressionType[compression.upper()]
        )
        if mcap.__version__ == _PACKED_BY_US:
            chunk = getattr(self.writer, "_Writer__chunk_builder")  # noqa: B009 - there is no public way in
            chunk.add_message = partial(_add_message, chunk)
        self.schema_id: Callable[[str, str, bytes], int] = cache(self.writer.register_schema)
        self.stream: IO[bytes] = open(path, "xb", buffering=0)  # noqa: SIM115 - closed by finish() or abandon()
        try:
            self.writer.start(profile, library)
        except OSError:
            self.abandon(remove=True)
            raise

    @property
    def span(self) -> FileSpan:
        """Name, log times and number of messages in the file."""
        return FileSpan(self.path.name, self.start_time_ns, self.end_time_ns, self.counts.total())

    def write(self, data: bytes) -> int:
        """Take whole records; a chunk waits for the index of its messages, which comes next."""
        if self.broken:
            raise OSError(errno.EIO, "an earlier write has failed")
        try:
            if self.size_bytes and os.fstat(self.stream.fileno()).st_nlink == 0:
                raise FileNotFoundError(errno.ENOENT, "the file was removed while it was being written")
            if data[:1] == bytes([Opcode.CHUNK]):
                self._chunk = data
            elif data:
                records, self._chunk = self._chunk + data, b""
                self.append(records)
                self._count(records)
        except OSError:
            self.broken = True
            raise
        return len(data)

    def tell(self) -> int:
        """Where the next record begins."""
        return self.size_bytes + len(self._chunk)

    def flush(self) -> None:
        """Nothing waits here; `writer.flush` closes the chunk in memory."""

    def finish(self, sync: bool = True) -> None:
        """Write the last chunk and the index, with `sync` wait until the disk has them, and close the file."""
        try:
            self.writer.finish()
            if sync:
                os.fsync(self.stream.fileno())
        finally:
            self.stream.close()

    def abandon(self, remove: bool = False) -> None:
        """Close the file as it is, and delete it or not; what is in it can be recovered."""
        self.stream.close()
        if remove:
            self.path.unlink(missing_ok=True)

    def append(self, data: bytes) -> None:
        """Write bytes behind those that are in the file, all or none of them."""
        view = memoryview(data)
        try:
            while view:
                written = self.stream.write(view)
                view = view[written or 0 :]
        except OSError:
            with suppress(OSError):  # a reader that goes as far as it can stops at the torn record
                self.stream.truncate(self.size_bytes)
                self.stream.seek(self.size_bytes)
            raise
        self.size_bytes += len(data)

    def _count(self, records: bytes) -> None:
        for record in walk(records, 0):
            if record.opcode == Opcode.CHUNK:
                start_ns, end_ns = _SPAN.unpack_from(records, record.body)
                self.start_time_ns = min(self.start_time_ns, start_ns) if self.counts else start_ns
                self.end_time_ns = max(self.end_time_ns, end_ns)
            elif record.opcode == Opcode.MESSAGE_INDEX:
                channel, entries_bytes = _INDEX.unpack_from(records, record.body)
                self.counts[channel] += entries_bytes // _INDEX_ENTRY_BYTES
