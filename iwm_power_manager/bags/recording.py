# SPDX-License-Identifier: Apache-2.0
"""Recording: a bounded queue, a thread that writes, and a memory of the last seconds. Needs no ROS.

The thread that takes messages from DDS must never wait for a disk. It hands over batches with `put`, which never
blocks: what does not fit into the queue's memory is dropped and counted. Everything that changes the recording (a new
topic, start, stop, split, snapshot) goes through the same queue, in order with the messages.
"""

from __future__ import annotations

import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from operator import itemgetter
from pathlib import Path

from iwm_power_manager.bags.limits import MESSAGE_OVERHEAD_BYTES
from iwm_power_manager.bags.metadata import Topic
from iwm_power_manager.bags.writer import BagWriter, MessageTooLarge, Sample, WriteFailed, WriterOptions
from iwm_power_manager.errors import BagError

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


@dataclass
class RecordingStatus:
    """What a recording has done so far. Counts run over all bags of this recording.

    Attributes
    ----------
    state : "recording", "stopped" or "failed"
    path, bytes_on_disk, files : bag being written, or the last one ("" before the first), its size and files
    written : messages in files
    dropped_queue : messages dropped because the queue was full
    dropped_size : messages larger than the limit
    dropped_error : messages that came, or were in memory, when writing failed
    pending : messages in the queue and in the chunk in memory
    queue_bytes, queue_peak_bytes : memory the queue takes, and the most it took
    disk_behind_s : what is older than this is on the disk and survives a power cut; 0 when all is, or without `sync`
    error : why the recording failed, one line
    """

    state: str = STOPPED
    path: str = ""
    written: int = 0
    dropped_queue: int = 0
    dropped_size: int = 0
    dropped_error: int = 0
    pending: int = 0
    queue_bytes: int = 0
    queue_peak_bytes: int = 0
    bytes_on_disk: int = 0
    files: int = 0
    disk_behind_s: float = 0.0
    error: str = ""


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
        self._lock = threading.Lock()
        self._queue: queue.SimpleQueue[Callable[[], object]] = queue.SimpleQueue()
        self._queue_count = 0  # messages in it
        self._status = RecordingStatus()  # of which `written` counts the bags before the current one
        self._writer: BagWriter | None = None
        self._last: BagWriter | None = None  # the bag being written, or the one before
        self._given = 0  # messages given to the current bag
        self._starts = self._snapshots = 0
        self._memory: deque[Sample] = deque()
        self._memory_bytes = 0
        self._next_flush = 0.0
        self._disk = ThreadPoolExecutor(1, "disk")
        self._on_disk_until: float | None = None  # what was given before is on the disk; None while nothing is written
        self._closing = self._closed = False
        self._thread = threading.Thread(target=self._run, name="bag writer", daemon=True)
        self._thread.start()

    # --- called by the thread that takes messages -------------------------------------------------------------------

    def put(self, samples: list[Sample]) -> None:
        """Hand over messages in the order of their log times, and their list; never blocks."""
        size = _size(samples)
        status = self._status
        with self._lock:
            while samples and status.queue_bytes + size > self.options.queue_bytes:
                size -= _size([samples.pop()])
                status.dropped_queue += 1
            status.queue_bytes += size
            self._queue_count += len(samples)
            status.queue_peak_bytes = max(status.queue_peak_bytes, status.queue_bytes)
        if samples:
            self._queue.put(partial(self._take, samples, size))

    # --- called by anyone -------------------------------------------------------------------------------------------

    def add_topic(self, topic: Topic) -> int:
        """Announce a topic; returns the number its messages carry, from 1 on."""
        with self._lock:
            self._topic_count += 1
            self._enqueue(partial(self._announce, topic))
            return self._topic_count

    def add_custom_data(self, values: Mapping[str, str]) -> None:
        """Add to the metadata of this bag and the following ones; does not wait."""
        self._enqueue(partial(self._add_custom_data, values))

    def start(self) -> Path:
        """Begin a bag; returns its path. `BagError` if one is being recorded already, or it cannot be created."""
        return self.call(self._start)

    def stop(self) -> Path:
        """Write what is queued, close the bag, return its path; `BagError` if none is being recorded."""
        return self.call(self._stop)

    def split(self) -> Path:
        """Close the current file of the bag and begin the next; returns the bag's path."""
        return self.call(self._split)

    def snapshot(self) -> Path:
        """Write the messages of the last `snapshot_s` seconds to a bag of their own; returns its path."""
        return self.call(self._snapshot)

    def close(self) -> None:
        """Write what is queued, close the bag if there is one, end the thread; `BagError` if it could not be closed."""
        if not self._thread.is_alive():
            return
        try:
            self.call(lambda: self._stop() if self._writer is not None else self.path)
        finally:
            self._closing = True
            self._queue.put(self._end)
            self._thread.join()
            self._disk.shutdown()

    def status(self) -> RecordingStatus:
        """Counts and state now."""
        with self._lock:
            writer, last, until = self._writer, self._last, self._on_disk_until
            written = writer.message_count if writer else 0
            return replace(
                self._status,
                path=str(last.path) if last else "",
                written=self._status.written + written,
                pending=max(self._given - written, 0) + self._queue_count,
                bytes_on_disk=last.size_bytes if last else 0,
                files=last.file_count if last else 0,
                disk_behind_s=0.0 if until is None else time.monotonic() - until,
            )

    # --- the writing thread -----------------------------------------------------------------------------------------

    def _enqueue(self, command: Callable[[], object]) -> None:
        if self._closing:
            raise BagError("the recorder is closing")
        self._queue.put(command)

    def call[T](self, command: Callable[[], T]) -> T:
        """Run something in the writing thread, behind all that was put; returns what it returns, or raises it."""
        future: Future[T] = Future()

        def run() -> None:
            try:
                future.set_result(command())
            except Exception as error:  # noqa: BLE001 - whoever waits for the command gets it, and sees it in the status
                if isinstance(error, WriteFailed) or not isinstance(error, BagError):
                    self._fail(error)
                future.set_exception(error)

        self._enqueue(run)
        return future.result()

    def _run(self) -> None:
        while not self._closed:
            wait_s = None if self._writer is None else max(0.0, self._next_flush - time.monotonic())
            try:
                with suppress(queue.Empty):
                    self._queue.get(timeout=wait_s)()
                if self._writer is not None and time.monotonic() >= self._next_flush:
                    self._flush(self._writer)
            except Exception as error:  # noqa: BLE001 - a fault here must end as a failed recording, not in silence
                self._fail(error)

    def _end(self) -> None:
        self._closed = True

    def _take(self, samples: list[Sample], size: int) -> None:
        with self._lock:
            self._queue_count -= len(samples)
            self._status.queue_bytes -= size
        if self.options.snapshot_s > 0.0:
            self._remember(samples, size)
        if self._writer is None:
            self._status.dropped_error += len(samples) if self._status.state == FAILED else 0
            return
        self._given += len(samples)
        remaining = iter(samples)
        while True:
            try:
                self._writer.write_all(remaining, size)
                return
            except MessageTooLarge as error:
                self._given -= 1
                self._status.dropped_size += 1
                self._status.error = str(error)

    def _flush(self, writer: BagWriter) -> None:
        """Bring what was given into the file, and have the disk take it, in a thread of its own.

        What is in the file survives the recorder, and a slow disk must not keep the next data from getting there.
        """
        now = time.monotonic()
        self._next_flush = now + self.options.flush_period_s
        writer.flush()
        if self.options.sync:
            writer.sync(lambda: self._reached(now))

    def _reached(self, until: float) -> None:
        """What was in the file at `until` is on the disk (said by the disk's thread)."""
        with self._lock:
            if self._on_disk_until is not None:
                self._on_disk_until = max(self._on_disk_until, until)

    def _fail(self, error: Exception) -> None:
        """End the recording; what is in the file stays."""
        writer = self._writer
        if writer is not None:
            with suppress(BagError):
                writer.close()
            self._status.dropped_error += self._given - writer.message_count
            self._leave(writer)
        self._status.error = str(error) if isinstance(error, BagError) else f"internal error: {error!r}"
        self._status.state = FAILED
        self.failed.set()

    def _leave(self, writer: BagWriter) -> None:
        with self._lock:
            self._status.state = STOPPED
            self._on_disk_until = None
            self._status.written += writer.message_count
            self._given = 0
            self._writer = None

    def _announce(self, topic: Topic) -> None:
        self._announced.append(topic)
        if self._writer is not None:
            self._writer.add_topic(topic)

    def _add_custom_data(self, values: Mapping[str, str]) -> None:
        self._custom_data.update(values)
        if self._writer is not None:
            self._writer.set_custom_data(values)

    def _new_bag(self, path: Path) -> BagWriter:
        writer = BagWriter(path, self.options.writer, self._custom_data, self._disk)
        for topic in self._announced:
            writer.add_topic(topic)
        return writer

    def _start(self) -> Path:
        if self._writer is not None:
            raise BagError(f"{self._writer.path}: is being recorded already")
        path = self.path if self._starts == 0 else _free_name(self.path, "", self._starts)
        try:
            writer = self._new_bag(path)
        except WriteFailed as error:
            raise BagError(str(error)) from None  # nothing has begun that could fail
        self._starts += 1
        self._next_flush = time.monotonic() + self.options.flush_period_s
        with self._lock:
            self._writer = self._last = writer
            self._status.state, self._status.error = RECORDING, ""
            self._on_disk_until = time.monotonic() if self.options.sync else None
        return path

    def _recorded(self) -> BagWriter:
        if self._writer is None:
            why = f": {self._status.error}" if self._status.state == FAILED else ""
            raise BagError(f"nothing is being recorded{why}")
        return self._writer

    def _stop(self) -> Path:
        writer = self._recorded()
        writer.close()
        self._leave(writer)
        return writer.path

    def _split(self) -> Path:
        writer = self._recorded()
        writer.split()
        return writer.path

    def _remember(self, samples: list[Sample], size: int) -> None:
        memory = self._memory
        memory.extend(samples)
        self._memory_bytes += size
        oldest = samples[-1][1] - int(self.options.snapshot_s * 1e9)
        while memory and (memory[0][1] < oldest or self._memory_bytes > self.options.snapshot_bytes):
            self._memory_bytes -= _size([memory.popleft()])

    def _snapshot(self) -> Path:
        if self.options.snapshot_s <= 0.0:
            raise BagError("no messages are kept for a snapshot; set snapshot_s above 0")
        self._snapshots += 1
        path = _free_name(self.path, "snapshot_", self._snapshots)
        try:
            with self._new_bag(path) as bag:
                most = self.options.writer.max_message_bytes
                bag.write_all((sample for sample in self._memory if len(sample[2]) <= most), most)
        except WriteFailed as error:
            raise BagError(str(error)) from None  # the bag that is being recorded is another
        return path


def _size(samples: Sequence[Sample]) -> int:
    return sum(map(len, map(itemgetter(2), samples))) + MESSAGE_OVERHEAD_BYTES * len(samples)


def _free_name(path: Path, kind: str, number: int) -> Path:
    """First of `<path>_<kind><number>`, counting up, that does not exist."""
    while (candidate := path.with_name(f"{path.name}_{kind}{number}")).exists():
        number += 1
    return candidate
