"""Make a valid bag of what a killed or starved recorder left on the disk.

Each file that has no proper end is written anew, message by message, with index and summary, and takes the place of
the damaged one; then `metadata.yaml` is made. The original is kept, as `<name>.damaged`, if a part in its middle could
not be read: what stands there is lost to us, but perhaps not to a specialist.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

from iwm_power_manager.bags.mcap_file import McapFile
from iwm_power_manager.bags.mcap_scan import McapScan
from iwm_power_manager.bags.metadata import CUSTOM_METADATA, METADATA_FILE, FileSpan, Topic
from iwm_power_manager.bags.reader import BagReader, custom_data_of, recording_order, topic_of
from iwm_power_manager.bags.writer import LIBRARY, announce, finish, span_of, write_metadata
from iwm_power_manager.errors import BagError


class FileRecovery(NamedTuple):
    """What became of one file.

    Attributes
    ----------
    name : file name
    rebuilt : it was written anew
    message_count : messages in it now
    damage : what was wrong with it; "" for a whole file
    discarded_bytes : torn bytes at its end
    lost_chunks : chunks in its middle that could not be read
    """

    name: str
    rebuilt: bool
    message_count: int
    damage: str
    discarded_bytes: int
    lost_chunks: int


class Recovery(NamedTuple):
    """What `recover` found and did.

    Attributes
    ----------
    path : the bag
    files : file by file
    missing : by topic, messages that the publisher's counter shows to be missing between the first and the last one
    start_ns, end_ns : log times the bag spans now
    metadata_written : `metadata.yaml` was missing or did not fit
    """

    path: Path
    files: list[FileRecovery]
    missing: dict[str, int]
    start_ns: int
    end_ns: int
    metadata_written: bool

    def lines(self) -> list[str]:
        """The report for the user."""
        total = sum(file.message_count for file in self.files)
        span = (self.end_ns - self.start_ns) * 1e-9
        out = [f"{self.path}: {total} messages over {span:.3f} s in {len(self.files)} file(s)"]
        for file in self.files:
            if not file.rebuilt:
                state = f"left out: {file.damage}" if file.damage else f"whole, {file.message_count} messages"
                out.append(f"  {file.name}: {state}")
                continue
            out.append(
                f"  {file.name}: {file.damage}; rebuilt with {file.message_count} messages, "
                f"{file.discarded_bytes} torn bytes at its end discarded"
            )
            if file.lost_chunks:
                out.append(
                    f"  {file.name}: {file.lost_chunks} chunk(s) unreadable; original kept as {file.name}.damaged"
                )
        for topic, count in sorted(self.missing.items()):
            out.append(f"  {topic}: {count} messages missing in between, by the publisher's counter")
        out.append("  metadata.yaml written" if self.metadata_written else "  nothing to recover")
        return out


def recover(path: Path | str) -> Recovery:
    """Make the MCAP bag in a folder valid; a bag that is valid already stays untouched.

    Raises
    ------
    BagError
        There is no such folder, no MCAP file in it, or no room for the rebuilt file.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise BagError(f"{folder}: is no folder" if folder.exists() else f"{folder}: does not exist")
    names = sorted(folder.glob("*.mcap"), key=recording_order)
    if not names:
        raise BagError(f"{folder}: holds no .mcap file")
    bag = _Bag()
    files = [_recover_file(name, bag) for name in names]
    if not bag.spans:
        raise BagError(f"{files[0].damage}; nothing to recover")
    stale = any(file.damage for file in files) or not _is_valid(folder)
    if stale:
        write_metadata(folder, bag.spans, bag.topics(), bag.custom_data)
    filled = [span for span in bag.spans if span.message_count]
    return Recovery(
        folder,
        files,
        bag.missing,
        min((span.start_ns for span in filled), default=0),
        max((span.end_ns for span in filled), default=0),
        stale,
    )


class _Bag:
    """What is known of the whole bag while its files are gone through."""

    def __init__(self) -> None:
        self.spans: list[FileSpan] = []
        self.custom_data: dict[str, str] = {}
        self.missing: dict[str, int] = {}
        self._topics: dict[str, Topic] = {}
        self._counts: dict[str, int] = {}
        self._last: dict[str, int] = {}

    def add(self, span: FileSpan, counts: dict[Topic, int]) -> None:
        """Count a file."""
        self.spans.append(span)
        for topic, count in counts.items():
            self._topics.setdefault(topic.name, topic)
            self._counts[topic.name] = self._counts.get(topic.name, 0) + count

    def topics(self) -> list[tuple[Topic, int]]:
        """All topics with their counts."""
        return [(topic, self._counts[name]) for name, topic in self._topics.items()]

    def note(self, topic: str, sequence: int) -> None:
        """Count what is missing before a message, by its publisher's counter."""
        last = self._last.get(topic, 0)
        if last and sequence > last + 1:
            self.missing[topic] = self.missing.get(topic, 0) + sequence - last - 1
        if sequence:
            self._last[topic] = sequence


def _recover_file(path: Path, bag: _Bag) -> FileRecovery:
    try:
        scan = McapScan(path)
    except BagError as error:
        return FileRecovery(path.name, False, 0, str(error), 0, 0)
    with scan:
        if not scan.channels:
            scan.read_definitions()
        topics = {number: topic_of(channel) for number, channel in scan.channels.items()}
        own = custom_data_of(scan)
        bag.custom_data.update(own)
        if not scan.damage:
            span, counts = _survey(path, scan)
            if not scan.damage:  # reading did not find any either
                bag.add(span, {topics[number]: counts.get(number, 0) for number in topics})
                return FileRecovery(path.name, False, span.message_count, "", 0, 0)
        damage, torn_bytes = scan.damage, scan.size_bytes - scan.end_offset
        file, written = _rebuild(path, scan, topics, own, bag)
        bag.add(span_of(file)._replace(name=path.name), written)
        return FileRecovery(path.name, True, file.message_count, damage, torn_bytes, scan.lost_chunks)


def _survey(path: Path, scan: McapScan) -> tuple[FileSpan, dict[int, int]]:
    counts: dict[int, int] = {}
    for _, number, _, _, _ in scan.messages():
        counts[number] = counts.get(number, 0) + 1
    return FileSpan(path.name, scan.start_ns, scan.end_ns, sum(counts.values())), counts


def _rebuild(
    path: Path, scan: McapScan, topics: dict[int, Topic], custom_data: dict[str, str], bag: _Bag
) -> tuple[McapFile, dict[Topic, int]]:
    """Write what `scan` can read to a new file, and put that in the place of the old one."""
    temporary = path.with_name(path.name + ".recovering")
    scan.lost_chunks = 0
    try:
        temporary.unlink(missing_ok=True)
        file = McapFile(temporary, library=LIBRARY)
        try:
            if custom_data:
                file.add_metadata(CUSTOM_METADATA, custom_data)
            channels = {number: announce(file, topic) for number, topic in topics.items()}
            for log_time, number, data, publish_time, sequence in scan.messages():
                if number in channels:
                    bag.note(topics[number].name, sequence)
                    file.write(channels[number], log_time, publish_time, sequence, data)
            finish(file, [(topics[number], channel) for number, channel in channels.items()], custom_data)
        except BaseException:
            file.abandon()
            temporary.unlink(missing_ok=True)
            raise
        if scan.lost_chunks:
            os.replace(path, path.with_name(path.name + ".damaged"))
        os.replace(temporary, path)
    except OSError as error:
        raise BagError(f"{temporary}: cannot be written: {error.strerror or error}") from None
    return file, {topics[number]: file.channel_counts[channel] for number, channel in channels.items()}


def _is_valid(folder: Path) -> bool:
    """Whether the metadata is there and speaks of files that are."""
    if not (folder / METADATA_FILE).is_file():
        return False
    with BagReader(folder) as bag:
        return not bag.damage
