# SPDX-License-Identifier: Apache-2.0
"""What the power manager hears: a subscription to each topic the signals file names, and its messages as readings."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import pairwise
from math import inf
from statistics import median
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions

from iwm_power_manager.control.lockstep import BATTERY, SPEED, WHEELS, LockstepQueue
from iwm_power_manager.control.monitor import BatteryReading, InputMonitor, JointReading, SpeedReading
from iwm_power_manager.errors import BagError
from iwm_power_manager.ros import messages, qos
from iwm_power_manager.ros.intake import Intake
from iwm_power_manager.signals.mapping import DEMANDS, PEDALS
from iwm_power_manager.signals.readings import (
    DemandReading,
    DirectionReading,
    FrictionReading,
    MotionReading,
    TopicReader,
    TorqueReading,
    field_like,
)
from iwm_power_manager.signals.types import types_of

#: The queue of each stamped input of a lock-step set.
_QUEUES: dict[type, int] = {SpeedReading: SPEED, JointReading: WHEELS, BatteryReading: BATTERY}
_NS_PER_S = 1_000_000_000
#: A rate is that of so many messages at most, and of so many at least.
_MOST_SENT, _FEWEST_SENT = 32, 5
#: Slower than this part of the rate that was said is another rate, until it is faster than the second part of it.
_SLOW, _SLOW_NO_MORE = 0.6, 0.8
#: After so many periods without a message a topic is silent, and not slow.
_SILENT = 4.0


def rate_hz(sent_ns: Collection[int]) -> float:
    """Rate of messages sent at these times, by the middle one of their gaps: some may be missing, or have come late.

    Infinite for too few to tell, and for bursts.
    """
    gaps_ns = [later - sooner for sooner, later in pairwise(sent_ns)]
    gap_ns = median(gaps_ns) if len(sent_ns) >= _FEWEST_SENT else 0
    return _NS_PER_S / gap_ns if gap_ns > 0 else inf


class Inputs:
    """Subscriptions of the power manager.

    Parameters
    ----------
    node : whose they are
    readers : of each topic
    on_demand : in lock-step, called with each message of the demand, which closes a set; None in real time

    Attributes
    ----------
    types : message type of each topic, by full name
    heard_ns : when the last message came on a topic, by full name: of the node's clock
    """

    def __init__(
        self,
        node: Node,
        readers: dict[str, TopicReader],
        on_demand: Callable[[bytes, dict[str, Any]], None] | None,
    ) -> None:
        self._node = node
        self._readers = readers
        self._intake = Intake(node)
        self._demand: tuple[TopicReader, Any] | None = None
        self._full = {topic: node.resolve_topic_name(topic) for topic in readers}
        self.types = {self._full[topic]: reader.read.types.name for topic, reader in readers.items()}
        self.heard_ns: dict[str, int] = {}
        self._sent_ns = {topic: deque[int](maxlen=_MOST_SENT) for topic in self.types}
        self._slow: dict[str, dict[str, str]] = {}
        self._of_one_wheel = {
            topic for topic, reader in readers.items() if any(source.of_one_wheel for source in reader.sources)
        }
        for topic, reader in readers.items():
            kind = messages.message_class(reader.read.types.name)
            asked = _asked(reader, lockstep=on_demand is not None)
            if on_demand is not None and set(reader.signals).intersection((*DEMANDS, *PEDALS)):
                subscription = node.create_subscription(
                    kind,
                    topic,
                    on_demand,
                    asked,
                    event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
                    raw=True,
                    qos_overriding_options=QoSOverridingOptions.with_default_policies(),
                )
                self._demand = (reader, subscription)
            else:
                self._intake.subscribe(kind, topic, asked, raw=True)

    @property
    def subscriptions(self) -> list[Any]:
        """The subscriptions, for whoever wants to know what they are matched with."""
        return [*self._intake.subscriptions(), *([self._demand[1]] if self._demand else [])]

    def drop_all(self) -> None:
        """Forget what has arrived."""
        self._intake.drop_all()
        for sent_ns in self._sent_ns.values():
            sent_ns.clear()

    def take(self, monitor: InputMonitor, now_ns: int) -> None:
        """Real time: judge what has arrived on every topic."""
        ahead_ns = now_ns - time.time_ns()  # of DDS, which tells when an unstamped message was sent
        for topic, reader in self._readers.items():
            taken = [(data, info["source_timestamp"] + ahead_ns) for data, info in self._intake.take(topic)]
            if not taken:
                continue
            self.heard_ns[self._full[topic]] = now_ns
            self._sent_ns[self._full[topic]].extend(sent_ns for _, sent_ns in taken)
            # Four wheels on four topics are put together: a second of one would come before the first of the next.
            for data, sent_ns in taken[-1:] if topic in self._of_one_wheel else taken:
                for reading in reader(data, sent_ns):
                    judge(monitor, reading, now_ns)

    def push_demand(self, queue: LockstepQueue, data: bytes, info: dict[str, Any]) -> None:
        """Lock-step: a demand into the queue of sets."""
        assert self._demand is not None
        sent_ns = info["source_timestamp"]
        self.heard_ns[self._demand[1].topic_name] = sent_ns
        for reading in self._demand[0](data, sent_ns):
            if isinstance(reading, DemandReading):
                queue.push_demand(sent_ns, reading.power_w)

    def collect(self, queue: LockstepQueue, monitor: InputMonitor, now_ns: int) -> None:
        """Lock-step: what belongs to a set into the queue of sets, the rest to the monitor."""
        for topic, reader in self._readers.items():
            for data, info in self._intake.take(topic):
                self.heard_ns[self._full[topic]] = now_ns
                for reading in reader(data, info["source_timestamp"]):
                    kind = _QUEUES.get(type(reading))
                    if kind is not None:
                        queue.push(kind, reading.stamp_ns, info["source_timestamp"], reading)
                    else:
                        judge(monitor, reading, now_ns)

    def slow(self, topics: Mapping[str, Sequence[str]], values: Mapping[str, Any], now_ns: int) -> dict[str, str]:
        """Topics that come far more slowly than their period says, by full name, with the rate of an input's slowest;
        the same topics and words as long as it lasts.

        Parameters
        ----------
        topics : of each of the controller's inputs, by full name
        values : the node's parameters
        now_ns : the node's clock
        """
        found = {}
        for name, of_input in topics.items():
            period_s = values.get(f"input_period_s.{name}", inf)  # friction may come when it likes
            enough_hz = (_SLOW_NO_MORE if name in self._slow else _SLOW) / period_s
            silent_ns = {topic: now_ns - self.heard_ns.get(topic, 0) for topic in of_input}
            rates = {topic: rate_hz(self._sent_ns[topic]) for topic in of_input}
            slow = [t for t, hz in rates.items() if hz < enough_hz and hz * silent_ns[t] < _SILENT * _NS_PER_S]
            if slow:
                hz = min(rates[topic] for topic in slow)
                words = f"comes at {hz:.3g} Hz, not at {1.0 / period_s:.3g}: input_period_s.{name} is {period_s:g}"
                found[name] = self._slow.get(name) or dict.fromkeys(slow, words)
        self._slow = found
        return {topic: words for of_input in found.values() for topic, words in of_input.items()}

    def how_to_hear(self, topic: str, msgtype: str) -> str:
        """What to write in the signals file to take a topic (full name) with another type; "" if that is not clear."""
        try:
            types = types_of(msgtype)
        except BagError:
            return ""
        (reader,) = (self._readers[name] for name, full in self._full.items() if full == topic)
        fields = {source.key: field_like(source, types) for source in reader.sources}
        found = [f"{key}: {{type: {msgtype}, field: {field}}}" for key, field in fields.items() if field]
        return f"; to hear it, write {', '.join(found)}" if found else ""

    def close(self) -> None:
        """Drop the subscriptions."""
        self._intake.close()
        if self._demand is not None:
            self._node.destroy_subscription(self._demand[1])
            self._demand = None


def _asked(reader: TopicReader, *, lockstep: bool) -> QoSProfile:
    if lockstep:
        return qos.profile(lockstep=True)
    reliable = any(source.qos == "reliable" for source in reader.sources)
    return qos.profile(lockstep=False, depth=qos.INPUT_DEPTH, reliability="reliable" if reliable else "best_effort")


def judge(monitor: InputMonitor, reading: Any, now_ns: int) -> None:
    """Hand a reading to the monitor."""
    kind = type(reading)
    if kind is SpeedReading:
        monitor.take_speed(reading, now_ns)
    elif kind is JointReading:
        monitor.take_wheels(reading, now_ns)
    elif kind is BatteryReading:
        monitor.take_battery(reading, now_ns)
    elif kind is DemandReading:
        monitor.take_demand(reading.power_w, (now_ns - reading.stamp_ns) / _NS_PER_S, now_ns, reading.lag_s)
    elif kind is FrictionReading:
        monitor.take_friction(reading.friction, now_ns)
    elif kind is TorqueReading:
        monitor.take_torques(reading, now_ns)
    elif kind is DirectionReading:
        monitor.direction = reading.direction
    elif kind is MotionReading:
        monitor.take_motion(reading.signal, reading.value, now_ns)
