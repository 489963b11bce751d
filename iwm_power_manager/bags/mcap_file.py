# SPDX-License-Identifier: Apache-2.0
"""One MCAP file being written by the `mcap` package, so that whatever happens to it, it ends with a whole record.

The package's writer hands its bytes to a buffer, and from there they go into the file by unbuffered writes. So a chunk
is in the file when `flush` returns, which is what makes a killed recorder's bag recoverable, and a write that the disk
refuses is cut off again. After that the package's writer is of no use: it has taken up what is not in the file. What is
there stays readable without an index, and `recover` gives it one.
"""

from __future__ import annotations

import errno
import os
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, cast

from mcap.records import Attachment
from mcap.writer import CompressionType, Writer

COMPRESSIONS = ("none", "lz4", "zstd")


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
    size_bytes : what is in the file so far
    message_count, channel_counts, start_time_ns, end_time_ns : of the messages in closed chunks; times are 0 while
        there are none
    pending_count : messages that are in memory only
    broken : a write has failed

    Raises
    ------
    OSError
        From any writing method. Whatever is in the file then ends with a whole record: a half-written one is cut off.
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
        self.message_count = 0
        self.start_time_ns = 0
        self.end_time_ns = 0
        self.channel_counts: dict[int, int] = {}
        self._pending: list[int] = []  # the messages' channels
        self._times: list[int] = []  # and log times
        self._schema_ids: dict[tuple[str, str, bytes], int] = {}
        self.broken = False
        self._buffer = _Buffer()
        self._pieces = self._buffer.pieces
        # Chunks are closed by the writer when they are large enough, and here by time.
        self._writer = Writer(
            cast("IO[bytes]", self._buffer), chunk_size=chunk_bytes, compression=CompressionType[compression.upper()]
        )
        self._add: Callable[..., None] = self._writer.add_message
        self._stream: IO[bytes] = open(path, "xb", buffering=0)  # noqa: SIM115 - closed by finish() or abandon()
        self._writer.start(profile, library)
        try:
            self._push()
        except OSError:
            self.remove()
            raise

    @property
    def pending_count(self) -> int:
        """Messages that are in memory only."""
        return len(self._pending)

    def schema_id(self, name: str, encoding: str, data: bytes) -> int:
        """Id of a schema, the same for the same schema."""
        key = (name, encoding, data)
        if key not in self._schema_ids:
            self._schema_ids[key] = self._writer.register_schema(name, encoding, data)
            if self._pieces:
                self._take_up()
        return self._schema_ids[key]

    def add_channel(self, topic: str, schema_id: int, metadata: Mapping[str, str], encoding: str = "cdr") -> int:
        """Announce a channel; returns its id. It is in the file with the first chunk that follows."""
        channel = self._writer.register_channel(topic, encoding, schema_id, dict(metadata))
        self.channel_counts[channel] = 0
        if self._pieces:  # that has closed a chunk
            self._take_up()
        return channel

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a metadata record now, outside of any chunk."""
        self._check()
        self._writer.add_metadata(name, dict(values))
        self._push()

    def add_attachment(self, attachment: Attachment) -> None:
        """Write an attachment now, outside of any chunk."""
        self._check()
        self._writer.add_attachment(
            attachment.create_time, attachment.log_time, attachment.name, attachment.media_type, attachment.data
        )
        self._push()

    def add_record(self, record: bytes) -> None:
        """Write a record as it is; for kinds that are not in the index."""
        self._check()
        self._buffer.write(record)
        self._push()

    def write(self, channel: int, log_time_ns: int, publish_time_ns: int, sequence: int, data: bytes) -> None:
        """Add a message to the chunk in memory; all numbers >= 0."""
        self._add(channel, log_time_ns, data, publish_time_ns, sequence)
        self._pending.append(channel)
        self._times.append(log_time_ns)
        if self._pieces:  # the writer has closed a chunk
            self._take_up()

    def flush(self, sync: bool = False) -> None:
        """Write the chunk in memory, if it holds a message; with `sync` wait until the disk has it."""
        if self._pending:
            self._writer.flush()
            self._take_up()
        if sync:
            os.fdatasync(self._stream.fileno())

    def _take_up(self) -> None:
        """Bring a closed chunk into the file, and count its messages."""
        pending, times = self._pending, self._times
        self._pending, self._times = [], []
        self._push()
        self.start_time_ns = min(times) if not self.message_count else min(self.start_time_ns, min(times))
        self.end_time_ns = max(self.end_time_ns, max(times))
        self.message_count += len(pending)
        for channel, count in Counter(pending).items():
            self.channel_counts[channel] += count
        if os.fstat(self._stream.fileno()).st_nlink == 0:
            raise FileNotFoundError(errno.ENOENT, "the file was removed while it was being written")

    def duplicate_descriptor(self) -> int:
        """A descriptor of the open file that stays valid when this one is closed."""
        return os.dup(self._stream.fileno())

    def finish(self) -> None:
        """Write the last chunk and the index, and close the file."""
        try:
            self.flush()
            self._check()
            self._writer.finish()
            self._push()
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

    def _check(self, *_: object) -> None:
        if self.broken:
            raise OSError(errno.EIO, "an earlier write has failed")

    def _push(self) -> None:
        """Bring what the writer has written into the file."""
        data = b"".join(self._buffer.pieces)
        self._buffer.pieces.clear()
        try:
            self._append(data)
        except OSError:
            self.broken = True
            self._add = self._check
            raise

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
