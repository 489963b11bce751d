# SPDX-License-Identifier: Apache-2.0
"""`equal`: half to each axle (the paper's ED)."""

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
    """Half."""
    return 0.5


STRATEGY = Strategy("equal", 0, choose, decides_without_demand=True)
