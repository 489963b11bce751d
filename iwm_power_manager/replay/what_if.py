# SPDX-License-Identifier: Apache-2.0
"""What another split, or another car, would have consumed on a recorded drive: an open-loop estimate.

Speed and wheel speeds stay as recorded; only the torques and their losses are computed anew. Strategies are compared at
the same force on the car, step by step: a motor that idles drags, and what that takes away the driver would have asked
for again, which the recorded demand does not. So the difference goes to the motors that work, in proportion. What the
estimate cannot tell is how the motion would have changed: slip that another split would have caused or avoided, a
driver's reaction to power that was not delivered, another mass.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

from iwm_power_manager.bags.reader import BagReader
from iwm_power_manager.control.record import DECIDED, command_of, measurement_of
from iwm_power_manager.control.types import Measurement, Wheels
from iwm_power_manager.errors import BagError, NoAnswerError
from iwm_power_manager.model.battery import chemical_power_w
from iwm_power_manager.model.motor import electrical_power_w, idle_drag_nm, regeneration_limit_nm, torque_limit_nm
from iwm_power_manager.model.parameters import Axle, VehicleParams
from iwm_power_manager.replay.compare import ReplayReport
from iwm_power_manager.replay.plan import Plan
from iwm_power_manager.replay.run import Replay

_S_PER_H = 3600.0
#: Difference of the work at the wheels, by the energy taken, below which two drives are the same.
_SAME_WORK = 0.001
_LEAST_DISTANCE_M = 1.0


@dataclass
class Consumption:
    """What one strategy would have consumed, added up step by step.

    Attributes
    ----------
    label : the strategy, or "recorded"
    distance_m : driven
    chemical_wh : taken out of the cells, battery losses included
    electrical_wh : drawn by the motors at the battery's terminals
    wheel_work_wh : work of motors, brakes and idle drag at the wheels
    friction_wh : of that, turned into heat by the friction brakes
    idle_drag_wh : of that, dragged by idle motors
    steps, step_s : control steps, and their mean length
    friction : least and greatest that the law assumed
    """

    label: str
    distance_m: float = 0.0
    chemical_wh: float = 0.0
    electrical_wh: float = 0.0
    wheel_work_wh: float = 0.0
    friction_wh: float = 0.0
    idle_drag_wh: float = 0.0
    steps: int = 0
    step_s: float = 0.0
    friction: tuple[float, float] = (math.inf, -math.inf)

    def add(self, vehicle: VehicleParams, measurement: Measurement, motor_nm: Wheels, brake_nm: Wheels) -> None:
        """One step with these torques."""
        hours = measurement.dt_s / _S_PER_H
        electrical = 0.0
        for wheel, speed in enumerate(measurement.wheel_speed_radps):
            motor, torque = _axle(vehicle, wheel).motor, motor_nm[wheel]
            electrical += electrical_power_w(torque, speed, motor)
            drag = idle_drag_nm(torque, speed, motor) * speed * hours
            self.idle_drag_wh += drag
            self.friction_wh += brake_nm[wheel] * speed * hours
            self.wheel_work_wh += (torque + brake_nm[wheel]) * speed * hours - drag
        self.distance_m += abs(measurement.speed_mps) * measurement.dt_s
        self.chemical_wh += chemical_power_w(electrical, vehicle.battery) * hours
        self.electrical_wh += electrical * hours
        self.steps += 1
        self.step_s += (measurement.dt_s - self.step_s) / self.steps
        self.friction = min(self.friction[0], measurement.friction), max(self.friction[1], measurement.friction)

    @property
    def wh_per_km(self) -> float:
        """Chemical energy by distance."""
        return 1000.0 * self.chemical_wh / self.distance_m

    def saving_percent(self, reference: Consumption) -> float | None:
        """Less than the reference took; None where the work at the wheels is not the same."""
        if abs(self.wheel_work_wh - reference.wheel_work_wh) > _SAME_WORK * abs(reference.chemical_wh):
            return None
        return 100.0 * (1.0 - self.chemical_wh / reference.chemical_wh)


def what_if(
    bag: BagReader, plans: Sequence[tuple[str, Plan]], progress: Callable[[int, int], None] | None = None
) -> tuple[list[Consumption], ReplayReport]:
    """Consumption of the recorded commands, where the bag has them, and of each plan, at the force of the first.

    The report is that of the last plan: what it says of the bag is the same for all.

    Parameters
    ----------
    plans : label and plan of each strategy, all with the same vehicle

    Raises
    ------
    BagError
        The bag gives no step, or the car does not move (then `NoAnswerError`).
    """
    vehicle = plans[0][1].vehicle.params
    forces_n: dict[tuple[int, int], float] = {}  # by stamp, and how often it came: a clock may be set back
    rows: list[Consumption] = []
    for label, plan in plans:
        replay = Replay(bag, plan)
        recorded = Consumption("recorded") if replay.exact and not rows else None
        row, seen = Consumption(label), Counter[int]()
        for _, steps in replay.steps(progress):
            for step in steps:
                measurement = measurement_of(step.values)
                key = step.stamp_ns, seen[step.stamp_ns]
                seen[step.stamp_ns] += 1
                if recorded is not None:
                    with suppress(ValueError, OverflowError):  # numbers that are no command: the comparison shows them
                        was = command_of(step.recorded[DECIDED])
                        torques = measurement, was.motor_torque_nm, was.friction_torque_nm
                        forces_n[key] = force_n(vehicle, *torques)
                        recorded.add(vehicle, *torques)
                motor_nm, brake_nm = step.command.motor_torque_nm, step.command.friction_torque_nm
                wanted_n = forces_n.setdefault(key, force_n(vehicle, measurement, motor_nm, brake_nm))
                row.add(vehicle, measurement, at_force(vehicle, measurement, motor_nm, brake_nm, wanted_n), brake_nm)
        report = replay.report()
        if not report.steps:
            raise BagError(f"{bag.path}: gave no control step: {replay.why_no_step()}")
        rows += [row] if recorded is None else [recorded, row]
    if rows[0].distance_m < _LEAST_DISTANCE_M or rows[0].chemical_wh == 0.0:
        raise NoAnswerError(
            f"{bag.path}: the car does not move ({rows[0].distance_m:.2f} m): there is nothing to compare"
            + "".join(f"; {note}" for note in report.notes)
        )
    return rows, report


def force_n(vehicle: VehicleParams, measurement: Measurement, motor_nm: Wheels, brake_nm: Wheels) -> float:
    """Force of all wheels on the car, drag of idle motors taken off, N."""
    force = 0.0
    for wheel, (torque, brake) in enumerate(zip(motor_nm, brake_nm, strict=True)):
        axle = _axle(vehicle, wheel)
        drag = idle_drag_nm(torque, measurement.wheel_speed_radps[wheel], axle.motor)
        force += (torque + brake - drag) / axle.wheel.radius_m
    return force


def at_force(
    vehicle: VehicleParams, measurement: Measurement, motor_nm: Wheels, brake_nm: Wheels, wanted_n: float
) -> Wheels:
    """Motor torques that give this force, N m.

    The working motors take what is missing, in proportion, as far as they can.
    """
    missing_n = wanted_n - force_n(vehicle, measurement, motor_nm, brake_nm)
    total = sum(map(abs, motor_nm))
    if not total or not missing_n:
        return motor_nm
    torques = []
    for wheel, torque in enumerate(motor_nm):
        axle, speed = _axle(vehicle, wheel), measurement.wheel_speed_radps[wheel]
        wanted = torque + missing_n * axle.wheel.radius_m * abs(torque) / total
        drive = max(torque_limit_nm(speed, 0.0, axle.motor), torque)
        regenerate = max(regeneration_limit_nm(speed, measurement.speed_mps, 0.0, axle.motor), -torque)
        torques.append(min(max(wanted, -regenerate), drive))
    return torques[0], torques[1], torques[2], torques[3]


def _axle(vehicle: VehicleParams, wheel: int) -> Axle:
    return vehicle.front if wheel < 2 else vehicle.rear
