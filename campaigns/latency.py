# SPDX-License-Identifier: Apache-2.0
"""`python -m campaigns.latency`: from inputs to command, beside a bare rclpy relay, in one run.

Two processes answer: the power manager in lock-step (each set of inputs is answered at once: the whole control path,
with no timer in it), and a relay that does nothing but receive the same four messages with plain callbacks and publish
the same three. Sets go to one and the other in turn, so that both meet the same machine. A third process, the power
manager in real time, tells the jitter of its period, beside a bare timer's.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from numpy.typing import NDArray
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

from iwm_power_manager import files
from iwm_power_manager.command_line import CommandParser
from iwm_power_manager.control.record import SIGNAL_NAMES
from iwm_power_manager.errors import IwmError
from iwm_power_manager.ros import ending, qos
from iwm_power_manager.ros import messages as m
from iwm_power_manager.ros.intake import Intake
from iwm_sim.domains import claimed_domain
from iwm_sim.processes import Children

_SPEED_MPS, _RADIUS_M = 10.0, 0.33
_PERIOD_NS = 10_000_000
_WARM = 200
_ANSWER_S = 2.0
_START_S = 300.0
_GREETING_S = 0.5
_PERCENTILES = (50.0, 99.0, 99.9, 100.0)
_INPUTS = (m.VEHICLE_SPEED, m.WHEEL_STATES, m.BATTERY_STATE, m.POWER_DEMAND)
_OUTPUTS = (m.WHEEL_TORQUE_COMMAND, m.FRICTION_BRAKE_COMMAND, m.POWER_MANAGER_STATE)


def relay_main(namespace: str) -> None:
    """The bare relay: four subscriptions, three publishers, a 100 Hz timer that publishes its time."""
    rclpy.init(args=[])
    node = Node("relay", namespace=namespace)
    profile = qos.profile(lockstep=True)
    outputs = [node.create_publisher(m.TOPIC_TYPES[topic], topic, profile) for topic in _OUTPUTS]
    ticks = node.create_publisher(m.TOPIC_TYPES[m.POWER_MANAGER_STATE], "ticks", profile)
    zeros = [0.0] * len(SIGNAL_NAMES)
    stamp_ns = 0

    def keep_stamp(message: Any) -> None:
        nonlocal stamp_ns
        stamp_ns = m.stamp_to_ns(message.header.stamp)

    def answer(_message: Any) -> None:
        torque = m.joint_message(stamp_ns, m.WHEEL_NAMES, effort=(0.0,) * 4)
        for publisher, message in zip(
            outputs, (torque, torque, m.joint_message(stamp_ns, SIGNAL_NAMES, position=zeros)), strict=True
        ):
            publisher.publish(message)

    for topic in _INPUTS:
        callback = answer if topic == m.POWER_DEMAND else keep_stamp
        node.create_subscription(m.TOPIC_TYPES[topic], topic, callback, profile)
    node.create_timer(
        _PERIOD_NS / 1e9,
        lambda: ticks.publish(m.joint_message(node.get_clock().now().nanoseconds, SIGNAL_NAMES, position=zeros)),
    )
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node, SingleThreadedExecutor())


class Questioner:
    """Sends sets of inputs to one namespace and times the answers."""

    def __init__(self, node: Node, namespace: str, state_topic: str = m.POWER_MANAGER_STATE) -> None:
        profile = qos.profile(lockstep=True)
        self._publishers = {
            topic: node.create_publisher(m.TOPIC_TYPES[topic], f"{namespace}/{topic}", profile) for topic in _INPUTS
        }
        self._intake = Intake(node)
        self._command = f"{namespace}/{m.FRICTION_BRAKE_COMMAND}"
        self._state = f"{namespace}/{state_topic}"
        self._intake.subscribe(m.TOPIC_TYPES[m.FRICTION_BRAKE_COMMAND], self._command, profile)
        self._intake.subscribe(m.TOPIC_TYPES[m.POWER_MANAGER_STATE], self._state, profile)
        self._node = node
        self._stamp_ns = 0

    def ready(self) -> bool:
        """Every input is matched, and somebody publishes commands."""
        matched = all(publisher.get_subscription_count() > 0 for publisher in self._publishers.values())
        return matched and self._node.count_publishers(self._command) > 0

    def greet(self) -> bool:
        """Send a set and wait a little for the answer: the first ones may meet a match that is not complete yet."""
        self._stamp_ns += _PERIOD_NS
        self.send(self._stamp_ns)
        end = time.monotonic() + _GREETING_S
        while time.monotonic() < end:
            if any(
                m.stamp_to_ns(answer.header.stamp) == self._stamp_ns for answer, _ in self._intake.take(self._command)
            ):
                return True
            time.sleep(0.01)
        return False

    def send(self, stamp_ns: int) -> None:
        """Publish one set of inputs, the demand last."""
        wheels = (_SPEED_MPS / _RADIUS_M,) * 4
        self._publishers[m.VEHICLE_SPEED].publish(m.vehicle_speed_message(stamp_ns, _SPEED_MPS))
        self._publishers[m.WHEEL_STATES].publish(m.wheel_states_message(stamp_ns, m.WHEEL_NAMES, wheels, (0.0,) * 4))
        self._publishers[m.BATTERY_STATE].publish(
            m.battery_state_message(stamp_ns, soc=0.5, voltage_v=237.0, discharge_current_a=20.0)
        )
        self._publishers[m.POWER_DEMAND].publish(m.number_message(5000.0))

    def ask(self) -> float:
        """Seconds from the moment before the first input is published to the moment the last command is here."""
        self._stamp_ns += _PERIOD_NS
        began_s = time.perf_counter()
        self.send(self._stamp_ns)
        while time.perf_counter() - began_s < _ANSWER_S:
            for message, _ in self._intake.take(self._command):
                if m.stamp_to_ns(message.header.stamp) == self._stamp_ns:
                    took_s = time.perf_counter() - began_s
                    self.stamps()
                    return took_s
        raise IwmError(f"{self._command}: no answer within {_ANSWER_S:g} s")

    def stamps(self) -> list[int]:
        """Stamps of the states that have arrived."""
        return [m.stamp_to_ns(message.header.stamp) for message, _ in self._intake.take(self._state)]


def measure_latency(relay: Questioner, manager: Questioner, count: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Seconds to each answer of the relay and of the power manager."""
    taken: tuple[list[float], list[float]] = ([], [])
    for i in range(_WARM + count):
        for answers, questioner in zip(taken, (relay, manager), strict=True):
            answers.append(questioner.ask())
            # As in a car: some pause between the sets, so that no queue is ever in the way.
            time.sleep(0.001 + 0.001 * (i % 3))
    return np.array(taken[0][_WARM:]), np.array(taken[1][_WARM:])


def measure_jitter(relay: Questioner, manager: Questioner, seconds: float) -> tuple[NDArray[Any], NDArray[Any]]:
    """Periods, s, of the relay's bare timer and of the power manager in real time, driven at 100 Hz."""
    stamps: tuple[list[int], list[int]] = ([], [])
    end = time.monotonic() + seconds
    due = time.monotonic()
    while time.monotonic() < end:
        manager.send(time.time_ns())
        for found, questioner in zip(stamps, (relay, manager), strict=True):
            found.extend(questioner.stamps())
        due += _PERIOD_NS / 1e9
        time.sleep(max(due - time.monotonic(), 0.0))
    return np.diff(np.array(stamps[0])) / 1e9, np.diff(np.array(stamps[1])) / 1e9


def row(name: str, values_s: NDArray[Any]) -> str:
    """One row of the table, in us."""
    return f"{name:34} {values_s.size:>6} " + " ".join(
        f"{np.percentile(values_s, p) * 1e6:>9.0f}" for p in _PERCENTILES
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; exit code 1 if the control path costs more than it may."""
    parser = CommandParser("latency", description=__doc__)
    parser.add_argument("--count", type=int, default=5000, help="sets of inputs to each of the two (5000)")
    parser.add_argument("--seconds", type=float, default=30.0, help="time the jitter is watched for (30)")
    parser.add_argument("--strategy", default="equal", help="strategy of the power manager (equal)")
    parser.add_argument("--policy", default="", help="its policy file or folder")
    parser.add_argument("--limit-us", type=float, default=math.inf, help="largest median overhead that passes")
    parser.add_argument("--json", type=Path, help="write the numbers there too")
    parser.add_argument("--relay", default="", help=argparse.SUPPRESS)
    chosen = parser.parse_args(arguments)
    if chosen.relay:
        relay_main(chosen.relay)
        return 0
    with tempfile.TemporaryDirectory(prefix="iwm-latency-") as folder, claimed_domain() as domain:
        own = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_LOG_DIR": folder}
        os.environ |= own
        rclpy.init(args=[], domain_id=domain)
        code = 1
        try:
            code = _run(chosen, os.environ | {"ROS_DOMAIN_ID": str(domain)}, Path(folder))
        except IwmError as error:
            print(f"latency: {error}", file=sys.stderr)
        finally:
            with ending.bounded(code):
                pass
    return code


def _run(chosen: argparse.Namespace, environment: Mapping[str, str], folder: Path) -> int:
    node = Node("questioner", enable_rosout=False, start_parameter_services=False)
    manager = [sys.executable, "-m", "iwm_power_manager.nodes.power_manager", "--ros-args"]
    manager += ["-p", f"strategy:={chosen.strategy}", "-p", f"policy_file:='{chosen.policy}'"]
    with Children(environment, folder) as children:
        relay = Questioner(node, "/relay")
        ticks = Questioner(node, "/relay", "ticks")
        children.start("relay", [sys.executable, "-m", "campaigns.latency", "--relay", "/relay"])
        lockstep = Questioner(node, "/lockstep")
        children.start("lockstep", [*manager, "-p", "lockstep:=true", "-r", "__ns:=/lockstep"])
        _wait(relay, lockstep)
        for questioner in (relay, lockstep):
            if not any(questioner.greet() for _ in range(round(_START_S / _GREETING_S))):
                raise IwmError("a node is there and does not answer")
        relay_s, manager_s = measure_latency(relay, lockstep, chosen.count)
        realtime = Questioner(node, "/realtime")
        children.start("realtime", [*manager, "-r", "__ns:=/realtime"])
        _wait(realtime)
        # What has piled up, and the first periods, are no part of the measurement.
        measure_jitter(ticks, realtime, 1.0)
        timer_s, period_s = measure_jitter(ticks, realtime, chosen.seconds)
    overhead_us = float(np.median(manager_s) - np.median(relay_s)) * 1e6
    print(f"{'us':34} {'n':>6} {'p50':>9} {'p99':>9} {'p99.9':>9} {'max':>9}")
    print(row("input to command, bare relay", relay_s))
    print(row("input to command, power manager", manager_s))
    print(row("period, bare timer", timer_s))
    print(row("period, power manager", period_s))
    print(f"median overhead of the whole control path over the bare relay: {overhead_us:.0f} us")
    if chosen.json:
        numbers = {
            name: {f"p{p:g}": float(np.percentile(values, p) * 1e6) for p in _PERCENTILES}
            for name, values in {
                "relay_us": relay_s,
                "power_manager_us": manager_s,
                "timer_period_us": timer_s,
                "period_us": period_s,
            }.items()
        }
        files.atomic_write(chosen.json, json.dumps(numbers | {"median_overhead_us": overhead_us}, indent=1).encode())
    return 0 if overhead_us <= chosen.limit_us else 1


def _wait(*questioners: Questioner) -> None:
    end = time.monotonic() + _START_S
    while not all(questioner.ready() for questioner in questioners):
        if time.monotonic() > end:
            raise IwmError(f"the nodes were not there after {_START_S:g} s")
        time.sleep(0.1)
    time.sleep(0.5)


if __name__ == "__main__":
    sys.exit(main())
