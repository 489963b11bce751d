# SPDX-License-Identifier: Apache-2.0
"""Run the control law over a recorded drive: no DDS, no clock; the same bag gives the same bytes every time.

Where the bag holds `power_manager/state`, each step is repeated from exactly what the law took, so that an unchanged
law with unchanged policy gives the recorded commands bit by bit. Where it does not (another car's bag, or inputs only),
steps are made from the mapped input signals.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

from iwm_power_manager.bags.metadata import DEFAULT_QOS, Topic
from iwm_power_manager.bags.reader import BagReader, Message
from iwm_power_manager.bags.writer import BagWriter
from iwm_power_manager.control.record import DECIDED, DECIDED_NAMES, SIGNAL_NAMES, YOUNGER_SIGNALS
from iwm_power_manager.errors import BagError, ConfigError
from iwm_power_manager.replay.commands import RecordedCommand, command_topics, commands_elsewhere, torques_nm
from iwm_power_manager.replay.compare import TopicComparer, TopicComparison
from iwm_power_manager.replay.plan import Plan
from iwm_power_manager.replay.recorded import SignalStream, check_signals, first_message
from iwm_power_manager.replay.steps import ReconstructedSteps, RecordedSteps, ReplayedStep
from iwm_power_manager.signals.cdr import UnreadableError
from iwm_power_manager.signals.commands import CommandWriter
from iwm_power_manager.signals.contract import JOINT_STATE, NODE_FRICTION
from iwm_power_manager.signals.contract import POWER_MANAGER_STATE as STATE
from iwm_power_manager.signals.mapping import SignalMapping, topic_named
from iwm_power_manager.signals.readings import joint_state_reader, joint_state_writer
from iwm_power_manager.signals.types import definition_of

#: How the state's topic ends, whatever its node is called.
_STATE_OF_ANY = "/state"
_STATE_READER = joint_state_reader("position")
#: Messages between two calls of `progress`.
PROGRESS_EVERY = 2000
#: Below this share of the messages of the busiest topic, a replay says that it made few steps.
_FEW_STEPS = 0.1
#: How many topics are named that may be a command under another name, and what to do with one.
_CANDIDATES = 5
_RENAME = "if it is one of them: --mapping with a copy of that file that has the recorded name"
#: A replay takes so many messages, or bytes, at a time.
_BATCH_MESSAGES = 2000
_BATCH_BYTES = 16 * 1024 * 1024


@dataclass
class ReplayReport:
    """What a replay did.

    Attributes
    ----------
    notes : what was done other than asked, a line each
    exact : steps were repeated from the recorded state; else made from the inputs
    messages, steps : messages read, and control steps taken
    first_stamp_ns, last_stamp_ns : of the steps
    span_ns : driven: from each step to the next, jumps back left out
    gaps : times at which steps are missing in the record, so that the law's memory is unknown
    changed : steps whose torques are not the recorded ones, whatever the law remembers at a gap
    restarts : pauses in the inputs after which the law started anew
    bad_messages : messages that could not be decoded
    dropped : inputs that were not believed, by topic and reason
    faults : steps whose command no motor may be given, by reason
    damage : what could not be read of the bag
    comparison : recomputed against recorded, by topic
    not_compared : commands that were not compared and why, a line each
    """

    notes: list[str]
    exact: bool
    messages: int = 0
    steps: int = 0
    first_stamp_ns: int = 0
    last_stamp_ns: int = 0
    span_ns: int = 0
    gaps: int = 0
    changed: int = 0
    restarts: int = 0
    bad_messages: int = 0
    dropped: dict[str, dict[str, int]] = field(default_factory=dict)
    faults: dict[str, int] = field(default_factory=dict)
    damage: list[str] = field(default_factory=list)
    comparison: list[TopicComparison] = field(default_factory=list)
    not_compared: list[str] = field(default_factory=list)


class Replay:
    """One pass over a bag.

    Parameters
    ----------
    bag : open bag
    plan : car, policies, settings
    tolerance : largest difference that is none, for the comparison

    Raises
    ------
    BagError
        The bag holds neither a state nor the signals that are needed.
    """

    def __init__(self, bag: BagReader, plan: Plan, tolerance: float = 0.0) -> None:
        self._bag = bag
        state = state_topic(bag)
        self._state_topic = state if state and first_message(bag, state) else None
        self._report = ReplayReport([*plan.notes], exact=self._state_topic is not None)
        self._state_comparer = TopicComparer(state or STATE, tolerance, YOUNGER_SIGNALS)
        self._commands: dict[str, RecordedCommand] = {}
        self._find_commands(plan.mapping, tolerance)
        self._recorded: RecordedSteps | None = None
        if self.exact:
            self._recorded = RecordedSteps(plan, tolerance)
            return
        self._stream = SignalStream(bag, plan.mapping, plan.vehicle.params)
        check_signals(bag, plan.mapping, self._stream, wheels=True)
        self._report.notes += [*self._stream.problems, *filter(None, [self._stream.use_log_times()])]
        self._reconstructed = ReconstructedSteps(plan, self._stream)
        self._stream.forget()

    @property
    def exact(self) -> bool:
        """Steps are repeated from the recorded state."""
        return self._report.exact

    def steps(self, progress: Callable[[int, int], None] | None = None) -> Iterator[tuple[Message, list[ReplayedStep]]]:
        """Every message of the bag, with the steps it caused.

        `progress(messages, log_time_ns)` is called now and then.
        """
        report = self._report
        for batch in _batches(self._bag.messages()):
            made = self._made(batch) if self._recorded is None else self._repeated(batch, self._recorded)
            for message, steps in zip(batch, made, strict=True):
                report.messages += 1
                if progress is not None and report.messages % PROGRESS_EVERY == 0:
                    progress(report.messages, message.log_time_ns)
                if (command := self._commands.get(message.topic)) is not None:
                    try:
                        command.recorded(message)
                    except UnreadableError:
                        report.bad_messages += 1
                for step in steps:
                    if not report.steps:
                        report.first_stamp_ns = report.last_stamp_ns = step.stamp_ns
                    report.span_ns += max(step.stamp_ns - report.last_stamp_ns, 0)
                    report.last_stamp_ns = step.stamp_ns
                    report.steps += 1
                    self._compare(step)
                yield message, steps

    def report(self) -> ReplayReport:
        """What has been done so far."""
        compared = [*(command.result() for command in self._commands.values()), self._state_comparer.result()]
        report = replace(
            self._report, damage=self._bag.damage, comparison=[found for found in compared if found.has_record]
        )
        if self._recorded is not None:
            report.gaps, report.changed = self._recorded.gaps, self._recorded.changed
            report.faults = dict(self._recorded.faults)
            return report
        report.notes = [*report.notes, *self._lost_wheels(), *self._too_few_steps()]
        report.bad_messages += self._stream.bad_messages
        report.restarts, report.dropped = self._reconstructed.restarts, self._reconstructed.dropped
        report.faults = dict(self._reconstructed.faults)
        return report

    def why_no_step(self) -> str:
        """Why the bag gave no control step, topic by topic."""
        if self.exact:
            return f"{self._state_topic}: {self._report.bad_messages} messages that cannot be read"
        parts = []
        for topic in sorted(self._stream.topics):
            part = f"{topic}: {self._stream.taken[topic]} messages"
            if self._stream.bad[topic]:
                part += f", {self._stream.bad[topic]} of them bad"
            parts.append(part)
        for name, reasons in self._reconstructed.dropped.items():
            parts.append(f"{name} not believed: " + ", ".join(f"{count} {reason}" for reason, count in reasons.items()))
        for reason, count in self._reconstructed.faults.items():
            parts.append(f"{count} without a command: {reason}")
        return "; ".join([*parts, *self._report.notes]) or "no message"

    def _lost_wheels(self) -> list[str]:
        """A line for each set of wheels that messages had no number for."""
        without = self._stream.without.items()
        return [f"{which} has no number in {count} messages: lost, as in the node" for which, count in without]

    def _too_few_steps(self) -> list[str]:
        """A line, if the bag gave far fewer steps than it holds wheel speeds."""
        steps = self._report.steps
        wheels = max(self._stream.taken[topic] for topic in self._stream.topics)
        if not steps or steps > _FEW_STEPS * wheels:
            return []
        return [f"only {steps} steps of {wheels} messages: {self.why_no_step()}"]

    def _find_commands(self, mapping: SignalMapping, tolerance: float) -> None:
        for name, (kind, sink) in command_topics(self._bag, mapping).items():
            try:
                command = RecordedCommand(self._bag, mapping, kind, sink, name, tolerance)
            except (BagError, ConfigError) as error:
                self._report.not_compared.append(f"{name}: {error}")
                continue
            if command.stamped or self.exact:
                self._commands[name] = command
            else:
                self._report.not_compared.append(f"{name}: carries no stamp, and the bag no state to tell its step")
        held = {sink.topic for _, sink in command_topics(self._bag, mapping).values()}
        elsewhere = commands_elsewhere(self._bag, mapping, report_topics(self._bag))
        for kind, sinks in mapping.commands.items():
            absent = ", ".join(sink.topic for sink in sinks if sink.topic not in held)
            if absent:
                likely = ", ".join(elsewhere[kind][:_CANDIDATES])
                hint = f"; of its type: {likely}; {_RENAME}" if likely else ""
                self._report.not_compared.append(f"{kind} on {absent} ({mapping.path}): not in the bag{hint}")
            elif not sinks:
                self._report.not_compared.append(f"{kind}: goes nowhere ({mapping.path})")

    def _made(self, batch: Sequence[Message]) -> Iterator[list[ReplayedStep]]:
        """The steps that each message of a batch causes as an input."""
        for message in batch:
            values = self._stream.values(message.topic, message.data, message.log_time_ns, message.publish_time_ns)
            yield self._reconstructed.take(values) if values else []

    def _repeated(self, batch: Sequence[Message], recorded: RecordedSteps) -> Iterator[list[ReplayedStep]]:
        """The step of each message of a batch that is a recorded state."""
        taken = [message.topic == self._state_topic and self._take_state(message, recorded) for message in batch]
        steps = iter(recorded.repeated())
        return ([step] if one and (step := next(steps)) is not None else [] for one in taken)

    def _take_state(self, message: Message, steps: RecordedSteps) -> bool:
        """Take a recorded state; False, and it counts as bad, if it is none."""
        try:
            stamp_ns, names, values = _STATE_READER(message.data)
            steps.take(names, values, stamp_ns, message)
        except KeyError as error:
            raise BagError(
                f"{self._bag.path}: {message.topic} lacks the signal {error}: recorded by another version"
            ) from None
        except (UnreadableError, ValueError):
            self._report.bad_messages += 1
            return False
        if list(names) == SIGNAL_NAMES:
            names, values = DECIDED_NAMES, values[DECIDED]
        else:
            found = dict(zip(names, values, strict=True))
            names = tuple(name for name in DECIDED_NAMES if name in found)
            values = tuple(found[name] for name in names)
        self._state_comparer.recorded(stamp_ns, message.log_time_ns, names, values)
        return True

    def _compare(self, step: ReplayedStep) -> None:
        for command in self._commands.values():
            command.recomputed(step)
        self._state_comparer.recomputed(step.stamp_ns, step.log_time_ns, DECIDED_NAMES, tuple(step.values[DECIDED]))


class ReplayOutput:
    """Writes a replay to a new bag: all recorded inputs as they are, commands and state recomputed.

    Parameters
    ----------
    writer : new bag
    bag : bag that is replayed
    plan : where the commands go
    """

    def __init__(self, writer: BagWriter, bag: BagReader, plan: Plan) -> None:
        self._writer = writer
        self._sequence = 0
        mapping = plan.mapping
        recorded = {sink.topic: name for name, (_, sink) in command_topics(bag, mapping).items()}
        state = state_topic(bag)
        computed = {*recorded.values(), *report_topics(bag)}
        self._copied = {
            name: writer.add_topic(topic) for name, topic in sorted(bag.topics.items()) if name not in computed
        }
        types = {sink.topic: sink.type for sinks in mapping.commands.values() for sink in sinks}
        names = {topic: recorded.get(topic, f"/{topic.lstrip('/')}") for topic in types}
        self._numbers = {
            topic: writer.add_topic(bag.topics.get(name) or _new_topic(name, types[topic]))
            for topic, name in names.items()
        }
        self._state_number = writer.add_topic(bag.topics[state] if state else _new_topic(f"/{STATE}", JOINT_STATE))
        self._commands = {kind: CommandWriter(mapping.path, sinks) for kind, sinks in mapping.commands.items()}
        self._state = joint_state_writer(SIGNAL_NAMES, "position")

    def write(self, message: Message, steps: Sequence[ReplayedStep]) -> None:
        """Write a message of the replayed bag, unless it is recomputed, and the steps it caused."""
        number = self._copied.get(message.topic)
        if number is not None:
            self._writer.write(number, message.log_time_ns, message.data, message.publish_time_ns, message.sequence)
        for step in steps:
            self._sequence += 1
            sent = [
                (self._numbers[topic], data)
                for kind, write in self._commands.items()
                for topic, data in write(step.stamp_ns, torques_nm(step, kind))
            ]
            for number, data in (*sent, (self._state_number, self._state(step.stamp_ns, step.values))):
                self._writer.write(number, step.log_time_ns, data, step.publish_time_ns, self._sequence)


def _new_topic(name: str, msgtype: str) -> Topic:
    return Topic(name, msgtype, *definition_of(msgtype), (DEFAULT_QOS._replace(depth=100),))


def exceeds(comparison: Sequence[TopicComparison], tolerance: float) -> bool:
    """Whether any topic differs by more than the tolerance, or nothing could be compared."""
    return not any(topic.compared for topic in comparison) or any(topic.largest > tolerance for topic in comparison)


def _batches(messages: Iterable[Message]) -> Iterator[list[Message]]:
    """Messages in batches, which take little memory even where messages are large."""
    batch: list[Message] = []
    size = 0
    for message in messages:
        batch.append(message)
        size += len(message.data)
        if len(batch) == _BATCH_MESSAGES or size > _BATCH_BYTES:
            yield batch
            batch, size = [], 0
    yield batch


def state_topic(bag: BagReader) -> str | None:
    """The bag's topic of the power manager's state, if it has one.

    It is private to its node: where the node had another name, it is the one topic `<node>/state` that carries the
    numbers of a step.

    Raises
    ------
    BagError
        It was recorded in several namespaces, or of several nodes.
    """
    name = topic_named(STATE, bag.topics)
    if name is not None:
        return name
    candidates = [
        name for name, topic in bag.topics.items() if topic.type == JOINT_STATE and name.endswith(_STATE_OF_ANY)
    ]
    states = [name for name in candidates if _carries_steps(bag, name)]
    if len(states) > 1:
        raise BagError(f"{bag.path}: holds the states of several nodes: {', '.join(sorted(states))}")
    return states[0] if states else None


def report_topics(bag: BagReader) -> list[str]:
    """The bag's topics that the power manager alone publishes: its state, and the estimated friction beside it."""
    state = state_topic(bag)
    if state is None:
        return []
    estimate = state.removesuffix(_STATE_OF_ANY) + NODE_FRICTION.removeprefix("~")
    topic = bag.topics.get(estimate)
    return [state] if topic is None or topic.type != JOINT_STATE else [state, estimate]


def _carries_steps(bag: BagReader, topic: str) -> bool:
    """Whether the first message of a topic names the signals of a control step."""
    first = first_message(bag, topic)
    try:
        return first is not None and set(DECIDED_NAMES) - set(YOUNGER_SIGNALS) <= set(_STATE_READER(first.data).names)
    except UnreadableError:
        return False
