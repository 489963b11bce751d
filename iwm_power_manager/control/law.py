# SPDX-License-Identifier: Apache-2.0
"""The control law: one step from a measurement to a command.

The order, which is also the order of precedence from weak to strong:

0. motion: speed and direction, and which sensor is not believed (`control.motion`); all that follows is reckoned in the
   direction of travel (`control.direction`), so that brakes brake and slip is slip backwards too;
1. slip of each wheel (`control.wheel`), filtered (eq. 10), and the torque the road took from it (eq. 11);
2. split: the strategy decides the front share, many times a second; the applied share follows at a limited rate;
3. skid gate: a wheel beyond the critical slip (Table 2 as printed: its axle), or one that keeps a slip while the road
   takes next to nothing from it, gets nothing, the others what they can;
4. capacity: what motors (peak, heat, power; eq. 19, 40), brakes (regeneration, where there are none), the slip limiter
   and the axle's yaw budget let each wheel give; what does not fit on one goes to the axle's other wheel and to the
   other axle (eq. 12);
5. power becomes torque (eq. 16-18); regeneration up to its limit, friction the rest (eq. 20, 41, 42);
6. slew limits on the motors; while a regenerative torque grows, friction fills in, so that braking always gets through;
7. battery limits on the motors (eq. 24, 43); friction takes over what cannot be regenerated.

8. hold: where the car rolls against the direction asked for, friction holds it until the motors do.

Steps 3 to 5 and 7 only ever make a motor torque smaller at once: no rate limit holds back a gate or a limit.
Steps 1 to 7 are `control.allocation`'s, which asks `control.axle` for the two wheels of each axle.
Wheels come one by one, in the order front left, front right, rear left, rear right; each with the numbers of its axle.
"""

from __future__ import annotations

from iwm_power_manager.control.allocation import drive
from iwm_power_manager.control.direction import held_nm, hold_torque_nm, travel_direction, turned_to
from iwm_power_manager.control.friction import estimate as friction_estimate
from iwm_power_manager.control.motion import Motion, estimate
from iwm_power_manager.control.settings import Settings
from iwm_power_manager.control.table import PolicyTable
from iwm_power_manager.control.types import (
    Command,
    ControllerState,
    FourWheels,
    FrictionState,
    Measurement,
    Wheels,
    WheelState,
)
from iwm_power_manager.jit import kernel
from iwm_power_manager.model.parameters import VehicleParams

#: Drive torque fades over this much speed below the fastest reverse, m/s.
REVERSE_FADE_MPS = 1.0


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
        travel * m.yaw_rate_radps,
        m.lateral_mps2,
        m.torque_shift_nm,
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
def _shifted(wheel: WheelState, shift_nm: float) -> WheelState:
    return WheelState(
        wheel.motor_nm,
        wheel.total_nm + shift_nm,
        wheel.speed_radps,
        wheel.road_nm,
        wheel.slip,
        wheel.gated,
        wheel.heat,
    )


@kernel
def _aligned(state: ControllerState, shift_nm: Wheels) -> FourWheels:
    """What is remembered of the wheels, with the torques that belong to how their speeds have changed."""
    a, b, c, d = state.wheels
    travel = state.travel
    return (
        _shifted(a, travel * shift_nm[0]),
        _shifted(b, travel * shift_nm[1]),
        _shifted(c, travel * shift_nm[2]),
        _shifted(d, travel * shift_nm[3]),
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
    wheels = _aligned(state, m.torque_shift_nm)
    motion, motion_after = estimate(m, state.motion, wheels, state.travel, state.steps == 0, vehicle)
    travel = travel_direction(motion.speed_mps, m.power_demand_w, m.direction, state.travel)
    before = turned_to(state, wheels, motion_after, travel)
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
    rolls_back = travel != m.direction and demand < 0.0
    made, after = drive(believed, before, rolls_back, motion.lower_part, settings, vehicle, policy)
    e, f, g, h = after.wheels
    motor = made.motor_torque_nm
    friction = made.friction_torque_nm
    w = before.wheels
    # Of a front and a rear wheel, as the mean of both sides.
    motor_before = 0.5 * (w[0].motor_nm + w[1].motor_nm + w[2].motor_nm + w[3].motor_nm)
    motor_now = 0.5 * (motor[0] + motor[1] + motor[2] + motor[3])
    hold = hold_torque_nm(state.hold_nm, motion, m, motor_now, motor_before, vehicle)
    if hold > 0.0 and demand >= 0.0:
        friction = (
            held_nm(hold, e.gated, vehicle.front),
            held_nm(hold, f.gated, vehicle.front),
            held_nm(hold, g.gated, vehicle.rear),
            held_nm(hold, h.gated, vehicle.rear),
        )
    final = ControllerState(
        steps=after.steps,
        split=after.split,
        wheels=after.wheels,
        front_unequal_s=after.front_unequal_s,
        rear_unequal_s=after.rear_unequal_s,
        yaw=after.yaw,
        motion=motion_after,
        travel=travel,
        hold_nm=hold,
        friction=grip,
    )
    return _answered(made, friction, travel, motion, hold, grip), final
