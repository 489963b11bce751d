# SPDX-License-Identifier: Apache-2.0
"""What fails in a scenario: sensors, actuators and messages, from one time to another. Plain numbers, no ROS."""

from __future__ import annotations

import math
import random
from collections import deque
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, TypeVar

from iwm_power_manager.control.types import WHEEL_NAMES, Wheels

SPEED = "vehicle_speed"
ALL_WHEELS = "wheels"
WHEEL_SENSORS = (ALL_WHEELS, *(f"wheel_{name}" for name in WHEEL_NAMES))
SENSORS = (SPEED, *WHEEL_SENSORS)
MOTORS = tuple(f"motor_{name}" for name in WHEEL_NAMES)
BRAKES = tuple(f"brake_{name}" for name in WHEEL_NAMES)
ACTUATORS = (*MOTORS, *BRAKES)
STAMPED = ("vehicle_speed", "wheel_states", "battery_state", "imu")
MESSAGES = ("power_demand", *STAMPED)

_ANY = (-1e6, 1e6, "")
#: What can go wrong with each kind of thing: least and largest value with its unit, or None where it takes none.
SENSOR_KINDS = {
    "factor": _ANY,
    "offset": _ANY,
    "drift_per_s": _ANY,
    "value": _ANY,
    "teeth": (1.0, 10000.0, ""),
    "stuck": None,
    "missing": None,
}
ACTUATOR_KINDS = {"factor": _ANY, "torque_nm": _ANY, "lag_s": (0.001, 10.0, "s"), "dead": None, "reversed": None}
MESSAGE_KINDS = {
    "lost": None,
    "delay_s": (0.0, 10.0, "s"),
    "jitter_s": (0.0, 10.0, "s"),
    "rate_hz": (0.1, 1000.0, "Hz"),
    "stamp_error_s": (-10.0, 10.0, "s"),
}
#: What only some targets know.
ONLY = {"teeth": WHEEL_SENSORS, "stamp_error_s": STAMPED}

_NS_PER_S = 1e9
_Shown = TypeVar("_Shown")


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


class _Turned(NamedTuple):
    """A wheel whose teeth are counted: its angle at a time, and the speed that is shown."""

    time_s: float
    angle_rad: float
    shown_radps: float


class _Way:
    """A message's way: what is under way, each with arrival and stamp, and the step it is at. None overtakes another.

    Delays are drawn from the name, so that a scenario is the same each time, whatever fails beside it.
    """

    def __init__(self, message: str) -> None:
        self.under_way: deque[tuple[int, int, Any]] = deque()
        self.step = 0
        self.random = random.Random(message)


class Faults:
    """The faults of a drive, with what they remember.

    Parameters
    ----------
    faults : all of them; those of one target act one after the other
    dt_s : step of the drive
    """

    def __init__(self, faults: Sequence[Fault], dt_s: float) -> None:
        self._faults = tuple(faults)
        self._dt_s = dt_s
        self._stuck: dict[Fault, float] = {}
        self._turned: dict[Fault, _Turned] = {}
        self._reached: dict[Fault, float] = {}
        self._ways = {f.target: _Way(f.target) for f in self._faults if f.message}

    def arriving(self, message: str, shown: _Shown, time_s: float, now_ns: int) -> Iterable[tuple[int, _Shown]]:
        """What arrives of a message in this step, oldest first, each with its stamp; asked once a step.

        Parameters
        ----------
        message : a name of `MESSAGES`, or another, which arrives at once
        shown : what is measured in this step
        time_s : of the drive
        now_ns : the same as stamps are written
        """
        way = self._ways.get(message)
        if way is None:
            return ((now_ns, shown),)
        sent, delay_s, error_s = True, 0.0, 0.0
        for fault in self._now(time_s):
            if not fault.message or fault.target != message:
                continue
            if fault.kind == "lost":
                sent = False
            elif fault.kind == "rate_hz":
                steps = fault.value * self._dt_s
                sent = sent and math.floor((way.step + 0.5) * steps) > math.floor((way.step - 0.5) * steps)
            elif fault.kind == "delay_s":
                delay_s += fault.value
            elif fault.kind == "jitter_s":
                delay_s += fault.value * way.random.random()
            else:
                error_s += fault.value
        way.step += 1
        if sent:
            way.under_way.append((now_ns + round(delay_s * _NS_PER_S), now_ns + round(error_s * _NS_PER_S), shown))
        arrived = []
        while way.under_way and way.under_way[0][0] <= now_ns:
            arrived.append(way.under_way.popleft()[1:])
        return arrived

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
            elif fault.kind == "teeth" and not math.isnan(value):
                value = self._counted(fault._replace(target=target + which), value, time_s)
            elif fault.kind == "stuck":
                value = self._stuck.setdefault(fault._replace(target=target + which), value)
        return value

    def _counted(self, fault: Fault, radps: float, time_s: float) -> float:
        """Wheel speed by the teeth that passed in the last step."""
        before = self._turned.get(fault)
        if before is None or before.time_s != time_s:
            tooth_rad = 2.0 * math.pi / fault.value
            from_rad = before.angle_rad if before else 0.0
            angle_rad = from_rad + radps * self._dt_s
            passed = math.floor(angle_rad / tooth_rad) - math.floor(from_rad / tooth_rad)
            before = self._turned[fault] = _Turned(time_s, angle_rad, passed * tooth_rad / self._dt_s)
        return before.shown_radps

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
            elif fault.kind == "lag_s":
                torques[i] = self._lagging(fault, torques[i])
            elif fault.kind == "dead":
                torques[i] = 0.0
            else:
                torques[i] = -torques[i]
        a, b, c, d = torques
        return a, b, c, d

    def _lagging(self, fault: Fault, torque_nm: float) -> float:
        """Mean over a step of a torque that follows as a lag of first order, at the end of which it is remembered."""
        missing = self._reached.get(fault, 0.0) - torque_nm
        left = math.exp(-self._dt_s / fault.value)
        self._reached[fault] = torque_nm + left * missing
        return torque_nm + (1.0 - left) * fault.value / self._dt_s * missing
