# SPDX-License-Identifier: Apache-2.0
"""One wheel in one step of the law: its slip, its gate, and what its motor, its brake and its grip allow."""

from __future__ import annotations

from typing import NamedTuple

from iwm_power_manager.control.settings import GATE_MODE_LIMITER, GATE_MODE_OFF, Settings
from iwm_power_manager.control.slip import (
    LEAST_SLIP_SPEED_MPS,
    UNLIMITED_NM,
    driven_slip_for_gate,
    filtered,
    gained_radps,
    limiter_torque_nm,
    road_torque_nm,
)
from iwm_power_manager.control.types import WheelState
from iwm_power_manager.control.wheel_doubt import FREE_PART, HELD_MPS, HELD_PART
from iwm_power_manager.jit import kernel
from iwm_power_manager.model.chassis import GRAVITY_MPS2
from iwm_power_manager.model.gate import axle_gated
from iwm_power_manager.model.motor import heat_after, regeneration_limit_nm, torque_limit_nm
from iwm_power_manager.model.parameters import Axle, VehicleParams
from iwm_power_manager.model.torque import conversion_speed_radps
from iwm_power_manager.model.tyre import slip_ratio

#: Speed of a braked wheel as part of the car's that is still believed when power becomes torque.
FASTEST_BRAKED = 1.12


class Wheel(NamedTuple):
    """One wheel in one step, before anything is commanded.

    Attributes
    ----------
    speed_radps : measured
    conversion_radps : speed by which its power is divided to get a torque
    fast_radps : the larger of the two: what its motor's limits go by
    road_nm : torque the road took from it, filtered
    slip : filtered
    gated : held at zero torque
    held : driven by a motor that is stuck, and held by its brake to what it is given
    actuator_nm : largest torque of motor or brake in the direction of the demand
    gain : part of a commanded torque that its motor delivers
    grip_nm : largest torque the slip limiter allows
    """

    speed_radps: float
    conversion_radps: float
    fast_radps: float
    road_nm: float
    slip: float
    gated: bool
    held: bool
    actuator_nm: float
    gain: float
    grip_nm: float


@kernel
def wheel_slip(
    wheel_speed_radps: float,
    speed_mps: float,
    dt_s: float,
    first: bool,
    before: WheelState,
    axle: Axle,
    settings: Settings,
) -> float:
    """Slip of a wheel (eq. 10), filtered."""
    measured = slip_ratio(wheel_speed_radps, speed_mps, axle.wheel.radius_m, settings.slip_speed_floor_mps)
    return filtered(before.slip, measured, dt_s, 0.0 if first else settings.slip_filter_s)


@kernel
def _slips_by_little(
    braking: bool,
    taken_nm: float,
    speed_radps: float,
    other_radps: float,
    speed_mps: float,
    least_nm: float,
    radius_m: float,
    vehicle: VehicleParams,
) -> bool:
    """Whether a wheel slips by less than the smoothest ice gives, or, alone of its axle, than the road the others.

    It is there, or on another road, or has a wrong sensor. With nothing it comes back, or it has.
    """
    sign, held = 1.0 if braking else -1.0, HELD_PART * speed_mps + HELD_MPS
    little_nm = FREE_PART * 0.25 * vehicle.chassis.mass_kg * GRAVITY_MPS2 * radius_m
    if sign * radius_m * (other_radps - speed_radps) > held:
        little_nm = max(little_nm, least_nm)
    return taken_nm < little_nm and sign * (speed_mps - radius_m * speed_radps) > held


@kernel
def _actuator_nm(
    braking: bool, fast_radps: float, speed_mps: float, gain: float, stuck_nm: float, heat: float, axle: Axle
) -> float:
    """Largest torque of motor or brake in the direction of the demand; `stuck_nm`: of a motor that its brake holds."""
    if braking:
        weakest = gain * regeneration_limit_nm(fast_radps, speed_mps, heat, axle.motor)
        return max(axle.friction_brake.max_torque_nm, weakest)
    return max(gain * torque_limit_nm(fast_radps, heat, axle.motor), stuck_nm)


@kernel
def wheel_of(
    wheel_speed_radps: float,
    slip: float,
    gate_slip: float,
    speed_mps: float,
    demand_w: float,
    gain: float,
    stuck_nm: float,
    lower_part: float,
    slip_target: float,
    least_nm: float,
    dt_s: float,
    first: bool,
    before: WheelState,
    other_radps: float,
    other_before: WheelState,
    axle: Axle,
    settings: Settings,
    vehicle: VehicleParams,
) -> Wheel:
    """Steps 1, 3 and 4 for one wheel; `gate_slip` is the slip its gate goes by, `other` the axle's other wheel.

    `least_nm` is what the road takes from it at least, as the others have it.
    """
    braking = demand_w < 0.0
    radius = axle.wheel.radius_m
    # A braked wheel is not faster than the car: one that seems to be must not weaken the brakes.
    turning = min(wheel_speed_radps, FASTEST_BRAKED * speed_mps / radius) if braking else wheel_speed_radps
    critical, floor = settings.critical_slip, settings.slip_speed_floor_mps
    conversion = conversion_speed_radps(turning, speed_mps, critical, radius, vehicle.driver.power_speed_floor_mps)
    if braking:
        conversion *= lower_part
    fast = max(wheel_speed_radps, conversion)
    road = 0.0
    if not first:
        gained = gained_radps(before, wheel_speed_radps, other_before, other_radps, radius)
        taken = road_torque_nm(before.total_nm, gained, dt_s, axle.wheel.inertia_kgm2)
        road = filtered(before.road_nm, taken, dt_s, settings.slip_filter_s)
        if wheel_speed_radps == other_radps:
            # One stands in for the other, which is not believed: nothing would ever tell their torques apart.
            other_taken = road_torque_nm(other_before.total_nm, gained, dt_s, axle.wheel.inertia_kgm2)
            road = 0.5 * (road + filtered(other_before.road_nm, other_taken, dt_s, settings.slip_filter_s))
    gated = False
    # The brakes have to be able to hold a car at rest: what is slip there, sensors cannot tell.
    if settings.gate_mode != GATE_MODE_OFF and not (braking and speed_mps < floor):
        if settings.gate_mode == GATE_MODE_LIMITER and not braking:
            gate_slip = driven_slip_for_gate(gate_slip, wheel_speed_radps, speed_mps, critical, floor, radius)
        gated = axle_gated(gate_slip, demand_w, before.gated, critical, settings.gate_hysteresis, settings.gate_driving)
    grip = UNLIMITED_NM
    if settings.gate_mode == GATE_MODE_LIMITER:
        grip = limiter_torque_nm(
            braking,
            road,
            wheel_speed_radps,
            speed_mps,
            slip_target,
            settings.slip_limiter_s,
            floor,
            radius,
            axle.wheel.inertia_kgm2,
        )
        asked = braking or (settings.gate_driving and demand_w > 0.0)
        taken_nm, w, other = max(grip, abs(road)), wheel_speed_radps, other_radps
        gated = gated or (asked and _slips_by_little(braking, taken_nm, w, other, speed_mps, least_nm, radius, vehicle))
    # A brake that makes the wheel lag holds against nothing: the torque is in the report only.
    held = not braking and stuck_nm > 0.0 and slip * speed_mps > -LEAST_SLIP_SPEED_MPS
    return Wheel(
        speed_radps=wheel_speed_radps,
        conversion_radps=conversion,
        fast_radps=fast,
        road_nm=road,
        slip=slip,
        gated=gated and not held,
        held=held,
        actuator_nm=_actuator_nm(braking, fast, speed_mps, gain, stuck_nm if held else 0.0, before.heat, axle),
        gain=gain,
        grip_nm=grip,
    )


@kernel
def capacity_nm(wheel: Wheel) -> float:
    """Largest torque of a wheel in the direction of the demand, N m >= 0."""
    return 0.0 if wheel.gated else min(wheel.actuator_nm, wheel.grip_nm)


@kernel
def wheel_after(
    wheel: Wheel, motor_nm: float, total_nm: float, before: WheelState, dt_s: float, axle: Axle
) -> WheelState:
    """What is remembered of a wheel."""
    return WheelState(
        motor_nm=motor_nm,
        total_nm=total_nm,
        speed_radps=wheel.speed_radps,
        road_nm=wheel.road_nm,
        slip=wheel.slip,
        gated=wheel.gated,
        heat=heat_after(before.heat, motor_nm, dt_s, axle.motor),
    )
