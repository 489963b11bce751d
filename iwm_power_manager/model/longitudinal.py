# SPDX-License-Identifier: Apache-2.0
"""Longitudinal dynamics of car and wheels (eq. 1, 2, 6-11): one implicit step.

Wheel slip is stiff: at 1 m/s a wheel settles in 0.3 ms, at 30 m/s in 9 ms. The step is backward Euler: each wheel's
speed solves eq. 11 with the tyre force at the end of the step, and the car's speed solves eq. 1 with the sum of these
forces. It is stable at any step size and speed, standstill included. Torques hold through the step.

The step keeps the books exactly: forces are constant over the step, so a force times the mean of the speeds before and
after it is the energy that flowed, and kinetic energies, works and losses add up to rounding error whatever the step
size (see `iwm_sim.plant`).

Left and right are alike here, so that a wheel of each axle is solved; `iwm_sim.double_track` has four wheels of their
own. The car only rolls forwards: brakes, bearing drag and rolling resistance are Coulomb friction, which stops a motion
and holds, but never reverses it; a car that would roll backwards stands still.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from iwm_power_manager.jit import kernel
from iwm_power_manager.model.chassis import aerodynamic_force_n, grade_force_n, normal_forces_n, rolling_force_n
from iwm_power_manager.model.parameters import Axle, Tyre, VehicleParams, Wheel
from iwm_power_manager.model.tyre import friction_and_slope, friction_coefficient, peak_ratio, slip_ratio

Two = tuple[float, float]  # front, rear


class Speeds(NamedTuple):
    """Speeds of car (m/s) and wheels (rad/s)."""

    car_mps: float
    front_radps: float
    rear_radps: float


class Torques(NamedTuple):
    """What acts on a wheel of each axle through a step, N m: motor, and what brake and drag exert at most (>= 0)."""

    front_motor_nm: float
    rear_motor_nm: float
    front_resisting_nm: float
    rear_resisting_nm: float


class Moved(NamedTuple):
    """A step: speeds at its end, and what acted during it.

    Attributes
    ----------
    front_force_n, rear_force_n : of a tyre, driving positive
    front_resisting_nm, rear_resisting_nm : what brake and idle drag really exerted, at most what they were told, >= 0
    rolling_force_n : what rolling resistance really exerted (less than eq. 4 only while it holds the car)
    """

    speeds: Speeds
    front_force_n: float
    rear_force_n: float
    front_resisting_nm: float
    rear_resisting_nm: float
    rolling_force_n: float


@kernel
def wheel_step(
    wheel_speed_radps: float,
    speed_after_mps: float,
    motor_torque_nm: float,
    resisting_torque_nm: float,
    normal_force_n: float,
    friction: float,
    dt_s: float,
    wheel: Wheel,
    tyre: Tyre,
) -> tuple[float, float, float]:
    """One wheel over one step at a known car speed (eq. 11).

    Safeguarded Newton on I (w1 - w0) / dt + r F(w1) = T. The tyre force is bounded, which brackets the root.

    Returns
    -------
    wheel speed after the step (rad/s), tyre force (N), torque the brake really exerted (N m)
    """
    radius = wheel.radius_m
    inertia_rate = wheel.inertia_kgm2 / dt_s
    torque = motor_torque_nm - resisting_torque_nm
    reach = radius * abs(friction) * peak_ratio(tyre) * normal_force_n / inertia_rate
    free = wheel_speed_radps + torque / inertia_rate
    low = free - reach
    high = free + reach
    speed = wheel_speed_radps
    if high > 0.0:
        speed = min(max(speed, low), high)
        change = high - low
        for _ in range(100):
            rim = radius * speed
            denominator = max(rim, speed_after_mps, tyre.slip_speed_floor_mps)
            slip = (rim - speed_after_mps) / denominator
            mu, slope = friction_and_slope(slip, friction, tyre)
            slip_rate = radius * speed_after_mps / (rim * rim) if denominator == rim else radius / denominator
            residual = inertia_rate * (speed - free) + radius * normal_force_n * mu
            gradient = inertia_rate + radius * normal_force_n * slope * slip_rate
            if residual > 0.0:
                high = speed
            else:
                low = speed
            next_speed = speed - residual / gradient if gradient > 0.0 else low - 1.0
            # The tyre's S-shaped curve can send Newton to and fro: halve where the steps do not shrink.
            if not low <= next_speed <= high or abs(next_speed - speed) > 0.5 * abs(change):
                next_speed = 0.5 * (low + high)
            change = next_speed - speed
            speed = next_speed
            if abs(change) <= 1e-11 * (1.0 + abs(speed)):
                break
        if speed > 0.0:
            return speed, (torque - inertia_rate * (speed - wheel_speed_radps)) / radius, resisting_torque_nm
    # The brake (or the drag) stops the wheel within the step and holds it.
    force = normal_force_n * friction_coefficient(
        slip_ratio(0.0, speed_after_mps, radius, tyre.slip_speed_floor_mps), friction, tyre
    )
    return 0.0, force, motor_torque_nm - radius * force + inertia_rate * wheel_speed_radps


@kernel
def _inertia_ratio(axle: Axle, mass_kg: float) -> float:
    """Inertia of an axle's two wheels, as a mass at the rim, over the car's mass."""
    return 2.0 * axle.wheel.inertia_kgm2 / (axle.wheel.radius_m * axle.wheel.radius_m * mass_kg)


@kernel
def step(
    before: Speeds,
    torques: Torques,
    acceleration_mps2: float,
    grade: float,
    friction: Two,
    dt_s: float,
    vehicle: VehicleParams,
) -> Moved:
    """Advance car and wheels by one implicit step.

    Parameters
    ----------
    before : >= 0
    acceleration_mps2 : of the previous step; only a first guess
    grade : rise over run
    friction : peak friction coefficient under the front and the rear wheels
    dt_s : step, > 0
    """
    chassis, front, rear = vehicle.chassis, vehicle.front, vehicle.rear
    mass = chassis.mass_kg
    # A change of the car's speed drags the wheels' inertia along: the known slope makes the iteration a Newton step.
    coupling = 1.0 + (_inertia_ratio(front, mass) + _inertia_ratio(rear, mass))
    grade_force = grade_force_n(grade, chassis)
    rolling_drop = rolling_force_n(grade, chassis) * dt_s / mass
    after = max(before.car_mps + acceleration_mps2 * dt_s, 0.0)
    # The faster the car is assumed to be, the more the tyres slow it: the root lies between what was too slow and what
    # was too fast. Without the bracket the iteration would swing about a car that locked wheels bring to rest.
    low, high, last_change = 0.0, math.inf, math.inf
    f = r = (0.0, 0.0, 0.0)
    moved = coasting = after
    for _ in range(60):
        front_n, rear_n = normal_forces_n((after - before.car_mps) / dt_s, after, grade, chassis)
        motor, resisting = torques.front_motor_nm, torques.front_resisting_nm
        f = wheel_step(before.front_radps, after, motor, resisting, front_n, friction[0], dt_s, front.wheel, front.tyre)
        motor, resisting = torques.rear_motor_nm, torques.rear_resisting_nm
        r = wheel_step(before.rear_radps, after, motor, resisting, rear_n, friction[1], dt_s, rear.wheel, rear.tyre)
        tyres = f[1] + f[1] + r[1] + r[1]
        coasting = before.car_mps + dt_s / mass * (tyres - aerodynamic_force_n(after, chassis) - grade_force)
        moved = max(coasting - rolling_drop, 0.0)
        change = moved - after
        if abs(change) <= 1e-10 * (1.0 + moved):
            break
        if change > 0.0:
            low = after
        else:
            high = after
        after += change / coupling
        if high < math.inf and (not low < after < high or abs(change) > 0.5 * last_change):
            after = 0.5 * (low + high)
        last_change = abs(change)
    return Moved(Speeds(moved, f[0], r[0]), f[1], r[1], f[2], r[2], (coasting - moved) * mass / dt_s)
