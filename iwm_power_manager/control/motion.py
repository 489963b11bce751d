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

`wheel_doubt` judges the wheels, `speed_doubt` the sensor, `motion_vote` starts the reference over.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from iwm_power_manager.control.motion_vote import (
    BIAS_MPS2,
    force_mps2,
    fresh_motion,
    restarted_motion,
    road_resistance_mps2,
    started_motion,
    vote,
)
from iwm_power_manager.control.speed_doubt import (
    Rolling,
    compared_speeds,
    is_confirmed,
    judged_speed,
    lower_part_of,
    rolling_of,
)
from iwm_power_manager.control.types import FourWheels, Measurement, MotionState, Wheels
from iwm_power_manager.control.wheel_doubt import (
    SLOW_MPS,
    WORN_PART,
    acting_nm,
    clamped,
    combined_factor,
    common_jump,
    mean_of,
    rims_of,
    scaled_wheels,
    turning_of,
    wheel_doubts,
    wheels_to_use,
)
from iwm_power_manager.jit import kernel
from iwm_power_manager.model.parameters import VehicleParams

#: What a speed sensor may pull the reference by, m/s2: a slope of 10 %; and part of the forces, for an unknown load.
PULL_MPS2 = 1.0
PULL_OF_FORCES = 0.2
#: The same for the wheels while the speed sensor is not believed, and for both below `SLOW_MPS`.
WHEEL_PULL_MPS2 = 1.5
SLOW_PULL_MPS2 = 8.0
#: A wheel within this part of the speed, and this, may be rolling: slip and tyre wear are no reason to pull. The last
#: is for wheels that lead by themselves: the forces may not explain what they show.
WHEEL_PART, WHEEL_MPS, ALONE_MPS = 0.06, 0.2, 0.1
#: How fast a steady difference is taken for a slope, 1/s2; and while the wheels confirm the sensor.
BIAS_GAIN_PER_S2, CONFIRMED_GAIN_PER_S2 = 1.5, 6.0
BIAS_STEP_MPS = 0.3
#: Bits of `Motion.doubted`: the wheels in their order, then the speed sensor.
DOUBT_SPEED = 16


class Motion(NamedTuple):
    """What is known of the car's motion.

    Attributes
    ----------
    speed_mps : speed to use, negative backwards
    wheel_speed_radps : wheel speeds to use; one that is not believed has that of its axle's other wheel, or rolls
    lower_part : the lower of two speeds, as part of the one used, where sensor and wheels differ by a quarter at most
        and nothing tells which of them is wrong; else 1
    doubted : bits of what is not believed: 1, 2, 4, 8 the wheels, 16 the speed sensor
    """

    speed_mps: float
    wheel_speed_radps: Wheels
    lower_part: float
    doubted: int


@kernel
def _pulled(
    predicted: float, shown: float, trusted: bool, rolling: Rolling, demand_w: float, forces: float, dt: float
) -> float:
    """The reference: what the forces predict, pulled at by sensor and wheels."""
    size = abs(predicted)
    slow = size <= SLOW_MPS
    reference = predicted
    if trusted:
        pull = SLOW_PULL_MPS2 if slow else PULL_MPS2 + PULL_OF_FORCES * abs(forces)
        reference += clamped(shown - predicted, pull * dt)
    if rolling.believed > 0:
        # A braked wheel is never faster than the car, a driven one never slower.
        best = rolling.mean_mps
        if demand_w < 0.0:
            best = rolling.high_mps if predicted >= 0.0 else rolling.low_mps
        elif demand_w > 0.0:
            best = rolling.low_mps if predicted >= 0.0 else rolling.high_mps
        error = best - predicted
        if abs(error) > WHEEL_PART * size + (WHEEL_MPS if trusted else ALONE_MPS):
            pull = PULL_MPS2
            if not trusted:
                pull = SLOW_PULL_MPS2 if slow else WHEEL_PULL_MPS2 + PULL_OF_FORCES * abs(forces)
            reference += clamped(error, pull * dt)
        elif not trusted and rolling.nearly:
            reference += clamped(error, PULL_MPS2 * dt)
    return reference


@kernel
def _bias_mps2(before: float, shown: float, predicted: float, trusted: bool, rolling: Rolling, dt: float) -> float:
    """What the forces do not explain of a speed that is believed."""
    if abs(predicted) <= SLOW_MPS:
        return clamped(before, BIAS_MPS2)
    if not trusted:
        return before
    gain = CONFIRMED_GAIN_PER_S2 if is_confirmed(shown, rolling) else BIAS_GAIN_PER_S2
    step = gain * clamped(shown - predicted, BIAS_STEP_MPS) * dt
    return clamped(before + step, max(BIAS_MPS2, abs(before)))


@kernel
def _acceleration_mps2(forces: float, before: MotionState, first: bool, vehicle: VehicleParams) -> float:
    """What changes the speed of a car that moves: the road's forces, its resistance, and what they do not explain."""
    if abs(before.speed_mps) > SLOW_MPS and not first:
        return forces - road_resistance_mps2(before.speed_mps, vehicle) + before.bias_mps2
    return 0.0


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
    shown, dt = measurement.speed_mps, measurement.dt_s
    raw, shift = measurement.wheel_speed_radps, measurement.torque_shift_nm
    if first:
        before = started_motion(shown, rims_of(raw, vehicle))
    factor, calm_s = before.wheels_factor, 0.0
    if not first:
        jump, calm_s = common_jump(shown, scaled_wheels(factor, raw), wheels, travel, dt, before, vehicle)
        if jump != 1.0:
            factor = combined_factor(factor, jump)
    w = scaled_wheels(factor, raw)
    rims = rims_of(w, vehicle)
    turning = turning_of(w, wheels, travel, first, dt, before.wheel_doubt_s, vehicle)
    least, most = acting_nm(turning.torque_nm, before, dt)
    forces = force_mps2(turning.road_nm, vehicle)
    acceleration = _acceleration_mps2(forces, before, first, vehicle)
    predicted = before.speed_mps + acceleration * dt
    agreed, mean, right = vote(shown, rims, predicted, acceleration, measurement, turning, before, vehicle)
    if right:
        predicted = mean
        before = restarted_motion(mean, rims, agreed, shown, wheels, turning, before, vehicle)
        agreed = before.agreed
    stray, doubt = wheel_doubts(
        w, turning, shift, least, most, predicted, acceleration, dt, before.wheel_stray_s, before.wheel_doubt_s, vehicle
    )
    rolling = rolling_of(rims, doubt, turning)
    sensor = judged_speed(shown, predicted, acceleration, dt, before, rolling)
    trusted = not math.isnan(shown) and sensor.doubt_s == 0.0
    demand = measurement.power_demand_w
    reference = _pulled(sensor.predicted_mps, shown, trusted, rolling, demand, forces, dt)
    used = shown if trusted else reference
    motion = Motion(
        speed_mps=used,
        wheel_speed_radps=wheels_to_use(w, doubt, used, rolling.believed, demand, vehicle),
        lower_part=lower_part_of(shown, reference, trusted, before.compared),
        doubted=_doubted(trusted, doubt, factor),
    )
    bias = _bias_mps2(before.bias_mps2, shown, sensor.predicted_mps, trusted, rolling, dt)
    compared, told, anew = compared_speeds(
        shown, rims, turning, sensor.apart_s, factor, before.compared, trusted and rolling.believed == 4, dt
    )
    if anew:
        # In the next step the wheels change without a torque.
        return motion, fresh_motion(mean_of(rims) * told / factor, bias, shown, before.brake_gain, told, compared, dt)
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
        least_nm=least,
        most_nm=most,
        agreed=agreed,
        brake_gain=before.brake_gain,
        wheels_factor=told,
        calm_s=calm_s,
        compared=compared,
    )
    return motion, after


@kernel
def _doubted(trusted: bool, doubt_s: Wheels, factor: float) -> int:
    """Bits of what is not believed."""
    bits = 0 if trusted else DOUBT_SPEED
    for i in range(4):
        if doubt_s[i] > 0.0 or abs(factor - 1.0) > WORN_PART:
            bits |= 1 << i
    return bits
