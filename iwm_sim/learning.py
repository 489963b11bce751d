# SPDX-License-Identifier: Apache-2.0
"""Policies from recorded driving, kept only if they are no worse than one of standard cycles.

Ten minutes of driving do not fill a transition matrix, and the driver's demand is no Markov chain. So how much a
recording should count beside standard cycles, and how far around its speed a step of it should, cannot be told from the
data alone; but it can be tried. Policies are solved with the recorded drive at several weights and bandwidths, all at
the price of a change that keeps the cycles' policy within its budget, and each drives what was recorded in the closed
loop. Of those that need no more energy than the policy of the cycles alone, the one that costs least of
what the solver minimizes, energy and the price of moving the split, is written; if that is not clearly less than
what the cycles' policy costs, theirs is. (Laroche et al. 2019,
*Safe policy improvement with baseline bootstrapping*, fall back on a baseline where data are few; here, as a whole.)
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iwm_power_manager.control.budget import price_units
from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.control.table import PolicyTable, empty_table
from iwm_power_manager.cycle import Cycle, longest_gap, make_cycle
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.mdp.budget import Trial
from iwm_power_manager.mdp.demand import Source, chain_of
from iwm_power_manager.mdp.problem import Problem
from iwm_power_manager.policy import Policy, load_policy
from iwm_power_manager.replay.recorded import RecordedDrive
from iwm_power_manager.solve import solve_one
from iwm_power_manager.vehicle import Vehicle
from iwm_sim import closed_loop
from iwm_sim.cluster import on_all_cores
from iwm_sim.metrics import measure

#: Weights of a recorded second beside a second of a cycle. 0: the cycles alone; infinite: the recording alone.
CYCLES_ALONE, RECORDING_ALONE = 0.0, math.inf
WEIGHTS = (0.05, 0.2, 0.5, 1.0, 2.0, 5.0, 20.0, RECORDING_ALONE)
#: Of the grid's bandwidth in speed, over which steps of the demand are taken together.
BANDWIDTHS = (1.0, 1.3)
CYCLES = ("ftp75", "hwfet", "nycc")
#: Smaller differences are chance: a change of the split a moment sooner or later.
CHANCE_PERCENT = 0.01
#: A recorded speed is followed from second to second, like a standard cycle: noise is no wish of the driver's.
_TRACE_STEP_S = 1.0


class Candidate(NamedTuple):
    """How a policy is solved.

    Attributes
    ----------
    weight : of a recorded second beside a second of a cycle
    bandwidth : in speed, as a multiple of the grid's
    """

    weight: float
    bandwidth: float


#: The policy that every other one is held against.
BASELINE = Candidate(CYCLES_ALONE, 1.0)
_NOT_SOLVED = Candidate(math.nan, math.nan)


class Outcome(NamedTuple):
    """What a policy cost on the drives, all of them together.

    Attributes
    ----------
    candidate : how it was solved
    energy_wh_per_km : out of the cells
    moves_wh_per_km : price of moving the split, in the same unit
    changes_per_min : changes of the split that count
    trace_held : on every drive
    """

    candidate: Candidate
    energy_wh_per_km: float
    moves_wh_per_km: float
    changes_per_min: float
    trace_held: bool

    @property
    def cost_wh_per_km(self) -> float:
        """What the solver minimizes."""
        return self.energy_wh_per_km + self.moves_wh_per_km


class Task(NamedTuple):
    """All that is needed to solve and drive a candidate; `trials` are those of the search for its price of a change."""

    problem: Problem
    vehicle: Vehicle
    friction: float
    recorded: tuple[Source, ...]
    general: tuple[Source, ...]
    drives: tuple[Cycle, ...]
    folder: str
    trials: tuple[Trial, ...] = ()


def recorded_cycle(name: str, drive: RecordedDrive) -> Cycle:
    """The recorded speed as a cycle, a point a second, each the mean of the second around it.

    Raises
    ------
    ConfigError
        The recording is shorter than two seconds.
    """
    whole = math.floor(float(drive.time_s[-1] - drive.time_s[0]) / _TRACE_STEP_S)
    if whole < 2:
        raise ConfigError(name, "", "is too short to be driven", "2 s or more")
    time = np.arange(whole + 1) * _TRACE_STEP_S
    # Exact means of a signal that is linear between its samples: differences of its integral.
    speed = np.maximum(drive.speed_mps, 0.0)
    since = drive.time_s - drive.time_s[0]
    integral = np.concatenate([[0.0], np.cumsum(np.diff(since) * 0.5 * (speed[1:] + speed[:-1]))])
    first, last = np.maximum(time - 0.5 * _TRACE_STEP_S, 0.0), np.minimum(time + 0.5 * _TRACE_STEP_S, since[-1])
    mean = (np.interp(last, since, integral) - np.interp(first, since, integral)) / (last - first)
    gap = longest_gap(since, speed)
    words = (
        f"{name}: the speed at {since[gap[0]]:.6g} s {gap[1]}: policies are tried on a straight line there"
        if gap
        else ""
    )
    return dataclasses.replace(make_cycle(name, time, mean), gap=words)


def sources_at(weight: float, recorded: Sequence[Source], general: Sequence[Source]) -> list[Source]:
    """Sources of the demand with the recording at a weight."""
    if weight == CYCLES_ALONE:
        return list(general)
    if weight == RECORDING_ALONE:
        return list(recorded)
    return [dataclasses.replace(source, weight=weight) for source in recorded] + list(general)


def varied(problem: Problem, candidate: Candidate) -> Problem:
    """The problem with a multiple of the bandwidth."""
    return dataclasses.replace(problem, speed_bandwidth_mps=problem.speed_bandwidth_mps * candidate.bandwidth)


def policy_path(folder: str, candidate: Candidate) -> Path:
    """Where the policy of a candidate is while it is tried; every one has a file of its own."""
    return Path(folder) / ("_".join(f"{name}_{value}" for name, value in candidate._asdict().items()) + ".npz")


def try_candidate(candidate: Candidate, task: Task) -> Outcome:
    """Solve, and drive."""
    problem = varied(task.problem, candidate)
    sources = sources_at(candidate.weight, task.recorded, task.general)
    chain = chain_of(problem, sources)
    path = policy_path(task.folder, candidate)
    solved = solve_one(problem, task.vehicle, task.friction, chain, sources, path, trials=task.trials)
    return drive_all(candidate, "sdp_lookahead", solved.policy.table(), task)


def drive_all(candidate: Candidate, strategy: str, table: PolicyTable, task: Task) -> Outcome:
    """Drive every drive with a strategy. A move costs what it cost the solver."""
    energy_wh = moves_wh = distance_m = minutes = changes = 0.0
    held = True
    for cycle in task.drives:
        run = closed_loop.run(cycle, task.vehicle, default_settings(strategy), table, task.friction)
        found = measure(run, task.vehicle.params)
        lasted_min = run.series.shape[0] * run.dt_s / 60.0
        energy_wh += found.energy_wh
        moves_wh += moves_j(np.diff(run["decided_share"]), table) / 3600.0
        distance_m += found.distance_m
        minutes += lasted_min
        changes += found.share_changes_per_min * lasted_min
        held = held and found.trace_held
    if distance_m <= 0.0:
        raise ConfigError(", ".join(cycle.source for cycle in task.drives), "", "the car does not move")
    per_km = 1000.0 / distance_m
    return Outcome(candidate, energy_wh * per_km, moves_wh * per_km, changes / minutes, held)


def moves_j(moves: NDArray[np.float64], table: PolicyTable) -> float:
    """Price of moves of the share, J."""
    if table.changes_per_min > 0.0:
        return table.switching_cost_j * sum(price_units(float(move)) for move in moves[moves != 0.0])
    return float(table.switching_cost_j * np.abs(moves).sum() + table.switching_fixed_cost_j * np.count_nonzero(moves))


def solve_cycles_alone(task: Task) -> tuple[Task, Policy]:
    """The task with the price of a change that the cycles alone need, for all candidates, and the policy of these."""
    path, chain = policy_path(task.folder, BASELINE), chain_of(task.problem, task.general)
    policy = solve_one(task.problem, task.vehicle, task.friction, chain, task.general, path).policy
    return task._replace(problem=policy.problem, trials=policy.trials), policy


def choose(outcomes: Sequence[Outcome]) -> Outcome:
    """The least cost of those that need no more energy than the cycles' and hold the trace; else the cycles'.

    What costs less by chance only (`CHANCE_PERCENT`) is no reason to leave the cycles' policy.

    Parameters
    ----------
    outcomes : one of them of `BASELINE`
    """
    (safe,) = (outcome for outcome in outcomes if outcome.candidate == BASELINE)
    # Energy that was saved by not following the trace is no saving.
    fair = [
        outcome
        for outcome in outcomes
        if outcome.energy_wh_per_km <= safe.energy_wh_per_km and (outcome.trace_held or not safe.trace_held)
    ]
    best = min(fair, key=lambda outcome: outcome.cost_wh_per_km)
    enough = safe.cost_wh_per_km * (1.0 - CHANCE_PERCENT / 100.0)
    return best if best.cost_wh_per_km < enough else safe


def candidates_of(problem: Problem, weights: Sequence[float], bandwidths: Sequence[float]) -> list[Candidate]:
    """Give the baseline, and then every weight from the smallest to the greatest, with every bandwidth."""
    if not problem.demand_by_speed:
        bandwidths = (1.0,)
    product = itertools.product(*(sorted(set(values)) for values in (weights, bandwidths)))
    return [BASELINE, *(candidate for values in product if (candidate := Candidate(*values)) != BASELINE)]


class Learned(NamedTuple):
    """Equal split, what each candidate cost, the chosen one of these, and its policy."""

    equal: Outcome
    outcomes: list[Outcome]
    chosen: Outcome
    policy: Policy


def learn(
    task: Task, candidates: Sequence[Candidate], jobs: int, done: Callable[[Outcome], None] = lambda _: None
) -> Learned:
    """Try candidates, the baseline first, on one road; `done` hears of each."""
    # In this process: what it compiles, the others find in the cache.
    task, cycles_alone = solve_cycles_alone(task)
    equal = drive_all(_NOT_SOLVED, "equal", empty_table(), task)
    outcomes = [drive_all(BASELINE, "sdp_lookahead", cycles_alone.table(), task)]
    done(outcomes[0])
    outcomes += on_all_cores(partial(try_candidate, task=task), candidates[1:], jobs, done)
    chosen = choose(outcomes)
    return Learned(equal, outcomes, chosen, load_policy(policy_path(task.folder, chosen.candidate)))


def best_of_each_weight(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """The baseline, and of each weight what `choose` would take; where it would take none, what costs least."""
    safe, *others = outcomes
    best = [safe]
    for _, group in itertools.groupby(others, key=lambda outcome: outcome.candidate.weight):
        tried = list(group)
        found = choose([safe, *tried])
        best.append(found if found is not safe else min(tried, key=lambda outcome: outcome.cost_wh_per_km))
    return best
