# SPDX-License-Identifier: Apache-2.0
"""Running a study on dask.distributed: batches out, rows in, written as they come.

Without an address a cluster of this machine's cores is made; with one, the study joins a scheduler that somebody
started, with whatever workers it has or gets. Either way the same functions run with the same arguments, and in this
process without any of it: the rows are the same, bit for bit. When a worker dies, dask gives its batches to others.
"""

from __future__ import annotations

import importlib.util
import math
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from typing import Any, NamedTuple

import dask
from distributed import Client, LocalCluster, as_completed
from distributed.scheduler import KilledWorker

from iwm_power_manager.errors import ConfigError, IwmError
from iwm_sim.fleet.store import Store
from iwm_sim.fleet.task import Batch, Given, Task, differences, fingerprint, work

#: How long a scheduler may take to answer, and the first of its workers to come, s.
ANSWER_S, FIRST_WORKER_S = 10, 120
#: Of work in a batch: beside it, what dask needs for one is nothing (docs/scale.md has the measurement).
BATCH_S = 2.0
#: The fewest, for the workers to finish together: a small study has smaller batches.
BATCHES_PER_WORKER = 20


class Summary(NamedTuple):
    """What a run did.

    Attributes
    ----------
    tasks : of them in all; `known` had rows from before
    batches, workers : they were done in, and by
    cpu_s, wall_s : of the workers' processors, for the tasks alone, and of the clock
    """

    tasks: int
    known: int
    batches: int
    workers: int
    cpu_s: float
    wall_s: float


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


def batched(tasks: Sequence[Task], seconds: float) -> list[tuple[Task, ...]]:
    """Tasks in batches of about so many seconds of work, neighbours together; the longest batches first."""
    batches: list[list[Task]] = []
    filled = seconds
    for task in tasks:
        if filled >= seconds:
            batches.append([])
            filled = 0.0
        batches[-1].append(task)
        filled += task.seconds
    return [tuple(batch) for batch in sorted(batches, key=lambda batch: -sum(task.seconds for task in batch))]


class Runner:
    """Does tasks and writes their rows.

    Parameters
    ----------
    store, given : the study's folder, and what it was begun with
    client : of the cluster; None does all in this process
    batch_s : seconds of work in a batch
    """

    def __init__(self, store: Store, given: Given, client: Client | None, batch_s: float = BATCH_S) -> None:
        self._store = store
        self._given = given
        self._client = client
        self._batch_s = batch_s

    def check_workers(self, say: Callable[[str], None]) -> None:
        """Wait for the first worker, and refuse one that computes other numbers; `say` hears who is there.

        Raises
        ------
        IwmError
            No worker came, or one has another code, library or processor with other numbers.
        """
        if self._client is None:
            return
        try:
            self._client.wait_for_workers(1, timeout=FIRST_WORKER_S)
        except TimeoutError:
            raise ConfigError("arguments", "--scheduler", "has no workers", "start some (docs/scale.md)") from None
        found = self._client.run(fingerprint)
        for worker, theirs in found.items():
            problem = differences(self._given.fingerprint, theirs)
            if problem:
                raise IwmError(f"worker {worker}: computes other numbers than this study: {problem}")
        dashboard = f"; dashboard: {self._client.dashboard_link}" if importlib.util.find_spec("bokeh") else ""
        say(f"{len(found)} workers, {', '.join(sorted({made['processor'] for made in found.values()}))}{dashboard}")

    def run(self, kind: type[Any], tasks: Sequence[Task], done: Callable[[int], object] = lambda _: None) -> Summary:
        """Do what has no rows yet; `done` hears of every so many tasks that are written."""
        started = time.perf_counter()
        left = self._store.missing(kind, tasks)
        done(len(tasks) - len(left))
        batches = batched(left, min(self._batch_s, self._even_s(left)))
        cpu_s, workers = 0.0, set()
        for made in self._results(partial(work, given=self._given), batches):
            self._store.add(kind, made)
            cpu_s += made.cpu_s
            workers.add(made.worker)
            done(len(made.keys))
        wall_s = time.perf_counter() - started
        return Summary(len(tasks), len(tasks) - len(left), len(batches), len(workers), cpu_s, wall_s)

    def _even_s(self, tasks: Sequence[Task]) -> float:
        """Seconds of work in a batch that let the workers finish together, each with some batches."""
        if self._client is None:
            return math.inf
        return sum(task.seconds for task in tasks) / (BATCHES_PER_WORKER * max(len(self._client.nthreads()), 1))

    def _results(self, function: Callable[..., Batch], batches: Sequence[tuple[Task, ...]]) -> Iterator[Batch]:
        if self._client is None:
            yield from map(function, batches)
            return
        coming = as_completed(self._client.map(function, batches, pure=False), with_results=True)
        try:
            for _, made in coming:
                yield made
        except KilledWorker as error:
            raise IwmError(f"a batch was lost with every worker that tried it, out of memory? {error}") from None


@contextmanager
def runner(store: Store, files: Sequence[str], scheduler: str | None, jobs: int, batch_s: float) -> Iterator[Runner]:
    """All that a study needs to run; one job without a scheduler stays in this process."""
    # Here first: what this compiles, the workers find in the cache.
    given = store.begin(fingerprint(), files)
    dask.config.set({"distributed.comm.timeouts.connect": f"{ANSWER_S}s"})
    with nullcontext(None) if scheduler is None and jobs <= 1 else connected(scheduler, jobs) as client:
        yield Runner(store, given, client, batch_s)
