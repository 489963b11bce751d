# SPDX-License-Identifier: Apache-2.0
"""What a worker does: tasks that hold file names and plain numbers, and give rows; the same task, the same bits.

A task is named by its `key`, a hash of all it holds. What numbers depend on beside it, the code and the processor, is
the `fingerprint`: a worker compares its own with that of the study, and refuses to work where they differ.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import os
import platform
import socket
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.errors import ConfigError, IwmError
from iwm_power_manager.files import read_bytes, sha256_of
from iwm_power_manager.kernel_cache import sources_hash
from iwm_power_manager.policy import load_policy
from iwm_power_manager.share import resolve
from iwm_power_manager.vehicle import Vehicle
from iwm_sim import road_run
from iwm_sim.metrics import Metrics, measure
from iwm_sim.scenario import load_scenario
from iwm_sim.study import cases
from iwm_sim.study.cases import Case, Change
from iwm_sim.study.driving import seconds_of
from iwm_sim.study.policies import solved
from iwm_sim.study.rows import rows_of

#: Of a processor; to fill batches, no promise.
_SECONDS_PER_POLICY = 10.0
_SECONDS_PER_SCENARIO = 2.0


class Made(NamedTuple):
    """What a task gives: rows, and files of policies by name."""

    rows: list[dict[str, Any]]
    policies: Mapping[str, bytes] = MappingProxyType({})


class Car(NamedTuple):
    """A car: a file or a drawn one, and the numbers that are not as it says."""

    vehicle: str
    idle_drive: str
    changes: tuple[Change, ...] = ()

    @property
    def label(self) -> str:
        """What tables call it."""
        changed = (f"{change.section}.{change.name} {change.value:g}" for change in self.changes)
        name = self.vehicle if cases.drawn_seed(self.vehicle) is not None else Path(self.vehicle).stem
        return ", ".join([name, *changed])

    def load(self) -> Vehicle:
        """The car itself."""
        return cases.vehicle_of(self.vehicle, self.idle_drive, self.changes)


def key_of(task: Any) -> str:
    """Name of a task: 20 hex digits over all it holds."""
    return hashlib.sha256(f"{type(task).__name__} {task!r}".encode()).hexdigest()[:20]


# --- kinds of tasks, each with its row ------------------------------------------------------------------------------


class PolicyRow(NamedTuple):
    """A solved policy; `changes_per_min` is what the solver expects, None where no budget is kept."""

    key: str
    car: str
    vehicle_hash: str
    idle_drive: str
    friction: float
    grid: str
    budget_per_min: float
    changes_per_min: float | None
    price_j: float
    bound_j: float
    converged: bool
    iterations: int
    policy: str


class Solve(NamedTuple):
    """Solve a policy for a car on a road, with a budget of changes a minute (None: the grid's)."""

    car: Car
    friction: float
    grid: str
    budget_per_min: float | None = None

    @property
    def file(self) -> str:
        """Name of the policy in the study's folder."""
        return f"{key_of(self)}.npz"

    @property
    def seconds(self) -> float:
        """About how long it takes."""
        return _SECONDS_PER_POLICY

    def run(self, _: Path) -> Made:
        """Solve it, or find it where this machine keeps what it has solved."""
        path = solved(self.car.load(), self.friction, self.grid, budget_per_min=self.budget_per_min)
        policy = load_policy(path)
        row = PolicyRow(
            key=key_of(self),
            car=self.car.label,
            vehicle_hash=policy.vehicle_hash,
            idle_drive=policy.idle_drive,
            friction=policy.friction,
            grid=policy.problem.name,
            budget_per_min=policy.problem.changes_per_min,
            changes_per_min=policy.trials[-1].changes_per_min if policy.trials else None,
            price_j=policy.problem.switching_cost_j,
            bound_j=policy.bound_j,
            converged=policy.converged,
            iterations=len(policy.iterations),
            policy=policy.checksum,
        )
        return Made([row._asdict()], {self.file: read_bytes(path)})


class DrivePlace(NamedTuple):
    """What was driven; its `Metrics` follow in the row.

    `fair` says whether the run may be compared with that of equal split: both held the trace, over the same distance;
    only then there is a saving.
    """

    key: str
    car: str
    vehicle_hash: str
    idle_drive: str
    cycle: str
    friction: float
    strategy: str
    policy: str
    fair: bool
    saving_percent: float | None


class Drive(NamedTuple):
    """Drive a cycle with strategies that are compared, equal split first; policies are named, not placed."""

    cases: tuple[Case, ...]

    @property
    def seconds(self) -> float:
        """About how long it takes."""
        return sum(seconds_of(case) for case in self.cases)

    def run(self, folder: Path) -> Made:
        """Drive all of them, with the policies of a folder."""
        placed = (
            dataclasses.replace(case, policy=str(folder / case.policy) if case.policy else "") for case in self.cases
        )
        equal, *_ = rows = rows_of([cases.result(case) for case in placed])
        made = []
        for case, row in zip(self.cases, rows, strict=True):
            fair = bool(row.same_distance_as_equal) and row.metrics.trace_held and equal.metrics.trace_held
            place = DrivePlace(
                key=key_of(self),
                car=Car(case.vehicle, case.idle_drive, case.car).label,
                vehicle_hash=row.made_with["vehicle_hash"],
                idle_drive=row.place.idle_drive,
                cycle=row.place.cycle,
                friction=case.friction,
                strategy=row.label,
                policy=row.made_with["policy_checksum"] or "",
                fair=fair,
                saving_percent=row.saving_percent if fair else None,
            )
            made.append(place._asdict() | row.metrics._asdict())
        return Made(made)


class RoadRow(NamedTuple):
    """One measure of a scenario beside what it has to be; None where it never happened or has no bound there."""

    key: str
    scenario: str
    car: str
    vehicle_hash: str
    idle_drive: str
    strategy: str
    measure: str
    value: float | None
    holds: bool
    aim: bool


class Road(NamedTuple):
    """Drive a scenario with a car; `policy` names the policy it needs."""

    scenario: str
    car: Car
    strategy: str
    policy: str = ""

    @property
    def seconds(self) -> float:
        """About how long it takes."""
        return _SECONDS_PER_SCENARIO

    def run(self, folder: Path) -> Made:
        """Drive it and compare what comes out with what it requires."""
        vehicle = self.car.load()
        scenario = load_scenario(self.scenario, vehicle=vehicle)
        policy = str(folder / self.policy) if self.policy else "policies"
        driven = road_run.check_scenario(scenario, default_settings(self.strategy), policy)
        same = (key_of(self), scenario.name, self.car.label, vehicle.hash, vehicle.idle_drive, self.strategy)
        rows = (
            RoadRow(*same, check.bound.measure, driven.values[check.bound.measure], check.holds, check.bound.aim)
            for check in driven.checked
        )
        return Made([row._asdict() for row in rows])


Task = Solve | Drive | Road
#: Columns of each kind's rows, by the name its parts have.
COLUMNS: dict[type[Any], tuple[type[Any], ...]] = {Solve: (PolicyRow,), Drive: (DrivePlace, Metrics), Road: (RoadRow,)}


# --- on a worker ----------------------------------------------------------------------------------------------------


class Given(NamedTuple):
    """What a study was begun with: folder of its policies, `fingerprint`, and the hashes of the files it names."""

    policies: str
    fingerprint: Mapping[str, str]
    files: Mapping[str, str]


class Batch(NamedTuple):
    """What a worker made of some tasks, and what it took: seconds of its processor and of the clock."""

    keys: tuple[str, ...]
    made: list[Made]
    cpu_s: float
    wall_s: float
    worker: str


@functools.cache
def fingerprint() -> dict[str, str]:
    """What this process's numbers depend on, by name.

    `numbers` is the hash of all series of half a minute's drive with this process's processor and libraries, with the
    tyre's trigonometric functions in it. `processor` is for the reader: another one with the same numbers will do.
    """
    import numba
    import numpy as np
    from numba.core.registry import cpu_target

    case = Case("generated:1", cases.BASE_CAR, "drag", 0.5, "instantaneous_slip")
    run = cases.drive(case, until_s=30.0)
    digest = hashlib.sha256(run.series.tobytes())
    digest.update(repr(measure(run, cases.vehicle_of(case.vehicle, case.idle_drive).params)).encode())
    return {
        "sources": sources_hash(__name__)[:16],
        "python": platform.python_version(),
        "numpy": np.__version__,
        "numba": numba.__version__,
        "numbers": digest.hexdigest()[:16],
        "processor": cpu_target.target_context.codegen().magic_tuple()[1],
    }


def differences(study: Mapping[str, str], worker: Mapping[str, str]) -> str:
    """What of a worker's fingerprint is not the study's, in words; "" if it will do."""
    other = (f"{name} {worker.get(name)} instead of {study[name]}" for name in study if study[name] != worker.get(name))
    found = list(other)
    return ", ".join(found) if any(not text.startswith("processor ") for text in found) else ""


@functools.cache
def _hash_here(name: str) -> str:
    return sha256_of(resolve(name))


def work(tasks: Sequence[Task], given: Given) -> Batch:
    """Do some tasks.

    Raises
    ------
    IwmError
        This worker computes other numbers than the study's first, or has another file than the study was begun with.
    """
    worker = f"{socket.gethostname()}:{os.getpid()}"
    problem = differences(given.fingerprint, fingerprint())
    if problem:
        raise IwmError(f"worker {worker}: computes other numbers than this study: {problem}")
    for name, digest in given.files.items():
        if _hash_here(name) != digest:
            raise ConfigError(name, "", f"worker {worker} has another file than the study was begun with")
    cpu_s, wall_s = time.process_time(), time.perf_counter()
    made = [task.run(Path(given.policies)) for task in tasks]
    keys = tuple(key_of(task) for task in tasks)
    return Batch(keys, made, time.process_time() - cpu_s, time.perf_counter() - wall_s, worker)
