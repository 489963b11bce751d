# SPDX-License-Identifier: Apache-2.0
"""Endpoints of others that a node cannot be connected with: another type, or a quality of service that does not fit."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSCompatibility, QoSProfile, qos_check_compatible


def mismatched_publishers(
    node: Node, subscriptions: Iterable[Any], msgtypes: dict[str, str], remedy: Callable[[str, str], str]
) -> dict[str, str]:
    """Why publishers of these subscriptions' topics are not heard, by topic name of the subscription.

    Parameters
    ----------
    node : whose subscriptions they are
    subscriptions : of rclpy
    msgtypes : type of each, by topic name
    remedy : says, for a topic and the type it is sent with, what to do about another type
    """
    found = {}
    for subscription in subscriptions:
        topic = subscription.topic_name
        if subscription.get_publisher_count() < node.count_publishers(topic):
            lines = []
            for info in node.get_publishers_info_by_topic(topic):
                sent = info.topic_type
                if sent != msgtypes[topic]:
                    lines.append(f"{node_name(info)} sends {sent}, not {msgtypes[topic]}{remedy(topic, sent)}")
                elif reason := _misfit(info.qos_profile, subscription.qos_profile):
                    lines.append(f"{node_name(info)} offers another quality of service: {reason}")
            found[topic] = "; ".join(lines)
    return {topic: text for topic, text in found.items() if text}


def mismatched_subscribers(node: Node, publishers: Iterable[Any], msgtypes: dict[str, str]) -> dict[str, str]:
    """Why subscribers of these publishers' topics do not hear them, by topic name of the publisher."""
    found = {}
    for publisher in publishers:
        topic = publisher.topic_name
        if publisher.get_subscription_count() < node.count_subscribers(topic):
            lines = []
            for info in node.get_subscriptions_info_by_topic(topic):
                if info.topic_type != msgtypes[topic]:
                    lines.append(f"{node_name(info)} wants {info.topic_type}, not {msgtypes[topic]}")
                elif reason := _misfit(publisher.qos_profile, info.qos_profile):
                    lines.append(f"{node_name(info)} asks for another quality of service: {reason}")
            found[topic] = "; ".join(lines)
    return {topic: text for topic, text in found.items() if text}


def node_name(info: Any) -> str:
    """Full name of the node an endpoint belongs to."""
    return f"{info.node_namespace.rstrip('/')}/{info.node_name}"


def _misfit(offered: QoSProfile, wanted: QoSProfile) -> str:
    """The policies that do not fit, of a text such as "ERROR: Best effort publisher and reliable subscription;"."""
    fits, reason = qos_check_compatible(offered, wanted)
    if fits != QoSCompatibility.ERROR:
        return ""
    parts = [part.removeprefix("ERROR:").strip() for part in reason.split(";")]
    return ", ".join(part.lower() for part in parts if part and not part.startswith("WARNING"))
