# SPDX-License-Identifier: Apache-2.0
"""Take messages from DDS as the bytes they arrived in, at the least possible cost.

An rclpy executor spends some 200 us on every message (it builds a wait set over all entities each time); the take
itself costs about 2 us. So nothing waits here: subscriptions have deep queues, their callback group keeps every
executor away from them, and `take` empties all of them in one go, some ten times a second or more. Nothing is lost in
precision by that, because the middleware stamps each message at its arrival; sorted by that stamp, the batch is in the
order of arrival across topics.
"""

from __future__ import annotations

import re
import struct
import time
from collections.abc import Callable, Iterable, Sequence
from operator import itemgetter
from typing import Any, NamedTuple

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

from iwm_power_manager.bags.losses import Losses
from iwm_power_manager.bags.metadata import INFINITE
from iwm_power_manager.ros.intake import Unattended, never_called
from iwm_power_manager.ros.messages import message_class

#: One message as it was taken: topic number, received (ns), bytes, sent (ns), the publisher's counter.
Taken = tuple[int, int, bytes, int, int]

#: A serialized `rosgraph_msgs/Clock`: seconds and nanoseconds behind the encapsulation.
CLOCK_FIELDS = struct.Struct("<iI")
CLOCK_FIELDS_OFFSET = 4

#: The counter as a bag has it: 32 bits.
_COUNTER = 0xFFFFFFFF

#: Messages taken from one topic before the next has its turn, so that a flood on one cannot starve the others.
_TURN = 5000

#: What the middleware says while it has not heard of a publisher's node.
_UNKNOWN_NODE_NAME = "_NODE_NAME_UNKNOWN_"


class FoundTopic(NamedTuple):
    """A topic that `RawSubscriptions` has just subscribed to."""

    number: int
    name: str
    type: str
    type_hash: str
    offered: tuple[Qos, ...]


class _Topic:
    """A subscription and what was counted on it."""

    __slots__ = (
        "count",
        "losses",
        "lost",
        "missed",
        "msg_class",
        "name",
        "number",
        "request",
        "single",
        "subscription",
    )

    def __init__(self, number: int, name: str, msg_class: type) -> None:
        self.number = number
        self.name = name
        self.msg_class = msg_class
        self.subscription: Any = None  # until `_subscribe`
        self.request: tuple[ReliabilityPolicy, DurabilityPolicy] | None = None
        self.single = True  # one publisher: its counter shows what is missing
        self.count = 0
        self.losses = Losses()
        self.lost = 0  # missing between the first and the last message while there was one publisher
        self.missed = 0  # sent before the first message that arrived


class RawSubscriptions:
    """Raw subscriptions to every topic that has a publisher and is asked for by name or by regular expression.

    Parameters
    ----------
    node : the node they belong to
    names : full topic names
    pattern : regular expression a full topic name has to match as a whole; None for none
    depth : messages each subscription keeps until they are taken
    prepare : called with the type of a topic before it is subscribed: what takes long and is needed for its messages

    Attributes
    ----------
    publishers : full names of the nodes that publish these topics, as far as they are known
    """

    def __init__(
        self,
        node: Node,
        names: Iterable[str],
        pattern: re.Pattern[str] | None = None,
        depth: int = 2000,
        prepare: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._node = node
        self._prepare = prepare
        self._names = frozenset(names)
        self._pattern = pattern
        self._depth = depth
        self.publishers: set[str] = set()
        self._group = Unattended()
        self._topics: dict[str, _Topic] = {}
        self._refused: dict[str, str] = {}

    def discover(self) -> tuple[list[FoundTopic], list[str]]:
        """Subscribe to topics that have appeared; returns them, and a line for each that cannot be subscribed."""
        found: list[FoundTopic] = []
        problems: list[str] = []
        for name, types in self._node.get_topic_names_and_types():
            if name not in self._names and not (self._pattern and self._pattern.fullmatch(name)):
                continue
            publishers = self._node.get_publishers_info_by_topic(name)
            if not publishers:
                continue
            self.publishers |= _node_names(publishers)
            try:
                topic = self._topics.get(name)
                if topic is None:
                    topic = _Topic(len(self._topics) + 1, name, _message_class(name, types))
                    self._prepare(types[0])
                    self._subscribe(topic, publishers)
                    self._topics[name] = topic
                    found.append(_found(topic, types[0], publishers))
                else:
                    self._subscribe(topic, publishers)
                topic.single = topic.single and len(publishers) == 1
            except ValueError as error:
                if self._refused.get(name) != str(error):
                    self._refused[name] = str(error)
                    problems.append(str(error))
        return found, problems

    def unmatched(self, names: Iterable[str]) -> list[str]:
        """Those of these topics that are not subscribed, or have no publisher that is matched."""
        return [
            name
            for name in names
            if name not in self._topics or not self._topics[name].subscription.get_publisher_count()
        ]

    def take(self) -> list[Taken]:
        """All messages that have arrived, in the order of arrival."""
        batch: list[Taken] = []
        for topic in list(self._topics.values()):
            self._take_topic(topic, batch)
        batch.sort(key=itemgetter(1))
        return batch

    def counts(self) -> dict[str, tuple[int, int, int]]:
        """By topic: messages taken, lost on the way, and sent before the first one that arrived.

        Losses are seen by the publisher's counter; with more than one publisher on a topic they cannot be told.
        """
        return {
            topic.name: (topic.count, min(topic.lost, topic.losses.count), topic.missed)
            for topic in list(self._topics.values())
        }

    def _take_topic(self, topic: _Topic, batch: list[Taken]) -> None:
        handle = topic.subscription.handle
        msg_class, number = topic.msg_class, topic.number
        losses = topic.losses
        before = len(batch)
        with handle:
            take = handle.take_message
            for _ in range(_TURN):
                taken = take(msg_class, True)
                if taken is None:
                    break
                data, info = taken
                sequence = info["publication_sequence_number"] or 0
                if sequence == losses.last + 1:
                    losses.last = sequence
                else:
                    topic.missed += 0 if losses.last else max(sequence - 1, 0)
                    losses.take(sequence)
                received = info["received_timestamp"] or time.time_ns()
                batch.append((number, received, data, info["source_timestamp"] or received, sequence & _COUNTER))
        topic.count += len(batch) - before
        if topic.single:
            topic.lost = losses.count

    def _subscribe(self, topic: _Topic, publishers: Sequence[TopicEndpointInfo]) -> None:
        """Subscribe with a request every publisher can meet; again, if a newcomer cannot meet the present one."""
        request = (
            _weakest(publishers, "reliability", ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT),
            _weakest(publishers, "durability", DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE),
        )
        if topic.request is not None and not _asks_more(topic.request, request):
            return
        previous = topic.subscription
        topic.subscription = self._node.create_subscription(
            topic.msg_class,
            topic.name,
            never_called,
            QoSProfile(
                history=HistoryPolicy.KEEP_LAST, depth=self._depth, reliability=request[0], durability=request[1]
            ),
            callback_group=self._group,
            raw=True,
        )
        topic.request = request
        if previous is not None:
            self._node.destroy_subscription(previous)


def _weakest(publishers: Sequence[TopicEndpointInfo], policy: str, strong: Any, weak: Any) -> Any:
    return strong if all(getattr(info.qos_profile, policy) == strong for info in publishers) else weak


def _asks_more(
    present: tuple[ReliabilityPolicy, DurabilityPolicy], possible: tuple[ReliabilityPolicy, DurabilityPolicy]
) -> bool:
    strong = (ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL)
    return any(have == want and can != want for have, can, want in zip(present, possible, strong, strict=True))


def _message_class(name: str, types: Sequence[str]) -> type:
    if len(types) != 1:
        raise ValueError(f"{name}: not recorded, it carries more than one type: {', '.join(sorted(types))}")
    try:
        return message_class(types[0])
    except ImportError:
        raise ValueError(f"{name}: not recorded, type {types[0]} is not installed here") from None


def _found(topic: _Topic, msgtype: str, publishers: Sequence[TopicEndpointInfo]) -> FoundTopic:
    known = str(publishers[0].topic_type_hash)
    return FoundTopic(
        topic.number,
        topic.name,
        msgtype,
        known if known.startswith("RIHS01_") else "",
        tuple(dict.fromkeys(_offered(info.qos_profile) for info in publishers)),
    )


def _node_names(publishers: Sequence[TopicEndpointInfo]) -> set[str]:
    """Full node names; a node's name may arrive later than its publishers."""
    return {
        f"{info.node_namespace.rstrip('/')}/{info.node_name}"
        for info in publishers
        if info.node_name != _UNKNOWN_NODE_NAME
    }


def _offered(profile: QoSProfile) -> Qos:
    def time(duration: Duration) -> QosTime:
        return min(QosTime(*divmod(int(duration.nanoseconds), 1_000_000_000)), INFINITE)

    return Qos(
        QosHistory[profile.history.name],
        profile.depth,
        QosReliability[profile.reliability.name],
        QosDurability[profile.durability.name],
        time(profile.deadline),
        time(profile.lifespan),
        QosLiveliness[profile.liveliness.name],
        time(profile.liveliness_lease_duration),
        False,
    )
