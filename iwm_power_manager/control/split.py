"""Strategies: how much of the demand the front axle gets. One interface, `decide`, for all of them.

`equal` (the paper's ED) halves it. `rule` (GRDP) is a straight line P_f(P_dem) fitted to a dynamic program.
`instantaneous` searches the split of least battery power, blind to slip. `instantaneous_slip` does so with load
transfer and settled slips, for the same road force, and changes only if that saves enough. `sdp` looks the share up in
the solved policy. `sdp_lookahead` takes the solved cost-to-go instead and minimises, at the continuous state, the cost
of the next step plus the expected cost of all that follows: no rounding to grid points; what it changed just now it is
slow to take back. `preview` plays a schedule made with the whole cycle known.
"""

from __future__ import annotations

from iwm_power_manager.control.table import PolicyTable
from iwm_power_manager.control.types import (
    EQUAL,
    INSTANTANEOUS,
    INSTANTANEOUS_SLIP,
    PREVIEW,
    RULE,
    SDP,
    SDP_LOOKAHEAD,
    Settings,
)
from iwm_power_manager.grid import interpolate5, locate
from iwm_power_manager.jit import kernel
from iwm_power_manager.model.decision import step_cost_and_next
from iwm_power_manager.model.parameters import VehicleParams
from iwm_power_manager.model.quasi_steady import demand_force_n, split_power_w

#: Price of a joule that is not delivered, in joules: high enough that delivering always comes first.
PRICE_OF_MISSING = 20.0

#: Power that tells two splits apart, W. Front-only and rear-only are nearly equal on equal motors: rounding must not
#: make them change places.
LEAST_DIFFERENCE_W = 1e-3

#: A demand smaller than this is none, W: the split stays as it is.
LEAST_DEMAND_W = 1.0


@kernel
def decide(
    power_demand_w: float,
    speed_mps: float,
    front_slip: float,
    rear_slip: float,
    previous_share: float,
    recent_change: float,
    friction: float,
    decisions: int,
    settings: Settings,
    vehicle: VehicleParams,
    policy: PolicyTable,
) -> float:
    """Front share 0..1 the strategy chooses.

    Parameters
    ----------
    power_demand_w : at the wheels, braking negative
    speed_mps : vehicle speed
    front_slip, rear_slip : filtered slips
    previous_share : of the decision before
    recent_change : sum of the latest changes of the share, fading out
    friction : peak friction coefficient to assume
    decisions : decisions taken so far in this run
    """
    strategy = settings.strategy
    if strategy == EQUAL:
        return 0.5
    if strategy == PREVIEW:
        return policy.schedule[min(decisions, policy.schedule.size - 1)]
    if abs(power_demand_w) < LEAST_DEMAND_W:
        return previous_share
    if strategy == RULE:
        return rule_share(power_demand_w, policy)
    if strategy == INSTANTANEOUS:
        return cheapest_share(power_demand_w, speed_mps, previous_share, friction, False, 0.0, vehicle, policy)
    if strategy == INSTANTANEOUS_SLIP:
        return cheapest_share(
            power_demand_w, speed_mps, previous_share, friction, True, settings.switching_power_w, vehicle, policy
        )
    if strategy == SDP:
        return table_share(power_demand_w, speed_mps, front_slip, rear_slip, previous_share, policy)
    if strategy == SDP_LOOKAHEAD:
        return lookahead_share(
            power_demand_w,
            speed_mps,
            front_slip,
            rear_slip,
            previous_share,
            settings.reversal_price * recent_change,
            vehicle,
            policy,
        )
    return 0.5


@kernel
def rule_share(power_demand_w: float, policy: PolicyTable) -> float:
    """GRDP: P_f = a + b * P_dem, with one line for driving (`rule[0:2]`) and one for braking (`rule[2:4]`)."""
    k = 0 if power_demand_w > 0.0 else 2
    share = (policy.rule[k] + policy.rule[k + 1] * power_demand_w) / power_demand_w
    return min(max(share, 0.0), 1.0)


@kernel
def cheapest_share(
    power_demand_w: float,
    speed_mps: float,
    previous_share: float,
    friction: float,
    slip_aware: bool,
    switching_power_w: float,
    vehicle: VehicleParams,
    policy: PolicyTable,
) -> float:
    """Share on the policy's share axis (or the previous one) with the least battery power now."""
    force = demand_force_n(power_demand_w, speed_mps, friction, slip_aware, vehicle)
    speed = max(speed_mps, vehicle.driver.power_speed_floor_mps)
    power, missing = split_power_w(force, speed, previous_share, friction, slip_aware, vehicle)
    best = previous_share
    best_power = power + PRICE_OF_MISSING * missing * speed - LEAST_DIFFERENCE_W
    for k in range(policy.share.size):
        power, missing = split_power_w(force, speed, policy.share[k], friction, slip_aware, vehicle)
        power += PRICE_OF_MISSING * missing * speed + switching_power_w
        if power < best_power:
            best_power = power
            best = policy.share[k]
    return best


@kernel
def table_share(
    power_demand_w: float,
    speed_mps: float,
    front_slip: float,
    rear_slip: float,
    previous_share: float,
    policy: PolicyTable,
) -> float:
    """Share from the solved policy, interpolated; outside its grid the edge's share holds."""
    a, fa = locate(policy.power_w, power_demand_w)
    b, fb = locate(policy.speed_mps, speed_mps)
    c, fc = locate(policy.slip_front, front_slip)
    d, fd = locate(policy.slip_rear, rear_slip)
    e, fe = locate(policy.previous_share, previous_share)
    return min(max(interpolate5(policy.front_share, a, fa, b, fb, c, fc, d, fd, e, fe), 0.0), 1.0)


@kernel
def lookahead_share(
    power_demand_w: float,
    speed_mps: float,
    front_slip: float,
    rear_slip: float,
    previous_share: float,
    tendency: float,
    vehicle: VehicleParams,
    policy: PolicyTable,
) -> float:
    """Share that minimises eq. 31 at the continuous state, with the solved cost-to-go.

    Parameters
    ----------
    tendency : where the share has just been going, > 0 to the front; a change against it costs 1 + |tendency| times
        its price, proportional part
    """
    best = previous_share
    best_cost = (
        _cost_j(power_demand_w, speed_mps, front_slip, rear_slip, previous_share, previous_share, 0.0, vehicle, policy)
        - LEAST_DIFFERENCE_W * policy.problem.dt_s
    )
    for k in range(policy.share.size):
        share = policy.share[k]
        against = max(-tendency if share > previous_share else tendency, 0.0)
        cost = _cost_j(
            power_demand_w, speed_mps, front_slip, rear_slip, previous_share, share, against, vehicle, policy
        )
        if cost < best_cost:
            best_cost = cost
            best = share
    return best


@kernel
def _cost_j(
    power_demand_w: float,
    speed_mps: float,
    front_slip: float,
    rear_slip: float,
    previous_share: float,
    share: float,
    dearer: float,
    vehicle: VehicleParams,
    policy: PolicyTable,
) -> float:
    """Right-hand side of eq. 31 for one share, J; `dearer` adds that part to the price of the change."""
    outcome = step_cost_and_next(power_demand_w, speed_mps, front_slip, rear_slip, share, vehicle, policy.problem)
    a, fa = locate(policy.power_w, power_demand_w)
    b, fb = locate(policy.speed_mps, outcome.speed_mps)
    c, fc = locate(policy.slip_front, outcome.slip_front)
    d, fd = locate(policy.slip_rear, outcome.slip_rear)
    e, fe = locate(policy.previous_share, share)
    follow_up = interpolate5(policy.expected_cost_j, a, fa, b, fb, c, fc, d, fd, e, fe)
    switching = policy.switching_cost_j * (1.0 + dearer) * abs(share - previous_share)
    if share != previous_share:
        switching += policy.switching_fixed_cost_j
    return outcome.cost_j + switching + policy.discount * follow_up
