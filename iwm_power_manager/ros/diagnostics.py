# SPDX-License-Identifier: Apache-2.0
"""What `/diagnostics` says: levels, messages and values from plain numbers, and the loop's supervision.

The stamp is the node's clock, so that it is right under sim time; rates are per second of that clock as well.
Execution time is measured on the processor's own clock: it is real whatever the simulated time does.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from iwm_power_manager.control.actuators import ActuatorState, MotorVerdict
from iwm_power_manager.control.inputs import Violation, WheelVerdict
from iwm_power_manager.control.monitor import DEMAND, Tally
from iwm_power_manager.control.supervision import MODE_NAMES, MODE_NORMAL, STALE_NAMES, Supervision, binding_limits
from iwm_power_manager.control.types import GATE_NAMES, Wheels
from iwm_power_manager.ros.messages import ns_to_stamp

OK, WARN, ERROR, STALE = range(4)
#: Torques that act by so much later, or sooner, than is told are warned of, s.
_LATE_S = 0.005
_LEVELS = (DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR, DiagnosticStatus.STALE)


class Status(NamedTuple):
    """One component's state, as `diagnostic_msgs/DiagnosticStatus` has it."""

    name: str
    level: int
    message: str
    values: Mapping[str, str]


def to_message(stamp_ns: int, node_name: str, statuses: Sequence[Status]) -> DiagnosticArray:
    """All statuses of a node as one message."""
    message = DiagnosticArray()
    message.header.stamp = ns_to_stamp(stamp_ns)
    for status in statuses:
        message.status.append(
            DiagnosticStatus(
                level=_LEVELS[status.level],
                name=f"{node_name}: {status.name}",
                message=status.message,
                hardware_id=node_name,
                values=[KeyValue(key=key, value=value) for key, value in status.values.items()],
            )
        )
    return message


class LoopStatistics:
    """Periods and execution times of the control loop.

    Attributes
    ----------
    steps : steps counted so far
    """

    def __init__(self) -> None:
        self.steps = 0
        self._execution_s: list[float] = []
        self._period_s: list[float] = []

    def add(self, period_s: float | None, execution_s: float) -> None:
        """Count a step; `period_s` is None where there is no previous step."""
        self.steps += 1
        self._execution_s.append(execution_s)
        if period_s is not None:
            self._period_s.append(period_s)

    def report(self, rate_hz: float | None, limits: Mapping[str, float]) -> Status:
        """State of the control loop since the last call, judged as ros2_control does; starts measuring anew.

        Parameters
        ----------
        rate_hz : the rate that was asked for; None in lock-step, where there is none
        limits : execution_warn_us, execution_error_us, periodicity_warn_hz, periodicity_error_hz
        """
        executions_s, self._execution_s = self._execution_s, []
        periods_s, self._period_s = self._period_s, []
        problems: list[tuple[int, str]] = []
        values = {"steps": str(self.steps), "steps since the last report": str(len(executions_s))}
        if executions_s:
            mean_us = sum(executions_s) / len(executions_s) * 1e6
            values["execution time, mean (us)"] = f"{mean_us:.0f}"
            values["execution time, max (us)"] = f"{max(executions_s) * 1e6:.0f}"
            problems += _beyond(mean_us, limits, "execution", "us", "mean execution time")
        if sum(periods_s) > 0.0:
            mean_hz = len(periods_s) / sum(periods_s)
            values["rate, mean (Hz)"] = f"{mean_hz:.2f}"
            values["period, min (ms)"] = f"{min(periods_s) * 1e3:.3f}"
            values["period, max (ms)"] = f"{max(periods_s) * 1e3:.3f}"
            if rate_hz is not None:
                problems += _beyond(
                    abs(mean_hz - rate_hz), limits, "periodicity", "hz", f"{mean_hz:.1f} instead of {rate_hz:g} Hz:"
                )
        elif rate_hz is not None:
            problems.append((ERROR, "no step since the last report"))
        level, message = _worst(problems)
        return Status("control loop", level, message, values)


def _beyond(value: float, limits: Mapping[str, float], what: str, unit: str, text: str) -> list[tuple[int, str]]:
    for level, word in ((ERROR, "error"), (WARN, "warn")):
        limit = limits[f"{what}_{word}_{unit}"]
        if value > limit:
            return [(level, f"{text} {value:.0f} {unit.replace('hz', 'Hz')} is above {limit:g}")]
    return []


def _worst(problems: Sequence[tuple[int, str]]) -> tuple[int, str]:
    if not problems:
        return OK, "ok"
    return max(level for level, _ in problems), "; ".join(text for _, text in problems)


@dataclass
class InputReport:
    """State of the inputs; remembers the counts of the last report to tell rates."""

    _received: dict[str, int] = field(default_factory=dict)
    _dropped: dict[str, int] = field(default_factory=dict)
    _last_ns: int | None = None

    def report(
        self,
        now_ns: int,
        tallies: Mapping[str, Tally],
        stale: int,
        verdicts: Sequence[WheelVerdict],
        wheel_names: Sequence[str],
        silent: Mapping[str, tuple[Sequence[str], str]],
    ) -> Status:
        """Ages, rates, counters and reasons of all inputs; `silent` has the topics of one that is missing, and why."""
        problems: list[tuple[int, str]] = []
        values = {}
        elapsed_s = 0.0 if self._last_ns is None else (now_ns - self._last_ns) / 1e9
        missing = {name for bit, name in STALE_NAMES.items() if stale & bit}
        for topic, tally in tallies.items():
            dropped = sum(tally.dropped.values())
            values[f"{topic}: age (s)"] = f"{tally.age_s(now_ns):.3f}"
            if elapsed_s > 0.0:
                rate = (tally.received - self._received.get(topic, 0)) / elapsed_s
                values[f"{topic}: rate (Hz)"] = f"{rate:.1f}"
            values[f"{topic}: received"] = str(tally.received)
            values[f"{topic}: dropped"] = str(dropped)
            for reason, count in sorted(tally.dropped.items()):
                values[f"{topic}: dropped, {_words(reason)}"] = str(count)
            if topic in missing:
                problems.append((ERROR, _missing(topic, tally, *silent.get(topic, ((), "")))))
            elif dropped > self._dropped.get(topic, 0):
                problems.append((WARN, f"{topic}: {tally.why() or 'dropped'}"))
            self._received[topic], self._dropped[topic] = tally.received, dropped
        for name, verdict in zip(wheel_names, verdicts, strict=True):
            values[f"wheel {name}"] = _words(verdict)
            if verdict is not WheelVerdict.GOOD:
                problems.append((WARN, f"wheel {name} is not believed ({_words(verdict)})"))
        self._last_ns = now_ns
        level, message = _worst(problems)
        return Status("inputs", level, message, values)


def _missing(name: str, tally: Tally, topics: Sequence[str], reason: str) -> str:
    """That an input is missing, on which of its topics where its name is none of them, and why."""
    described = name == DEMAND and tally.described()  # which names the topic
    where = ", ".join(topic for topic in topics if not described and not topic.endswith(f"/{name}"))
    why = tally.why() or reason
    return f"{name} is missing" + (f" on {where}" if where else "") + (f" ({why})" if why else "")


def control_status(
    lifecycle: str,
    supervision: Supervision,
    gate: int,
    limits: int,
    activity: Mapping[str, int],
    strategy: str,
    car: Mapping[str, str],
    cut: str = "",
) -> Status:
    """What the control does: lifecycle state, mode and its reason, gate, limits and how often they bind; the car.

    With `cut`, limits leave nothing of what is asked for.
    """
    mode = MODE_NAMES[supervision.mode]
    missing = [name for bit, name in STALE_NAMES.items() if supervision.stale & bit]
    values = {
        "lifecycle": lifecycle,
        "mode": mode,
        "degraded reason": f"missing: {', '.join(missing)}" if missing else "none",
        "motor torque allowed (%)": f"{100.0 * supervision.motor_factor:.0f}",
        "strategy": strategy,
        **car,
        "gate": GATE_NAMES[gate],
        "limits that bind": ", ".join(binding_limits(limits, supervision.motor_factor)) or "none",
        **{f"{name}: steps since the last report": str(count) for name, count in activity.items()},
    }
    if lifecycle != "active":
        return Status("control", OK, lifecycle, values)
    if supervision.mode == MODE_NORMAL:
        return Status("control", WARN if cut else OK, cut or "normal", values)
    reason = f": {', '.join(missing)} missing" if missing else ""
    return Status("control", ERROR if missing else WARN, f"{mode}{reason}", values)


def motors_status(
    actuators: ActuatorState, friction_nm: Wheels, wheel_names: Sequence[str], later_s: float = 0.0
) -> Status:
    """Which motors do not do what they are told, what of their torque is counted on, and whose brakes hold them.

    `later_s` : by how much torques were found to act later than stamps and `actuator_delay_s` say
    """
    values = {
        "reported torque": "judged" if actuators.reporting else "none that follows the commands",
        "torques act later than told (ms)": f"{1e3 * later_s:g}",
    }
    problems: list[tuple[int, str]] = []
    if abs(later_s) >= _LATE_S:
        words = f"{1e3 * abs(later_s):g} ms {'later' if later_s > 0.0 else 'sooner'}"
        problems.append((WARN, f"torques act {words} than stamps of wheel_states and actuator_delay_s say"))
    for name, motor, brake_nm in zip(wheel_names, actuators.motors, friction_nm, strict=True):
        values[f"motor {name}"] = _words(motor.verdict)
        values[f"motor {name}: counted on (%)"] = f"{100.0 * motor.gain:.0f}"
        if motor.verdict is not MotorVerdict.GOOD:
            held = f" at {motor.stuck_nm:.0f} N m, held by its brake" if motor.stuck_nm and brake_nm else ""
            problems.append((ERROR, f"motor {name} is {_words(motor.verdict)}{held}"))
    level, message = _worst(problems)
    return Status("motors", level, message, values)


def brakes_status(gain: Wheels, wheel_names: Sequence[str]) -> Status:
    """Which friction brakes give less than they are told, as speeds and forces have it."""
    values = {
        f"brake {name}: counted on (%)": f"{100.0 * part:.0f}" for name, part in zip(wheel_names, gain, strict=True)
    }
    problems = [
        (ERROR, f"brake {name} is {'weak' if part else 'dead'}")
        for name, part in zip(wheel_names, gain, strict=True)
        if part < 1.0
    ]
    return Status("brakes", *_worst(problems), values)


def sensors_status(
    doubted_steps: Mapping[int, int], steps: int, wheel_names: Sequence[str], *, agree: bool, apart: str = ""
) -> Status:
    """Which speed sensors the law did not believe in most of its steps, because they contradict the others.

    Parameters
    ----------
    doubted_steps : steps in which it was not believed, by number of the wheel; 4 is `vehicle_speed`
    steps : steps since the last report
    wheel_names : the wheels in their order
    agree : all of them show the same motion
    apart : by what factor `vehicle_speed` and the wheels do not
    """
    names = [*(f"wheel {name}" for name in wheel_names), "vehicle_speed"]
    values = {
        f"{name}: not believed (% of the steps)": f"{100.0 * doubted_steps.get(number, 0) / max(steps, 1):.0f}"
        for number, name in enumerate(names)
    }
    contradicted = [name for number, name in enumerate(names) if 2 * doubted_steps.get(number, 0) > steps]
    why = apart if names[-1] in contradicted or len(contradicted) == len(wheel_names) else ""
    problem = f"{', '.join(contradicted)} not believed: {why or 'contradicts the others; right unit, sign and scale?'}"
    if agree and contradicted == names:
        problem = "vehicle_speed and wheels agree, but not with the motion before: car, bench or bag started over? "
        problem += "then deactivate and activate this node as well"
    return Status("sensors", *_worst([(WARN, problem)] if contradicted else []), values)


def _words(code: Violation | WheelVerdict | MotorVerdict) -> str:
    return code.name.lower().replace("_", " ")
