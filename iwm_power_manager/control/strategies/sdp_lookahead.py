# SPDX-License-Identifier: Apache-2.0
"""`sdp_lookahead`: one step of Bellman's equation at the continuous state, with the solved cost-to-go.

It minimises the cost of the next step plus the expected cost of all that follows: no rounding to grid points. A change
costs what the budget of changes makes it (`control.budget`); what would have to come for it to pay is believed by half
only, and what is noise of the demand is averaged out (`control.persistence`).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from iwm_power_manager.control.budget import affordable, price_factor, price_level, price_units
from iwm_power_manager.control.persistence import SAMPLES, held_s
from iwm_power_manager.control.strategies.instantaneous import LEAST_DIFFERENCE_W
from iwm_power_manager.control.strategy import Situation, Strategy
from iwm_power_manager.control.table import PolicyTable
from iwm_power_manager.grid import interpolate5, locate
from iwm_power_manager.jit import kernel
from iwm_power_manager.model.decision import SLIP_QUASI_STEADY, Settled, settled, settled_step, step_cost_and_next
from iwm_power_manager.model.parameters import VehicleParams
from iwm_power_manager.model.pedals import full_power_w

if TYPE_CHECKING:
    from iwm_power_manager.control.settings import Settings


#: Part of the forecast that is believed where changes are budgeted. Changes are made where it is high, and there it is
#: too high on average: in hindsight they were worth half of it. Braking beyond what the motors can do, what is better
#: just now is no reason to move brake force about (docs/solver.md).
TRUST = 0.5
#: For the rest a rule of thumb counts: what is better now stays so for this long, s.
WORTH_S = 0.6

Cell = tuple[int, float]  # as `locate` gives it

#: From this gain on a demand counts as it is: averaging would change nothing that matters.
_LASTING = 0.99
#: Part of a cost that sums and products may lose.
_ROUNDING = 1e-9


class _Ahead(NamedTuple):
    """What a demand leads to, whatever the share, where slip is settled; the cells it and its end are in."""

    settled: Settled
    power: Cell
    speed: Cell
    slip_front: Cell
    slip_rear: Cell


@kernel
def _ahead(power_demand_w: float, situation: Situation, vehicle: VehicleParams, policy: PolicyTable) -> _Ahead:
    before = settled(power_demand_w, situation.speed_mps, vehicle, policy.problem)
    return _Ahead(
        before,
        locate(policy.power_w, power_demand_w),
        locate(policy.speed_mps, before.speed_mps),
        locate(policy.slip_front, 0.0),
        locate(policy.slip_rear, 0.0),
    )


@kernel
def _cell_of(k: int, share: float, policy: PolicyTable) -> Cell:
    """Where a share, perhaps the k-th, lies among the previous shares, which mostly are the same ones."""
    axis = policy.previous_share
    if 0 <= k < axis.size and axis[k] == share:
        return k, 0.0
    return locate(axis, share)


@kernel
def choose(situation: Situation, settings: Settings, vehicle: VehicleParams, policy: PolicyTable) -> float:
    """Share that minimises eq. 31, among those whose change the budget can afford."""
    previous = situation.previous_share
    used = situation.changes_used
    factor = price_factor(used, policy.changes_per_min)
    level = price_level(factor) if policy.dearer_cost_j.shape[0] > 0 else 0.0
    price = factor * policy.switching_cost_j
    budgeted = policy.changes_per_min > 0.0
    ahead = _ahead(situation.power_demand_w, situation, vehicle, policy)
    # Each kernel is called in one place, so that the compiler puts it there: a car and a policy are much to pass on.
    best, best_cost = previous, math.inf
    for k in range(-1, policy.share.size):
        share, switching = previous, -LEAST_DIFFERENCE_W * policy.problem.dt_s
        if k >= 0:
            share = policy.share[k]
            move = share - previous
            if move == 0.0 or not affordable(share, previous, used, policy.changes_per_min):
                continue
            switching = price * (price_units(move) if budgeted else abs(move)) + policy.switching_fixed_cost_j
        cell = _cell_of(k, share, policy)
        # Most shares are worse for certain than the best so far, before anything is solved for them.
        for least in (policy.problem.slip_model == SLIP_QUASI_STEADY, False):
            cost = _cost_j(ahead, situation, share, cell, least, level, vehicle, policy) + switching
            if cost - _ROUNDING * abs(cost) >= best_cost:
                break
        if cost < best_cost:
            best_cost = cost
            best = share
    return best


@kernel
def _cost_j(
    ahead: _Ahead,
    situation: Situation,
    share: float,
    cell: Cell,
    least: bool,
    level: float,
    vehicle: VehicleParams,
    policy: PolicyTable,
) -> float:
    """Cost of a step with this share and of all that follows, J, in the mean over what the demand jitters between."""
    gain = situation.jitter.gain
    demand_w = situation.power_demand_w
    trust, steps = 1.0, 1.0
    if policy.changes_per_min > 0.0 and demand_w > -full_power_w(situation.speed_mps, vehicle):
        trust = TRUST
        steps = TRUST + (1.0 - TRUST) * WORTH_S / policy.problem.dt_s
    samples = 0
    if gain <= _LASTING:
        samples = min(SAMPLES, situation.jitter.taken)
        steps += held_s(gain) / policy.problem.dt_s
    total = weights = 0.0
    weight = gain
    for i in range(-1, samples):
        if i >= 0:
            demand_w = situation.jitter.samples_w[i]
            ahead = _ahead(demand_w, situation, vehicle, policy)
        cost = _demand_cost_j(ahead, demand_w, situation, share, cell, least, level, steps, trust, vehicle, policy)
        if gain > _LASTING:
            return cost
        total += weight * cost
        weights += weight
        weight *= 1.0 - gain
    return total / weights


@kernel
def _demand_cost_j(
    ahead: _Ahead,
    power_demand_w: float,
    situation: Situation,
    share: float,
    cell: Cell,
    least: bool,
    level: float,
    steps: float,
    trust: float,
    vehicle: VehicleParams,
    policy: PolicyTable,
) -> float:
    """Right-hand side of eq. 31 for one demand and one share, J, without the price of the change.

    `cell` is the share's among the previous shares, `steps` how many times the step's cost counts, `trust` the part of
    what follows; `least` asks for a bound, never larger but for rounding.
    """
    speed, problem = situation.speed_mps, policy.problem
    a, fa = ahead.power
    b, fb = ahead.speed
    c, fc = ahead.slip_front
    d, fd = ahead.slip_rear
    e, fe = cell
    if problem.slip_model == SLIP_QUASI_STEADY:
        outcome = settled_step(ahead.settled, power_demand_w, speed, share, least, vehicle, problem)
    else:
        outcome = step_cost_and_next(
            power_demand_w, speed, situation.front_slip, situation.rear_slip, share, vehicle, problem
        )
        b, fb = locate(policy.speed_mps, outcome.speed_mps)
        c, fc = locate(policy.slip_front, outcome.slip_front)
        d, fd = locate(policy.slip_rear, outcome.slip_rear)
    if level <= 0.0:
        follow_up = interpolate5(policy.expected_cost_j, a, fa, b, fb, c, fc, d, fd, e, fe)
    else:
        upper = min(int(level), policy.dearer_cost_j.shape[0] - 1)
        low = policy.expected_cost_j if upper == 0 else policy.dearer_cost_j[upper - 1]
        follow_up = interpolate5(low, a, fa, b, fb, c, fc, d, fd, e, fe)
        high = interpolate5(policy.dearer_cost_j[upper], a, fa, b, fb, c, fc, d, fd, e, fe)
        follow_up += (level - upper) * (high - follow_up)
    return steps * outcome.cost_j + trust * policy.discount * follow_up


STRATEGY = Strategy("sdp_lookahead", 5, choose, needs_policy=True)
