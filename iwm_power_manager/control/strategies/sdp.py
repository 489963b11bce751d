# SPDX-License-Identifier: Apache-2.0
"""`sdp`: the share of the solved policy, looked up in its table."""

from __future__ import annotations

from typing import TYPE_CHECKING

from iwm_power_manager.control.strategy import Situation, Strategy
from iwm_power_manager.control.table import PolicyTable
from iwm_power_manager.grid import interpolate5, locate
from iwm_power_manager.jit import kernel
from iwm_power_manager.model.parameters import VehicleParams

if TYPE_CHECKING:
    from iwm_power_manager.control.settings import Settings


@kernel
def choose(situation: Situation, settings: Settings, vehicle: VehicleParams, policy: PolicyTable) -> float:
    """Share from the solved policy, interpolated; outside its grid the edge's share holds."""
    a, fa = locate(policy.power_w, situation.power_demand_w)
    b, fb = locate(policy.speed_mps, situation.speed_mps)
    c, fc = locate(policy.slip_front, situation.front_slip)
    d, fd = locate(policy.slip_rear, situation.rear_slip)
    e, fe = locate(policy.previous_share, situation.previous_share)
    return min(max(interpolate5(policy.front_share, a, fa, b, fb, c, fc, d, fd, e, fe), 0.0), 1.0)


STRATEGY = Strategy("sdp", 4, choose, needs_policy=True)
