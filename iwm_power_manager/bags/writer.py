# SPDX-License-Identifier: Apache-2.0
"""Write a rosbag2 bag: a folder of MCAP files with `metadata.yaml`, version 9. Needs no ROS.

Messages come as the CDR bytes they had on the wire and stay that. A bag is split into files by size or by duration;
each file carries every schema and the custom metadata, so that each can be read, or recovered, alone.
"""

from __future__ import annotations

import math
import os
import stat
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from functools import partial
from itertools import islice, starmap
from pathlib import Path
from typing import Any

from iwm_power_manager import __version__
from iwm_power_manager.bags import metadata
from iwm_power_manager.bags.mcap_file import COMPRESSIONS, McapFile
from iwm_power_manager.bags.mcap_source import RECORD_OVERHEAD_BYTES
from iwm_power_manager.errors import BagError, ConfigError, system_errors
from iwm_power_manager.files import atomic_write, sync_folder

#: One message: topic's number, log time (ns, when it was received and what readers sort by), CDR bytes with their
#: four bytes of encapsulation, publish time (ns, when it was sent), the publisher's counter (0 if unknown, < 2^32).
Sample = tuple[int, int, bytes, int, int]

LIBRARY = f"iwm_power_manager {__version__}"


@dataclass(frozen=True)
class WriterOptions:
    """How a bag is written.

    Attributes
    ----------
    compression : "none", "lz4" or "zstd", of each chunk
    chunk_bytes : uncompressed size at which a chunk is closed
    max_bytes : size at which a file is closed and the next begun; 0 for no limit
    max_duration_ns : the same by log time; 0 for no limit
    max_message_bytes : a larger message is refused
    """

    compression: str = "zstd"
    chunk_bytes: int = 786_432
    max_bytes: int = 0
    max_duration_ns: int = 0
    max_message_bytes: int = 64 * 1024 * 1024

    def __post_init__(self) -> None:
        if self.compression not in COMPRESSIONS:
            raise BagError(f"compression: {self.compression!r} is unknown; allowed: {' | '.join(COMPRESSIONS)}")
        for name, low in (("chunk_bytes", 1024), ("max_bytes", 0), ("max_duration_ns", 0), ("max_message_bytes", 1)):
            value = getattr(self, name)
            if value < low:
                raise BagError(f"{name}: {value} is too small; allowed: >= {low}")


class MessageTooLarge(BagError):
    """A message is larger than `WriterOptions.max_message_bytes`; it was not written, the bag is unharmed."""


class WriteFailed(BagError):
    """The disk is full, the folder is gone or the like: close the bag, which keeps what was written."""


class BagWriter(AbstractContextManager["BagWriter"]):
    """A new rosbag2 bag.

    Parameters
    ----------
    path : folder to create; an existing one is never touched
    options : compression, splits and limits
    custom_data : free text by key, for `custom_data` of the metadata
    disk : waits for the disk in the place of the writing methods, which go on meanwhile; None: they wait

    Raises
    ------
    BagError
        The folder exists or cannot be created.
    WriteFailed
        From every method that writes.
    """

    def __init__(
        self,
        path: Path | str,
        options: WriterOptions | None = None,
        custom_data: Mapping[str, str] | None = None,
        disk: Executor | None = None,
    ) -> None:
        self.path = Path(path)
        self.options = options or WriterOptions()
        self.custom_data = dict(custom_data or {})
        self._disk = disk
        self._disk_work: deque[Future[None]] = deque()
        self._topics: list[metadata.Topic] = []
        self._counts: Counter[int] = Counter()  # messages by topic, in closed files
        self._spans: list[metadata.FileSpan] = []
        self._closed = False
        self._closed_bytes = 0
        self._splits = self.options.max_bytes > 0 or self.options.max_duration_ns > 0
        self._fill = (0, 0)  # how large the file was, and what has been given to it since
        self._file_start_ns: int | None = None  # log time of its first message
        self._file: McapFile | None = None  # none once the bag is closed, or if the next file could not be opened
        if os.path.lexists(self.path):
            raise BagError(f"{self.path}: exists already and is not overwritten; choose another name")
        with system_errors(self.path, "cannot be created"):
            _make_folder(self.path)
        try:
            self._open_file()
        except BagError:
            with suppress(OSError):
                self.path.rmdir()  # it would be in the way of the next attempt
            raise

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def size_bytes(self) -> int:
        """What is on disk in all files of the bag."""
        return self._closed_bytes + (self._file.size_bytes if self._file else 0)

    @property
    def message_count(self) -> int:
        """Messages on disk; those of the chunk in memory are not counted yet."""
        return sum(span.message_count for span in self._spans) + (self._file.counts.total() if self._file else 0)

    @property
    def file_count(self) -> int:
        """Files of the bag so far."""
        return len(self._spans) + (1 if self._file else 0)

    def add_topic(self, topic: metadata.Topic) -> int:
        """Announce a topic; returns the number that `write` takes, from 1 on."""
        self._topics.append(topic)
        with self._failing():
            return announce(self._open, topic)

    def set_custom_data(self, values: Mapping[str, str]) -> None:
        """Add to the custom metadata, in the file at once."""
        self.custom_data.update(values)
        with self._failing():
            self._open.writer.add_metadata(metadata.CUSTOM_METADATA, dict(values))

    def write(
        self, topic: int, log_time_ns: int, data: bytes, publish_time_ns: int | None = None, sequence: int = 0
    ) -> None:
        """Write one message; arguments as in `Sample`, `publish_time_ns` None for the log time."""
        sent_ns = log_time_ns if publish_time_ns is None else publish_time_ns
        self.write_all(iter([(topic, log_time_ns, data, sent_ns, sequence)]), len(data))

    def write_all(self, samples: Iterator[Sample], largest: float = math.inf) -> None:
        """Write messages of at most `largest` bytes each, as far as that is known.

        After `MessageTooLarge` the iterator stands behind the message that was refused.
        """
        watched = self._splits or largest > self.options.max_message_bytes
        with self._failing():
            for sample in samples if watched else islice(samples, int(self._file_start_ns is None)):
                self._prepare(*sample[:2], len(sample[2]))
                self._add(*sample)
            deque(starmap(self._add, samples), 0)  # a topic's number is its channel's: nothing of ours stands between

    def _prepare(self, topic: int, log_time_ns: int, size: int) -> None:
        """Refuse a message that is too large; begin the next file, if the present one is full or old enough."""
        options, file = self.options, self._open
        if size > options.max_message_bytes:
            raise MessageTooLarge(
                f"{self.path}: {self._topics[topic - 1].name}: a message of {size} bytes was not written; "
                f"allowed: <= {options.max_message_bytes}"
            )
        given = self._fill[1] if self._fill[0] == file.size_bytes else 0
        if self._file_start_ns is not None and (
            0 < options.max_duration_ns <= log_time_ns - self._file_start_ns
            or 0 < options.max_bytes < file.size_bytes + given + size
        ):
            self.split()
            file, given = self._open, 0
        self._fill = (file.size_bytes, given + RECORD_OVERHEAD_BYTES + size)
        if self._file_start_ns is None:
            self._file_start_ns = log_time_ns

    def flush(self) -> None:
        """Bring everything given so far into the file: it then survives this process."""
        with self._failing():
            self._open.writer.flush()

    def sync(self, then: Callable[[], object]) -> None:
        """Have the disk take what is in the file, and call `then`; nothing is done while it is at earlier work."""
        with self._failing():
            self._check_disk()
            if not self._disk_work:
                self._on_disk(partial(_sync_file, self._open.path, then))

    def _on_disk(self, work: Callable[[], None]) -> None:
        """Have work done by whoever waits for the disk."""
        if self._disk is None:
            work()
        else:
            self._disk_work.append(self._disk.submit(work))

    def _check_disk(self, wait: bool = False) -> None:
        """Raise what the disk has said to earlier work."""
        while self._disk_work and (wait or self._disk_work[0].done()):
            self._disk_work.popleft().result()

    def split(self) -> None:
        """Close the current file and begin the next."""
        if self._file_start_ns is not None:
            self._finish_file(self._open)
            self._open_file()

    def close(self) -> None:
        """Close the file and write `metadata.yaml`. Closing twice does nothing."""
        if self._closed:
            return
        self._closed = True
        try:
            if self._file is not None:
                self._finish_file(self._file)
            with self._failing():
                self._check_disk(wait=True)
        finally:
            write_metadata(self.path, self._information(self._spans, self._counts))

    def _information(self, files: Sequence[metadata.FileSpan], counts: Counter[int]) -> dict[str, Any]:
        topics = [(topic, counts[number]) for number, topic in enumerate(self._topics, 1)]
        return metadata.bag_information("mcap", files, topics, self.custom_data)

    def abandon(self) -> None:
        """Close without index and metadata, as a crash would leave the bag (see `recover`)."""
        self._closed = True
        if self._file is not None:
            self._file.abandon()
            self._file = None

    @property
    def _open(self) -> McapFile:
        if self._file is None:
            raise WriteFailed(f"{self.path}: is closed, or its next file could not be created")
        return self._file

    def _failing(self) -> AbstractContextManager[None]:
        """What the disk says as what this bag says."""
        return system_errors(self.path, "cannot be written", WriteFailed)

    def _open_file(self) -> None:
        """Begin the next file; one that cannot take its definitions is removed again."""
        with self._failing():
            file = McapFile(
                self.path / f"{self.path.name}_{len(self._spans)}.mcap",
                library=LIBRARY,
                compression=self.options.compression,
                chunk_bytes=self.options.chunk_bytes,
            )
            try:
                self._on_disk(partial(sync_folder, self.path))
                if self.custom_data:
                    file.writer.add_metadata(metadata.CUSTOM_METADATA, self.custom_data)
                if [announce(file, topic) for topic in self._topics] != [*range(1, len(self._topics) + 1)]:
                    raise AssertionError("channels are numbered in the order they are announced")
            except OSError:
                file.abandon(remove=True)
                raise
        self._file, self._file_start_ns = file, None
        self._add = file.writer.add_message

    def _finish_file(self, file: McapFile) -> None:
        try:
            with self._failing():
                if not file.broken:
                    file.writer.flush()
                    information = self._information([file.span], file.counts)
                    file.writer.add_metadata("rosbag2", {"serialized_metadata": metadata.yaml_text(information)})
                    file.finish(sync=False)
                    self._on_disk(partial(_sync_file, file.path))
        finally:
            file.abandon()
            self._file = self._file_start_ns = None
            self._counts += file.counts
            self._spans.append(file.span)
            self._closed_bytes += file.size_bytes


def _sync_file(path: Path, then: Callable[[], object] = lambda: None) -> None:
    """Wait until the disk has what is in a file."""
    with path.open("rb") as file:
        os.fdatasync(file.fileno())
    then()


def _make_folder(path: Path) -> None:
    """Create a folder, and those above it that are missing, so that they survive a power cut."""
    missing = [folder for folder in path.parents if not folder.exists()]
    path.mkdir(parents=True)
    for folder in (path, *missing):
        sync_folder(folder.parent)


def announce(file: McapFile, topic: metadata.Topic) -> int:
    """Write a topic's schema and channel into a file; returns the channel's id."""
    definition = topic.definition.encode("utf-8", "surrogateescape")
    schema = file.schema_id(topic.type, topic.encoding, definition) if definition else 0
    qos = metadata.yaml_text(metadata.qos_entries(topic.qos)) if topic.qos else ""
    more = {"offered_qos_profiles": qos, "topic_type_hash": topic.type_hash}
    return file.writer.register_channel(topic.name, topic.serialization, schema, more)


def write_metadata(folder: Path, information: Mapping[str, Any]) -> None:
    """Write a bag's `metadata.yaml`; `WriteFailed` if it cannot be. What it says is of `metadata.bag_information`."""
    path = folder / metadata.METADATA_FILE
    try:
        with system_errors(path, "cannot be written", WriteFailed):
            if os.path.lexists(path) and not stat.S_ISREG(
                path.lstat().st_mode
            ):  # what a link leads to is not the bag's
                path.unlink()
            atomic_write(path, metadata.yaml_text({"rosbag2_bagfile_information": information}).encode())
    except ConfigError as error:
        raise WriteFailed(str(error)) from None
