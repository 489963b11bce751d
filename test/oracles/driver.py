# SPDX-License-Identifier: Apache-2.0
"""The driver in plain Python: what force is wanted, which pedal gives it, what the integral does."""

from __future__ import annotations

from oracles.physics import road_load
from oracles.step import G


def look(integral, speed, trace, ahead, slope, grade, dt, vehicle):
    """Accelerator, brake, power demand and the error integral afterwards."""
    settings, motor, radius = vehicle.driver, vehicle.front.motor, vehicle.front.wheel.radius_m
    rolling = max(speed, settings.power_speed_floor_mps)
    full_brake = settings.full_brake_g * vehicle.chassis.mass_kg * G * rolling
    if max(trace, ahead) < 0.2 and speed < 0.3:
        return 0.0, 0.1, -0.1 * full_brake, 0.0
    mass = vehicle.chassis.mass_kg + 4.0 * vehicle.front.wheel.inertia_kgm2 / radius**2
    error = trace - speed
    wanted = mass * slope + road_load(speed, grade, vehicle.chassis)
    wanted += settings.proportional_n_per_mps * error + settings.integral_n_per_m * integral
    full = 4.0 * min(motor.peak_torque_nm * rolling / radius, motor.max_power_w) if wanted > 0.0 else full_brake
    pedal = abs(wanted) * rolling / full
    # A pedal on the floor: an error it cannot remove must not wind up.
    stuck = pedal > 1.0 and error * wanted > 0.0
    pedal = min(pedal, 1.0)
    after = integral if stuck else integral + error * dt
    return (pedal, 0.0, pedal * full, after) if wanted > 0.0 else (0.0, pedal, -pedal * full, after)
