# SPDX-License-Identifier: Apache-2.0
"""Many tasks at once on dask.distributed: on this machine's cores, or on whatever workers a scheduler has.

Without an address a cluster of this machine's cores is made for the occasion; with one, a scheduler that somebody
started is joined. Either way the same functions run with the same arguments, and in this process without any of it:
the results are the same, bit for bit. When a worker dies, dask gives its tasks to others.
"""

from __future__ import annotations

import importlib.util
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from typing import TYPE_CHECKING, Any, TypeVar

from iwm_power_manager.errors import ConfigError, IwmError

if TYPE_CHECKING:
    from distributed import Client

Item = TypeVar("Item")
Made = TypeVar("Made")

#: How long a scheduler may take to answer, s.
ANSWER_S = 10


def dask_setup(_: Any) -> None:
    """Leave Ctrl-C, which a terminal sends to all, to the study, which ends its workers; dask calls this in each."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def connected(scheduler: str | None, jobs: int) -> Iterator[Client]:
    """A client of a scheduler, or of a cluster of `jobs` processes with one thread each.

    Raises
    ------
    ConfigError
        Nobody answers at the address.
    """
    import dask
    from distributed import Client, LocalCluster

    dask.config.set({"distributed.comm.timeouts.connect": f"{ANSWER_S}s"})
    if scheduler is None:
        # The solver's threads would fight over the cores with the other workers.
        options = {"env": {"NUMBA_NUM_THREADS": "1"}, "silence_logs": 50, "dashboard_address": "127.0.0.1:0"}
        options["preload"] = __name__
        with (
            LocalCluster(n_workers=jobs, threads_per_worker=1, processes=True, **options) as cluster,
            Client(cluster) as client,
        ):
            yield client
        return
    try:
        client = Client(scheduler, timeout=ANSWER_S)
    except (OSError, ValueError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ConfigError("arguments", "--scheduler", f"{scheduler}: {reason}", "the address it prints") from None
    with client:
        yield client


def as_they_come(
    client: Client | None, function: Callable[[Item], Made], items: Sequence[Item]
) -> Iterator[tuple[int, Made]]:
    """Number of an item and what the function makes of it, as the workers are done; without a client in this process.

    Raises
    ------
    IwmError
        An item was lost with every worker that tried it.
    """
    if client is None:
        yield from enumerate(map(function, items))
        return
    from distributed import as_completed
    from distributed.scheduler import KilledWorker

    futures = client.map(function, items, pure=False)
    numbers = {future.key: number for number, future in enumerate(futures)}
    try:
        for future, made in as_completed(futures, with_results=True):
            yield numbers[future.key], made
    except KilledWorker as error:
        raise IwmError(f"a task was lost with every worker that tried it, out of memory? {error}") from None


def on_all_cores(
    function: Callable[[Item], Made], items: Sequence[Item], jobs: int, done: Callable[[Made], object] = lambda _: None
) -> list[Made]:
    """`[function(item) for item in items]`, on `jobs` processes; `done` hears of each as it is ready.

    Parameters
    ----------
    function : can be pickled, as can the items
    items : the longest first gives the least idle time at the end
    jobs : processes; 1 stays in this one
    """
    made: dict[int, Made] = {}
    workers = min(jobs, len(items))
    if workers > 1 and importlib.util.find_spec("distributed") is None:
        print("one core is used: distributed is not installed (pip install distributed)", file=sys.stderr)
        workers = 1
    with nullcontext(None) if workers <= 1 else connected(None, workers) as client:
        for number, result in as_they_come(client, function, items):
            made[number] = result
            done(result)
    return [made[number] for number in range(len(items))]
