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
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from iwm_power_manager.bags.reader import BagReader
from iwm_power_manager.control.record import DECIDED, command_of, completed, measurement_of
from iwm_power_manager.control.types import Measurement, Wheels
from iwm_power_manager.errors import BagError
from iwm_power_manager.model.battery import chemical_power_w
from iwm_power_manager.model.motor import electrical_power_w, idle_drag_nm, regeneration_limit_nm, torque_limit_nm
from iwm_power_manager.model.parameters import Axle, VehicleParams
from iwm_power_manager.replay.plan import Plan
from iwm_power_manager.replay.run import Replay, state_topic
from iwm_power_manager.signals.cdr import UnreadableError
from iwm_power_manager.signals.contract import WHEEL_NAMES
from iwm_power_manager.signals.readings import joint_state_reader

_J_PER_WH = 3600.0
#: Difference of the work at the wheels, by the energy taken, below which two drives are the same.
_SAME_WORK = 0.001
_LEAST_DISTANCE_M = 1.0


class Consumption(NamedTuple):
    """What one strategy would have consumed.

    Attributes
    ----------
    label : the strategy, or "recorded"
    distance_m : driven
    chemical_wh : taken out of the cells, battery losses included
    electrical_wh : drawn by the motors at the battery's terminals
    wheel_work_wh : work of motors, brakes and idle drag at the wheels
    friction_wh : of that, turned into heat by the friction brakes
    idle_drag_wh : of that, dragged by idle motors
    step_s : mean length of a control step
    friction : least and greatest that the law assumed
    """

    label: str
    distance_m: float
    chemical_wh: float
    electrical_wh: float
    wheel_work_wh: float
    friction_wh: float
    idle_drag_wh: float
    step_s: float
    friction: tuple[float, float]

    @property
    def wh_per_km(self) -> float:
        """Chemical energy by distance."""
        return 1000.0 * self.chemical_wh / self.distance_m

    def saving_percent(self, reference: Consumption) -> float | None:
        """Less than the reference took; None where the work at the wheels is not the same."""
        if abs(self.wheel_work_wh - reference.wheel_work_wh) > _SAME_WORK * abs(reference.chemical_wh):
            return None
        return 100.0 * (1.0 - self.chemical_wh / reference.chemical_wh)


class EnergyMeter:
    """Adds up what motors and battery of a car do, step by step."""

    def __init__(self, label: str, vehicle: VehicleParams) -> None:
        self._label = label
        self._vehicle = vehicle
        self._distance_m = self._time_s = 0.0
        self._steps = 0
        self._friction = (math.inf, -math.inf)
        self._joules = [0.0] * 5

    def add(self, measurement: Measurement, motor_torque_nm: Wheels, friction_torque_nm: Wheels) -> None:
        """One step with these torques."""
        dt_s = measurement.dt_s
        electrical = work = friction = drag = 0.0
        for wheel in range(len(WHEEL_NAMES)):
            speed, torque, brake = (
                measurement.wheel_speed_radps[wheel],
                motor_torque_nm[wheel],
                friction_torque_nm[wheel],
            )
            motor = _axle(self._vehicle, wheel).motor
            electrical += electrical_power_w(torque, speed, motor)
            dragging = idle_drag_nm(torque, speed, motor) * speed
            drag += dragging
            friction += brake * speed
            work += (torque + brake) * speed - dragging
        chemical = chemical_power_w(electrical, self._vehicle.battery)
        self._distance_m += measurement.speed_mps * dt_s
        self._time_s += dt_s
        self._steps += 1
        self._friction = min(self._friction[0], measurement.friction), max(self._friction[1], measurement.friction)
        for i, power in enumerate((chemical, electrical, work, friction, drag)):
            self._joules[i] += power * dt_s

    def result(self) -> Consumption:
        """The sums so far."""
        step_s = self._time_s / max(self._steps, 1)
        wh = [joules / _J_PER_WH for joules in self._joules]
        return Consumption._make((self._label, self._distance_m, *wh, step_s, self._friction))


def what_if(
    bag: BagReader,
    plans: Sequence[tuple[str, Plan]],
    progress: Callable[[int, int], None] | None = None,
) -> list[Consumption]:
    """Consumption of the recorded commands, where the bag has them, and of each plan, at the force of the first.

    Parameters
    ----------
    plans : label and plan of each strategy, all with the same vehicle

    Raises
    ------
    BagError
        The bag gives no step, or the car does not move.
    """
    vehicle = plans[0][1].vehicle.params
    forces_n: dict[int, float] = {}
    results = []
    state = state_topic(bag)
    if state is not None and Replay(bag, plans[0][1]).exact:
        meter = EnergyMeter("recorded", vehicle)
        for stamp_ns, step in _recorded_steps(bag, state):
            forces_n[stamp_ns] = force_n(vehicle, *step)
            meter.add(*step)
        results.append(meter.result())
    for label, plan in plans:
        meter = EnergyMeter(label, vehicle)
        replay = Replay(bag, plan)
        first = not results
        for _, steps in replay.steps(progress):
            for done in steps:
                measurement = measurement_of(done.values)
                torques, brakes = done.command.motor_torque_nm, done.command.friction_torque_nm
                if first:
                    forces_n[done.stamp_ns] = force_n(vehicle, measurement, torques, brakes)
                elif (wanted_n := forces_n.get(done.stamp_ns)) is not None:
                    torques = at_force(vehicle, measurement, torques, brakes, wanted_n)
                meter.add(measurement, torques, brakes)
        if not replay.report().steps:
            raise BagError(f"{bag.path}: gave no control step: {replay.why_no_step()}")
        results.append(meter.result())
    if results[0].distance_m < _LEAST_DISTANCE_M or results[0].chemical_wh == 0.0:
        raise BagError(
            f"{bag.path}: the car does not move ({results[0].distance_m:.2f} m): there is nothing to compare"
        )
    return results


def _recorded_steps(bag: BagReader, state: str) -> Iterator[tuple[int, tuple[Measurement, Wheels, Wheels]]]:
    """What the law took in each recorded step, and what it commanded."""
    decode = joint_state_reader("position")
    for message in bag.messages():
        if message.topic == state:
            try:
                recorded = decode(message.data)
                values = completed(recorded.names, recorded.values)
                command = command_of(values[DECIDED])
            except (UnreadableError, KeyError, ValueError, OverflowError):
                continue  # the replay counts it
            yield recorded.stamp_ns, (measurement_of(values), command.motor_torque_nm, command.friction_torque_nm)


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
