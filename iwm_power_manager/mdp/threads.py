# SPDX-License-Identifier: Apache-2.0
"""Spread a kernel over the cores: separate ranges of its output, each written by one thread."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise

#: More ranges than threads, so that one slow range does not leave the other cores idle.
_RANGES_PER_THREAD = 6
#: Numbers to compute that are worth a range of their own: handing one over takes as long as some thousand of them.
_WORTH_A_RANGE = 16384


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="solver")


def over_ranges(size: int, numbers: int, function: Callable[[int, int], None]) -> None:
    """Call function(first, last) for consecutive ranges that cover 0..size; return when all are done.

    `function` calls a `parallel_kernel` whose output in a range depends on nothing written in another one: then the
    result is the same for any number of threads. `numbers` is how many it computes in all: few are not spread widely.
    """
    from numba import config

    # numba's count honours both the process's CPU affinity and NUMBA_NUM_THREADS.
    threads = config.NUMBA_NUM_THREADS
    count = min(size, threads * _RANGES_PER_THREAD, numbers // _WORTH_A_RANGE) if threads > 1 else 1
    if count <= 1:
        function(0, size)
        return
    ranges = iter(list(pairwise(size * i // count for i in range(count + 1))))

    def work() -> None:
        for low, high in ranges:  # each range goes to one of the threads
            function(low, high)

    others = [_pool(threads - 1).submit(work) for _ in range(min(threads, count) - 1)]
    work()
    for other in others:
        if not other.cancel():  # one that never began has nothing left to do
            other.result()
