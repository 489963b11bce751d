# SPDX-License-Identifier: Apache-2.0
"""Steps of the law whose memory stays in compiled code: one at a time, for the node, and many in one call."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iwm_power_manager.control.law import step
from iwm_power_manager.control.record import decided, measurement_of
from iwm_power_manager.control.settings import Settings
from iwm_power_manager.control.table import PolicyTable
from iwm_power_manager.control.types import Command, ControllerState, Measurement
from iwm_power_manager.held import Held
from iwm_power_manager.jit import kernel
from iwm_power_manager.model.limits import battery_limits_w
from iwm_power_manager.model.parameters import VehicleParams

FloatArray = NDArray[np.float64]

_decided = kernel(decided)
_measurement = kernel(measurement_of)


@kernel
def battery_limits(soc: float, temperature_degc: float, vehicle: Held[VehicleParams]) -> tuple[float, float]:
    """Electrical power the car's battery may give and take, W (`limits.battery_limits_w`)."""
    return battery_limits_w(soc, temperature_degc, vehicle.value.battery)


@kernel
def advance(
    measurement: Measurement,
    before: Held[ControllerState],
    after: Held[ControllerState],
    settings: Settings,
    vehicle: Held[VehicleParams],
    policy: PolicyTable,
) -> tuple[Command, tuple[float, ...], float]:
    """One step of the law, from `before` to `after`.

    Returns
    -------
    Command
    values of `record.DECIDED_NAMES`
    friction the strategy is to assume in the next step
    """
    command, state = step(measurement, before.value, settings, vehicle.value, policy)
    numbers = _decided(command, before.value, state)
    after.value = state
    return command, numbers, state.friction.assumed


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
