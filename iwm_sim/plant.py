"""The car as it is: the higher-fidelity model, used for evaluation only.

Beyond the control-oriented model it has four wheels of their own, motors that heat up and derate, and a battery whose
open-circuit voltage and resistance depend on its charge, with a polarisation branch. It obeys commands only as far as
its motors can.

Every joule is booked. Within a step forces and torques are constant, so their work is exact with the mean of the speeds
before and after, and

    chemical = ohmic + polarisation + motor losses + brakes + idle drag + tyre slip + air + rolling + grade
               + change of kinetic energy (car and wheels) + change of energy in the polarisation branch

holds to rounding error.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from iwm_power_manager.jit import kernel
from iwm_power_manager.model.battery import current_a
from iwm_power_manager.model.chassis import aerodynamic_force_n, grade_force_n
from iwm_power_manager.model.longitudinal import Four, step
from iwm_power_manager.model.motor import (
    electrical_power_w,
    heat_after,
    idle_drag_nm,
    regeneration_limit_nm,
    torque_limit_nm,
)
from iwm_power_manager.model.parameters import Battery, VehicleParams


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


class PlantState(NamedTuple):
    """The car between two steps.

    Attributes
    ----------
    speed_mps, wheel_speed_radps : car and four wheels
    acceleration_mps2 : mean over the last step
    distance_m : since the start
    soc : state of charge 0..1
    polarisation_v : voltage of the RC branch
    heat : heat index of each motor
    motor_torque_nm, friction_torque_nm : what motors and brakes really did in the last step
    electrical_power_w, current_a, terminal_v : battery in the last step
    energies : the books
    """

    speed_mps: float
    wheel_speed_radps: Four
    acceleration_mps2: float
    distance_m: float
    soc: float
    polarisation_v: float
    heat: Four
    motor_torque_nm: Four
    friction_torque_nm: Four
    electrical_power_w: float
    current_a: float
    terminal_v: float
    energies: Energies


def initial_plant(vehicle: VehicleParams, soc: float = 0.8, speed_mps: float = 0.0) -> PlantState:
    """A rested, cold car at a speed, its wheels rolling."""
    zero = (0.0, 0.0, 0.0, 0.0)
    wheel = speed_mps / vehicle.front.wheel.radius_m
    return PlantState(
        speed_mps=float(speed_mps),
        wheel_speed_radps=(wheel, wheel, wheel, wheel),
        acceleration_mps2=0.0,
        distance_m=0.0,
        soc=float(soc),
        polarisation_v=0.0,
        heat=zero,
        motor_torque_nm=zero,
        friction_torque_nm=zero,
        electrical_power_w=0.0,
        current_a=0.0,
        terminal_v=float(open_circuit_v(float(soc), vehicle.battery)),
        energies=Energies(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    )


@kernel
def open_circuit_v(soc: float, battery: Battery) -> float:
    """Open-circuit voltage of the pack, V."""
    return battery.cells_in_series * np.interp(soc, battery.ocv_soc, battery.ocv_cell_v)


@kernel
def ohmic_resistance_ohm(soc: float, battery: Battery) -> float:
    """R0 of the pack, ohm: constant above 30 % charge, rising linearly below, by the given factor at 10 %."""
    rise = (battery.ohmic_factor_at_10_percent - 1.0) * max(0.3 - soc, 0.0) / 0.2
    return battery.ohmic_resistance_ohm * (1.0 + rise)


@kernel
def obeyed_torque_nm(
    command_nm: float, wheel_speed_radps: float, speed_mps: float, heat: float, vehicle: VehicleParams
) -> float:
    """What a motor makes of a command: it saturates at its own limits."""
    highest = torque_limit_nm(wheel_speed_radps, heat, vehicle.front.motor)
    lowest = -regeneration_limit_nm(wheel_speed_radps, speed_mps, heat, vehicle.front.motor)
    return min(max(command_nm, lowest), highest)


@kernel
def _brake_part(held_nm: float, brake_nm: float, drag_nm: float) -> float:
    """The friction brake's part of what held a wheel back: a wheel that stops within the step takes less than told."""
    told = brake_nm + drag_nm
    return held_nm * brake_nm / told if told > 0.0 else 0.0


@kernel
def advance(
    state: PlantState,
    motor_command_nm: Four,
    friction_command_nm: Four,
    grade: float,
    friction: Four,
    dt_s: float,
    substeps: int,
    vehicle: VehicleParams,
) -> PlantState:
    """The car after holding a command for a time.

    Parameters
    ----------
    motor_command_nm, friction_command_nm : of each wheel; friction <= 0
    grade : rise over run
    friction : peak friction coefficient under each wheel
    dt_s : how long the command holds
    substeps : implicit steps it is divided into, >= 1
    """
    battery = vehicle.battery
    motor = vehicle.front.motor
    radius = vehicle.front.wheel.radius_m
    m0 = obeyed_torque_nm(motor_command_nm[0], state.wheel_speed_radps[0], state.speed_mps, state.heat[0], vehicle)
    m1 = obeyed_torque_nm(motor_command_nm[1], state.wheel_speed_radps[1], state.speed_mps, state.heat[1], vehicle)
    m2 = obeyed_torque_nm(motor_command_nm[2], state.wheel_speed_radps[2], state.speed_mps, state.heat[2], vehicle)
    m3 = obeyed_torque_nm(motor_command_nm[3], state.wheel_speed_radps[3], state.speed_mps, state.heat[3], vehicle)
    motors = (m0, m1, m2, m3)
    most = vehicle.front.friction_brake.max_torque_nm
    brakes = (
        min(max(-friction_command_nm[0], 0.0), most),
        min(max(-friction_command_nm[1], 0.0), most),
        min(max(-friction_command_nm[2], 0.0), most),
        min(max(-friction_command_nm[3], 0.0), most),
    )

    h = dt_s / substeps
    speed = state.speed_mps
    wheels = state.wheel_speed_radps
    acceleration = state.acceleration_mps2
    distance = state.distance_m
    soc = state.soc
    polarisation = state.polarisation_v
    books = state.energies
    exerted = (0.0, 0.0, 0.0, 0.0)
    power = 0.0
    current = 0.0
    terminal = 0.0
    for _ in range(substeps):
        drags = (
            idle_drag_nm(m0, wheels[0], motor),
            idle_drag_nm(m1, wheels[1], motor),
            idle_drag_nm(m2, wheels[2], motor),
            idle_drag_nm(m3, wheels[3], motor),
        )
        resisting = (brakes[0] + drags[0], brakes[1] + drags[1], brakes[2] + drags[2], brakes[3] + drags[3])
        motion = step(speed, wheels, acceleration, motors, resisting, grade, friction, h, vehicle)
        mean_speed = 0.5 * (speed + motion.speed_mps)

        exerted = (
            _brake_part(motion.resisting_torque_nm[0], brakes[0], drags[0]),
            _brake_part(motion.resisting_torque_nm[1], brakes[1], drags[1]),
            _brake_part(motion.resisting_torque_nm[2], brakes[2], drags[2]),
            _brake_part(motion.resisting_torque_nm[3], brakes[3], drags[3]),
        )
        power = 0.0
        shaft = 0.0
        braked = 0.0
        dragged = 0.0
        slipped = 0.0
        for i in range(4):
            mean_wheel = 0.5 * (wheels[i] + motion.wheel_speed_radps[i])
            power += electrical_power_w(motors[i], mean_wheel, motor)
            shaft += motors[i] * mean_wheel
            braked += exerted[i] * mean_wheel
            dragged += (motion.resisting_torque_nm[i] - exerted[i]) * mean_wheel
            slipped += motion.tyre_force_n[i] * (radius * mean_wheel - mean_speed)

        voltage = open_circuit_v(soc, battery)
        resistance = ohmic_resistance_ohm(soc, battery)
        current = current_a(power, voltage - polarisation, resistance)
        terminal = voltage - polarisation - resistance * current
        soc -= current * h / (3600.0 * battery.capacity_ah)
        # The RC branch exactly, for a current that holds through the step; its loss is what went in and did not stay.
        decay = math.exp(-h / battery.polarisation_time_constant_s)
        full = battery.polarisation_resistance_ohm * current
        after = full + (polarisation - full) * decay
        capacity = 0.0
        if battery.polarisation_resistance_ohm > 0.0:
            capacity = battery.polarisation_time_constant_s / battery.polarisation_resistance_ohm
        stored = 0.5 * capacity * (after * after - polarisation * polarisation)
        entered = polarisation * current * h
        polarisation = after

        books = Energies(
            books.chemical_j + voltage * current * h,
            books.ohmic_j + resistance * current * current * h,
            books.polarisation_j + entered - stored,
            books.motor_loss_j + (power - shaft) * h,
            books.friction_brake_j + braked * h,
            books.idle_drag_j + dragged * h,
            books.tyre_slip_j + slipped * h,
            books.air_j + aerodynamic_force_n(motion.speed_mps, vehicle.chassis) * mean_speed * h,
            books.rolling_j + motion.rolling_force_n * mean_speed * h,
            books.grade_j + grade_force_n(grade, vehicle.chassis) * mean_speed * h,
        )
        acceleration = (motion.speed_mps - speed) / h
        distance += mean_speed * h
        speed = motion.speed_mps
        wheels = motion.wheel_speed_radps

    heat = (
        heat_after(state.heat[0], m0, dt_s, motor),
        heat_after(state.heat[1], m1, dt_s, motor),
        heat_after(state.heat[2], m2, dt_s, motor),
        heat_after(state.heat[3], m3, dt_s, motor),
    )
    return PlantState(
        speed,
        wheels,
        acceleration,
        distance,
        soc,
        polarisation,
        heat,
        motors,
        (-exerted[0], -exerted[1], -exerted[2], -exerted[3]),
        power,
        current,
        terminal,
        books,
    )
