"""What the pedals mean, as power at the wheels (docs/model.md).

    accelerator a:  P = a * P_max(v),   P_max = min(4 T_peak w, 4 P_motor),  w = v / r
    brake b:        P = -b * k m g v

both with the speed floor below which a power can no longer be turned into a force (eq. 16 at rest).
"""

from __future__ import annotations

from iwm_power_manager.jit import kernel
from iwm_power_manager.model.chassis import GRAVITY_MPS2
from iwm_power_manager.model.parameters import VehicleParams


@kernel
def full_power_w(speed_mps: float, vehicle: VehicleParams) -> float:
    """Power of the fully pressed accelerator, W."""
    motor = vehicle.front.motor
    wheel_speed = max(speed_mps, vehicle.driver.power_speed_floor_mps) / vehicle.front.wheel.radius_m
    return 4.0 * min(motor.peak_torque_nm * wheel_speed, motor.max_power_w)


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
