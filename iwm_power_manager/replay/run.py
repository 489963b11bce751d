# SPDX-License-Identifier: Apache-2.0
"""Run the control law over a recorded drive: no DDS, no clock; the same bag gives the same bytes every time.

Where the bag holds `power_manager/state`, each step is repeated from exactly what the law took, so that an unchanged
law with unchanged policy gives the recorded commands bit by bit. Where it does not (another car's bag, or inputs only),
steps are made from the mapped input signals.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from iwm_power_manager.bags.metadata import DEFAULT_QOS, Topic
from iwm_power_manager.bags.reader import BagReader, Message
from iwm_power_manager.bags.writer import BagWriter
from iwm_power_manager.control.record import DECIDED_NAMES, SIGNAL_NAMES, YOUNGER_SIGNALS
from iwm_power_manager.errors import BagError, IwmError
from iwm_power_manager.replay.compare import TopicComparer, TopicComparison
from iwm_power_manager.replay.plan import Plan
from iwm_power_manager.replay.recorded import SignalStream, check_signals
from iwm_power_manager.replay.steps import ReconstructedSteps, RecordedSteps, ReplayedStep
from iwm_power_manager.signals.cdr import UnreadableError
from iwm_power_manager.signals.mapping import JOINT_STATE, SignalMapping, topic_named
from iwm_power_manager.signals.readings import NamedValues, joint_state_reader, joint_state_writer
from iwm_power_manager.signals.types import definition_of

MOTOR_COMMAND = "wheel_torque_command"
FRICTION_COMMAND = "friction_brake_command"
STATE = "power_manager/state"
#: How the state's topic ends, whatever its node is called.
_STATE_OF_ANY = "/state"
_STATE_READER = joint_state_reader("position")
#: What a replay computes anew.
COMPUTED = (MOTOR_COMMAND, FRICTION_COMMAND, STATE)

#: Messages between two calls of `progress`.
PROGRESS_EVERY = 2000
#: Readings from the bag's start that show whether its messages come in sets of one stamp.
_PROBE_READINGS = 1000
#: Below this share of the messages of the busiest topic, a replay says that it made few steps.
_FEW_STEPS = 0.1
_FIRST_DECIDED = SIGNAL_NAMES.index(DECIDED_NAMES[0])


class ReplayReport(NamedTuple):
    """What a replay did.

    Attributes
    ----------
    notes : what was done other than asked, a line each
    exact : steps were repeated from the recorded state; else made from the inputs
    messages : read
    steps : control steps taken
    first_stamp_ns, last_stamp_ns : of the steps
    span_ns : driven: from each step to the next, jumps back left out
    gaps : times at which steps are missing in the record, so that the law's memory is unknown
    restarts : pauses in the inputs after which the law started anew
    bad_messages : messages that could not be decoded
    dropped : inputs that were not believed, by topic and reason
    faults : steps whose command no motor may be given, by reason
    damage : what could not be read of the bag
    comparison : recomputed against recorded, by topic
    """

    notes: list[str]
    exact: bool
    messages: int
    steps: int
    first_stamp_ns: int
    last_stamp_ns: int
    span_ns: int
    gaps: int
    restarts: int
    bad_messages: int
    dropped: dict[str, dict[str, int]]
    faults: dict[str, int]
    damage: list[str]
    comparison: list[TopicComparison]


class Replay:
    """One pass over a bag.

    Parameters
    ----------
    bag : open bag
    plan : car, policies, settings
    mapping : signals, where the bag holds no state of the power manager
    tolerance : largest difference that is none, for the comparison

    Raises
    ------
    BagError
        The bag holds neither a state nor the signals that are needed.
    """

    def __init__(self, bag: BagReader, plan: Plan, mapping: SignalMapping, tolerance: float = 0.0) -> None:
        self._bag = bag
        self._plan = plan
        names = computed_topics(bag)
        self._state_topic = _with_messages(bag, names.get(STATE))
        self._recorded: RecordedSteps | None = None
        self._reconstructed: ReconstructedSteps | None = None
        self._stream: SignalStream | None = None
        self._bad_messages = 0
        self._notes: list[str] = []
        self._messages = 0
        self._steps = 0
        self._stamps = (0, 0)
        self._span_ns = 0
        self._comparers = {
            kind: TopicComparer(name, tolerance, YOUNGER_SIGNALS if kind == STATE else ())
            for kind, name in names.items()
        }
        self._decoders = {
            name: (kind, joint_state_reader("position" if kind == STATE else "effort")) for kind, name in names.items()
        }
        if self._state_topic is not None:
            self._recorded = RecordedSteps(plan)
        else:
            self._stream = SignalStream(bag, mapping, plan.vehicle.params)
            check_signals(bag, mapping, self._stream, wheels=True)
            self._notes = [*self._stream.problems, *filter(None, [self._stream.use_log_times()])]
            self._reconstructed = ReconstructedSteps(plan, itertools.islice(self._stream, _PROBE_READINGS))
            self._stream.taken.clear()
            self._stream.bad.clear()
            self._stream.without.clear()

    @property
    def exact(self) -> bool:
        """Steps are repeated from the recorded state."""
        return self._recorded is not None

    def steps(self, progress: Callable[[int, int], None] | None = None) -> Iterator[tuple[Message, list[ReplayedStep]]]:
        """Every message of the bag, with the steps it caused.

        `progress(messages, log_time_ns)` is called now and then.
        """
        for message in self._bag.messages():
            self._messages += 1
            if progress is not None and self._messages % PROGRESS_EVERY == 0:
                progress(self._messages, message.log_time_ns)
            steps = self._take(message)
            for step in steps:
                first_ns, last_ns = self._stamps if self._steps else (step.stamp_ns, step.stamp_ns)
                self._span_ns += max(step.stamp_ns - last_ns, 0)
                self._stamps = (first_ns, step.stamp_ns)
                self._steps += 1
                self._compare(step)
            yield message, steps

    def report(self) -> ReplayReport:
        """What has been done so far."""
        source = self._recorded or self._reconstructed
        return ReplayReport(
            [*self._notes, *self._lost_wheels(), *self._too_few_steps()],
            self.exact,
            self._messages,
            self._steps,
            *self._stamps,
            self._span_ns,
            self._recorded.gaps if self._recorded else 0,
            self._reconstructed.restarts if self._reconstructed else 0,
            self._bad_messages + (self._stream.bad_messages if self._stream else 0),
            self._reconstructed.dropped if self._reconstructed else {},
            dict(source.faults) if source else {},
            self._bag.damage,
            [result for comparer in self._comparers.values() if (result := comparer.result()).has_record],
        )

    def why_no_step(self) -> str:
        """Why the bag gave no control step, topic by topic."""
        if self._stream is None or self._reconstructed is None:
            return f"{self._state_topic}: {self._bad_messages} messages that cannot be read"
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
        return "; ".join([*parts, *self._notes]) or "no message"

    def _lost_wheels(self) -> list[str]:
        """A line for each set of wheels that messages had no number for."""
        without = self._stream.without if self._stream is not None else {}
        return [f"{which} has no number in {count} messages: lost, as in the node" for which, count in without.items()]

    def _too_few_steps(self) -> list[str]:
        """A line, if the bag gave far fewer steps than it holds wheel speeds."""
        if self._stream is None or not self._steps:
            return []
        wheels = max(self._stream.taken[topic] for topic in self._stream.topics)
        if self._steps > _FEW_STEPS * wheels:
            return []
        return [f"only {self._steps} steps of {wheels} messages: {self.why_no_step()}"]

    def _take(self, message: Message) -> list[ReplayedStep]:
        known = self._decoders.get(message.topic)
        if known is not None:
            return self._take_computed(message, *known)
        if self._stream is None or self._reconstructed is None:
            return []
        values = self._stream.values(message.topic, message.data, message.log_time_ns, message.publish_time_ns)
        return self._reconstructed.take(values) if values else []

    def _take_computed(self, message: Message, kind: str, decode: Callable[[bytes], NamedValues]) -> list[ReplayedStep]:
        """A recorded command or state: what the recomputed one is held against, and where the state is, a step."""
        try:
            recorded = decode(message.data)
            steps: list[ReplayedStep] = []
            if kind == STATE and self._recorded is not None:
                step = self._recorded.take(recorded, message.log_time_ns, message.publish_time_ns)
                steps = [step] if step is not None else []
        except IwmError:
            raise
        except KeyError as error:
            raise BagError(
                f"{self._bag.path}: {message.topic} lacks the signal {error}: recorded by another version"
            ) from None
        except Exception:  # noqa: BLE001 - generated decoders raise whatever a damaged message makes them raise
            self._bad_messages += 1
            return []
        names, values = recorded.names, recorded.values
        if kind == STATE and list(names) == SIGNAL_NAMES:
            names, values = DECIDED_NAMES, values[_FIRST_DECIDED : _FIRST_DECIDED + len(DECIDED_NAMES)]
        elif kind == STATE:
            found = dict(zip(names, values, strict=True))
            names = tuple(name for name in DECIDED_NAMES if name in found)
            values = tuple(found[name] for name in names)
        self._comparers[kind].recorded(recorded.stamp_ns, message.log_time_ns, names, values)
        return steps

    def _compare(self, step: ReplayedStep) -> None:
        names = self._plan.wheel_names
        for kind, wanted, values in (
            (MOTOR_COMMAND, names, step.command.motor_torque_nm),
            (FRICTION_COMMAND, names, step.command.friction_torque_nm),
            (STATE, DECIDED_NAMES, decided_values(step)),
        ):
            comparer = self._comparers.get(kind)
            if comparer is not None:
                comparer.recomputed(step.stamp_ns, step.log_time_ns, wanted, tuple(values))


class ReplayOutput:
    """Writes a replay to a new bag: all recorded inputs as they are, commands and state recomputed.

    Parameters
    ----------
    writer : new bag
    bag : bag that is replayed
    plan : for the wheels' names
    """

    def __init__(self, writer: BagWriter, bag: BagReader, plan: Plan) -> None:
        self._writer = writer
        self._sequence = 0
        computed = computed_topics(bag)
        self._copied = {
            name: writer.add_topic(topic) for name, topic in sorted(bag.topics.items()) if name not in computed.values()
        }
        self._numbers = []
        for kind in COMPUTED:
            new = Topic(f"/{kind}", JOINT_STATE, *definition_of(JOINT_STATE), (DEFAULT_QOS._replace(depth=100),))
            topic = bag.topics[computed[kind]] if kind in computed else new
            self._numbers.append(writer.add_topic(topic))
        self._wheels = joint_state_writer(plan.wheel_names, "effort")
        self._state = joint_state_writer(SIGNAL_NAMES, "position")

    def write(self, message: Message, steps: Sequence[ReplayedStep]) -> None:
        """Write a message of the replayed bag, unless it is recomputed, and the steps it caused."""
        number = self._copied.get(message.topic)
        if number is not None:
            self._writer.write(number, message.log_time_ns, message.data, message.publish_time_ns, message.sequence)
        for step in steps:
            self._sequence += 1
            for topic, data in zip(
                self._numbers,
                (
                    self._wheels(step.stamp_ns, step.command.motor_torque_nm),
                    self._wheels(step.stamp_ns, step.command.friction_torque_nm),
                    self._state(step.stamp_ns, step.values),
                ),
                strict=True,
            ):
                self._writer.write(topic, step.log_time_ns, data, step.publish_time_ns, self._sequence)


def exceeds(comparison: Sequence[TopicComparison], tolerance: float) -> bool:
    """Whether any topic differs by more than the tolerance, or nothing could be compared."""
    return not any(topic.compared for topic in comparison) or any(topic.largest > tolerance for topic in comparison)


def decided_values(step: ReplayedStep) -> tuple[float, ...]:
    """Of a step's numbers, those the law decided."""
    return tuple(step.values[_FIRST_DECIDED : _FIRST_DECIDED + len(DECIDED_NAMES)])


def computed_topics(bag: BagReader) -> dict[str, str]:
    """The bag's topics of the commands and the state, by the names of `COMPUTED`; those it does not have are left out.

    The state is private to its node: where the node had another name, it is the one topic `<node>/state` that carries
    the numbers of a step.

    Raises
    ------
    BagError
        One of them was recorded in several namespaces, or the state of several nodes.
    """
    found = {kind: name for kind in COMPUTED if (name := topic_named(kind, bag.topics)) is not None}
    if STATE not in found:
        candidates = [
            name for name, topic in bag.topics.items() if topic.type == JOINT_STATE and name.endswith(_STATE_OF_ANY)
        ]
        states = [name for name in candidates if _carries_steps(bag, name)]
        if len(states) > 1:
            raise BagError(f"{bag.path}: holds the states of several nodes: {', '.join(sorted(states))}")
        if states:
            found[STATE] = states[0]
    return found


def _carries_steps(bag: BagReader, topic: str) -> bool:
    """Whether the first message of a topic names the signals of a control step."""
    first = next((message for message in bag.messages() if message.topic == topic), None)
    try:
        return first is not None and set(DECIDED_NAMES) - set(YOUNGER_SIGNALS) <= set(_STATE_READER(first.data).names)
    except UnreadableError:
        return False


def _with_messages(bag: BagReader, topic: str | None) -> str | None:
    """The topic, if at least one message of it was recorded."""
    if topic is None:
        return None
    if bag.counts:
        return topic if bag.counts.get(topic) else None
    return topic if any(message.topic == topic for message in bag.messages()) else None
