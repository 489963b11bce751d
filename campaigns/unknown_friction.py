# SPDX-License-Identifier: Apache-2.0
"""What it costs not to know the road's friction: the estimate beside the truth, over cycles and over jumps.

Savings are those of the study's cells; skid figures those of a car that comes onto another road while its driver
brakes, drives or does so later, from one second after the jump on.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from iwm_sim.closed_loop import Run
from iwm_sim.cluster import on_all_cores
from iwm_sim.metrics import Metrics
from iwm_sim.road_measures import MEASURES, driven
from iwm_sim.road_run import drive_scenario
from iwm_sim.scenario import Demand, Friction, Scenario, load_scenario
from iwm_sim.study import paper
from iwm_sim.study.cases import Case
from iwm_sim.study.driving import drive_all
from iwm_sim.study.names import REFERENCE
from iwm_sim.study.plan import IDLE_DRIVES, STRATEGY, Policies
from iwm_sim.study.rows import saving_percent

#: What the figures of a jump are, and from when on they count, s.
SKID_FIGURES = ("longest_beyond_critical_s", "longest_locked_s", "longest_spinning_s")
AFTER_S = 1.0

#: Roads before and after a jump, left and right, by name.
JUMPS = {
    "0.9 to 0.2": ((0.9, 0.9), (0.2, 0.2)),
    "0.2 to 0.9": ((0.2, 0.2), (0.9, 0.9)),
    "0.5 to 0.2": ((0.5, 0.5), (0.2, 0.2)),
    "0.9 to split": ((0.9, 0.9), (0.2, 0.9)),
    "split to 0.9": ((0.2, 0.9), (0.9, 0.9)),
    "0.2 to split": ((0.2, 0.2), (0.9, 0.2)),
    "split to its mirror image": ((0.2, 0.9), (0.9, 0.2)),
}
SPEEDS_MPS = (10.0, 20.0, 30.0)
#: What the driver does, from when on, s; the jump comes at `JUMP_S`, as far as the car would have rolled by then.
DEMANDS = (
    Demand(1.0, "brake", 1.0),
    Demand(1.0, "brake", 0.25),
    Demand(1.0, "accelerator", 1.0),
    Demand(2.5, "brake", 1.0),
    Demand(2.5, "accelerator", 1.0),
)
JUMP_S = 1.5
#: Savings that differ by no more count as alike, points.
SAME_POINTS = 0.02
_LONGEST_S = {"brake": 40.0, "accelerator": 8.0}


class Jumped(NamedTuple):
    """A jump with friction told and estimated: the figures of `SKID_FIGURES`, s (0 if the car stood by then)."""

    scenario: Scenario
    told: tuple[float, ...]
    estimated: tuple[float, ...]

    @property
    def road(self) -> str:
        """Name of the jump."""
        return self.scenario.name.partition(",")[0]

    @property
    def no_worse(self) -> bool:
        """No figure is larger where the friction is not known."""
        return all(ours <= theirs + 1e-9 for ours, theirs in zip(self.estimated, self.told, strict=True))


class Saved(NamedTuple):
    """A cell: what is saved against equal split, %, friction told and estimated (None: the trace was lost)."""

    cycle: str
    friction: float
    idle_drive: str
    told_percent: float | None
    estimated_percent: float | None


def differs(cell: Saved) -> bool:
    """Whether not knowing the friction makes a difference of more than `SAME_POINTS`, or loses the trace."""
    told, estimated = cell.told_percent, cell.estimated_percent
    if told is None or estimated is None:
        return told is not estimated
    return abs(estimated - told) > SAME_POINTS


def jump(name: str, speed_mps: float, demand: Demand) -> Scenario:
    """The scenario of a jump by its name in `JUMPS`."""
    before, after = JUMPS[name]
    return dataclasses.replace(
        load_scenario("jump_down"),
        name=f"{name}, {speed_mps:g} m/s, {demand.kind} {demand.value:g} from {demand.from_s:g} s",
        speed_mps=speed_mps,
        demand=(demand,),
        friction=(Friction(0.0, *before), Friction(JUMP_S * speed_mps, *after)),
        assumed_friction=min(before),
        duration_s=_LONGEST_S[demand.kind],
        to_standstill=True,
        steering=None,
        require=(),
    )


def all_jumps() -> list[Scenario]:
    """Every jump at every speed with every demand."""
    return [jump(*each) for each in itertools.product(JUMPS, SPEEDS_MPS, DEMANDS)]


def jumped(scenario: Scenario) -> Jumped:
    """Drive a jump twice and compare."""
    told, estimated = (_figures(drive_scenario(scenario, friction_known=known), scenario) for known in (True, False))
    return Jumped(scenario, told, estimated)


def _figures(run: Run, scenario: Scenario) -> tuple[float, ...]:
    road = driven(run, scenario.truth).wheels("road_{}")
    start = int(np.argmax((road != road[0]).any(axis=1))) + round(AFTER_S / run.dt_s)
    if start >= len(road) or run.road is None:
        return tuple(0.0 for _ in SKID_FIGURES)
    later = driven(Run(run.dt_s, run.series[start:], run.final, run.road[start:]), scenario.truth)
    return tuple(MEASURES[name](later) for name in SKID_FIGURES)


def savings(cells: Sequence[tuple[str, float, str]], jobs: int, vehicle: str, policies: str) -> list[Saved]:
    """What is saved in cells of cycle, friction and idle drive."""
    at_hand = Policies(vehicle, policies)
    wanted: list[Case] = []
    for cycle, friction, idle_drive in cells:
        equal = Case(cycle, vehicle, idle_drive, friction, REFERENCE)
        ours = dataclasses.replace(equal, strategy=STRATEGY)
        told = dataclasses.replace(ours, policy=at_hand.ours(idle_drive, friction))
        wanted += [equal, told, dataclasses.replace(ours, policies=policies)]
    made: list[Metrics] = [result.metrics for result in drive_all(wanted, jobs)]
    return [
        Saved(*cell, saving_percent(told, equal), saving_percent(estimated, equal))
        for cell, (equal, told, estimated) in zip(cells, itertools.batched(made, 3), strict=True)
    ]


def all_cells() -> list[tuple[str, float, str]]:
    """The cells of the paper's tables, for either idle drive."""
    return list(itertools.product(paper.CYCLES, paper.FRICTIONS, IDLE_DRIVES))


def all_jumped(jobs: int) -> list[Jumped]:
    """Every jump, driven and compared."""
    return on_all_cores(jumped, all_jumps(), jobs)
