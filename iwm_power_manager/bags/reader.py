# SPDX-License-Identifier: Apache-2.0
"""Read any rosbag2 bag: MCAP or sqlite3, one file or many, compressed or not, whole or damaged. Needs no ROS.

Messages come in the order of their log times; where the clock was set back while they were recorded, in that of the
recording. What cannot be read is described in `BagReader.damage`; it is never fatal as long as anything can be read.
Nothing outside of the bag's folder is opened, and nothing but regular files.
"""

from __future__ import annotations

import heapq
import os
import re
import tempfile
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import lru_cache
from itertools import accumulate, count
from operator import itemgetter
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

from iwm_power_manager.bags import limits
from iwm_power_manager.bags.limits import PACKED, check_exists, decompress, decompress_file, regular_file
from iwm_power_manager.bags.mcap_source import MAGIC, ChannelMessage, McapSource, Piece, Source
from iwm_power_manager.bags.metadata import (
    METADATA_FILE,
    Topic,
    miscounted,
    read_metadata,
    text_values,
    topic_counts,
    typed,
)
from iwm_power_manager.bags.sqlite_source import SqliteSource
from iwm_power_manager.errors import BagError, did_you_mean, system_errors

SUFFIXES = (".mcap", ".db3")
COMPRESSED_SUFFIXES = (".zstd", ".zst", ".lz4")
#: What another program has to make readable: how it begins with what to do, and what its name ends with.
_FOREIGN = {
    b"\x1f\x8b": "is packed by gzip: unpack it first",
    b"BZh": "is packed by bzip2: unpack it first",
    b"#ROSBAG ": "is a bag of ROS 1: rosbags-convert makes one of ROS 2 of it",
}
_FOREIGN_ENDINGS = (*(kind + packed for kind in SUFFIXES for packed in (".gz", ".bz2")), ".bag")
_SQLITE_MAGIC = b"SQLite format 3\0"
_NEVER = 2**64
_DIGITS = re.compile(r"\d+")
MISNAMED = "is compressed, which its name does not say"


class Message(NamedTuple):
    """One recorded message.

    Attributes
    ----------
    log_time_ns : when it was received
    topic : full topic name
    data : its bytes, CDR in a bag of ROS 2
    publish_time_ns : when it was sent (the log time where the storage does not say)
    sequence : the publisher's counter, 0 if unknown
    """

    log_time_ns: int
    topic: str
    data: bytes
    publish_time_ns: int
    sequence: int


class BagReader(ExitStack):
    """A bag, opened for reading; its files are closed with it.

    Parameters
    ----------
    path : folder of the bag, or one `.mcap` or `.db3` file, which may be compressed (`.mcap.zst`, `.mcap.lz4`)

    Attributes
    ----------
    topics : recorded topics by name; where one has several definitions, each after the first has a number behind it
    counts : messages by topic
    custom_data : custom metadata
    start_ns, end_ns : log times the bag spans (0, 0 if it is empty)
    notes : what is unusual and costs nothing, a line each

    Raises
    ------
    BagError
        There is no bag, or nothing in it can be read.
    """

    def __init__(self, path: Path | str) -> None:
        super().__init__()
        self.path = Path(path)
        check_exists(self.path)
        self._damage: list[str] = []
        self.notes: list[str] = []
        self.sources: list[Source] = []
        try:
            self.information, problem = read_metadata(self.path) if os.path.isdir(self.path) else ({}, "")
            there = os.path.lexists(self.path / METADATA_FILE)
            (self._damage if there else self.notes).extend([problem] if problem else [])
            self._open_all()
        except BaseException:
            self.close()
            raise
        self.topics: dict[str, Topic] = {}
        self._names: dict[Source, dict[int, str]] = {}  # by the channels of each file
        self._kinds: dict[str, dict[tuple[str, str], str]] = {}
        self.counts: Counter[str] = Counter()
        self.custom_data = text_values(self.information.get("custom_data"))
        self._pieces = [piece for source in self.sources for piece in source.pieces]
        # To look at the first messages is no work done twice.
        self._unpack: Callable[[Piece], list[ChannelMessage]] = lru_cache(1)(lambda piece: piece.source.unpack(piece))
        for source in self.sources:
            self._take(source)
        self._set_back = self._where_set_back()
        if self._set_back:
            self.notes.append(
                f"{self._set_back.path}: the clock was set back meanwhile: it is read in the order of recording"
            )
        if self.information and not self.damage:
            held = topic_counts(self.sources)
            if miscounted(self.information, held):
                self.notes.append(f"{self.path}: metadata.yaml miscounts the messages: {held.total()} are there")
        self.start_ns = min((piece.start_ns for piece in self._pieces if piece.end_ns), default=0)
        self.end_ns = max((piece.end_ns for piece in self._pieces), default=0)

    @property
    def damage(self) -> list[str]:
        """What could not be read so far, a line each; empty for a whole bag."""
        return self._damage + [f"{source.path}: {line}" for source in self.sources for line in source.damage]

    def messages(self) -> Iterator[Message]:
        """All messages in the order of log times; equal times, or a clock that was set back, keep that of recording."""
        lost: Counter[tuple[Source, str]] = Counter()
        for source, messages in self._in_order():
            names = self._names[source]
            for log_time, channel, data, publish_time, sequence in messages:
                name = names.get(channel)
                if name is None:
                    lost[source, "message(s) belong to channels that are nowhere announced"] += 1
                    continue
                if data[:4] in PACKED:  # compression mode "message"
                    try:
                        data = decompress(PACKED[data[:4]], data)
                    except BagError:  # stays as it is; decoders refuse and count it
                        lost[source, "compressed message(s) cannot be decompressed"] += 1
                yield Message(log_time, name, data, publish_time, sequence)
        for (source, what), number in lost.items():
            source.note(f"{number} {what}")

    def _in_order(self) -> Iterator[tuple[Source, Sequence[ChannelMessage]]]:
        """The messages in their order, as many at a time as one file has next.

        Memory: a piece, such as a chunk, and of those before it the messages that belong behind its first.
        """
        if self._set_back:
            yield from ((piece.source, self._unpack(piece)) for piece in self._pieces)
            return
        pieces = sorted(self._pieces, key=itemgetter(0))
        waiting: list[tuple[int, int, ChannelMessage, Source]] = []
        order, size = count(), 0
        for piece, next_ns in zip(pieces, [*(piece.start_ns for piece in pieces[1:]), _NEVER], strict=False):
            messages = sorted(self._unpack(piece), key=itemgetter(0))
            ready = 0 if waiting else bisect_right(messages, next_ns, key=itemgetter(0))
            yield piece.source, messages[:ready]
            for message in messages[ready:]:
                size += len(message[2]) + limits.MESSAGE_OVERHEAD_BYTES
                heapq.heappush(waiting, (message[0], next(order), message, piece.source))
            if size > limits.MAX_OVERLAP_BYTES:
                piece.source.note("its chunks overlap in time by more than fits into memory: not all is in order")
                next_ns = _NEVER
            while waiting and waiting[0][0] <= next_ns:
                *_, message, source = heapq.heappop(waiting)
                size -= len(message[2]) + limits.MESSAGE_OVERHEAD_BYTES
                yield source, [message]

    def _where_set_back(self) -> Source | None:
        """The file in which the log times of a topic go back, or with which they do among files of one series.

        Where pieces follow each other in time, none is read to see.
        """
        filled = [piece for piece in self._pieces if piece.end_ns]  # one without messages has no times
        ends = accumulate((piece.end_ns for piece in filled), max)
        jumps = any(after.start_ns < end - limits.SET_BACK_NS for end, after in zip(ends, filled[1:], strict=False))
        within = any(source.goes_back for source in self.sources)
        alone = len(filled) == 1 and filled[0].end_ns - filled[0].start_ns > limits.SET_BACK_NS
        newest: dict[tuple[str, str | None], int] = {}
        for piece in filled if jumps or within or alone else ():
            series, names = _DIGITS.sub("", piece.source.path.name), self._names[piece.source]
            for log_time, channel, *_ in self._unpack(piece):
                topic = series, names.get(channel)
                if log_time < newest.setdefault(topic, log_time) - limits.SET_BACK_NS:
                    return piece.source
                newest[topic] = log_time
        return None

    # --- opening ----------------------------------------------------------------------------------------------------

    def _take(self, source: Source) -> None:
        """What a file knows of topics, counts and custom data."""
        topics = {number: typed(topic, self.information) for number, topic in source.topics.items()}
        names = self._names[source] = {number: self._name(topic) for number, topic in topics.items()}
        for number, topic in topics.items():
            self.counts[names[number]] += source.counts[number]
            if topic.definition or names[number] not in self.topics:
                self.topics[names[number]] = topic
            if names[number] != topic.name:
                self.notes.append(f"{topic.name} has more than one definition: each message is read by its own")
        self.custom_data = source.custom_data | self.custom_data

    def _name(self, topic: Topic) -> str:
        """Its own, or, for a definition after the first, one that no other topic can have."""
        kinds = self._kinds.setdefault(topic.name, {})
        if kinds and not topic.definition:
            return topic.name
        name = f"{topic.name} ({len(kinds) + 1})" if kinds else topic.name
        name = kinds.pop((topic.type, ""), name)  # an older file of the bag may have no definitions
        return kinds.setdefault((topic.type, topic.definition), name)

    def _open_all(self) -> None:
        problems = []
        for name in self._file_names():
            try:
                opened, problem = opened_file(name, self, self.path if self.path != name else None)
                harmless = problem == MISNAMED
                (self.notes if harmless else self._damage).extend([f"{name}: {problem}"] if problem else [])
                self.sources.append(open_source(opened, name, self))
            except BagError as error:
                problems.append(str(error))
        if not self.sources:
            inside = {path.parent for kind in (".mcap", ".db3") for path in self.path.glob(f"*/*{kind}")}
            meant = did_you_mean(str(path) for path in sorted(inside)[:3])
            raise BagError(problems[0] if problems else f"{self.path}: holds no .mcap or .db3 file{meant}")
        self.sources.sort(key=lambda source: _recording_order(source.path))
        self._damage += problems

    def _file_names(self) -> list[Path]:
        if not os.path.isdir(self.path):
            return [self.path]
        names = [self.path / name for name in listed_files(self.information)]
        present = [name for name in names if os.path.exists(name)]
        self._damage += [f"{name}: is missing" for name in names if name not in present]
        if not present:
            return data_files(self.path)
        with suppress(BagError):  # a folder that may be entered and not listed
            there = data_files(self.path)
            known = {*present, *(name for name in there if recovered(name) in present)}
            left_out = [name for name in there if name not in known and begins_as_data(name, self.path)]
            self.notes += [f"{name}: is not in metadata.yaml and left out" for name in left_out]
        return present


def recovered(path: Path) -> Path:
    """Where a recovered file goes."""
    return path.with_name(plain_name(path)).with_suffix(".mcap")


def plain_name(path: Path) -> str:
    """A file's name without what says that it is compressed."""
    return path.stem if path.suffix in COMPRESSED_SUFFIXES else path.name


def begins_as_data(path: Path, folder: Path | None = None) -> bool:
    """Whether a file begins as one that can be read (unpacked), whatever its name: not as what a power cut has left."""
    with suppress(BagError):
        regular_file(path, folder)
        begins = (MAGIC, _SQLITE_MAGIC[: len(MAGIC)], *PACKED, *_FOREIGN)
        return path.suffix in COMPRESSED_SUFFIXES or _head(path, len(MAGIC)).startswith(begins)
    return False


def listed_files(information: Mapping[str, Any]) -> dict[str, None]:
    """Names of the data files that a `metadata.yaml` lists, in its order.

    Older versions put the folder's name in front (on Windows with a backslash); what leads elsewhere is looked for in
    the folder, and is not there.
    """
    listed = information.get("relative_file_paths")
    listed = listed if isinstance(listed, list) else []
    names = (PurePosixPath(str(name).replace("\\", "/")).name for name in listed)
    return dict.fromkeys(name for name in names if name.strip("."))


def opened_file(path: Path, stack: ExitStack, folder: Path | None = None, beside: bool = False) -> tuple[Path, str]:
    """A data file itself, or a copy that is decompressed (and goes with `stack`), and what is wrong with it.

    Raises
    ------
    BagError
        It is no regular file, lies outside of its `folder`, cannot be decompressed, or is packed by another program.
    """
    regular_file(path, folder)
    named = path.suffix in COMPRESSED_SUFFIXES
    if advice := next((words for begin, words in _FOREIGN.items() if _head(path, len(begin)) == begin), ""):
        raise BagError(f"{path}: {advice}")
    if journals(path):
        return path, "has a journal, which is not read: recorder --recover does that"
    if not named and _head(path, 4) not in PACKED:
        return path, ""
    where = path.parent if beside else None
    copied = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="iwm_bag_", dir=where))) / path.stem
    return copied, decompress_file(path, copied) or ("" if named else MISNAMED)


def journals(path: Path) -> list[Path]:
    """What sqlite has left beside a database that was not closed."""
    beside = [path.with_name(path.name + end) for end in ("-wal", "-journal")]
    return [journal for journal in beside if os.path.isfile(journal) and os.path.getsize(journal)]


def _head(path: Path, size: int) -> bytes:
    """The first bytes of a file; `BagError` if it cannot be read."""
    with system_errors(path, "cannot be read"), path.open("rb") as file:
        return file.read(size)


def open_source(opened: Path, path: Path, stack: ExitStack) -> Source:
    """Open a data file, or a copy of the one at `path`, as what it is by its first bytes, else by its name."""
    head = _head(opened, len(_SQLITE_MAGIC))
    sqlite = head == _SQLITE_MAGIC or (opened.suffix == ".db3" and not head.startswith(MAGIC))
    try:
        source = SqliteSource(opened, stack) if sqlite else McapSource(opened, stack)
    except BagError as error:  # not under the name of a copy
        raise BagError(str(error).replace(str(opened), str(path))) from None
    source.path = path
    return source


def data_files(folder: Path) -> list[Path]:
    """Data files of a bag's folder in the order of recording: `bag_10.mcap` comes after `bag_9.mcap`."""
    with system_errors(folder, "cannot be read"):
        entries = list(folder.iterdir())
    packed = [entry for entry in entries if entry.name.endswith(_FOREIGN_ENDINGS)]
    names = [entry for entry in entries if plain_name(entry).endswith(SUFFIXES)] or packed  # which say what to do
    real = {os.path.realpath(name) for name in names if not name.is_symlink()}
    names = [name for name in names if not (name.is_symlink() and os.path.realpath(name) in real)]  # the same twice
    names = [name for name in names if name.suffix not in COMPRESSED_SUFFIXES or name.with_suffix("") not in names]
    return sorted(names, key=_recording_order)


def _recording_order(path: Path) -> tuple[int, str]:
    digits = path.name.split(".", 1)[0].rpartition("_")[2]
    return (int(digits) if digits.isascii() and digits.isdigit() and len(digits) < 20 else 0, path.name)
