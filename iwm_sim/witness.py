"""A witness of what the machine did to a process: how long it stood still, and how long it let the process wait.

A deadline can be missed because the program took too long, or because it was not run: the operating system gave the
processor to somebody else, or, on a virtual machine, the host took the processor away. The witness tells the second
kind. On each processor a thread sleeps from millisecond to millisecond, at real-time priority where that is allowed:
when it wakes too late, nothing else can have run on that processor either. And the kernel says how long the watched
process was ready to run and was not let.
"""

from __future__ import annotations

import os
import threading
import time
from array import array
from bisect import bisect_left, bisect_right
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

_TICK_S = 0.001
#: Above every other thread that asks for real time here; normal priority where that is refused.
_PRIORITY = 60


class Stall(NamedTuple):
    """A processor stood still: from when its witness was to wake until it did, wall-clock s."""

    begin_s: float
    end_s: float


class Witness:
    """Watches every processor this process may use, and the main thread of another process.

    Parameters
    ----------
    pid : process that is watched

    Attributes
    ----------
    stalls : by processor, in the order of time
    times_s, waited_s : when the process was looked at (wall-clock s), and how long it had then been ready to run but
        not running since its start, s
    real_time : the witnesses run at real-time priority: what they miss, any other thread on their processor misses
    """

    def __init__(self, pid: int) -> None:
        self._schedule = Path(f"/proc/{pid}/schedstat")
        self.stalls: dict[int, list[Stall]] = {}
        self.times_s = array("d")
        self.waited_s = array("d")
        self.real_time = True
        self._stopped = threading.Event()
        self._threads: list[threading.Thread] = []

    def start(self) -> None:
        """Begin to watch."""
        for index, processor in enumerate(sorted(os.sched_getaffinity(0))):
            self.stalls[processor] = []
            thread = threading.Thread(target=self._watch, args=(processor, index == 0), daemon=True)
            thread.start()
            self._threads.append(thread)

    def stop(self) -> None:
        """End watching; what was seen stays."""
        self._stopped.set()
        for thread in self._threads:
            thread.join()

    def machine_s(self, begin_s: float, end_s: float) -> float:
        """Time between two wall-clock times that the machine took, s.

        The longer of what the stalls of one processor took and what the process waited: a process that is to wake
        during a stall counts as waiting too.
        """
        stalled_s = max((_overlap_s(stalls, begin_s, end_s) for stalls in self.stalls.values()), default=0.0)
        if not self.times_s:
            return stalled_s
        first = max(bisect_right(self.times_s, begin_s) - 1, 0)
        last = min(bisect_left(self.times_s, end_s), len(self.times_s) - 1)
        return max(stalled_s, self.waited_s[last] - self.waited_s[first])

    def summary(self) -> str:
        """What the machine did, in words."""
        times = " and ".join(str(len(stalls)) for stalls in self.stalls.values()) or "no"
        longest_s = max((stall.end_s - stall.begin_s for stalls in self.stalls.values() for stall in stalls), default=0)
        priority = "real-time" if self.real_time else "normal"
        return (
            f"the processors stood still {times} times, at most {1000 * longest_s:.1f} ms (seen at {priority} priority)"
        )

    def _watch(self, processor: int, looks_at_process: bool) -> None:
        os.sched_setaffinity(0, {processor})  # of this thread
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
        except OSError:
            self.real_time = False
        due = time.monotonic()
        while not self._stopped.is_set():
            due += _TICK_S
            time.sleep(max(due - time.monotonic(), 0.0))
            behind = time.monotonic() - due
            if behind > _TICK_S:
                now = time.time()
                self.stalls[processor].append(Stall(now - behind, now))
                # Stays on the grid: of a stall that follows at once, as little as possible is slept through.
                due += behind - behind % _TICK_S
            if looks_at_process:
                with suppress(OSError, ValueError, IndexError):  # the process has ended, or the kernel does not say
                    waited_ns = int(self._schedule.read_text().split()[1])
                    self.times_s.append(time.time())
                    self.waited_s.append(waited_ns / 1e9)


def _overlap_s(stalls: list[Stall], begin_s: float, end_s: float) -> float:
    first = bisect_right(stalls, begin_s, key=lambda stall: stall.end_s)
    total_s = 0.0
    for stall in stalls[first:]:
        if stall.begin_s >= end_s:
            break
        total_s += min(stall.end_s, end_s) - max(stall.begin_s, begin_s)
    return total_s
