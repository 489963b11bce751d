"""`sdp_lookahead`: one step of Bellman's equation at the continuous state, with the solved cost-to-go.

It minimises the cost of the next step plus the expected cost of all that follows: no rounding to grid points. What it
changed just now it is slow to take back.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from iwm_power_manager.control.strategies.instantaneous import LEAST_DIFFERENCE_W
from iwm_power_manager.control.strategy import Situation, Strategy
from iwm_power_manager.control.table import PolicyTable
from iwm_power_manager.grid import interpolate5, locate
from iwm_power_manager.jit import kernel
from iwm_power_manager.model.decision import step_cost_and_next
from iwm_power_manager.model.parameters import VehicleParams

if TYPE_CHECKING:
    from iwm_power_manager.control.settings import Settings


@kernel
def choose(situation: Situation, settings: Settings, vehicle: VehicleParams, policy: PolicyTable) -> float:
    """Share that minimises eq. 31. A change against the latest ones costs more, by `reversal_price`."""
    previous = situation.previous_share
    tendency = settings.reversal_price * situation.recent_change
    best = previous
    best_cost = _cost_j(situation, previous, 0.0, vehicle, policy) - LEAST_DIFFERENCE_W * policy.problem.dt_s
    for k in range(policy.share.size):
        share = policy.share[k]
        against = max(-tendency if share > previous else tendency, 0.0)
        cost = _cost_j(situation, share, against, vehicle, policy)
        if cost < best_cost:
            best_cost = cost
            best = share
    return best


@kernel
def _cost_j(situation: Situation, share: float, dearer: float, vehicle: VehicleParams, policy: PolicyTable) -> float:
    """Right-hand side of eq. 31 for one share, J; `dearer` adds that part to the price of the change."""
    outcome = step_cost_and_next(
        situation.power_demand_w,
        situation.speed_mps,
        situation.front_slip,
        situation.rear_slip,
        share,
        vehicle,
        policy.problem,
    )
    a, fa = locate(policy.power_w, situation.power_demand_w)
    b, fb = locate(policy.speed_mps, outcome.speed_mps)
    c, fc = locate(policy.slip_front, outcome.slip_front)
    d, fd = locate(policy.slip_rear, outcome.slip_rear)
    e, fe = locate(policy.previous_share, share)
    follow_up = interpolate5(policy.expected_cost_j, a, fa, b, fb, c, fc, d, fd, e, fe)
    switching = policy.switching_cost_j * (1.0 + dearer) * abs(share - situation.previous_share)
    if share != situation.previous_share:
        switching += policy.switching_fixed_cost_j
    return outcome.cost_j + switching + policy.discount * follow_up


STRATEGY = Strategy("sdp_lookahead", 5, choose, needs_policy=True)
