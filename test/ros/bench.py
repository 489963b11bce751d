# SPDX-License-Identifier: Apache-2.0
"""A power manager in a process of its own, and a hand on each of its topics."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from member import Member
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParameters
from rclpy.client import Client
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState

from iwm_power_manager.ros import messages, qos
from iwm_power_manager.ros.asking import AGAIN_S, Question

PATIENCE_S = 60.0
TRANSITIONS = {
    "configure": Transition.TRANSITION_CONFIGURE,
    "activate": Transition.TRANSITION_ACTIVATE,
    "deactivate": Transition.TRANSITION_DEACTIVATE,
    "cleanup": Transition.TRANSITION_CLEANUP,
    "shutdown_active": Transition.TRANSITION_ACTIVE_SHUTDOWN,
    "shutdown_inactive": Transition.TRANSITION_INACTIVE_SHUTDOWN,
    "shutdown_unconfigured": Transition.TRANSITION_UNCONFIGURED_SHUTDOWN,
}


#: Lifecycle state that a transition ends in.
REACHED = {
    "configure": "inactive",
    "activate": "active",
    "deactivate": "inactive",
    "cleanup": "unconfigured",
    **dict.fromkeys((name for name in TRANSITIONS if name.startswith("shutdown")), "finalized"),
}


def environment(domain: int, log_dir: Path) -> dict[str, str]:
    """Environment of a node on a DDS domain of its own."""
    return {
        **os.environ,
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(log_dir),
        "PYTHONUNBUFFERED": "1",
    }


def arguments(parameters: Mapping[str, Any], remaps: Mapping[str, str] | None = None) -> list[str]:
    """`--ros-args` of a node."""
    found = ["--ros-args"]
    for name, value in parameters.items():
        text = str(value).lower() if isinstance(value, bool) else f"'{value}'" if value == "" else str(value)
        found += ["-p", f"{name}:={text}"]
    for source, target in (remaps or {}).items():
        found += ["-r", f"{source}:={target}"]
    return found


class Running:
    """A node in a process of its own."""

    def __init__(
        self, module: str, args: list[str], domain: int, folder: Path, more: Mapping[str, str] | None = None
    ) -> None:
        self.output = folder / f"{module.rsplit('.', 1)[-1]}-{time.monotonic_ns()}.log"
        with self.output.open("w") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", module, *args],
                env=environment(domain, folder) | dict(more or {}),
                stdout=log,
                stderr=subprocess.STDOUT,
            )

    def text(self) -> str:
        """What it has printed so far."""
        return self.output.read_text()

    def stop(self, sig: int = signal.SIGINT) -> int:
        """Signal it, and wait for its exit code."""
        if self.process.poll() is None:
            self.process.send_signal(sig)
        return self.wait()

    def wait(self) -> int:
        """Exit code, once it has ended by itself."""
        try:
            return self.process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
            raise AssertionError(f"did not end:\n{self.text()}") from None


class Bench(Member):
    """Publishes every input of the power manager and keeps every output."""

    def __init__(self, *, lockstep: bool = False, namespace: str = "", sim_time: bool = False) -> None:
        super().__init__("bench", namespace)
        self.sim_time = sim_time
        self.now_ns = 1_000_000_000
        profile = qos.profile(lockstep=lockstep)
        keep_all = qos.profile(lockstep=True)
        self.publishers = {
            topic: self.node.create_publisher(messages.TOPIC_TYPES[topic], topic, profile)
            for topic in (
                messages.VEHICLE_SPEED,
                messages.WHEEL_STATES,
                messages.POWER_DEMAND,
                messages.BATTERY_STATE,
                messages.ROAD_FRICTION,
            )
        }
        if sim_time:
            self.publishers[messages.CLOCK] = self.node.create_publisher(
                messages.TOPIC_TYPES[messages.CLOCK], f"{namespace}/clock", keep_all
            )
        #: What the motors report where `send` is not told: nothing, so zero.
        self.reported: Callable[[], tuple[float, ...]] = tuple
        self.torques: list[JointState] = []
        self.frictions: list[JointState] = []
        self.states: list[dict[str, float]] = []
        self.state_stamps: list[int] = []
        self.diagnostics: list[DiagnosticArray] = []
        self.node.create_subscription(JointState, messages.WHEEL_TORQUE_COMMAND, self.torques.append, keep_all)
        self.node.create_subscription(JointState, messages.FRICTION_BRAKE_COMMAND, self.frictions.append, keep_all)
        self.node.create_subscription(JointState, messages.POWER_MANAGER_STATE, self._on_state, keep_all)
        self.node.create_subscription(DiagnosticArray, f"{namespace}/diagnostics", self.diagnostics.append, keep_all)
        self.clients: dict[str, Any] = {}

    def _on_state(self, message: JointState) -> None:
        stamp, values = messages.read_named_numbers(message)
        self.states.append(values)
        self.state_stamps.append(stamp)

    # Waiting

    def spin_until(self, condition: Callable[[], Any], what: str, patience_s: float = PATIENCE_S) -> Any:
        """Serve callbacks until `condition` is true; returns what it returned."""
        end = time.monotonic() + patience_s
        while not (found := condition()):
            assert time.monotonic() < end, f"waited in vain for {what}"
            self.executor.spin_once(timeout_sec=0.05)
        return found

    def connect(self) -> None:
        """Wait until every topic has its counterpart."""
        inputs = [publisher for topic, publisher in self.publishers.items() if topic != messages.CLOCK]
        outputs = (messages.WHEEL_TORQUE_COMMAND, messages.FRICTION_BRAKE_COMMAND, messages.POWER_MANAGER_STATE)
        self.spin_until(
            lambda: (
                all(p.get_subscription_count() for p in inputs)
                and all(self.node.count_publishers(topic) for topic in outputs)
            ),
            "the power manager's topics",
        )

    # Services

    def _client(self, kind: Any, service: str) -> Client:
        """Client of a service of the power manager, once the service is there."""
        client = self.clients.get(service)
        if client is None:
            client = self.clients[service] = self.node.create_client(kind, f"power_manager/{service}")
        self.spin_until(client.service_is_ready, f"service {service}")
        return client

    def call(self, kind: Any, service: str, request: Any) -> Any:
        """Call a service of the power manager that may be called twice."""
        client = self._client(kind, service)
        return self.spin_until(Question(client, request).answer, f"an answer of {service}")

    def change_state(self, transition: str) -> bool:
        """Ask for a lifecycle transition, once, since a second one would be refused; its answer may be lost."""
        client = self._client(ChangeState, "change_state")
        future = client.call_async(ChangeState.Request(transition=Transition(id=TRANSITIONS[transition])))
        ask_s = time.monotonic() + AGAIN_S

        def changed() -> bool:
            nonlocal ask_s
            if future.done() or time.monotonic() < ask_s:
                return future.done()
            ask_s = time.monotonic() + AGAIN_S
            return self.lifecycle_state() == REACHED[transition]

        self.spin_until(changed, f"an answer of {transition}")
        return not future.done() or bool(future.result().success)

    def lifecycle_state(self) -> str:
        """Label of the lifecycle state."""
        return str(self.call(GetState, "get_state", GetState.Request()).current_state.label)

    def set_parameter(self, name: str, value: Any) -> str:
        """Set a parameter; returns the reason if it was refused, else ""."""
        request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
        result = self.call(SetParameters, "set_parameters", request).results[0]
        return "" if result.successful else str(result.reason) or "refused"

    def get_parameter(self, name: str) -> Any:
        """Value of a parameter."""
        answer = self.call(GetParameters, "get_parameters", GetParameters.Request(names=[name]))
        return rclpy.parameter.parameter_value_to_python(answer.values[0])

    def describe(self, name: str) -> Any:
        """Descriptor of a parameter."""
        answer = self.call(DescribeParameters, "describe_parameters", DescribeParameters.Request(names=[name]))
        return answer.descriptors[0]

    # Inputs

    def publish(self, topic: str, message: Any) -> None:
        """Publish on an input."""
        self.publishers[topic].publish(message)

    def stamp(self) -> int:
        """The time inputs are stamped with."""
        return self.now_ns if self.sim_time else self.node.get_clock().now().nanoseconds

    def send(
        self,
        *,
        speed: float = 10.0,
        wheels: tuple[float, ...] | None = None,
        demand: float = 5000.0,
        soc: float = 0.5,
        temperature: float = 25.0,
        stamp_ns: int | None = None,
        torques: tuple[float, ...] = (),
        names: tuple[str, ...] = messages.WHEEL_NAMES,
        without: tuple[str, ...] = (),
    ) -> int:
        """Publish one set of inputs, the demand last; returns its stamp."""
        stamp = self.stamp() if stamp_ns is None else stamp_ns
        wheels = (speed / 0.33,) * 4 if wheels is None else wheels
        set_of_inputs = {
            messages.VEHICLE_SPEED: messages.vehicle_speed_message(stamp, speed),
            messages.WHEEL_STATES: messages.wheel_states_message(
                stamp, names, wheels, torques or self.reported() or (0.0,) * len(wheels)
            ),
            messages.BATTERY_STATE: messages.battery_state_message(
                stamp, soc=soc, voltage_v=237.0, discharge_current_a=10.0, temperature_c=temperature
            ),
            messages.POWER_DEMAND: messages.number_message(demand),
        }
        for topic, message in set_of_inputs.items():
            if topic not in without:
                self.publish(topic, message)
        return stamp

    def drive(
        self,
        condition: Callable[[], Any],
        what: str,
        *,
        period_s: float = 0.01,
        patience_s: float = PATIENCE_S,
        **inputs: Any,
    ) -> Any:
        """Publish inputs at a steady rate until `condition` is true; returns what it returned."""
        end = time.monotonic() + patience_s
        due = time.monotonic()
        while not (found := condition()):
            now = time.monotonic()
            assert now < end, f"waited in vain for {what}"
            if now >= due:
                if self.sim_time:
                    self.now_ns += int(period_s * 1e9)
                    self.publish(messages.CLOCK, messages.clock_message(self.now_ns))
                self.send(**inputs)
                due = max(due + period_s, now)
            self.executor.spin_once(timeout_sec=max(due - time.monotonic(), 0.0))
        return found

    def answer_to(self, stamp_ns: int) -> tuple[JointState, JointState]:
        """Commands with a stamp, in lock-step."""

        def find() -> tuple[JointState, JointState] | None:
            torque = [m for m in self.torques if messages.stamp_to_ns(m.header.stamp) == stamp_ns]
            friction = [m for m in self.frictions if messages.stamp_to_ns(m.header.stamp) == stamp_ns]
            return (torque[-1], friction[-1]) if torque and friction else None

        return self.spin_until(find, f"the answer to {stamp_ns}")

    # Outputs

    def last(self, signal_name: str) -> float:
        """Last value of a signal of the state topic; NaN before the first."""
        return self.states[-1][signal_name] if self.states else float("nan")

    def mode(self) -> int:
        """Mode in the last state; -1 before the first."""
        return int(self.last("mode")) if self.states else -1

    def status(self, name: str) -> Any:
        """The newest diagnostic status of that name."""
        for array in reversed(self.diagnostics):
            for status in array.status:
                if status.name == f"{self.node.get_namespace().rstrip('/')}/power_manager: {name}":
                    return status
        return None
