# SPDX-License-Identifier: Apache-2.0
"""Another vehicle stack: whatever topics and types it has, beside a power manager that is told of them by YAML."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from member import Member

from iwm_power_manager.ros import messages, qos

PATIENCE_S = 60.0
JOINTS, NUMBER, NUMBERS = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64", "std_msgs/msg/Float64MultiArray"


class Stack(Member):
    """Publishes and hears topics of any type.

    Parameters
    ----------
    namespace : of the node
    sends : type of each topic it publishes
    hears : type of each topic it subscribes to
    reliability : of what it publishes
    """

    def __init__(
        self,
        namespace: str,
        sends: Mapping[str, str],
        hears: Mapping[str, str],
        reliability: str = "best_effort",
    ) -> None:
        super().__init__("stack", namespace)
        offered = qos.profile(lockstep=False, reliability=reliability)
        self.publishers = {
            topic: self.node.create_publisher(messages.message_class(kind), topic, offered)
            for topic, kind in sends.items()
        }
        self.received: dict[str, list[Any]] = {topic: [] for topic in hears}
        keep_all = qos.profile(lockstep=True)
        for topic, kind in hears.items():
            self.node.create_subscription(messages.message_class(kind), topic, self.received[topic].append, keep_all)
        self.diagnostics: list[DiagnosticArray] = []
        self.node.create_subscription(DiagnosticArray, f"{namespace}/diagnostics", self.diagnostics.append, keep_all)

    def stamp(self) -> Any:
        """The present time."""
        return self.node.get_clock().now().to_msg()

    def drive(
        self,
        make: Callable[[Stack], Mapping[str, Any]],
        condition: Callable[[], Any],
        what: str,
        period_s: float = 0.01,
    ) -> Any:
        """Publish what `make` gives at a steady rate until `condition` is true; returns what it returned."""
        end = time.monotonic() + PATIENCE_S
        due = time.monotonic()
        while not (found := condition()):
            now = time.monotonic()
            assert now < end, f"waited in vain for {what}; {self.text()}"
            if now >= due:
                for topic, message in make(self).items():
                    self.publishers[topic].publish(message)
                due = max(due + period_s, now)
            self.executor.spin_once(timeout_sec=max(due - time.monotonic(), 0.0))
        return found

    def last(self, topic: str) -> Any:
        """Newest message of a topic; None before the first."""
        return self.received[topic][-1] if self.received[topic] else None

    def text(self) -> str:
        """What the last diagnostics say."""
        if not self.diagnostics:
            return "no diagnostics"
        return "; ".join(f"{status.name}: {status.message}" for status in self.diagnostics[-1].status)


def number(value: float) -> Any:
    """A Float64."""
    return messages.number_message(float(value))


def of_type(msgtype: str, **fields: Any) -> Any:
    """A message with some fields set, by path with `__` for a dot."""
    message = messages.message_class(msgtype)()
    for path, value in fields.items():
        owner: Any = message
        *parents, last = path.split("__")
        for parent in parents:
            owner = getattr(owner, parent)
        setattr(owner, last, value)
    return message
