"""What another split, or another car, would have consumed on a recorded drive: an open-loop estimate.

Speed, wheel speeds and demand stay as recorded; only the torques and their losses are computed anew. So it tells what
motors and battery would have drawn for the same motion. It cannot tell how the motion would have changed: slip that
another split would have caused or avoided, a driver's reaction to power that was not delivered, another mass.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from iwm_power_manager.bags.reader import BagReader
from iwm_power_manager.control.record import SIGNAL_NAMES, from_numbers
from iwm_power_manager.control.types import Measurement, Wheels
from iwm_power_manager.model.battery import chemical_power_w
from iwm_power_manager.model.motor import electrical_power_w, idle_drag_nm
from iwm_power_manager.model.parameters import VehicleParams
from iwm_power_manager.replay.plan import Plan
from iwm_power_manager.replay.run import STATE, Replay
from iwm_power_manager.signals.contract import WHEEL_NAMES
from iwm_power_manager.signals.mapping import SignalMapping, topic_named
from iwm_power_manager.signals.readings import joint_state_reader

_J_PER_WH = 3600.0


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
    """

    label: str
    distance_m: float
    chemical_wh: float
    electrical_wh: float
    wheel_work_wh: float
    friction_wh: float
    idle_drag_wh: float

    @property
    def wh_per_km(self) -> float:
        """Chemical energy by distance; NaN for a car that stood."""
        return 1000.0 * self.chemical_wh / self.distance_m if self.distance_m else float("nan")


class EnergyMeter:
    """Adds up what motors and battery of a car do, step by step."""

    def __init__(self, label: str, vehicle: VehicleParams) -> None:
        self._label = label
        self._vehicle = vehicle
        self._distance_m = 0.0
        self._joules = [0.0] * 5

    def add(self, measurement: Measurement, motor_torque_nm: Wheels, friction_torque_nm: Wheels) -> None:
        """One step with these torques."""
        motor, dt_s = self._vehicle.front.motor, measurement.dt_s
        electrical = work = friction = drag = 0.0
        for speed, torque, brake in zip(
            measurement.wheel_speed_radps, motor_torque_nm, friction_torque_nm, strict=True
        ):
            electrical += electrical_power_w(torque, speed, motor)
            dragging = idle_drag_nm(torque, speed, motor) * speed
            drag += dragging
            friction += brake * speed
            work += (torque + brake) * speed - dragging
        chemical = chemical_power_w(electrical, self._vehicle.battery)
        self._distance_m += measurement.speed_mps * dt_s
        for i, power in enumerate((chemical, electrical, work, friction, drag)):
            self._joules[i] += power * dt_s

    def result(self) -> Consumption:
        """The sums so far."""
        return Consumption(self._label, self._distance_m, *(joules / _J_PER_WH for joules in self._joules))


def what_if(
    bag: BagReader,
    plans: Sequence[tuple[str, Plan]],
    mapping: SignalMapping,
    progress: Callable[[int, int], None] | None = None,
) -> list[Consumption]:
    """Consumption of the recorded commands, where the bag has them, and of each plan.

    Parameters
    ----------
    plans : label and plan of each strategy, all with the same vehicle
    """
    results = []
    state = topic_named(STATE, bag.topics)
    if state is not None and Replay(bag, plans[0][1], mapping).exact:
        meter = EnergyMeter("recorded", plans[0][1].vehicle.params)
        decode = joint_state_reader("position")
        for message in bag.messages():
            if message.topic == state:
                values = dict(zip(*decode(message.data)[1:], strict=True))
                meter.add(
                    from_numbers(values).measurement,
                    _wheels(values, "motor_torque_nm"),
                    _wheels(values, "friction_torque_nm"),
                )
        results.append(meter.result())
    for label, plan in plans:
        meter = EnergyMeter(label, plan.vehicle.params)
        for _, steps in Replay(bag, plan, mapping).steps(progress):
            for step in steps:
                measurement = from_numbers(dict(zip(SIGNAL_NAMES, step.values, strict=True))).measurement
                meter.add(measurement, step.command.motor_torque_nm, step.command.friction_torque_nm)
        results.append(meter.result())
    return results


def _wheels(values: dict[str, float], kind: str) -> Wheels:
    a, b, c, d = (values[f"{wheel}_{kind}"] for wheel in WHEEL_NAMES)
    return a, b, c, d
