# SPDX-License-Identifier: Apache-2.0
"""Make a valid bag of what a killed or starved recorder left on the disk, whoever's it was.

All that can be read of a file is written anew by the `mcap` package: messages, schemas in any language, attachments,
metadata, and as bytes the records it does not know. What was compressed to a file, or is a damaged sqlite3 file,
becomes an MCAP file beside it. The copy is read and counted before it takes the original's place, and an original of
which something could not be read is kept. A chunk that was cut off counts as that: its checksum is of all of it, and
what a power cut has left of a part may be zeros that look like messages.
"""

from __future__ import annotations

import itertools
import os
import shutil
import sqlite3
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema

from iwm_power_manager.bags import mcap_source, reader
from iwm_power_manager.bags.limits import PACKED, check_exists, regular_file
from iwm_power_manager.bags.losses import Losses
from iwm_power_manager.bags.mcap_file import McapFile
from iwm_power_manager.bags.metadata import (
    FileSpan,
    Topic,
    bag_information,
    miscounted,
    read_metadata,
    text_values,
    topic_counts,
    typed,
)
from iwm_power_manager.bags.sqlite_source import SqliteSource
from iwm_power_manager.bags.writer import LIBRARY, announce, write_metadata
from iwm_power_manager.errors import BagError, NoAnswerError, system_errors
from iwm_power_manager.files import sync_folder

_DAMAGED = ".damaged"


class FileRecovery(NamedTuple):
    """What became of one file.

    Attributes
    ----------
    name, message_count : the file, and messages in it now
    rebuilt : it was written anew
    damage : what was wrong with it; "" for a whole file
    discarded_bytes : torn bytes at its end
    lost_chunks : chunks, or stretches of the file, that could not be read
    kept : name of the original, where it is kept; "" where the rebuilt file has taken its place
    """

    name: str
    rebuilt: bool
    message_count: int
    damage: str
    discarded_bytes: int = 0
    lost_chunks: int = 0
    kept: str = ""

    def lines(self) -> list[str]:
        """The report for the user."""
        if not self.rebuilt:
            state = f"left out: {self.damage}" if self.damage else f"whole, {self.message_count} messages"
            return [f"  {self.name}: {state}"]
        out = [f"  {self.name}: {self.damage}; rebuilt with {self.message_count} messages, "
               f"{self.discarded_bytes} torn bytes at its end discarded"]  # fmt: skip
        if self.lost_chunks:
            out.append(f"  {self.name}: {self.lost_chunks} chunk(s) or other stretch(es) unreadable")
        if self.kept:
            out.append(f"  {self.name}: original kept as {self.kept}")
        return out


class Recovery(NamedTuple):
    """What `recover` found and did.

    Attributes
    ----------
    path : the bag
    files : file by file
    missing : by topic of one publisher, messages that its counter shows to be missing between the first and the last
    start_ns, end_ns : log times the bag spans now
    metadata_written : `metadata.yaml` was missing or did not fit
    """

    path: Path
    files: list[FileRecovery]
    missing: dict[str, int]
    start_ns: int
    end_ns: int
    metadata_written: bool

    @property
    def message_count(self) -> int:
        """Messages in the bag now."""
        return sum(file.message_count for file in self.files)

    def lines(self) -> list[str]:
        """The report for the user."""
        total = self.message_count
        span = (self.end_ns - self.start_ns) * 1e-9
        out = [f"{self.path}: {total} messages over {span:.3f} s in {len(self.files)} file(s)"]
        for file in self.files:
            out += file.lines()
        for topic, count in sorted(self.missing.items()):
            out.append(f"  {topic}: {count} messages missing in between, by the publisher's counter")
        if self.metadata_written:
            out.append("  metadata.yaml written")
        elif not any(file.rebuilt for file in self.files):
            out.append("  nothing to recover")
        return out


def recover(path: Path | str) -> Recovery:
    """Make a bag valid; one that is valid already stays untouched.

    Parameters
    ----------
    path : a bag's folder, or one `.mcap`, `.db3`, `.mcap.zstd` or `.db3.zstd` file

    Raises
    ------
    BagError
        There is no such bag, nothing in it can be read, or there is no room for the rebuilt file; `NoAnswerError` if
        its files were cut off within their first bytes.
    """
    path = Path(path)
    folder = path if os.path.isdir(path) else None
    with ExitStack() as stack:
        files: list[_File] = []
        left_out: list[FileRecovery] = []
        names = _names(path)
        losses = defaultdict[str, Losses](Losses)
        for name in names:
            try:
                regular_file(name, folder)
                name.name.encode()
                files.append(_File(name, stack, losses))
            except UnicodeEncodeError:
                why = f"{name}: its name is no UTF-8 text, which metadata.yaml could not hold: rename it"
                left_out.append(FileRecovery(name.name, False, 0, why))
            except BagError as error:
                left_out.append(FileRecovery(name.name, False, 0, str(error)))
        if not files:
            kind = NoAnswerError if all(map(_just_begun, names)) else BagError
            raise kind(f"{left_out[0].damage}; nothing to recover")
        information, problem = read_metadata(path) if folder else ({}, "none")
        fits = not problem and reader.listed_files(information).keys() == {file.path.name for file in files}
        fits = fits and not miscounted(information, topic_counts(file.seen for file in files))
        sqlite = all(file.is_sqlite and not file.problem for file in files)
        for file in files:
            if file.problem or (file.is_sqlite and not sqlite) or (file.is_compressed and not fits):
                file.rebuild()
        for file in files:
            file.put_in_place()
        stale = folder is not None and not (fits and not any(file.report.rebuilt for file in files))
        if stale:
            _write_metadata(path, files, "sqlite3" if sqlite else "mcap", information)
        return Recovery(
            path,
            [file.report for file in files] + left_out,
            {topic: found.count for topic, found in losses.items() if found.count},
            min((file.seen.start_ns for file in files if file.seen.count), default=0),
            max(file.seen.end_ns for file in files),
            stale,
        )


def _names(path: Path) -> list[Path]:
    """Data files; not those of which an earlier recovery has left its result beside them."""
    check_exists(path)
    if not os.path.isdir(path):
        named = reader.plain_name(path).endswith(reader.SUFFIXES)
        if not (named or reader.begins_as_data(path)):
            raise BagError(f"{path}: is no folder and no .mcap or .db3 file")
        return [path]
    names = reader.data_files(path)
    listed = [path / name for name in reader.listed_files(read_metadata(path)[0])]  # under whatever name
    names += [name for name in listed if name not in names and reader.begins_as_data(name, path)]
    names = [name for name in names if reader.recovered(name) == name or reader.recovered(name) not in names]
    if not names:
        raise BagError(f"{path}: holds no .mcap or .db3 file")
    return names


def _just_begun(path: Path) -> bool:
    """Whether a file was cut off within its first bytes, or is empty."""
    with suppress(BagError, OSError):
        regular_file(path)
        with path.open("rb") as file:
            return mcap_source.MAGIC.startswith(file.read(len(mcap_source.MAGIC)))
    return False


class _Seen:
    """All messages of a file, read and counted: by channel, in all, the first and the last, compressed one by one.

    What is missing by the publishers' numbers goes to `losses`, by topic, from file to file.
    """

    def __init__(self, source: mcap_source.Source, losses: defaultdict[str, Losses]) -> None:
        self.source = source
        self.topics = source.topics
        self.counts: Counter[int] = Counter()
        self.compression = ""
        start_ns, self.end_ns = 2**64, 0
        own = _is_own(source)  # other recorders count something else
        for log_time, channel, data, _, sequence in source.messages():
            self.counts[channel] += 1
            start_ns, self.end_ns = min(start_ns, log_time), max(self.end_ns, log_time)
            self.compression = self.compression or PACKED.get(data[:4], "")
            if sequence and own and channel in self.topics:
                losses[self.topics[channel].name].take(sequence)
        self.count = self.counts.total()
        self.start_ns = start_ns if self.count else 0


class _File:
    """A data file and what becomes of it: what is wrong with it, and what was found, at last in the rebuilt one."""

    def __init__(self, path: Path, stack: ExitStack, losses: defaultdict[str, Losses]) -> None:
        self._stack = stack
        self.path = path
        self.is_compressed = path.suffix in reader.COMPRESSED_SUFFIXES
        self._temporary: Path | None = None
        opened, problem = _opened(path, stack)
        self.seen = _Seen(reader.open_source(opened, path, stack), losses)
        self.is_sqlite = isinstance(self.seen.source, SqliteSource)
        found = self.seen.source.damage[:3]
        if self.seen.counts.keys() - self.seen.topics.keys():
            found.append("holds messages of channels that are nowhere announced")
        elif not found and +self.seen.counts != +self.seen.source.counts:
            found.append(f"says of itself that it holds {self.seen.source.counts.total()} messages")
        self.problem = problem or "; ".join(found)
        self.report = FileRecovery(path.name, False, self.seen.count, "")

    def rebuild(self) -> None:
        """Write what can be read to a file of its own, and read that."""
        target = reader.recovered(self.path)
        if target != self.path and os.path.lexists(target):
            raise BagError(f"{target}: exists, and what is recovered of {self.path.name} would go there: move it away")
        temporary = target.with_name(target.name + ".recovering")
        with system_errors(temporary, "cannot be written"):
            temporary.unlink(missing_ok=True)
            self._stack.callback(temporary.unlink, missing_ok=True)
            copy = _Copy(self.seen.source, temporary)
            made = _Seen(reader.open_source(temporary, target, self._stack), defaultdict(Losses))
        if made.source.damage or made.count < self.seen.count:
            raise BagError(
                f"{temporary}: holds {made.count} of {self.seen.count} messages; the original is left as it is"
            )
        kept = self.path.name if target != self.path else _free_name(target) if copy.lost or copy.torn else ""
        what = self.problem or ("is compressed" if self.is_compressed else "is sqlite3 beside MCAP")
        self.report = FileRecovery(target.name, True, made.count, what, copy.torn, copy.lost, kept)
        self.seen, self.path, self._temporary = made, target, temporary

    def put_in_place(self) -> None:
        """Let the rebuilt file take its place."""
        if self._temporary is None:
            return
        with system_errors(self._temporary, "cannot be written"):
            if _DAMAGED in self.report.kept:
                keep = self.path.with_name(self.report.kept)
                try:
                    os.link(self.path, keep)
                except OSError:  # a file system without links
                    shutil.copy2(self.path, keep)
            os.replace(self._temporary, self.path)
            sync_folder(self.path.parent)


def _free_name(path: Path) -> str:
    """Name for an original that is kept; that of an earlier recovery stays."""
    names = (f"{path.name}{_DAMAGED}{f'_{i}' if i else ''}" for i in itertools.count())
    return next(name for name in names if not os.path.lexists(path.with_name(name)))


def _is_own(source: mcap_source.Source) -> bool:
    return source.header.library.startswith(LIBRARY.partition(" ")[0])


def _opened(path: Path, stack: ExitStack) -> tuple[Path, str]:
    """The file itself, or a copy that can be read, and what is wrong with it."""
    journals = reader.journals(path)
    if not journals:
        return reader.opened_file(path, stack, beside=True)
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="iwm_recover_", dir=path.parent)))
    for file in (path, *journals):
        regular_file(file, path.parent)
        shutil.copyfile(file, folder / file.name)
    with suppress(sqlite3.Error), closing(sqlite3.connect(folder / path.name)) as database:  # else it is read without
        database.execute("PRAGMA journal_mode = DELETE")
    return folder / path.name, "has a journal: the recorder did not finish"


class _Copy:
    """What can be read of a file, in a new MCAP file.

    Attributes
    ----------
    lost : chunks, or stretches, that could not be read, or not all of them
    torn : bytes at its end
    """

    def __init__(self, source: mcap_source.Source, target: Path) -> None:
        self.lost = self.torn = 0
        self._file = McapFile(target, library=source.header.library or LIBRARY, profile=source.header.profile)
        self._numbers: dict[int, int] = {}  # by the channels of the old file those of the new one
        self._schemas: dict[int, Schema] = {}
        self._made: dict[str, int] = {}
        try:
            if isinstance(source, mcap_source.McapSource):
                self._define(source.definitions)
                for record in source.records():
                    self._carry_over(source, record)
            else:
                self._numbers |= {number: announce(self._file, topic) for number, topic in source.topics.items()}
                self._write(source.messages())
            self._file.finish()
        finally:
            self._file.abandon()

    def _define(self, definitions: mcap_source.Definitions) -> None:
        """Announce channels; one that is announced anew, and otherwise, is another one from here on."""
        self._schemas.update(definitions.schemas)
        for number, channel in definitions.channels.items():
            schema = self._schemas.get(channel.schema_id)
            key = self._file.schema_id(schema.name, schema.encoding, schema.data) if schema else 0
            what = channel.topic, channel.message_encoding, key, channel.metadata
            name = repr((number, what))
            if name not in self._made:
                self._made[name] = self._file.writer.register_channel(*what)
            self._numbers[number] = self._made[name]

    def _write(self, messages: Iterable[mcap_source.ChannelMessage]) -> None:
        writer, numbers = self._file.writer, self._numbers
        for log_time, channel, data, publish_time, sequence in messages:
            if channel not in numbers:  # its announcement is lost; what was sent on it is not
                numbers[channel] = writer.register_channel(f"/recovered/channel_{channel}", "cdr", 0, {})
            writer.add_message(numbers[channel], log_time, data, publish_time, sequence)

    def _carry_over(self, source: mcap_source.McapSource, record: mcap_source.Record) -> None:
        found, raw, writer = record.content, source.data[record.start : record.end], self._file.writer
        left_out: list[str] = []
        here = mcap_source.Definitions(left_out.append)
        if record.opcode == Opcode.CHUNK:
            try:
                messages = mcap_source.split(source.raw(record), here)
            except BagError:
                self.lost += 1
                return
            self.lost += any(line.startswith(mcap_source.LEFT_OUT) for line in left_out)
            self._define(here)
            self._write(messages)
        elif isinstance(found, Schema | Channel):
            here.take(found)
            self._define(here)
        elif record.opcode == Opcode.MESSAGE:
            self._write(mcap_source.split(raw, here))
        elif isinstance(found, Attachment):
            writer.add_attachment(found.create_time, found.log_time, found.name, found.media_type, found.data)
        elif isinstance(found, Metadata):
            writer.add_metadata(found.name, found.metadata)
        elif record.opcode >= mcap_source.FIRST_PRIVATE:
            self._file.write(raw)
        elif record.opcode == mcap_source.UNREADABLE and record.end < len(source.data):
            self.lost += 1
        elif record.opcode == mcap_source.UNREADABLE:
            self.torn = len(raw)


def _write_metadata(folder: Path, files: list[_File], storage: str, recorded: Mapping[str, object]) -> None:
    """`metadata.yaml` of the whole bag, with what the old one or the files know of it."""
    topics: dict[str, Topic] = {}
    counts = topic_counts(file.seen for file in files)
    custom_data: dict[str, str] = {}
    distro = str(recorded.get("ros_distro") or "")
    for file in files:
        source = file.seen.source
        custom_data.update(source.custom_data)
        if isinstance(source, mcap_source.McapSource):  # "" is this one
            known = source.information.get("ros_distro") or source.metadata.get("rosbag2", {}).get("ROS_DISTRO")
            distro = distro or str(known or ("" if _is_own(source) else "unknown"))
        for topic in file.seen.topics.values():
            topics.setdefault(topic.name, typed(topic, recorded))
    information = bag_information(
        storage,
        [FileSpan(file.path.name, file.seen.start_ns, file.seen.end_ns, file.seen.count) for file in files],
        [(topic, counts[name]) for name, topic in topics.items()],
        custom_data | text_values(recorded.get("custom_data")),
        distro=distro,
        compression=next((file.seen.compression for file in files if file.seen.compression), ""),
    )
    write_metadata(folder, information)
