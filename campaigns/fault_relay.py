# SPDX-License-Identifier: Apache-2.0
"""A relay between simulator and power manager that can do to the messages what broken parts do.

The simulator publishes below `raw/`; the relay hands everything on, as it is or spoilt, and listens to what the power
manager makes of it. It polls, so that one process can relay four topics at 100 Hz and watch three without missing any.
"""

from __future__ import annotations

import copy
import itertools
import math
import random
import time
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node

from iwm_power_manager.ros import messages as m
from iwm_power_manager.ros import qos
from iwm_power_manager.ros.intake import Intake

RAW = "raw"
DIAGNOSTICS = "diagnostics"
INPUTS = (m.VEHICLE_SPEED, m.WHEEL_STATES, m.BATTERY_STATE, m.POWER_DEMAND)
OUTPUTS = (m.WHEEL_TORQUE_COMMAND, m.FRICTION_BRAKE_COMMAND, m.POWER_MANAGER_STATE)
_POLL_S = 0.001
_NS_PER_S = 1_000_000_000

#: What becomes of a message: any number of messages to send instead.
Transform = Callable[[Any, float], Iterable[Any]]


def pass_on(message: Any, _now_s: float) -> Iterable[Any]:
    """The message as it is."""
    return (message,)


def stop(_message: Any, _now_s: float) -> Iterable[Any]:
    """Nothing."""
    return ()


def delay(delay_s: float) -> Transform:
    """Every message some time later."""
    waiting: deque[tuple[float, Any]] = deque()

    def delayed(message: Any, now_s: float) -> Iterable[Any]:
        waiting.append((now_s + delay_s, message))
        while waiting and waiting[0][0] <= now_s:
            yield waiting.popleft()[1]

    return delayed


def freeze(*, restamp: bool) -> Transform:
    """The first message again and again; with `restamp`, only its value."""
    first: list[Any] = []

    def frozen(message: Any, _now_s: float) -> Iterable[Any]:
        first.append(message)
        again = copy.deepcopy(first[0])
        del first[1:]
        if restamp:
            again.header.stamp = message.header.stamp
        return (again,)

    return frozen


def repeat(times: int) -> Transform:
    """Every message several times, with stamps a little apart."""

    def repeated(message: Any, _now_s: float) -> Iterable[Any]:
        for i in range(times):
            again = copy.deepcopy(message)
            if hasattr(again, "header"):
                again.header.stamp = m.ns_to_stamp(m.stamp_to_ns(message.header.stamp) + i * 1000)
            yield again

    return repeated


def thin(every: int) -> Transform:
    """Only every n-th message."""
    numbers = itertools.count(1)
    return lambda message, _now_s: (message,) if next(numbers) % every == 0 else ()


def lose(probability: float, seed: int) -> Transform:
    """Each message with a probability."""
    dice = random.Random(seed)
    return lambda message, _now_s: () if dice.random() < probability else (message,)


def restamp(shift_s: float) -> Transform:
    """Stamps shifted by a time."""
    shift_ns = round(shift_s * _NS_PER_S)

    def restamped(message: Any, _now_s: float) -> Iterable[Any]:
        if hasattr(message, "clock"):
            message.clock = m.ns_to_stamp(m.stamp_to_ns(message.clock) + shift_ns)
        else:
            message.header.stamp = m.ns_to_stamp(m.stamp_to_ns(message.header.stamp) + shift_ns)
        return (message,)

    return restamped


def replace(value: float) -> Transform:
    """Every value of the message by one number."""

    def replaced(message: Any, _now_s: float) -> Iterable[Any]:
        if hasattr(message, "twist"):
            message.twist.linear.x = value
        elif hasattr(message, "velocity"):
            message.velocity = [value] * len(message.velocity)
        elif hasattr(message, "percentage"):
            message.percentage = value
        else:
            message.data = value
        return (message,)

    return replaced


def wheels(order: tuple[int, ...]) -> Transform:
    """The wheels of the message in another order, or not all of them, each with its own value."""

    def chosen(message: Any, _now_s: float) -> Iterable[Any]:
        name, velocity, effort = (
            [values[i] for i in order] for values in (message.name, message.velocity, message.effort)
        )
        stamp_ns = m.stamp_to_ns(message.header.stamp)
        return (m.joint_message(stamp_ns, name, velocity=velocity, effort=effort),)

    return chosen


class Observation(NamedTuple):
    """One command of the power manager as it arrived.

    Attributes
    ----------
    time_s : monotonic clock
    motor_nm, friction_nm : torques
    """

    time_s: float
    motor_nm: tuple[float, ...]
    friction_nm: tuple[float, ...]


class FaultRelay:
    """Relay, injector and observer in one node.

    Attributes
    ----------
    transforms : what is done to each topic; `pass_on` unless a fault is in force
    commands : every command since `forget`
    applied : torques the simulated motors really gave since `forget`, with their times
    modes : time, mode and missing inputs whenever one of them changed
    reports : text of every diagnostic status that is not OK, with the time it was first seen
    """

    def __init__(self, context: rclpy.Context, namespace: str) -> None:
        self._node = Node(
            "fault_relay", context=context, namespace=namespace, enable_rosout=False, start_parameter_services=False
        )
        profile = qos.profile(lockstep=False)
        deep = qos.profile(lockstep=True)
        self._intake = Intake(self._node)
        self._publishers = {}
        for topic in (*INPUTS, "clock"):
            kind = m.TOPIC_TYPES[m.CLOCK if topic == "clock" else topic]
            self._intake.subscribe(kind, f"{RAW}/{topic}", deep)
            self._publishers[topic] = self._node.create_publisher(kind, topic, profile)
        for topic in OUTPUTS:
            self._intake.subscribe(m.TOPIC_TYPES[topic], topic, deep)
        self._intake.subscribe(DiagnosticArray, DIAGNOSTICS, deep)
        self.transforms: dict[str, Transform] = {}
        self.heal()
        self._friction: tuple[float, ...] = (0.0,) * 4
        self.forget()

    def heal(self) -> None:
        """Hand everything on as it is."""
        self.transforms = dict.fromkeys((*INPUTS, "clock"), pass_on)

    def forget(self) -> None:
        """Begin observing anew."""
        self.commands: list[Observation] = []
        self.applied: list[tuple[float, float]] = []
        self.modes: list[tuple[float, int, int]] = []
        self.reports: dict[str, float] = {}
        self.signals: dict[str, float] = {}

    def intruder(self) -> Any:
        """A second publisher of motor torque commands."""
        return self._node.create_publisher(
            m.TOPIC_TYPES[m.WHEEL_TORQUE_COMMAND], m.WHEEL_TORQUE_COMMAND, qos.profile(lockstep=False)
        )

    def dismiss(self, publisher: Any) -> None:
        """Take a second publisher away."""
        self._node.destroy_publisher(publisher)

    def close(self) -> None:
        """Leave."""
        self._intake.close()
        self._node.destroy_node()

    def run(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Relay and observe for some time, or until a condition holds; whether it did."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self._pump()
            if until():
                return True
            time.sleep(_POLL_S)
        return False

    def _pump(self) -> None:
        for topic, transform in self.transforms.items():
            for message, _ in self._intake.take(f"{RAW}/{topic}"):
                now_s = time.monotonic()
                if topic == m.WHEEL_STATES:
                    self.applied.append((now_s, max(map(abs, message.effort), default=0.0)))
                for changed in transform(message, now_s):
                    self._publishers[topic].publish(changed)
        for message, _ in self._intake.take(m.FRICTION_BRAKE_COMMAND):
            self._friction = tuple(message.effort)
        for message, _ in self._intake.take(m.WHEEL_TORQUE_COMMAND):
            self.commands.append(Observation(time.monotonic(), tuple(message.effort), self._friction))
        for message, _ in self._intake.take(m.POWER_MANAGER_STATE):
            self.signals = m.read_named_numbers(message)[1]
            state = (int(self.signals["mode"]), int(self.signals["stale"]))
            if not self.modes or self.modes[-1][1:] != state:
                self.modes.append((time.monotonic(), *state))
        for message, _ in self._intake.take(DIAGNOSTICS):
            for status in message.status:
                if status.level != b"\0":
                    self.reports.setdefault(f"{status.name.split(': ')[1]}: {status.message}", time.monotonic())

    @property
    def mode(self) -> int:
        """Mode in the newest state; -1 before the first."""
        return self.modes[-1][1] if self.modes else -1

    def finite(self) -> bool:
        """Every torque of every command is a finite number."""
        return all(
            math.isfinite(torque) for command in self.commands for torque in command.motor_nm + command.friction_nm
        )
