# SPDX-License-Identifier: Apache-2.0
"""Play a bag to DDS, with /clock, so that the real nodes can be driven by a recorded drive.

Time is the bag's: the log time, or, where a /clock was recorded, what that clock showed; so a lock-step drive, recorded
much faster than real time, is played at the speed it was driven, and one whose clock was set back in between goes on at
its own pace. The messages go out as the bytes they were recorded
in, under the quality of service their publishers had offered.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Collection, Iterator
from typing import Any, NamedTuple

import rclpy
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rosbags.interfaces import QosDurability, QosReliability
from rosgraph_msgs.msg import Clock

from iwm_power_manager.bags.reader import BagReader, Message
from iwm_power_manager.errors import BagError, one_line
from iwm_power_manager.ros import ending
from iwm_power_manager.ros.interruption import Interruption
from iwm_power_manager.ros.messages import CLOCK, clock_message, message_class
from iwm_power_manager.ros.raw import CLOCK_FIELDS, CLOCK_FIELDS_OFFSET
from iwm_power_manager.signals.mapping import topic_named

#: Not inputs: what nodes say about themselves.
_NOT_PLAYED = ("/diagnostics", "/rosout", "/parameter_events", CLOCK)

_TICK_NS = 10_000_000
#: No drive pauses for longer, ns: a clock that jumps by more was set.
_LONGEST_PAUSE_NS = 3600 * 10**9
_NS_PER_S = 1_000_000_000
_DEPTH = 1000
#: Before the first message: until the listeners have stayed the same for the one, at most for the other.
_SETTLE_S = 1.0
_PATIENCE_S = 5.0
_ACKNOWLEDGE_S = 2.0


class PlayOptions(NamedTuple):
    """How a bag is played.

    Attributes
    ----------
    rate : times real time
    step : wait for Enter before each 10 ms
    start_s, end_s : part of the bag, from its begin; None for its end
    loop : begin again at the end
    topics : those to play; () for all but commands and reports
    commands : topics of the bag that others command
    listeners : begin when each topic has so many; 0: when somebody listens and no more listeners appear
    """

    rate: float = 1.0
    step: bool = False
    start_s: float = 0.0
    end_s: float | None = None
    loop: bool = False
    topics: tuple[str, ...] = ()
    commands: Collection[str] = ()
    listeners: int = 0


def play(bag: BagReader, options: PlayOptions) -> int:
    """Play until the end, or until Ctrl-C or SIGTERM; returns the exit code.

    Raises
    ------
    BagError
        Nothing can be played: a topic or a message type is missing.
    """
    interruption = Interruption(started=True)
    interruption.install()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = Node("replay", enable_rosout=False, start_parameter_services=False)
    code = 1
    try:
        player = _Player(node, bag, options, interruption)
        player.wait_for_listeners()
        while player.pass_once() and options.loop and not interruption.requested:
            pass
        player.finish()
        code = 0
    finally:
        with ending.bounded(code):
            node.destroy_node()
    return code


class _Player:
    def __init__(self, node: Node, bag: BagReader, options: PlayOptions, interruption: Interruption) -> None:
        self._bag = bag
        self._options = options
        self._interruption = interruption
        self._publishers, problems = _publishers(node, bag, options)
        for line in problems:
            print(f"replay: {line}", file=sys.stderr)
        self._clock = node.create_publisher(Clock, CLOCK, QoSProfile(depth=_DEPTH))
        self._sent = 0
        self._jumps: list[str] = []

    def wait_for_listeners(self) -> None:
        """Wait for the listeners that were asked for, else until somebody listens and no more listeners appear."""
        wanted = self._options.listeners
        while wanted and not self._interruption.wait(0.02):
            if all(publisher.get_subscription_count() >= wanted for publisher in self._publishers.values()):
                self._interruption.wait(_SETTLE_S)
                return
        deadline = time.monotonic() + _PATIENCE_S
        count, since = -1, time.monotonic()
        while time.monotonic() < deadline and not self._interruption.wait(0.02):
            now = sum(publisher.get_subscription_count() for publisher in self._publishers.values())
            if now != count:
                count, since = now, time.monotonic()
            elif count and time.monotonic() - since > _SETTLE_S:
                return
        if not count and not self._interruption.requested:
            print("replay: nobody listens; playing all the same", file=sys.stderr)

    def pass_once(self) -> bool:
        """Play the chosen part once; False if there was nothing in it."""
        first_ns: int | None = None
        next_tick_ns = 0
        started_s = 0.0
        before = self._sent
        for offset_ns, time_ns, message in paced(self._bag, self._jumps):
            if offset_ns < self._options.start_s * _NS_PER_S:
                continue
            if self._options.end_s is not None and offset_ns > self._options.end_s * _NS_PER_S:
                break
            if first_ns is None:
                first_ns = next_tick_ns = offset_ns
                started_s = time.monotonic()
            while next_tick_ns <= offset_ns:
                due_s = started_s + (next_tick_ns - first_ns) / _NS_PER_S / self._options.rate
                if not self._reach(time_ns - offset_ns + next_tick_ns, due_s, ticks=True):
                    return False
                next_tick_ns += _TICK_NS
            if not self._reach(
                time_ns, started_s + (offset_ns - first_ns) / _NS_PER_S / self._options.rate, ticks=False
            ):
                return False
            publisher = self._publishers.get(message.topic)
            if publisher is not None:
                publisher.publish(message.data)
                self._sent += 1
        if self._sent == before:
            playable = [offset for offset, _, message in paced(self._bag, []) if message.topic in self._publishers]
            span = [f"{offset / _NS_PER_S:.3f}" for offset in playable[:1] + playable[-1:]]
            there = f"; it holds some from {' to '.join(span)} s" if span else ""
            raise BagError(f"{self._bag.path}: holds no message to play between --start and --end{there}")
        return True

    def finish(self) -> None:
        """Wait until listeners have everything, and say what was sent."""
        for publisher in self._publishers.values():
            publisher.wait_for_all_acked(Duration(seconds=_ACKNOWLEDGE_S))
        print(f"{self._bag.path}: {self._sent} messages of {len(self._publishers)} topics published")
        for line in dict.fromkeys([*self._bag.notes, *self._jumps]):
            print(f"  {one_line(line)}")
        for line in self._bag.damage:
            print(f"  damaged: {one_line(line)}")

    def _reach(self, time_ns: int, due_s: float, *, ticks: bool) -> bool:
        """Wait until a time on the steady clock, and tell the bag's; False if it is to stop."""
        if self._options.step:
            if ticks and not sys.stdin.readline():
                self._interruption.requested = True
        else:
            wait_s = due_s - time.monotonic()
            if wait_s > 0.0:
                self._interruption.wait(wait_s)
        if self._interruption.requested:
            return False
        self._clock.publish(clock_message(time_ns))
        return True


def _chosen(bag: BagReader, options: PlayOptions) -> list[str]:
    if not options.topics:
        return [name for name in bag.topics if name not in options.commands and name not in _NOT_PLAYED]
    names = []
    for wanted in options.topics:
        name = topic_named(wanted, bag.topics)
        if name is None:
            raise BagError(f"{bag.path}: holds no topic {wanted}; it holds {', '.join(sorted(bag.topics))}")
        names.append(name)
    return names


def _publishers(node: Node, bag: BagReader, options: PlayOptions) -> tuple[dict[str, Any], list[str]]:
    """A publisher for each chosen topic, and a line for each that cannot be played here."""
    found: dict[str, Any] = {}
    problems = []
    for name in _chosen(bag, options):
        try:
            found[name] = _publisher(node, bag, name)
        except Exception as error:  # noqa: BLE001 - rclpy has several for names and types that are none
            problems.append(one_line(f"{name} is left out: {error}", 300))
    if not found:
        raise BagError(f"{bag.path}: nothing can be played: {'; '.join(problems[:3]) or 'no topic'}")
    return found, problems


def _publisher(node: Node, bag: BagReader, name: str) -> Any:
    topic = bag.topics[name]
    if topic.serialization != "cdr":
        raise BagError(f"its messages are {topic.serialization!r}, not CDR")
    try:
        msg_class = message_class(topic.type)
    except (ImportError, ValueError):
        raise BagError(f"type {topic.type} is not installed here") from None
    reliable = not topic.qos or any(profile.reliability is not QosReliability.BEST_EFFORT for profile in topic.qos)
    latched = any(profile.durability is QosDurability.TRANSIENT_LOCAL for profile in topic.qos)
    profile = QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=_DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
    return node.create_publisher(msg_class, name, profile)


def paced(bag: BagReader, jumps: list[str]) -> Iterator[tuple[int, int, Message]]:
    """The bag's messages with the time since the first, in which no clock jumps, and the time of each.

    A line for each time the recorded clock jumps, back or by more than any pause, is added to `jumps`.
    """
    last_ns: int | None = None
    offset_ns = 0
    for time_ns, message in _timeline(bag):
        step_ns = 0 if last_ns is None else time_ns - last_ns
        if 0 <= step_ns <= _LONGEST_PAUSE_NS:
            offset_ns += step_ns
        else:
            way = "back" if step_ns < 0 else "forward"
            jumps.append(
                f"the recorded clock jumps {way} by {abs(step_ns) / _NS_PER_S:.3f} s after "
                f"{offset_ns / _NS_PER_S:.3f} s: played on at its own pace"
            )
        last_ns = time_ns
        yield offset_ns, time_ns, message


def _timeline(bag: BagReader) -> Iterator[tuple[int, Message]]:
    """The bag's messages with the time of each: of the recorded clock, if there is one, else of the recording."""
    clocked = CLOCK in bag.topics and (not bag.counts or bag.counts.get(CLOCK, 0) > 0)
    if not clocked:
        for message in bag.messages():
            yield message.log_time_ns, message
        return
    waiting: list[Message] = []
    now_ns: int | None = None
    for message in bag.messages():
        if message.topic == CLOCK and len(message.data) >= CLOCK_FIELDS_OFFSET + CLOCK_FIELDS.size:
            seconds, nanoseconds = CLOCK_FIELDS.unpack_from(message.data, CLOCK_FIELDS_OFFSET)
            now_ns = seconds * _NS_PER_S + nanoseconds
            for early in waiting:
                yield now_ns, early
            waiting = []
        elif now_ns is None:
            waiting.append(message)
        else:
            yield now_ns, message
    for early in waiting:
        yield early.log_time_ns, early
