# SPDX-License-Identifier: Apache-2.0
"""Many steps of the law in one call: what the law remembers stays in compiled code from step to step."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iwm_power_manager.control.law import step
from iwm_power_manager.control.record import decided, measurement_of
from iwm_power_manager.control.settings import Settings
from iwm_power_manager.control.table import PolicyTable
from iwm_power_manager.control.types import ControllerState
from iwm_power_manager.jit import kernel
from iwm_power_manager.model.parameters import VehicleParams

FloatArray = NDArray[np.float64]

_decided = kernel(decided)
_measurement = kernel(measurement_of)


@kernel
def repeat(
    numbers: FloatArray,
    state: ControllerState,
    settings: Settings,
    vehicle: VehicleParams,
    policy: PolicyTable,
    results: FloatArray,
) -> ControllerState:
    """Steps of the law, one after the other.

    Parameters
    ----------
    numbers : float64[steps, `record.SIGNALS`], of which the measurements count
    state : before the first
    results : float64[steps, `record.DECIDED_NAMES`], filled

    Returns
    -------
    ControllerState
        After the last step.
    """
    for i in range(numbers.shape[0]):
        command, after = step(_measurement(numbers[i]), state, settings, vehicle, policy)
        found = _decided(command, state, after)
        for k in range(len(found)):
            results[i, k] = found[k]
        state = after
    return state
