# SPDX-License-Identifier: Apache-2.0
"""From the messages of a bag to control steps: repeated exactly where the bag has them, else made from the inputs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from iwm_power_manager.bags.losses import Losses
from iwm_power_manager.bags.reader import BagReader, Message
from iwm_power_manager.control import lockstep, monitor, record
from iwm_power_manager.control.controller import Controller, ControllerLimits
from iwm_power_manager.control.gap import possible_memories
from iwm_power_manager.control.guard import violated_bound
from iwm_power_manager.control.inputs import WheelVerdict
from iwm_power_manager.control.repeat import repeat
from iwm_power_manager.control.settings import Settings
from iwm_power_manager.control.stepping import AsRecorded, Lockstep, Taken
from iwm_power_manager.control.table import PolicyTable
from iwm_power_manager.control.thresholds import RECORDED, actuator_limits, input_limits, supervision_limits
from iwm_power_manager.control.types import Command, initial_state
from iwm_power_manager.errors import BagError, one_line
from iwm_power_manager.replay.compare import ReplayReport, TopicComparer
from iwm_power_manager.replay.plan import Plan
from iwm_power_manager.replay.recorded import Recorded, SignalStream, check_signals
from iwm_power_manager.signals.cdr import UnreadableError
from iwm_power_manager.signals.contract import WHEEL_NAMES
from iwm_power_manager.signals.readings import (
    DemandReading,
    DirectionReading,
    FrictionReading,
    MotionReading,
    joint_state_reader,
)

#: What each kind of reading is to the controller.
_TOPICS = {
    monitor.SpeedReading: monitor.SPEED,
    monitor.JointReading: monitor.WHEELS,
    monitor.BatteryReading: monitor.BATTERY,
    DemandReading: monitor.DEMAND,
    FrictionReading: monitor.FRICTION,
}
#: Those of a lock-step set that carry a stamp.
_SETS = {monitor.SPEED: lockstep.SPEED, monitor.WHEELS: lockstep.WHEELS, monitor.BATTERY: lockstep.BATTERY}
#: Where these stand among a record's numbers, and torques and heat indices among those the law decides.
_FRICTION, _DT, _LOST = map(record.SIGNAL_NAMES.index, ("friction", "dt_s", "wheels_lost"))
_TORQUES, _HEAT = slice(0, 8), record.DECIDED_NAMES.index("front_heat")
#: Memories that have given the same numbers, to within this, for so long, s, do not matter any more; a torque that is
#: further from theirs, N m, has another reason.
_ALIKE = 1e-6
_SETTLED_S = 2.0
_UNLIKE_NM = 1e-3
FloatArray = NDArray[np.float64]

#: A pause in the recording longer than this starts the law anew.
_PAUSE_S = 1.0
#: An input that is older at a step made of inputs is said to be.
_OLD_NS = 500_000_000
#: Values from the start of a bag that show whether its messages come in sets of one stamp.
_PROBE_VALUES = 400
#: Below this share of the messages of the busiest topic, or of the wheel speeds, a replay says that it made few steps.
_FEW_STEPS, _STEPS_LACK = 0.1, 0.9
STATE_READER = joint_state_reader("position")


class ReplayedStep(NamedTuple):
    """One step of the law.

    Attributes
    ----------
    stamp_ns : of the command
    log_time_ns, publish_time_ns : of the message that caused the step
    command : what it decided
    values : numbers of `control.record.SIGNALS`
    recorded : the same as recorded; () of a step made from inputs
    """

    stamp_ns: int
    log_time_ns: int
    publish_time_ns: int
    command: Command
    values: Sequence[float]
    recorded: Sequence[float] = ()


class _Due(NamedTuple):
    """A recorded step that waits to be repeated; without numbers it is the answer before, sent again."""

    stamp_ns: int
    log_time_ns: int
    publish_time_ns: int
    numbers: Sequence[float]


class _Block(NamedTuple):
    """Recorded steps with the same settings and policy; `begins`: number of the first, if that is not the next one."""

    settings: Settings
    table: PolicyTable
    begins: int | None
    due: list[_Due]


class RecordedSteps:
    """Repeats the steps a `power_manager/state` has recorded, bit by bit as long as none is missing.

    They are taken many at a time: the law's memory takes longer on its way in and out of compiled code than a step.

    Parameters
    ----------
    bag : open bag
    plan : car, policies, settings
    report : is told of gaps, changed steps and faults
    topic : of the state
    comparer : is given what was recorded
    tolerance : largest difference that is none
    """

    def __init__(
        self, bag: BagReader, plan: Plan, report: ReplayReport, topic: str, comparer: TopicComparer, tolerance: float
    ) -> None:
        self._path = bag.path
        self._plan = plan
        self._report = report
        self._topic = topic
        self._comparer = comparer
        self._tolerance = tolerance
        self._memories = [initial_state()]  # of which the first counts
        self._recorded: Sequence[float] = ()  # settings
        self._settings = plan.settings
        self._blocks: list[_Block] = []
        self._next = 0
        self._numbers = Losses()
        self._stamp_ns = -1
        self._made: ReplayedStep | None = None
        self._alike_s = 0.0  # for how long all memories have given the same
        self._lost: Counter[int] = Counter()  # steps by the wheels that were not believed

    def made(self, batch: Sequence[Message]) -> Iterator[list[ReplayedStep]]:
        """The step of each message of a batch that is a recorded state."""
        taken = [message.topic == self._topic and self._take_message(message) for message in batch]
        steps = iter([step for block in self._blocks for step in self._repeated(block)])
        self._blocks = [block._replace(begins=None, due=[]) for block in self._blocks[-1:]]
        return ([step] if one and (step := next(steps)) is not None else [] for one in taken)

    def not_believed(self) -> dict[str, dict[str, int]]:
        """Wheels that the node did not believe, by how many of the steps."""
        steps = {
            f"wheel {name}": sum(count for bits, count in self._lost.items() if bits >> i & 1)
            for i, name in enumerate(WHEEL_NAMES)
        }
        return {wheel: {"steps": count} for wheel, count in steps.items() if count}

    def why_none(self) -> str:
        """Why there is no step."""
        return f"{self._topic}: {self._report.bad_messages} messages that cannot be read"

    def notes(self) -> list[str]:
        """Nothing is done other than recorded."""
        return []

    def _take_message(self, message: Message) -> bool:
        """Take a recorded state; False, and it counts as bad, if it is none."""
        try:
            stamp_ns, names, values = STATE_READER(message.data)
            self._take(names, values, stamp_ns, message)
        except KeyError as error:
            raise BagError(
                f"{self._path}: {message.topic} lacks the signal {error}: recorded by another version"
            ) from None
        except (UnreadableError, ValueError):
            self._report.bad_messages += 1
            return False
        if list(names) == record.SIGNAL_NAMES:
            names, values = record.DECIDED_NAMES, values[record.DECIDED]
        else:
            found = dict(zip(names, values, strict=True))
            names = tuple(name for name in record.DECIDED_NAMES if name in found)
            values = tuple(found[name] for name in names)
        self._comparer.recorded(stamp_ns, message.log_time_ns, names, values)
        return True

    def _take(self, names: Sequence[str], values: Sequence[float], stamp_ns: int, message: Message) -> None:
        """Take one step's numbers; `KeyError` or `ValueError` if the message is of another kind or version."""
        plan = self._plan
        numbers = record.completed(names, values)
        number = record.step_of(numbers)
        times = stamp_ns, message.log_time_ns, message.publish_time_ns
        if number + 1 == self._next and stamp_ns == self._stamp_ns:
            self._blocks[-1].due.append(_Due(*times, ()))
            return
        if numbers[record.SETTINGS] != self._recorded:  # they rarely change
            self._settings = record.from_numbers(numbers).settings._replace(**plan.changes)
            self._recorded = numbers[record.SETTINGS]
        friction = record.measurement_of(numbers).friction if plan.keeps_friction else plan.friction
        table = plan.policies.table(self._settings.strategy, friction)
        begins = number if number == 0 or number != self._next else None
        last = self._blocks[-1] if self._blocks else None
        if begins is not None or last is None or last.settings is not self._settings or last.table is not table:
            self._blocks.append(_Block(self._settings, table, begins, []))
        self._blocks[-1].due.append(_Due(*times, numbers))
        if 0.0 < numbers[_LOST] < 1 << len(WHEEL_NAMES):
            self._lost[int(numbers[_LOST])] += 1
        self._report.gaps += bool(begins)
        self._numbers.take(number + 1)
        self._report.several = self._numbers.several
        self._next, self._stamp_ns = number + 1, stamp_ns

    def _repeated(self, block: _Block) -> Iterator[ReplayedStep | None]:
        rows = iter(self._computed(block, [due.numbers for due in block.due if due.numbers]))
        for due in block.due:
            if due.numbers:
                row = next(rows)
                command = record.command_of(row[record.DECIDED])
                problem = violated_bound(command, self._plan.vehicle.params)
                self._report.count_fault(problem)
                self._made = None if problem else ReplayedStep(*due[:3], command, row, due.numbers)
            yield self._made and self._made._replace(log_time_ns=due.log_time_ns, publish_time_ns=due.publish_time_ns)

    def _computed(self, block: _Block, recorded: list[Sequence[float]]) -> list[list[float]]:
        """Numbers of steps, with what the law decides today."""
        if not recorded:
            return []
        if block.begins is not None:
            self._memories = possible_memories(self._memories[0], block.begins, recorded[0], block.table)
            self._alike_s = 0.0
        numbers = np.array(recorded)
        numbers[:, record.SETTINGS] = block.settings
        if not self._plan.keeps_friction:
            numbers[:, _FRICTION] = self._plan.friction
        results = np.empty((len(self._memories), len(recorded), len(record.DECIDED_NAMES)))
        self._memories = [
            repeat(numbers, memory, block.settings, self._plan.vehicle.params, block.table, result)
            for memory, result in zip(self._memories, results, strict=True)
        ]
        self._report.changed += self._changed(numbers, results)
        if all(memory == self._memories[0] for memory in self._memories):
            del self._memories[1:]
        numbers[:, record.DECIDED] = results[0]
        return numbers.tolist()

    def _changed(self, numbers: FloatArray, results: FloatArray) -> int:
        """How many steps no memory explains: all have given the same for a while, and the record is another."""
        apart_nm = np.abs(numbers[:, record.DECIDED] - results[0])[:, _TORQUES].max(axis=1)
        if len(results) == 1:
            return int(np.count_nonzero(~(apart_nm <= self._tolerance)))
        changed = 0
        alike = np.ptp(results[:, :, :_HEAT], axis=0).max(axis=1) <= _ALIKE
        for one, apart, dt_s in zip(alike.tolist(), apart_nm.tolist(), numbers[:, _DT].tolist(), strict=True):
            self._alike_s = self._alike_s + dt_s if one else 0.0
            changed += self._alike_s > _SETTLED_S and not apart <= self._tolerance + _UNLIKE_NM
        return changed


class ReconstructedSteps:
    """Makes steps from recorded inputs: by sets of one stamp as in lock-step, else one step for each wheel speed.

    Parameters
    ----------
    bag : open bag
    plan : car, policies, settings
    report : is told of what was done other than expected, restarts and faults

    Raises
    ------
    BagError
        The bag lacks a signal that is needed.
    """

    def __init__(self, bag: BagReader, plan: Plan, report: ReplayReport) -> None:
        self._plan = plan
        self._report = report
        self._stream = stream = SignalStream(bag, plan.mapping, plan.vehicle.params)
        check_signals(bag, plan.mapping, stream, wheels=True)
        probe = stream.probe()
        report.notes += stream.problems
        self._in_sets = stream.by_stamp and _in_sets(probe[:_PROBE_VALUES])
        self._wheels = self._again = 0  # wheel speeds, and those of them with the stamp of the one before
        self._wheels_ns = -1
        self._motion: list[MotionReading] = []  # since the last step: heard when the next one is due, as in the node
        self._came_ns: dict[str, int] = {}  # of each kind of input, by the log
        self._old: Counter[str] = Counter()  # wheel speeds that came when another input had not come for long
        vehicle = plan.vehicle.params
        judged = input_limits(RECORDED, vehicle.front.wheel.radius_m, by_clock=False)
        limits = ControllerLimits(judged, None, supervision_limits(RECORDED), actuator_limits(RECORDED))
        table = plan.policies.table(plan.settings.strategy, plan.friction)
        self._controller = Controller(vehicle, WHEEL_NAMES, limits, plan.settings, table, plan.friction)
        self._lockstep = Lockstep(self._controller, plan.period_s)
        self._recorded = AsRecorded(self._controller, plan.period_s, _PAUSE_S)

    def made(self, batch: Sequence[Message]) -> Iterator[list[ReplayedStep]]:
        """The steps that each message of a batch causes as an input."""
        for message in batch:
            bad = self._stream.bad_messages
            yield self._of(self._stream.values(message))
            self._report.bad_messages += self._stream.bad_messages - bad
            self._report.restarts = self._lockstep.restarts + self._recorded.restarts

    def not_believed(self) -> dict[str, dict[str, int]]:
        """Inputs that were not believed: counts by reason, by topic and wheel."""
        inputs = self._controller.monitor
        found = {
            topic: {reason.name.lower(): count for reason, count in tally.dropped.items()}
            for topic, tally in inputs.tallies.items()
            if tally.dropped
        }
        for (wheel, verdict), count in inputs.wheels_refused.items():
            if verdict is not WheelVerdict.ABSENT or not self._stream.without:  # that is said of the messages
                found.setdefault(f"wheel {wheel}", {})[verdict.name.lower()] = count
        return found

    def why_none(self) -> str:
        """Why there is no step, topic by topic."""
        taken, bad, why = self._stream.taken, self._stream.bad, self._stream.reasons
        parts = [
            f"{topic}: {taken[topic]} messages"
            + (f", {bad[topic]} of them bad ({one_line(why.get(topic, 'no number'), 100)})" if bad[topic] else "")
            for topic in sorted(self._stream.topics)
        ]
        tallies = self._controller.monitor.tallies
        for name, reasons in self.not_believed().items():
            counts = ", ".join(f"{count} {reason.replace('_', ' ')}" for reason, count in reasons.items())
            last = tallies[name].why() if name in tallies else ""
            parts.append(f"{name} not believed: {counts}" + (f" (the last: {last})" if last else ""))
        if self._again:
            parts.append(f"{self._again} wheel speeds with the stamp of the one before")
        parts += [f"{count} without a command: {reason}" for reason, count in self._report.faults.items()]
        return "; ".join([*parts, *self._report.notes]) or "no message"

    def notes(self) -> list[str]:
        """A line for each set of wheels that messages had no number for, and one if there were few steps."""
        stream, steps = self._stream, self._report.steps
        found = [
            f"{which} has no number in {count} messages: lost, as in the node"
            for which, count in stream.without.items()
        ]
        found += [
            f"{topic} had not come for {1e-9 * _OLD_NS:g} s at {count} wheel speeds: taken as it was last"
            for topic, count in self._old.items()
            if count > 1  # one is the first after a pause of all
        ]
        most = max(stream.taken[topic] for topic in stream.topics)
        if 0 < steps <= _FEW_STEPS * most:
            found.append(f"only {steps} steps of {most} messages: {self.why_none()}")
        elif 0 < steps < _STEPS_LACK * self._wheels:
            found.append(f"only {steps} steps of {self._wheels} wheel speeds: {self.why_none()}")
        elif steps and self._again > 1:
            found.append(f"{self._again} wheel speeds have the stamp of the one before, and no step of their own")
        return found

    def _of(self, values: Sequence[Recorded]) -> list[ReplayedStep]:
        steps: list[ReplayedStep] = []
        for value in values:
            reading: Any = value.reading
            topic = _TOPICS.get(type(reading))
            if topic == monitor.WHEELS:
                self._old.update(kind for kind, at in self._came_ns.items() if value.log_time_ns - at > _OLD_NS)
                self._wheels += 1
                self._again += reading.stamp_ns == self._wheels_ns
                self._wheels_ns = reading.stamp_ns
            elif isinstance(reading, MotionReading):
                self._motion.append(reading)
            elif isinstance(reading, DirectionReading):
                self._controller.monitor.direction = reading.direction
            if topic == (monitor.DEMAND if self._in_sets else monitor.WHEELS):
                for shown in self._motion:
                    self._controller.monitor.take_motion(shown.signal, shown.value, self._wheels_ns)
                self._motion.clear()
            if topic == monitor.FRICTION:
                self._friction(reading.friction, reading.stamp_ns)
            elif topic is not None:
                if topic in (monitor.SPEED, monitor.DEMAND):
                    self._came_ns[topic] = value.log_time_ns
                content = reading.power_w if topic == monitor.DEMAND else reading
                take = self._push if self._in_sets else self._use
                for taken in take(topic, content, reading.stamp_ns, value.publish_time_ns):
                    self._report.count_fault(taken.fault)
                    if taken.step is not None:  # else a fault, or the same set once more
                        steps.append(ReplayedStep(taken.stamp_ns, *value[:2], *taken.step))
        return steps

    def _push(self, topic: str, content: Any, now_ns: int, sent_ns: int) -> Iterable[Taken]:
        """Lock-step: collect a set, step when it is complete."""
        if topic == monitor.DEMAND:
            self._lockstep.queue.push_demand(sent_ns, content)
        else:
            self._lockstep.queue.push(_SETS[topic], now_ns, sent_ns, content)
        return self._lockstep.steps()

    def _use(self, topic: str, content: Any, now_ns: int, _: int) -> Iterable[Taken]:
        """Not in sets: keep the latest of everything, step at the wheel speeds."""
        inputs = self._controller.monitor
        if topic == monitor.SPEED:
            inputs.take_speed(content, now_ns)
        elif topic == monitor.BATTERY:
            inputs.take_battery(content, now_ns)
        elif topic == monitor.DEMAND:
            inputs.take_demand(content, 0.0, now_ns)
        elif (taken := self._recorded.step(content, now_ns)) is not None:
            return [taken]
        return []

    def _friction(self, friction: float, now_ns: int) -> None:
        controller = self._controller
        if self._plan.keeps_friction and controller.monitor.take_friction(friction, now_ns):
            controller.friction = controller.monitor.friction
            controller.policy = self._plan.policies.table(self._plan.settings.strategy, controller.friction)


def _in_sets(probe: Sequence[Recorded]) -> bool:
    """Whether speed, wheel speeds and battery come with the same stamps, as in lock-step."""
    values = [(_TOPICS.get(type(value.reading)), value) for value in probe]
    if not all(value.stamped for topic, value in values if topic in _SETS):
        return False
    stamps = [{value.reading.stamp_ns for found, value in values if found == topic} for topic in _SETS]
    common = set.intersection(*stamps)
    return len(common) > 1 and len(common) >= max(map(len, stamps)) - 2
