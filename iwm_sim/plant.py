# SPDX-License-Identifier: Apache-2.0
"""The car as it is: the higher-fidelity model, used for evaluation only.

Beyond the control-oriented model it moves in the plane (`iwm_sim.double_track`), forwards and backwards, and has four
wheels of their own, motors that heat up and derate, and a battery whose open-circuit voltage and resistance depend on
its charge, with a polarisation branch. It obeys commands only as far as its motors can. Where left and right are alike,
nothing steers and the car rolls forwards, the motion in the plane is a straight line, and `model.two_axles` solves it:
the same equations without their lateral half.

Every joule is booked. Within a step forces and torques are constant, so their work is exact with the mean of the speeds
before and after, and

    chemical = ohmic + polarisation + motor losses + brakes + idle drag + tyre slip + air + rolling + grade
               + change of kinetic energy (car and wheels, yaw included) + change of energy in the polarisation branch

holds to rounding error.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from iwm_power_manager.grid import interpolate1, locate
from iwm_power_manager.jit import kernel
from iwm_power_manager.model.battery import current_a
from iwm_power_manager.model.chassis import aerodynamic_force_n, grade_force_n, normal_forces_n
from iwm_power_manager.model.longitudinal import Speeds, Torques
from iwm_power_manager.model.motor import (
    electrical_power_w,
    heat_after,
    idle_drag_nm,
    regeneration_limit_nm,
    torque_limit_nm,
)
from iwm_power_manager.model.parameters import Axle, Battery, Motor, VehicleParams
from iwm_power_manager.model.two_axles import step_onward
from iwm_sim import double_track
from iwm_sim.double_track import Four


class Energies(NamedTuple):
    """What has flowed since the start, J. `chemical_j` is what the cells gave; the rest is where it went."""

    chemical_j: float
    ohmic_j: float
    polarisation_j: float
    motor_loss_j: float
    friction_brake_j: float
    idle_drag_j: float
    tyre_slip_j: float
    air_j: float
    rolling_j: float
    grade_j: float


class Surroundings(NamedTuple):
    """What the world does to the car in a step.

    Attributes
    ----------
    friction : peak friction coefficient under each wheel
    grade : rise over run
    headwind_mps : wind against the car
    """

    friction: Four
    grade: float = 0.0
    headwind_mps: float = 0.0


class PlantState(NamedTuple):
    """The car between two steps.

    Attributes
    ----------
    speed_mps, lateral_speed_mps, yaw_rate_radps : of the centre of gravity, in body axes: forward, to the left
    wheel_speed_radps : four wheels, negative when rolling backwards
    acceleration_mps2, lateral_acceleration_mps2 : mean over the last step
    distance_m : since the start, along the car; backwards it falls
    x_m, y_m, heading_rad : where it is, from a start at the origin; y and heading positive to the left
    soc : state of charge 0..1
    polarisation_v : voltage of the RC branch
    heat : heat index of each motor
    motor_torque_nm, friction_torque_nm : what motors and brakes really did in the last step, forward positive
    electrical_power_w, current_a, terminal_v : battery in the last step
    energies : the books
    """

    speed_mps: float
    lateral_speed_mps: float
    yaw_rate_radps: float
    wheel_speed_radps: Four
    acceleration_mps2: float
    lateral_acceleration_mps2: float
    distance_m: float
    x_m: float
    y_m: float
    heading_rad: float
    soc: float
    polarisation_v: float
    heat: Four
    motor_torque_nm: Four
    friction_torque_nm: Four
    electrical_power_w: float
    current_a: float
    terminal_v: float
    energies: Energies


#: Below this speed, m/s, a motor gives its torque either way: no regeneration is worth anything there.
STANDSTILL_MPS = 0.1


def initial_plant(vehicle: VehicleParams, soc: float = 0.8, speed_mps: float = 0.0) -> PlantState:
    """A rested, cold car at a speed, its wheels rolling."""
    zero = (0.0, 0.0, 0.0, 0.0)
    front = speed_mps / vehicle.front.wheel.radius_m
    rear = speed_mps / vehicle.rear.wheel.radius_m
    return PlantState(
        speed_mps=float(speed_mps),
        lateral_speed_mps=0.0,
        yaw_rate_radps=0.0,
        wheel_speed_radps=(front, front, rear, rear),
        acceleration_mps2=0.0,
        lateral_acceleration_mps2=0.0,
        distance_m=0.0,
        x_m=0.0,
        y_m=0.0,
        heading_rad=0.0,
        soc=float(soc),
        polarisation_v=0.0,
        heat=zero,
        motor_torque_nm=zero,
        friction_torque_nm=zero,
        electrical_power_w=0.0,
        current_a=0.0,
        terminal_v=float(open_circuit_v(float(soc), vehicle.battery)),
        energies=Energies(*(0.0 for _ in Energies._fields)),
    )


@kernel
def open_circuit_v(soc: float, battery: Battery) -> float:
    """Open-circuit voltage of the pack, V."""
    return battery.cells_in_series * interpolate1(battery.ocv_cell_v, *locate(battery.ocv_soc, soc))


@kernel
def ohmic_resistance_ohm(soc: float, battery: Battery) -> float:
    """R0 of the pack, ohm: constant above 30 % charge, rising linearly below, by the given factor at 10 %."""
    rise = (battery.ohmic_factor_at_10_percent - 1.0) * max(0.3 - soc, 0.0) / 0.2
    return battery.ohmic_resistance_ohm * (1.0 + rise)


class Pack(NamedTuple):
    """The battery over one step: its state afterwards, its power and what it lost."""

    soc: float
    polarisation_v: float
    current_a: float
    terminal_v: float
    chemical_j: float
    ohmic_j: float
    polarisation_j: float


@kernel
def pack_after(soc: float, polarisation_v: float, power_w: float, dt_s: float, battery: Battery) -> Pack:
    """The battery after giving a power for a time."""
    voltage = open_circuit_v(soc, battery)
    resistance = ohmic_resistance_ohm(soc, battery)
    current = current_a(power_w, voltage - polarisation_v, resistance)
    # The RC branch exactly, for a current that holds through the step; its loss is what went in and did not stay.
    decay = math.exp(-dt_s / battery.polarisation_time_constant_s)
    full = battery.polarisation_resistance_ohm * current
    after = full + (polarisation_v - full) * decay
    capacity = 0.0
    if battery.polarisation_resistance_ohm > 0.0:
        capacity = battery.polarisation_time_constant_s / battery.polarisation_resistance_ohm
    stored = 0.5 * capacity * (after * after - polarisation_v * polarisation_v)
    entered = polarisation_v * current * dt_s
    return Pack(
        soc=soc - current * dt_s / (3600.0 * battery.capacity_ah),
        polarisation_v=after,
        current_a=current,
        terminal_v=voltage - polarisation_v - resistance * current,
        chemical_j=voltage * current * dt_s,
        ohmic_j=resistance * current * current * dt_s,
        polarisation_j=entered - stored,
    )


@kernel
def obeyed_torque_nm(command_nm: float, wheel_speed_radps: float, speed_mps: float, heat: float, motor: Motor) -> float:
    """What a motor makes of a command: it saturates at its own limits.

    A torque against the car's way forwards is regeneration, with its limits; all others are the motor's full torque:
    forwards whichever way the car rolls, backwards from all but standstill on.
    """
    turning = abs(wheel_speed_radps)
    most = torque_limit_nm(turning, heat, motor)
    least = -regeneration_limit_nm(turning, speed_mps, heat, motor) if speed_mps > STANDSTILL_MPS else -most
    return min(max(command_nm, least), most)


@kernel
def _brake_part(held_nm: float, brake_nm: float, drag_nm: float) -> float:
    """The friction brake's part of what held a wheel back: a wheel that stops within the step takes less than told."""
    told = brake_nm + drag_nm
    return held_nm * brake_nm / told if told > 0.0 else 0.0


@kernel
def _alike(of_wheels: Four) -> bool:
    return of_wheels[0] == of_wheels[1] and of_wheels[2] == of_wheels[3]


@kernel
def runs_straight(
    state: PlantState, motors: Four, resisting: Four, steer_rad: float, surroundings: Surroundings
) -> bool:
    """Whether nothing in this step can turn the car or drive it backwards."""
    wheels = state.wheel_speed_radps
    return (
        steer_rad == 0.0
        and state.lateral_speed_mps == 0.0
        and state.yaw_rate_radps == 0.0
        and surroundings.headwind_mps == 0.0
        and state.speed_mps >= 0.0
        and wheels[0] >= 0.0
        and wheels[2] >= 0.0
        and _alike(wheels)
        and _alike(motors)
        and _alike(resisting)
        and _alike(surroundings.friction)
        # At rest, a slope or a motor may start it backwards; what holds it then is Coulomb friction both ways.
        and (state.speed_mps > 0.0 or surroundings.grade == 0.0)
        and (state.speed_mps > STANDSTILL_MPS or min(motors[0], motors[2]) >= 0.0)
    )


@kernel
def _straight(
    state: PlantState,
    motors: Four,
    resisting: Four,
    surroundings: Surroundings,
    dt_s: float,
    vehicle: VehicleParams,
) -> double_track.PlaneMotion:
    """The step along a straight line, as motion in the plane."""
    grade, friction, wheels = surroundings.grade, surroundings.friction, state.wheel_speed_radps
    before = Speeds(state.speed_mps, wheels[0], wheels[2])
    moved = step_onward(
        before,
        Torques(motors[0], motors[2], resisting[0], resisting[2]),
        state.acceleration_mps2,
        grade,
        (friction[0], friction[2]),
        dt_s,
        vehicle,
    )
    after = moved.speeds
    mean_speed = 0.5 * (before.car_mps + after.car_mps)
    front_rim = vehicle.front.wheel.radius_m * (0.5 * (before.front_radps + after.front_radps))
    rear_rim = vehicle.rear.wheel.radius_m * (0.5 * (before.rear_radps + after.rear_radps))
    slipped = moved.front_force_n * (front_rim - mean_speed) + moved.rear_force_n * (rear_rim - mean_speed)
    acceleration = (after.car_mps - before.car_mps) / dt_s
    front, rear = normal_forces_n(acceleration, after.car_mps, grade, vehicle.chassis)
    return double_track.PlaneMotion(
        speed_mps=after.car_mps,
        lateral_speed_mps=0.0,
        yaw_rate_radps=0.0,
        wheel_speed_radps=(after.front_radps, after.front_radps, after.rear_radps, after.rear_radps),
        acceleration_mps2=acceleration,
        lateral_acceleration_mps2=0.0,
        normal_force_n=(front, front, rear, rear),
        holding_torque_nm=(
            -moved.front_resisting_nm,
            -moved.front_resisting_nm,
            -moved.rear_resisting_nm,
            -moved.rear_resisting_nm,
        ),
        turned_rad=0.0,
        mean_speed_mps=mean_speed,
        mean_lateral_mps=0.0,
        rolling_force_n=moved.rolling_force_n,
        air_force_n=aerodynamic_force_n(after.car_mps, vehicle.chassis),
        slip_work_w=2.0 * slipped,
    )


@kernel
def _moved(
    state: PlantState,
    motors: Four,
    resisting: Four,
    steer_rad: float,
    surroundings: Surroundings,
    dt_s: float,
    vehicle: VehicleParams,
) -> double_track.PlaneMotion:
    """One implicit step of the motion, along a straight line where that is all it can be."""
    if runs_straight(state, motors, resisting, steer_rad, surroundings):
        motion = _straight(state, motors, resisting, surroundings, dt_s, vehicle)
        if motion.speed_mps > 0.0 or surroundings.grade == 0.0:
            return motion
    return double_track.step(
        state.speed_mps,
        state.lateral_speed_mps,
        state.yaw_rate_radps,
        state.wheel_speed_radps,
        state.acceleration_mps2,
        state.lateral_acceleration_mps2,
        motors,
        resisting,
        steer_rad,
        surroundings.grade,
        surroundings.headwind_mps,
        surroundings.friction,
        dt_s,
        vehicle,
    )


class _Work(NamedTuple):
    """One wheel over a step: power of its motor, and what brake and drag took, W; torque of the brake, N m."""

    electrical_w: float
    shaft_w: float
    braked_w: float
    dragged_w: float
    braking_nm: float


@kernel
def _wheel_work(
    i: int, state: PlantState, motion: double_track.PlaneMotion, motors: Four, brakes: Four, drags: Four, motor: Motor
) -> _Work:
    mean_wheel = 0.5 * (state.wheel_speed_radps[i] + motion.wheel_speed_radps[i])
    held = motion.holding_torque_nm[i]
    exerted = _brake_part(-held, brakes[i], drags[i])
    # Running backwards, a motor does with both signs turned what it does forwards.
    sign = -1.0 if mean_wheel < 0.0 else 1.0
    power = electrical_power_w(sign * motors[i], sign * mean_wheel, motor)
    return _Work(power, motors[i] * mean_wheel, exerted * mean_wheel, (-held - exerted) * mean_wheel, exerted)


@kernel
def _substep(
    state: PlantState,
    motors: Four,
    brakes: Four,
    heat: Four,
    steer_rad: float,
    surroundings: Surroundings,
    h: float,
    vehicle: VehicleParams,
) -> PlantState:
    """One implicit step with its books; `heat` is the motors' afterwards."""
    wheels = state.wheel_speed_radps
    drags = (
        idle_drag_nm(motors[0], abs(wheels[0]), vehicle.front.motor),
        idle_drag_nm(motors[1], abs(wheels[1]), vehicle.front.motor),
        idle_drag_nm(motors[2], abs(wheels[2]), vehicle.rear.motor),
        idle_drag_nm(motors[3], abs(wheels[3]), vehicle.rear.motor),
    )
    resisting = (brakes[0] + drags[0], brakes[1] + drags[1], brakes[2] + drags[2], brakes[3] + drags[3])
    motion = _moved(state, motors, resisting, steer_rad, surroundings, h, vehicle)
    front, rear = vehicle.front.motor, vehicle.rear.motor
    fl = fr = _wheel_work(0, state, motion, motors, brakes, drags, front)
    rl = rr = _wheel_work(2, state, motion, motors, brakes, drags, rear)
    alike = _alike(wheels) and _alike(motion.wheel_speed_radps) and _alike(motors) and _alike(brakes)
    if not (alike and _alike(motion.holding_torque_nm)):
        fr = _wheel_work(1, state, motion, motors, brakes, drags, front)
        rr = _wheel_work(3, state, motion, motors, brakes, drags, rear)
    power = fl.electrical_w + fr.electrical_w + rl.electrical_w + rr.electrical_w
    shaft = fl.shaft_w + fr.shaft_w + rl.shaft_w + rr.shaft_w
    braked = fl.braked_w + fr.braked_w + rl.braked_w + rr.braked_w
    dragged = fl.dragged_w + fr.dragged_w + rl.dragged_w + rr.dragged_w
    pack = pack_after(state.soc, state.polarisation_v, power, h, vehicle.battery)
    mean_speed = motion.mean_speed_mps
    books = state.energies
    heading = state.heading_rad + 0.5 * motion.turned_rad
    # The mean velocity is given in the axes after the step; halfway through they point half a turn back.
    back_cosine = math.cos(0.5 * motion.turned_rad)
    back_sine = math.sin(0.5 * motion.turned_rad)
    along = back_cosine * mean_speed - back_sine * motion.mean_lateral_mps
    across = back_sine * mean_speed + back_cosine * motion.mean_lateral_mps
    return PlantState(
        speed_mps=motion.speed_mps,
        lateral_speed_mps=motion.lateral_speed_mps,
        yaw_rate_radps=motion.yaw_rate_radps,
        wheel_speed_radps=motion.wheel_speed_radps,
        acceleration_mps2=motion.acceleration_mps2,
        lateral_acceleration_mps2=motion.lateral_acceleration_mps2,
        distance_m=state.distance_m + mean_speed * h,
        x_m=state.x_m + (math.cos(heading) * along - math.sin(heading) * across) * h,
        y_m=state.y_m + (math.sin(heading) * along + math.cos(heading) * across) * h,
        heading_rad=state.heading_rad + motion.turned_rad,
        soc=pack.soc,
        polarisation_v=pack.polarisation_v,
        heat=heat,
        motor_torque_nm=motors,
        friction_torque_nm=(-fl.braking_nm, -fr.braking_nm, -rl.braking_nm, -rr.braking_nm),
        electrical_power_w=power,
        current_a=pack.current_a,
        terminal_v=pack.terminal_v,
        energies=Energies(
            chemical_j=books.chemical_j + pack.chemical_j,
            ohmic_j=books.ohmic_j + pack.ohmic_j,
            polarisation_j=books.polarisation_j + pack.polarisation_j,
            motor_loss_j=books.motor_loss_j + (power - shaft) * h,
            friction_brake_j=books.friction_brake_j + braked * h,
            idle_drag_j=books.idle_drag_j + dragged * h,
            tyre_slip_j=books.tyre_slip_j + motion.slip_work_w * h,
            air_j=books.air_j + motion.air_force_n * mean_speed * h,
            rolling_j=books.rolling_j + motion.rolling_force_n * mean_speed * h,
            grade_j=books.grade_j + grade_force_n(surroundings.grade, vehicle.chassis) * mean_speed * h,
        ),
    )


@kernel
def _obeyed(i: int, command_nm: Four, state: PlantState, axle: Axle) -> float:
    return obeyed_torque_nm(command_nm[i], state.wheel_speed_radps[i], state.speed_mps, state.heat[i], axle.motor)


@kernel
def _braking(command_nm: float, axle: Axle) -> float:
    return min(max(-command_nm, 0.0), axle.friction_brake.max_torque_nm)


@kernel
def advance(
    state: PlantState,
    motor_command_nm: Four,
    friction_command_nm: Four,
    steer_rad: float,
    surroundings: Surroundings,
    dt_s: float,
    substeps: int,
    vehicle: VehicleParams,
) -> PlantState:
    """The car after holding a command for a time.

    Parameters
    ----------
    motor_command_nm, friction_command_nm : of each wheel; a friction torque <= 0 is how hard the brake is applied,
        whichever way the wheel turns
    steer_rad : angle of the front wheels, positive to the left
    surroundings : road and wind
    dt_s : how long the command holds
    substeps : implicit steps it is divided into, >= 1
    """
    front = vehicle.front
    rear = vehicle.rear
    motors = (
        _obeyed(0, motor_command_nm, state, front),
        _obeyed(1, motor_command_nm, state, front),
        _obeyed(2, motor_command_nm, state, rear),
        _obeyed(3, motor_command_nm, state, rear),
    )
    brakes = (
        _braking(friction_command_nm[0], front),
        _braking(friction_command_nm[1], front),
        _braking(friction_command_nm[2], rear),
        _braking(friction_command_nm[3], rear),
    )
    heat = (
        heat_after(state.heat[0], motors[0], dt_s, front.motor),
        heat_after(state.heat[1], motors[1], dt_s, front.motor),
        heat_after(state.heat[2], motors[2], dt_s, rear.motor),
        heat_after(state.heat[3], motors[3], dt_s, rear.motor),
    )
    for _ in range(substeps):
        state = _substep(state, motors, brakes, heat, steer_rad, surroundings, dt_s / substeps, vehicle)
    return state
