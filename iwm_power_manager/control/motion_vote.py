# SPDX-License-Identifier: Apache-2.0
"""When the speeds outvote the forces: where the reference starts over, and which brakes gave less than was asked."""

from __future__ import annotations

import math

from iwm_power_manager.control.speed_doubt import AGREE_MPS, AGREE_PART, APART_S, ROLLING_FRICTION, used_friction_of
from iwm_power_manager.control.types import Agreed, Compared, FourWheels, Measurement, MotionState, Wheels, WheelState
from iwm_power_manager.control.wheel_doubt import (
    NO_WHEELS,
    SLOW_MPS,
    SPEED_MPS,
    SPEED_PART,
    WHOLE_BRAKES,
    Turning,
    clamped,
    middle_of,
)
from iwm_power_manager.jit import kernel
from iwm_power_manager.model.chassis import GRAVITY_MPS2
from iwm_power_manager.model.parameters import Axle, VehicleParams
from iwm_power_manager.model.tyre import friction_coefficient

#: The steepest slope, m/s2.
BIAS_MPS2 = 2.5
#: Five speeds that agree against the reference are right after `APART_S`; after this long where their torque could make
#: wheels slip that way. Below the speed they stand, which a dead control unit shows too.
AGREED_S = 1.0
STANDING_MPS = 0.1
#: A single wheel that rolls with the sensor while the others slip has to do so this many times longer.
ALONE = 3.0
#: An accelerometer sides with the speeds where it is this many times nearer to them than to the forces.
NEARER = 0.5
#: Deceleration by brakes that are not counted on that a demand explains, as part of it and m/s2.
ASKED_PART, ASKED_MPS2 = 1.25, 1.0
#: A brake gives less than half of its torque where no road of this friction would let its wheel slip so little with it;
#: one that gives less than the last part gives nothing.
BEST_ROAD, HALF, DEAD = 1.2, 0.5, 0.2
#: Nothing accelerates a car more than this, m/s2.
MOST_MPS2 = 12.0


@kernel
def force_mps2(road: Wheels, vehicle: VehicleParams) -> float:
    """Acceleration by the road's forces alone."""
    front = (road[0] + road[1]) / vehicle.front.wheel.radius_m
    rear = (road[2] + road[3]) / vehicle.rear.wheel.radius_m
    return (front + rear) / vehicle.chassis.mass_kg


@kernel
def road_resistance_mps2(speed_mps: float, vehicle: VehicleParams) -> float:
    """Deceleration by air and rolling."""
    c = vehicle.chassis
    drag = 0.5 * c.air_density_kgpm3 * c.drag_coefficient * c.frontal_area_m2 * speed_mps * abs(speed_mps)
    return drag / c.mass_kg + c.rolling_resistance * GRAVITY_MPS2 * clamped(speed_mps / SLOW_MPS, 1.0)


@kernel
def started_motion(shown: float, rims: Wheels) -> MotionState:
    """The first step of a run: the wheels are taken as rolling, and the sensor is believed if it agrees."""
    start = middle_of(rims)
    if not math.isnan(shown) and abs(shown - start) <= SPEED_PART * abs(start) + SPEED_MPS:
        start = shown
    return fresh_motion(start, 0.0, shown, WHOLE_BRAKES, 1.0, Compared(1.0, 0.0), 0.0)


@kernel
def fresh_motion(
    speed_mps: float,
    bias_mps2: float,
    shown_mps: float,
    brake_gain: Wheels,
    factor: float,
    compared: Compared,
    wheel_doubt_s: float,
) -> MotionState:
    """A reference that nothing contradicts."""
    return MotionState(
        speed_mps=speed_mps,
        bias_mps2=bias_mps2,
        shown_mps=shown_mps,
        shown_s=0.0,
        moved_mps=0.0,
        apart_s=0.0,
        doubt_s=0.0,
        wheel_stray_s=NO_WHEELS,
        wheel_doubt_s=(wheel_doubt_s, wheel_doubt_s, wheel_doubt_s, wheel_doubt_s),
        least_nm=NO_WHEELS,
        most_nm=NO_WHEELS,
        agreed=Agreed(0.0, 0.0, 0.0, 0.0),
        brake_gain=brake_gain,
        wheels_factor=factor,
        calm_s=0.0,
        compared=compared,
    )


@kernel
def vote(
    shown: float,
    rims: Wheels,
    predicted: float,
    acceleration: float,
    measurement: Measurement,
    t: Turning,
    before: MotionState,
    vehicle: VehicleParams,
) -> tuple[Agreed, float, bool]:
    """How long speeds have agreed against the reference by now, on which speed, and whether they are right.

    Wheels that stand say nothing: a dead control unit shows zeros too.
    """
    none = Agreed(0.0, 0.0, 0.0, 0.0)
    doubt, torque, dt = before.wheel_doubt_s, t.torque_nm, measurement.dt_s
    all_doubted = min(doubt[0], doubt[1], doubt[2], doubt[3]) > 0.0
    # Without a sensor wheels that are believed lead the reference by themselves.
    blind = math.isnan(shown)
    mean = middle_of(rims) if blind else shown
    spread = AGREE_PART * abs(mean) + AGREE_MPS
    count, own_nm = 0, 0.0
    slipping, foreign, gain = True, _foreign_brakes(vehicle), before.brake_gain
    for i in range(4):
        if abs(rims[i] - mean) <= spread:
            count += 1
            own_nm += torque[i]
        else:
            # By a brake that nobody counts on: another system's, or one that is back.
            braked = (foreign or gain[i] < 1.0) and mean * (rims[i] - mean) < 0.0
            slipping = slipping and (braked or torque[i] * (rims[i] - mean) > 0.0)
    near = abs(mean - predicted) <= SPEED_PART * abs(mean) + SPEED_MPS
    enough = (count == 4 and all_doubted) if blind else slipping
    if near or not enough or abs(mean) <= STANDING_MPS:
        return none, mean, False
    agreed = Agreed(dt, mean, 0.0, 0.0)
    old = before.agreed
    if old.lasted_s > 0.0:
        felt = measurement.acceleration_mps2 * dt
        agreed = Agreed(old.lasted_s + dt, old.from_mps, old.moved_mps + acceleration * dt, old.felt_mps + felt)
    used = used_friction_of(torque, t)
    # A driven wheel is never slower than the car, a braked one never faster; no skid makes a wheel doubted.
    slip = own_nm * (mean - predicted) > 0.0 and not (all_doubted and used < ROLLING_FRICTION)
    # What an accelerometer says, a slope taken off as the forces have it.
    felt = agreed.felt_mps + before.bias_mps2 * agreed.lasted_s
    off_speeds, off_forces = abs(felt - (mean - agreed.from_mps)), abs(felt - agreed.moved_mps)
    uncounted = (foreign or min(gain) < 1.0) and _asked_for(mean, agreed, measurement, vehicle)
    if count == 0:
        # No wheel rolls with the sensor: only an accelerometer tells that it is right, or brakes that are back.
        told = off_speeds < NEARER * off_forces or (uncounted and not foreign)
        return agreed, mean, agreed.lasted_s > ALONE * APART_S and told
    if slip:
        if off_forces < NEARER * off_speeds:
            return agreed, mean, False
        known = off_speeds < NEARER * off_forces or uncounted
        slip = not (known or abs(before.bias_mps2) > BIAS_MPS2 or min(gain) < 1.0)
        if slip and count < 4:
            return none, mean, False
    enough_s = AGREED_S if slip else APART_S
    if count == 1:
        enough_s *= ALONE
    return agreed, mean, agreed.lasted_s > enough_s


@kernel
def _foreign_brakes(vehicle: VehicleParams) -> bool:
    """Whether another system has the friction brakes."""
    return max(vehicle.front.friction_brake.max_torque_nm, vehicle.rear.friction_brake.max_torque_nm) == 0.0


@kernel
def _asked_for(mean: float, agreed: Agreed, measurement: Measurement, vehicle: VehicleParams) -> bool:
    """Whether the speeds slow down no more than the driver asks for."""
    asked = -measurement.power_demand_w / (vehicle.chassis.mass_kg * max(abs(mean), SLOW_MPS))
    slower = abs(agreed.from_mps) - abs(mean)
    return asked > 0.0 and slower <= (ASKED_PART * asked + ASKED_MPS2) * agreed.lasted_s


@kernel
def _braked_n(rim: float, mean: float, wheel: WheelState, load_nm: float, axle: Axle) -> tuple[float, float]:
    """Force that a wheel's friction brake is counted on for, N; and of it what no road can have taken at its slip."""
    force = max(wheel.motor_nm - wheel.total_nm, 0.0) / axle.wheel.radius_m
    most_nm = BEST_ROAD * load_nm * friction_coefficient(max(1.0 - rim / mean, 0.0), 1.0, axle.tyre)
    return force, force if most_nm < HALF * abs(wheel.total_nm) else 0.0


@kernel
def _weak_brakes(
    lack_mps2: float,
    mean: float,
    rims: Wheels,
    wheels: FourWheels,
    t: Turning,
    gain: Wheels,
    vehicle: VehicleParams,
) -> tuple[Wheels, float]:
    """Part of each friction brake's torque that arrives, and how much of the lack of deceleration that explains."""
    mass = vehicle.chassis.mass_kg
    a, a_free = _braked_n(rims[0], mean, wheels[0], t.front_nm, vehicle.front)
    b, b_free = _braked_n(rims[1], mean, wheels[1], t.front_nm, vehicle.front)
    c, c_free = _braked_n(rims[2], mean, wheels[2], t.rear_nm, vehicle.rear)
    d, d_free = _braked_n(rims[3], mean, wheels[3], t.rear_nm, vehicle.rear)
    free_n = a_free + b_free + c_free + d_free
    # Where all slip as they might with their torque, none is nearer to blame than another.
    blamed_n = free_n if free_n > 0.0 else a + b + c + d
    if lack_mps2 <= 0.0 or blamed_n == 0.0:
        return gain, 0.0
    part = max(1.0 - lack_mps2 * mass / blamed_n, 0.0)
    if part < DEAD:
        part = 0.0
    all_alike = free_n == 0.0
    after = (
        part * gain[0] if a_free > 0.0 or all_alike else gain[0],
        part * gain[1] if b_free > 0.0 or all_alike else gain[1],
        part * gain[2] if c_free > 0.0 or all_alike else gain[2],
        part * gain[3] if d_free > 0.0 or all_alike else gain[3],
    )
    return after, min(lack_mps2, (1.0 - part) * blamed_n / mass)


@kernel
def restarted_motion(
    mean: float,
    rims: Wheels,
    agreed: Agreed,
    shown: float,
    wheels: FourWheels,
    t: Turning,
    before: MotionState,
    vehicle: VehicleParams,
) -> MotionState:
    """The reference from speeds that are right, and what that makes of the forces: brakes that are weak, or a slope."""
    missed = (mean - agreed.from_mps - agreed.moved_mps) / agreed.lasted_s
    factor, told = before.wheels_factor, before.compared
    if abs(missed) <= BIAS_MPS2:
        return fresh_motion(mean, before.bias_mps2, shown, before.brake_gain, factor, told, 0.0)
    sign = 1.0 if mean >= 0.0 else -1.0
    lack = sign * missed
    if lack < 0.0 and min(before.brake_gain) < 1.0:
        return fresh_motion(mean, before.bias_mps2, shown, WHOLE_BRAKES, factor, told, 0.0)  # they are back
    gain, found = _weak_brakes(lack, mean, rims, wheels, t, before.brake_gain, vehicle)
    bias = clamped(before.bias_mps2 + sign * (lack - found), MOST_MPS2)
    return fresh_motion(mean, bias, shown, gain, factor, told, 0.0)
