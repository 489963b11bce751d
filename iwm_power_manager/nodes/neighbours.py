# SPDX-License-Identifier: Apache-2.0
"""Who else is on the power manager's topics: other commanders, second sources, and whoever cannot be connected with."""

from __future__ import annotations

from typing import NamedTuple

from rclpy.node import Node

from iwm_power_manager.nodes.power_manager_inputs import Inputs
from iwm_power_manager.nodes.power_manager_outputs import Outputs
from iwm_power_manager.ros import diagnostics
from iwm_power_manager.ros.matching import mismatched_publishers, mismatched_subscribers


class Neighbours(NamedTuple):
    """What was found.

    Attributes
    ----------
    statuses : for `/diagnostics`
    problems : a line each
    unheard : why a topic is not heard, by topic
    """

    statuses: list[diagnostics.Status]
    problems: list[str]
    unheard: dict[str, str]


def look(node: Node, inputs: Inputs, outputs: Outputs) -> Neighbours:
    """Look at the graph as it is now."""
    types = inputs.types | outputs.types
    counts = {topic: node.count_publishers(topic) for topic in outputs.topics}
    others = [f"{topic} has {count} publishers" for topic, count in counts.items() if count > 1]
    deaf = mismatched_subscribers(node, outputs.publishers, types)
    problems = [*others, *(f"{topic}: {why}" for topic, why in deaf.items())]
    values = {f"{topic}: publishers": str(count) for topic, count in counts.items()}
    level = diagnostics.ERROR if problems else diagnostics.OK
    statuses = [diagnostics.Status("command topics", level, "; ".join(problems) or "ok", values)]
    mismatches = mismatched_publishers(node, inputs.subscriptions, types)
    unheard = [f"{topic}: {why}" for topic, why in mismatches.items()]
    senders = {found.topic_name: node.count_publishers(found.topic_name) for found in inputs.subscriptions}
    several = [f"{topic} has {count} publishers" for topic, count in senders.items() if count > 1]
    if unheard or several:
        level = diagnostics.ERROR if unheard else diagnostics.WARN
        statuses.append(diagnostics.Status("input topics", level, "; ".join([*unheard, *several]), {}))
    silent = {topic: "no publisher" for topic, count in senders.items() if not count}
    return Neighbours(statuses, [*problems, *unheard, *several], silent | mismatches)
