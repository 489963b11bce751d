# SPDX-License-Identifier: Apache-2.0
"""Driver, control law and plant in one process: the simulator node's loop without ROS.

The order within a step is the one the nodes keep in lock-step: sensors, driver, law, plant. The same kernels on the
same numbers give the same bits.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from iwm_power_manager.control import law
from iwm_power_manager.control.settings import Settings
from iwm_power_manager.control.table import PolicyTable
from iwm_power_manager.control.types import Command, ControllerState, Measurement, initial_state
from iwm_power_manager.cycle import Cycle
from iwm_power_manager.jit import kernel
from iwm_power_manager.model.driver import DriverState, Pedals, Trace, drive, sample
from iwm_power_manager.model.limits import battery_limits_w
from iwm_power_manager.model.parameters import VehicleParams
from iwm_power_manager.model.pedals import pedal_power_w
from iwm_power_manager.model.tyre import slip_ratio
from iwm_power_manager.vehicle import Vehicle
from iwm_sim import plant

FloatArray = npt.NDArray[np.float64]

#: Temperature the simulated battery reports, degC. The plant has no thermal model of the pack.
BATTERY_TEMPERATURE_DEGC = 25.0


class Decision(NamedTuple):
    """What only the control law knows of a step; fields as in `control.types.Command`."""

    decided_share: float
    front_share: float
    gate: float
    limits: float
    front_power_w: float
    rear_power_w: float


class Row(NamedTuple):
    """One step of a run, taken at its start; torques, power and acceleration are what the plant did in that step.

    Wheel speeds, torques, slips and heat are those of the left wheel of each axle: on a straight, uniform road left and
    right are alike. Drives where they are not have a `RoadRow` beside it. Units are in the names: `_nm` is N m, `_j` J;
    without one a number has none.

    Attributes
    ----------
    trace_mps, speed_mps : of the cycle, and of the car
    power_demand_w : what the driver asks for at the wheels, braking negative
    accelerator, brake : pedals, 0..1
    decided_share, front_share : front power over power demand, 0..1: as decided, and as applied on the way there
    gate : what is held at zero torque: 0 nothing, 1 front axle, 2 rear axle, 3 both
    limits : what limits the command: a sum of `control.types.LIMIT_NAMES`' bits
    front_power_w, rear_power_w : commanded to the axle at the wheels, motors and brakes together
    front_motor_nm, rear_motor_nm, front_friction_nm, rear_friction_nm : torque of one motor, and of one brake (<= 0)
    front_slip, rear_slip : eq. 10 of the paper, -1 is a locked wheel
    soc : state of charge, 0..1
    electrical_power_w, current_a : drawn from the battery, charging negative
    front_heat, rear_heat : heat index of a motor, 0 cold to 1 hot
    chemical_j : energy drawn from the cells since the start, losses included
    """

    time_s: float
    trace_mps: float
    speed_mps: float
    power_demand_w: float
    accelerator: float
    brake: float
    decided_share: float
    front_share: float
    gate: float
    limits: float
    front_power_w: float
    rear_power_w: float
    front_motor_nm: float
    rear_motor_nm: float
    front_friction_nm: float
    rear_friction_nm: float
    front_wheel_radps: float
    rear_wheel_radps: float
    front_slip: float
    rear_slip: float
    soc: float
    electrical_power_w: float
    current_a: float
    distance_m: float
    acceleration_mps2: float
    front_heat: float
    rear_heat: float
    chemical_j: float


#: Columns of a run's series.
COLUMNS = Row._fields


#: The wheels, in names of columns.
SHORT_WHEEL_NAMES = ("fl", "fr", "rl", "rr")


class RoadRow(NamedTuple):
    """What a step of a drive has beside `Row`: each wheel, and the car in the plane; taken at its start.

    Torques are what motors and brakes really did in the step, forward positive; slips are eq. 10 in the direction of
    travel, braking negative.
    """

    x_m: float
    y_m: float
    heading_rad: float
    lateral_speed_mps: float
    yaw_rate_radps: float
    lateral_acceleration_mps2: float
    steering_wheel_rad: float
    grade: float
    wheel_fl_radps: float
    wheel_fr_radps: float
    wheel_rl_radps: float
    wheel_rr_radps: float
    slip_fl: float
    slip_fr: float
    slip_rl: float
    slip_rr: float
    motor_fl_nm: float
    motor_fr_nm: float
    motor_rl_nm: float
    motor_rr_nm: float
    friction_fl_nm: float
    friction_fr_nm: float
    friction_rl_nm: float
    friction_rr_nm: float
    road_fl: float
    road_fr: float
    road_rl: float
    road_rr: float
    mode: float
    wheels_lost: float
    doubted: float


ROAD_COLUMNS = RoadRow._fields


class Noise(NamedTuple):
    """Errors of sensors and foot, added to each sample; empty arrays mean none.

    Attributes
    ----------
    speed_mps : (n,)
    wheel_radps : (n, 4)
    pedal : (n,), part of the travel of the pedal in use
    """

    speed_mps: FloatArray = np.zeros(0)
    wheel_radps: FloatArray = np.zeros((0, 4))
    pedal: FloatArray = np.zeros(0)


NO_NOISE = Noise()


@dataclass(frozen=True, eq=False)
class Run:
    """A finished run.

    Attributes
    ----------
    series : float64[steps, len(COLUMNS)]
    final : the plant at its end
    road : float64[steps, len(ROAD_COLUMNS)], of a `drive.Drive`: each wheel, and the car in the plane
    """

    dt_s: float
    series: FloatArray
    final: plant.PlantState
    road: FloatArray | None = None

    def __getitem__(self, column: str) -> FloatArray:
        return self.series[:, COLUMNS.index(column)]


def run(
    cycle: Cycle,
    vehicle: Vehicle,
    settings: Settings,
    policy: PolicyTable,
    friction: float,
    *,
    assumed_friction: float | None = None,
    dt_s: float = 0.01,
    substeps: int = 1,
    soc: float = 0.8,
    until_s: float = np.inf,
    noise: Noise = NO_NOISE,
    plant_vehicle: Vehicle | None = None,
    table_of: Callable[[float], PolicyTable] | None = None,
) -> Run:
    """Drive a cycle.

    Parameters
    ----------
    cycle : speed trace
    vehicle : the car the law and the driver believe in
    settings, policy : of the law
    friction : peak friction coefficient of the road
    assumed_friction : what the law is told, if it is something else
    dt_s : control step
    substeps : plant steps in a control step
    soc : state of charge at the start
    until_s : drive only so much of the cycle
    noise : errors of the sensors
    plant_vehicle : the car as it is, if it differs
    table_of : the policy for a friction; with it, the law is told the friction it has estimated, from
        `settings.friction_prior` on, and `policy` and `assumed_friction` do not count
    """
    params = vehicle.params
    truth = params if plant_vehicle is None else plant_vehicle.params
    trace = sample(cycle, dt_s, params.driver.preview_s)
    if until_s < np.inf:
        trace = Trace(*(values[: int(np.floor(until_s / dt_s + 1e-9))] for values in trace))
    series = np.empty((trace.speed_mps.size, len(COLUMNS)))
    start = plant.initial_plant(truth, soc, float(trace.speed_mps[0]))
    told = friction if assumed_friction is None else assumed_friction
    if table_of is not None:
        told = settings.friction_prior
        policy = table_of(told)
    at = Progress(0, start, initial_state(), DriverState(0.0))
    while at.steps < len(series):
        at = _loop(
            trace,
            at,
            settings,
            params,
            truth,
            policy,
            float(friction),
            float(told),
            table_of is not None,
            float(dt_s),
            int(substeps),
            noise,
            series,
        )
        if table_of is not None:
            told = at.controller.friction.assumed
            policy = table_of(told)
    return Run(dt_s, series, at.car)


@kernel
def measure(
    car: plant.PlantState,
    power_demand_w: float,
    dt_s: float,
    friction: float,
    speed_error_mps: float,
    wheel_error_radps: tuple[float, float, float, float],
    vehicle: VehicleParams,
) -> Measurement:
    """What the law is told about the car. State of charge goes through single precision, as in its ROS message."""
    # Back to double precision for numba too, which would compile a law of its own for a single-precision charge.
    soc = np.float64(np.float32(car.soc))
    discharge, charge = battery_limits_w(soc, BATTERY_TEMPERATURE_DEGC, vehicle.battery)
    w = car.wheel_speed_radps
    e = wheel_error_radps
    return Measurement(
        max(car.speed_mps + speed_error_mps, 0.0),
        (max(w[0] + e[0], 0.0), max(w[1] + e[1], 0.0), max(w[2] + e[2], 0.0), max(w[3] + e[3], 0.0)),
        power_demand_w,
        dt_s,
        friction,
        discharge,
        charge,
        soc,
        (1.0, 1.0, 1.0, 1.0),
        1.0,
        (0.0, 0.0, 0.0, 0.0),
        math.nan,
        math.nan,
        math.nan,
        (0.0, 0.0, 0.0, 0.0),
    )


@kernel
def decision_of(command: Command) -> Decision:
    """What a command says of the law's reasons, as numbers of a row."""
    return Decision(
        decided_share=command.decided_share,
        front_share=command.front_share,
        gate=float(command.gate),
        limits=float(command.limits),
        front_power_w=command.front_power_w,
        rear_power_w=command.rear_power_w,
    )


@kernel
def row_of(
    time_s: float,
    trace_mps: float,
    pedals: Pedals,
    decision: Decision,
    before: plant.PlantState,
    after: plant.PlantState,
    vehicle: VehicleParams,
) -> Row:
    """The row of a step from the car before and after it."""
    front, rear = vehicle.front, vehicle.rear
    speed = before.speed_mps
    front_wheel, rear_wheel = before.wheel_speed_radps[0], before.wheel_speed_radps[2]
    return Row(
        time_s=time_s,
        trace_mps=trace_mps,
        speed_mps=speed,
        power_demand_w=pedals.power_demand_w,
        accelerator=pedals.accelerator,
        brake=pedals.brake,
        decided_share=decision.decided_share,
        front_share=decision.front_share,
        gate=decision.gate,
        limits=decision.limits,
        front_power_w=decision.front_power_w,
        rear_power_w=decision.rear_power_w,
        front_motor_nm=after.motor_torque_nm[0],
        rear_motor_nm=after.motor_torque_nm[2],
        front_friction_nm=after.friction_torque_nm[0],
        rear_friction_nm=after.friction_torque_nm[2],
        front_wheel_radps=front_wheel,
        rear_wheel_radps=rear_wheel,
        front_slip=slip_ratio(front_wheel, speed, front.wheel.radius_m, front.tyre.slip_speed_floor_mps),
        rear_slip=slip_ratio(rear_wheel, speed, rear.wheel.radius_m, rear.tyre.slip_speed_floor_mps),
        soc=before.soc,
        electrical_power_w=after.electrical_power_w,
        current_a=after.current_a,
        distance_m=before.distance_m,
        acceleration_mps2=after.acceleration_mps2,
        front_heat=after.heat[0],
        rear_heat=after.heat[2],
        chemical_j=after.energies.chemical_j,
    )


@kernel
def shaken(pedals: Pedals, travel: float, speed_mps: float, vehicle: VehicleParams) -> Pedals:
    """The pedal in use, pressed further by a part of its travel, inside its range."""
    accelerator, brake = pedals.accelerator, pedals.brake
    if brake > 0.0:
        brake = min(max(brake + travel, 0.0), 1.0)
    else:
        accelerator = min(max(accelerator + travel, 0.0), 1.0)
    return Pedals(accelerator, brake, pedal_power_w(accelerator, brake, speed_mps, vehicle))


class Progress(NamedTuple):
    """How far a drive has come: steps taken, and what lives from one to the next."""

    steps: int
    car: plant.PlantState
    controller: ControllerState
    driver: DriverState


@kernel
def _loop(
    trace: Trace,
    at: Progress,
    settings: Settings,
    vehicle: VehicleParams,
    truth: VehicleParams,
    policy: PolicyTable,
    friction: float,
    assumed_friction: float,
    estimated: bool,
    dt_s: float,
    substeps: int,
    noise: Noise,
    series: FloatArray,
) -> Progress:
    """Steps to the end of the trace; or, where the friction is estimated, until another one is to be assumed."""
    road = (friction, friction, friction, friction)
    car, controller, driver = at.car, at.controller, at.driver
    steps = at.steps
    for k in range(at.steps, trace.speed_mps.size):
        speed_error = 0.0
        wheel_error = (0.0, 0.0, 0.0, 0.0)
        if noise.speed_mps.size > 0:
            speed_error = noise.speed_mps[k]
            e = noise.wheel_radps[k]
            wheel_error = (e[0], e[1], e[2], e[3])
        pedals, driver = drive(
            driver,
            car.speed_mps,
            trace.speed_mps[k],
            trace.ahead_mps[k],
            trace.ahead_mps2[k],
            trace.grade[k],
            dt_s,
            vehicle,
        )
        if noise.pedal.size > 0:
            pedals = shaken(pedals, noise.pedal[k], car.speed_mps, vehicle)
        measurement = measure(car, pedals.power_demand_w, dt_s, assumed_friction, speed_error, wheel_error, vehicle)
        command, controller = law.step(measurement, controller, settings, vehicle, policy)
        before = car
        surroundings = plant.Surroundings(road, trace.grade[k], 0.0)
        car = plant.advance(
            car, command.motor_torque_nm, command.friction_torque_nm, 0.0, surroundings, dt_s, substeps, truth
        )
        row = row_of(k * dt_s, trace.speed_mps[k], pedals, decision_of(command), before, car, truth)
        for column in range(len(row)):
            series[k, column] = row[column]
        steps = k + 1
        if estimated and controller.friction.assumed != assumed_friction:
            break
    return Progress(steps, car, controller, driver)
