# SPDX-License-Identifier: Apache-2.0
"""`instantaneous_slip`: the split of least battery power for the same road force, with load transfer and settled slips.

It changes only if that saves enough.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from iwm_power_manager.control.strategies.instantaneous import cheapest_share
from iwm_power_manager.control.strategy import Situation, Strategy
from iwm_power_manager.control.table import PolicyTable
from iwm_power_manager.jit import kernel
from iwm_power_manager.model.parameters import VehicleParams

if TYPE_CHECKING:
    from iwm_power_manager.control.settings import Settings


@kernel
def choose(situation: Situation, settings: Settings, vehicle: VehicleParams, policy: PolicyTable) -> float:
    """The cheapest share, slip counted, where it saves `switching_power_w`."""
    return cheapest_share(situation, True, settings.switching_power_w, vehicle, policy)


STRATEGY = Strategy("instantaneous_slip", 3, choose)
