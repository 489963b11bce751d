# SPDX-License-Identifier: Apache-2.0
"""From the messages of a bag to control steps: repeated exactly where the bag has them, else made from the inputs."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from iwm_power_manager.control import law, lockstep
from iwm_power_manager.control.controller import Controller, ControllerLimits
from iwm_power_manager.control.guard import violated_bound
from iwm_power_manager.control.monitor import (
    BATTERY,
    DEMAND,
    FRICTION,
    SPEED,
    WHEELS,
    BatteryReading,
    JointReading,
    SpeedReading,
)
from iwm_power_manager.control.record import DECIDED_NAMES, SIGNAL_NAMES, YOUNGER_SIGNALS, decided, from_numbers
from iwm_power_manager.control.settings import Settings
from iwm_power_manager.control.stepping import AsRecorded, Lockstep, Taken
from iwm_power_manager.control.thresholds import RECORDED, actuator_limits, input_limits, supervision_limits
from iwm_power_manager.control.types import Command, ControllerState, initial_state
from iwm_power_manager.replay.plan import Plan
from iwm_power_manager.replay.recorded import Recorded
from iwm_power_manager.signals.contract import WHEEL_NAMES
from iwm_power_manager.signals.readings import DemandReading, FrictionReading, NamedValues

#: What each kind of reading is to the controller.
_TOPICS = {
    SpeedReading: SPEED,
    JointReading: WHEELS,
    BatteryReading: BATTERY,
    DemandReading: DEMAND,
    FrictionReading: FRICTION,
}
#: A pause in the recording longer than this starts the law anew.
_PAUSE_S = 1.0
#: Values from the start of a bag that show whether its messages come in sets of one stamp.
_PROBE_VALUES = 400


class ReplayedStep(NamedTuple):
    """One step of the law.

    Attributes
    ----------
    stamp_ns : of the command
    log_time_ns, publish_time_ns : of the message that caused the step
    command : what it decided
    before, after : its memory
    values : numbers of `control.record.SIGNALS`
    """

    stamp_ns: int
    log_time_ns: int
    publish_time_ns: int
    command: Command
    before: ControllerState
    after: ControllerState
    values: Sequence[float]


class RecordedSteps:
    """Repeats the steps a `power_manager/state` has recorded, bit by bit as long as none is missing.

    Attributes
    ----------
    gaps : times at which the law's memory is unknown, because steps before are not in the bag
    late_start : the first recorded step is not the first of its run
    faults : steps whose command no motor may be given; they come without a command
    """

    def __init__(self, plan: Plan) -> None:
        self.gaps = 0
        self.late_start = False
        self.faults: Counter[str] = Counter()
        self._plan = plan
        self._state = initial_state()
        self._next = 0
        self._last: ReplayedStep | None = None
        self._settings: Settings | None = None
        self._setting_values: dict[str, float] = {}

    def take(self, recorded: NamedValues, log_time_ns: int, publish_time_ns: int) -> ReplayedStep | None:
        """Repeat one step; `KeyError` if the message is of another kind or version."""
        values = YOUNGER_SIGNALS | dict(zip(recorded.names, recorded.values, strict=True))
        number = int(values["step"])
        last = self._last
        if last is not None and last.stamp_ns == recorded.stamp_ns and last.before.steps == number:
            return last._replace(log_time_ns=log_time_ns, publish_time_ns=publish_time_ns)  # an answer, repeated
        first, measurement, settings = from_numbers(values)
        if first:
            self._state = initial_state()
        elif number != self._next:
            self.gaps += 1
            self.late_start |= self._last is None
            self._state = self._state._replace(steps=number)
        self._next = number + 1
        plan = self._plan
        if plan.changes:
            settings = settings._replace(**plan.changes)
        if not plan.keeps_friction:
            measurement = measurement._replace(friction=plan.friction)
        table = plan.policies.table(settings.strategy, measurement.friction)
        before = self._state
        command, after = law.step(measurement, before, settings, plan.vehicle.params, table)
        self._state = after
        problem = violated_bound(command, plan.vehicle.params)
        if problem:
            self.faults[problem] += 1
            return None
        values.update(zip(DECIDED_NAMES, map(float, decided(command, before, after)), strict=True))
        if settings != self._settings:  # they rarely change
            self._settings = settings
            self._setting_values = {f"setting.{name}": float(value) for name, value in settings._asdict().items()}
        values.update(self._setting_values)
        values["friction"] = measurement.friction
        self._last = ReplayedStep(
            recorded.stamp_ns,
            log_time_ns,
            publish_time_ns,
            command,
            before,
            after,
            [values[name] for name in SIGNAL_NAMES],
        )
        return self._last


class ReconstructedSteps:
    """Makes steps from recorded inputs: by sets of one stamp as in lock-step, else one step for each wheel speed.

    Parameters
    ----------
    plan : car, policies, settings
    probe : readings from its start

    Attributes
    ----------
    in_sets : the inputs come in sets of one stamp
    faults : steps whose command no motor may be given
    """

    def __init__(self, plan: Plan, probe: Iterable[Recorded]) -> None:
        self.faults: Counter[str] = Counter()
        self._plan = plan
        self.in_sets = _in_sets(probe)
        vehicle = plan.vehicle.params
        limits = ControllerLimits(
            input_limits(RECORDED, vehicle.front.wheel.radius_m, by_clock=False),
            None,
            supervision_limits(RECORDED),
            actuator_limits(RECORDED),
        )
        table = plan.policies.table(plan.settings.strategy, plan.friction)
        self._controller = Controller(vehicle, WHEEL_NAMES, limits, plan.settings, table, plan.friction)
        self._lockstep = Lockstep(self._controller, plan.period_s)
        self._recorded = AsRecorded(self._controller, plan.period_s, _PAUSE_S)

    @property
    def restarts(self) -> int:
        """Pauses in the recording, or jumps back, after which the law started anew."""
        return self._lockstep.restarts + self._recorded.restarts

    @property
    def dropped(self) -> dict[str, dict[str, int]]:
        """Inputs that were not believed: counts by reason, by topic."""
        return {
            topic: {reason.name.lower(): count for reason, count in tally.dropped.items()}
            for topic, tally in self._controller.monitor.tallies.items()
            if tally.dropped
        }

    def take(self, values: Sequence[Recorded]) -> list[ReplayedStep]:
        """The readings of one message; returns the steps they cause."""
        steps = []
        for value in values:
            topic = _TOPICS.get(type(value.reading))
            if topic is not None:
                reading: Any = value.reading
                content = reading[-1] if topic in (DEMAND, FRICTION) else reading
                steps += (self._push if self.in_sets else self._use)(topic, content, reading.stamp_ns, value)
        return steps

    def _push(self, topic: str, content: object, now_ns: int, value: Recorded) -> list[ReplayedStep]:
        """Lock-step: collect a set, step when it is complete."""
        queue = self._lockstep.queue
        if topic == DEMAND:
            queue.push_demand(value.publish_time_ns, content)
        elif topic == FRICTION:
            self._friction(content, now_ns)
        else:
            kind = {SPEED: lockstep.SPEED, WHEELS: lockstep.WHEELS, BATTERY: lockstep.BATTERY}[topic]
            queue.push(kind, now_ns, value.publish_time_ns, content)
        before = self._controller.state
        steps = []
        for taken in self._lockstep.steps():
            steps += self._replayed(taken, before, value)
            before = self._controller.state
        return steps

    def _use(self, topic: str, content: object, now_ns: int, value: Recorded) -> list[ReplayedStep]:
        """Not in sets: keep the latest of everything, step at the wheel speeds."""
        monitor = self._controller.monitor
        if topic == SPEED:
            monitor.take_speed(content, now_ns)  # type: ignore[arg-type]
        elif topic == BATTERY:
            monitor.take_battery(content, now_ns)  # type: ignore[arg-type]
        elif topic == DEMAND:
            monitor.take_demand(content, 0.0, now_ns)  # type: ignore[arg-type]
        elif topic == FRICTION:
            self._friction(content, now_ns)
        else:
            before = self._controller.state
            taken = self._recorded.step(content, now_ns)
            return self._replayed(taken, before, value) if taken is not None else []
        return []

    def _friction(self, content: object, now_ns: int) -> None:
        controller = self._controller
        if self._plan.keeps_friction and controller.monitor.take_friction(content, now_ns):  # type: ignore[arg-type]
            controller.friction = controller.monitor.friction
            controller.policy = self._plan.policies.table(self._plan.settings.strategy, controller.friction)

    def _replayed(self, taken: Taken, before: ControllerState, value: Recorded) -> list[ReplayedStep]:
        if taken.fault:
            self.faults[taken.fault] += 1
        if taken.step is None:
            return []  # a fault, or the same set once more
        command, numbers = taken.step
        return [
            ReplayedStep(
                taken.stamp_ns,
                value.log_time_ns,
                value.publish_time_ns,
                command,
                before if taken.since_s is not None else initial_state(),
                self._controller.state,
                numbers,
            )
        ]


def _in_sets(probe: Iterable[Recorded]) -> bool:
    """Whether speed, wheel speeds and battery come with the same stamps, as in lock-step."""
    stamps: dict[type, set[int]] = {SpeedReading: set(), JointReading: set(), BatteryReading: set()}
    for value in itertools.islice(probe, _PROBE_VALUES):
        if type(value.reading) in stamps:
            if not value.stamped:
                return False
            stamps[type(value.reading)].add(value.reading.stamp_ns)
    common = set.intersection(*stamps.values())
    return len(common) > 1 and len(common) >= max(map(len, stamps.values())) - 2
