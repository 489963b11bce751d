# SPDX-License-Identifier: Apache-2.0
"""What the driver's wish means as power at the wheels, however it is said (docs/model.md, docs/connect.md).

    accelerator a:  P = a * P_max(v),   P_max = sum over the four motors of min(T_peak w, P_motor),  w = v / r
    brake b:        P = -b * k m g v

    wheel force F:  P = F * v,   torque T over all wheels:  P = T * v / r,   acceleration a:  P = (m_eq a + F_road) * v

all with the speed floor below which a power can no longer be turned into a force (eq. 16 at rest): v is at least that.
The law divides by the same floor, so that a car at rest gets the force that was asked for.
"""

from __future__ import annotations

from iwm_power_manager.jit import kernel
from iwm_power_manager.model.chassis import GRAVITY_MPS2, equivalent_mass_kg, road_load_n
from iwm_power_manager.model.parameters import VehicleParams

#: Ways to say a demand that is no power.
PEDAL_TRAVEL, FORCE, TORQUE, ACCELERATION = range(4)


@kernel
def full_power_w(speed_mps: float, vehicle: VehicleParams) -> float:
    """Power of the fully pressed accelerator, W."""
    speed = max(speed_mps, vehicle.driver.power_speed_floor_mps)
    front, rear = vehicle.front, vehicle.rear
    of_front = min(front.motor.peak_torque_nm * (speed / front.wheel.radius_m), front.motor.max_power_w)
    of_rear = min(rear.motor.peak_torque_nm * (speed / rear.wheel.radius_m), rear.motor.max_power_w)
    return 2.0 * (of_front + of_rear)


@kernel
def full_braking_w(speed_mps: float, vehicle: VehicleParams) -> float:
    """Power of the fully pressed brake pedal, W, positive."""
    force = vehicle.driver.full_brake_g * vehicle.chassis.mass_kg * GRAVITY_MPS2
    return force * max(speed_mps, vehicle.driver.power_speed_floor_mps)


@kernel
def pedal_power_w(accelerator: float, brake: float, speed_mps: float, vehicle: VehicleParams) -> float:
    """Power demand of two pedals, W; the brake overrides the accelerator."""
    if brake > 0.0:
        return -brake * full_braking_w(speed_mps, vehicle)
    return accelerator * full_power_w(speed_mps, vehicle)


@kernel
def force_power_w(force_n: float, speed_mps: float, vehicle: VehicleParams) -> float:
    """Power of a force over all wheels, W; braking negative. At rest the force is what the car gets."""
    return force_n * max(speed_mps, vehicle.driver.power_speed_floor_mps)


@kernel
def torque_power_w(torque_nm: float, speed_mps: float, vehicle: VehicleParams) -> float:
    """Power of a torque, the sum over the four wheels, W; braking negative. At rest the torque is what the car gets.

    Where the axles' wheels differ in size, half of it counts for each axle.
    """
    force = 0.5 * (torque_nm / vehicle.front.wheel.radius_m + torque_nm / vehicle.rear.wheel.radius_m)
    return force_power_w(force, speed_mps, vehicle)


@kernel
def acceleration_power_w(acceleration_mps2: float, speed_mps: float, vehicle: VehicleParams) -> float:
    """Power that gives an acceleration on the flat, W; braking negative.

    The road's load is added, so that 0 holds the speed. Below the speed floor it fades, with the speed, to nothing: a
    car at rest that is to accelerate by 0 gets no torque, and one that is to brake is held.
    """
    moving = min(speed_mps / vehicle.driver.power_speed_floor_mps, 1.0)
    force = equivalent_mass_kg(vehicle) * acceleration_mps2 + moving * road_load_n(speed_mps, 0.0, vehicle.chassis)
    return force_power_w(force, speed_mps, vehicle)


@kernel
def demand_power_w(kind: int, value: float, brake: float, speed_mps: float, vehicle: VehicleParams) -> float:
    """Power of a demand that is said otherwise, W; braking negative.

    Parameters
    ----------
    kind : PEDAL_TRAVEL, FORCE, TORQUE or ACCELERATION
    value : travel of the accelerator 0..1, N, N m or m/s2
    brake : travel of the brake pedal 0..1, where `kind` is PEDAL_TRAVEL
    speed_mps : of the car, >= 0
    """
    if kind == FORCE:
        return force_power_w(value, speed_mps, vehicle)
    if kind == TORQUE:
        return torque_power_w(value, speed_mps, vehicle)
    if kind == ACCELERATION:
        return acceleration_power_w(value, speed_mps, vehicle)
    return pedal_power_w(value, brake, speed_mps, vehicle)
