"""The control law: one step from a measurement to a command.

The order, which is also the order of precedence from weak to strong:

1. slip of each axle from its wheels, filtered (eq. 10);
2. split: the strategy decides the front share, ten times a second; the applied share follows at a limited rate;
3. skid gate: an axle beyond the critical slip gets nothing, the other one all (Table 2);
4. room: what motors (peak, heat, power; eq. 19, 40), brakes and the slip limiter let each axle give; what does not fit
   on one axle goes to the other (eq. 12);
5. power becomes torque (eq. 16-18), left and right alike; regeneration up to its limit, friction the rest (eq. 20, 41,
   42);
6. slew limits on the motors; while a regenerative torque grows, friction fills in, so that braking always gets through;
7. battery limits on the motors (eq. 24, 43); friction takes over what cannot be regenerated.

Steps 3 to 5 and 7 only ever make a motor torque smaller at once: no rate limit holds back a gate or a limit.
"""

from __future__ import annotations

import math

from iwm_power_manager.control.settings import GATE_MODE_LIMITER, GATE_MODE_OFF, Settings
from iwm_power_manager.control.slew import approached, slewed
from iwm_power_manager.control.slip import UNLIMITED_NM, axle_slip, filtered, road_torque_nm, torque_room_nm
from iwm_power_manager.control.split import decide
from iwm_power_manager.control.strategy import Situation
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
)
from iwm_power_manager.jit import kernel
from iwm_power_manager.model.gate import axle_gated, gated_split
from iwm_power_manager.model.limits import battery_scale, car_power_w
from iwm_power_manager.model.motor import heat_after, regeneration_limit_nm, torque_limit_nm
from iwm_power_manager.model.parameters import VehicleParams
from iwm_power_manager.model.torque import allocate, blend, conversion_speed_radps

#: A motor torque below this is rounding noise of a share or a fade; zero lets the drive go idle.
ZERO_TORQUE_NM = 1e-6

#: Part of the demand that sums and differences of powers may lose without a limit having bitten.
ROUNDING = 1e-12


@kernel
def _inside(
    torque_nm: float,
    gated: bool,
    braking: bool,
    grip_nm: float,
    wheel_speed_radps: float,
    speed_mps: float,
    heat: float,
    vehicle: VehicleParams,
) -> float:
    """A slewed motor torque, cut to what gate, motor and grip allow in this step."""
    if gated:
        return 0.0
    driving_room = torque_limit_nm(wheel_speed_radps, heat, vehicle.front.motor)
    braking_room = regeneration_limit_nm(wheel_speed_radps, speed_mps, heat, vehicle.front.motor)
    if braking:
        braking_room = min(braking_room, grip_nm)
    else:
        driving_room = min(driving_room, grip_nm)
    return min(max(torque_nm, -braking_room), driving_room)


@kernel
def _quiet(torque_nm: float) -> float:
    return torque_nm if abs(torque_nm) > ZERO_TORQUE_NM else 0.0


@kernel
def _friction(total_nm: float, motor_nm: float, most_nm: float) -> float:
    """Friction torque that makes up, with what the motor does, the braking torque asked for.

    A motor that is still on its way down from driving is held against: braking gets through at once.
    """
    return max(min(total_nm - motor_nm, 0.0), -most_nm)


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
    radius = vehicle.front.wheel.radius_m
    inertia = vehicle.front.wheel.inertia_kgm2
    speed = max(measurement.speed_mps, 0.0)
    demand = measurement.power_demand_w
    dt = measurement.dt_s
    left_front, right_front, left_rear, right_rear = measurement.wheel_speed_radps
    front_speed = 0.5 * (left_front + right_front)
    rear_speed = 0.5 * (left_rear + right_rear)
    braking = demand < 0.0
    first = state.steps == 0

    # 1. slip
    floor = settings.slip_speed_floor_mps
    time_constant = 0.0 if first else settings.slip_filter_s
    front_slip = filtered(state.front_slip, axle_slip(left_front, right_front, speed, radius, floor), dt, time_constant)
    rear_slip = filtered(state.rear_slip, axle_slip(left_rear, right_rear, speed, radius, floor), dt, time_constant)

    # 2. split
    decisions = state.decisions
    age = state.decision_age_s + dt
    decided = state.decided_share
    recent = state.recent_change
    # Half a step of slack: sums of 0.01 s must not delay every tenth decision by a step.
    if first or age >= settings.decision_period_s - 0.5 * dt:
        recent *= math.exp(-age / settings.reversal_s)
        situation = Situation(
            power_demand_w=demand,
            speed_mps=speed,
            front_slip=front_slip,
            rear_slip=rear_slip,
            previous_share=decided,
            recent_change=recent,
            friction=measurement.friction,
            decisions=decisions,
        )
        decided = decide(situation, settings, vehicle, policy)
        recent += decided - state.decided_share
        decisions += 1
        age = 0.0
    applied = decided if first else approached(state.applied_share, decided, settings.share_rate_per_s * dt)

    # 3. gate
    front_gated = False
    rear_gated = False
    if settings.gate_mode != GATE_MODE_OFF:
        critical = settings.critical_slip
        hysteresis = settings.gate_hysteresis
        driving = settings.gate_driving
        front_gated = axle_gated(front_slip, demand, state.front_gated, critical, hysteresis, driving)
        rear_gated = axle_gated(rear_slip, demand, state.rear_gated, critical, hysteresis, driving)
    front_power, rear_power = gated_split(demand, applied, front_gated, rear_gated)

    # 4. room of each axle, as torque of one wheel
    limits = 0
    front_conversion = conversion_speed_radps(front_speed, speed, settings.critical_slip, vehicle)
    rear_conversion = conversion_speed_radps(rear_speed, speed, settings.critical_slip, vehicle)
    front_fast = max(left_front, right_front, front_conversion)
    rear_fast = max(left_rear, right_rear, rear_conversion)
    front_road = 0.0
    rear_road = 0.0
    if not first:
        front_road = filtered(
            state.front_road_nm,
            road_torque_nm(state.front_total_nm, state.front_speed_radps, front_speed, dt, inertia),
            dt,
            settings.slip_filter_s,
        )
        rear_road = filtered(
            state.rear_road_nm,
            road_torque_nm(state.rear_total_nm, state.rear_speed_radps, rear_speed, dt, inertia),
            dt,
            settings.slip_filter_s,
        )
    if braking:
        front_room = vehicle.front.friction_brake.max_torque_nm
        rear_room = front_room
    else:
        front_room = torque_limit_nm(front_fast, state.front_heat, vehicle.front.motor)
        rear_room = torque_limit_nm(rear_fast, state.rear_heat, vehicle.front.motor)
    front_grip = UNLIMITED_NM
    rear_grip = UNLIMITED_NM
    if settings.gate_mode == GATE_MODE_LIMITER:
        target = settings.slip_target
        lag = settings.slip_limiter_s
        front_worst = min(left_front, right_front) if braking else max(left_front, right_front)
        rear_worst = min(left_rear, right_rear) if braking else max(left_rear, right_rear)
        front_grip = torque_room_nm(braking, front_road, front_worst, speed, target, lag, floor, radius, inertia)
        rear_grip = torque_room_nm(braking, rear_road, rear_worst, speed, target, lag, floor, radius, inertia)
    front_asked = abs(front_power)
    rear_asked = abs(rear_power)
    front_given, rear_given = allocate(
        front_asked,
        rear_asked,
        0.0 if front_gated else 2.0 * front_conversion * min(front_room, front_grip),
        0.0 if rear_gated else 2.0 * rear_conversion * min(rear_room, rear_grip),
    )

    # 5. torque
    sign = -1.0 if braking else 1.0
    front_total = sign * front_given / (2.0 * front_conversion)
    rear_total = sign * rear_given / (2.0 * rear_conversion)
    tolerance = ROUNDING * abs(demand)
    # Where both axles together fall short, each of them is at its limit, whatever its own part was.
    short = front_asked + rear_asked - front_given - rear_given > tolerance
    for asked, given, gated, room, grip, fast in (
        (front_asked, front_given, front_gated, front_room, front_grip, front_fast),
        (rear_asked, rear_given, rear_gated, rear_room, rear_grip, rear_fast),
    ):
        if not gated and (short or asked - given > tolerance):
            if grip < room:
                limits |= LIMIT_SLIP
            elif braking:
                limits |= LIMIT_FRICTION_BRAKE
            else:
                limits |= LIMIT_MOTOR
                if room < torque_limit_nm(fast, 0.0, vehicle.front.motor):
                    limits |= LIMIT_THERMAL
    front_motor, front_friction = blend(front_total, front_fast, speed, state.front_heat, vehicle)
    rear_motor, rear_friction = blend(rear_total, rear_fast, speed, state.rear_heat, vehicle)
    if front_friction < 0.0 or rear_friction < 0.0:
        limits |= LIMIT_REGENERATION

    # 6. slew; a gate or a limit may cut at once
    up = settings.slew_up_nmps
    down = settings.slew_down_nmps
    growth = settings.slew_regeneration_nmps
    front_slewed = slewed(state.front_motor_nm, front_motor, dt, up, down, growth)
    rear_slewed = slewed(state.rear_motor_nm, rear_motor, dt, up, down, growth)
    front_heat = state.front_heat
    rear_heat = state.rear_heat
    front_slewed = _quiet(
        _inside(front_slewed, front_gated, braking, front_grip, front_fast, speed, front_heat, vehicle)
    )
    rear_slewed = _quiet(_inside(rear_slewed, rear_gated, braking, rear_grip, rear_fast, speed, rear_heat, vehicle))
    if max(abs(front_slewed - front_motor), abs(rear_slewed - rear_motor)) > ZERO_TORQUE_NM:
        limits |= LIMIT_SLEW

    # 7. battery
    scale = battery_scale(
        front_slewed,
        rear_slewed,
        front_speed,
        rear_speed,
        measurement.discharge_limit_w,
        measurement.charge_limit_w,
        vehicle.front.motor,
    )
    if scale < 1.0:
        power = car_power_w(front_slewed, rear_slewed, front_speed, rear_speed, vehicle.front.motor)
        limits |= LIMIT_BATTERY_CHARGE if power < 0.0 else LIMIT_BATTERY_DISCHARGE
    front_motor = scale * front_slewed
    rear_motor = scale * rear_slewed
    if braking:
        most = vehicle.front.friction_brake.max_torque_nm
        front_friction = _friction(front_total, front_motor, most)
        rear_friction = _friction(rear_total, rear_motor, most)

    command = Command(
        (front_motor, front_motor, rear_motor, rear_motor),
        (front_friction, front_friction, rear_friction, rear_friction),
        applied,
        decided,
        (1 if front_gated else 0) + (2 if rear_gated else 0),
        limits,
        2.0 * front_conversion * (front_motor + front_friction),
        2.0 * rear_conversion * (rear_motor + rear_friction),
        front_slip,
        rear_slip,
    )
    after = ControllerState(
        state.steps + 1,
        decisions,
        age,
        decided,
        applied,
        recent,
        front_motor,
        rear_motor,
        front_motor + front_friction,
        rear_motor + rear_friction,
        front_speed,
        rear_speed,
        front_road,
        rear_road,
        front_slip,
        rear_slip,
        front_gated,
        rear_gated,
        heat_after(state.front_heat, front_motor, dt, vehicle.front.motor),
        heat_after(state.rear_heat, rear_motor, dt, vehicle.front.motor),
    )
    return command, after
