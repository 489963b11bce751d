# SPDX-License-Identifier: Apache-2.0
"""The step of `model.longitudinal` from a good guess.

Three unknowns are left: the speeds of the car and of a wheel of each axle at the end of the step. Newton's method on
all three at once takes two or three iterations from the solution of a neighbouring problem, or from the car's motion
so far, where `longitudinal.step`, which has to find its way from anywhere, takes a dozen evaluations of each tyre and
more. It answers only where it is sure: a wheel or the car that stops, a wheel equation that may have several solutions,
or an iteration that does not converge are left to `longitudinal.step`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from iwm_power_manager.jit import kernel
from iwm_power_manager.model.chassis import aerodynamic_force_n, grade_force_n, normal_forces_n, rolling_force_n
from iwm_power_manager.model.longitudinal import Moved, Speeds, Torques, Two, step
from iwm_power_manager.model.parameters import Axle, VehicleParams
from iwm_power_manager.model.tyre import friction_and_slope

#: Newton's steps shrink quadratically: where one is this small (relative), the next one is rounding.
_SMALL = 1e-8
_MOST_ITERATIONS = 8
#: Slips at which a tyre's curve is sampled.
_SAMPLES = 200


class Curve(NamedTuple):
    """What makes a wheel's equation ambiguous: where friction falls with slip.

    Attributes
    ----------
    fall : most negative slope of the friction coefficient over slip, <= 0
    sliding : least friction coefficient beyond the peak; what is below it, only the rising branch gives
    """

    fall: float
    sliding: float


#: `curves` of `step_from` with which `longitudinal.step` is always asked.
UNSURE = (Curve(-math.inf, 0.0), Curve(-math.inf, 0.0))


class _Balance(NamedTuple):
    """A wheel's equation (eq. 11) at a guess, and how it and the tyre's force follow wheel and car."""

    missing_nm: float
    by_wheel: float
    by_car: float
    force_n: float
    force_by_wheel: float
    force_by_car: float


@kernel
def curve_of(friction: float, axle: Axle) -> Curve:
    """What there is to know of an axle's tyre on a road, from samples of its curve."""
    fall = peak = 0.0
    for i in range(_SAMPLES + 1):
        mu, slope = friction_and_slope(i / _SAMPLES, friction, axle.tyre)
        fall = min(fall, slope)
        peak = max(peak, mu)
    sliding = peak
    for i in range(_SAMPLES, -1, -1):
        mu, _ = friction_and_slope(i / _SAMPLES, friction, axle.tyre)
        if mu == peak:
            break
        sliding = min(sliding, mu)
    return Curve(fall, sliding)


@kernel
def _balance(
    wheel: float,
    car: float,
    before: float,
    torque: float,
    normal: float,
    normal_by_car: float,
    friction: float,
    rate: float,
    axle: Axle,
) -> _Balance:
    radius = axle.wheel.radius_m
    rim = radius * wheel
    denominator = max(rim, car, axle.tyre.slip_speed_floor_mps)
    mu, slope = friction_and_slope((rim - car) / denominator, friction, axle.tyre)
    by_wheel = radius / denominator
    by_car = -1.0 / denominator
    if denominator == rim:
        by_wheel *= car / rim
    elif denominator == car:
        by_car *= rim / car
    force = normal * mu
    force_by_wheel = normal * slope * by_wheel
    force_by_car = normal * slope * by_car + normal_by_car * mu
    return _Balance(
        missing_nm=rate * (wheel - before) + radius * force - torque,
        by_wheel=rate + radius * force_by_wheel,
        by_car=radius * force_by_car,
        force_n=force,
        force_by_wheel=force_by_wheel,
        force_by_car=force_by_car,
    )


@kernel
def _only_one(car: float, normal: float, force: float, curve: Curve, rate: float, axle: Axle) -> bool:
    """Whether a wheel's equation can have no second solution at this speed of the car.

    A force on the rising branch that no sliding tyre has: all wheels that are faster find more force, all slower ones
    less. Beyond that, the wheel's inertia has to outweigh the curve's fall.
    """
    if abs(force) < curve.sliding * normal:
        return True
    radius = axle.wheel.radius_m
    return rate + radius * radius * normal * curve.fall / max(car, axle.tyre.slip_speed_floor_mps) > 0.0


class _Found(NamedTuple):
    """What Newton's method came to, if anything, and what tells how sure it is.

    `rising` : no tyre was beyond its peak on the way
    """

    found: bool
    rising: bool
    speeds: Speeds
    front_n: float
    rear_n: float
    front_force_n: float
    rear_force_n: float


@kernel
def _newton(
    before: Speeds,
    torques: Torques,
    guess: Speeds,
    grade: float,
    friction: Two,
    dt_s: float,
    vehicle: VehicleParams,
) -> _Found:
    chassis = vehicle.chassis
    part = dt_s / chassis.mass_kg
    rolling = rolling_force_n(grade, chassis)
    slope = grade_force_n(grade, chassis)
    front_rate = vehicle.front.wheel.inertia_kgm2 / dt_s
    rear_rate = vehicle.rear.wheel.inertia_kgm2 / dt_s
    front_nm = torques.front_motor_nm - torques.front_resisting_nm
    rear_nm = torques.rear_motor_nm - torques.rear_resisting_nm
    wheelbase = chassis.front_axle_to_cg_m + chassis.rear_axle_to_cg_m
    car, front, rear = guess
    rising = True
    for _ in range(_MOST_ITERATIONS):
        front_n, rear_n = normal_forces_n((car - before.car_mps) / dt_s, car, grade, chassis)
        both = front_n + rear_n
        drag = aerodynamic_force_n(car, chassis)
        drag_by_car = 2.0 * drag / car
        shift = 0.0
        if 0.0 < front_n < both:
            shift = chassis.cg_height_m * (1.0 / part + drag_by_car) / (2.0 * wheelbase)
        f = _balance(front, car, before.front_radps, front_nm, front_n, -shift, friction[0], front_rate, vehicle.front)
        r = _balance(rear, car, before.rear_radps, rear_nm, rear_n, shift, friction[1], rear_rate, vehicle.rear)
        if f.by_wheel <= 0.0 or r.by_wheel <= 0.0:
            break
        rising = rising and f.force_by_wheel > 0.0 and r.force_by_wheel > 0.0
        # Each wheel follows the car as its own equation says; what is left is one equation of the car's speed.
        front_lag = f.force_by_wheel / f.by_wheel
        rear_lag = r.force_by_wheel / r.by_wheel
        force = f.force_n + r.force_n - front_lag * f.missing_nm - rear_lag * r.missing_nm
        force_by_car = f.force_by_car + r.force_by_car - front_lag * f.by_car - rear_lag * r.by_car
        missing = car - before.car_mps + part * (drag + rolling + slope - 2.0 * force)
        change = -missing / (1.0 + part * (drag_by_car - 2.0 * force_by_car))
        front_change = -(f.missing_nm + f.by_car * change) / f.by_wheel
        rear_change = -(r.missing_nm + r.by_car * change) / r.by_wheel
        car += change
        front += front_change
        rear += rear_change
        if not (car > 0.0 and front > 0.0 and rear > 0.0):
            break
        if (
            abs(change) <= _SMALL * (1.0 + car)
            and abs(front_change) <= _SMALL * (1.0 + front)
            and abs(rear_change) <= _SMALL * (1.0 + rear)
        ):
            return _Found(True, rising, Speeds(car, front, rear), front_n, rear_n, f.force_n, r.force_n)
    return _Found(False, False, guess, 0.0, 0.0, 0.0, 0.0)


@kernel
def _moved(before: Speeds, torques: Torques, after: Speeds, grade: float, dt_s: float, vehicle: VehicleParams) -> Moved:
    """The step to known speeds."""
    t, front, rear = torques, vehicle.front.wheel, vehicle.rear.wheel
    front_gained = front.inertia_kgm2 / dt_s * (after.front_radps - before.front_radps)
    rear_gained = rear.inertia_kgm2 / dt_s * (after.rear_radps - before.rear_radps)
    return Moved(
        after,
        (t.front_motor_nm - t.front_resisting_nm - front_gained) / front.radius_m,
        (t.rear_motor_nm - t.rear_resisting_nm - rear_gained) / rear.radius_m,
        t.front_resisting_nm,
        t.rear_resisting_nm,
        rolling_force_n(grade, vehicle.chassis),
    )


@kernel
def _turning(speeds: Speeds) -> bool:
    return speeds.car_mps > 0.0 and speeds.front_radps > 0.0 and speeds.rear_radps > 0.0


@kernel
def step_from(
    before: Speeds,
    torques: Torques,
    guess: Speeds,
    friction: float,
    curves: tuple[Curve, Curve],
    dt_s: float,
    vehicle: VehicleParams,
) -> Moved:
    """Advance car and wheels by one implicit step on a level road.

    Parameters
    ----------
    before : >= 0
    guess : speeds at the end of the step, > 0, as near as may be
    curves : `curve_of` the front and the rear tyre, or `UNSURE`
    """
    both = (friction, friction)
    if curves[0].fall > -math.inf and _turning(guess):
        found = _newton(before, torques, guess, 0.0, both, dt_s, vehicle)
        front_rate = vehicle.front.wheel.inertia_kgm2 / dt_s
        rear_rate = vehicle.rear.wheel.inertia_kgm2 / dt_s
        car = found.speeds.car_mps
        if (
            found.found
            and _only_one(car, found.front_n, found.front_force_n, curves[0], front_rate, vehicle.front)
            and _only_one(car, found.rear_n, found.rear_force_n, curves[1], rear_rate, vehicle.rear)
        ):
            return _moved(before, torques, found.speeds, 0.0, dt_s, vehicle)
    return step(before, torques, (guess.car_mps - before.car_mps) / dt_s, 0.0, both, dt_s, vehicle)


@kernel
def step_onward(
    before: Speeds,
    torques: Torques,
    acceleration_mps2: float,
    grade: float,
    friction: Two,
    dt_s: float,
    vehicle: VehicleParams,
) -> Moved:
    """Advance car and wheels by one implicit step, as a car moves on.

    Tyres that are below their peak and stay there have one solution: the one that the motion leads to.

    Parameters
    ----------
    before : >= 0
    acceleration_mps2 : of the previous step; only a first guess
    grade : rise over run
    friction : peak friction coefficient under the front and the rear wheels
    """
    gained = acceleration_mps2 * dt_s
    guess = Speeds(
        before.car_mps + gained,
        before.front_radps + gained / vehicle.front.wheel.radius_m,
        before.rear_radps + gained / vehicle.rear.wheel.radius_m,
    )
    if _turning(guess):
        found = _newton(before, torques, guess, grade, friction, dt_s, vehicle)
        if found.found and found.rising:
            return _moved(before, torques, found.speeds, grade, dt_s, vehicle)
    return step(before, torques, (guess.car_mps - before.car_mps) / dt_s, grade, friction, dt_s, vehicle)
