# SPDX-License-Identifier: Apache-2.0
"""Limits of the battery (eq. 24, 43), with their derating by charge and temperature."""

from __future__ import annotations

from iwm_power_manager.jit import kernel
from iwm_power_manager.model.motor import electrical_power_w
from iwm_power_manager.model.parameters import Battery, VehicleParams


@kernel
def fade(value: float, zero_at: float, full_at: float) -> float:
    """0 at and beyond `zero_at`, 1 at and beyond `full_at`, linear between; the two may come in either order."""
    return min(max((value - zero_at) / (full_at - zero_at), 0.0), 1.0)


@kernel
def battery_limits_w(soc: float, temperature_degc: float, battery: Battery) -> tuple[float, float]:
    """Electrical power the battery may give and take, W, both >= 0.

    A temperature that is not known (NaN) derates nothing.

    Returns
    -------
    discharge limit, charge limit
    """
    b = battery
    discharge = b.discharge_limit_w * fade(soc, b.discharge_zero_below_soc, b.discharge_full_above_soc)
    charge = b.charge_limit_w * fade(soc, b.charge_zero_above_soc, b.charge_full_below_soc)
    if temperature_degc == temperature_degc:
        hot = fade(temperature_degc, b.power_zero_above_degc, b.power_full_below_degc)
        discharge *= hot
        charge *= hot * fade(temperature_degc, b.charge_zero_below_degc, b.charge_full_above_degc)
    return discharge, charge


@kernel
def wheels_power_w(
    torque_nm: tuple[float, float, float, float],
    speed_radps: tuple[float, float, float, float],
    factor: float,
    vehicle: VehicleParams,
) -> float:
    """Electrical power of the four motors, W (eq. 23), with each torque times a factor."""
    front = vehicle.front.motor
    rear = vehicle.rear.motor
    # Axle by axle: left and right alike give the bits of twice an axle's.
    return (
        electrical_power_w(factor * torque_nm[0], speed_radps[0], front)
        + electrical_power_w(factor * torque_nm[1], speed_radps[1], front)
    ) + (
        electrical_power_w(factor * torque_nm[2], speed_radps[2], rear)
        + electrical_power_w(factor * torque_nm[3], speed_radps[3], rear)
    )


@kernel
def wheels_scale(
    torque_nm: tuple[float, float, float, float],
    speed_radps: tuple[float, float, float, float],
    discharge_limit_w: float,
    charge_limit_w: float,
    vehicle: VehicleParams,
) -> float:
    """Largest factor 0..1 on the motor torques that keeps the battery inside its limits (eq. 24, 43).

    Where even standby or losses at zero torque are too much, the factor is 0: torque cannot help then. So it is where
    both limits are 0: that switches the motors off.
    """
    power = wheels_power_w(torque_nm, speed_radps, 1.0, vehicle)
    if -charge_limit_w <= power <= discharge_limit_w:
        return 1.0
    charging = power < -charge_limit_w
    low = 0.0
    high = 1.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        power = wheels_power_w(torque_nm, speed_radps, middle, vehicle)
        # Only the side that was violated: the losses of a weak regeneration, which an empty battery cannot cover, must
        # not hide the stronger one that covers them.
        if (power >= -charge_limit_w) if charging else (power <= discharge_limit_w):
            low = middle
        else:
            high = middle
    power = wheels_power_w(torque_nm, speed_radps, low, vehicle)
    return low if -charge_limit_w <= power <= discharge_limit_w else 0.0
