# SPDX-License-Identifier: Apache-2.0
"""Messages of one MCAP file, whole or damaged.

A whole file's index is read by the `mcap` package. Where it is missing or makes no sense, the file is gone through
record by record, which finds the same. Chunks are unpacked when their turn comes. (Of a whole file `rosbags` reads
neither publish times nor sequence numbers, see `storage_mcap.msgsrc`, and a lock-step replay needs both.)
"""

from __future__ import annotations

import heapq
import mmap
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Header, MessageIndex, Metadata

from iwm_power_manager.bags.limits import MAX_OVERLAP_BYTES, decompress, regular_file
from iwm_power_manager.bags.mcap_records import (
    HEAD_BYTES,
    MAGIC,
    UNREADABLE,
    ChunkMessage,
    Definitions,
    Record,
    chunk_head,
    read_record,
    split,
    walk,
)
from iwm_power_manager.bags.metadata import CUSTOM_METADATA, Topic, information_of, parse_qos, text_values
from iwm_power_manager.errors import BagError

#: Footer record and closing magic, and in front of them the checksum of the summary.
_FOOTER = struct.Struct("<BQQQI8s")
#: Messages that stand outside of chunks are read in pieces of about this size.
_RUN_BYTES = 1024 * 1024


class Piece(NamedTuple):
    """A chunk, or a stretch of messages outside of chunks: log times it spans, where it is, bytes it unpacks to."""

    start_ns: int
    end_ns: int
    start: int
    end: int
    size: int
    is_chunk: bool


class McapSource:
    """An MCAP file, opened and surveyed.

    Parameters
    ----------
    path : the file
    stack : closes it

    Attributes
    ----------
    path : the file
    damage : what is wrong with the file, a line each; grows while messages are read
    definitions : schemas and channels
    counts : messages by channel, as far as chunks can be read
    metadata : contents of metadata records, by name
    start_ns, end_ns : log times of the messages; 0 if there is none
    indexed : the file was finished by its writer

    Raises
    ------
    BagError
        The file cannot be opened, is no MCAP file at all, or asks for more than `bags.limits` allow.
    """

    def __init__(self, path: Path, stack: ExitStack) -> None:
        self.path = path
        self.damage: list[str] = []
        self.definitions = Definitions()
        self.counts: Counter[int] = Counter()
        self.metadata: dict[str, dict[str, str]] = {}
        self._pieces: list[Piece] = []
        size = regular_file(path)
        if size == 0:
            raise BagError(f"{path}: is empty")
        try:
            with path.open("rb") as stream:
                self.data: Any = stack.enter_context(mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ))
        except OSError as error:
            raise BagError(f"{path}: cannot be read: {error.strerror or error}") from None
        if self.data[: len(MAGIC)] != MAGIC:
            raise BagError(f"{path}: is no MCAP file")
        self.indexed = self._read_index()
        if not self.indexed:
            self._scan()
        if not self.definitions.channels or self.counts.keys() - self.definitions.channels.keys():
            for piece in self._pieces:  # announced inside of chunks only
                self.unpack(piece)
            self.damage = list(dict.fromkeys(self.damage))
        self._pieces = [self._as_read(piece) if piece.start_ns >= piece.end_ns else piece for piece in self._pieces]
        filled = [piece for piece in self._pieces if piece.start_ns <= piece.end_ns]
        self.start_ns = min((piece.start_ns for piece in filled), default=0)
        self.end_ns = max((piece.end_ns for piece in filled), default=0)

    # --- what the file is about -------------------------------------------------------------------------------------

    def topics(self) -> dict[int, Topic]:
        """The topic of each channel."""
        found = {}
        for number, channel in self.definitions.channels.items():
            schema = self.definitions.schema_of(channel)
            found[number] = Topic(
                channel.topic,
                schema.name,
                schema.data.decode("utf-8", "surrogateescape"),
                channel.metadata.get("topic_type_hash", ""),
                parse_qos(channel.metadata.get("offered_qos_profiles", "")),
                schema.encoding,
                channel.message_encoding,
            )
        return found

    def topic_counts(self) -> Counter[str]:
        """Messages by topic."""
        found: Counter[str] = Counter()
        for number, channel in self.definitions.channels.items():
            found[channel.topic] += self.counts[number]
        return found

    def information(self) -> dict[str, Any]:
        """What rosbag2 keeps inside of the file of its `metadata.yaml`; {} if that is nothing or cannot be read."""
        return information_of(self.metadata.get("rosbag2", {}).get("serialized_metadata", ""))

    def custom_data(self) -> dict[str, str]:
        """Custom metadata inside of the file, our own recorder's or rosbag2's."""
        return text_values(self.information().get("custom_data")) | self.metadata.get(CUSTOM_METADATA, {})

    def header(self) -> Header:
        """The file's head; an empty one if it is damaged."""
        record = next(walk(self.data), None)
        if record is not None and record.opcode == Opcode.HEADER:
            try:
                found: Header = read_record(Header, self.body(record))
                return found
            except BagError:
                pass
        return Header(profile="ros2", library="")

    def body(self, record: Record) -> bytes:
        """Content of a record."""
        return bytes(self.data[record.body : record.end])

    # --- the survey -------------------------------------------------------------------------------------------------

    def _read_index(self) -> bool:
        """Take up the index at the file's end; False if there is none to rely on."""
        data = self.data
        if len(data) < _FOOTER.size or data[-len(MAGIC) :] != MAGIC:
            return False
        opcode, _, start, _, crc, _ = _FOOTER.unpack_from(data, len(data) - _FOOTER.size)
        if opcode != Opcode.FOOTER or not 0 < start < len(data):
            return False
        if crc and zlib.crc32(data[start : len(data) - len(MAGIC) - 4]) != crc:
            self.damage.append("its summary is damaged")
            return False
        try:
            reader = SeekingReader(data)
            summary = reader.get_summary()
            if summary is None or summary.statistics is None or not summary.chunk_indexes:
                return False
            for record in reader.iter_metadata():
                self.metadata.setdefault(record.name, {}).update(record.metadata)
        except Exception:  # noqa: BLE001 - the package lets through whatever damaged bytes make it raise
            self.damage.append("its summary is damaged")
            return False
        pieces = [
            Piece(
                index.message_start_time,
                index.message_end_time,
                index.chunk_start_offset,
                index.chunk_start_offset + index.chunk_length,
                index.uncompressed_size,
                True,
            )
            for index in summary.chunk_indexes
        ]
        if len({piece.start for piece in pieces}) < len(pieces) or any(piece.end > start for piece in pieces):
            self.damage.append("its summary is damaged")
            return False
        self.definitions.schemas.update(summary.schemas)
        self.definitions.channels.update(summary.channels)
        self.counts.update(summary.statistics.channel_message_counts)
        self._pieces = pieces
        return True

    def _scan(self) -> None:
        """Go through all records."""
        data = self.data
        chunk: Piece | None = None  # the last one, whose index is still to come
        run: list[Record] = []
        ended = False
        for record in walk(data):
            if run and (record.opcode != Opcode.MESSAGE or record.end - run[0].start > _RUN_BYTES):
                self._note_run(run)
                run = []
            if chunk is not None and record.opcode != Opcode.MESSAGE_INDEX:
                self._note_chunk(chunk, None)
                chunk = None
            try:
                if record.opcode == Opcode.CHUNK:
                    head = chunk_head(data, record.body, record.end)
                    chunk = Piece(head.start_ns, head.end_ns, record.start, record.end, head.size, True)
                elif record.opcode == Opcode.MESSAGE_INDEX and chunk is not None:
                    self._note_chunk(chunk, self.body(record))
                    chunk = None
                elif record.opcode == Opcode.MESSAGE_INDEX:
                    self._count(self.body(record))
                elif record.opcode == Opcode.MESSAGE:
                    run.append(record)
                elif record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    self.definitions.take(record.opcode, self.body(record))
                elif record.opcode == Opcode.METADATA:
                    found = read_record(Metadata, self.body(record))
                    self.metadata.setdefault(found.name, {}).update(found.metadata)
                elif record.opcode == UNREADABLE:
                    self._note_stretch(record)
            except BagError as error:
                self.damage.append(f"{error} at byte {record.start}")
            ended = record.opcode in (Opcode.DATA_END, Opcode.FOOTER)
        if run:
            self._note_run(run)
        if chunk is not None:
            self._note_chunk(chunk, None)
        if ended:
            self._scan_summary(record.end)
        if not ended or data[-len(MAGIC) :] != MAGIC:
            self.damage.append("ends without a footer: the recorder did not finish it")

    def _scan_summary(self, offset: int) -> None:
        """Schemas and channels repeated after the data: other writers announce them inside of chunks only."""
        for record in walk(self.data, offset):
            if record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                try:
                    self.definitions.take(record.opcode, self.body(record))
                except BagError as error:
                    self.damage.append(f"{error} at byte {record.start}")

    def _note_chunk(self, piece: Piece, index: bytes | None) -> None:
        """A chunk, with the first record of its index; without one it is opened to see what is in it."""
        if index is not None:
            self._count(index)
            self._pieces.append(piece)
            return
        messages = self.unpack(piece)
        self.counts.update(message.channel_id for message in messages)
        if messages:
            self._pieces.append(piece)

    def _count(self, index: bytes) -> None:
        found = read_record(MessageIndex, index)
        self.counts[found.channel_id] += len(found.records)

    def _note_run(self, run: list[Record]) -> None:
        piece = Piece(0, 0, run[0].start, run[-1].end, run[-1].end - run[0].start, False)
        messages = self.unpack(piece)
        times = [message.log_time_ns for message in messages]
        self.counts.update(message.channel_id for message in messages)
        if times:
            self._pieces.append(piece._replace(start_ns=min(times), end_ns=max(times)))

    def _note_stretch(self, record: Record) -> None:
        if record.end < len(self.data):
            self.damage.append(f"holds no record from byte {record.start} to {record.end}")

    def _as_read(self, piece: Piece) -> Piece:
        """A chunk that says it spans no time: with the times of its messages, or none of them."""
        times = [message.log_time_ns for message in self.unpack(piece)]
        return piece._replace(start_ns=min(times), end_ns=max(times)) if times else piece._replace(start_ns=1, end_ns=0)

    # --- messages ---------------------------------------------------------------------------------------------------

    def messages(self) -> Iterator[ChunkMessage]:
        """All messages in the order of their log times; equal times keep the order of the file.

        Memory: the chunks that overlap in time, usually one.
        """
        pieces = sorted((piece for piece in self._pieces if piece.start_ns <= piece.end_ns), key=attrgetter("start_ns"))
        group: list[Piece] = []
        end_ns = -1
        for piece in pieces:
            if group and piece.start_ns >= end_ns:
                yield from self._merged(group)
                group = []
            group.append(piece)
            end_ns = max(end_ns, piece.end_ns)
        yield from self._merged(group)

    def _merged(self, group: list[Piece]) -> Iterator[ChunkMessage]:
        """Messages of chunks that overlap one another in time."""
        if len(group) == 1:
            yield from self._sorted(group[0])
            return
        if _largest_overlap(group) > MAX_OVERLAP_BYTES:
            self.damage.append(
                "its chunks overlap in time by more than fits into memory: read in the order of the file"
            )
            for piece in sorted(group, key=attrgetter("start")):
                yield from self._sorted(piece)
            return
        # A mark in front of each chunk keeps it packed until its time has come.
        streams = [self._marked(piece) for piece in group]
        for message in heapq.merge(*streams, key=_log_time):
            if message is not None and message.offset >= 0:
                yield message

    def _marked(self, piece: Piece) -> Iterator[ChunkMessage]:
        yield ChunkMessage(piece.start_ns, 0, b"", 0, 0, -1)
        yield from self._sorted(piece)

    def _sorted(self, piece: Piece) -> list[ChunkMessage]:
        return sorted(self.unpack(piece), key=_log_time)

    def unpack(self, piece: Piece) -> list[ChunkMessage]:
        """Messages of a chunk in the order of the file; none, and a line of damage, if it cannot be unpacked."""
        try:
            if not piece.is_chunk:
                return split(self.data[piece.start : piece.end], self.definitions)
            return split(self.raw(piece.start, piece.end), self.definitions)
        except BagError as error:
            self.damage.append(f"the chunk at byte {piece.start} {error}")
            return []

    def raw(self, start: int, end: int) -> bytes:
        """Content of the chunk whose record spans these bytes; `BagError` if it is damaged or too large."""
        head = chunk_head(self.data, start + HEAD_BYTES, end)
        if self.data[start] != Opcode.CHUNK or head.end > end:
            raise BagError("is damaged")
        raw = decompress(head.compression, self.data[head.data : head.end], head.size)
        if head.crc and zlib.crc32(raw) != head.crc:
            raise BagError("is damaged: its checksum is wrong")
        return raw


_log_time = attrgetter("log_time_ns")


def _largest_overlap(group: list[Piece]) -> int:
    """The most bytes of chunks that are to be in memory at one time."""
    changes = sorted(
        [(piece.start_ns, piece.size) for piece in group] + [(piece.end_ns, -piece.size) for piece in group]
    )
    most = present = 0
    for _, change in changes:
        present += change
        most = max(most, present)
    return most
