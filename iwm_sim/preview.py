# SPDX-License-Identifier: Apache-2.0
"""Deterministic dynamic programming over a whole cycle known in advance.

The bound nobody can beat: the split that costs least battery energy plus switching cost when every future demand is
known. It takes demand and speed from a drive of the cycle with equal split (the driver asks for almost the same
whatever the split does) and lets slip settle; the schedule it finds is then driven in the closed loop like any other
strategy. The generalized rule (the paper's GRDP) is a straight line fitted to its P_f over P_dem.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from iwm_power_manager.control.strategies.instantaneous import PRICE_OF_MISSING
from iwm_power_manager.control.table import empty_table
from iwm_power_manager.jit import kernel, parallel_kernel
from iwm_power_manager.model.parameters import VehicleParams
from iwm_power_manager.model.quasi_steady import demand_force_n, split_power_w
from iwm_sim.closed_loop import Run
from iwm_sim.metrics import share_changes

FloatArray = npt.NDArray[np.float64]

#: Between these the price is bisected that keeps a number of changes, in the logarithm.
_PRICES_J = (1e-2, 1e6)
_BISECTIONS = 12


@parallel_kernel
def _tabulate(power_w, speed_mps, samples, share, friction, dt_s, vehicle, out):
    for k in range(out.shape[0]):
        for u in range(share.size):
            total = 0.0
            for i in range(k * samples, min((k + 1) * samples, power_w.size)):
                speed = max(speed_mps[i], vehicle.driver.power_speed_floor_mps)
                force = demand_force_n(power_w[i], speed_mps[i], friction, True, vehicle)
                power, missing = split_power_w(force, speed, share[u], friction, True, vehicle)
                total += (power + PRICE_OF_MISSING * missing * speed) * dt_s
            out[k, u] = total


@kernel
def cheapest_path(cost_j, share, switching_cost_j, switching_fixed_cost_j, path):
    """Fill `path` with the index of the share of each step that minimises the sum of step and switching costs.

    Parameters
    ----------
    cost_j : float64[n, U], cost of each share in each step
    share : float64[U], increasing
    switching_cost_j : cost of a change of the share by 1, proportional
    switching_fixed_cost_j : cost of any change
    path : int64[n], output
    """
    n, n_u = cost_j.shape
    origin = np.zeros((n, n_u), dtype=np.int16)
    total = cost_j[0].copy()
    new = np.empty(n_u)
    for k in range(1, n):
        # The price grows with the distance, so that the cheapest share to come from is handed on from share to share.
        from_below = np.inf
        came = 0
        for u in range(n_u):
            new[u] = total[u]
            origin[k, u] = u
            if u > 0:
                move = switching_cost_j * (share[u] - share[u - 1])
                from_below += move
                if total[u - 1] + move < from_below:
                    from_below = total[u - 1] + move
                    came = u - 1
                if from_below + switching_fixed_cost_j < new[u]:
                    new[u] = from_below + switching_fixed_cost_j
                    origin[k, u] = came
        from_above = np.inf
        for u in range(n_u - 2, -1, -1):
            move = switching_cost_j * (share[u + 1] - share[u])
            from_above += move
            if total[u + 1] + move < from_above:
                from_above = total[u + 1] + move
                came = u + 1
            if from_above + switching_fixed_cost_j < new[u]:
                new[u] = from_above + switching_fixed_cost_j
                origin[k, u] = came
        for u in range(n_u):
            total[u] = new[u] + cost_j[k, u]
    last = np.argmin(total)
    for k in range(n - 1, -1, -1):
        path[k] = last
        last = origin[k, last]


def step_costs(
    power_w: FloatArray,
    speed_mps: FloatArray,
    dt_s: float,
    decision_period_s: float,
    vehicle: VehicleParams,
    friction: float,
    share: FloatArray,
) -> FloatArray:
    """Cost of each share in each decision of a drive whose demand and speed are known from its start to its end, J.

    Parameters
    ----------
    power_w, speed_mps : float64[n], demand and speed in each control step, as a drive of the same cycle had them
    dt_s, decision_period_s : control step and decision period; the latter a multiple of the former
    vehicle, friction : what is driven, and on what
    share : float64[U], shares to choose from

    Returns
    -------
    float64[ceil(n * dt_s / decision_period_s), U]
    """
    samples = round(decision_period_s / dt_s)
    cost = np.empty((-(-power_w.size // samples), share.size))
    _tabulate(power_w, speed_mps, samples, share, friction, dt_s, vehicle, cost)
    return cost


def cheapest_schedule(
    cost_j: FloatArray, share: FloatArray, switching_cost_j: float = 0.0, switching_fixed_cost_j: float = 0.0
) -> FloatArray:
    """Share of each decision with the least sum of costs and prices of changes (see `cheapest_path`)."""
    path = np.empty(cost_j.shape[0], dtype=np.int64)
    cheapest_path(cost_j, share, switching_cost_j, switching_fixed_cost_j, path)
    return share[path]


def cheapest_within(cost_j: FloatArray, share: FloatArray, most_changes: float) -> FloatArray:
    """The cheapest schedule of those with a constant price of a move and at most so many changes (`share_changes`)."""
    low, high = _PRICES_J
    for _ in range(_BISECTIONS):
        price = float(np.sqrt(low * high))
        if share_changes(cheapest_schedule(cost_j, share, price)) > most_changes + 1e-6:
            low = price
        else:
            high = price
    return cheapest_schedule(cost_j, share, high)


def schedule(
    run: Run,
    period_s: float,
    vehicle: VehicleParams,
    friction: float,
    changes_per_min: float | None = None,
    prices_j: tuple[float, float] = (0.0, 0.0),
) -> FloatArray:
    """The cheapest share of each decision for the demand that a run had.

    Parameters
    ----------
    run, period_s : a drive of the cycle, and how often the share is decided
    vehicle, friction : what is driven, and on what
    changes_per_min : at most so many; None is as many as are worth `prices_j`, those of `cheapest_schedule`
    """
    share = empty_table().share
    cost = step_costs(run["power_demand_w"], run["speed_mps"], run.dt_s, period_s, vehicle, friction, share)
    if changes_per_min is None:
        return cheapest_schedule(cost, share, *prices_j)
    return cheapest_within(cost, share, changes_per_min * run.series.shape[0] * run.dt_s / 60.0)


def fit_rule(power_w: FloatArray, front_share: FloatArray, least_power_w: float = 200.0) -> FloatArray:
    """Straight lines P_f = a + b P_dem through a schedule, one for driving and one for braking (least squares).

    Returns
    -------
    float64[4] : a, b for driving, a, b for braking; W and 1
    """
    lines = []
    for mask in (power_w > least_power_w, power_w < -least_power_w):
        if np.count_nonzero(mask) < 2:
            lines += [0.0, 0.5]
            continue
        demand = power_w[mask]
        design = np.column_stack((np.ones_like(demand), demand))
        lines += np.linalg.lstsq(design, front_share[mask] * demand, rcond=None)[0].tolist()
    return np.array(lines)
