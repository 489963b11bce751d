# SPDX-License-Identifier: Apache-2.0
"""Running a study: batches out, rows in, written as they come; in this process, on its cores, or on a cluster."""

from __future__ import annotations

import importlib.util
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from iwm_power_manager.errors import ConfigError, IwmError
from iwm_sim.cluster import as_they_come, connected
from iwm_sim.fleet.store import Store
from iwm_sim.fleet.task import Given, Task, differences, fingerprint, work

if TYPE_CHECKING:
    from distributed import Client

#: How long the first worker of a scheduler may take to come, s.
FIRST_WORKER_S = 120
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
        for _, made in as_they_come(self._client, partial(work, given=self._given), batches):
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


@contextmanager
def runner(store: Store, files: Sequence[str], scheduler: str | None, jobs: int, batch_s: float) -> Iterator[Runner]:
    """All that a study needs to run; one job without a scheduler stays in this process."""
    # Here first: what this compiles, the workers find in the cache.
    given = store.begin(fingerprint(), files)
    with nullcontext(None) if scheduler is None and jobs <= 1 else connected(scheduler, jobs) as client:
        yield Runner(store, given, client, batch_s)
