# SPDX-License-Identifier: Apache-2.0
"""`sdp_lookahead`: one step of Bellman's equation at the continuous state, with the solved cost-to-go.

It minimises the cost of the next step plus the expected cost of all that follows: no rounding to grid points. A change
costs what the budget of changes makes it (`control.budget`); what would have to come for it to pay is believed by half
only, and what is noise of the demand is averaged out (`control.persistence`), as far as a mean can.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from iwm_power_manager.control.budget import affordable, price_factor, price_level, price_units
from iwm_power_manager.control.persistence import SAMPLE_S, SAMPLES, carried_w, demand_ago, held_s, remembered_s
from iwm_power_manager.control.strategies.instantaneous import LEAST_DIFFERENCE_W
from iwm_power_manager.control.strategy import Situation, Strategy
from iwm_power_manager.control.table import PolicyTable
from iwm_power_manager.grid import Ends, ends, interpolate3_of_5
from iwm_power_manager.jit import kernel
from iwm_power_manager.model.decision import (
    SLIP_QUASI_STEADY,
    Settled,
    settled,
    settled_step,
    slip_followed,
    step_cost_and_next,
)
from iwm_power_manager.model.parameters import VehicleParams
from iwm_power_manager.model.pedals import full_power_w

if TYPE_CHECKING:
    from iwm_power_manager.control.settings import Settings


#: Part of the forecast that is believed where changes are budgeted. Changes are made where it is high, and there it is
#: too high on average: in hindsight they were worth half of it. Braking beyond what the motors can do, what is better
#: just now is no reason to move brake force about (docs/solver.md). What has just come up is the likelier too high: the
#: forecast is the mean of now and a step of the chain ago, and where eq. 31 asks for a change at both, it is believed.
TRUST = 0.5
#: For the rest a rule of thumb counts: what is better now stays so for this long, s.
WORTH_S = 0.8

#: From this gain on a demand counts as it is: averaging would change nothing that matters.
_LASTING = 0.99
#: Part of a cost that sums and products may lose.
_ROUNDING = 1e-9


class _Ahead(NamedTuple):
    """What a demand leads to, whatever the share, where slip is settled; the cells it and its end are in.

    `earlier` is the cell of the demand whose forecast counts beside that of this one.
    """

    settled: Settled
    power: Ends
    earlier: Ends
    speed: Ends
    slip_front: Ends
    slip_rear: Ends


@kernel
def _ahead(
    power_demand_w: float, earlier_w: float, situation: Situation, vehicle: VehicleParams, policy: PolicyTable
) -> _Ahead:
    before = settled(power_demand_w, situation.speed_mps, True, vehicle, policy.problem)
    return _Ahead(
        before,
        ends(policy.power_w, power_demand_w),
        ends(policy.power_w, earlier_w),
        ends(policy.speed_mps, before.speed_mps),
        ends(policy.slip_front, 0.0),
        ends(policy.slip_rear, 0.0),
    )


class _Sample(NamedTuple):
    """A demand that counts, and what of it is the same for all shares.

    `rolling` is as `ahead.settled` if no wheel slipped; `followed` is the part of its slip that wheels reach. `kept_j`
    is what a step at the share that is held costs.
    """

    demand_w: float
    ahead: _Ahead
    rolling: Settled
    followed: float
    kept_j: float


@kernel
def _sample(power_demand_w: float, situation: Situation, vehicle: VehicleParams, policy: PolicyTable) -> _Sample:
    speed, problem = situation.speed_mps, policy.problem
    ahead = _ahead(power_demand_w, power_demand_w, situation, vehicle, policy)
    rolling = settled(power_demand_w, speed, False, vehicle, problem)
    followed = slip_followed(ahead.settled.force_n, speed, SAMPLE_S, vehicle, problem)
    front, rear, kept = situation.front_slip, situation.rear_slip, situation.previous_share
    kept_j = step_cost_and_next(power_demand_w, speed, front, rear, kept, vehicle, problem).cost_j
    return _Sample(power_demand_w, ahead, rolling, followed, kept_j)


@kernel
def _before(k: int, situation: Situation, vehicle: VehicleParams) -> float:
    """The k-th of the demands before, W, as it would be now."""
    return carried_w(situation.jitter, k, situation.speed_mps, vehicle.driver.power_speed_floor_mps)


@kernel
def _jittering(situation: Situation, vehicle: VehicleParams, policy: PolicyTable) -> tuple[_Sample, ...]:
    """The present demand, all those before it that a jitter holds, and at the end the mean of those that count."""
    demand_w, gain = situation.power_demand_w, situation.jitter.gain
    weights = weight = gain
    mean_w = weight * demand_w
    for i in range(min(SAMPLES, situation.jitter.taken)):
        weight *= 1.0 - gain
        mean_w += weight * _before(i, situation, vehicle)
        weights += weight
    # Written out, since kernels make no arrays and numba no tuples in a loop; as many as `SAMPLES`.
    return (
        _sample(demand_w, situation, vehicle, policy),
        _sample(_before(0, situation, vehicle), situation, vehicle, policy),
        _sample(_before(1, situation, vehicle), situation, vehicle, policy),
        _sample(_before(2, situation, vehicle), situation, vehicle, policy),
        _sample(_before(3, situation, vehicle), situation, vehicle, policy),
        _sample(_before(4, situation, vehicle), situation, vehicle, policy),
        _sample(_before(5, situation, vehicle), situation, vehicle, policy),
        _sample(_before(6, situation, vehicle), situation, vehicle, policy),
        _sample(_before(7, situation, vehicle), situation, vehicle, policy),
        _sample(_before(8, situation, vehicle), situation, vehicle, policy),
        _sample(_before(9, situation, vehicle), situation, vehicle, policy),
        _sample(mean_w / weights, situation, vehicle, policy),
    )


@kernel
def _half_believed(power_demand_w: float, situation: Situation, vehicle: VehicleParams, policy: PolicyTable) -> bool:
    """Whether only a part of the forecast is believed: where changes are budgeted, but in braking beyond the motors."""
    return policy.changes_per_min > 0.0 and power_demand_w > -full_power_w(situation.speed_mps, vehicle)


@kernel
def _cell_of(k: int, share: float, policy: PolicyTable) -> Ends:
    """Where a share, perhaps the k-th, lies among the previous shares, which mostly are the same ones."""
    axis = policy.previous_share
    if 0 <= k < axis.size and axis[k] == share:
        return Ends(k, k, 0.0)
    return ends(axis, share)


class _Outlook(NamedTuple):
    """What a share costs in a step of the chain, and what is forecast to follow, J.

    `later_j` goes by the present demand, `earlier_j` by that of a step ago, where it counts; else they are the same.
    Where the demand jitters, `doubt_j` is the standard error of what a step saves against the share that is held.
    """

    step_j: float
    later_j: float
    earlier_j: float
    doubt_j: float


@kernel
def _balanced(vehicle: VehicleParams) -> float:
    """Share at which front and rear motors are loaded alike: 0.5 where they are equal."""
    front, rear = vehicle.front, vehicle.rear
    force = front.motor.peak_torque_nm / front.wheel.radius_m
    return force / (force + rear.motor.peak_torque_nm / rear.wheel.radius_m)


@kernel
def choose(situation: Situation, settings: Settings, vehicle: VehicleParams, policy: PolicyTable) -> float:
    """Share that minimises eq. 31, as far as it is believed, among those whose change the budget can afford."""
    previous = situation.previous_share
    used = situation.changes_used
    factor = price_factor(used, previous, policy.changes_per_min, policy.elasticity)
    level = price_level(factor) if policy.dearer_cost_j.shape[0] > 0 else 0.0
    price = factor * policy.switching_cost_j
    budgeted = policy.changes_per_min > 0.0
    balanced = _balanced(vehicle)
    demand_w = situation.power_demand_w
    gain = situation.jitter.gain
    half = _half_believed(demand_w, situation, vehicle, policy)
    steady = half and gain > _LASTING and remembered_s(situation.jitter) >= policy.problem.dt_s
    earlier_w = demand_ago(situation.jitter, demand_w, policy.problem.dt_s) if steady else demand_w
    held = held_s(gain) / policy.problem.dt_s if gain <= _LASTING else 0.0
    trust, steps = 1.0, 1.0 + held
    if half:
        trust = TRUST
        steps = TRUST + (1.0 - TRUST) * WORTH_S / policy.problem.dt_s + held
    ahead = _ahead(demand_w, earlier_w, situation, vehicle, policy)
    now = _Sample(demand_w, ahead, ahead.settled, 1.0, 0.0)
    seen: tuple[_Sample, ...] = (now, now, now, now, now, now, now, now, now, now, now, now)
    if gain <= _LASTING:
        seen = _jittering(situation, vehicle, policy)
    # Each kernel is called in one place, so that the compiler puts it there: a car and a policy are much to pass on.
    best, most = previous, 0.0
    kept = found = _Outlook(0.0, 0.0, 0.0, 0.0)
    worth = 0.0
    for k in range(-1, policy.share.size):
        share, switching = previous, LEAST_DIFFERENCE_W * policy.problem.dt_s
        if k >= 0:
            share = policy.share[k]
            move = share - previous
            if move == 0.0 or not affordable(share, previous, used, policy.changes_per_min):
                continue
            switching += price * (price_units(move) if budgeted else abs(move)) + policy.switching_fixed_cost_j
        cell = _cell_of(k, share, policy)
        bound = False
        # Most shares are worth less than the best so far for certain, before anything is solved for them.
        for least in (k >= 0 and policy.problem.slip_model == SLIP_QUASI_STEADY, False):
            found = _outlook(seen, situation, share, cell, least, bound, found, level, vehicle, policy)
            if k < 0:
                kept = found
                break
            bound = least
            step = kept.step_j - found.step_j
            later = policy.discount * (kept.later_j - found.later_j)
            earlier = policy.discount * (kept.earlier_j - found.earlier_j)
            worth = steps * step + trust * 0.5 * (later + earlier)
            if steady and step > 0.0:
                worth = max(worth, step + min(later, earlier))
            worth -= switching
            if budgeted and (share - previous) * (share - balanced) > 0.0:
                worth -= steps * found.doubt_j
            if worth + _ROUNDING * abs(kept.step_j) <= most:
                break
        if k >= 0 and worth > most:
            most = worth
            best = share
    return best


@kernel
def _outlook(
    seen: tuple[_Sample, ...],
    situation: Situation,
    share: float,
    cell: Ends,
    least: bool,
    bound: bool,
    found: _Outlook,
    level: float,
    vehicle: VehicleParams,
    policy: PolicyTable,
) -> _Outlook:
    """What this share costs, in the mean over what the demand jitters between.

    What a tyre's slip does not follow of the jitter costs what the slip of the mean demand costs.
    """
    speed, problem, gain = situation.speed_mps, policy.problem, situation.jitter.gain
    samples = min(SAMPLES, situation.jitter.taken) if gain <= _LASTING else 0
    lags = problem.slip_model == SLIP_QUASI_STEADY
    step = later = earlier = weights = unfollowed = saved = squares = spread = 0.0
    weight = gain
    for i in range(samples + 2 if lags else samples + 1):
        sample = seen[i if i <= samples else SAMPLES + 1]
        one = _demand_outlook(
            sample.ahead, sample.demand_w, situation, share, cell, least, bound, found, level, vehicle, policy
        )
        if gain > _LASTING:
            return one
        slipless_j = one.step_j
        if lags:
            slipless_j = settled_step(
                sample.rolling, sample.demand_w, speed, share, False, False, vehicle, problem
            ).cost_j
        slip_j = one.step_j - slipless_j
        if i > samples:
            step += unfollowed * slip_j
            break
        step += weight * (slipless_j + sample.followed * slip_j)
        unfollowed += weight * (1.0 - sample.followed)
        later += weight * one.later_j
        earlier += weight * one.earlier_j
        weights += weight
        saving = sample.kept_j - one.step_j
        saved += weight * saving
        squares += weight * saving * saving
        spread += weight * weight
        weight *= 1.0 - gain
    saved /= weights
    doubt = 0.0 if least else math.sqrt(max(squares / weights - saved * saved, 0.0) * spread) / weights
    if bound:
        return _Outlook(step / weights, found.later_j, found.earlier_j, doubt)
    return _Outlook(step / weights, later / weights, earlier / weights, doubt)


@kernel
def _demand_outlook(
    ahead: _Ahead,
    power_demand_w: float,
    situation: Situation,
    share: float,
    cell: Ends,
    least: bool,
    bound: bool,
    found: _Outlook,
    level: float,
    vehicle: VehicleParams,
    policy: PolicyTable,
) -> _Outlook:
    """Right-hand side of eq. 31 for one demand and one share, without the price of the change.

    `cell` is the share's among the previous shares; `least` asks for a bound, never larger but for rounding. What
    follows is that of `found` where there has been a `bound`: there, slip is settled, it is the same.
    """
    speed, problem = situation.speed_mps, policy.problem
    end, front, rear = ahead.speed, ahead.slip_front, ahead.slip_rear
    if problem.slip_model == SLIP_QUASI_STEADY:
        outcome = settled_step(ahead.settled, power_demand_w, speed, share, True, least, vehicle, problem)
        if bound:
            return _Outlook(outcome.cost_j, found.later_j, found.earlier_j, 0.0)
    else:
        outcome = step_cost_and_next(
            power_demand_w, speed, situation.front_slip, situation.rear_slip, share, vehicle, problem
        )
        end = ends(policy.speed_mps, outcome.speed_mps)
        front = ends(policy.slip_front, outcome.slip_front)
        rear = ends(policy.slip_rear, outcome.slip_rear)
    later = earlier = 0.0
    for corner in range(4):
        c, weight = (front.high, front.fraction) if corner & 1 else (front.low, 1.0 - front.fraction)
        d, part = (rear.high, rear.fraction) if corner & 2 else (rear.low, 1.0 - rear.fraction)
        weight *= part
        if weight == 0.0:
            continue
        expected = _expected_j(ahead.power, end, c, d, cell, level, policy)
        later += weight * expected
        if ahead.earlier != ahead.power:
            expected = _expected_j(ahead.earlier, end, c, d, cell, level, policy)
        earlier += weight * expected
    return _Outlook(outcome.cost_j, later, earlier, 0.0)


@kernel
def _expected_j(power: Ends, speed: Ends, c: int, d: int, share: Ends, level: float, policy: PolicyTable) -> float:
    """Expected cost-to-go at the c-th front and the d-th rear slip, at the price of this level."""
    if level <= 0.0:
        return interpolate3_of_5(policy.expected_cost_j, power, speed, c, d, share)
    upper = min(int(level), policy.dearer_cost_j.shape[0] - 1)
    below = policy.expected_cost_j if upper == 0 else policy.dearer_cost_j[upper - 1]
    low = interpolate3_of_5(below, power, speed, c, d, share)
    return low + (level - upper) * (interpolate3_of_5(policy.dearer_cost_j[upper], power, speed, c, d, share) - low)


STRATEGY = Strategy("sdp_lookahead", 5, choose, needs_policy=True)
