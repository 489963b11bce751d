# SPDX-License-Identifier: Apache-2.0
"""Leaving DDS in bounded time: what a node still owes is done, and nothing its middleware does may keep it alive.

A participant of Fast DDS that is destroyed while it hears of another one can wait for ever, turning in a loop that
hardly lets the other thread go on and holds the interpreter's lock meanwhile (Fast-DDS issue 6513; where its C++
library has no `pthread_cond_clockwait`, as in the wheels). A node that has commanded zero torque, or closed its bag,
must end all the same.
"""

from __future__ import annotations

import ctypes
import gc
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import rclpy

from iwm_power_manager.ros import realtime

#: Leaving takes less than 0.1 s on an idle machine; on one with far too much to do, a second or two. Launch waits 5 s
#: before it calls a node that was asked to end unresponsive: time enough for this, and for `SHORT_S` before and after.
LIMIT_S = 3.0
#: For what comes before and after leaving DDS, each; and for all of it where nothing was begun that has to end well.
SHORT_S = 0.9

_CLOCK_MONOTONIC, _SIGEV_THREAD = 1, 2


class _Value(ctypes.Union):
    _fields_ = (("number", ctypes.c_int), ("pointer", ctypes.c_void_p))


class _Event(ctypes.Structure):
    """`struct sigevent` of Linux on machines of 64 bits."""

    _fields_ = (
        ("value", _Value),
        ("signal", ctypes.c_int),
        ("notify", ctypes.c_int),
        ("function", ctypes.c_void_p),
        ("attributes", ctypes.c_void_p),
        ("padding", ctypes.c_char * 32),
    )


class _Time(ctypes.Structure):
    _fields_ = (
        ("interval_s", ctypes.c_long),
        ("interval_ns", ctypes.c_long),
        ("value_s", ctypes.c_long),
        ("value_ns", ctypes.c_long),
    )


@contextmanager
def bounded(code: int, limit_s: float | None = None) -> Iterator[None]:
    """Leave DDS, after what the body of the `with` does; end the process if both take longer than allowed.

    Real-time priority is given up, and all threads get the same processor for that time: there, a thread that waits
    for a lock runs as soon as another one lets go of it, which ends the loop described above.

    Parameters
    ----------
    code : exit code of the process if it has to be ended; nothing is printed, no destructor runs then
    limit_s : longest time for the body, the shutdown of rclpy and the garbage in between; None: `LIMIT_S`
    """
    with suppress(BrokenPipeError):  # nobody reads it: `executables` has a word for that, and DDS is left all the same
        sys.stdout.flush()
    sys.stderr.flush()
    realtime.give_up_priority()
    limit_s = LIMIT_S if limit_s is None else limit_s
    with deadline(code, limit_s), one_processor():
        try:
            yield
        finally:
            # Nodes sit in reference cycles. What is left of them would be destroyed by the interpreter, unwatched.
            gc.unfreeze()
            gc.collect()
            rclpy.try_shutdown()


@contextmanager
def deadline(code: int, limit_s: float) -> Iterator[None]:
    """End the process with an exit code if the body of the `with` takes longer."""
    timer = _start_timer(code, limit_s)
    try:
        yield
    finally:
        if timer is not None:
            ctypes.CDLL(None).timer_delete(timer)


def at_exit(code: int) -> int:
    """What ends a process: the interpreter's own end, with what compiled libraries do in it, is bounded as well.

    Returns
    -------
    int
        The same exit code, for `sys.exit`.
    """
    _start_timer(code, SHORT_S)
    return code


def _start_timer(code: int, limit_s: float) -> ctypes.c_void_p | None:
    """Timer of the C library, whose thread calls `_exit`: no Python needed, since its lock may never be free again."""
    libc = ctypes.CDLL(None, use_errno=True)
    event = _Event(notify=_SIGEV_THREAD, function=ctypes.cast(libc._exit, ctypes.c_void_p))
    event.value.number = code
    timer = ctypes.c_void_p()
    if libc.timer_create(_CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer)) != 0:
        print(f"cannot bound the time of leaving DDS: {os.strerror(ctypes.get_errno())}", file=sys.stderr)
        return None
    seconds, rest = divmod(limit_s, 1.0)
    libc.timer_settime(timer, 0, ctypes.byref(_Time(value_s=int(seconds), value_ns=int(rest * 1e9))), None)
    return timer


@contextmanager
def one_processor() -> Iterator[None]:
    """All threads of this process on one of its processors, and afterwards where they were.

    For whoever destroys a participant of DDS and has more to do after that.
    """
    before: dict[int, set[int]] = {}
    for name in os.listdir("/proc/self/task"):
        with suppress(OSError):  # it has just ended, or may not be moved
            before[int(name)] = os.sched_getaffinity(int(name))
    allowed = sorted(os.sched_getaffinity(0))
    chosen = {allowed[os.getpid() % len(allowed)]}
    for thread in before:
        with suppress(OSError):
            os.sched_setaffinity(thread, chosen)
    try:
        yield
    finally:
        for thread, processors in before.items():
            with suppress(OSError):
                os.sched_setaffinity(thread, processors)
