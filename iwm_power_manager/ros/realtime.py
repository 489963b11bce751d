# SPDX-License-Identifier: Apache-2.0
"""Keeping other work off the control path: garbage collection, scheduling, affinity, memory.

Everything here is asked of the operating system and may be refused; what was refused is returned as text, so that the
node can warn and go on.
"""

from __future__ import annotations

import ctypes
import gc
import os
import threading
from collections.abc import Callable

_MCL_CURRENT, _MCL_FUTURE = 1, 2


def parse_affinity(text: str) -> set[int]:
    """Processors named in a list such as "0,2"; empty for "".

    Raises
    ------
    ValueError
        The text is no such list; the message says so.
    """
    try:
        processors = {int(part) for part in text.split(",")} if text.strip() else set()
    except ValueError:
        raise ValueError(f"{text!r} is no list of processors such as '0,2'") from None
    if any(processor < 0 for processor in processors):
        raise ValueError(f"{text!r} has a negative processor")
    return processors


def stop_automatic_collection() -> None:
    """Collect once, exempt all that lives now from later collections, and never collect by surprise again.

    A full collection of a process that has numba loaded takes some 50 ms; of what has come since `gc.freeze`, well
    under one. `collect` has to be called now and then, at a time that suits.
    """
    gc.collect()
    gc.freeze()
    gc.disable()


def keep() -> None:
    """Exempt what has come since `stop_automatic_collection` from later collections, too."""
    gc.freeze()


def collect() -> None:
    """Collect what has become garbage since `stop_automatic_collection`."""
    gc.collect()


def resume_automatic_collection() -> None:
    """Undo `stop_automatic_collection`."""
    gc.enable()
    gc.unfreeze()


def request(priority: int, processors: set[int], lock_memory: bool) -> list[str]:
    """Ask for a SCHED_FIFO priority (0: not), processors (empty: all) and locked memory for this process.

    The calling thread gets the priority, all others, which are those of DDS, one less: they do not delay it, but what
    it waits for, a lock that one of them holds, does not wait behind the whole rest of the system either.

    Returns
    -------
    what was refused, in words; empty if nothing was
    """
    refused = []
    if processors and (problem := _for_every_thread(lambda thread: os.sched_setaffinity(thread, processors))):
        refused.append(f"CPU affinity {sorted(processors)}: {problem}")
    if priority:
        caller, other = os.sched_param(priority), os.sched_param(max(priority - 1, 1))

        def schedule(thread: int) -> None:
            os.sched_setscheduler(thread, os.SCHED_FIFO, caller if thread == threading.get_native_id() else other)

        if problem := _for_every_thread(schedule):
            refused.append(f"SCHED_FIFO priority {priority}: {problem}")
    if lock_memory:
        libc = ctypes.CDLL(None, use_errno=True)
        if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE) != 0:
            refused.append(f"locked memory: {os.strerror(ctypes.get_errno())}")
    return refused


def give_up_priority() -> None:
    """Every thread of this process back to the scheduling of ordinary programs."""
    _for_every_thread(lambda thread: os.sched_setscheduler(thread, os.SCHED_OTHER, os.sched_param(0)))


def _for_every_thread(ask: Callable[[int], None]) -> str:
    """Ask something for every thread of this process; the first refusal in words, "" if there was none."""
    for name in os.listdir("/proc/self/task"):
        try:
            ask(int(name))
        except ProcessLookupError:
            pass  # it has just ended
        except OSError as error:
            return str(error.strerror)
    return ""
