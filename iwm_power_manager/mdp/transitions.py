# SPDX-License-Identifier: Apache-2.0
"""Cost and next state of every state and control, tabulated for the solver."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iwm_power_manager.grid import locate
from iwm_power_manager.jit import kernel, parallel_kernel
from iwm_power_manager.mdp.policy_iteration import Model, list_cells
from iwm_power_manager.mdp.problem import Problem
from iwm_power_manager.mdp.threads import over_ranges
from iwm_power_manager.model.decision import axles_gated, step_cost_and_next
from iwm_power_manager.model.parameters import VehicleParams


@kernel
def _mark_gated(power_w, slip_front, slip_rear, n_speed, problem, gated):
    n_f, n_r = slip_front.size, slip_rear.size
    for p in range(power_w.size):
        for f in range(n_f):
            for r in range(n_r):
                front, rear = axles_gated(power_w[p], slip_front[f], slip_rear[r], problem)
                for v in range(n_speed):
                    gated[p, (v * n_f + f) * n_r + r] = front or rear


@kernel
def _store(outcome, i, speed_mps, slip_front, slip_rear, cost, corner, fraction):
    a, fa = locate(speed_mps, outcome.speed_mps)
    b, fb = locate(slip_front, outcome.slip_front)
    c, fc = locate(slip_rear, outcome.slip_rear)
    cost[i] = outcome.cost_j
    corner[i] = (a * slip_front.size + b) * slip_rear.size + c
    fraction[i, 0] = fa
    fraction[i, 1] = fb
    fraction[i, 2] = fc


@parallel_kernel
def _fill_free(
    power_w,
    speed_mps,
    slip_front,
    slip_rear,
    share,
    vehicle,
    problem,
    start,
    cell,
    first_state,
    last_state,
    cost,
    corner,
    fraction,
):
    n_u = share.size
    plane = slip_front.size * slip_rear.size
    shortfall = np.empty(n_u)
    for state in range(first_state, last_state):
        p = np.searchsorted(start, state, side="right") - 1
        first = start[p]
        n = start[p + 1] - first
        c = cell[state]
        v = speed_mps[c // plane]
        f = slip_front[c // slip_rear.size % slip_front.size]
        r = slip_rear[c % slip_rear.size]
        least = np.inf
        for u in range(n_u):
            i = first * n_u + u * n + state - first
            outcome = step_cost_and_next(power_w[p], v, f, r, share[u], vehicle, problem)
            _store(outcome, i, speed_mps, slip_front, slip_rear, cost, corner, fraction)
            shortfall[u] = outcome.shortfall_w
            least = min(least, outcome.shortfall_w)
        # Feasible controls have no shortfall; where none is feasible, those that deliver most are left.
        for u in range(n_u):
            if shortfall[u] > least + 1e-6:
                cost[first * n_u + u * n + state - first] = np.inf


@parallel_kernel
def _fill_gated(
    power_w,
    speed_mps,
    slip_front,
    slip_rear,
    vehicle,
    problem,
    start,
    cell,
    first_state,
    last_state,
    cost,
    corner,
    fraction,
):
    plane = slip_front.size * slip_rear.size
    for state in range(first_state, last_state):
        p = np.searchsorted(start, state, side="right") - 1
        c = cell[state]
        v = speed_mps[c // plane]
        f = slip_front[c // slip_rear.size % slip_front.size]
        r = slip_rear[c % slip_rear.size]
        outcome = step_cost_and_next(power_w[p], v, f, r, 0.5, vehicle, problem)
        _store(outcome, state, speed_mps, slip_front, slip_rear, cost, corner, fraction)


def gated_states(problem: Problem, friction: float) -> NDArray[np.bool_]:
    """bool[P, C]: states in which skid avoidance leaves no choice."""
    cells = problem.speed_mps.size * problem.slip_front.size * problem.slip_rear.size
    gated = np.zeros((problem.power_w.size, cells), dtype=np.bool_)
    _mark_gated(
        problem.power_w, problem.slip_front, problem.slip_rear, problem.speed_mps.size, problem.params(friction), gated
    )
    return gated


def build_model(problem: Problem, vehicle: VehicleParams, friction: float, demand: NDArray[np.float64]) -> Model:
    """Tabulate cost and next state of every state and control.

    Parameters
    ----------
    problem : grids and settings
    vehicle : the car
    friction : peak friction coefficient of the road
    demand : float64[G, P, P], `DemandChain.matrix` over `problem.power_w`
    """
    params = problem.params(friction)
    axes = (problem.power_w, problem.speed_mps, problem.slip_front, problem.slip_rear)
    no_choice = gated_states(problem, friction)
    free_start, free_cell = list_cells(~no_choice)
    gated_start, gated_cell = list_cells(no_choice)

    def empty(n: int) -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.float64]]:
        return np.empty(n), np.empty(n, np.int32), np.empty((n, 3))

    free = empty(free_cell.size * problem.share.size)
    over_ranges(
        free_cell.size,
        lambda first, last: _fill_free(
            *axes, problem.share, vehicle, params, free_start, free_cell, first, last, *free
        ),
    )
    gated = empty(gated_cell.size)
    over_ranges(
        gated_cell.size,
        lambda first, last: _fill_gated(*axes, vehicle, params, gated_start, gated_cell, first, last, *gated),
    )
    return Model(
        problem.discount,
        np.ascontiguousarray(demand, dtype=np.float64),
        (problem.speed_mps.size, problem.slip_front.size, problem.slip_rear.size),
        problem.switching_cost(),
        free_start,
        free_cell,
        *free,
        gated_start,
        gated_cell,
        *gated,
    )
