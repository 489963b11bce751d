# SPDX-License-Identifier: Apache-2.0
"""Waking up on time, again and again, and writing down when: the loop of a witness that watches a processor.

Compiled, because it shares the processor with what is watched: each wake-up of an interpreter would touch some hundred
pages of memory that a busy host may first have to find again, and keep the watched process waiting meanwhile.
"""

from __future__ import annotations

import numpy as np
from numba import types
from numpy.typing import NDArray

from iwm_power_manager.jit import parallel_kernel

#: Columns of a wake-up, wall-clock ns but for the third: due, woken, time its work took, asleep again.
DUE, WOKE, WORK, SLEPT = range(4)
COLUMNS = 4
#: Entries of the state: not 0 to end the loop; wake-ups so far.
STOP, COUNT = range(2)

_REALTIME, _MONOTONIC, _ABSOLUTE = 0, 1, 1
_NS_PER_S = 1_000_000_000
_int, _time = types.int32, types.CPointer(types.int64)
#: Of the C library; a `struct timespec` is two int64 wherever Python has 64 bits.
_clock_gettime = types.ExternalFunction("clock_gettime", _int(_int, _time))
_clock_nanosleep = types.ExternalFunction("clock_nanosleep", _int(_int, _int, _time, _time))


@parallel_kernel
def _now_ns(clock: int, timespec: NDArray[np.int64]) -> int:
    _clock_gettime(clock, timespec.ctypes)
    return timespec[0] * _NS_PER_S + timespec[1]


@parallel_kernel
def wake_up(
    ring: NDArray[np.int64],
    state: NDArray[np.int64],
    pages: NDArray[np.uint8],
    timespec: NDArray[np.int64],
    tick_ns: int,
) -> None:
    """Wake every `tick_ns` until `state[STOP]` is set, and write down each time; runs without the interpreter's lock.

    Parameters
    ----------
    ring : wake-up number `i` is written to row `i` modulo their number, shape (rows, COLUMNS)
    state : STOP and COUNT, shape (2,)
    pages : each byte is written to at each wake-up: the work that is timed
    timespec : memory for the C library, shape (2,)
    tick_ns : between two times that are due; those it slept or was held up through are left out
    """
    due_ns = _now_ns(_MONOTONIC, timespec)
    while state[STOP] == 0:
        due_ns += tick_ns
        woke_ns = _now_ns(_MONOTONIC, timespec)
        while woke_ns < due_ns:  # a signal wakes too early
            timespec[0], timespec[1] = due_ns // _NS_PER_S, due_ns % _NS_PER_S
            _clock_nanosleep(_MONOTONIC, _ABSOLUTE, timespec.ctypes, timespec.ctypes)
            woke_ns = _now_ns(_MONOTONIC, timespec)
        wall_ns = _now_ns(_REALTIME, timespec)
        row = ring[state[COUNT] % len(ring)]
        row[DUE], row[WOKE] = wall_ns - (woke_ns - due_ns), wall_ns
        pages += np.uint8(1)
        row[WORK] = _now_ns(_REALTIME, timespec) - wall_ns
        # Stays on the grid: of a stall that follows at once, as little as possible is slept through.
        due_ns += (woke_ns - due_ns) // tick_ns * tick_ns
        row[SLEPT] = _now_ns(_REALTIME, timespec)
        state[COUNT] += 1
