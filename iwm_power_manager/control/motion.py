# SPDX-License-Identifier: Apache-2.0
"""How fast the car moves, and which sensor is not believed: five speeds and the torques that were applied.

The torques say what the speed does next: the road force is what turns neither motor nor brake into wheel acceleration
(eq. 11), its sum is what accelerates the car (eq. 1). So there is a reference that no speed sensor can walk away with:
it follows the forces, and each sensor may pull at it only as fast as a slope or an unknown load would. A sensor that
leaves it, stands still while it moves, or contradicts four wheels that roll freely, is not believed until it has been
near it again for a while. A believed speed sensor is taken as it is: on a healthy car this page changes nothing.

The forces may be wrong too: a brake that gives nothing, brakes of another system, a dynamometer, a trailer, a
gap in the messages. A speed sensor and the wheels that roll with it are right where no slip can explain what they show,
and the others slip as their torques make them; the reference starts over from them. What the forces said too much is
then taken off the brakes of the wheels that cannot have had their torque, since they hardly slip; what is left is an
acceleration that nothing explains, until the same vote says otherwise. An accelerometer, where there is one, tells at
once whether the forces or the speeds are right.

A wheel is not believed when it does what no torque can: slows down faster than its brake can, or stays away from the
car's speed although nothing holds it. A wheel that skids does neither. Four that jump by one factor while the sensor
does not are corrected by it: no road loses its grip under both axles in the same step. Where sensor and wheels have
differed by one factor ever since they first rolled freely, nothing tells which is wrong: the wheels are turned into the
sensor's speed, so that slip is slip, and a power that brakes is divided by the lower of both.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from iwm_power_manager.control.types import (
    Agreed,
    Compared,
    FourWheels,
    Measurement,
    MotionState,
    Wheels,
    WheelState,
)
from iwm_power_manager.jit import kernel
from iwm_power_manager.model.chassis import GRAVITY_MPS2
from iwm_power_manager.model.parameters import Axle, VehicleParams, Wheel
from iwm_power_manager.model.tyre import friction_coefficient

#: What a speed sensor may pull the reference by, m/s2: a slope of 10 %; and part of the forces, for an unknown load.
PULL_MPS2 = 1.0
PULL_OF_FORCES = 0.2
#: The same for the wheels while the speed sensor is not believed, and for both below `SLOW_MPS`, where static friction
#: makes forces say little.
WHEEL_PULL_MPS2 = 1.5
SLOW_PULL_MPS2 = 8.0
SLOW_MPS = 1.0
#: A wheel within this part of the speed, and this, may be rolling: slip and tyre wear are no reason to pull.
WHEEL_PART, WHEEL_MPS = 0.06, 0.2
#: How fast a steady difference is taken for a slope, 1/s2, and the steepest slope, m/s2.
BIAS_GAIN_PER_S2 = 1.5
BIAS_MPS2 = 2.5
BIAS_STEP_MPS = 0.3
#: The same while the wheels confirm the sensor this well.
CONFIRMED_GAIN_PER_S2 = 6.0
CONFIRMED_PART, CONFIRMED_MPS = 0.02, 0.15
#: A speed sensor this far from the reference is not believed: part of the speed, and m/s.
SPEED_PART, SPEED_MPS = 0.03, 0.5
#: A sensor that shows the same number for this long while the reference moved by this is stuck.
STUCK_S, STUCK_MPS = 0.05, 0.3
#: Wheels that agree this well and take less than this part of their load from the road are rolling; a speed sensor that
#: is this far from them for this long is not believed.
AGREE_PART, AGREE_MPS = 0.04, 0.3
ROLLING_FRICTION = 0.08
#: Below the second torque or this speed, m/s, what they slip makes no wrong speed of them.
NEARLY_FRICTION, NEARLY_MPS = 0.15, 4.0
APART_PART, APART_MPS, APART_S = 0.05, 0.5, 0.1
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
#: A sensor must have been near the reference for this long before it is believed again.
DISTRUST_S = 0.5
#: Noise of a wheel's change in one step, rad/s; what a torque explains is taken times `TORQUE_MARGIN`.
JUMP_RADPS = 1.5
TORQUE_MARGIN = 1.5
#: A wheel without torque (part of load times radius) and away from the car's speed comes back at least as fast as on
#: the smoothest ice; one that does not for this long is a bad sensor. It is good again within the second pair. A gated
#: wheel is away beyond the third, one that runs against its torque beyond the fourth, which bends stay within.
FREE_PART, ICE_FRICTION, RETURN_S = 0.05, 0.03, 0.06
STRAY_PART, STRAY_MPS = 0.1, 0.5
GOOD_PART, GOOD_MPS = 0.06, 0.3
HELD_PART, HELD_MPS = 0.02, 0.1
AGAINST_PART, AGAINST_MPS = 0.05, 0.3
#: A sensor and wheels that differ by no more than this may both be right: tyres, or a wrong radius.
LEAST_PART = 0.72
#: Wheels that are all wrong are believed to be so by one factor within this and its inverse; one within the second part
#: of 1 is tyre wear. What they jump by in the same step, rad/s, and how far their factors may be apart.
LEAST_FACTOR, WORN_PART = 0.6, 0.05
COMMON_RADPS, COMMON_PART, CALM_S = 0.5, 0.03, 0.05
#: Sensor and wheels are compared when these first roll freely, or differ from it against their torques, for this long
#: and faster than this. Beyond the last speed a sensor that is off by 5 m/s would look like one that is wrong by a
#: factor, and the wheels are believed.
COMPARED_S, COMPARED_MPS, COMPARED_MOST_MPS = 0.2, 2.0, 12.5
#: No road force is larger than this part of the wheel's static load.
MOST_FRICTION = 2.0
#: Bits of `Motion.doubted`: the wheels in their order, then the speed sensor.
DOUBT_SPEED = 16


class Motion(NamedTuple):
    """What is known of the car's motion.

    Attributes
    ----------
    speed_mps : speed to use, negative backwards
    uncertainty_mps : how wrong it may be
    wheel_speed_radps : wheel speeds to use; one that is not believed has that of its axle's other wheel, or rolls
    lower_part : the lower of two speeds, as part of the one used, where sensor and wheels differ by a quarter at most
        and nothing tells which of them is wrong; else 1
    doubted : bits of what is not believed: 1, 2, 4, 8 the wheels, 16 the speed sensor
    """

    speed_mps: float
    uncertainty_mps: float
    wheel_speed_radps: Wheels
    lower_part: float
    doubted: int


NO_WHEELS = (0.0, 0.0, 0.0, 0.0)
WHOLE_BRAKES = (1.0, 1.0, 1.0, 1.0)


@kernel
def _clamped(value: float, most: float) -> float:
    return min(max(value, -most), most)


@kernel
def _road_nm(
    torque_nm: float, change_radps: float, dt_s: float, doubted: bool, inertia: float, load_nm: float
) -> float:
    """Torque the road took from a wheel; of a wheel that is not believed, all of it."""
    road = torque_nm if doubted else torque_nm - inertia * change_radps / dt_s
    return _clamped(road, MOST_FRICTION * load_nm)


@kernel
def _wheel_doubt(
    speed_radps: float,
    change_radps: float,
    torque_nm: float,
    reference_mps: float,
    acceleration_mps2: float,
    dt_s: float,
    stray_s: float,
    doubt_s: float,
    gated: bool,
    wheel: Wheel,
    load_nm: float,
) -> tuple[float, float]:
    """How long a wheel has stayed away by now, and the time it has yet to be good."""
    radius, inertia = wheel.radius_m, wheel.inertia_kgm2
    size = abs(reference_mps)
    direction = 1.0 if reference_mps >= 0.0 else -1.0
    level = direction * (radius * speed_radps - reference_mps)
    change = direction * change_radps
    explained = direction * torque_nm / inertia * dt_s
    rolling = direction * acceleration_mps2 / radius * dt_s
    jumped = False
    if size > SLOW_MPS:
        # The road only ever drives a wheel towards the car's speed.
        if level < 0.0:
            jumped = change < TORQUE_MARGIN * min(explained, rolling, 0.0) - JUMP_RADPS
        else:
            jumped = change > TORQUE_MARGIN * max(explained, rolling, 0.0) + JUMP_RADPS
    # Nothing holds a wheel that is free, nor one that is braked and yet faster than the car.
    free = abs(torque_nm) < FREE_PART * load_nm
    against = direction * torque_nm * level < 0.0 and not free
    # One that is gated should be back by now: an error that looks like slip would keep it gated for ever.
    away = abs(level) > STRAY_PART * size + STRAY_MPS
    if gated:
        away = abs(level) > HELD_PART * size + HELD_MPS
    elif against:
        away = abs(level) > AGAINST_PART * size + AGAINST_MPS
    if (free or against) and away and (-change if level > 0.0 else change) < ICE_FRICTION * load_nm / inertia * dt_s:
        stray_s = min(stray_s + dt_s, 2.0 * RETURN_S)  # no matter for how long it was wrong
    else:
        stray_s = max(stray_s - dt_s, 0.0)
    # A step that jumps away is a fault; one that jumps back is the end of it.
    if (jumped and away) or stray_s > RETURN_S:
        doubt_s = DISTRUST_S
    elif doubt_s > 0.0 and abs(level) <= GOOD_PART * size + GOOD_MPS:
        doubt_s = max(doubt_s - dt_s, 0.0)
    return stray_s, doubt_s


class _Rolling(NamedTuple):
    """What the wheels that are believed say: how many, their rim speeds' extremes and mean, and whether they roll.

    `freely` is without slip that would show; `nearly` is with less than makes a wrong speed of it.
    """

    believed: int
    low_mps: float
    high_mps: float
    mean_mps: float
    freely: bool
    nearly: bool


@kernel
def _used_friction(torque_nm: Wheels, t: _Turning) -> float:
    """The largest of four torques at the wheels, as part of the wheel's load."""
    a, b, c, d = torque_nm
    return max(max(abs(a), abs(b)) / t.front_nm, max(abs(c), abs(d)) / t.rear_nm)


@kernel
def _rolling(rims: Wheels, doubt_s: Wheels, turning: _Turning) -> _Rolling:
    count = 0
    low = math.inf
    high = -math.inf
    total = 0.0
    for i in range(4):
        if doubt_s[i] == 0.0:
            count += 1
            low = min(low, rims[i])
            high = max(high, rims[i])
            total += rims[i]
    used = _used_friction(turning.road_nm, turning)
    agree = count >= 3 and high - low <= AGREE_PART * abs(high) + AGREE_MPS
    mean = total / max(count, 1)
    nearly = agree and (used < NEARLY_FRICTION or abs(high) < NEARLY_MPS)
    return _Rolling(count, low, high, mean, agree and used < ROLLING_FRICTION, nearly)


@kernel
def _same(shown: float, mean_mps: float) -> bool:
    return abs(shown - mean_mps) <= CONFIRMED_PART * abs(shown) + CONFIRMED_MPS


@kernel
def _confirmed(shown: float, rolling: _Rolling) -> bool:
    return rolling.believed >= 3 and _same(shown, rolling.mean_mps)


class _Sensor(NamedTuple):
    """The speed sensor after judgement: as in `MotionState`, with the speed that is predicted now."""

    predicted_mps: float
    shown_s: float
    moved_mps: float
    apart_s: float
    doubt_s: float


@kernel
def _judge_speed(
    shown: float, predicted: float, acceleration: float, dt: float, before: MotionState, rolling: _Rolling
) -> _Sensor:
    """Whether the speed sensor is believed."""
    if math.isnan(shown):
        return _Sensor(predicted, 0.0, 0.0, 0.0, before.doubt_s)
    same = shown == before.shown_mps
    shown_s = before.shown_s + dt if same else 0.0
    moved = before.moved_mps + acceleration * dt if same else 0.0
    apart = 0.0
    if rolling.freely and abs(shown - rolling.mean_mps) > APART_PART * abs(rolling.mean_mps) + APART_MPS:
        apart = before.apart_s + dt
        if apart > APART_S and before.doubt_s == 0.0:
            predicted = rolling.mean_mps  # four against one, and nothing that could make them slip
    tolerance = SPEED_PART * abs(predicted) + SPEED_MPS
    error = abs(shown - predicted)
    far = error > tolerance and abs(predicted) > SLOW_MPS
    doubt = before.doubt_s
    # Where the wheels show the same it is the car that keeps its speed.
    stuck = shown_s > STUCK_S and abs(moved) > STUCK_MPS and not _confirmed(shown, rolling)
    if far or apart > APART_S or stuck:
        doubt = DISTRUST_S
    elif error <= 0.5 * tolerance:
        doubt = max(doubt - dt, 0.0)
    return _Sensor(predicted, shown_s, moved, apart, doubt)


@kernel
def _pulled(
    predicted: float, shown: float, trusted: bool, rolling: _Rolling, demand_w: float, forces: float, dt: float
) -> float:
    """The reference: what the forces predict, pulled at by sensor and wheels."""
    size = abs(predicted)
    slow = size <= SLOW_MPS
    reference = predicted
    if trusted:
        pull = SLOW_PULL_MPS2 if slow else PULL_MPS2 + PULL_OF_FORCES * abs(forces)
        reference += _clamped(shown - predicted, pull * dt)
    if rolling.believed > 0:
        # A braked wheel is never faster than the car, a driven one never slower.
        best = rolling.mean_mps
        if demand_w < 0.0:
            best = rolling.high_mps if predicted >= 0.0 else rolling.low_mps
        elif demand_w > 0.0:
            best = rolling.low_mps if predicted >= 0.0 else rolling.high_mps
        error = best - predicted
        if abs(error) > WHEEL_PART * size + WHEEL_MPS:
            pull = PULL_MPS2
            if not trusted:
                pull = SLOW_PULL_MPS2 if slow else WHEEL_PULL_MPS2 + PULL_OF_FORCES * abs(forces)
            reference += _clamped(error, pull * dt)
        elif not trusted and rolling.nearly:
            reference += _clamped(error, PULL_MPS2 * dt)
    return reference


@kernel
def _forces_mps2(road: Wheels, vehicle: VehicleParams) -> float:
    """Acceleration by the road's forces alone."""
    front = (road[0] + road[1]) / vehicle.front.wheel.radius_m
    rear = (road[2] + road[3]) / vehicle.rear.wheel.radius_m
    return (front + rear) / vehicle.chassis.mass_kg


@kernel
def _resistance_mps2(speed_mps: float, vehicle: VehicleParams) -> float:
    """Deceleration by air and rolling."""
    c = vehicle.chassis
    drag = 0.5 * c.air_density_kgpm3 * c.drag_coefficient * c.frontal_area_m2 * speed_mps * abs(speed_mps)
    return drag / c.mass_kg + c.rolling_resistance * GRAVITY_MPS2 * _clamped(speed_mps / SLOW_MPS, 1.0)


@kernel
def _started(shown: float, rims: Wheels) -> MotionState:
    """The first step of a run: the wheels are taken as rolling, and the sensor is believed if it agrees."""
    start = _middle(rims)
    if not math.isnan(shown) and abs(shown - start) <= SPEED_PART * abs(start) + SPEED_MPS:
        start = shown
    return _fresh(start, 0.0, shown, WHOLE_BRAKES, 1.0, Compared(1.0, 0.0), 0.0)


@kernel
def _fresh(
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
        agreed=Agreed(0.0, 0.0, 0.0, 0.0),
        brake_gain=brake_gain,
        wheels_factor=factor,
        calm_s=0.0,
        compared=compared,
    )


class _Turning(NamedTuple):
    """The wheels since the last step, signed as the car is: torque, gain of speed, what the road took; of their loads.

    Attributes
    ----------
    torque_nm, change_radps, road_nm, gated : of each wheel
    front_nm, rear_nm : load times radius, the torque of a road of friction 1
    """

    torque_nm: Wheels
    change_radps: Wheels
    road_nm: Wheels
    gated: tuple[bool, bool, bool, bool]
    front_nm: float
    rear_nm: float


@kernel
def _turning(
    w: Wheels,
    wheels: FourWheels,
    travel: float,
    first: bool,
    dt: float,
    doubt_s: Wheels,
    vehicle: VehicleParams,
) -> _Turning:
    chassis = vehicle.chassis
    front, rear = vehicle.front.wheel, vehicle.rear.wheel
    weight = chassis.mass_kg * GRAVITY_MPS2 / (chassis.front_axle_to_cg_m + chassis.rear_axle_to_cg_m)
    front_nm = 0.5 * weight * chassis.rear_axle_to_cg_m * front.radius_m
    rear_nm = 0.5 * weight * chassis.front_axle_to_cg_m * rear.radius_m
    a, b, c, d = wheels
    torque = (travel * a.total_nm, travel * b.total_nm, travel * c.total_nm, travel * d.total_nm)
    change = NO_WHEELS
    if not first:
        change = (
            w[0] - travel * a.speed_radps,
            w[1] - travel * b.speed_radps,
            w[2] - travel * c.speed_radps,
            w[3] - travel * d.speed_radps,
        )
    road = (
        _road_nm(torque[0], change[0], dt, doubt_s[0] > 0.0, front.inertia_kgm2, front_nm),
        _road_nm(torque[1], change[1], dt, doubt_s[1] > 0.0, front.inertia_kgm2, front_nm),
        _road_nm(torque[2], change[2], dt, doubt_s[2] > 0.0, rear.inertia_kgm2, rear_nm),
        _road_nm(torque[3], change[3], dt, doubt_s[3] > 0.0, rear.inertia_kgm2, rear_nm),
    )
    return _Turning(torque, change, road, (a.gated, b.gated, c.gated, d.gated), front_nm, rear_nm)


@kernel
def _voted(
    shown: float,
    rims: Wheels,
    predicted: float,
    acceleration: float,
    measurement: Measurement,
    t: _Turning,
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
    mean = _middle(rims) if blind else shown
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
    used = _used_friction(torque, t)
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
def _restarted(
    mean: float,
    rims: Wheels,
    agreed: Agreed,
    shown: float,
    wheels: FourWheels,
    t: _Turning,
    before: MotionState,
    vehicle: VehicleParams,
) -> MotionState:
    """The reference from speeds that are right, and what that makes of the forces: brakes that are weak, or a slope."""
    missed = (mean - agreed.from_mps - agreed.moved_mps) / agreed.lasted_s
    factor, told = before.wheels_factor, before.compared
    if abs(missed) <= BIAS_MPS2:
        return _fresh(mean, before.bias_mps2, shown, before.brake_gain, factor, told, 0.0)
    sign = 1.0 if mean >= 0.0 else -1.0
    lack = sign * missed
    if lack < 0.0 and min(before.brake_gain) < 1.0:
        return _fresh(mean, before.bias_mps2, shown, WHOLE_BRAKES, factor, told, 0.0)  # they are back
    gain, found = _weak_brakes(lack, mean, rims, wheels, t, before.brake_gain, vehicle)
    bias = _clamped(before.bias_mps2 + sign * (lack - found), MOST_MPS2)
    return _fresh(mean, bias, shown, gain, factor, told, 0.0)


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
    t: _Turning,
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
def _doubts(
    w: Wheels,
    t: _Turning,
    predicted: float,
    acceleration: float,
    dt: float,
    stray: Wheels,
    old: Wheels,
    vehicle: VehicleParams,
) -> tuple[Wheels, Wheels]:
    """How long each wheel has stayed away by now, and the time it has yet to be good."""
    front, rear = vehicle.front.wheel, vehicle.rear.wheel
    torque, change, g = t.torque_nm, t.change_radps, t.gated
    s0, d0 = _wheel_doubt(
        w[0], change[0], torque[0], predicted, acceleration, dt, stray[0], old[0], g[0], front, t.front_nm
    )
    s1, d1 = _wheel_doubt(
        w[1], change[1], torque[1], predicted, acceleration, dt, stray[1], old[1], g[1], front, t.front_nm
    )
    s2, d2 = _wheel_doubt(
        w[2], change[2], torque[2], predicted, acceleration, dt, stray[2], old[2], g[2], rear, t.rear_nm
    )
    s3, d3 = _wheel_doubt(
        w[3], change[3], torque[3], predicted, acceleration, dt, stray[3], old[3], g[3], rear, t.rear_nm
    )
    return (s0, s1, s2, s3), (d0, d1, d2, d3)


@kernel
def _used_wheels(
    w: Wheels, doubt: Wheels, used_mps: float, believed: int, demand_w: float, vehicle: VehicleParams
) -> Wheels:
    """Wheel speeds to use.

    Where none is believed, all of them may be wrong by one factor: the one that slips least is taken as rolling, and
    the others tell their slip beside it.
    """
    front, rear = vehicle.front.wheel.radius_m, vehicle.rear.wheel.radius_m
    if believed == 0:
        sign = 1.0 if used_mps >= 0.0 else -1.0
        rims = _rims(_times(sign, w), vehicle)
        best = max(rims) if demand_w < 0.0 else min(rims)
        factor = abs(used_mps) / best if best > 0.0 else 0.0
        if LEAST_FACTOR < factor < 1.0 / LEAST_FACTOR:
            return _times(factor, w)
    return (
        _used(w[0], doubt[0], w[1], doubt[1], used_mps / front),
        _used(w[1], doubt[1], w[0], doubt[0], used_mps / front),
        _used(w[2], doubt[2], w[3], doubt[3], used_mps / rear),
        _used(w[3], doubt[3], w[2], doubt[2], used_mps / rear),
    )


@kernel
def _times(factor: float, w: Wheels) -> Wheels:
    return (factor * w[0], factor * w[1], factor * w[2], factor * w[3])


@kernel
def _combined(factor: float, more: float) -> float:
    """What the wheels are multiplied by from now on."""
    both = factor * more
    if both < LEAST_FACTOR or both > 1.0 / LEAST_FACTOR:
        return factor
    return 1.0 if abs(both - 1.0) <= WORN_PART else both


@kernel
def _jumped_by(
    shown: float, w: Wheels, wheels: FourWheels, travel: float, dt: float, before: MotionState, vehicle: VehicleParams
) -> tuple[float, float]:
    """Factor that undoes a jump of all four wheels in this step which neither their torques nor the sensor explain.

    The torque explains what the road did not take of it in the last step. That is known while the wheels have done what
    it says for a while, which is the second number: after a message that is late, nothing explains their changes.
    """
    speed = before.speed_mps
    d = before.wheel_doubt_s
    near = abs(shown - speed) <= SPEED_PART * abs(speed) + SPEED_MPS
    odd = near and before.doubt_s == 0.0 and max(d[0], d[1], d[2], d[3]) == 0.0 and before.calm_s > CALM_S
    rest, low, high, new = 0.0, math.inf, -math.inf, False
    for i in range(4):
        old = travel * wheels[i].speed_radps
        inertia = vehicle.front.wheel.inertia_kgm2 if i < 2 else vehicle.rear.wheel.inertia_kgm2
        gained = travel * (wheels[i].total_nm - wheels[i].road_nm) * dt / inertia
        change = w[i] - old
        rest += 0.25 * (change - gained)
        new = new or change != 0.0
        over = change - min(max(change, min(gained, 0.0)), max(gained, 0.0))
        if abs(over) <= COMMON_RADPS or w[i] * old <= 0.0:
            odd = False
        else:
            part = (old + gained) / w[i]
            low, high = min(low, part), max(high, part)
    calm_s = before.calm_s + dt if new and abs(rest) <= COMMON_RADPS else 0.0
    return 0.5 * (low + high) if odd and high - low <= COMMON_PART else 1.0, calm_s


@kernel
def _bias_mps2(before: float, shown: float, predicted: float, trusted: bool, rolling: _Rolling, dt: float) -> float:
    """What the forces do not explain of a speed that is believed."""
    if abs(predicted) <= SLOW_MPS:
        return _clamped(before, BIAS_MPS2)
    if not trusted:
        return before
    gain = CONFIRMED_GAIN_PER_S2 if _confirmed(shown, rolling) else BIAS_GAIN_PER_S2
    step = gain * _clamped(shown - predicted, BIAS_STEP_MPS) * dt
    return _clamped(before + step, max(BIAS_MPS2, abs(before)))


@kernel
def estimate(
    measurement: Measurement,
    before: MotionState,
    wheels: FourWheels,
    travel: float,
    first: bool,
    vehicle: VehicleParams,
) -> tuple[Motion, MotionState]:
    """The car's motion now.

    Parameters
    ----------
    measurement : speeds, negative backwards; a speed that is not known is NaN
    before : of the step before
    wheels : what the law remembers of them, in the direction of travel
    travel : 1 if that was forwards, -1 backwards
    first : the first step of a run: nothing is known from before
    """
    shown = measurement.speed_mps
    dt = measurement.dt_s
    raw = measurement.wheel_speed_radps
    if first:
        before = _started(shown, _rims(raw, vehicle))
    factor, calm_s = before.wheels_factor, 0.0
    if not first:
        jump, calm_s = _jumped_by(shown, _times(factor, raw), wheels, travel, dt, before, vehicle)
        factor = _combined(factor, jump)
    w = _times(factor, raw)
    rims = _rims(w, vehicle)
    turning = _turning(w, wheels, travel, first, dt, before.wheel_doubt_s, vehicle)
    forces = _forces_mps2(turning.road_nm, vehicle)
    acceleration = 0.0
    if abs(before.speed_mps) > SLOW_MPS and not first:
        acceleration = forces - _resistance_mps2(before.speed_mps, vehicle) + before.bias_mps2
    predicted = before.speed_mps + acceleration * dt
    agreed, mean, right = _voted(shown, rims, predicted, acceleration, measurement, turning, before, vehicle)
    if right:
        predicted = mean
        before = _restarted(mean, rims, agreed, shown, wheels, turning, before, vehicle)
        agreed = before.agreed
    stray, doubt = _doubts(w, turning, predicted, acceleration, dt, before.wheel_stray_s, before.wheel_doubt_s, vehicle)
    rolling = _rolling(rims, doubt, turning)
    sensor = _judge_speed(shown, predicted, acceleration, dt, before, rolling)
    trusted = not math.isnan(shown) and sensor.doubt_s == 0.0
    demand = measurement.power_demand_w
    reference = _pulled(sensor.predicted_mps, shown, trusted, rolling, demand, forces, dt)
    used = shown if trusted else reference
    motion = Motion(
        speed_mps=used,
        uncertainty_mps=0.1 + SPEED_PART * abs(used) if trusted else SPEED_MPS + 2.0 * WHEEL_PART * abs(used),
        wheel_speed_radps=_used_wheels(w, doubt, used, rolling.believed, demand, vehicle),
        lower_part=_lower_part(shown, reference, trusted, before.compared),
        doubted=_doubted(trusted, doubt, factor),
    )
    bias = _bias_mps2(before.bias_mps2, shown, sensor.predicted_mps, trusted, rolling, dt)
    compared, told, anew = _compared(shown, rims, turning, sensor.apart_s, factor, before.compared, dt)
    if anew:
        # In the next step the wheels change without a torque.
        return motion, _fresh(_mean(rims) * told / factor, bias, shown, before.brake_gain, told, compared, dt)
    after = MotionState(
        speed_mps=reference,
        bias_mps2=bias,
        shown_mps=shown,
        shown_s=sensor.shown_s,
        moved_mps=sensor.moved_mps,
        apart_s=sensor.apart_s,
        doubt_s=sensor.doubt_s,
        wheel_stray_s=stray,
        wheel_doubt_s=doubt,
        agreed=agreed,
        brake_gain=before.brake_gain,
        wheels_factor=factor,
        calm_s=calm_s,
        compared=compared,
    )
    return motion, after


@kernel
def _compared(
    shown: float, rims: Wheels, t: _Turning, apart_s: float, factor: float, before: Compared, dt: float
) -> tuple[Compared, float, bool]:
    """What sensor and wheels have said of each other by now, the wheels' factor, and whether all begins anew by it."""
    mean = _mean(rims)
    slow = math.isnan(shown) or min(abs(shown), abs(mean)) <= COMPARED_MPS or shown * mean < 0.0
    agree = max(rims) - min(rims) <= AGREE_PART * abs(mean) + AGREE_MPS
    freely = _used_friction(t.road_nm, t) < ROLLING_FRICTION
    if slow or not agree or not (freely or _mean(t.torque_nm) * (mean - shown) < 0.0):
        return before, factor, False
    if before.lasted_s >= COMPARED_S:
        # Wheels that show by themselves what the sensor does are right again; a wrong sensor is not wrong by a factor.
        over = freely and _unsure(before) and (_same(shown, mean / factor) or apart_s > APART_S)
        return (Compared(1.0, before.lasted_s), 1.0, True) if over else (before, factor, False)
    lasted_s = before.lasted_s + dt
    ratio = before.ratio + dt / lasted_s * (shown / mean - before.ratio)
    if lasted_s < COMPARED_S:
        return Compared(ratio, lasted_s), factor, False
    same = abs(ratio - 1.0) <= WORN_PART
    if same or not LEAST_PART < ratio < 1.0 / LEAST_PART or abs(mean) > COMPARED_MOST_MPS:
        ratio = 1.0
    return Compared(ratio, lasted_s), _combined(factor, ratio), not same


@kernel
def _unsure(compared: Compared) -> bool:
    """Whether sensor and wheels have differed by a factor from the start on."""
    return compared.lasted_s >= COMPARED_S and compared.ratio != 1.0


@kernel
def _lower_part(shown: float, reference: float, trusted: bool, compared: Compared) -> float:
    """The lower of two speeds, as part of the one used, where nothing tells which of them is wrong; else 1."""
    part = 1.0
    if _unsure(compared):
        part = min(1.0 / compared.ratio, 1.0)
    if not (trusted or math.isnan(shown)) and abs(reference) > SLOW_MPS:
        ratio = shown / reference
        if LEAST_PART < ratio < 1.0:
            part = min(part, ratio)
    return part


@kernel
def _doubted(trusted: bool, doubt_s: Wheels, factor: float) -> int:
    """Bits of what is not believed."""
    bits = 0 if trusted else DOUBT_SPEED
    for i in range(4):
        if doubt_s[i] > 0.0 or factor != 1.0:
            bits |= 1 << i
    return bits


@kernel
def _rims(w: Wheels, vehicle: VehicleParams) -> Wheels:
    front, rear = vehicle.front.wheel.radius_m, vehicle.rear.wheel.radius_m
    return (w[0] * front, w[1] * front, w[2] * rear, w[3] * rear)


@kernel
def _mean(values: Wheels) -> float:
    return 0.25 * (values[0] + values[1] + values[2] + values[3])


@kernel
def _middle(rims: Wheels) -> float:
    """Mean of the two middle ones."""
    low = min(rims[0], rims[1], rims[2], rims[3])
    high = max(rims[0], rims[1], rims[2], rims[3])
    return 0.5 * (rims[0] + rims[1] + rims[2] + rims[3] - low - high)


@kernel
def _used(own: float, own_doubt_s: float, other: float, other_doubt_s: float, rolling: float) -> float:
    if own_doubt_s == 0.0:
        return own
    return other if other_doubt_s == 0.0 else rolling
