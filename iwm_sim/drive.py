# SPDX-License-Identifier: Apache-2.0
"""A driver and a car in a scenario, one step at a time.

The closed loop of `closed_loop.run`, cut open where the control law stands: `sense` is what the law may know, `advance`
takes what it commands. The same kernels on the same numbers in the same order give the same bits.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from iwm_power_manager.archive import read_npz
from iwm_power_manager.control.types import Wheels
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.files import atomic_write
from iwm_power_manager.model.chassis import GRAVITY_MPS2
from iwm_power_manager.model.driver import DriverState, Pedals, Trace, drive, sample
from iwm_power_manager.model.parameters import VehicleParams
from iwm_power_manager.model.pedals import full_braking_w, pedal_power_w
from iwm_power_manager.model.tyre import slip_ratio
from iwm_sim import double_track, plant
from iwm_sim.closed_loop import COLUMNS, ROAD_COLUMNS, SHORT_WHEEL_NAMES, Decision, RoadRow, Run, row_of
from iwm_sim.faults import Faults
from iwm_sim.scenario import Scenario
from iwm_sim.steering import LaneKeeper

#: Columns of a run's series that only the control law knows; a drive leaves them empty (NaN).
LAW_COLUMNS = Decision._fields
CAR_COLUMNS = tuple(name for name in COLUMNS if name not in LAW_COLUMNS)
#: Front axle's part of what brakes of another system do.
FOREIGN_FRONT = 0.7
#: Nothing is known of what the law thought.
UNDECIDED = Decision(*(math.nan for _ in LAW_COLUMNS))


class Sensors(NamedTuple):
    """What the car and its driver show at the start of a step, faults of the sensors included (NaN: nothing).

    Attributes
    ----------
    speed_mps, wheel_speed_radps : of the car and the four wheels, negative backwards
    motor_torque_nm, friction_torque_nm : what motors and brakes really did in the previous step
    power_demand_w : of the driver, braking negative, with the pedals (0..1) it comes from
    soc, battery_voltage_v, battery_current_a : of the battery; current positive when discharging
    acceleration_mps2, lateral_acceleration_mps2 : of an accelerometer on the body, the slope's part included
    yaw_rate_radps, steering_wheel_rad : positive to the left
    direction : the driver asks for: 1 forward, -1 reverse
    """

    speed_mps: float
    wheel_speed_radps: Wheels
    motor_torque_nm: Wheels
    friction_torque_nm: Wheels
    power_demand_w: float
    accelerator: float
    brake: float
    soc: float
    battery_voltage_v: float
    battery_current_a: float
    acceleration_mps2: float
    lateral_acceleration_mps2: float
    yaw_rate_radps: float
    steering_wheel_rad: float
    direction: int


class Drive:
    """A scenario being driven.

    Parameters
    ----------
    scenario : the car, what is driven, the road, and what fails
    dt_s : step

    Attributes
    ----------
    step : steps taken
    car : state of the plant at the start of the next step

    Raises
    ------
    ConfigError
        It is shorter than one step.
    """

    def __init__(self, scenario: Scenario, *, dt_s: float, substeps: int = 1) -> None:
        self.scenario = scenario
        self.description = scenario.described or scenario.name
        self._believed = scenario.vehicle.params
        self._params = scenario.truth
        steps = math.floor(scenario.duration_s / dt_s + 1e-9)
        self._trace: Trace | None = None
        if scenario.cycle is not None:
            self._trace = sample(scenario.cycle, dt_s, self._believed.driver.preview_s)
            steps = min(steps, self._trace.speed_mps.size)
        if steps < 1:
            where = (scenario.cycle.path or scenario.cycle.name) if scenario.cycle else scenario.path
            key = "time_s" if scenario.cycle else "until.time_s"
            raise ConfigError(where, key, f"lasts no step of {dt_s:g} s", f">= {dt_s:g} s")
        self._dt_s = dt_s
        self._substeps = substeps
        self._series = np.full((steps, len(COLUMNS)), np.nan)
        self._road_series = np.full((steps, len(ROAD_COLUMNS)), np.nan)
        self._faults = Faults(scenario.faults, dt_s)
        self._hands = LaneKeeper(self._believed, dt_s) if scenario.steering is None else None
        self.car = plant.initial_plant(self._params, scenario.soc, scenario.speed_mps)
        self._driver = DriverState(0.0)
        self._pedals: Pedals | None = None
        self.step = 0
        self._warm()

    @property
    def finished(self) -> bool:
        """The end of the scenario is reached."""
        return self.step == len(self._series) or (
            self.scenario.to_standstill
            and self.step > 0
            and self.car.speed_mps == 0.0
            and self._look().power_demand_w < 0.0
        )

    @property
    def time_s(self) -> float:
        """Time driven."""
        return self.step * self._dt_s

    @property
    def duration_s(self) -> float:
        """Time to drive in all, at most."""
        return len(self._series) * self._dt_s

    @property
    def capacity_ah(self) -> float:
        """Capacity of the battery."""
        return self._params.battery.capacity_ah

    @property
    def steering_wheel_rad(self) -> float:
        """Angle of the steering wheel in this step."""
        if self._hands is not None:
            return self._hands.angle_rad
        return self._at(self.scenario.steering or (), self.time_s)

    @property
    def grade(self) -> float:
        """Rise over run where the car is."""
        if self._trace is not None and self.scenario.cycle is not None and self.scenario.grade == ((0.0, 0.0),):
            return float(self._trace.grade[self.step])
        return self._at(self.scenario.grade, self.car.x_m)

    @property
    def friction(self) -> Wheels:
        """Peak friction under each wheel."""
        road = self.scenario.friction
        if len(road) == 1 and road[0].left == road[0].right:
            return (road[0].left,) * 4
        cosine, sine = math.cos(self.car.heading_rad), math.sin(self.car.heading_rad)
        forward, left = double_track.wheel_places_m(self._params)
        values = []
        for x, y in zip(forward, left, strict=True):
            along = self.car.x_m + cosine * x - sine * y
            across = self.car.y_m + sine * x + cosine * y
            patch = next((patch for patch in reversed(road) if patch.from_m <= along), road[0])
            values.append(patch.left if across >= 0.0 else patch.right)
        a, b, c, d = values
        return a, b, c, d

    def arriving(self, message: str, sensors: Sensors, now_ns: int) -> Iterable[tuple[int, Sensors]]:
        """What arrives of a message, by the name of its topic, in this step, oldest first, each with its stamp.

        Parameters
        ----------
        sensors : what is shown now
        now_ns : the time, as stamps are written
        """
        return self._faults.arriving(message, sensors, self.time_s, now_ns)

    def sense(self) -> Sensors:
        """What the car shows now; the driver looks once a step, however often this is asked."""
        car = self.car
        pedals = self._look()
        grade = self.grade
        return Sensors(
            speed_mps=self._faults.speed(car.speed_mps, self.time_s),
            wheel_speed_radps=self._faults.wheels(car.wheel_speed_radps, self.time_s),
            motor_torque_nm=car.motor_torque_nm,
            friction_torque_nm=car.friction_torque_nm,
            power_demand_w=pedals.power_demand_w,
            accelerator=pedals.accelerator,
            brake=pedals.brake,
            soc=car.soc,
            battery_voltage_v=car.terminal_v,
            battery_current_a=car.current_a,
            acceleration_mps2=car.acceleration_mps2 + GRAVITY_MPS2 * grade / math.sqrt(1.0 + grade * grade),
            lateral_acceleration_mps2=car.lateral_acceleration_mps2,
            yaw_rate_radps=car.yaw_rate_radps,
            steering_wheel_rad=self.steering_wheel_rad,
            direction=self.scenario.direction,
        )

    def advance(
        self,
        motor_torque_nm: Wheels,
        friction_torque_nm: Wheels,
        decision: Decision = UNDECIDED,
        mode: float = math.nan,
        wheels_lost: float = math.nan,
        doubted: float = math.nan,
    ) -> None:
        """Hold a command for one step.

        Parameters
        ----------
        motor_torque_nm, friction_torque_nm : what is commanded; actuators that fail do something else
        decision, mode, wheels_lost, doubted : for the series, what the power manager says of itself
        """
        pedals = self._look()
        before = self.car
        k = self.step
        time_s = self.time_s
        grade = self.grade
        road = self.friction
        steering = self._hands.steer(before) if self._hands is not None else self.steering_wheel_rad
        self.car = car = plant.advance(
            before,
            self._faults.motors(motor_torque_nm, time_s),
            self._faults.brakes(self._foreign_nm() if self.scenario.foreign_brakes else friction_torque_nm, time_s),
            steering / self._params.chassis.steering_ratio,
            plant.Surroundings(road, grade, self.scenario.headwind_mps),
            self._dt_s,
            self._substeps,
            self._params,
        )
        trace_mps = math.nan if self._trace is None else float(self._trace.speed_mps[k])
        self._series[k] = row_of(k * self._dt_s, trace_mps, pedals, decision, before, car, self._params)
        self._road_series[k] = _road_row(before, car, steering, grade, road, mode, wheels_lost, doubted, self._params)
        self.step += 1
        self._pedals = None

    def pedal_brake_torque_nm(self) -> Wheels:
        """Friction torque of each wheel when the brake pedal works on the brakes directly, N m, <= 0."""
        speed = self.car.speed_mps
        floor = self._params.driver.power_speed_floor_mps
        force_n = self._look().brake * full_braking_w(speed, self._params) / max(speed, floor)
        front = -force_n * self._params.front.wheel.radius_m / 4.0
        rear = -force_n * self._params.rear.wheel.radius_m / 4.0
        return front, front, rear, rear

    def _foreign_nm(self) -> Wheels:
        """Friction torque of each wheel by the brakes of another system, most of it in front as in most cars."""
        force_n = self._at(self.scenario.foreign_brakes, self.time_s) * self._believed.chassis.mass_kg
        front = -0.5 * FOREIGN_FRONT * force_n * self._believed.front.wheel.radius_m
        rear = -0.5 * (1.0 - FOREIGN_FRONT) * force_n * self._believed.rear.wheel.radius_m
        return front, front, rear, rear

    def run(self) -> Run:
        """What has been driven so far."""
        return Run(self._dt_s, self._series[: self.step].copy(), self.car, self._road_series[: self.step].copy())

    def summary(self) -> str:
        """Distance and energy so far, in words."""
        distance_km = self.car.distance_m / 1000.0
        energy_wh = self.car.energies.chemical_j / 3600.0
        per_km = f"{energy_wh / distance_km:.2f} Wh/km" if distance_km > 0.0 else "no distance"
        return f"{distance_km:.3f} km, {per_km}, state of charge {100.0 * self.car.soc:.2f} %"

    @staticmethod
    def _at(values: Sequence[tuple[float, float]], place: float) -> float:
        """The value that holds at a time or place: that of the last entry before it, 0 before the first of several."""
        if len(values) == 1:
            return values[0][1] if place >= values[0][0] or values[0][0] == 0.0 else 0.0
        return next((value for start, value in reversed(values) if start <= place), 0.0)

    def _look(self) -> Pedals:
        if self._pedals is None:
            self._pedals = self._followed() if self._trace is not None else self._asked()
        return self._pedals

    def _followed(self) -> Pedals:
        """What the driver does who follows the trace."""
        k, trace = self.step, self._trace
        assert trace is not None
        pedals, self._driver = drive(
            self._driver,
            self.car.speed_mps,
            trace.speed_mps[k],
            trace.ahead_mps[k],
            trace.ahead_mps2[k],
            self.grade,
            self._dt_s,
            self._believed,
        )
        return pedals

    def _asked(self) -> Pedals:
        """What the scenario says the driver does, whichever way the car rolls."""
        speed = abs(self.car.speed_mps)
        asked = next((entry for entry in reversed(self.scenario.demand) if entry.from_s <= self.time_s + 1e-9), None)
        if asked is None:
            return Pedals(0.0, 0.0, 0.0)
        value = asked.value
        if asked.kind == "accelerator":
            return Pedals(value, 0.0, pedal_power_w(value, 0.0, speed, self._believed))
        if asked.kind == "brake":
            return Pedals(0.0, value, pedal_power_w(0.0, value, speed, self._believed))
        if asked.kind == "power_w":
            return Pedals(0.0, 0.0, value)
        rolling = max(speed, self._believed.driver.power_speed_floor_mps)
        return Pedals(0.0, 0.0, -value * self._believed.chassis.mass_kg * rolling)

    def _warm(self) -> None:
        """Compile every kernel now and not in the first steps."""
        state, driver, hands = self.car, self._driver, self._hands
        none = (0.0, 0.0, 0.0, 0.0)
        self._hands = None if hands is None else LaneKeeper(self._believed, self._dt_s)
        self.sense()
        self.advance(none, self.pedal_brake_torque_nm())
        self.car, self._driver, self._hands, self._pedals, self.step = state, driver, hands, None, 0
        self._faults = Faults(self.scenario.faults, self._dt_s)


def _road_row(
    before: plant.PlantState,
    after: plant.PlantState,
    steering_wheel_rad: float,
    grade: float,
    road: Wheels,
    mode: float,
    wheels_lost: float,
    doubted: float,
    vehicle: VehicleParams,
) -> RoadRow:
    """The row of a step from the car before and after it."""
    ways = -1.0 if before.speed_mps < 0.0 else 1.0
    names = SHORT_WHEEL_NAMES
    slips = [
        slip_ratio(ways * w, abs(before.speed_mps), axle.wheel.radius_m, axle.tyre.slip_speed_floor_mps)
        for w, axle in zip(
            before.wheel_speed_radps, (vehicle.front, vehicle.front, vehicle.rear, vehicle.rear), strict=True
        )
    ]
    return RoadRow(
        x_m=before.x_m,
        y_m=before.y_m,
        heading_rad=before.heading_rad,
        lateral_speed_mps=before.lateral_speed_mps,
        yaw_rate_radps=before.yaw_rate_radps,
        lateral_acceleration_mps2=after.lateral_acceleration_mps2,
        steering_wheel_rad=steering_wheel_rad,
        grade=grade,
        **{f"wheel_{n}_radps": x for n, x in zip(names, before.wheel_speed_radps, strict=True)},
        **{f"slip_{n}": x for n, x in zip(names, slips, strict=True)},
        **{f"motor_{n}_nm": x for n, x in zip(names, after.motor_torque_nm, strict=True)},
        **{f"friction_{n}_nm": x for n, x in zip(names, after.friction_torque_nm, strict=True)},
        **{f"road_{n}": x for n, x in zip(names, road, strict=True)},
        mode=mode,
        wheels_lost=wheels_lost,
        doubted=doubted,
    )


def save_run(path: Path | str, run: Run, notes: Mapping[str, Any] | None = None) -> None:
    """Write a run as .npz, atomically, with notes that JSON can hold; `ConfigError` if the folder cannot be written."""
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        columns=np.array(COLUMNS),
        dt_s=np.float64(run.dt_s),
        series=run.series,
        road=np.zeros((0, 0)) if run.road is None else run.road,
        final=np.array(json.dumps(run.final)),
        notes=np.array(json.dumps(dict(notes or {}))),
    )
    atomic_write(path, buffer.getvalue())


def load_run(path: Path | str) -> tuple[Run, dict[str, Any]]:
    """Read the run and the notes that `save_run` wrote; `ConfigError` if the file is something else."""
    content = read_npz(path, ("columns", "dt_s", "series", "road", "final", "notes"), "recorded run")
    try:
        if tuple(content["columns"]) != COLUMNS:
            raise ConfigError(path, "columns", "are those of another version", ", ".join(COLUMNS))
        final: list[Any] = [tuple(v) if isinstance(v, list) else v for v in json.loads(str(content["final"]))]
        car = plant.PlantState(*final)
        car = car._replace(energies=plant.Energies(*car.energies))
        road = content["road"] if content["road"].size else None
        run = Run(float(content["dt_s"]), content["series"], car, road)
        return run, json.loads(str(content["notes"]))
    except (KeyError, TypeError, ValueError, RecursionError):
        raise ConfigError(path, "", "is no recorded run") from None
