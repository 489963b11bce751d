# SPDX-License-Identifier: Apache-2.0
"""Run the control law over a recorded drive: no DDS, no clock; the same bag gives the same bytes every time.

Where the bag holds `power_manager/state`, each step is repeated from exactly what the law took, so that an unchanged
law with unchanged policy gives the recorded commands bit by bit. Where it does not (another car's bag, or inputs only),
steps are made from the mapped input signals.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

from iwm_power_manager.bags.metadata import DEFAULT_QOS, Topic
from iwm_power_manager.bags.reader import BagReader, Message
from iwm_power_manager.bags.writer import BagWriter
from iwm_power_manager.control.record import DECIDED, DECIDED_NAMES, SIGNAL_NAMES, YOUNGER_SIGNALS
from iwm_power_manager.errors import BagError, ConfigError
from iwm_power_manager.replay.commands import RecordedCommand, command_topics, commands_elsewhere, torques_nm
from iwm_power_manager.replay.compare import ReplayReport, TopicComparer, TopicComparison
from iwm_power_manager.replay.plan import Plan
from iwm_power_manager.replay.recorded import first_message
from iwm_power_manager.replay.steps import STATE_READER, ReconstructedSteps, RecordedSteps, ReplayedStep
from iwm_power_manager.signals.cdr import UnreadableError
from iwm_power_manager.signals.commands import CommandWriter
from iwm_power_manager.signals.contract import JOINT_STATE, NODE_FRICTION
from iwm_power_manager.signals.contract import POWER_MANAGER_STATE as STATE
from iwm_power_manager.signals.mapping import SignalMapping, topic_named
from iwm_power_manager.signals.readings import joint_state_writer
from iwm_power_manager.signals.types import definition_of
from iwm_power_manager.trace_units import Energies, apart

#: How the state's topic ends, whatever its node is called.
_STATE_OF_ANY = "/state"
#: Messages between two calls of `progress`.
PROGRESS_EVERY = 2000
#: Below this sum of speeds, m/s, there is no drive.
_MOVING_MPS = 10.0
#: Where these stand among a record's numbers.
_SPEED, _DEMAND, _DT = map(SIGNAL_NAMES.index, ("speed_mps", "requested_power_w", "dt_s"))
#: How many topics are named that may be a command under another name, and what to do with one.
_CANDIDATES = 5
_RENAME = "if it is one of them: --mapping with a copy of that file that has the recorded name"
#: A replay takes so many messages, or bytes, at a time.
_BATCH_MESSAGES = 2000
_BATCH_BYTES = 16 * 1024 * 1024


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
        self._radius_m = plan.vehicle.params.front.wheel.radius_m
        self._shown_mps = self._rolled_mps = 0.0  # sums of the speed, and of the wheels' rims
        self._along = 0.0  # of their product: below 0 where they have opposite signs
        self._energies = Energies(plan.vehicle.params.chassis.mass_kg)
        state = state_topic(bag)
        exact = state is not None and first_message(bag, state) is not None
        report = self._report = ReplayReport([*plan.notes], exact)
        self._state_comparer = TopicComparer(state or STATE, tolerance, YOUNGER_SIGNALS)
        self._commands: dict[str, RecordedCommand] = {}
        self._find_commands(plan.mapping, tolerance)
        self._source: RecordedSteps | ReconstructedSteps
        if state is not None and exact:
            self._source = RecordedSteps(bag, plan, report, state, self._state_comparer, tolerance)
        else:
            self._source = ReconstructedSteps(bag, plan, report)

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
            for message, steps in zip(batch, self._source.made(batch), strict=True):
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
        return replace(
            self._report,
            notes=[*self._bag.notes, *self._report.notes, *self._source.notes(), *self._other_unit()],
            dropped=self._source.not_believed(),
            damage=self._bag.damage,
            comparison=[found for found in compared if found.has_record],
        )

    def why_no_step(self) -> str:
        """Why the bag gave no control step, topic by topic, and what of it could not be read."""
        return "; ".join([self._source.why_none(), *self._bag.damage[:_CANDIDATES]])

    def _other_unit(self) -> list[str]:
        """A line, if speed and wheel speeds, or speed and demand, cannot both be in the units they were read in."""
        if max(self._shown_mps, self._rolled_mps) < _MOVING_MPS:
            return []
        if self._along < 0.0:
            return ["speed and wheel_speed are of opposite signs in most steps: is the sign of one of them wrong?"]
        found = apart(self._shown_mps, self._rolled_mps, self._radius_m)
        found = found or self._energies.apart()
        return [found] if found else []

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

    def _compare(self, step: ReplayedStep) -> None:
        values = step.values
        rolled_mps = (values[1] + values[2] + values[3] + values[4]) * 0.25 * self._radius_m
        self._shown_mps += abs(values[0])
        self._rolled_mps += abs(rolled_mps)
        self._along += values[0] * rolled_mps
        if not self._report.exact:
            self._energies.add(values[_SPEED], values[_DEMAND], values[_DT])
        for command in self._commands.values():
            command.recomputed(step)
        self._state_comparer.recomputed(step.stamp_ns, step.log_time_ns, DECIDED_NAMES, tuple(values[DECIDED]))


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
        return first is not None and set(DECIDED_NAMES) - set(YOUNGER_SIGNALS) <= set(STATE_READER(first.data).names)
    except UnreadableError:
        return False
