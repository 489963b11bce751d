# SPDX-License-Identifier: Apache-2.0
"""The two wheels of an axle in one step: its yaw budget, and what each of them is given of the axle's power.

Wheels that are alike in all that is known of them are worked out once.
"""

from __future__ import annotations

from typing import NamedTuple

from iwm_power_manager.control.direction import MOVING_MPS
from iwm_power_manager.control.one_road import UNEQUAL_PART
from iwm_power_manager.control.settings import GATE_MODE_TABLE2, Settings
from iwm_power_manager.control.slew import slewed
from iwm_power_manager.control.slip import LEAST_SLIP_SPEED_MPS, worse_slip
from iwm_power_manager.control.types import (
    LIMIT_FRICTION_BRAKE,
    LIMIT_MOTOR,
    LIMIT_REGENERATION,
    LIMIT_SLEW,
    LIMIT_SLIP,
    LIMIT_THERMAL,
    FourWheels,
    Measurement,
    Wheels,
    WheelState,
)
from iwm_power_manager.control.wheel import Wheel, capacity_nm, wheel_of
from iwm_power_manager.jit import kernel
from iwm_power_manager.model.motor import regeneration_limit_nm, torque_limit_nm
from iwm_power_manager.model.parameters import Axle, VehicleParams
from iwm_power_manager.model.torque import between_wheels, blend

#: A motor torque below this is rounding noise of a share or a fade; zero lets the drive go idle.
ZERO_TORQUE_NM = 1e-6
#: Torques that have been unequal for longer than this are no passing bump, s.
UNEQUAL_S = 0.03
#: The yaw budget grows with one over the square of the speed, up to the square of this.
MOST_YAW_SPEED = 2.0
#: Slip of the front wheel that grips, and of the rear ones, where the yaw rate is watched.
WATCHED_SLIP = 0.1
WATCHED_REAR_SLIP = 0.06
#: Slip of a driven front wheel beside one that has less of its motor, at `yaw_speed_mps`: what a driver hardly feels.
BESIDE_WEAK_SLIP = 0.01


class Given(NamedTuple):
    """What a wheel is given: motor and friction torque, before slew and battery, and the sum asked of both."""

    total_nm: float
    motor_nm: float
    slewed_nm: float
    friction_nm: float


class Pair(NamedTuple):
    """The two wheels of an axle in one step, and what its yaw budget leaves each, N m.

    Wheels that are `alike` in all that is known of them need to be worked out once.
    """

    left: Wheel
    right: Wheel
    left_capacity_nm: float
    right_capacity_nm: float
    alike: bool


class Shared(NamedTuple):
    """What an axle's wheels are given, and the torques that were meant, N m >= 0."""

    left: Given
    right: Given
    left_nm: float
    right_nm: float


@kernel
def _capacities_nm(left: Wheel, right: Wheel, moments_nm: tuple[float, float], axle: Axle) -> tuple[float, float]:
    """Capacity of an axle's two wheels within its yaw budget: the moments that more torque left, and right, may have.

    The moment of a difference of torques T is T / radius * track / 2.
    """
    left_capacity, right_capacity = capacity_nm(left), capacity_nm(right)
    per_moment = 2.0 * axle.wheel.radius_m / axle.track_width_m
    left_more, right_more = per_moment * moments_nm[0], per_moment * moments_nm[1]
    return min(left_capacity, right_capacity + left_more), min(right_capacity, left_capacity + right_more)


@kernel
def unequal_s(before_s: float, left: Wheel, right: Wheel, wanted: bool, dt_s: float) -> float:
    """How long an axle has braked unequally, or would have without a yaw budget: > 0 more left, < 0 more right.

    What was steered for one side is nothing for the other: the time goes back through zero; at once where one wheel
    stands in for the other, which is not believed: there may have been no difference at all.
    """
    left_capacity, right_capacity = capacity_nm(left), capacity_nm(right)
    if wanted and abs(left_capacity - right_capacity) > UNEQUAL_PART * max(left_capacity, right_capacity):
        return before_s + dt_s if left_capacity > right_capacity else before_s - dt_s
    left_over = 0.0 if left.speed_radps == right.speed_radps else max(abs(before_s) - dt_s, 0.0)
    return left_over if before_s > 0.0 else -left_over


@kernel
def _driven_slip_targets(speed_mps: float, slips: Wheels, motor_gain: Wheels, settings: Settings) -> Wheels:
    """Slip the limiter holds each driven wheel at: `slip_target`, unless a motor gives less than it should.

    The front wheel whose motor gives more than the other's slips no more than that one: so what turns the car is little
    on a road that has little to hold it with, and all that the motor has on a good one. The rear wheels slip no more
    than the front ones, or they would have nothing to hold it with. What they may slip all the same goes with one over
    the square of the speed, as yaw budgets do; at the rear at low speed with one over the speed, as where they brake.
    """
    most = settings.slip_target
    front_left, front_right = motor_gain[0], motor_gain[1]
    left = right = rear = most
    part = settings.yaw_speed_mps / max(speed_mps, MOVING_MPS)
    if front_left != front_right:
        weaker = slips[1] if front_left > front_right else slips[0]
        beside = min(most, max(part * part * BESIDE_WEAK_SLIP, weaker))
        left, right = (beside, most) if front_left > front_right else (most, beside)
    if min(motor_gain) < 1.0 and min(slips[2], slips[3]) * speed_mps > LEAST_SLIP_SPEED_MPS:
        least = min(part, part * part) * settings.unequal_rear_slip_target
        rear = min(most, max(least, min(slips[0], slips[1])))
    return left, right, rear, rear


@kernel
def slip_targets(
    unequal_s: float,
    speed_mps: float,
    braking: bool,
    watched: bool,
    slips: Wheels,
    front_first: bool,
    motor_gain: Wheels,
    settings: Settings,
) -> Wheels:
    """Slip the limiter holds each wheel at.

    Unequal torques of the front wheels have to be steered against, with the front wheel that grips; and they turn the
    car, which the rear wheels keep straight: both need to keep something of their grip for that; less of it where the
    yaw rate is `watched`.

    Where braked rear wheels use more of their grip than the front ones, what has turned the car, a bump or a motor that
    does not obey, turns it on, the faster the more they slip and the car goes. So above a slip that goes with one over
    the speed they slip no more than the front ones; and at the limit of the road all wheels give what they can. Left
    alone are slow cars, a rear axle of which a wheel rolls, torques that have just become unequal (a bump or two
    roads), and where the front wheels do not come first: their brakes are another system's or weak, and may not take
    over, or the driver asks for more than gentle braking.
    """
    most = settings.slip_target
    if not braking:
        return _driven_slip_targets(speed_mps, slips, motor_gain, settings)
    if abs(unequal_s) <= UNEQUAL_S:
        part = max(settings.yaw_speed_mps / max(speed_mps, MOVING_MPS), 1.0)
        slipping = -max(slips[2], slips[3]) * speed_mps > LEAST_SLIP_SPEED_MPS
        behind = most
        if front_first and slipping and unequal_s == 0.0 and part < MOST_YAW_SPEED:
            behind = min(most, max(part * settings.unequal_rear_slip_target, -max(slips[0], slips[1])))
        return (most, most, behind, behind)
    high = min(most, max(settings.unequal_slip_target, WATCHED_SLIP if watched else 0.0))
    low = min(most, settings.unequal_low_slip_target)
    rear = min(most, max(settings.unequal_rear_slip_target, WATCHED_REAR_SLIP if watched else 0.0))
    return (high, low, rear, rear) if unequal_s > 0.0 else (low, high, rear, rear)


@kernel
def speed_part(speed_mps: float, settings: Settings) -> float:
    """Part of a yaw budget at a speed: how far a moment takes the car aside goes with the square of the speed."""
    part = min(settings.yaw_speed_mps / max(speed_mps, MOVING_MPS), MOST_YAW_SPEED)
    return part * part


@kernel
def yaw_moments_nm(
    now_nm: float,
    growth_nmps: float,
    most_nm: float,
    unequal_s: float,
    speed_mps: float,
    braking: bool,
    settings: Settings,
) -> tuple[float, float]:
    """Yaw moments that more torque left, and more torque right, may have.

    Motors pull far less than brakes, and most at low speed: driving, all of it is there at once.
    """
    if not braking:
        return most_nm, most_nm
    part = speed_part(speed_mps, settings)
    now, growth = part * now_nm, part * growth_nmps
    return min(now + growth * max(unequal_s, 0.0), most_nm), min(now + growth * max(-unequal_s, 0.0), most_nm)


@kernel
def alike_wheels(k: int, measurement: Measurement, before: FourWheels, targets: Wheels) -> bool:
    """Whether the wheels `k` and `k + 1` have all in common, so that what is worked out for one holds for both."""
    m = measurement
    w, gain, stuck = m.wheel_speed_radps, m.motor_gain, m.motor_stuck_nm
    same = w[k] == w[k + 1] and gain[k] == gain[k + 1] and stuck[k] == stuck[k + 1]
    return same and before[k] == before[k + 1] and targets[k] == targets[k + 1]


@kernel
def pair_of(
    k: int,
    measurement: Measurement,
    slips: Wheels,
    speed_mps: float,
    lower_part: float,
    targets: Wheels,
    least_nm: Wheels,
    moments_nm: tuple[float, float],
    first: bool,
    before: FourWheels,
    alike: bool,
    axle: Axle,
    settings: Settings,
    vehicle: VehicleParams,
) -> Pair:
    """Steps 3 and 4 for the axle whose wheels are `k` and `k + 1`."""
    m = measurement
    w, gain, demand, dt = m.wheel_speed_radps, m.motor_gain, m.power_demand_w, m.dt_s
    left_gate, right_gate = slips[k], slips[k + 1]
    if settings.gate_mode == GATE_MODE_TABLE2:
        left_gate = right_gate = worse_slip(slips[k], slips[k + 1])
    left = wheel_of(
        w[k], slips[k], left_gate, speed_mps, demand, gain[k], m.motor_stuck_nm[k], lower_part, targets[k],
        least_nm[k], dt, first, before[k], w[k + 1], before[k + 1], axle, settings, vehicle,
    )  # fmt: skip
    right = left
    if not alike:
        right = wheel_of(
            w[k + 1], slips[k + 1], right_gate, speed_mps, demand, gain[k + 1], m.motor_stuck_nm[k + 1], lower_part,
            targets[k + 1], least_nm[k + 1], dt, first, before[k + 1], w[k], before[k], axle, settings, vehicle,
        )  # fmt: skip
    left_capacity, right_capacity = _capacities_nm(left, right, moments_nm, axle)
    return Pair(left, right, left_capacity, right_capacity, alike)


@kernel
def pair_capacity_w(pair: Pair) -> float:
    """Largest power of an axle, W >= 0."""
    return pair.left.conversion_radps * pair.left_capacity_nm + pair.right.conversion_radps * pair.right_capacity_nm


@kernel
def _commanded_nm(torque_nm: float, gain: float) -> float:
    """Torque to command so that `torque_nm` arrives."""
    return torque_nm / gain if gain > 0.0 else 0.0


@kernel
def _given(
    total_nm: float,
    wheel: Wheel,
    speed_mps: float,
    braking: bool,
    dt_s: float,
    before: WheelState,
    settings: Settings,
    axle: Axle,
) -> Given:
    """Steps 5 and 6 for one wheel. A weak motor is commanded more than it is to deliver, within the same limits."""
    motor, friction = blend(total_nm, wheel.fast_radps, speed_mps, before.heat, wheel.gain, axle.motor)
    motor = _commanded_nm(motor, wheel.gain)
    torque = slewed(
        before.motor_nm,
        motor,
        dt_s,
        settings.slew_up_nmps,
        settings.slew_down_nmps,
        settings.slew_regeneration_nmps,
    )
    # A gate or a limit cuts at once.
    if wheel.gated or wheel.gain == 0.0:
        torque = 0.0
    else:
        grip = wheel.grip_nm / wheel.gain
        most = torque_limit_nm(wheel.fast_radps, before.heat, axle.motor)
        least = regeneration_limit_nm(wheel.fast_radps, speed_mps, before.heat, axle.motor)
        if braking:
            least = min(least, grip)
        else:
            most = min(most, grip)
        torque = min(max(torque, -least), most)
        if abs(torque) <= ZERO_TORQUE_NM:
            torque = 0.0
    return Given(total_nm=total_nm, motor_nm=motor, slewed_nm=torque, friction_nm=friction)


@kernel
def shared_of(
    given_w: float,
    pair: Pair,
    speed_mps: float,
    braking: bool,
    dt_s: float,
    left_before: WheelState,
    right_before: WheelState,
    settings: Settings,
    axle: Axle,
) -> Shared:
    """Steps 5 and 6 for an axle."""
    sign = -1.0 if braking else 1.0
    left_nm, right_nm = between_wheels(
        given_w, pair.left.conversion_radps, pair.right.conversion_radps, pair.left_capacity_nm, pair.right_capacity_nm
    )
    left = _given(sign * left_nm, pair.left, speed_mps, braking, dt_s, left_before, settings, axle)
    right = left
    if not pair.alike:
        right = _given(sign * right_nm, pair.right, speed_mps, braking, dt_s, right_before, settings, axle)
    return Shared(left, right, left_nm, right_nm)


@kernel
def _limits(wheel: Wheel, given: Given, short: bool, braking: bool, axle: Axle) -> int:
    """Bits of what kept one wheel from its part of the demand; `short`: it has less of it than it should have."""
    bits = 0
    if not wheel.gated and short:
        if wheel.grip_nm < wheel.actuator_nm:
            bits |= LIMIT_SLIP
        elif braking:
            bits |= LIMIT_FRICTION_BRAKE if axle.friction_brake.max_torque_nm > 0.0 else LIMIT_REGENERATION
        else:
            bits |= LIMIT_MOTOR
            if wheel.actuator_nm < torque_limit_nm(wheel.fast_radps, 0.0, axle.motor):
                bits |= LIMIT_THERMAL
    if given.friction_nm < 0.0:
        bits |= LIMIT_REGENERATION
    if abs(given.slewed_nm - given.motor_nm) > ZERO_TORQUE_NM:
        bits |= LIMIT_SLEW
    return bits


@kernel
def pair_limits(pair: Pair, shared: Shared, short: bool, braking: bool, axle: Axle) -> int:
    """Bits of what kept the wheels of an axle from their parts of the demand."""
    left = _limits(pair.left, shared.left, short or shared.left_nm < shared.right_nm, braking, axle)
    return left | _limits(pair.right, shared.right, short or shared.right_nm < shared.left_nm, braking, axle)


@kernel
def friction_nm(given: Given, wheel: Wheel, delivered_nm: float, braking: bool, axle: Axle) -> float:
    """Friction torque that makes up, with what the motor delivers, the torque asked for.

    A motor that is still on its way down from driving, or stuck, is held against: braking gets through at once. One
    that is stuck is held against while driving, too, to what it is to drive by.
    """
    if wheel.gated or not (braking or wheel.held):
        return given.friction_nm
    return max(min(given.total_nm - delivered_nm, 0.0), -axle.friction_brake.max_torque_nm)
