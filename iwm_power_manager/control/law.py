# SPDX-License-Identifier: Apache-2.0
"""The control law: one step from a measurement to a command.

The order, which is also the order of precedence from weak to strong:

0. motion: speed and direction, and which sensor is not believed (`control.motion`); all that follows is reckoned in the
   direction of travel, so that brakes brake and slip is slip backwards too;
1. slip of each wheel, filtered (eq. 10), and the torque the road took from it (eq. 11);
2. split: the strategy decides the front share, many times a second; the applied share follows at a limited rate;
3. skid gate: a wheel beyond the critical slip (Table 2 as printed: its axle) gets nothing, the others what they can;
4. capacity: what motors (peak, heat, power; eq. 19, 40), brakes (regeneration, where there are none), the slip limiter
   and the axle's yaw budget let each wheel give; what does not fit on one goes to the axle's other wheel and to the
   other axle (eq. 12);
5. power becomes torque (eq. 16-18); regeneration up to its limit, friction the rest (eq. 20, 41, 42);
6. slew limits on the motors; while a regenerative torque grows, friction fills in, so that braking always gets through;
7. battery limits on the motors (eq. 24, 43); friction takes over what cannot be regenerated.

8. hold: where the car rolls against the direction asked for, friction holds it until the motors do.

Steps 3 to 5 and 7 only ever make a motor torque smaller at once: no rate limit holds back a gate or a limit.
Wheels come one by one, in the order front left, front right, rear left, rear right; each with the numbers of its axle.
"""

from __future__ import annotations

from typing import NamedTuple

from iwm_power_manager.control.friction import estimate as friction_estimate
from iwm_power_manager.control.motion import Motion, estimate
from iwm_power_manager.control.settings import GATE_MODE_LIMITER, GATE_MODE_OFF, GATE_MODE_TABLE2, Settings
from iwm_power_manager.control.slew import slewed
from iwm_power_manager.control.slip import (
    UNLIMITED_NM,
    filtered,
    gained_radps,
    limiter_torque_nm,
    road_torque_nm,
    worse_slip,
)
from iwm_power_manager.control.split import split
from iwm_power_manager.control.table import PolicyTable
from iwm_power_manager.control.types import (
    LIMIT_BATTERY_CHARGE,
    LIMIT_BATTERY_DISCHARGE,
    LIMIT_FRICTION_BRAKE,
    LIMIT_MOTOR,
    LIMIT_REGENERATION,
    LIMIT_SLEW,
    LIMIT_SLIP,
    LIMIT_THERMAL,
    Command,
    ControllerState,
    FourWheels,
    FrictionState,
    Measurement,
    MotionState,
    SplitMemory,
    Wheels,
    WheelState,
)
from iwm_power_manager.jit import kernel
from iwm_power_manager.model.chassis import GRAVITY_MPS2
from iwm_power_manager.model.gate import axle_gated, gated_split
from iwm_power_manager.model.limits import wheels_power_w, wheels_scale
from iwm_power_manager.model.motor import heat_after, regeneration_limit_nm, torque_limit_nm
from iwm_power_manager.model.parameters import Axle, VehicleParams
from iwm_power_manager.model.torque import allocate, between_wheels, blend, conversion_speed_radps
from iwm_power_manager.model.tyre import slip_ratio

#: A motor torque below this is rounding noise of a share or a fade; zero lets the drive go idle.
ZERO_TORQUE_NM = 1e-6

#: Part of the demand that sums and differences of powers may lose without a limit having bitten.
ROUNDING = 1e-12


#: Speed of a braked wheel as part of the car's that is still believed when power becomes torque.
FASTEST_BRAKED = 1.12

#: Torques that have been unequal for longer than this are no passing bump, s; and roads whose wheels can take torques
#: that are less than this part apart are no two roads.
UNEQUAL_S = 0.03
UNEQUAL_PART = 0.2
#: The yaw budget grows with one over the square of the speed, up to the square of this.
MOST_YAW_SPEED = 2.0

#: Below this speed, m/s, the car counts as standing: it is what wheels and car must both exceed to be rolling.
MOVING_MPS = 0.06
#: The hold: slope it is made for; speed beyond which it is no longer a matter of holding, m/s; change of the torque of
#: two motors that counts as none, N m a step; time in which it then fades, s.
HOLD_GRADE = 0.25
HOLD_BELOW_MPS = 1.5
HOLD_STEADY_NM = 1.0
HOLD_FADE_S = 0.4
#: Drive torque fades over this much speed below the fastest reverse, m/s.
REVERSE_FADE_MPS = 1.0


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
    actuator_nm: float
    gain: float
    grip_nm: float


class Given(NamedTuple):
    """What a wheel is given: motor and friction torque, before slew and battery, and the sum asked of both."""

    total_nm: float
    motor_nm: float
    slewed_nm: float
    friction_nm: float


@kernel
def _slip(
    wheel_speed_radps: float,
    speed_mps: float,
    dt_s: float,
    first: bool,
    before: WheelState,
    axle: Axle,
    settings: Settings,
) -> float:
    measured = slip_ratio(wheel_speed_radps, speed_mps, axle.wheel.radius_m, settings.slip_speed_floor_mps)
    return filtered(before.slip, measured, dt_s, 0.0 if first else settings.slip_filter_s)


@kernel
def _wheel(
    wheel_speed_radps: float,
    slip: float,
    gate_slip: float,
    speed_mps: float,
    demand_w: float,
    gain: float,
    lower_part: float,
    gate_mode: int,
    slip_target: float,
    dt_s: float,
    first: bool,
    before: WheelState,
    other_radps: float,
    other_before: WheelState,
    axle: Axle,
    settings: Settings,
    vehicle: VehicleParams,
) -> Wheel:
    """Steps 1, 3 and 4 for one wheel; `gate_slip` is the slip its gate goes by, `other` the axle's other wheel."""
    braking = demand_w < 0.0
    radius = axle.wheel.radius_m
    # A braked wheel is not faster than the car: one that seems to be must not weaken the brakes.
    turning = min(wheel_speed_radps, FASTEST_BRAKED * speed_mps / radius) if braking else wheel_speed_radps
    conversion = conversion_speed_radps(
        turning, speed_mps, settings.critical_slip, radius, vehicle.driver.power_speed_floor_mps
    )
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
    if gate_mode != GATE_MODE_OFF and not (braking and speed_mps < settings.slip_speed_floor_mps):
        gated = axle_gated(
            gate_slip, demand_w, before.gated, settings.critical_slip, settings.gate_hysteresis, settings.gate_driving
        )
    grip = UNLIMITED_NM
    if gate_mode == GATE_MODE_LIMITER:
        grip = limiter_torque_nm(
            braking,
            road,
            wheel_speed_radps,
            speed_mps,
            slip_target,
            settings.slip_limiter_s,
            settings.slip_speed_floor_mps,
            radius,
            axle.wheel.inertia_kgm2,
        )
    return Wheel(
        speed_radps=wheel_speed_radps,
        conversion_radps=conversion,
        fast_radps=fast,
        road_nm=road,
        slip=slip,
        gated=gated,
        actuator_nm=max(
            axle.friction_brake.max_torque_nm, gain * regeneration_limit_nm(fast, speed_mps, before.heat, axle.motor)
        )
        if braking
        else gain * torque_limit_nm(fast, before.heat, axle.motor),
        gain=gain,
        grip_nm=grip,
    )


@kernel
def _capacity_nm(wheel: Wheel) -> float:
    return 0.0 if wheel.gated else min(wheel.actuator_nm, wheel.grip_nm)


@kernel
def _capacities_nm(left: Wheel, right: Wheel, moments_nm: tuple[float, float], axle: Axle) -> tuple[float, float]:
    """Capacity of an axle's two wheels within its yaw budget: the moments that more torque left, and right, may have.

    The moment of a difference of torques T is T / radius * track / 2.
    """
    left_capacity, right_capacity = _capacity_nm(left), _capacity_nm(right)
    per_moment = 2.0 * axle.wheel.radius_m / axle.track_width_m
    left_more, right_more = per_moment * moments_nm[0], per_moment * moments_nm[1]
    return min(left_capacity, right_capacity + left_more), min(right_capacity, left_capacity + right_more)


@kernel
def _unequal_s(before_s: float, left: Wheel, right: Wheel, wanted: bool, dt_s: float) -> float:
    """How long an axle has braked unequally, or would have without a yaw budget: > 0 more left, < 0 more right.

    What was steered for one side is nothing for the other: the time goes back through zero.
    """
    left_capacity, right_capacity = _capacity_nm(left), _capacity_nm(right)
    if wanted and abs(left_capacity - right_capacity) > UNEQUAL_PART * max(left_capacity, right_capacity):
        return before_s + dt_s if left_capacity > right_capacity else before_s - dt_s
    left_over = max(abs(before_s) - dt_s, 0.0)
    return left_over if before_s > 0.0 else -left_over


@kernel
def _slip_targets(unequal_s: float, braking: bool, settings: Settings) -> Wheels:
    """Slip the limiter holds each wheel at.

    Unequal torques of the front wheels have to be steered against, with the front wheel that grips; and they turn the
    car, which the rear wheels keep straight: both need to keep something of their grip for that.
    """
    most = settings.slip_target
    if not braking or abs(unequal_s) <= UNEQUAL_S:
        return (most, most, most, most)
    high = min(most, settings.unequal_slip_target)
    low = min(most, settings.unequal_low_slip_target)
    rear = min(most, settings.unequal_rear_slip_target)
    return (high, low, rear, rear) if unequal_s > 0.0 else (low, high, rear, rear)


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
def _friction_nm(given: Given, gated: bool, delivered_nm: float, braking: bool, axle: Axle) -> float:
    """Friction torque that makes up, with what the motor delivers, the braking torque asked for.

    A motor that is still on its way down from driving, or stuck, is held against: braking gets through at once.
    """
    if not braking or gated:
        return given.friction_nm
    return max(min(given.total_nm - delivered_nm, 0.0), -axle.friction_brake.max_torque_nm)


@kernel
def _after(wheel: Wheel, motor_nm: float, total_nm: float, before: WheelState, dt_s: float, axle: Axle) -> WheelState:
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
def _yaw_moments_nm(
    now_nm: float,
    growth_nmps: float,
    most_nm: float,
    unequal_s: float,
    speed_mps: float,
    braking: bool,
    settings: Settings,
) -> tuple[float, float]:
    """Yaw moments that more torque left, and more torque right, may have.

    How far a moment takes the car aside until it is steered against goes with the square of the speed. Motors pull far
    less than brakes, and most at low speed: driving, all of it is there at once.
    """
    if not braking:
        return most_nm, most_nm
    part = min(settings.yaw_speed_mps / max(speed_mps, MOVING_MPS), MOST_YAW_SPEED)
    now, growth = part * part * now_nm, part * part * growth_nmps
    return min(now + growth * max(unequal_s, 0.0), most_nm), min(now + growth * max(-unequal_s, 0.0), most_nm)


@kernel
def _alike(k: int, measurement: Measurement, before: FourWheels, targets: Wheels) -> bool:
    """Whether the wheels `k` and `k + 1` have all in common, so that what is worked out for one holds for both."""
    m = measurement
    w, gain, stuck = m.wheel_speed_radps, m.motor_gain, m.motor_stuck_nm
    same = w[k] == w[k + 1] and gain[k] == gain[k + 1] and stuck[k] == stuck[k + 1]
    return same and before[k] == before[k + 1] and targets[k] == targets[k + 1]


@kernel
def _pair(
    k: int,
    measurement: Measurement,
    slips: Wheels,
    speed_mps: float,
    lower_part: float,
    gate_mode: int,
    targets: Wheels,
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
    if gate_mode == GATE_MODE_TABLE2:
        left_gate = right_gate = worse_slip(slips[k], slips[k + 1])
    left = _wheel(
        w[k], slips[k], left_gate, speed_mps, demand, gain[k], lower_part, gate_mode, targets[k], dt, first,
        before[k], w[k + 1], before[k + 1], axle, settings, vehicle,
    )  # fmt: skip
    right = left
    if not alike:
        right = _wheel(
            w[k + 1], slips[k + 1], right_gate, speed_mps, demand, gain[k + 1], lower_part, gate_mode, targets[k + 1],
            dt, first, before[k + 1], w[k], before[k], axle, settings, vehicle,
        )  # fmt: skip
    left_capacity, right_capacity = _capacities_nm(left, right, moments_nm, axle)
    return Pair(left, right, left_capacity, right_capacity, alike)


@kernel
def _pair_capacity_w(pair: Pair) -> float:
    return pair.left.conversion_radps * pair.left_capacity_nm + pair.right.conversion_radps * pair.right_capacity_nm


@kernel
def _shared(
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
def _pair_limits(pair: Pair, shared: Shared, short: bool, braking: bool, axle: Axle) -> int:
    left = _limits(pair.left, shared.left, short or shared.left_nm < shared.right_nm, braking, axle)
    return left | _limits(pair.right, shared.right, short or shared.right_nm < shared.left_nm, braking, axle)


@kernel
def _bits(front: Pair, rear: Pair) -> int:
    """Bits of the wheels that are gated."""
    front_bits = (1 if front.left.gated else 0) + (2 if front.right.gated else 0)
    return front_bits + (4 if rear.left.gated else 0) + (8 if rear.right.gated else 0)


@kernel
def drive(
    measurement: Measurement,
    state: ControllerState,
    slip_control: bool,
    lower_part: float,
    settings: Settings,
    vehicle: VehicleParams,
    policy: PolicyTable,
) -> tuple[Command, ControllerState]:
    """Steps 1 to 7, all in the direction of travel.

    Parameters
    ----------
    measurement : speeds that are believed
    state : of the step before
    slip_control : gate and slip limiter may act
    lower_part : a power that brakes is divided by this part of the speed (`motion.Motion`)
    """
    speed = max(measurement.speed_mps, 0.0)
    dt = measurement.dt_s
    braking = measurement.power_demand_w < 0.0
    first = state.steps == 0
    before = state.wheels

    s = settings
    front_s, rear_s = state.front_unequal_s, state.rear_unequal_s
    targets = _slip_targets(front_s, braking, s)
    front_alike = _alike(0, measurement, before, targets)
    rear_alike = _alike(2, measurement, before, targets)

    # 1. slip, wheel by wheel; an axle's is that of its worse wheel
    w = measurement.wheel_speed_radps
    fl_slip = _slip(w[0], speed, dt, first, before[0], vehicle.front, settings)
    fr_slip = fl_slip if front_alike else _slip(w[1], speed, dt, first, before[1], vehicle.front, settings)
    rl_slip = _slip(w[2], speed, dt, first, before[2], vehicle.rear, settings)
    rr_slip = rl_slip if rear_alike else _slip(w[3], speed, dt, first, before[3], vehicle.rear, settings)
    front_slip = worse_slip(fl_slip, fr_slip)
    rear_slip = worse_slip(rl_slip, rr_slip)

    # 2. split
    memory = split(measurement, speed, front_slip, rear_slip, first, state.split, settings, vehicle, policy)

    # 3. gate, 4. capacity
    mode = settings.gate_mode if slip_control else GATE_MODE_OFF
    slips = (fl_slip, fr_slip, rl_slip, rr_slip)
    front_nm = _yaw_moments_nm(s.front_yaw_nm, s.front_yaw_growth_nmps, s.front_yaw_most_nm, front_s, speed, braking, s)
    rear_nm = _yaw_moments_nm(s.rear_yaw_nm, s.rear_yaw_growth_nmps, s.rear_yaw_most_nm, rear_s, speed, braking, s)
    front = _pair(
        0, measurement, slips, speed, lower_part, mode, targets, front_nm, first, before, front_alike, vehicle.front, s,
        vehicle,
    )  # fmt: skip
    rear = _pair(
        2, measurement, slips, speed, lower_part, mode, targets, rear_nm, first, before, rear_alike, vehicle.rear, s,
        vehicle,
    )  # fmt: skip
    return _commanded(measurement, speed, front, rear, front_slip, rear_slip, memory, state, settings, vehicle)


@kernel
def _delivered_nm(motor_nm: Wheels, gain: Wheels, stuck_nm: Wheels) -> Wheels:
    """What arrives of the motors' torques."""
    return (
        gain[0] * motor_nm[0] + stuck_nm[0],
        gain[1] * motor_nm[1] + stuck_nm[1],
        gain[2] * motor_nm[2] + stuck_nm[2],
        gain[3] * motor_nm[3] + stuck_nm[3],
    )


@kernel
def _arrived_nm(delivered: Wheels, friction: Wheels, gain: Wheels) -> Wheels:
    """Torque of motor and brake at each wheel."""
    return (
        delivered[0] + gain[0] * friction[0],
        delivered[1] + gain[1] * friction[1],
        delivered[2] + gain[2] * friction[2],
        delivered[3] + gain[3] * friction[3],
    )


@kernel
def _frictions_nm(
    front: Pair, f: Shared, rear: Pair, r: Shared, delivered_nm: Wheels, braking: bool, vehicle: VehicleParams
) -> Wheels:
    """Friction torque of each wheel."""
    return (
        _friction_nm(f.left, front.left.gated, delivered_nm[0], braking, vehicle.front),
        _friction_nm(f.right, front.right.gated, delivered_nm[1], braking, vehicle.front),
        _friction_nm(r.left, rear.left.gated, delivered_nm[2], braking, vehicle.rear),
        _friction_nm(r.right, rear.right.gated, delivered_nm[3], braking, vehicle.rear),
    )


@kernel
def _wheels_after(
    front: Pair,
    rear: Pair,
    motor_nm: Wheels,
    total_nm: Wheels,
    before: FourWheels,
    dt_s: float,
    vehicle: VehicleParams,
) -> FourWheels:
    """What is remembered of the four wheels."""
    return (
        _after(front.left, motor_nm[0], total_nm[0], before[0], dt_s, vehicle.front),
        _after(front.right, motor_nm[1], total_nm[1], before[1], dt_s, vehicle.front),
        _after(rear.left, motor_nm[2], total_nm[2], before[2], dt_s, vehicle.rear),
        _after(rear.right, motor_nm[3], total_nm[3], before[3], dt_s, vehicle.rear),
    )


@kernel
def _commanded(
    measurement: Measurement,
    speed_mps: float,
    front: Pair,
    rear: Pair,
    front_slip: float,
    rear_slip: float,
    memory: SplitMemory,
    state: ControllerState,
    settings: Settings,
    vehicle: VehicleParams,
) -> tuple[Command, ControllerState]:
    """Steps 4 to 7: from the power each axle is asked for to the torques that are commanded."""
    demand, dt = measurement.power_demand_w, measurement.dt_s
    braking = demand < 0.0
    fl0, fr0, rl0, rr0 = state.wheels
    front_gated = front.left.gated and front.right.gated
    rear_gated = rear.left.gated and rear.right.gated
    front_power, rear_power = gated_split(demand, memory.applied_share, front_gated, rear_gated)
    front_asked, rear_asked = abs(front_power), abs(rear_power)
    front_given, rear_given = allocate(front_asked, rear_asked, _pair_capacity_w(front), _pair_capacity_w(rear))

    # 5. torque, 6. slew
    f = _shared(front_given, front, speed_mps, braking, dt, fl0, fr0, settings, vehicle.front)
    r = _shared(rear_given, rear, speed_mps, braking, dt, rl0, rr0, settings, vehicle.rear)
    tolerance = ROUNDING * abs(demand)
    # Where both axles together fall short, each of them is at its limit, whatever its own part was.
    short = front_asked + rear_asked - front_given - rear_given > tolerance
    front_short = short or front_asked - front_given > tolerance
    rear_short = short or rear_asked - rear_given > tolerance
    limits = _pair_limits(front, f, front_short, braking, vehicle.front)
    limits |= _pair_limits(rear, r, rear_short, braking, vehicle.rear)

    # 7. battery
    w = measurement.wheel_speed_radps
    wanted = (f.left.slewed_nm, f.right.slewed_nm, r.left.slewed_nm, r.right.slewed_nm)
    scale = wheels_scale(wanted, w, measurement.discharge_limit_w, measurement.charge_limit_w, vehicle)
    if scale < 1.0:
        power = wheels_power_w(wanted, w, 1.0, vehicle)
        limits |= LIMIT_BATTERY_CHARGE if power < 0.0 else LIMIT_BATTERY_DISCHARGE
    motor = (scale * wanted[0], scale * wanted[1], scale * wanted[2], scale * wanted[3])
    delivered = _delivered_nm(motor, measurement.motor_gain, measurement.motor_stuck_nm)
    friction = _frictions_nm(front, f, rear, r, delivered, braking, vehicle)
    fl_nm, fr_nm, rl_nm, rr_nm = _arrived_nm(delivered, friction, state.motion.brake_gain)
    gate = (1 if front_gated else 0) + (2 if rear_gated else 0)
    command = Command(
        motor_torque_nm=motor,
        friction_torque_nm=friction,
        brake_gain=state.motion.brake_gain,
        front_share=memory.applied_share,
        decided_share=memory.decided_share,
        gate=gate,
        limits=limits,
        front_power_w=front.left.conversion_radps * fl_nm + front.right.conversion_radps * fr_nm,
        rear_power_w=rear.left.conversion_radps * rl_nm + rear.right.conversion_radps * rr_nm,
        front_slip=front_slip,
        rear_slip=rear_slip,
        gated_wheels=_bits(front, rear),
        speed_mps=measurement.speed_mps,
        doubted=0,
        hold_nm=0.0,
        left_friction=0.0,
        right_friction=0.0,
        left_confidence=0.0,
        right_confidence=0.0,
    )
    front_apart = braking and (fl_nm != fr_nm or front_short)
    rear_apart = braking and (rl_nm != rr_nm or rear_short)
    after = ControllerState(
        steps=state.steps + 1,
        split=memory,
        wheels=_wheels_after(front, rear, motor, (fl_nm, fr_nm, rl_nm, rr_nm), state.wheels, dt, vehicle),
        front_unequal_s=_unequal_s(state.front_unequal_s, front.left, front.right, front_apart, dt),
        rear_unequal_s=_unequal_s(state.rear_unequal_s, rear.left, rear.right, rear_apart, dt),
        motion=state.motion,
        travel=state.travel,
        hold_nm=state.hold_nm,
        friction=state.friction,
    )
    return command, after


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
def _travel(speed_mps: float, demand_w: float, direction: float, before: float) -> float:
    """Direction everything is reckoned in: driving, the one asked for; braking, the one the car moves in."""
    if demand_w >= 0.0:
        return direction
    if abs(speed_mps) < MOVING_MPS:
        return before
    return 1.0 if speed_mps > 0.0 else -1.0


@kernel
def _hold_nm(
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
def _held_nm(hold_nm: float, gated: bool, axle: Axle) -> float:
    """Friction torque that holds a wheel; nobody brakes meanwhile, so there is no other."""
    return 0.0 if gated else -min(hold_nm, axle.friction_brake.max_torque_nm)


@kernel
def _turned_to(state: ControllerState, motion: MotionState, travel: float) -> ControllerState:
    """What is remembered, in the direction of travel of this step, with what is known of the motion now."""
    a, b, c, d = state.wheels
    if travel != state.travel:
        a, b, c, d = _turned(a), _turned(b), _turned(c), _turned(d)
    return ControllerState(
        steps=state.steps,
        split=state.split,
        wheels=(a, b, c, d),
        front_unequal_s=state.front_unequal_s,
        rear_unequal_s=state.rear_unequal_s,
        motion=motion,
        travel=travel,
        hold_nm=state.hold_nm,
        friction=state.friction,
    )


@kernel
def _believed(measurement: Measurement, motion: Motion, travel: float, settings: Settings) -> Measurement:
    """What is believed of a measurement, in the direction of travel; backwards, the car is driven no faster than so."""
    m = measurement
    demand = m.power_demand_w
    if demand > 0.0 and m.direction < 0.0:
        over = (settings.reverse_speed_mps + motion.speed_mps) / REVERSE_FADE_MPS
        demand *= min(max(over, 0.0), 1.0)
    w = motion.wheel_speed_radps
    stuck = m.motor_stuck_nm
    return Measurement(
        travel * motion.speed_mps,
        (travel * w[0], travel * w[1], travel * w[2], travel * w[3]),
        demand,
        m.dt_s,
        m.friction,
        m.discharge_limit_w,
        m.charge_limit_w,
        m.soc,
        m.motor_gain,
        m.direction,
        (travel * stuck[0], travel * stuck[1], travel * stuck[2], travel * stuck[3]),
        m.acceleration_mps2,
    )


@kernel
def _answered(
    made: Command, friction_nm: Wheels, travel: float, motion: Motion, hold_nm: float, grip: FrictionState
) -> Command:
    """The command in the direction of the car, with what is known beside the torques."""
    motor = made.motor_torque_nm
    return Command(
        motor_torque_nm=(travel * motor[0], travel * motor[1], travel * motor[2], travel * motor[3]),
        friction_torque_nm=friction_nm,
        brake_gain=made.brake_gain,
        front_share=made.front_share,
        decided_share=made.decided_share,
        gate=made.gate,
        limits=made.limits,
        front_power_w=made.front_power_w,
        rear_power_w=made.rear_power_w,
        front_slip=made.front_slip,
        rear_slip=made.rear_slip,
        gated_wheels=made.gated_wheels,
        speed_mps=motion.speed_mps,
        doubted=motion.doubted,
        hold_nm=hold_nm,
        left_friction=grip.left.friction,
        right_friction=grip.right.friction,
        left_confidence=grip.left.confidence,
        right_confidence=grip.right.confidence,
    )


@kernel
def step(
    measurement: Measurement,
    state: ControllerState,
    settings: Settings,
    vehicle: VehicleParams,
    policy: PolicyTable,
) -> tuple[Command, ControllerState]:
    """One control step.

    Parameters
    ----------
    measurement : checked inputs; every number finite, but for a vehicle speed that is not known
    state : what the previous step returned, or `initial_state()`

    Returns
    -------
    Command, ControllerState
    """
    m = measurement
    motion, motion_after = estimate(m, state.motion, state.wheels, state.travel, state.steps == 0, vehicle)
    travel = _travel(motion.speed_mps, m.power_demand_w, m.direction, state.travel)
    before = _turned_to(state, motion_after, travel)
    believed = _believed(m, motion, travel, settings)
    grip = friction_estimate(
        state.friction,
        before.wheels,
        believed.wheel_speed_radps,
        believed.speed_mps,
        motion.doubted == 0,
        state.steps == 0,
        m.dt_s,
        settings,
        vehicle,
    )
    demand = believed.power_demand_w
    # A car that rolls back is to be stopped, whatever its wheels do.
    slip_control = travel == m.direction or demand >= 0.0
    made, after = drive(believed, before, slip_control, motion.lower_part, settings, vehicle, policy)
    e, f, g, h = after.wheels
    motor = made.motor_torque_nm
    friction = made.friction_torque_nm
    a, b, c, d = before.wheels
    # Of a front and a rear wheel, as the mean of both sides.
    motor_before = 0.5 * (a.motor_nm + b.motor_nm + c.motor_nm + d.motor_nm)
    motor_now = 0.5 * (motor[0] + motor[1] + motor[2] + motor[3])
    hold = _hold_nm(state.hold_nm, motion, m, motor_now, motor_before, vehicle)
    if hold > 0.0 and demand >= 0.0:
        friction = (
            _held_nm(hold, e.gated, vehicle.front),
            _held_nm(hold, f.gated, vehicle.front),
            _held_nm(hold, g.gated, vehicle.rear),
            _held_nm(hold, h.gated, vehicle.rear),
        )
    final = ControllerState(
        steps=after.steps,
        split=after.split,
        wheels=after.wheels,
        front_unequal_s=after.front_unequal_s,
        rear_unequal_s=after.rear_unequal_s,
        motion=motion_after,
        travel=travel,
        hold_nm=hold,
        friction=grip,
    )
    return _answered(made, friction, travel, motion, hold, grip), final
