# SPDX-License-Identifier: Apache-2.0
"""`rule`: a straight line P_f(P_dem) fitted to a dynamic program (the paper's GRDP)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from iwm_power_manager.control.strategy import Situation, Strategy
from iwm_power_manager.control.table import PolicyTable
from iwm_power_manager.jit import kernel
from iwm_power_manager.model.parameters import VehicleParams

if TYPE_CHECKING:
    from iwm_power_manager.control.settings import Settings


@kernel
def choose(situation: Situation, settings: Settings, vehicle: VehicleParams, policy: PolicyTable) -> float:
    """P_f = a + b * P_dem, with one line for driving (`rule[0:2]`) and one for braking (`rule[2:4]`)."""
    power_w = situation.power_demand_w
    k = 0 if power_w > 0.0 else 2
    share = (policy.rule[k] + policy.rule[k + 1] * power_w) / power_w
    return min(max(share, 0.0), 1.0)


STRATEGY = Strategy("rule", 1, choose)
