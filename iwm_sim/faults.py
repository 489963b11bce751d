# SPDX-License-Identifier: Apache-2.0
"""What fails in a scenario: sensors, actuators and messages, from one time to another. Plain numbers, no ROS."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from iwm_power_manager.control.types import WHEEL_NAMES, Wheels

SPEED = "vehicle_speed"
ALL_WHEELS = "wheels"
SENSORS = (SPEED, ALL_WHEELS, *(f"wheel_{name}" for name in WHEEL_NAMES))
MOTORS = tuple(f"motor_{name}" for name in WHEEL_NAMES)
BRAKES = tuple(f"brake_{name}" for name in WHEEL_NAMES)
ACTUATORS = (*MOTORS, *BRAKES)
MESSAGES = ("vehicle_speed", "wheel_states", "power_demand", "battery_state")

#: What can go wrong with each kind of thing, and whether it takes a value.
SENSOR_KINDS = {"factor": True, "offset": True, "drift_per_s": True, "value": True, "stuck": False, "missing": False}
ACTUATOR_KINDS = {"factor": True, "torque_nm": True, "dead": False, "reversed": False}
MESSAGE_KINDS = {"lost": False}


class Fault(NamedTuple):
    """One fault.

    Attributes
    ----------
    target : a name of `SENSORS`, `ACTUATORS` or `MESSAGES`
    kind : what is wrong; `value` is its number, if it has one
    from_s, until_s : when
    message : the target is a message and not the sensor of the same name
    """

    target: str
    kind: str
    value: float
    from_s: float
    until_s: float
    message: bool = False


class Faults:
    """The faults of a drive, with what they remember.

    Parameters
    ----------
    faults : all of them; those of one target act one after the other
    """

    def __init__(self, faults: Sequence[Fault]) -> None:
        self._faults = tuple(faults)
        self._stuck: dict[Fault, float] = {}

    def lost(self, message: str, time_s: float) -> bool:
        """Whether a message does not arrive now."""
        return any(f.message and f.target == message for f in self._now(time_s))

    def speed(self, speed_mps: float, time_s: float) -> float:
        """What the speed sensor shows (NaN: nothing)."""
        return self._sensed(SPEED, speed_mps, time_s)

    def wheels(self, wheel_radps: Wheels, time_s: float) -> Wheels:
        """What the wheel speed sensors show (NaN: nothing)."""
        a, b, c, d = (
            self._sensed(f"wheel_{name}", self._sensed(ALL_WHEELS, value, time_s, name), time_s)
            for name, value in zip(WHEEL_NAMES, wheel_radps, strict=True)
        )
        return a, b, c, d

    def motors(self, torque_nm: Wheels, time_s: float) -> Wheels:
        """What the motors make of a command."""
        return self._acted(MOTORS, torque_nm, time_s)

    def brakes(self, torque_nm: Wheels, time_s: float) -> Wheels:
        """What the friction brakes make of a command."""
        return self._acted(BRAKES, torque_nm, time_s)

    def _now(self, time_s: float) -> list[Fault]:
        return [f for f in self._faults if f.from_s <= time_s < f.until_s]

    def _sensed(self, target: str, value: float, time_s: float, which: str = "") -> float:
        for fault in self._now(time_s):
            if fault.target != target or fault.message:
                continue
            if fault.kind == "factor":
                value *= fault.value
            elif fault.kind == "offset":
                value += fault.value
            elif fault.kind == "drift_per_s":
                value += fault.value * (time_s - fault.from_s)
            elif fault.kind == "value":
                value = fault.value
            elif fault.kind == "missing":
                value = math.nan
            else:
                value = self._stuck.setdefault(fault._replace(target=target + which), value)
        return value

    def _acted(self, names: tuple[str, ...], torque_nm: Wheels, time_s: float) -> Wheels:
        torques = list(torque_nm)
        for fault in self._now(time_s):
            if fault.target not in names:
                continue
            i = names.index(fault.target)
            if fault.kind == "factor":
                torques[i] *= fault.value
            elif fault.kind == "torque_nm":
                torques[i] = fault.value
            elif fault.kind == "dead":
                torques[i] = 0.0
            else:
                torques[i] = -torques[i]
        a, b, c, d = torques
        return a, b, c, d
