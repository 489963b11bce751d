# SPDX-License-Identifier: Apache-2.0
"""The commands of a bag, on the topics its signals file gave them: what was sent, and what would be sent."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Collection, Sequence

from iwm_power_manager.bags.limits import SET_BACK_NS
from iwm_power_manager.bags.reader import BagReader, Message
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.replay.compare import TopicComparer, TopicComparison
from iwm_power_manager.replay.steps import ReplayedStep
from iwm_power_manager.signals.cdr import MessageReader, names_path
from iwm_power_manager.signals.commands import MOTOR, CommandWriter, Sink, parts_of
from iwm_power_manager.signals.contract import JOINT_STATE, WHEEL_NAMES
from iwm_power_manager.signals.mapping import SignalMapping, topic_named
from iwm_power_manager.signals.readings import NamedValues
from iwm_power_manager.signals.types import types_of

#: Steps back that a command without a stamp may belong to: it may be recorded after the state that was sent after it.
_RECENT = 1000


class RecordedCommand:
    """One topic of commands: its recorded messages, held against what the replayed steps would send.

    A message without a stamp belongs to the step whose state was sent next after it.

    Parameters
    ----------
    bag : that holds it
    mapping, kind, sink : what it carries
    name : of the topic in the bag
    tolerance : largest difference that is none

    Attributes
    ----------
    kind, name : as given
    stamped : the messages carry a stamp

    Raises
    ------
    BagError, ConfigError
        Its type is not known here, or not what the mapping says.
    """

    def __init__(
        self, bag: BagReader, mapping: SignalMapping, kind: str, sink: Sink, name: str, tolerance: float
    ) -> None:
        topic = bag.topics[name]
        types = types_of(topic.type, topic.encoding, topic.definition)
        if types.name != sink.type:
            raise ConfigError(mapping.path, f"{sink.key}.type", f"{name} carries {types.name}, not {sink.type}")
        self.kind, self.name = kind, name
        self._names = tuple(sink.names[wheel] if sink.names else WHEEL_NAMES[wheel] for wheel in sink.wheels)
        self._write = CommandWriter(mapping.path, [sink])
        # What a message of less than double precision would hold, only its bytes tell.
        self._parts = parts_of(sink) if topic.type == JOINT_STATE else ()
        self._read = MessageReader(types, [sink.field], self._made, names_path(sink.field) if sink.names else "")
        self.stamped = self._read.stamped
        self._comparer = TopicComparer(name, tolerance)
        self._sent: deque[tuple[int, int]] = deque(maxlen=_RECENT)
        self._waiting: list[tuple[int, int, NamedValues]] = []
        self._alone = 0
        self._newest_ns = 0

    def _made(
        self, stamp_ns: int, values: tuple[float | tuple[float, ...], ...], names: tuple[str, ...]
    ) -> NamedValues:
        value = values[0]
        return NamedValues(stamp_ns, names or self._names, value if isinstance(value, tuple) else (value,))

    def recorded(self, message: Message) -> None:
        """Take a recorded message; `UnreadableError` if it is none."""
        found = self._read(message.data)
        if self.stamped:
            self._comparer.recorded(found.stamp_ns, message.log_time_ns, found.names, found.values)
            return
        self._follow(message.publish_time_ns)
        place = bisect_left(self._sent, (message.publish_time_ns, -1))
        if place < len(self._sent):
            self._comparer.recorded(self._sent[place][1], message.log_time_ns, found.names, found.values)
        else:
            self._waiting.append((message.publish_time_ns, message.log_time_ns, found))

    def recomputed(self, step: ReplayedStep) -> None:
        """Take a replayed step."""
        if not self.stamped:
            self._follow(step.publish_time_ns)
            self._sent.append((step.publish_time_ns, step.stamp_ns))
            due = [one for one in self._waiting if one[0] <= step.publish_time_ns]
            self._waiting = self._waiting[len(due) :]
            for _, log_time_ns, found in due[:-1]:  # zero torque, as at the end of commanding, belongs to no step
                self._alone += 1
                self._comparer.recorded(-self._alone, log_time_ns, found.names, found.values)
            for _, log_time_ns, found in due[-1:]:
                self._comparer.recorded(step.stamp_ns, log_time_ns, found.names, found.values)
        torques = torques_nm(step, self.kind)
        if self._parts:
            values = tuple([factor * torques[wheel] for wheel, factor in self._parts])
        else:
            ((_, data),) = self._write(step.stamp_ns, torques)
            values = self._read(data).values
        self._comparer.recomputed(step.stamp_ns, step.log_time_ns, self._names, values)

    def _follow(self, publish_time_ns: int) -> None:
        """Forget the steps of before the clock was set back, in whose times nothing can be found any more."""
        if publish_time_ns < self._newest_ns - SET_BACK_NS:
            self._sent.clear()
            self._newest_ns = publish_time_ns
        self._newest_ns = max(self._newest_ns, publish_time_ns)

    def result(self) -> TopicComparison:
        """What has been found so far."""
        return self._comparer.result()


def torques_nm(step: ReplayedStep, kind: str) -> Sequence[float]:
    """What a step commands to the motors, or to the brakes."""
    return step.command.motor_torque_nm if kind == MOTOR else step.command.friction_torque_nm


def command_topics(bag: BagReader, mapping: SignalMapping) -> dict[str, tuple[str, Sink]]:
    """Kind and sink of each command that the bag holds, by its topic there."""
    return {
        name: (kind, sink)
        for kind, sinks in mapping.commands.items()
        for sink in sinks
        if (name := topic_named(sink.topic, bag.topics)) is not None
    }


def commands_elsewhere(bag: BagReader, mapping: SignalMapping, reports: Collection[str]) -> dict[str, list[str]]:
    """Topics that may be a command under another name, by its kind, where the bag lacks a topic of that command.

    They carry the message type of the command, and are neither inputs nor `reports` of the node.
    """
    commands = command_topics(bag, mapping)
    held = {sink.topic for _, sink in commands.values()}
    known = {*commands, *reports, *(topic_named(name, bag.topics) for name in mapping.topics())}
    unknown = {name: topic.type for name, topic in sorted(bag.topics.items()) if name not in known}
    return {
        kind: [name for name, type_ in unknown.items() if any(type_ == sink.type for sink in sinks)]
        for kind, sinks in mapping.commands.items()
        if any(sink.topic not in held for sink in sinks)
    }
