# SPDX-License-Identifier: Apache-2.0
"""What the power manager sends: commands to the topics the signals file names, and its own state."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.lifecycle import LifecycleNode
from rclpy.qos_overriding_options import QoSOverridingOptions

from iwm_power_manager.control.controller import Step
from iwm_power_manager.control.record import SIGNAL_NAMES
from iwm_power_manager.nodes.preparation import Prepared
from iwm_power_manager.ros import messages, qos
from iwm_power_manager.signals.commands import FRICTION, MOTOR
from iwm_power_manager.signals.contract import JOINT_STATE, NODE_FRICTION, NODE_STATE
from iwm_power_manager.signals.readings import joint_state_writer

_ZERO = (0.0, 0.0, 0.0, 0.0)
_ACKNOWLEDGE_S = 0.2
_ESTIMATE = ("left_friction", "right_friction", "left_friction_confidence", "right_friction_confidence")
_ESTIMATE_S = 0.1


class Outputs:
    """Publishers of the commands and of the state, by topic.

    Parameters
    ----------
    node : whose they are
    prepared : with the signals file and the writers of its commands
    period_s : of the control loop; None in lock-step

    Attributes
    ----------
    topics : of the commands, as the signals file names them
    types : message type of each topic, by full name
    """

    def __init__(self, node: LifecycleNode, prepared: Prepared, period_s: float | None) -> None:
        self._node = node
        self._writers = prepared.commands
        self._write_state = joint_state_writer(SIGNAL_NAMES, "position")
        self._write_estimate = joint_state_writer(_ESTIMATE, "position")
        self._estimate_every = max(round(_ESTIMATE_S / (period_s or _ESTIMATE_S)), 1)
        self._steps = 0
        types = {sink.topic: sink.type for sinks in prepared.mapping.commands.values() for sink in sinks}
        self.topics = list(types)
        types[NODE_STATE] = types[NODE_FRICTION] = JOINT_STATE
        self.types = {node.resolve_topic_name(topic): kind for topic, kind in types.items()}
        offered = dict.fromkeys(self.topics, qos.command_profile(period_s))
        offered[NODE_STATE] = offered[NODE_FRICTION] = qos.profile(lockstep=period_s is None)
        # What cannot be met is told in the diagnostics; an event handler would be waited for at each step.
        silent = PublisherEventCallbacks(use_default_callbacks=False)
        overrides = QoSOverridingOptions.with_default_policies()
        self._publishers: dict[str, Any] = {
            topic: node.create_lifecycle_publisher(
                messages.message_class(types[topic]),
                topic,
                profile,
                event_callbacks=silent,
                qos_overriding_options=overrides,
            )
            for topic, profile in offered.items()
        }

    @property
    def publishers(self) -> list[Any]:
        """The publishers, for whoever wants to know what they are matched with."""
        return list(self._publishers.values())

    def answer(self, stamp_ns: int, step: Step) -> list[tuple[str, bytes]]:
        """Messages that say what came of a step, by topic."""
        made = step.command
        answer = [
            *self._writers[MOTOR](stamp_ns, made.motor_torque_nm),
            *self._writers[FRICTION](stamp_ns, made.friction_torque_nm),
            (NODE_STATE, self._write_state(stamp_ns, step.values)),
        ]
        if self._steps % self._estimate_every == 0:
            grip = (made.left_friction, made.right_friction, made.left_confidence, made.right_confidence)
            answer.append((NODE_FRICTION, self._write_estimate(stamp_ns, grip)))
        self._steps += 1
        return answer

    def publish(self, answer: list[tuple[str, bytes]], may_send: Callable[[float], bool] = lambda _: True) -> bool:
        """Publish messages; no command any more once `may_send` forbids one at its moment (monotonic s), then False."""
        allowed = True
        for topic, data in answer:
            publisher = self._publishers[topic]
            send = publisher.handle.publish_raw  # nothing more stands between the look at the clock and DDS
            if not publisher.is_activated:
                continue
            if topic in self.topics and not (allowed := allowed and may_send(time.monotonic())):
                continue
            send(data)
        return allowed

    def zero(self, now_ns: int) -> None:
        """Command zero torque."""
        for write in self._writers.values():
            self.publish(write(now_ns, _ZERO))

    def wait(self) -> None:
        """Wait a moment, the same for all topics, for those who obey to have the last command."""
        until_s = time.monotonic() + _ACKNOWLEDGE_S
        for topic in self.topics:
            left_s = max(until_s - time.monotonic(), 0.0)
            self._publishers[topic].wait_for_all_acked(Duration(seconds=left_s))

    def close(self) -> None:
        """Drop the publishers."""
        for publisher in self._publishers.values():
            self._node.destroy_lifecycle_publisher(publisher)
        self._publishers.clear()
