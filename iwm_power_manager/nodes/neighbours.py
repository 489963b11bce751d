# SPDX-License-Identifier: Apache-2.0
"""Who else is on the power manager's topics: who obeys, other commanders, second sources, who cannot be connected."""

from __future__ import annotations

from typing import NamedTuple

from rclpy.node import Node

from iwm_power_manager.nodes.power_manager_inputs import Inputs
from iwm_power_manager.nodes.power_manager_outputs import Outputs
from iwm_power_manager.ros import diagnostics
from iwm_power_manager.ros.matching import mismatched_publishers, mismatched_subscribers, node_name

#: Nodes that hear commands and obey none: this package's own, rosbag2's, and those of the command `ros2`.
_WATCHERS, _COMMAND_LINE = ("recorder", "watch_car", "rosbag2_recorder"), "_ros2cli"


class Neighbours(NamedTuple):
    """What was found.

    Attributes
    ----------
    statuses : for `/diagnostics`
    problems : a line each
    unheard : why a topic is not heard, or not well, by topic
    unobeyed : topics of commands that nobody subscribes to
    """

    statuses: list[diagnostics.Status]
    problems: list[str]
    unheard: dict[str, str]
    unobeyed: list[str]


def look(node: Node, inputs: Inputs, outputs: Outputs, slow: dict[str, str]) -> Neighbours:
    """Look at the graph as it is now; `slow` tells of topics that are heard, but not as often as they should be."""
    types = inputs.types | outputs.types
    commanders = {topic: node.count_publishers(topic) for topic in map(node.resolve_topic_name, outputs.topics)}
    deaf = _lines(mismatched_subscribers(node, outputs.publishers, types))
    wrong = [*_shared(node, commanders), *deaf]
    obeying = {topic: _obeying(node, topic) for topic in commanders}
    unobeyed = [topic for topic, count in obeying.items() if not count]
    values = {f"{topic}: publishers": str(count) for topic, count in commanders.items()}
    values |= {f"{topic}: subscriptions": str(count) for topic, count in obeying.items()}
    level = diagnostics.ERROR if wrong else diagnostics.WARN if unobeyed else diagnostics.OK
    lines = [*wrong, *([nobody_obeys(unobeyed)] if unobeyed else [])]
    statuses = [diagnostics.Status("command topics", level, "; ".join(lines) or "ok", values)]
    mismatches = mismatched_publishers(node, inputs.subscriptions, types, inputs.how_to_hear)
    unheard = _lines(mismatches)
    senders = {found.topic_name: node.count_publishers(found.topic_name) for found in inputs.subscriptions}
    several = _shared(node, senders)
    heard_badly = [*unheard, *several, *_lines(slow)]
    if heard_badly:
        level = diagnostics.ERROR if unheard else diagnostics.WARN
        statuses.append(diagnostics.Status("input topics", level, "; ".join(heard_badly), {}))
    silent = {
        topic: "no message" if count else "no publisher"
        for topic, count in senders.items()
        if not count or topic not in inputs.heard_ns
    }
    return Neighbours(statuses, [*wrong, *heard_badly], slow | silent | mismatches, unobeyed)


def nobody_obeys(topics: list[str]) -> str:
    """What is said of commands that go nowhere."""
    return f"nobody subscribes to {', '.join(topics)}"


def _obeying(node: Node, topic: str) -> int:
    """Subscriptions to a topic, without those of nodes that are known to watch only."""
    names = [info.node_name for info in node.get_subscriptions_info_by_topic(topic)]
    return sum(name not in _WATCHERS and not name.startswith(_COMMAND_LINE) for name in names)


def _lines(reasons: dict[str, str]) -> list[str]:
    """A line for all topics that have the same reason."""
    topics: dict[str, list[str]] = {}
    for topic, why in reasons.items():
        topics.setdefault(why, []).append(topic)
    return [f"{', '.join(found)}: {why}" for why, found in topics.items()]


def _shared(node: Node, publishers: dict[str, int]) -> list[str]:
    """A line for all topics that have the same publishers, more than one; a node that has two is named twice."""
    found: dict[str, list[str]] = {}
    for topic in (topic for topic, count in publishers.items() if count > 1):
        names = ", ".join(sorted(map(node_name, node.get_publishers_info_by_topic(topic))))
        found.setdefault(f"{publishers[topic]} publishers{{}}: {names}", []).append(topic)
    return [
        f"{', '.join(topics)} " + ("have " + words.format(" each") if len(topics) > 1 else "has " + words.format(""))
        for words, topics in found.items()
    ]
