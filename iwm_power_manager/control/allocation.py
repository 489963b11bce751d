# SPDX-License-Identifier: Apache-2.0
"""From the demand to the torques of four wheels, all in the direction of travel: steps 1 to 7 of the law."""

from __future__ import annotations

from iwm_power_manager.control.axle import (
    UNEQUAL_S,
    Pair,
    Shared,
    alike_wheels,
    friction_nm,
    pair_capacity_w,
    pair_limits,
    pair_of,
    shared_of,
    slip_targets,
    speed_part,
    unequal_s,
    yaw_moments_nm,
)
from iwm_power_manager.control.one_road import least_road_nm
from iwm_power_manager.control.settings import Settings
from iwm_power_manager.control.slip import worse_slip
from iwm_power_manager.control.split import split
from iwm_power_manager.control.table import PolicyTable
from iwm_power_manager.control.types import (
    LIMIT_BATTERY_CHARGE,
    LIMIT_BATTERY_DISCHARGE,
    Command,
    ControllerState,
    FourWheels,
    Measurement,
    SplitMemory,
    Wheels,
)
from iwm_power_manager.control.wheel import wheel_after, wheel_slip
from iwm_power_manager.control.yaw import GROWTH_FRICTION, YawState, with_yaw, yaw_step
from iwm_power_manager.jit import kernel
from iwm_power_manager.model.gate import gated_split
from iwm_power_manager.model.limits import wheels_power_w, wheels_scale
from iwm_power_manager.model.parameters import VehicleParams
from iwm_power_manager.model.torque import allocate

#: Deceleration beyond which a driver wants all that the road gives, m/s2: half of a full pedal, twice what 0.2 gives.
GENTLE_MPS2 = 4.0
#: Part of the demand that sums and differences of powers may lose without a limit having bitten.
ROUNDING = 1e-12


@kernel
def drive(
    measurement: Measurement,
    state: ControllerState,
    rolls_back: bool,
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
    rolls_back : braked in the direction that nobody asked for
    lower_part : a power that brakes is divided by this part of the speed (`motion.Motion`)
    """
    speed = max(measurement.speed_mps, 0.0)
    dt = measurement.dt_s
    braking = measurement.power_demand_w < 0.0
    first = state.steps == 0
    before = state.wheels

    s = settings
    front_s, rear_s = state.front_unequal_s, state.rear_unequal_s
    lasting_s = front_s if abs(front_s) > UNEQUAL_S else 0.0
    firm = max(state.friction.left.friction, state.friction.right.friction) / GROWTH_FRICTION
    growth = min(speed_part(speed, s), 1.0) * firm * s.yaw_rate_growth_nmps
    rate, lateral = measurement.yaw_rate_radps, measurement.lateral_mps2
    yaw = yaw_step(state.yaw, rate, lateral, speed, lasting_s, growth, braking, dt)

    # 1. slip, wheel by wheel; an axle's is that of its worse wheel
    w = measurement.wheel_speed_radps
    fl_slip = wheel_slip(w[0], speed, dt, first, before[0], vehicle.front, settings)
    fr_slip = wheel_slip(w[1], speed, dt, first, before[1], vehicle.front, settings)
    rl_slip = wheel_slip(w[2], speed, dt, first, before[2], vehicle.rear, settings)
    rr_slip = wheel_slip(w[3], speed, dt, first, before[3], vehicle.rear, settings)
    slips = (fl_slip, fr_slip, rl_slip, rr_slip)
    front_slip = worse_slip(fl_slip, fr_slip)
    rear_slip = worse_slip(rl_slip, rr_slip)
    brakes = state.motion.brake_gain
    front_first = (
        vehicle.front.friction_brake.max_torque_nm > 0.0
        and min(brakes[0], brakes[1]) == 1.0
        and -measurement.power_demand_w <= GENTLE_MPS2 * vehicle.chassis.mass_kg * speed
    )
    gain = measurement.motor_gain
    targets = slip_targets(front_s, speed, braking, yaw.believed, slips, front_first, gain, s)
    front_alike = alike_wheels(0, measurement, before, targets)
    rear_alike = alike_wheels(2, measurement, before, targets)

    # 2. split
    memory = split(measurement, speed, front_slip, rear_slip, first, state.split, settings, vehicle, policy)

    # 3. gate, 4. capacity
    # Of wheels that are alike none slips alone.
    least_nm = (0.0, 0.0, 0.0, 0.0) if front_alike and rear_alike else least_road_nm(before, vehicle)
    front_nm = yaw_moments_nm(s.front_yaw_nm, s.front_yaw_growth_nmps, s.front_yaw_most_nm, front_s, speed, braking, s)
    rear_nm = yaw_moments_nm(s.rear_yaw_nm, s.rear_yaw_growth_nmps, s.rear_yaw_most_nm, rear_s, speed, braking, s)
    if braking:
        front_nm, rear_nm = with_yaw(front_nm, rear_nm, front_s, yaw)
    front = pair_of(
        0, measurement, slips, speed, lower_part, targets, least_nm, front_nm, first, before, front_alike,
        vehicle.front, s, vehicle,
    )  # fmt: skip
    rear = pair_of(
        2, measurement, slips, speed, lower_part, targets, least_nm, rear_nm, first, before, rear_alike,
        vehicle.rear, s, vehicle,
    )  # fmt: skip
    # No strategy knows of a car that rolls back: both axles brake alike.
    share = 0.5 if rolls_back else memory.applied_share
    axle_slips = front_slip, rear_slip
    return _commanded(measurement, speed, front, rear, axle_slips, memory, yaw, share, state, settings, vehicle)


@kernel
def _commanded(
    measurement: Measurement,
    speed_mps: float,
    front: Pair,
    rear: Pair,
    axle_slips: tuple[float, float],
    memory: SplitMemory,
    yaw: YawState,
    share: float,
    state: ControllerState,
    settings: Settings,
    vehicle: VehicleParams,
) -> tuple[Command, ControllerState]:
    """Steps 4 to 7: from the power each axle is asked for to the torques that are commanded."""
    demand, dt, wheels = measurement.power_demand_w, measurement.dt_s, state.wheels
    braking = demand < 0.0
    gated = front.left.gated and front.right.gated, rear.left.gated and rear.right.gated
    front_power, rear_power = gated_split(demand, share, gated)
    front_asked, rear_asked = abs(front_power), abs(rear_power)
    front_given, rear_given = allocate(front_asked, rear_asked, pair_capacity_w(front), pair_capacity_w(rear))

    # 5. torque, 6. slew
    f = shared_of(front_given, front, speed_mps, braking, dt, wheels[0], wheels[1], settings, vehicle.front)
    r = shared_of(rear_given, rear, speed_mps, braking, dt, wheels[2], wheels[3], settings, vehicle.rear)
    tolerance = ROUNDING * abs(demand)
    # Where both axles together fall short, each of them is at its limit, whatever its own part was.
    short = front_asked + rear_asked - front_given - rear_given > tolerance
    front_short = short or front_asked - front_given > tolerance
    rear_short = short or rear_asked - rear_given > tolerance
    limits = pair_limits(front, f, front_short, braking, vehicle.front)
    limits |= pair_limits(rear, r, rear_short, braking, vehicle.rear)

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
    command = Command(
        motor_torque_nm=motor,
        friction_torque_nm=friction,
        brake_gain=state.motion.brake_gain,
        front_share=share,
        decided_share=memory.decided_share,
        gate=int(gated[0]) + 2 * int(gated[1]),
        limits=limits,
        front_power_w=front.left.conversion_radps * fl_nm + front.right.conversion_radps * fr_nm,
        rear_power_w=rear.left.conversion_radps * rl_nm + rear.right.conversion_radps * rr_nm,
        front_slip=axle_slips[0],
        rear_slip=axle_slips[1],
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
        wheels=_wheels_after(front, rear, motor, (fl_nm, fr_nm, rl_nm, rr_nm), wheels, dt, vehicle),
        front_unequal_s=unequal_s(state.front_unequal_s, front.left, front.right, front_apart, dt),
        rear_unequal_s=unequal_s(state.rear_unequal_s, rear.left, rear.right, rear_apart, dt),
        yaw=yaw,
        motion=state.motion,
        travel=state.travel,
        hold_nm=state.hold_nm,
        friction=state.friction,
    )
    return command, after


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
        friction_nm(f.left, front.left, delivered_nm[0], braking, vehicle.front),
        friction_nm(f.right, front.right, delivered_nm[1], braking, vehicle.front),
        friction_nm(r.left, rear.left, delivered_nm[2], braking, vehicle.rear),
        friction_nm(r.right, rear.right, delivered_nm[3], braking, vehicle.rear),
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
        wheel_after(front.left, motor_nm[0], total_nm[0], before[0], dt_s, vehicle.front),
        wheel_after(front.right, motor_nm[1], total_nm[1], before[1], dt_s, vehicle.front),
        wheel_after(rear.left, motor_nm[2], total_nm[2], before[2], dt_s, vehicle.rear),
        wheel_after(rear.right, motor_nm[3], total_nm[3], before[3], dt_s, vehicle.rear),
    )


@kernel
def _bits(front: Pair, rear: Pair) -> int:
    """Bits of the wheels that are gated."""
    front_bits = (1 if front.left.gated else 0) + (2 if front.right.gated else 0)
    return front_bits + (4 if rear.left.gated else 0) + (8 if rear.right.gated else 0)
