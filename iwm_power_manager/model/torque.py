# SPDX-License-Identifier: Apache-2.0
"""From power to motor and friction torque (eq. 12, 16-20, 40-42)."""

from __future__ import annotations

from iwm_power_manager.jit import kernel
from iwm_power_manager.model.motor import regeneration_limit_nm
from iwm_power_manager.model.parameters import Motor


@kernel
def conversion_speed_radps(
    wheel_speed_radps: float, speed_mps: float, critical_slip: float, radius_m: float, floor_mps: float
) -> float:
    """Speed by which a power is divided to get a torque, rad/s.

    Eq. 16 divides by the wheel's own speed, which diverges at rest and pulls a locking wheel into the lock. So the
    divisor never falls below the wheel speed at the critical braking slip, nor below the speed floor. Inside the
    desired slip interval, above the floor, it is eq. 16 as printed.
    """
    held = speed_mps * (1.0 - critical_slip) / radius_m
    return max(wheel_speed_radps, held, floor_mps / radius_m)


@kernel
def allocate(front: float, rear: float, front_capacity: float, rear_capacity: float) -> tuple[float, float]:
    """Give each axle what it asks for; what one cannot take goes to the other (all >= 0, in W)."""
    front_given = min(front, front_capacity)
    rear_given = min(rear + front - front_given, rear_capacity)
    front_given = min(front + rear - rear_given, front_capacity)
    return front_given, max(rear_given, 0.0)


@kernel
def between_wheels(
    given_w: float,
    left_conversion_radps: float,
    right_conversion_radps: float,
    left_capacity_nm: float,
    right_capacity_nm: float,
) -> tuple[float, float]:
    """Torques of an axle's two wheels, N m >= 0, for a power of the axle: equal, where both can take it.

    A wheel that can take less gives what it can, the other one the rest.
    """
    equal = given_w / (left_conversion_radps + right_conversion_radps)
    if left_capacity_nm == right_capacity_nm or equal <= min(left_capacity_nm, right_capacity_nm):
        return equal, equal
    if left_capacity_nm < right_capacity_nm:
        return left_capacity_nm, max(given_w - left_capacity_nm * left_conversion_radps, 0.0) / right_conversion_radps
    return max(given_w - right_capacity_nm * right_conversion_radps, 0.0) / left_conversion_radps, right_capacity_nm


@kernel
def blend(
    torque_nm: float, wheel_speed_radps: float, speed_mps: float, heat: float, gain: float, motor: Motor
) -> tuple[float, float]:
    """Share a wheel's torque between its motor and its friction brake (eq. 20, 41, 42).

    Driving is the motor's. Braking is the motor's up to the part `gain` of the regeneration limit, which a weak motor
    delivers, the rest is friction's.

    Returns
    -------
    motor torque (N m), friction torque (N m, <= 0)
    """
    if torque_nm >= 0.0:
        return torque_nm, 0.0
    regeneration = min(-torque_nm, gain * regeneration_limit_nm(wheel_speed_radps, speed_mps, heat, motor))
    return -regeneration, torque_nm + regeneration
