# SPDX-License-Identifier: Apache-2.0
"""From a car, a grid and a demand to a policy file: what every command that solves policies calls."""

from __future__ import annotations

import dataclasses
import os
import re
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iwm_power_manager.control.budget import DEARER
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.files import friction_in_name
from iwm_power_manager.mdp.budget import Trial, find_price
from iwm_power_manager.mdp.certify import bellman_residual_j
from iwm_power_manager.mdp.demand import DemandChain, Source
from iwm_power_manager.mdp.policy_iteration import Iteration, Solution, solve
from iwm_power_manager.mdp.problem import Problem, load_problem
from iwm_power_manager.mdp.sweep import Model
from iwm_power_manager.mdp.transitions import build_model
from iwm_power_manager.model.parameters import VehicleParams
from iwm_power_manager.policy import Policy, cost_quantum_j, make_policy, save_policy, with_residual
from iwm_power_manager.share import resolve
from iwm_power_manager.vehicle import Vehicle

#: While the price of a change is searched, a solution may be this many times as far from the optimum.
SEARCH_TOLERANCE = 20.0


class Solved(NamedTuple):
    """One policy, where it was written and what it took."""

    policy: Policy
    path: Path
    build_s: float
    solve_s: float


def load_grid(name: str, vehicle: VehicleParams) -> Problem:
    """A grid of the package by its name, or of a file, with its axes as they are for a car."""
    return load_problem(grid_path(name)).for_car(vehicle)


def grid_path(name: str) -> Path:
    """File of a grid: a preset by name, or the file itself."""
    preset = resolve(f"config/grids/{name}.yaml")
    return preset if os.path.exists(preset) else resolve(name)


def targets(output: Path, vehicle: Vehicle, problem: Problem, frictions: Sequence[float]) -> list[Path]:
    """Where each policy goes; a folder is made, a file is for one policy only."""
    if len(set(frictions)) != len(frictions):
        raise ConfigError("arguments", "--friction", "names a value twice")
    if output.suffix == ".npz":
        if len(frictions) > 1:
            raise ConfigError(
                "arguments", "--output", f"{output} is one file for {len(frictions)} policies", "a folder"
            )
        if not os.path.isdir(output.parent):  # said before, not after the work
            raise ConfigError("arguments", "--output", f"{output}: cannot be written: no such folder")
        return [output]
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError("arguments", "--output", f"{output}: {error.strerror}", "a folder or a .npz file") from None
    if not os.access(output, os.W_OK):
        raise ConfigError("arguments", "--output", f"{output}: may not be written to", "a folder or a .npz file")
    stem = re.sub(r"[^a-z0-9]+", "_", f"{vehicle.name} {vehicle.idle_drive} {problem.name}".lower()).strip("_")
    return [output / f"{stem}_mu{friction_in_name(friction)}.npz" for friction in frictions]


def solve_one(
    problem: Problem,
    vehicle: Vehicle,
    friction: float,
    chain: DemandChain,
    sources: Sequence[Source],
    path: Path,
    update: Callable[[Iteration], None] = lambda _: None,
    verify: bool = False,
    trials: Sequence[Trial] = (),
) -> Solved:
    """Solve for one road, write the policy, and say what it took; `update` hears of every iteration.

    With `verify`, the Bellman residual of what is stored is computed from the problem alone and stored, too. `trials`
    are those of the search that gave the problem its price of a change, if it has one.
    """
    started = time.perf_counter()
    problem = problem.on_road(friction)
    model = build_model(problem, vehicle.params, friction, chain.matrix)
    built = time.perf_counter()
    # What rounding the stored cost-to-go adds is part of the promise.
    tolerance = problem.tolerance_j - cost_quantum_j(problem.tolerance_j) / 2.0
    start = None
    if problem.changes_per_min > 0.0 and problem.switching_cost_j == 0.0:
        found = find_price(
            model, problem.share, problem.dt_s, problem.changes_per_min, SEARCH_TOLERANCE * problem.tolerance_j
        )
        problem = dataclasses.replace(problem, switching_cost_j=found.price_j)
        start, trials = found.solution.cost_j, found.trials
    solution = _priced(model, problem, 1.0, tolerance, update, start)
    factors = DEARER if problem.changes_per_min > 0.0 else ()
    dearer = [_priced(model, problem, factor, tolerance, lambda _: None, solution.cost_j) for factor in factors]
    done = time.perf_counter()
    policy = make_policy(problem, vehicle, friction, chain, sources, solution, dearer, trials)
    if verify:
        priced = model._replace(switching_j=problem.switching_cost())
        policy = with_residual(policy, bellman_residual_j(priced, policy.cost_by_state_j()))
    save_policy(policy, path)
    return Solved(policy, path, built - started, done - built)


def _priced(
    model: Model,
    problem: Problem,
    factor: float,
    tolerance_j: float,
    update: Callable[[Iteration], None],
    start_j: NDArray[np.float64] | None,
) -> Solution:
    """The solution with this many times the problem's price of a change."""
    priced = model._replace(switching_j=factor * problem.switching_cost())
    return solve(priced, problem.share, tolerance_j, problem.max_iterations, update, start_j)
