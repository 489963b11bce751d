# SPDX-License-Identifier: Apache-2.0
"""`sdp_lookahead`: one step of Bellman's equation at the continuous state, with the solved cost-to-go.

It minimises the cost of the next step plus the expected cost of all that follows: no rounding to grid points. A change
costs what the budget of changes makes it (`control.budget`); what would have to come for it to pay is believed by half
only, and what is noise of the demand is averaged out (`control.persistence`).
"""

from __future__ import annotations

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

if TYPE_CHECKING:
    from iwm_power_manager.control.settings import Settings


#: Part of the forecast that is believed, driving, where changes are budgeted. Changes are made where it is high, and
#: there it is too high on average: in hindsight they were worth half of it. Braking, what is better just now is no
#: reason to move brake force about (docs/solver.md).
TRUST = 0.5
#: For the rest a rule of thumb counts: what is better now stays so for this long, s.
WORTH_S = 0.6

Cell = tuple[int, float]  # as `locate` gives it

#: From this gain on a demand counts as it is: averaging would change nothing that matters.
_LASTING = 0.99


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
def _cell_of(k: int, policy: PolicyTable) -> Cell:
    """Where the k-th share lies among the previous shares, which mostly are the same ones."""
    axis, share = policy.previous_share, policy.share[k]
    if k < axis.size and axis[k] == share:
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
    best = previous
    stay = locate(policy.previous_share, previous)
    best_cost = _cost_j(ahead, situation, previous, stay, level, vehicle, policy)
    best_cost -= LEAST_DIFFERENCE_W * policy.problem.dt_s
    for k in range(policy.share.size):
        share = policy.share[k]
        move = share - previous
        if move == 0.0 or not affordable(share, previous, used, policy.changes_per_min):
            continue
        switching = price * (price_units(move) if budgeted else abs(move)) + policy.switching_fixed_cost_j
        cost = _cost_j(ahead, situation, share, _cell_of(k, policy), level, vehicle, policy) + switching
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
    level: float,
    vehicle: VehicleParams,
    policy: PolicyTable,
) -> float:
    """Cost of a step with this share and of all that follows, J, in the mean over what the demand jitters between."""
    gain = situation.jitter.gain
    demand_w = situation.power_demand_w
    trust, steps = 1.0, 1.0
    if policy.changes_per_min > 0.0 and demand_w > 0.0:
        trust = TRUST
        steps = TRUST + (1.0 - TRUST) * WORTH_S / policy.problem.dt_s
    if gain > _LASTING:
        return _demand_cost_j(ahead, demand_w, situation, share, cell, level, steps, trust, vehicle, policy)
    steps += held_s(gain) / policy.problem.dt_s
    total = gain * _demand_cost_j(ahead, demand_w, situation, share, cell, level, steps, trust, vehicle, policy)
    weights = gain
    weight = gain
    for i in range(min(SAMPLES, situation.jitter.taken)):
        weight *= 1.0 - gain
        sample_w = situation.jitter.samples_w[i]
        sampled = _ahead(sample_w, situation, vehicle, policy)
        weights += weight
        total += weight * _demand_cost_j(
            sampled, sample_w, situation, share, cell, level, steps, trust, vehicle, policy
        )
    return total / weights


@kernel
def _demand_cost_j(
    ahead: _Ahead,
    power_demand_w: float,
    situation: Situation,
    share: float,
    cell: Cell,
    level: float,
    steps: float,
    trust: float,
    vehicle: VehicleParams,
    policy: PolicyTable,
) -> float:
    """Right-hand side of eq. 31 for one demand and one share, J, without the price of the change.

    `cell` is the share's among the previous shares, `steps` how many times the step's cost counts, `trust` the part of
    what follows.
    """
    speed, problem = situation.speed_mps, policy.problem
    a, fa = ahead.power
    b, fb = ahead.speed
    c, fc = ahead.slip_front
    d, fd = ahead.slip_rear
    e, fe = cell
    if problem.slip_model == SLIP_QUASI_STEADY:
        outcome = settled_step(ahead.settled, power_demand_w, speed, share, vehicle, problem)
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
