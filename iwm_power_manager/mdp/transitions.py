# SPDX-License-Identifier: Apache-2.0
"""Cost and next state of every state and control, tabulated for the solver."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iwm_power_manager.grid import locate
from iwm_power_manager.jit import kernel, parallel_kernel
from iwm_power_manager.mdp.problem import Problem
from iwm_power_manager.mdp.sweep import Model, list_cells
from iwm_power_manager.mdp.threads import over_ranges
from iwm_power_manager.model.chassis import equivalent_mass_kg, road_load_n
from iwm_power_manager.model.decision import axles_gated, step_near, wheel_speed_of_state
from iwm_power_manager.model.longitudinal import Speeds
from iwm_power_manager.model.parameters import VehicleParams
from iwm_power_manager.model.two_axles import curve_of

#: Newton's method does not start from a car at rest, m/s.
_SLOW_MPS = 0.05
#: A step takes as long as some fifty numbers of a sweep.
_NUMBERS_A_STEP = 50


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


@kernel
def _rolling_guess(power_w, speed_mps, vehicle, problem):
    """Where a car whose wheels roll would be after a step: what Newton's method starts from."""
    force = power_w / max(speed_mps, vehicle.driver.power_speed_floor_mps)
    gained = problem.dt_s * (force - road_load_n(speed_mps, 0.0, vehicle.chassis)) / equivalent_mass_kg(vehicle)
    car = max(speed_mps + gained, 0.5 * speed_mps, _SLOW_MPS)
    return Speeds(car, car / vehicle.front.wheel.radius_m, car / vehicle.rear.wheel.radius_m)


@kernel
def _beyond(now, last):
    """The next of a row of speeds that change evenly."""
    if 2.0 * now.car_mps <= last.car_mps or 2.0 * now.front_radps <= last.front_radps:
        return now
    if 2.0 * now.rear_radps <= last.rear_radps:
        return now
    return Speeds(
        2.0 * now.car_mps - last.car_mps,
        2.0 * now.front_radps - last.front_radps,
        2.0 * now.rear_radps - last.rear_radps,
    )


@kernel
def _first_at_least(ascending, number):
    """As np.searchsorted, with which numba would load SciPy's linear algebra."""
    low, high = 0, ascending.size
    while low < high:
        middle = (low + high) // 2
        if ascending[middle] < number:
            low = middle + 1
        else:
            high = middle
    return low


@kernel
def _turning_alike(i, slip, speed_mps, axle):
    """Last slip of the axis at which the wheel turns as at the i-th: at rest, wheels that brake all stand."""
    while i + 1 < slip.size and wheel_speed_of_state(slip[i + 1], speed_mps, axle) == wheel_speed_of_state(
        slip[i], speed_mps, axle
    ):
        i += 1
    return i


@kernel
def _first_of_its_kind(state, p, start, cell, speed_mps, slip_front, slip_rear, vehicle):
    """Of the states that differ in the name of their slips only, the one that is tabulated; the others are copies."""
    n_r = slip_rear.size
    plane = slip_front.size * n_r
    c = cell[state]
    v = c // plane
    f = _turning_alike(c // n_r % slip_front.size, slip_front, speed_mps[v], vehicle.front)
    r = _turning_alike(c % n_r, slip_rear, speed_mps[v], vehicle.rear)
    wanted = v * plane + f * n_r + r
    if wanted == c:
        return state
    found = start[p] + _first_at_least(cell[start[p] : start[p + 1]], wanted)
    return found if found < start[p + 1] and cell[found] == wanted else state


@parallel_kernel
def _fill_free(axes, share, vehicle, problem, start, cell, first_state, last_state, cost, corner, fraction):
    power_w, speed_mps, slip_front, slip_rear = axes
    n_u = share.size
    n_r = slip_rear.size
    plane = slip_front.size * n_r
    shortfall = np.empty(n_u)
    curves = (curve_of(problem.friction, vehicle.front), curve_of(problem.friction, vehicle.rear))
    for state in range(first_state, last_state):
        p = _first_at_least(start, state + 1) - 1
        if _first_of_its_kind(state, p, start, cell, speed_mps, slip_front, slip_rear, vehicle) != state:
            continue
        first = start[p]
        n = start[p + 1] - first
        c = cell[state]
        v, f, r = speed_mps[c // plane], slip_front[c // n_r % slip_front.size], slip_rear[c % n_r]
        guess = _rolling_guess(power_w[p], v, vehicle, problem)
        last = guess
        least = np.inf
        for u in range(n_u):
            i = first * n_u + u * n + state - first
            outcome, speeds = step_near(power_w[p], v, f, r, share[u], guess, curves, vehicle, problem)
            # Shares follow each other: so do the solutions.
            guess = _beyond(speeds, last) if u > 0 else speeds
            last = speeds
            _store(outcome, i, speed_mps, slip_front, slip_rear, cost, corner, fraction)
            shortfall[u] = outcome.shortfall_w
            least = min(least, outcome.shortfall_w)
        # Feasible controls have no shortfall; where none is feasible, those that deliver most are left.
        for u in range(n_u):
            if shortfall[u] > least + 1e-6:
                cost[first * n_u + u * n + state - first] = np.inf


@parallel_kernel
def _copy_alike(axes, n_u, vehicle, start, cell, first_state, last_state, cost, corner, fraction):
    _, speed_mps, slip_front, slip_rear = axes
    for state in range(first_state, last_state):
        p = _first_at_least(start, state + 1) - 1
        source = _first_of_its_kind(state, p, start, cell, speed_mps, slip_front, slip_rear, vehicle)
        if source != state:
            first = start[p]
            n = start[p + 1] - first
            for u in range(n_u):
                to, of = first * n_u + u * n + state - first, first * n_u + u * n + source - first
                cost[to] = cost[of]
                corner[to] = corner[of]
                for axis in range(3):
                    fraction[to, axis] = fraction[of, axis]


@parallel_kernel
def _fill_gated(axes, vehicle, problem, start, cell, first_state, last_state, cost, corner, fraction):
    power_w, speed_mps, slip_front, slip_rear = axes
    n_r = slip_rear.size
    plane = slip_front.size * n_r
    curves = (curve_of(problem.friction, vehicle.front), curve_of(problem.friction, vehicle.rear))
    for state in range(first_state, last_state):
        p = _first_at_least(start, state + 1) - 1
        c = cell[state]
        v, f, r = speed_mps[c // plane], slip_front[c // n_r % slip_front.size], slip_rear[c % n_r]
        guess = _rolling_guess(power_w[p], v, vehicle, problem)
        outcome, _ = step_near(power_w[p], v, f, r, 0.5, guess, curves, vehicle, problem)
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

    def fill_free(first: int, last: int) -> None:
        _fill_free(axes, problem.share, vehicle, params, free_start, free_cell, first, last, *free)

    def copy_alike(first: int, last: int) -> None:
        _copy_alike(axes, problem.share.size, vehicle, free_start, free_cell, first, last, *free)

    pairs = free_cell.size * problem.share.size
    over_ranges(free_cell.size, _NUMBERS_A_STEP * pairs, fill_free)
    over_ranges(free_cell.size, pairs, copy_alike)
    gated = empty(gated_cell.size)

    def fill_gated(first: int, last: int) -> None:
        _fill_gated(axes, vehicle, params, gated_start, gated_cell, first, last, *gated)

    over_ranges(gated_cell.size, _NUMBERS_A_STEP * gated_cell.size, fill_gated)
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
