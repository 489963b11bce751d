# SPDX-License-Identifier: Apache-2.0
"""Inputs that are fetched when they are needed, instead of waking the node one by one.

An executor spends some 100 us or more on every message it dispatches; a take costs a few. A control step wants the
newest message of every topic at one moment, so it takes them then. A publisher that floods a topic cannot starve the
loop either: of a short queue, whatever comes between two steps overwrites itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions


class Unattended(CallbackGroup):
    """A group no executor ever serves."""

    def can_execute(self, _entity: Any) -> bool:
        """Never."""
        return False

    def beginning_execution(self, _entity: Any) -> bool:
        """Never begins."""
        return False

    def ending_execution(self, _entity: Any) -> None:
        """Nothing was begun."""


def never_called(_message: Any) -> None:
    """Callback of a subscription in an `Unattended` group."""
    raise AssertionError("an executor served an unattended subscription")


class Intake:
    """Unattended subscriptions of a node, by topic."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._group = Unattended()
        self._subscriptions: dict[str, Any] = {}
        self._raw: dict[str, bool] = {}

    def subscribe(self, kind: type, topic: str, profile: QoSProfile, *, raw: bool = False) -> None:
        """Subscribe; the profile can be overridden by the node's `qos_overrides` parameters.

        With `raw`, `take` gives a message's bytes instead of the message.
        """
        self._raw[topic] = raw
        self._subscriptions[topic] = self._node.create_subscription(
            kind,
            topic,
            never_called,
            profile,
            callback_group=self._group,
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )

    def take(self, topic: str) -> Iterator[tuple[Any, dict[str, Any]]]:
        """Messages that have arrived since the last call, oldest first, each with its DDS information."""
        subscription = self._subscriptions.get(topic)
        if subscription is None:
            return
        # A flood that arrives faster than it is taken must not hold the caller: one queue's worth at most.
        for _ in range(subscription.qos_profile.depth):
            with subscription.handle:
                taken = subscription.handle.take_message(subscription.msg_type, self._raw[topic])
            if taken is None:
                return
            yield taken

    def drop_all(self) -> None:
        """Forget what has arrived on any topic."""
        for topic in self._subscriptions:
            for _ in self.take(topic):
                pass

    def subscriptions(self) -> list[Any]:
        """The subscriptions, for whoever wants to know what they are matched with."""
        return list(self._subscriptions.values())

    def close(self) -> None:
        """Drop all subscriptions."""
        for subscription in self._subscriptions.values():
            self._node.destroy_subscription(subscription)
        self._subscriptions.clear()
        self._raw.clear()
