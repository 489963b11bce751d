# SPDX-License-Identifier: Apache-2.0
"""Electrical power for a given road force and front share, with the slips settled.

Slip settles within milliseconds, on ice at speed within some 100 (`decision.slip_followed`); a decision about the split
holds for 100 ms and more: for choosing the split, each tyre sits where the inverse Magic Formula puts it. The demand is
met at the road (F_x * v), so that power spun away in slip costs what it costs and buys nothing. What an axle cannot
give (tyre, motor) goes to the other one, as the control law does it; what neither can give is returned, not hidden.
"""

from __future__ import annotations

from typing import NamedTuple

from iwm_power_manager.jit import kernel
from iwm_power_manager.model.battery import chemical_power_w
from iwm_power_manager.model.chassis import GRAVITY_MPS2, equivalent_mass_kg, normal_forces_n, road_load_n
from iwm_power_manager.model.motor import electrical_power_w, idle_drag_nm, regeneration_limit_nm, torque_limit_nm
from iwm_power_manager.model.parameters import Axle, Motor, VehicleParams
from iwm_power_manager.model.tyre import least_slip_at_friction, peak_ratio, slip_at_friction, wheel_speed_at_slip

#: Part of the peak friction a strategy plans with. The rest is the distance the slip limiter keeps from the peak.
USABLE_FRICTION = 0.99


@kernel
def axle_power_w(
    force_n: float,
    speed_mps: float,
    normal_n: float,
    friction: float,
    slip_aware: bool,
    least: bool,
    axle: Axle,
) -> float:
    """Electrical power of an axle's two motors, W, for the axle's road force (braking negative).

    Braking beyond the regeneration limit is friction's and brings nothing. Where a bound will do, never larger but for
    rounding, `least` mostly spares solving for the slip.
    """
    radius = axle.wheel.radius_m
    motor = axle.motor
    torque = 0.5 * force_n * radius
    wheel_speed = speed_mps / radius
    if slip_aware and normal_n > 0.0:
        used = 0.5 * force_n / normal_n
        bounded = False
        if least:
            wheel_speed = wheel_speed_at_slip(least_slip_at_friction(used, friction, axle.tyre), speed_mps, radius)
            bounded = _slip_costs(torque, wheel_speed, speed_mps, motor)
        if not bounded:
            wheel_speed = wheel_speed_at_slip(slip_at_friction(used, friction, axle.tyre), speed_mps, radius)
    if torque < 0.0:
        torque = -min(-torque, regeneration_limit_nm(wheel_speed, speed_mps, 0.0, motor))
    return 2.0 * electrical_power_w(torque, wheel_speed, motor)


@kernel
def _slip_costs(torque_nm: float, wheel_speed_radps: float, speed_mps: float, motor: Motor) -> bool:
    """Whether all further slip surely takes more power: driving, the wheel turns faster then; braking, slower.

    The loss is a polynomial of the speed that bends upwards, so that what holds at this speed holds beyond.
    """
    if motor.map_torque_nm.shape[0] > 0 or motor.loss_quadratic_speed < 0.0:
        return False
    by_speed = torque_nm + motor.loss_linear_speed + 2.0 * motor.loss_quadratic_speed * wheel_speed_radps
    if torque_nm > 0.0:
        return by_speed >= 0.0
    # The limit of regeneration only rises as the wheel slows down.
    return by_speed <= 0.0 and -torque_nm <= regeneration_limit_nm(wheel_speed_radps, speed_mps, 0.0, motor)


class Axles(NamedTuple):
    """What a car at a speed, asked for a road force, has for it, however it is split.

    Attributes
    ----------
    front_radps, rear_radps : of a rolling wheel
    front_load_n, rear_load_n : of a wheel
    front_grip_n, rear_grip_n : largest force that the tyres of the axle carry
    front_capacity_n, rear_capacity_n : and that its motors give with it
    """

    front_radps: float
    rear_radps: float
    front_load_n: float
    rear_load_n: float
    front_grip_n: float
    rear_grip_n: float
    front_capacity_n: float
    rear_capacity_n: float


@kernel
def axles_of(force_n: float, speed_mps: float, friction: float, slip_aware: bool, vehicle: VehicleParams) -> Axles:
    """`Axles` at a speed > 0, m/s, and a force, N; not `slip_aware`, tyres carry anything."""
    front, rear = vehicle.front, vehicle.rear
    front_rolling = speed_mps / front.wheel.radius_m
    rear_rolling = speed_mps / rear.wheel.radius_m
    acceleration = (force_n - road_load_n(speed_mps, 0.0, vehicle.chassis)) / equivalent_mass_kg(vehicle)
    front_load, rear_load = normal_forces_n(acceleration, speed_mps, 0.0, vehicle.chassis)
    front_grip = rear_grip = 1e12
    if slip_aware:
        grip = 2.0 * USABLE_FRICTION * friction
        front_grip = grip * peak_ratio(front.tyre) * front_load
        rear_grip = grip * peak_ratio(rear.tyre) * rear_load
    front_capacity, rear_capacity = front_grip, rear_grip
    if force_n > 0.0:
        front_capacity = min(
            front_capacity, 2.0 * torque_limit_nm(front_rolling, 0.0, front.motor) / front.wheel.radius_m
        )
        rear_capacity = min(rear_capacity, 2.0 * torque_limit_nm(rear_rolling, 0.0, rear.motor) / rear.wheel.radius_m)
    return Axles(
        front_rolling, rear_rolling, front_load, rear_load, front_grip, rear_grip, front_capacity, rear_capacity
    )


@kernel
def split_power_w(
    force_n: float, speed_mps: float, front_share: float, friction: float, slip_aware: bool, vehicle: VehicleParams
) -> tuple[float, float]:
    """Chemical battery power for a road force at a front share, W, and the force that cannot be delivered, N."""
    axles = axles_of(force_n, speed_mps, friction, slip_aware, vehicle)
    power, missing, _ = split_outcome_w(axles, force_n, speed_mps, front_share, friction, slip_aware, False, vehicle)
    return power, missing


@kernel
def split_outcome_w(
    axles: Axles,
    force_n: float,
    speed_mps: float,
    front_share: float,
    friction: float,
    slip_aware: bool,
    least: bool,
    vehicle: VehicleParams,
) -> tuple[float, float, float]:
    """Chemical battery power for a road force at a front share, and what the axles could not do of it.

    Parameters
    ----------
    axles : `axles_of` this force and speed
    force_n : sum of the tyre forces asked for, N, braking negative
    speed_mps : vehicle speed, > 0
    front_share : front axle's part of the force, 0..1; at 0 and 1 the other axle is idle
    friction : peak friction coefficient
    slip_aware : False ignores slip, load transfer and the tyre's limit
    least : a bound of the power will do, which is never larger and takes half of the time

    Returns
    -------
    battery power (W, eq. 21), missing force (N, >= 0), force an axle was asked for beyond its grip (N, >= 0; what the
    other one could take over of it is not missing)
    """
    front_motor, rear_motor = vehicle.front.motor, vehicle.rear.motor
    front = front_share * force_n
    rear = force_n - front
    if front == 0.0 and rear == 0.0:
        front_w = electrical_power_w(0.0, axles.front_radps, front_motor)
        idle_w = front_w + electrical_power_w(0.0, axles.rear_radps, rear_motor)
        return chemical_power_w(2.0 * idle_w, vehicle.battery), 0.0, 0.0
    sign = 1.0 if force_n > 0.0 else -1.0
    # An idle axle's drag is a force too; the working axle has to overcome it. One that has to help is not idle.
    if front == 0.0 and sign * rear <= axles.rear_capacity_n:
        rear += 2.0 * idle_drag_nm(0.0, axles.front_radps, front_motor) / vehicle.front.wheel.radius_m
    elif rear == 0.0 and sign * front <= axles.front_capacity_n:
        front += 2.0 * idle_drag_nm(0.0, axles.rear_radps, rear_motor) / vehicle.rear.wheel.radius_m
    need_front = sign * front
    need_rear = sign * rear

    over = max(need_front - axles.front_grip_n, 0.0) + max(need_rear - axles.rear_grip_n, 0.0)
    given_front = min(need_front, axles.front_capacity_n)
    given_rear = min(need_rear + need_front - given_front, axles.rear_capacity_n)
    given_front = min(need_front + need_rear - given_rear, axles.front_capacity_n)
    missing = need_front + need_rear - given_front - given_rear

    front_n, rear_n = sign * given_front, sign * given_rear
    power = axle_power_w(front_n, speed_mps, axles.front_load_n, friction, slip_aware, least, vehicle.front)
    power += axle_power_w(rear_n, speed_mps, axles.rear_load_n, friction, slip_aware, least, vehicle.rear)
    return chemical_power_w(power, vehicle.battery), missing, over


@kernel
def demand_slip(force_n: float, friction: float, vehicle: VehicleParams) -> float:
    """Slip at which a tyre of the front axle carries its part of a road force, or as much as it may use of the road."""
    used = force_n / (vehicle.chassis.mass_kg * GRAVITY_MPS2)
    most = USABLE_FRICTION * friction * peak_ratio(vehicle.front.tyre)
    return slip_at_friction(min(max(used, -most), most), friction, vehicle.front.tyre)


@kernel
def demand_force_n(
    power_demand_w: float, speed_mps: float, friction: float, slip_aware: bool, vehicle: VehicleParams
) -> float:
    """Road force a power demand at the wheels stands for, N: torque by eq. 16 with its speed floor, both axles alike.

    A wheel that slips turns faster than it rolls, so that the same power is less torque: a tenth less near the grip of
    a slippery road. Without `slip_aware` the wheels roll. Where the axles' tyres differ, the front one's slip counts:
    what a demand means must not depend on the split.
    """
    floor = vehicle.driver.power_speed_floor_mps
    force = power_demand_w / max(speed_mps, floor)
    if not slip_aware:
        return force
    slip = demand_slip(force, friction, vehicle)
    rim_speed = vehicle.front.wheel.radius_m * wheel_speed_at_slip(slip, speed_mps, vehicle.front.wheel.radius_m)
    return power_demand_w / max(rim_speed, floor)
