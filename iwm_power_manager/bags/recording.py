# SPDX-License-Identifier: Apache-2.0
"""Recording: a bounded queue, a thread that writes, and a memory of the last seconds. Needs no ROS.

The thread that takes messages from DDS must never wait for a disk. It hands over batches with `put`, which never
blocks: what does not fit into the queue's memory is dropped and counted. Everything that changes the recording (a new
topic, start, stop, split, snapshot) goes through the same queue, in order with the messages.
"""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from iwm_power_manager.bags.metadata import Topic
from iwm_power_manager.bags.writer import BagWriter, MessageTooLarge, WriterOptions
from iwm_power_manager.errors import BagError

#: One message: topic number, log time (ns), CDR bytes, publish time (ns), the publisher's counter.
Sample = tuple[int, int, bytes, int, int]

#: Memory one queued message takes besides its bytes: the tuple, its integers, the bytes object's head.
SAMPLE_OVERHEAD_BYTES = 250

RECORDING, STOPPED, FAILED = "recording", "stopped", "failed"


@dataclass(frozen=True)
class RecordingOptions:
    """How a recording behaves.

    Attributes
    ----------
    writer : how bags are written
    flush_period_s : at most this long a message stays in memory before it is in the file
    sync : have the disk take the data at each flush, so that a power cut loses hardly more than a crash
    queue_bytes : memory for messages that wait to be written
    snapshot_s : seconds of messages kept in memory for `snapshot`; 0 for none
    snapshot_bytes : memory for them; the oldest go first
    """

    writer: WriterOptions = field(default_factory=WriterOptions)
    flush_period_s: float = 0.25
    sync: bool = True
    queue_bytes: int = 64 * 1024 * 1024
    snapshot_s: float = 0.0
    snapshot_bytes: int = 64 * 1024 * 1024


class RecordingStatus(NamedTuple):
    """What a recording has done so far. Counts run over all bags of this recording.

    Attributes
    ----------
    state : "recording", "stopped" or "failed"
    path : bag being written, or the last one ("" before the first)
    written : messages in files
    dropped_queue : messages dropped because the queue was full
    dropped_size : messages larger than the limit
    dropped_error : messages that came, or were in memory, when writing failed
    pending : messages in the queue and in the chunk in memory
    queue_bytes, queue_peak_bytes : memory the queue takes, and the most it took
    bytes_on_disk : of the current or last bag
    files : number of files of that bag
    disk_behind_s : what is older than this is on the disk and survives a power cut; 0 when all is, or without `sync`
    error : why the recording failed, one line
    """

    state: str
    path: str
    written: int
    dropped_queue: int
    dropped_size: int
    dropped_error: int
    pending: int
    queue_bytes: int
    queue_peak_bytes: int
    bytes_on_disk: int
    files: int
    disk_behind_s: float
    error: str


class Recording:
    """Writes the messages it is given to bags, from a thread of its own.

    Parameters
    ----------
    path : bag of the first start; each later start, and each snapshot, gets a name derived from it
    options : flush period, memory limits, compression
    custom_data : text for the metadata of every bag
    """

    def __init__(
        self, path: Path | str, options: RecordingOptions | None = None, custom_data: Mapping[str, str] | None = None
    ) -> None:
        self.path = Path(path)
        self.options = options or RecordingOptions()
        self.failed = threading.Event()
        self._custom_data = dict(custom_data or {})
        self._topic_count = 0
        self._announced: list[Topic] = []  # by the writing thread, in the order of their numbers
        self._wake = threading.Condition()
        self._queue: deque[list[Sample] | Callable[[], None]] = deque()
        self._queue_bytes = 0
        self._queue_count = 0
        self._queue_peak = 0
        self._dropped_queue = 0
        self._dropped_size = 0
        self._dropped_error = 0
        self._error = ""
        self._state = STOPPED
        self._writer: BagWriter | None = None
        self._given = 0  # messages given to the current bag
        self._written_before = 0  # messages in the bags before it
        self._status = RecordingStatus(STOPPED, "", 0, 0, 0, 0, 0, 0, 0, 0, 0, 0.0, "")
        self._starts = 0
        self._snapshots = 0
        self._memory: deque[Sample] = deque()
        self._memory_bytes = 0
        self._last_flush = time.monotonic()
        self._disk = ThreadPoolExecutor(1, "disk")
        self._syncing: Future[None] | None = None
        self._on_disk_until: float | None = None  # what was given before is on the disk; None while nothing is written
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="bag writer", daemon=True)
        self._thread.start()

    # --- called by the thread that takes messages -------------------------------------------------------------------

    def put(self, samples: list[Sample]) -> None:
        """Hand over messages in the order of their log times; never blocks."""
        if not samples:
            return
        size = sum(len(sample[2]) for sample in samples) + SAMPLE_OVERHEAD_BYTES * len(samples)
        with self._wake:
            if self._queue_bytes + size > self.options.queue_bytes:
                samples, size = self._fitting(samples)
                if not samples:
                    return
            self._queue.append(samples)
            self._queue_bytes += size
            self._queue_count += len(samples)
            self._queue_peak = max(self._queue_peak, self._queue_bytes)
            self._wake.notify()

    def _fitting(self, samples: list[Sample]) -> tuple[list[Sample], int]:
        room = self.options.queue_bytes - self._queue_bytes
        size = 0
        for count, sample in enumerate(samples):
            needed = len(sample[2]) + SAMPLE_OVERHEAD_BYTES
            if size + needed > room:
                self._dropped_queue += len(samples) - count
                return samples[:count], size
            size += needed
        return samples, size

    # --- called by anyone -------------------------------------------------------------------------------------------

    def add_topic(self, topic: Topic) -> int:
        """Announce a topic; returns the number its messages carry."""
        with self._wake:
            number = self._topic_count
            self._topic_count += 1
            self._queue.append(lambda: self._announce(topic))
            self._wake.notify()
        return number

    def start(self) -> Path:
        """Begin a bag; returns its path.

        Raises
        ------
        BagError
            One is being recorded already, or the bag cannot be created.
        """
        return self._call(self._start)

    def stop(self) -> Path:
        """Write what is queued, close the bag, return its path; `BagError` if none is being recorded."""
        return self._call(self._stop)

    def split(self) -> Path:
        """Close the current file of the bag and begin the next; returns the bag's path."""
        return self._call(self._split)

    def snapshot(self) -> Path:
        """Write the messages of the last `snapshot_s` seconds to a bag of their own; returns its path."""
        return self._call(self._snapshot)

    def add_custom_data(self, values: Mapping[str, str]) -> None:
        """Add to the metadata of this bag and the following ones; does not wait."""
        with self._wake:
            self._queue.append(lambda: self._add_custom_data(values))
            self._wake.notify()

    def close(self) -> None:
        """Write what is queued, close the bag if there is one, end the thread.

        Raises
        ------
        BagError
            The bag could not be closed properly.
        """
        if not self._thread.is_alive():
            return
        try:
            self._call(lambda: self._stop() if self._writer is not None else self.path)
        finally:
            with self._wake:
                self._closing = True
                self._wake.notify()
            self._thread.join()
            self._disk.shutdown()

    def status(self) -> RecordingStatus:
        """Counts and state now."""
        with self._wake:
            until = self._on_disk_until
            return self._status._replace(
                disk_behind_s=0.0 if until is None else time.monotonic() - until,
                dropped_queue=self._dropped_queue,
                pending=self._status.pending + self._queue_count,
                queue_bytes=self._queue_bytes,
                queue_peak_bytes=self._queue_peak,
            )

    # --- the writing thread -----------------------------------------------------------------------------------------

    def _call[T](self, command: Callable[[], T]) -> T:
        future: Future[T] = Future()

        def run() -> None:
            try:
                result = command()
            except BagError as error:
                self._publish()
                future.set_exception(error)
            else:
                self._publish()  # whoever waits for the command sees its effect in the status
                future.set_result(result)

        with self._wake:
            if self._closing:
                raise BagError("the recorder is closing")
            self._queue.append(run)
            self._wake.notify()
        return future.result()

    def _run(self) -> None:
        while True:
            with self._wake:
                if not self._queue and not self._closing:
                    self._wake.wait(self._until_flush())
                item = self._queue.popleft() if self._queue else None
                if item is None and self._closing:
                    return
            try:
                if callable(item):
                    item()
                elif item is not None:
                    self._take(item)
                if self._writer is not None and time.monotonic() - self._last_flush >= self.options.flush_period_s:
                    self._flush(self._writer)
            except Exception as error:  # noqa: BLE001 - a fault here must end as a failed recording, not in silence
                self._give_up(error)
            self._publish()

    def _give_up(self, error: Exception) -> None:
        self._error = f"internal error: {error!r}"
        if self._writer is not None:
            self._fail(self._writer, BagError(self._error))
        self._state = FAILED
        self.failed.set()

    def _publish(self) -> None:
        writer = self._writer
        with self._wake:
            self._status = self._status._replace(
                state=self._state,
                written=self._written_before + (writer.message_count if writer else 0),
                dropped_size=self._dropped_size,
                dropped_error=self._dropped_error,
                pending=self._given - writer.message_count if writer else 0,
                error=self._error,
            )
            if writer is not None:
                self._status = self._status._replace(
                    path=str(writer.path), bytes_on_disk=writer.size_bytes, files=writer.file_count
                )

    def _until_flush(self) -> float | None:
        if self._writer is None:
            return None
        return max(0.0, self._last_flush + self.options.flush_period_s - time.monotonic())

    def _take(self, samples: list[Sample]) -> None:
        if self.options.snapshot_s > 0.0:
            self._remember(samples)
        writer = self._writer
        if writer is not None:
            self._write(writer, samples)
        elif self._state == FAILED:
            self._dropped_error += len(samples)
        with self._wake:
            self._queue_count -= len(samples)
            self._queue_bytes -= _size(samples)

    def _write(self, writer: BagWriter, samples: Iterable[Sample]) -> None:
        write = writer.write
        remaining = iter(samples)
        given = 0
        try:
            while True:
                try:
                    for sample in remaining:
                        given += 1
                        write(*sample)
                    break
                except MessageTooLarge as error:
                    given -= 1
                    self._dropped_size += 1
                    self._error = str(error)
            self._given += given
        except BagError as error:
            self._given += given
            self._dropped_error += sum(1 for _ in remaining)
            self._fail(writer, error)

    def _flush(self, writer: BagWriter) -> None:
        self._last_flush = time.monotonic()
        try:
            writer.flush()
            if self.options.sync:
                self._sync(writer)
        except BagError as error:
            self._fail(writer, error)

    def _sync(self, writer: BagWriter) -> None:
        """Have the disk take what is in the file, in a thread of its own.

        What is in the file survives the recorder, and a slow disk must not keep the next data from getting there.
        """
        if self._syncing is not None:
            if not self._syncing.done():
                return
            error = self._syncing.exception()
            self._syncing = None
            if error is not None:
                raise BagError(f"{writer.path}: the disk reports an error: {error}")
        self._syncing = self._disk.submit(self._sync_and_close, writer.duplicate_descriptor(), time.monotonic())

    def _sync_and_close(self, descriptor: int, until: float) -> None:
        """Run by the disk's thread: what was in the file at `until` is on the disk afterwards."""
        try:
            os.fdatasync(descriptor)
        finally:
            os.close(descriptor)
        with self._wake:
            if self._on_disk_until is not None:
                self._on_disk_until = max(self._on_disk_until, until)

    def _fail(self, writer: BagWriter, error: BagError) -> None:
        with suppress(BagError):
            writer.close()
        self._dropped_error += self._given - writer.message_count
        self._error = str(error)
        self._leave(writer, FAILED)
        self.failed.set()

    def _leave(self, writer: BagWriter, state: str) -> None:
        self._state = state
        with self._wake:
            self._on_disk_until = None
        self._publish()
        self._written_before += writer.message_count
        self._given = 0
        self._writer = None

    def _announce(self, topic: Topic) -> None:
        self._announced.append(topic)
        if self._writer is not None:
            try:
                self._writer.add_topic(topic)
            except BagError as error:
                self._fail(self._writer, error)

    def _new_bag(self, path: Path) -> BagWriter:
        writer = BagWriter(path, self.options.writer, self._custom_data)
        for topic in self._announced:
            writer.add_topic(topic)
        return writer

    def _start(self) -> Path:
        if self._writer is not None:
            raise BagError(f"{self._writer.path}: is being recorded already")
        path = self.path if self._starts == 0 else _free_name(self.path, "", self._starts)
        self._writer = self._new_bag(path)
        self._starts += 1
        self._state = RECORDING
        self._error = ""
        self._last_flush = time.monotonic()
        if self.options.sync:
            with self._wake:
                self._on_disk_until = self._last_flush
        return path

    def _recorded(self) -> BagWriter:
        if self._writer is None:
            raise BagError("nothing is being recorded" + (f": {self._error}" if self._state == FAILED else ""))
        return self._writer

    def _stop(self) -> Path:
        writer = self._recorded()
        try:
            writer.close()
        except BagError as error:
            self._fail(writer, error)
            raise
        self._leave(writer, STOPPED)
        return writer.path

    def _split(self) -> Path:
        writer = self._recorded()
        try:
            writer.split()
        except BagError as error:
            self._fail(writer, error)
            raise
        return writer.path

    def _add_custom_data(self, values: Mapping[str, str]) -> None:
        self._custom_data.update(values)
        if self._writer is not None:
            try:
                self._writer.set_custom_data(values)
            except BagError as error:
                self._fail(self._writer, error)

    def _remember(self, samples: list[Sample]) -> None:
        memory = self._memory
        memory.extend(samples)
        self._memory_bytes += _size(samples)
        oldest = samples[-1][1] - int(self.options.snapshot_s * 1e9)
        while memory and (memory[0][1] < oldest or self._memory_bytes > self.options.snapshot_bytes):
            self._memory_bytes -= len(memory.popleft()[2]) + SAMPLE_OVERHEAD_BYTES

    def _snapshot(self) -> Path:
        if self.options.snapshot_s <= 0.0:
            raise BagError("no messages are kept for a snapshot; set snapshot_s above 0")
        self._snapshots += 1
        path = _free_name(self.path, "snapshot_", self._snapshots)
        with self._new_bag(path) as bag:
            for sample in self._memory:
                with suppress(MessageTooLarge):
                    bag.write(*sample)
        return path


def _size(samples: Iterable[Sample]) -> int:
    return sum(len(sample[2]) + SAMPLE_OVERHEAD_BYTES for sample in samples)


def _free_name(path: Path, kind: str, number: int) -> Path:
    """First of `<path>_<kind><number>`, counting up, that does not exist."""
    while (candidate := path.with_name(f"{path.name}_{kind}{number}")).exists():
        number += 1
    return candidate
