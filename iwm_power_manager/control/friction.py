# SPDX-License-Identifier: Apache-2.0
"""Peak friction of the road under the left and the right wheels, from slip and road force.

A tyre's force over its load is the road's peak friction times a curve of the slip that the tyre alone decides (eq. 9).
So each wheel tells the friction in two ways:

- **slipping**: the curve is well up, and force over curve is the friction at once. It takes over within a tenth of a
  second; upwards at a limited rate, so that one outlier raises nothing.
- **rolling**: the slip is small, and what is known of it is mostly error. The slope of curve over force is its inverse
  friction: a regression with the applied torque as instrument, which neither white noise of the speeds nor a constant
  error of them (a worn tyre, a speedometer) biases. How well it is known follows from how far the torques were apart
  and how far the points lie from the line; the confidence is that, and only as fast as that is the slope believed.

A friction in use is a lower bound at any slip. Where nothing tells, the estimate goes back to the prior, slowly.

That the slope at small slip goes with the peak is a property of this tyre model; of real tyres it holds by tendency
only (the slip-slope method), so an estimate from rolling alone is a reason for a power split, not for a brake.
"""

from __future__ import annotations

import math

from iwm_power_manager.control.settings import Settings
from iwm_power_manager.control.types import (
    FrictionState,
    SideGrip,
    WheelGrip,
    WheelState,
)
from iwm_power_manager.jit import kernel
from iwm_power_manager.model.chassis import normal_forces_n
from iwm_power_manager.model.parameters import Axle, VehicleParams
from iwm_power_manager.model.tyre import friction_coefficient, slip_ratio

Wheels = tuple[float, float, float, float]

#: Below this speed, m/s, slip is mostly error.
SLOWEST_MPS = 3.0
#: Errors of slip go with one over the speed: up to here, m/s, a wheel's word counts the less.
SURE_MPS = 10.0
#: Slip speed, m/s, and part of the curve beyond which a wheel slips; the speeds of the wheels on either side of a
#: curve driven at this acceleration, m/s2, differ as well.
SLIPPING_MPS = 0.4
SLIPPING_PART = 0.4
CURVE_MPS2 = 4.0
#: Slip and force are averaged over this time, s, before a wheel counts as slipping; then its friction is believed
#: within the second time.
SHORT_S = 0.02
PROMPT_S = 0.05
#: The slope is believed within this time, s, as far as it is known: it is a mean over `friction_memory_s` already, and
#: until it counts the split is that of another road.
SLOPE_S = 0.1
#: Slip that no tyre model is better than, and the relative error at which a slope is half believed.
LEAST_ERROR_SLIP = 0.0005
HALF_BELIEVED = 0.1
#: What is left of the confidence when the road was felt, in the time after it, goes with `friction_return_s`.
LEAST_FRICTION, MOST_FRICTION = 0.05, 1.2
#: Friction the strategy is given: it follows the estimate when that is this far off, to two digits.
DEAD_BAND = 0.03
_STEPS = 100.0


@kernel
def _averaged(before: float, value: float, part: float) -> float:
    return before + part * (value - before)


@kernel
def _rolled(
    grip: WheelGrip, torque: float, road: float, curve: float, weight: float, keep: float, slip: float, used: float
) -> WheelGrip:
    """A point added to a wheel's regression, with the weight of all before it times `keep` (weighted Welford)."""
    total = keep * grip.weight + weight
    part = weight / total
    d_torque, d_curve = torque - grip.torque, curve - grip.curve
    mean_torque = grip.torque + part * d_torque
    mean_road = grip.road + part * (road - grip.road)
    mean_curve = grip.curve + part * d_curve
    return WheelGrip(
        slip=slip,
        used=used,
        weight=total,
        torque=mean_torque,
        road=mean_road,
        curve=mean_curve,
        torque_torque=keep * grip.torque_torque + weight * d_torque * (torque - mean_torque),
        torque_road=keep * grip.torque_road + weight * d_torque * (road - mean_road),
        torque_curve=keep * grip.torque_curve + weight * d_torque * (curve - mean_curve),
        curve_curve=keep * grip.curve_curve + weight * d_curve * (curve - mean_curve),
    )


@kernel
def _wheel(
    grip: WheelGrip,
    before: WheelState,
    wheel_speed_radps: float,
    speed_mps: float,
    load_n: float,
    dt_s: float,
    settings: Settings,
    axle: Axle,
) -> tuple[WheelGrip, float]:
    """What a wheel adds; and the friction it slips at, 0 if it does not slip."""
    radius = axle.wheel.radius_m
    scale = 1.0 / (radius * load_n)
    torque = before.total_nm * scale
    road = torque - axle.wheel.inertia_kgm2 * (wheel_speed_radps - before.speed_radps) / dt_s * scale
    slip = slip_ratio(wheel_speed_radps, speed_mps, radius, axle.tyre.slip_speed_floor_mps)
    part = dt_s / (SHORT_S + dt_s)
    slip_now = _averaged(grip.slip, slip, part)
    used_now = _averaged(grip.used, road, part)
    curve = friction_coefficient(slip_now, 1.0, axle.tyre)
    apart = abs(slip_now) * speed_mps
    if apart > SLIPPING_MPS + 0.5 * axle.track_width_m * CURVE_MPS2 / speed_mps and abs(curve) > SLIPPING_PART:
        # Whatever it rolled on before, it may not be what it slips on.
        slipping = max(used_now / curve, LEAST_FRICTION)
        return WheelGrip(slip_now, used_now, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), slipping
    size = min(speed_mps / SURE_MPS, 1.0)
    keep = 1.0 - dt_s / (settings.friction_memory_s + dt_s)
    curve = friction_coefficient(slip, 1.0, axle.tyre)
    return _rolled(grip, torque, road, curve, size * size, keep, slip_now, used_now), 0.0


@kernel
def _slope(front: WheelGrip, rear: WheelGrip, axle: Axle) -> tuple[float, float]:
    """Friction that the slope of a side's wheels tells, and how far it is believed, 0..1."""
    torque_road = front.torque_road + rear.torque_road
    torque_curve = front.torque_curve + rear.torque_curve
    square = front.torque_torque + rear.torque_torque
    weight = front.weight + rear.weight
    if not (torque_road > 0.0 and torque_curve > 0.0 and square > 0.0):
        return 0.0, 0.0
    slope = torque_curve / torque_road
    off = front.curve_curve + rear.curve_curve - 2.0 * slope * torque_curve + slope * slope * square
    least = friction_coefficient(LEAST_ERROR_SLIP, 1.0, axle.tyre)
    error = math.sqrt((max(off, 0.0) / weight + least * least) / square) / slope
    friction = min(max(1.0 / slope, LEAST_FRICTION), MOST_FRICTION)
    return friction, 1.0 / (1.0 + (error / HALF_BELIEVED) * (error / HALF_BELIEVED))


@kernel
def _side(
    side: SideGrip,
    front: WheelGrip,
    rear: WheelGrip,
    front_slipping: float,
    rear_slipping: float,
    dt_s: float,
    settings: Settings,
    axle: Axle,
) -> SideGrip:
    """The estimate of one side."""
    friction = side.friction
    faded = side.confidence * (1.0 - dt_s / (settings.friction_return_s + dt_s))
    slipping = max(front_slipping, rear_slipping)
    if slipping > 0.0:
        # Where both slip, neither may be at its peak: the larger is nearer.
        change = (min(slipping, MOST_FRICTION) - friction) * dt_s / (PROMPT_S + dt_s)
        return SideGrip(friction + min(change, settings.friction_rise_per_s * dt_s), 1.0)
    slope, believed = _slope(front, rear, axle)
    change = believed * (slope - friction) * dt_s / SLOPE_S
    change += (1.0 - believed) * (settings.friction_prior - friction) * dt_s / settings.friction_return_s
    friction += min(change, settings.friction_rise_per_s * dt_s)
    used = max(abs(front.used), abs(rear.used))
    if used > friction:
        friction += min(min(used, MOST_FRICTION) - friction, settings.friction_rise_per_s * dt_s)
    return SideGrip(friction, max(believed, faded))


@kernel
def estimate(
    before: FrictionState,
    wheels: tuple[WheelState, WheelState, WheelState, WheelState],
    wheel_speed_radps: Wheels,
    speed_mps: float,
    believed: bool,
    first: bool,
    dt_s: float,
    settings: Settings,
    vehicle: VehicleParams,
) -> FrictionState:
    """The road's peak friction by now.

    Parameters
    ----------
    before : of the step before
    wheels : what the law remembers of them
    wheel_speed_radps, speed_mps : as believed, in the direction of travel, like `wheels`
    believed : no sensor is doubted; else nothing is learned
    first : the first step of a run: the prior holds
    dt_s : time since the step before
    """
    prior = settings.friction_prior
    if first:
        side = SideGrip(prior, 0.0)
        return FrictionState(left=side, right=side, wheels=before.wheels, assumed=prior)
    a, b, c, d = before.wheels
    left_front = right_front = left_rear = right_rear = 0.0
    front, rear = vehicle.front, vehicle.rear
    if believed and speed_mps > SLOWEST_MPS:
        torque = wheels[0].road_nm + wheels[1].road_nm
        force = torque / front.wheel.radius_m + (wheels[2].road_nm + wheels[3].road_nm) / rear.wheel.radius_m
        front_n, rear_n = normal_forces_n(force / vehicle.chassis.mass_kg, 0.0, 0.0, vehicle.chassis)
        front_n, rear_n = max(front_n, 1.0), max(rear_n, 1.0)
        w = wheel_speed_radps
        front_alike = wheels[0] == wheels[1] and w[0] == w[1] and a == b
        rear_alike = wheels[2] == wheels[3] and w[2] == w[3] and c == d
        a, left_front = _wheel(a, wheels[0], w[0], speed_mps, front_n, dt_s, settings, front)
        c, left_rear = _wheel(c, wheels[2], w[2], speed_mps, rear_n, dt_s, settings, rear)
        if front_alike:
            b, right_front = a, left_front
        else:
            b, right_front = _wheel(b, wheels[1], w[1], speed_mps, front_n, dt_s, settings, front)
        if rear_alike:
            d, right_rear = c, left_rear
        else:
            d, right_rear = _wheel(d, wheels[3], w[3], speed_mps, rear_n, dt_s, settings, rear)
    left = right = _side(before.left, a, c, left_front, left_rear, dt_s, settings, front)
    if not (a == b and c == d and before.left == before.right):
        right = _side(before.right, b, d, right_front, right_rear, dt_s, settings, front)
    lower = min(left.friction, right.friction)
    assumed = before.assumed
    if abs(lower - assumed) > DEAD_BAND:
        assumed = math.floor(lower * _STEPS + 0.5) / _STEPS
    return FrictionState(left=left, right=right, wheels=(a, b, c, d), assumed=assumed)
