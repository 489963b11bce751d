# SPDX-License-Identifier: Apache-2.0
"""The direction that a step is reckoned in, and the hold of a car that rolls against the one asked for."""

from __future__ import annotations

from iwm_power_manager.control.motion import Motion
from iwm_power_manager.control.types import ControllerState, FourWheels, Measurement, MotionState, WheelState
from iwm_power_manager.control.yaw import no_yaw
from iwm_power_manager.jit import kernel
from iwm_power_manager.model.chassis import GRAVITY_MPS2
from iwm_power_manager.model.parameters import Axle, VehicleParams

#: Below this speed, m/s, the car counts as standing: it is what wheels and car must both exceed to be rolling.
MOVING_MPS = 0.06
#: The hold: slope it is made for; speed beyond which it is no longer a matter of holding, m/s; change of the torque of
#: two motors that counts as none, N m a step; time in which it then fades, s.
HOLD_GRADE = 0.25
HOLD_BELOW_MPS = 1.5
HOLD_STEADY_NM = 1.0
HOLD_FADE_S = 0.4


@kernel
def _turned(wheel: WheelState) -> WheelState:
    """What is remembered of a wheel, reckoned in the other direction of travel."""
    return WheelState(
        motor_nm=-wheel.motor_nm,
        total_nm=-wheel.motor_nm + (wheel.total_nm - wheel.motor_nm),
        speed_radps=-wheel.speed_radps,
        road_nm=-wheel.road_nm,
        slip=0.0,
        gated=False,
        heat=wheel.heat,
    )


@kernel
def turned_to(state: ControllerState, wheels: FourWheels, motion: MotionState, travel: float) -> ControllerState:
    """What is remembered, in the direction of travel of this step, with what is known of wheels and motion now."""
    a, b, c, d = wheels
    yaw = state.yaw
    if travel != state.travel:
        yaw = no_yaw()
        a, b, c, d = _turned(a), _turned(b), _turned(c), _turned(d)
    return ControllerState(
        steps=state.steps,
        split=state.split,
        wheels=(a, b, c, d),
        front_unequal_s=state.front_unequal_s,
        rear_unequal_s=state.rear_unequal_s,
        yaw=yaw,
        motion=motion,
        travel=travel,
        hold_nm=state.hold_nm,
        friction=state.friction,
    )


@kernel
def travel_direction(speed_mps: float, demand_w: float, direction: float, before: float) -> float:
    """Direction everything is reckoned in: driving, the one asked for; braking, the one the car moves in."""
    if demand_w >= 0.0:
        return direction
    if abs(speed_mps) < MOVING_MPS:
        return before
    return 1.0 if speed_mps > 0.0 else -1.0


@kernel
def hold_torque_nm(
    before_nm: float,
    motion: Motion,
    measurement: Measurement,
    motor_nm: float,
    motor_before_nm: float,
    vehicle: VehicleParams,
) -> float:
    """Friction torque a wheel is held with on a slope, N m >= 0.

    It comes when the car begins to roll against the direction asked for, and goes when the car moves off; while the
    driver drives and the motors have come to what he asks for, it fades.
    """
    chassis = vehicle.chassis
    w = motion.wheel_speed_radps
    rolling = measurement.direction * motion.speed_mps
    wheels = measurement.direction * 0.25 * (w[0] + w[1] + w[2] + w[3]) * vehicle.front.wheel.radius_m
    most = 0.25 * chassis.mass_kg * GRAVITY_MPS2 * HOLD_GRADE * vehicle.front.wheel.radius_m
    if rolling > MOVING_MPS or wheels > MOVING_MPS:
        return 0.0
    if (
        rolling < -MOVING_MPS
        and wheels < -MOVING_MPS
        and rolling > -HOLD_BELOW_MPS
        and measurement.power_demand_w >= 0.0
    ):
        return most
    if measurement.power_demand_w > 0.0 and abs(motor_nm - motor_before_nm) < HOLD_STEADY_NM:
        return max(before_nm - most * measurement.dt_s / HOLD_FADE_S, 0.0)
    return before_nm


@kernel
def held_nm(hold_nm: float, gated: bool, axle: Axle) -> float:
    """Friction torque that holds a wheel; nobody brakes meanwhile, so there is no other."""
    return 0.0 if gated else -min(hold_nm, axle.friction_brake.max_torque_nm)
