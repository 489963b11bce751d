# SPDX-License-Identifier: Apache-2.0
"""How fast a car can go on the level: where its motors' power meets the road load (eq. 3, 4)."""

from __future__ import annotations

from iwm_power_manager.model.parameters import Chassis, VehicleParams

_GRAVITY_MPS2 = 9.81


def motor_power_w(vehicle: VehicleParams) -> float:
    """Power of all motors, W: the unit of a relative power axis."""
    return 2.0 * (vehicle.front.motor.max_power_w + vehicle.rear.motor.max_power_w)


def top_speed_mps(chassis: Chassis, power_w: float, at_most_mps: float = 100.0) -> float:
    """Speed at which the road load takes this mechanical power, m/s: with all motors' the unit of a speed axis."""
    drag = 0.5 * chassis.air_density_kgpm3 * chassis.frontal_area_m2 * chassis.drag_coefficient
    rolling = chassis.rolling_resistance * chassis.mass_kg * _GRAVITY_MPS2
    low, high = 0.0, at_most_mps
    for _ in range(60):
        middle = 0.5 * (low + high)
        if (drag * middle * middle + rolling) * middle < power_w:
            low = middle
        else:
            high = middle
    return high
