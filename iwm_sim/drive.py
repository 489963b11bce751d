"""A driver and a car on a cycle, one step at a time.

The closed loop of `closed_loop.run`, cut open where the control law stands: `sense` is what the law may know, `advance`
takes what it commands. The same kernels on the same numbers in the same order give the same bits.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from iwm_power_manager.archive import read_npz
from iwm_power_manager.control.types import Wheels
from iwm_power_manager.cycle import Cycle
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.files import atomic_write
from iwm_power_manager.model.driver import DriverState, Pedals, drive, sample
from iwm_power_manager.model.pedals import full_braking_w
from iwm_power_manager.vehicle import Vehicle
from iwm_sim import plant
from iwm_sim.closed_loop import COLUMNS, Decision, Run, row_of

#: Columns of a run's series that only the control law knows; a drive leaves them empty (NaN).
LAW_COLUMNS = Decision._fields
CAR_COLUMNS = tuple(name for name in COLUMNS if name not in LAW_COLUMNS)
_UNDECIDED = Decision(*(math.nan for _ in LAW_COLUMNS))


class Sensors(NamedTuple):
    """What the car and its driver show at the start of a step.

    Attributes
    ----------
    speed_mps, wheel_speed_radps : of the car and the four wheels
    motor_torque_nm : what the motors really did in the previous step
    power_demand_w : of the driver, braking negative, with the pedals (0..1) it comes from
    soc, battery_voltage_v, battery_current_a : of the battery; current positive when discharging
    """

    speed_mps: float
    wheel_speed_radps: Wheels
    motor_torque_nm: Wheels
    power_demand_w: float
    accelerator: float
    brake: float
    soc: float
    battery_voltage_v: float
    battery_current_a: float


class Drive:
    """A cycle being driven.

    Parameters
    ----------
    vehicle, cycle : the car and its trace
    friction : peak friction coefficient of the road
    initial_soc : state of charge at the start, 0..1
    dt_s : step
    until_s : stop after this much of the cycle

    Attributes
    ----------
    step : steps taken
    car : state of the plant at the start of the next step

    Raises
    ------
    ConfigError
        The cycle is shorter than one step.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        cycle: Cycle,
        *,
        friction: float,
        initial_soc: float,
        dt_s: float,
        until_s: float = math.inf,
        substeps: int = 1,
    ) -> None:
        self.description = f"{vehicle.name} on {cycle.name}, friction {friction:g}, idle drive {vehicle.idle_drive}"
        self._vehicle = vehicle
        self._params = vehicle.params
        self._trace = sample(cycle, dt_s, self._params.driver.preview_s)
        steps = self._trace.speed_mps.size
        if until_s < math.inf:
            steps = min(steps, math.floor(until_s / dt_s + 1e-9))
        if steps < 1:
            raise ConfigError(cycle.path or cycle.name, "time_s", f"lasts no step of {dt_s:g} s", f">= {dt_s:g} s")
        self._road = (friction,) * 4
        self._dt_s = dt_s
        self._substeps = substeps
        self._series = np.full((steps, len(COLUMNS)), np.nan)
        self.car = plant.initial_plant(self._params, initial_soc, float(self._trace.speed_mps[0]))
        self._foot = DriverState(0.0)
        self._pedals: Pedals | None = None
        self.step = 0
        self._warm()

    @property
    def finished(self) -> bool:
        """The end of the cycle is reached."""
        return self.step == len(self._series)

    @property
    def time_s(self) -> float:
        """Time driven."""
        return self.step * self._dt_s

    @property
    def duration_s(self) -> float:
        """Time to drive in all."""
        return len(self._series) * self._dt_s

    @property
    def capacity_ah(self) -> float:
        """Capacity of the battery."""
        return self._params.battery.capacity_ah

    def sense(self) -> Sensors:
        """What the car shows now; the driver looks once a step, however often this is asked."""
        car = self.car
        pedals = self._look()
        return Sensors(
            car.speed_mps,
            car.wheel_speed_radps,
            car.motor_torque_nm,
            pedals.power_demand_w,
            pedals.accelerator,
            pedals.brake,
            car.soc,
            car.terminal_v,
            car.current_a,
        )

    def advance(self, motor_torque_nm: Wheels, friction_torque_nm: Wheels) -> None:
        """Hold a command for one step."""
        pedals = self._look()
        before = self.car
        k = self.step
        self.car = car = plant.advance(
            before,
            motor_torque_nm,
            friction_torque_nm,
            0.0,
            plant.Surroundings(self._road, self._trace.grade[k], 0.0),
            self._dt_s,
            self._substeps,
            self._params,
        )
        self._series[k] = row_of(
            k * self._dt_s, self._trace.speed_mps[k], pedals, _UNDECIDED, before, car, self._params
        )
        self.step += 1
        self._pedals = None

    def pedal_brake_torque_nm(self) -> Wheels:
        """Friction torque of each wheel when the brake pedal works on the brakes directly, N m, <= 0."""
        speed = self.car.speed_mps
        floor = self._params.driver.power_speed_floor_mps
        force_n = self._look().brake * full_braking_w(speed, self._params) / max(speed, floor)
        return (-force_n * self._params.front.wheel.radius_m / 4.0,) * 4

    def run(self) -> Run:
        """What has been driven so far."""
        return Run(self._dt_s, self._series[: self.step].copy(), self.car)

    def summary(self) -> str:
        """Distance and energy so far, in words."""
        distance_km = self.car.distance_m / 1000.0
        energy_wh = self.car.energies.chemical_j / 3600.0
        per_km = f"{energy_wh / distance_km:.2f} Wh/km" if distance_km > 0.0 else "no distance"
        return f"{distance_km:.3f} km, {per_km}, state of charge {100.0 * self.car.soc:.2f} %"

    def _look(self) -> Pedals:
        if self._pedals is None:
            k = self.step
            trace = self._trace
            self._pedals, self._foot = drive(
                self._foot,
                self.car.speed_mps,
                trace.speed_mps[k],
                trace.ahead_mps[k],
                trace.ahead_mps2[k],
                trace.grade[k],
                self._dt_s,
                self._params,
            )
        return self._pedals

    def _warm(self) -> None:
        """Compile every kernel now and not in the first steps."""
        state, foot = self.car, self._foot
        none = (0.0, 0.0, 0.0, 0.0)
        self.sense()
        self.advance(none, self.pedal_brake_torque_nm())
        self.car, self._foot, self._pedals, self.step = state, foot, None, 0


def save_run(path: Path | str, run: Run, notes: Mapping[str, Any] | None = None) -> None:
    """Write a run as .npz, atomically, with notes that JSON can hold; `ConfigError` if the folder cannot be written."""
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        columns=np.array(COLUMNS),
        dt_s=np.float64(run.dt_s),
        series=run.series,
        final=np.array(_leaves(run.final)),
        notes=np.array(json.dumps(dict(notes or {}))),
    )
    atomic_write(path, buffer.getvalue())


def load_run(path: Path | str) -> tuple[Run, dict[str, Any]]:
    """Read the run and the notes that `save_run` wrote; `ConfigError` if the file is something else."""
    content = read_npz(path, ("columns", "dt_s", "series", "final", "notes"), "recorded run")
    try:
        if tuple(content["columns"]) != COLUMNS:
            raise ConfigError(path, "columns", "are those of another version", ", ".join(COLUMNS))
        leaves = iter(content["final"].tolist())
        run = Run(float(content["dt_s"]), content["series"], _rebuild(plant.PlantState, leaves))
        return run, json.loads(str(content["notes"]))
    except (KeyError, TypeError, ValueError, StopIteration, RecursionError):
        raise ConfigError(path, "", "is no recorded run") from None


def _leaves(value: Any) -> list[float]:
    if isinstance(value, tuple):
        return [leaf for part in value for leaf in _leaves(part)]
    return [float(value)]


def _rebuild(kind: type[plant.PlantState], leaves: Any) -> plant.PlantState:
    fields: dict[str, Any] = {}
    for name in kind._fields:
        if name == "energies":
            fields[name] = plant.Energies(*(next(leaves) for _ in plant.Energies._fields))
        elif name in plant.OF_WHEELS:
            fields[name] = tuple(next(leaves) for _ in range(4))
        else:
            fields[name] = next(leaves)
    return kind(**fields)
