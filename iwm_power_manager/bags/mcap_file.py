# SPDX-License-Identifier: Apache-2.0
"""One MCAP file being written by the `mcap` package, so that whatever happens to it, it ends with a whole record.

The package's writer hands its bytes to a buffer, and from there they go into the file by unbuffered writes. So a chunk
is in the file when `push` returns, which is what makes a killed recorder's bag recoverable, and a write that the disk
refuses is cut off again. After that the package's writer is of no use: it has taken up what is not in the file. What is
there stays readable without an index, and `recover` gives it one.

rosbags' writer ends a chunk by its size alone, writes neither publish times nor sequence numbers, and one file
(`McapWriter` in https://gitlab.com/ternaris/rosbags/-/blob/master/src/rosbags/rosbag2/storage_mcap.py).
"""

from __future__ import annotations

import errno
import os
import struct
from collections import Counter
from pathlib import Path
from typing import IO, cast

from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer

from iwm_power_manager.bags.mcap_records import MAGIC, walk

COMPRESSIONS = ("none", "lz4", "zstd")
_SPAN = struct.Struct("<QQ")
_INDEX = struct.Struct("<HI")
_INDEX_ENTRY_BYTES = 16


class _Buffer:
    """What the package's writer takes for a file: collects bytes, and knows where in the file they will stand."""

    def __init__(self) -> None:
        self.pieces: list[bytes] = []
        self.offset = 0

    def write(self, data: bytes) -> int:
        self.pieces.append(data)
        self.offset += len(data)
        return len(data)

    def tell(self) -> int:
        return self.offset

    def flush(self) -> None:
        pass


class McapFile:
    """A new MCAP file, opened for writing.

    Parameters
    ----------
    path : file to create; it must not exist
    library : who wrote it, for the header
    compression : "none", "lz4" or "zstd"
    chunk_bytes : uncompressed size beyond which a chunk is closed
    profile : whose conventions the file follows

    Attributes
    ----------
    writer : the package's; after whatever was done with it, `push` brings what it has written into the file
    pieces : what it has written since then
    stream : the file itself, unbuffered
    size_bytes : what is in the file so far
    counts, start_time_ns, end_time_ns : messages by channel, and their log times, in the file; 0 while there are none
    broken : a write has failed

    Raises
    ------
    OSError
        From any method that writes. What is in the file then ends with a whole record: a half-written one is cut off.
        Of the messages in memory nothing is left, what comes later is refused, and the file gets no index.
    """

    def __init__(
        self,
        path: Path,
        *,
        library: str,
        compression: str = "zstd",
        chunk_bytes: int = 786_432,
        profile: str = "ros2",
    ) -> None:
        self.path = path
        self.size_bytes = 0
        self.start_time_ns = 0
        self.end_time_ns = 0
        self.counts: Counter[int] = Counter()
        self.broken = False
        self._schema_ids: dict[tuple[str, str, bytes], int] = {}
        self._buffer = _Buffer()
        self.pieces = self._buffer.pieces
        # Chunks are closed by the writer when they are large enough, and by whoever calls `flush`, in time.
        self.writer = Writer(
            cast("IO[bytes]", self._buffer), chunk_size=chunk_bytes, compression=CompressionType[compression.upper()]
        )
        self.stream: IO[bytes] = open(path, "xb", buffering=0)  # noqa: SIM115 - closed by finish() or abandon()
        self.writer.start(profile, library)
        try:
            self.push()
        except OSError:
            self.remove()
            raise

    @property
    def message_count(self) -> int:
        """Messages in the file."""
        return self.counts.total()

    def schema_id(self, name: str, encoding: str, data: bytes) -> int:
        """Id of a schema, the same for the same schema."""
        key = (name, encoding, data)
        if key not in self._schema_ids:
            self._schema_ids[key] = self.writer.register_schema(name, encoding, data)
        return self._schema_ids[key]

    def push(self) -> None:
        """Bring what the writer has written into the file, and count it."""
        if self.broken:
            raise OSError(errno.EIO, "an earlier write has failed")
        data = b"".join(self.pieces)
        self.pieces.clear()
        try:
            if self.size_bytes and os.fstat(self.stream.fileno()).st_nlink == 0:
                raise FileNotFoundError(errno.ENOENT, "the file was removed while it was being written")
            self.append(data)
        except OSError:
            self.broken = True
            raise
        for record in walk(data, 0 if self.size_bytes > len(data) else len(MAGIC)):
            if record.opcode == Opcode.CHUNK:
                start_ns, end_ns = _SPAN.unpack_from(data, record.body)
                self.start_time_ns = min(self.start_time_ns, start_ns) if self.counts else start_ns
                self.end_time_ns = max(self.end_time_ns, end_ns)
            elif record.opcode == Opcode.MESSAGE_INDEX:
                channel, entries_bytes = _INDEX.unpack_from(data, record.body)
                self.counts[channel] += entries_bytes // _INDEX_ENTRY_BYTES

    def add_record(self, record: bytes) -> None:
        """Write a record as it is, behind those before it; for kinds that are not in the index."""
        self._buffer.write(record)
        self.push()

    def flush(self) -> None:
        """Write the chunk in memory, if it holds a message."""
        self.writer.flush()
        self.push()

    def finish(self, sync: bool = True) -> None:
        """Write the last chunk and the index, with `sync` wait until the disk has them, and close the file."""
        try:
            self.flush()
            self.writer.finish()
            self.push()
            if sync:
                os.fsync(self.stream.fileno())
        finally:
            self.stream.close()

    def abandon(self) -> None:
        """Close the file as it is; what is in it can be recovered."""
        self.stream.close()

    def remove(self) -> None:
        """Close the file and delete it."""
        self.stream.close()
        self.path.unlink(missing_ok=True)

    def append(self, data: bytes) -> None:
        """Write bytes behind those that are in the file, all or none of them."""
        view = memoryview(data)
        try:
            while view:
                written = self.stream.write(view)
                view = view[written or 0 :]
        except OSError:
            self._cut()
            raise
        self.size_bytes += len(data)

    def _cut(self) -> None:
        try:
            self.stream.truncate(self.size_bytes)
            self.stream.seek(self.size_bytes)
        except OSError:
            pass  # a reader that goes as far as it can stops at the torn record
