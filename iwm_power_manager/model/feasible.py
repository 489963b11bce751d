# SPDX-License-Identifier: Apache-2.0
"""Whether a car can follow a trace, and what following it takes: plain sums over the trace, no simulation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iwm_power_manager import trace_units
from iwm_power_manager.cycle import Cycle
from iwm_power_manager.model.parameters import Axle, VehicleParams

_GRAVITY_MPS2 = 9.81
_WINDOW_S = 1.0
#: Shares of what a car can do that count as more than it can: a driver gets away with less.
_MARGIN = 1.02
#: Few roads are steeper; a grade in percent or degrees is, in the hills, beyond what a cycle may have at all.
_STEEP = 0.2

FloatArray = NDArray[np.float64]


def _forces(cycle: Cycle, car: VehicleParams) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Time (s), speed (m/s) and force at the road (N, braking negative) of each second from each point of a trace."""
    time, chassis = cycle.time_s, car.chassis
    window = min(_WINDOW_S, cycle.duration_s)
    start = np.minimum(time, time[-1] - window)
    before, after = (np.interp(start + shift, time, cycle.speed_mps) for shift in (0.0, window))
    speed = 0.5 * (before + after)
    slope = np.interp(start + 0.5 * window, time, cycle.grade)
    inertia = sum(2.0 * a.wheel.inertia_kgm2 / a.wheel.radius_m**2 for a in (car.front, car.rear))
    drag = 0.5 * chassis.air_density_kgpm3 * chassis.frontal_area_m2 * chassis.drag_coefficient
    weight = chassis.mass_kg * _GRAVITY_MPS2 / np.sqrt(1.0 + slope * slope)
    load = drag * speed * speed + weight * (slope + chassis.rolling_resistance)
    force = (chassis.mass_kg + inertia) * (after - before) / window + np.where(speed > 0.0, load, 0.0)
    return start, speed, force


def _driving_limit_n(axle: Axle, speed_mps: FloatArray) -> FloatArray:
    wheel_speed = np.maximum(speed_mps / axle.wheel.radius_m, 1e-3)
    torque = np.minimum(axle.motor.peak_torque_nm, axle.motor.max_power_w / wheel_speed)
    return 2.0 * torque / axle.wheel.radius_m


def trace_warnings(cycle: Cycle, car: VehicleParams, friction: float) -> list[str]:
    """What of a trace this car cannot follow on this road, one line for each reason, and which unit looks wrong.

    Means over a second against the peak torque and power of the motors, the battery's limit without losses, the grip of
    all four tyres, and the friction brakes. Heat, load transfer and slip come on top: a trace without a warning may be
    lost all the same.
    """
    time, speed, force = _forces(cycle, car)
    grip = friction * car.chassis.mass_kg * _GRAVITY_MPS2
    motors = _driving_limit_n(car.front, speed) + _driving_limit_n(car.rear, speed)
    battery = car.battery.discharge_limit_w / np.maximum(speed, 1e-3)
    brakes = sum(2.0 * a.friction_brake.max_torque_nm / a.wheel.radius_m for a in (car.front, car.rear))
    span = np.gradient(time) if time.size > 2 else np.full(time.size, cycle.duration_s / max(time.size, 1))
    lines = []
    for what, needed, limit in (
        ("the motors give", force, motors),
        ("the battery gives", force, battery),
        (f"the tyres carry at friction {friction:g}", force, np.full_like(force, grip)),
        (f"the tyres carry in braking at friction {friction:g}", -force, np.full_like(force, grip)),
        ("the friction brakes give", -force, np.full_like(force, brakes)),
    ):
        over = needed > _MARGIN * limit
        if np.any(over):
            at = int(np.argmax(needed / np.maximum(limit, 1e-9)))
            lines.append(
                f"{cycle.name}: asks {needed[at]:.0f} N at {time[at]:.4g} s ({3.6 * speed[at]:.0f} km/h), and "
                f"{what} {limit[at]:.0f} N; more than they can for {float(np.sum(span[over])):.3g} s in all"
            )
    steepest = float(np.max(np.abs(cycle.grade)))
    if steepest > _STEEP:
        steep = f"grade reaches {steepest:.3g}, a slope of {100.0 * steepest:.3g} %, as few roads have"
        lines.append(f"{cycle.name}: {steep}: is it in percent or degrees?")
    lively = trace_units.too_lively(cycle.time_s, cycle.speed_mps)
    return [*lines, f"{cycle.name}: {lively}"] if lively else lines


def traction_wh_per_km(cycle: Cycle, car: VehicleParams) -> float:
    """Energy at the wheels that driving a trace takes, Wh/km: what speeds the car up and overcomes the road load."""
    step = np.diff(cycle.time_s)
    speed = 0.5 * (cycle.speed_mps[1:] + cycle.speed_mps[:-1])
    chassis = car.chassis
    inertia = sum(2.0 * a.wheel.inertia_kgm2 / a.wheel.radius_m**2 for a in (car.front, car.rear))
    slope = 0.5 * (cycle.grade[1:] + cycle.grade[:-1])
    drag = 0.5 * chassis.air_density_kgpm3 * chassis.frontal_area_m2 * chassis.drag_coefficient
    load = drag * speed**2 + chassis.mass_kg * _GRAVITY_MPS2 * (slope + chassis.rolling_resistance)
    force = (chassis.mass_kg + inertia) * np.diff(cycle.speed_mps) / step + load
    joules = float(np.sum(np.maximum(force * speed, 0.0) * step))
    return joules / 3600.0 / max(cycle.distance_m / 1000.0, 1e-9)
