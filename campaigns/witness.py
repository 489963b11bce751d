# SPDX-License-Identifier: Apache-2.0
"""A witness of what the machine did to a process: how long it stood still, and how long it let the process wait.

A deadline can be missed because the program took too long, or because it was not run: the operating system gave the
processor to somebody else, or, on a virtual machine, the host took the processor away. The witness tells the second
kind, in two ways. As long as the watched process wants to run, what it was not given is the time on the clock less the
processor time it used. But a host that takes a processor away does not always say so, and then the kernel books that
time as used by whoever was on it. So a process of the witness's own wakes on that processor every half a millisecond,
at a higher real-time priority: from the time it is to wake until it sleeps again nothing else runs there, whatever the
books say (test/sim/test_witness.py has a process that looks). Each time it does a little work that is always the same,
on some pages of memory, which tells when these were slow (`Witness.slowest_work_s`; nothing is deducted for that). The
same wake-ups tell what held the watched process up when it was to be woken itself.
"""

from __future__ import annotations

import gc
import itertools
import math
import os
import subprocess
import sys
import threading
import time
from array import array
from bisect import bisect_right
from collections.abc import Callable, Collection
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from campaigns import wake_ups
from iwm_power_manager.errors import IwmError

_TICK_S = 0.0005
#: Later than this is no ordinary wake-up: on an idle machine one of a thousand takes so long.
_LATE_S = 0.00025
#: How often the kernel is asked about the process.
_LOOK_S = 0.001
#: Above every other thread that asks for real time here; normal priority where that is refused.
_PRIORITY = 60
#: Written to at each wake-up, a byte of each page: memory can be slow when the processor is not.
_PAGE_BYTES, _PAGES = 4096, 16
#: Wake-ups are put away this often; there is room for half a minute of them.
_PUT_AWAY_S = 1.0
_RING_ROWS = 1 << 16
_REAL_TIME, _NORMAL = b"real-time\n", b"normal\n"


class Stall(NamedTuple):
    """A processor stood still: from when its witness was to wake until it did, much too late, wall-clock s."""

    begin_s: float
    end_s: float


class Look(NamedTuple):
    """What the kernel said about the watched process's main thread.

    Attributes
    ----------
    time_s : when, wall-clock s
    used_s : processor time used since its start
    sleeps : how often it has gone to sleep by itself since its start
    wants_to_run : it ran or waited for the processor; 0 or 1
    """

    time_s: float
    used_s: float
    sleeps: float
    wants_to_run: float


class Witness:
    """Watches processors, and the main thread of another process.

    Parameters
    ----------
    pid : process that is watched
    processors : those it may use; None: all that this process may use

    Attributes
    ----------
    processes : that watch: one for each processor, one for the watched process
    stalls : by processor, in the order of time; there once the witness has stopped, like all that follows
    withheld : by processor, shape (n, 2): times of which each wake-up of its witness kept everything else off it, from
        when it was due until it slept again, wall-clock s; empty without real-time priority
    work_s : by processor, shape (n,): how long the same little work took at each of these wake-ups
    looks : at the watched process, in the order of time
    real_time : the witnesses ran at real-time priority: what they missed, any other thread on their processor missed
    """

    def __init__(self, pid: int, processors: Collection[int] | None = None) -> None:
        self._pid = pid
        self._processors = sorted(os.sched_getaffinity(0) if processors is None else processors)
        self.processes: list[subprocess.Popen[bytes]] = []
        self.stalls: dict[int, list[Stall]] = {}
        self.withheld: dict[int, NDArray[np.float64]] = {}
        self.work_s: dict[int, NDArray[np.float64]] = {}
        self.looks: list[Look] = []
        self.real_time = True

    def __enter__(self) -> Self:
        """Begin to watch."""
        for what in (*(("processor", number) for number in self._processors), ("process", self._pid)):
            command = [sys.executable, "-m", "campaigns.witness", *map(str, what)]
            self.processes.append(subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE))
        for process in self.processes:
            assert process.stdout is not None
            self.real_time &= process.stdout.readline() != _NORMAL
        return self

    def __exit__(self, *_: object) -> None:
        """End watching; what was seen stays."""
        *by_processor, seen = (process.communicate()[0] for process in self.processes)
        for processor, numbers in zip(self._processors, by_processor, strict=True):
            rows_ns = np.frombuffer(numbers, dtype=np.int64).reshape(-1, wake_ups.COLUMNS)
            due_s, woke_s, work_s, slept_s = rows_ns.T / 1e9
            late = woke_s - due_s > _LATE_S
            self.stalls[processor] = [Stall(*pair) for pair in zip(due_s[late], woke_s[late], strict=True)]
            seen_by_all = slice(None if self.real_time else 0)
            self.withheld[processor] = np.column_stack([due_s, slept_s])[seen_by_all]
            self.work_s[processor] = work_s[seen_by_all]
        self.looks = [Look(*row) for row in np.frombuffer(seen).reshape(-1, len(Look._fields)).tolist()]

    def machine_s(self, begin_s: float, end_s: float) -> float:
        """Time between two wall-clock times that the machine took, s.

        As long as it wanted to run: what it was not given, or what was withheld from everything on its processor,
        whichever is longer, since either may be a part of the other. Where it woke: the stall it woke in, as far as it
        slept through it. Where it slept all the time: nothing. Where nobody looked: the stalls. Of a process that moves
        between processors it is the longest of what each says: it is on one at a time, and stalls of two would explain
        too much when added up.
        """
        return max((self._taken_s(processor, begin_s, end_s) for processor in self.stalls), default=0.0)

    def _taken_s(self, processor: int, begin_s: float, end_s: float) -> float:
        stalls = np.array(self.stalls[processor], dtype=float).reshape(-1, 2)
        total_s, reached_s = 0.0, begin_s
        running_since_s, used_s = math.nan, 0.0
        asleep_since_s: float | None = None
        first = max(bisect_right(self.looks, begin_s, key=lambda look: look.time_s) - 1, 0)
        for before, after in itertools.pairwise(self.looks[first:]):
            from_s, to_s = max(before.time_s, begin_s), min(after.time_s, end_s)
            if before.time_s >= end_s:
                break
            if to_s <= from_s:
                continue
            total_s += overlap_s(stalls, reached_s, from_s)
            reached_s = to_s
            slept = after.sleeps != before.sleeps
            if before.wants_to_run and not slept:
                asleep_since_s = None
                running_since_s = from_s if math.isnan(running_since_s) else running_since_s
                used_s += (after.used_s - before.used_s) * (to_s - from_s) / (after.time_s - before.time_s)
                continue
            total_s += self._kept_s(processor, running_since_s, from_s, used_s)
            running_since_s, used_s = math.nan, 0.0
            if not before.wants_to_run and not after.wants_to_run and not slept:
                asleep_since_s = from_s if asleep_since_s is None else asleep_since_s
            else:
                since_s = from_s if asleep_since_s is None else asleep_since_s
                # A stall that was over while it still slept held nothing up. Just after one, it has yet to be woken.
                lasting = stalls[stalls[:, 1] > from_s - _TICK_S]
                total_s += overlap_s(lasting, since_s, to_s)
                asleep_since_s = None
        total_s += self._kept_s(processor, running_since_s, reached_s, used_s)
        return total_s + overlap_s(stalls, reached_s, end_s)

    def _kept_s(self, processor: int, begin_s: float, end_s: float, used_s: float) -> float:
        """What the machine kept from the process while it wanted to run; 0 if it never began (NaN)."""
        if math.isnan(begin_s):
            return 0.0
        withheld = self.withheld.get(processor, np.empty((0, 2)))
        given_s = min(used_s, end_s - begin_s - overlap_s(withheld, begin_s, end_s))
        return end_s - begin_s - given_s

    def slowest_work_s(self, begin_s: float, end_s: float) -> tuple[float, float]:
        """How long the same little work took at most between two times, and how long it usually takes, s; else 0."""
        longest_s, usual_s = 0.0, 0.0
        for processor, work_s in self.work_s.items():
            withheld = self.withheld[processor]
            inside = work_s[np.searchsorted(withheld[:, 1], begin_s) : np.searchsorted(withheld[:, 0], end_s)]
            if inside.size and inside.max() > longest_s:
                longest_s, usual_s = float(inside.max()), float(np.median(work_s))
        return longest_s, usual_s

    def summary(self) -> str:
        """What the machine did, in words."""
        times = " and ".join(str(len(stalls)) for stalls in self.stalls.values()) or "no"
        lasted_s = [stall.end_s - stall.begin_s for stalls in self.stalls.values() for stall in stalls]
        priority = "real-time" if self.real_time else "normal"
        return (
            f"the processors stood still {times} times, {sum(lasted_s):.2f} s together, at most "
            f"{1000 * max(lasted_s, default=0.0):.1f} ms (seen at {priority} priority)"
        )


def overlap_s(spans: NDArray[np.float64], begin_s: float, end_s: float) -> float:
    """Time between `begin_s` and `end_s` that lies in spans: shape (n, 2), in the order of time, none in another."""
    near = spans[np.searchsorted(spans[:, 1], begin_s) : np.searchsorted(spans[:, 0], end_s)]
    return float(np.sum(np.maximum(np.minimum(near[:, 1], end_s) - np.maximum(near[:, 0], begin_s), 0.0)))


class Watch:
    """Wakes on the processor of the thread that runs it; another thread puts away what it wrote.

    Parameters
    ----------
    rows : wake-ups kept until they are put away
    """

    def __init__(self, rows: int = _RING_ROWS) -> None:
        # Written to once, so that no page has to be found while it watches.
        self._ring = np.ones((rows, wake_ups.COLUMNS), dtype=np.int64)
        self._state = np.zeros(2, dtype=np.int64)
        self._pages = np.ones(_PAGES * _PAGE_BYTES, dtype=np.uint8)[::_PAGE_BYTES]
        self._timespec = np.zeros(2, dtype=np.int64)
        self._kept: list[NDArray[np.int64]] = []
        self._put_away = 0
        self.stop()
        self.run()  # compiles
        self._state[:] = 0

    @property
    def count(self) -> int:
        """Wake-ups so far."""
        return int(self._state[wake_ups.COUNT])

    def run(self) -> None:
        """Watch until `stop`."""
        wake_ups.wake_up(self._ring, self._state, self._pages, self._timespec, round(_TICK_S * 1e9))

    def stop(self) -> None:
        """`run` returns at its next wake-up."""
        self._state[wake_ups.STOP] = 1

    def put_away(self) -> None:
        """Take what has been written since the last call; to be called before the ring is full.

        Raises
        ------
        IwmError
            It was called too late: wake-ups are lost.
        """
        count = self.count
        numbers = np.arange(self._put_away, count) % len(self._ring)
        self._kept.append(self._ring[numbers])
        if self.count - self._put_away > len(self._ring):
            raise IwmError("the witness's wake-ups were not put away in time")
        self._put_away = count

    def found(self) -> NDArray[np.int64]:
        """Everything put away, shape (n, COLUMNS)."""
        return np.concatenate(self._kept)


def _watch_process(pid: int, stopped: Callable[[], bool]) -> array[float]:
    """The columns of `Look`, row after row."""
    found = array("d")
    status, schedule = Path(f"/proc/{pid}/status"), Path(f"/proc/{pid}/schedstat")
    while not stopped():
        time.sleep(_LOOK_S)
        with suppress(OSError, ValueError, IndexError, KeyError):  # it has ended, or the kernel does not say
            values = dict(line.split(":", 1) for line in status.read_text().splitlines())
            used_ns = int(schedule.read_text().split()[0])
            now = time.time()
            row = (now, used_ns / 1e9, float(values["voluntary_ctxt_switches"]), float("R" in values["State"]))
            found.extend(row)
    return found


def _main() -> None:
    """`python -m campaigns.witness processor|process NUMBER`: watch until the input ends, then tell."""
    kind, number = sys.argv[1], int(sys.argv[2])
    gc.disable()
    ended = threading.Event()
    watch = Watch() if kind == "processor" else None

    def put_away() -> None:
        while not ended.wait(_PUT_AWAY_S):
            assert watch is not None
            watch.put_away()

    def await_end() -> None:
        sys.stdin.buffer.read()
        ended.set()
        if watch is not None:
            watch.stop()

    # Before this thread asks for one processor and priority, which the others must not have.
    threads = [threading.Thread(target=await_end, daemon=True)]
    if watch is not None:
        threads.append(threading.Thread(target=put_away, daemon=True))
    for thread in threads:
        thread.start()
    said = _REAL_TIME
    if watch is not None:
        os.sched_setaffinity(0, {number})
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    except OSError:
        said = _NORMAL
    sys.stdout.buffer.write(said)
    sys.stdout.buffer.flush()
    if watch is None:
        found = _watch_process(number, ended.is_set).tobytes()
    else:
        watch.run()
        threads[-1].join()
        watch.put_away()
        found = watch.found().tobytes()
    sys.stdout.buffer.write(found)


if __name__ == "__main__":
    with suppress(KeyboardInterrupt):  # Ctrl-C is for the process that asked; it sees this one end
        _main()
