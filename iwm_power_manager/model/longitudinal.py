"""Longitudinal dynamics of car and wheels (eq. 1, 2, 6-11): one implicit step.

Wheel slip is stiff: at 1 m/s a wheel settles in 0.3 ms, at 30 m/s in 9 ms. The step is backward Euler: each wheel's
speed solves eq. 11 with the tyre force at the end of the step, and the car's speed solves eq. 1 with the sum of these
forces. It is stable at any step size and speed, standstill included. Torques hold through the step.

The step keeps the books exactly: forces are constant over the step, so a force times the mean of the speeds before and
after it is the energy that flowed, and kinetic energies, works and losses add up to rounding error whatever the step
size (see `iwm_sim.plant`).

The car only rolls forwards: brakes, bearing drag and rolling resistance are Coulomb friction, which stops a motion and
holds, but never reverses it; a car that would roll backwards stands still.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from iwm_power_manager.jit import kernel
from iwm_power_manager.model.chassis import aerodynamic_force_n, grade_force_n, normal_forces_n, rolling_force_n
from iwm_power_manager.model.parameters import Tyre, VehicleParams, Wheel
from iwm_power_manager.model.tyre import friction_and_slope, friction_coefficient, slip_ratio

Four = tuple[float, float, float, float]  # front_left, front_right, rear_left, rear_right


class Motion(NamedTuple):
    """Car and wheels at the end of a step, and the forces that acted during it.

    Attributes
    ----------
    speed_mps, wheel_speed_radps : at the end of the step
    tyre_force_n : of each wheel, driving positive
    resisting_torque_nm : what brake and idle drag really exerted, at most what they were told, >= 0
    rolling_force_n : what rolling resistance really exerted (less than eq. 4 only while it holds the car)
    """

    speed_mps: float
    wheel_speed_radps: Four
    tyre_force_n: Four
    resisting_torque_nm: Four
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
    reach = radius * abs(friction) * tyre.peak_factor * normal_force_n / inertia_rate
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
def step(
    speed_mps: float,
    wheel_speed_radps: Four,
    acceleration_mps2: float,
    motor_torque_nm: Four,
    resisting_torque_nm: Four,
    grade: float,
    friction: Four,
    dt_s: float,
    vehicle: VehicleParams,
) -> Motion:
    """Advance car and wheels by one implicit step.

    Parameters
    ----------
    speed_mps, wheel_speed_radps : before the step, >= 0
    acceleration_mps2 : of the previous step; only a first guess
    motor_torque_nm : at each wheel
    resisting_torque_nm : friction brake plus idle drag at each wheel, >= 0
    grade : rise over run
    friction : peak friction coefficient under each wheel
    dt_s : step, > 0
    """
    chassis = vehicle.chassis
    wheel = vehicle.front.wheel
    tyre = vehicle.front.tyre
    mass = chassis.mass_kg
    # A change of the car's speed drags the wheels' inertia along: the known slope makes the iteration a Newton step.
    coupling = 1.0 + 4.0 * wheel.inertia_kgm2 / (wheel.radius_m * wheel.radius_m * mass)
    grade_force = grade_force_n(grade, chassis)
    rolling_drop = rolling_force_n(grade, chassis) * dt_s / mass
    mirrored_front = (
        wheel_speed_radps[0] == wheel_speed_radps[1]
        and motor_torque_nm[0] == motor_torque_nm[1]
        and resisting_torque_nm[0] == resisting_torque_nm[1]
        and friction[0] == friction[1]
    )
    mirrored_rear = (
        wheel_speed_radps[2] == wheel_speed_radps[3]
        and motor_torque_nm[2] == motor_torque_nm[3]
        and resisting_torque_nm[2] == resisting_torque_nm[3]
        and friction[2] == friction[3]
    )
    before = wheel_speed_radps
    driving = motor_torque_nm
    resisting = resisting_torque_nm
    after = max(speed_mps + acceleration_mps2 * dt_s, 0.0)
    w0, f0, b0 = 0.0, 0.0, 0.0
    w1, f1, b1 = 0.0, 0.0, 0.0
    w2, f2, b2 = 0.0, 0.0, 0.0
    w3, f3, b3 = 0.0, 0.0, 0.0
    moved = after
    coasting = after
    drag = 0.0
    # The faster the car is assumed to be, the more the tyres slow it: the root lies between what was too slow and what
    # was too fast. Without the bracket the iteration would swing about a car that locked wheels bring to rest.
    low = 0.0
    high = math.inf
    last_change = math.inf
    for _ in range(60):
        front, rear = normal_forces_n((after - speed_mps) / dt_s, after, grade, chassis)
        w0, f0, b0 = wheel_step(before[0], after, driving[0], resisting[0], front, friction[0], dt_s, wheel, tyre)
        w1, f1, b1 = w0, f0, b0
        if not mirrored_front:
            w1, f1, b1 = wheel_step(before[1], after, driving[1], resisting[1], front, friction[1], dt_s, wheel, tyre)
        w2, f2, b2 = wheel_step(before[2], after, driving[2], resisting[2], rear, friction[2], dt_s, wheel, tyre)
        w3, f3, b3 = w2, f2, b2
        if not mirrored_rear:
            w3, f3, b3 = wheel_step(before[3], after, driving[3], resisting[3], rear, friction[3], dt_s, wheel, tyre)
        drag = aerodynamic_force_n(after, chassis)
        coasting = speed_mps + dt_s / mass * (f0 + f1 + f2 + f3 - drag - grade_force)
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
    return Motion(moved, (w0, w1, w2, w3), (f0, f1, f2, f3), (b0, b1, b2, b3), (coasting - moved) * mass / dt_s)
