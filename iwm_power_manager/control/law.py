"""The control law: one step from a measurement to a command.

The order, which is also the order of precedence from weak to strong:

1. slip of each wheel, filtered (eq. 10), and the torque the road took from it (eq. 11);
2. split: the strategy decides the front share, many times a second; the applied share follows at a limited rate;
3. skid gate: a wheel beyond the critical slip (Table 2 as printed: its axle) gets nothing, the others what they can;
4. capacity: what motors (peak, heat, power; eq. 19, 40), brakes, the slip limiter and the axle's yaw budget let each
   wheel give; what does not fit on one goes to the axle's other wheel and to the other axle (eq. 12);
5. power becomes torque (eq. 16-18); regeneration up to its limit, friction the rest (eq. 20, 41, 42);
6. slew limits on the motors; while a regenerative torque grows, friction fills in, so that braking always gets through;
7. battery limits on the motors (eq. 24, 43); friction takes over what cannot be regenerated.

Steps 3 to 5 and 7 only ever make a motor torque smaller at once: no rate limit holds back a gate or a limit.
Wheels come one by one, in the order front left, front right, rear left, rear right; each with the numbers of its axle.
"""

from __future__ import annotations

from typing import NamedTuple

from iwm_power_manager.control.settings import GATE_MODE_LIMITER, GATE_MODE_OFF, GATE_MODE_TABLE2, Settings
from iwm_power_manager.control.slew import slewed
from iwm_power_manager.control.slip import UNLIMITED_NM, filtered, road_torque_nm, torque_room_nm, worse_slip
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
    Measurement,
    WheelState,
)
from iwm_power_manager.jit import kernel
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
    dt_s: float,
    first: bool,
    before: WheelState,
    axle: Axle,
    settings: Settings,
    vehicle: VehicleParams,
) -> Wheel:
    """Steps 1, 3 and 4 for one wheel; `gate_slip` is the slip its gate goes by."""
    braking = demand_w < 0.0
    radius = axle.wheel.radius_m
    conversion = conversion_speed_radps(
        wheel_speed_radps, speed_mps, settings.critical_slip, radius, vehicle.driver.power_speed_floor_mps
    )
    fast = max(wheel_speed_radps, conversion)
    road = 0.0
    if not first:
        taken = road_torque_nm(before.total_nm, before.speed_radps, wheel_speed_radps, dt_s, axle.wheel.inertia_kgm2)
        road = filtered(before.road_nm, taken, dt_s, settings.slip_filter_s)
    gated = False
    if settings.gate_mode != GATE_MODE_OFF:
        gated = axle_gated(
            gate_slip, demand_w, before.gated, settings.critical_slip, settings.gate_hysteresis, settings.gate_driving
        )
    grip = UNLIMITED_NM
    if settings.gate_mode == GATE_MODE_LIMITER:
        grip = torque_room_nm(
            braking,
            road,
            wheel_speed_radps,
            speed_mps,
            settings.slip_target,
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
        actuator_nm=axle.friction_brake.max_torque_nm
        if braking
        else gain * torque_limit_nm(fast, before.heat, axle.motor),
        gain=gain,
        grip_nm=grip,
    )


@kernel
def _room_nm(wheel: Wheel) -> float:
    return 0.0 if wheel.gated else min(wheel.actuator_nm, wheel.grip_nm)


@kernel
def _rooms_nm(
    left: Wheel, right: Wheel, unequal_s: float, dt_s: float, budget_nm: float, growth_nmps: float, axle: Axle
) -> tuple[float, float, float]:
    """Room of an axle's two wheels within its yaw budget, and how long they have been unequal by then.

    The moment of a difference of torques T is T / radius * track / 2.
    """
    left_room = _room_nm(left)
    right_room = _room_nm(right)
    if left_room == right_room:
        return left_room, right_room, max(unequal_s - dt_s, 0.0)
    moment = budget_nm + growth_nmps * unequal_s
    difference = moment * 2.0 * axle.wheel.radius_m / axle.track_width_m
    less = min(left_room, right_room)
    return min(left_room, less + difference), min(right_room, less + difference), unequal_s + dt_s


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
            bits |= LIMIT_FRICTION_BRAKE
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
def _friction_nm(given: Given, delivered_nm: float, braking: bool, axle: Axle) -> float:
    """Friction torque that makes up, with what the motor delivers, the braking torque asked for.

    A motor that is still on its way down from driving is held against: braking gets through at once.
    """
    if not braking:
        return given.friction_nm
    return max(min(given.total_nm - delivered_nm, 0.0), -axle.friction_brake.max_torque_nm)


@kernel
def _after(
    wheel: Wheel, motor_nm: float, friction_nm: float, before: WheelState, dt_s: float, axle: Axle
) -> WheelState:
    """What is remembered of a wheel."""
    return WheelState(
        motor_nm=motor_nm,
        total_nm=wheel.gain * motor_nm + friction_nm,
        speed_radps=wheel.speed_radps,
        road_nm=wheel.road_nm,
        slip=wheel.slip,
        gated=wheel.gated,
        heat=heat_after(before.heat, motor_nm, dt_s, axle.motor),
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
    measurement : checked inputs; every number finite, speeds >= 0
    state : what the previous step returned, or `initial_state()`

    Returns
    -------
    Command, ControllerState
    """
    front, rear = vehicle.front, vehicle.rear
    fl0, fr0, rl0, rr0 = state.wheels
    speed = max(measurement.speed_mps, 0.0)
    demand = measurement.power_demand_w
    dt = measurement.dt_s
    braking = demand < 0.0
    first = state.steps == 0

    gain = measurement.motor_gain

    # 1. slip, wheel by wheel; an axle's is that of its worse wheel
    w = measurement.wheel_speed_radps
    fl_slip = _slip(w[0], speed, dt, first, fl0, front, settings)
    fr_slip = _slip(w[1], speed, dt, first, fr0, front, settings)
    rl_slip = _slip(w[2], speed, dt, first, rl0, rear, settings)
    rr_slip = _slip(w[3], speed, dt, first, rr0, rear, settings)
    front_slip = worse_slip(fl_slip, fr_slip)
    rear_slip = worse_slip(rl_slip, rr_slip)

    # 2. split
    memory = split(measurement, speed, front_slip, rear_slip, first, state.split, settings, vehicle, policy)

    # 3. gate, 4. capacity
    printed = settings.gate_mode == GATE_MODE_TABLE2
    fl_gate, fr_gate = (front_slip, front_slip) if printed else (fl_slip, fr_slip)
    rl_gate, rr_gate = (rear_slip, rear_slip) if printed else (rl_slip, rr_slip)
    fl = _wheel(w[0], fl_slip, fl_gate, speed, demand, gain[0], dt, first, fl0, front, settings, vehicle)
    fr = _wheel(w[1], fr_slip, fr_gate, speed, demand, gain[1], dt, first, fr0, front, settings, vehicle)
    rl = _wheel(w[2], rl_slip, rl_gate, speed, demand, gain[2], dt, first, rl0, rear, settings, vehicle)
    rr = _wheel(w[3], rr_slip, rr_gate, speed, demand, gain[3], dt, first, rr0, rear, settings, vehicle)
    front_gated = fl.gated and fr.gated
    rear_gated = rl.gated and rr.gated
    fl_room, fr_room, front_unequal = _rooms_nm(
        fl, fr, state.front_unequal_s, dt, settings.front_yaw_nm, settings.front_yaw_growth_nmps, front
    )
    rl_room, rr_room, rear_unequal = _rooms_nm(
        rl, rr, state.rear_unequal_s, dt, settings.rear_yaw_nm, settings.rear_yaw_growth_nmps, rear
    )
    front_power, rear_power = gated_split(demand, memory.applied_share, front_gated, rear_gated)
    front_asked = abs(front_power)
    rear_asked = abs(rear_power)
    front_given, rear_given = allocate(
        front_asked,
        rear_asked,
        fl.conversion_radps * fl_room + fr.conversion_radps * fr_room,
        rl.conversion_radps * rl_room + rr.conversion_radps * rr_room,
    )

    # 5. torque, 6. slew
    sign = -1.0 if braking else 1.0
    fl_nm, fr_nm = between_wheels(front_given, fl.conversion_radps, fr.conversion_radps, fl_room, fr_room)
    rl_nm, rr_nm = between_wheels(rear_given, rl.conversion_radps, rr.conversion_radps, rl_room, rr_room)
    fl_given = _given(sign * fl_nm, fl, speed, braking, dt, fl0, settings, front)
    fr_given = _given(sign * fr_nm, fr, speed, braking, dt, fr0, settings, front)
    rl_given = _given(sign * rl_nm, rl, speed, braking, dt, rl0, settings, rear)
    rr_given = _given(sign * rr_nm, rr, speed, braking, dt, rr0, settings, rear)
    tolerance = ROUNDING * abs(demand)
    # Where both axles together fall short, each of them is at its limit, whatever its own part was.
    short = front_asked + rear_asked - front_given - rear_given > tolerance
    front_short = short or front_asked - front_given > tolerance
    rear_short = short or rear_asked - rear_given > tolerance
    limits = (
        _limits(fl, fl_given, front_short or fl_nm < fr_nm, braking, front)
        | _limits(fr, fr_given, front_short or fr_nm < fl_nm, braking, front)
        | _limits(rl, rl_given, rear_short or rl_nm < rr_nm, braking, rear)
        | _limits(rr, rr_given, rear_short or rr_nm < rl_nm, braking, rear)
    )

    # 7. battery
    wanted = (fl_given.slewed_nm, fr_given.slewed_nm, rl_given.slewed_nm, rr_given.slewed_nm)
    scale = wheels_scale(wanted, w, measurement.discharge_limit_w, measurement.charge_limit_w, vehicle)
    if scale < 1.0:
        power = wheels_power_w(wanted, w, 1.0, vehicle)
        limits |= LIMIT_BATTERY_CHARGE if power < 0.0 else LIMIT_BATTERY_DISCHARGE
    motor = (scale * wanted[0], scale * wanted[1], scale * wanted[2], scale * wanted[3])
    delivered = (gain[0] * motor[0], gain[1] * motor[1], gain[2] * motor[2], gain[3] * motor[3])
    friction = (
        _friction_nm(fl_given, delivered[0], braking, front),
        _friction_nm(fr_given, delivered[1], braking, front),
        _friction_nm(rl_given, delivered[2], braking, rear),
        _friction_nm(rr_given, delivered[3], braking, rear),
    )
    fl_nm, fr_nm = delivered[0] + friction[0], delivered[1] + friction[1]
    rl_nm, rr_nm = delivered[2] + friction[2], delivered[3] + friction[3]

    command = Command(
        motor_torque_nm=motor,
        friction_torque_nm=friction,
        front_share=memory.applied_share,
        decided_share=memory.decided_share,
        gate=(1 if front_gated else 0) + (2 if rear_gated else 0),
        limits=limits,
        front_power_w=fl.conversion_radps * fl_nm + fr.conversion_radps * fr_nm,
        rear_power_w=rl.conversion_radps * rl_nm + rr.conversion_radps * rr_nm,
        front_slip=front_slip,
        rear_slip=rear_slip,
        gated_wheels=(1 if fl.gated else 0) + (2 if fr.gated else 0) + (4 if rl.gated else 0) + (8 if rr.gated else 0),
    )
    after = ControllerState(
        steps=state.steps + 1,
        split=memory,
        wheels=(
            _after(fl, motor[0], friction[0], fl0, dt, front),
            _after(fr, motor[1], friction[1], fr0, dt, front),
            _after(rl, motor[2], friction[2], rl0, dt, rear),
            _after(rr, motor[3], friction[3], rr0, dt, rear),
        ),
        front_unequal_s=front_unequal,
        rear_unequal_s=rear_unequal,
    )
    return command, after
