# SPDX-License-Identifier: Apache-2.0
"""Which wheel speeds are believed: a wheel that does what no torque can, and four that jump by one factor, are not."""

from __future__ import annotations

import math
from typing import NamedTuple

from iwm_power_manager.control.types import FourWheels, MotionState, Wheels
from iwm_power_manager.jit import kernel
from iwm_power_manager.model.chassis import GRAVITY_MPS2
from iwm_power_manager.model.parameters import VehicleParams, Wheel

#: Below this speed, m/s, static friction makes forces say little.
SLOW_MPS = 1.0
#: A speed sensor this far from the reference is not believed: part of the speed, and m/s.
SPEED_PART, SPEED_MPS = 0.03, 0.5
#: A sensor must have been near the reference for this long before it is believed again.
DISTRUST_S = 0.5
#: Noise of a wheel's change in one step, rad/s; what a torque explains is taken times `TORQUE_MARGIN`.
JUMP_RADPS = 1.5
TORQUE_MARGIN = 1.5
#: Motors and brakes may follow their command as a lag of first order that nobody tells, up to this time constant: then
#: what acts is between the least and the most that was commanded, fading so. A wheel that turns away from the car's
#: speed by so many rad/s more in a step than the car's own change is moved by a torque that acts still.
LAG_S, MOVED_RADPS = 0.06, 0.5
#: A wheel without torque (part of load times radius) and away from the car's speed comes back at least as fast as on
#: the smoothest ice; one that does not for this long is a bad sensor. It is good again within the second pair. A gated
#: wheel is away beyond the third, one that runs against its torque beyond the fourth, which bends stay within.
FREE_PART, ICE_FRICTION, RETURN_S = 0.05, 0.03, 0.06
STRAY_PART, STRAY_MPS = 0.1, 0.5
GOOD_PART, GOOD_MPS = 0.06, 0.3
HELD_PART, HELD_MPS = 0.02, 0.1
AGAINST_PART, AGAINST_MPS = 0.05, 0.3
#: Wheels that are all wrong are believed to be so by one factor within this and its inverse; one within the second part
#: of 1 is tyre wear. What they jump by in the same step, rad/s, and how far their factors may be apart.
LEAST_FACTOR, WORN_PART = 0.6, 0.05
COMMON_RADPS, COMMON_PART, CALM_S = 0.5, 0.03, 0.05
#: No road force is larger than this part of the wheel's static load.
MOST_FRICTION = 2.0
NO_WHEELS = (0.0, 0.0, 0.0, 0.0)
WHOLE_BRAKES = (1.0, 1.0, 1.0, 1.0)


@kernel
def clamped(value: float, most: float) -> float:
    """A value, held within `most` of zero."""
    return min(max(value, -most), most)


@kernel
def mean_of(values: Wheels) -> float:
    """Mean of four."""
    return 0.25 * (values[0] + values[1] + values[2] + values[3])


@kernel
def middle_of(rims: Wheels) -> float:
    """Mean of the two middle ones."""
    low = min(rims[0], rims[1], rims[2], rims[3])
    high = max(rims[0], rims[1], rims[2], rims[3])
    return 0.5 * (rims[0] + rims[1] + rims[2] + rims[3] - low - high)


@kernel
def rims_of(w: Wheels, vehicle: VehicleParams) -> Wheels:
    """Speed of each rim, m/s."""
    front, rear = vehicle.front.wheel.radius_m, vehicle.rear.wheel.radius_m
    return (w[0] * front, w[1] * front, w[2] * rear, w[3] * rear)


@kernel
def _road_nm(
    torque_nm: float, change_radps: float, dt_s: float, doubted: bool, inertia: float, load_nm: float
) -> float:
    """Torque the road took from a wheel; of a wheel that is not believed, all of it."""
    road = torque_nm if doubted else torque_nm - inertia * change_radps / dt_s
    return clamped(road, MOST_FRICTION * load_nm)


class Turning(NamedTuple):
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
def turning_of(
    w: Wheels,
    wheels: FourWheels,
    travel: float,
    first: bool,
    dt: float,
    doubt_s: Wheels,
    vehicle: VehicleParams,
) -> Turning:
    """The four wheels of a step, as their torques explain them."""
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
    return Turning(torque, change, road, (a.gated, b.gated, c.gated, d.gated), front_nm, rear_nm)


@kernel
def _fading_nm(torque_nm: float, before_nm: float, dt_s: float) -> float:
    """What may be left of a torque of before."""
    return torque_nm + LAG_S / (LAG_S + dt_s) * (before_nm - torque_nm)


@kernel
def acting_nm(torque_nm: Wheels, before: MotionState, dt_s: float) -> tuple[Wheels, Wheels]:
    """The least and the most torque that may have acted on each wheel, signed as the car is."""
    a, b, c, d = torque_nm
    low, high = before.least_nm, before.most_nm
    least = (
        min(a, _fading_nm(a, low[0], dt_s)),
        min(b, _fading_nm(b, low[1], dt_s)),
        min(c, _fading_nm(c, low[2], dt_s)),
        min(d, _fading_nm(d, low[3], dt_s)),
    )
    most = (
        max(a, _fading_nm(a, high[0], dt_s)),
        max(b, _fading_nm(b, high[1], dt_s)),
        max(c, _fading_nm(c, high[2], dt_s)),
        max(d, _fading_nm(d, high[3], dt_s)),
    )
    return least, most


@kernel
def _wheel_doubt(
    speed_radps: float,
    change_radps: float,
    torque_nm: float,
    shift_nm: float,
    least_nm: float,
    most_nm: float,
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
    rolling = direction * acceleration_mps2 / radius * dt_s
    # Away from the car's speed: what the wheel did, what the car does, and the torques that may have acted.
    sign = -1.0 if level < 0.0 else 1.0
    away_radps, away_rolling = sign * change, max(sign * rolling, 0.0)
    away_nm = max(sign * direction * least_nm, sign * direction * most_nm)
    # Where a stamp looks older than it is, the last torque explains more than the one that was looked up by it.
    looked_up, last = sign * direction * torque_nm, sign * direction * (torque_nm - shift_nm)
    explained = TORQUE_MARGIN * max(max(looked_up, last, 0.0) / inertia * dt_s, away_rolling)
    # The road only ever drives a wheel towards the car's speed.
    jumped = size > SLOW_MPS and away_radps > max(explained, away_nm / inertia * dt_s) + JUMP_RADPS
    moved = away_nm > FREE_PART * load_nm and away_radps > TORQUE_MARGIN * away_rolling + MOVED_RADPS
    # Nothing holds a wheel that is free, nor one that is braked and yet faster than the car.
    free = abs(torque_nm) < FREE_PART * load_nm
    against = direction * torque_nm * level < 0.0 and not free
    # One that is gated should be back by now: an error that looks like slip would keep it gated for ever.
    away = abs(level) > STRAY_PART * size + STRAY_MPS
    if gated:
        away = abs(level) > HELD_PART * size + HELD_MPS
    elif against:
        away = abs(level) > AGAINST_PART * size + AGAINST_MPS
    held = moved or -away_radps >= ICE_FRICTION * load_nm / inertia * dt_s
    stays = (free or against) and away and not held
    # Beyond the first it is no matter for how long it was wrong.
    stray_s = min(stray_s + dt_s, 2.0 * RETURN_S) if stays else max(stray_s - dt_s, 0.0)
    # A step that jumps away is a fault; one that jumps back is the end of it.
    if (jumped and away) or stray_s > RETURN_S:
        doubt_s = DISTRUST_S
    elif doubt_s > 0.0 and abs(level) <= GOOD_PART * size + GOOD_MPS:
        doubt_s = max(doubt_s - dt_s, 0.0)
    return stray_s, doubt_s


@kernel
def wheel_doubts(
    w: Wheels,
    t: Turning,
    shift_nm: Wheels,
    least_nm: Wheels,
    most_nm: Wheels,
    predicted: float,
    acceleration: float,
    dt: float,
    stray: Wheels,
    old: Wheels,
    vehicle: VehicleParams,
) -> tuple[Wheels, Wheels]:
    """How long each wheel has stayed away by now, and the time it has yet to be good."""
    torque, change, g, shift, low, high = t.torque_nm, t.change_radps, t.gated, shift_nm, least_nm, most_nm
    front, rear, f, r, v, a = vehicle.front.wheel, vehicle.rear.wheel, t.front_nm, t.rear_nm, predicted, acceleration
    s0, d0 = _wheel_doubt(
        w[0], change[0], torque[0], shift[0], low[0], high[0], v, a, dt, stray[0], old[0], g[0], front, f
    )
    s1, d1 = _wheel_doubt(
        w[1], change[1], torque[1], shift[1], low[1], high[1], v, a, dt, stray[1], old[1], g[1], front, f
    )
    s2, d2 = _wheel_doubt(
        w[2], change[2], torque[2], shift[2], low[2], high[2], v, a, dt, stray[2], old[2], g[2], rear, r
    )
    s3, d3 = _wheel_doubt(
        w[3], change[3], torque[3], shift[3], low[3], high[3], v, a, dt, stray[3], old[3], g[3], rear, r
    )
    return (s0, s1, s2, s3), (d0, d1, d2, d3)


@kernel
def scaled_wheels(factor: float, w: Wheels) -> Wheels:
    """Four wheel speeds times a factor."""
    return (factor * w[0], factor * w[1], factor * w[2], factor * w[3])


@kernel
def combined_factor(factor: float, more: float) -> float:
    """What the wheels are multiplied by from now on."""
    both = factor * more
    if both < LEAST_FACTOR or both > 1.0 / LEAST_FACTOR:
        return factor
    return 1.0 if abs(both - 1.0) <= WORN_PART else both


@kernel
def common_jump(
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
def _used(own: float, own_doubt_s: float, other: float, other_doubt_s: float, rolling: float) -> float:
    if own_doubt_s == 0.0:
        return own
    return other if other_doubt_s == 0.0 else rolling


@kernel
def wheels_to_use(
    w: Wheels, doubt: Wheels, used_mps: float, believed: int, demand_w: float, vehicle: VehicleParams
) -> Wheels:
    """Wheel speeds to use.

    Where none is believed, all of them may be wrong by one factor: the one that slips least is taken as rolling, and
    the others tell their slip beside it.
    """
    front, rear = vehicle.front.wheel.radius_m, vehicle.rear.wheel.radius_m
    if believed == 0:
        sign = 1.0 if used_mps >= 0.0 else -1.0
        rims = rims_of(scaled_wheels(sign, w), vehicle)
        best = max(rims) if demand_w < 0.0 else min(rims)
        factor = abs(used_mps) / best if best > 0.0 else 0.0
        if LEAST_FACTOR < factor < 1.0 / LEAST_FACTOR:
            return scaled_wheels(factor, w)
    return (
        _used(w[0], doubt[0], w[1], doubt[1], used_mps / front),
        _used(w[1], doubt[1], w[0], doubt[0], used_mps / front),
        _used(w[2], doubt[2], w[3], doubt[3], used_mps / rear),
        _used(w[3], doubt[3], w[2], doubt[2], used_mps / rear),
    )
