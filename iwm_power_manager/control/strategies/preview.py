# SPDX-License-Identifier: Apache-2.0
"""`preview`: plays a schedule made with the whole cycle known; the bound for all others."""

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
    """The schedule's share of this decision; its last one holds."""
    return policy.schedule[min(situation.decisions, policy.schedule.size - 1)]


STRATEGY = Strategy("preview", 6, choose, knows_future=True, decides_without_demand=True)
