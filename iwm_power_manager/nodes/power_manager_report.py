# SPDX-License-Identifier: Apache-2.0
"""What the power manager reports on `/diagnostics`: collects between two reports, writes one on request."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray

from iwm_power_manager.control.controller import Controller
from iwm_power_manager.control.motion import DOUBT_SPEED
from iwm_power_manager.control.supervision import STALE_SPEED, STALE_WHEELS, Supervision, binding_limits
from iwm_power_manager.control.types import GATE_NONE, LIMIT_BATTERY_DISCHARGE, LIMIT_SLEW, Command
from iwm_power_manager.ros import diagnostics

#: Fewer steps since the last report say neither whether a sensor is believed nor whether torque is cut for long.
_FEW_STEPS = 5
#: Driving power that is asked for in earnest, and as a force, which near standstill makes little power; the part of it
#: that is as good as none; the part of steps that counts.
_ASKED_W, _ASKED_N, _NONE, _MOSTLY = 1e3, 500.0, 0.05, 0.9
#: Slower, a car may roll back on a slope; and what it gains in a second against its motors then.
_ROLLS_MPS, _GAINS_MPS = 1.5, 0.2
#: A car that its motors drive has moved off when it is faster than this, and does so sooner than in this time.
_MOVES_MPS, _MOVES_OFF_NS = 0.1, 2_000_000_000


def _in_earnest(command: Command, motor_factor: float, asked_w: float) -> bool:
    """Whether power to drive is asked for, and no input is missing."""
    return motor_factor == 1.0 and asked_w > min(_ASKED_W, _ASKED_N * max(abs(command.speed_mps), 1.0))


def is_cut(command: Command, motor_factor: float, asked_w: float) -> bool:
    """Whether power to drive is asked for and as good as none is given, although no input is missing."""
    given_w = command.front_power_w + command.rear_power_w
    return _in_earnest(command, motor_factor, asked_w) and abs(given_w) < _NONE * asked_w


def is_stuck(command: Command, motor_factor: float, asked_w: float) -> bool:
    """Whether a car stands, or rolls back slowly, although its motors are commanded what is asked for."""
    along_mps = command.speed_mps if sum(command.motor_torque_nm) > 0.0 else -command.speed_mps
    given = _in_earnest(command, motor_factor, asked_w) and not is_cut(command, motor_factor, asked_w)
    return given and -_ROLLS_MPS <= along_mps < _MOVES_MPS


def is_against(command: Command, asked_w: float) -> bool:
    """Whether the car moves against motors that drive it."""
    motors_nm = sum(command.motor_torque_nm)
    return asked_w > 0.0 and abs(command.speed_mps) > _ROLLS_MPS and command.speed_mps * motors_nm < 0.0


def against_in_words(command: Command) -> str:
    """What a car that moves against its motors may be wired like."""
    return (
        f"goes faster and faster, {command.speed_mps:.3g} m/s, against {sum(command.motor_torque_nm):.3g} N m of its "
        "motors: right sign of the motor_torque command, of speed and wheel_speed?"
    )


def stuck_in_words(command: Command) -> str:
    """What keeps a car from moving off."""
    held = ", its own brakes hold it" if any(command.friction_torque_nm) else ""
    motors_nm = sum(command.motor_torque_nm)
    return (
        f"does not move off, {command.speed_mps:.2g} m/s at {motors_nm:.3g} N m of its motors{held}: "
        "right sign of the motor_torque command? A brake that is on, too steep a slope?"
    )


def cut_in_words(controller: Controller) -> str:
    """What is asked for and which limits leave nothing of it; "" if none is known."""
    command, monitor = controller.command, controller.monitor
    if command is None or not (bits := command.limits & ~LIMIT_SLEW):
        return ""
    why = f"at {command.speed_mps:.3g} m/s"
    if bits & LIMIT_BATTERY_DISCHARGE:  # the last of them: before it, something was left
        bits = LIMIT_BATTERY_DISCHARGE
        why = f"charge {100.0 * monitor.soc:.3g} %"
        why += "" if math.isnan(monitor.temperature_c) else f", {monitor.temperature_c:.3g} degC"
        why += ": right unit?"
    limits = ", ".join(binding_limits(bits, 1.0))
    return f"asked for {monitor.demand_w / 1e3:.3g} kW, gets as good as none: {limits} ({why})"


class PowerManagerReport:
    """Counts steps, gates and limits; turns them and the node's present state into diagnostics.

    Parameters
    ----------
    node_name, wheel_names : in full; in their order
    rate_hz : of the control loop; None without one
    car : what is said of the car, by key

    Attributes
    ----------
    doubts : what the last report said of sensors that are not believed and of torque that is cut, for the log
    """

    def __init__(
        self, node_name: str, wheel_names: Sequence[str], rate_hz: float | None, car: Mapping[str, str]
    ) -> None:
        self._node_name = node_name
        self._wheel_names = wheel_names
        self._rate_hz = rate_hz
        self._car = car
        self._loop = diagnostics.LoopStatistics()
        self._inputs = diagnostics.InputReport()
        self._activity: Counter[str] = Counter()
        self._steps = 0
        self._doubted: Counter[int] = Counter()
        self._cut_steps = self._against_steps = self._stuck_steps = 0
        self._from_mps = 0.0
        self._stuck_since_ns: int | None = None
        self._cut = self._apart = self._against = self._stuck = ""
        self.doubts: list[str] = []

    def note_step(
        self, command: Command, supervision: Supervision, asked_w: float, period_s: float | None, execution_s: float
    ) -> None:
        """Count one step of the active node; what did not come is missing, and not doubted."""
        missing = DOUBT_SPEED * bool(supervision.stale & STALE_SPEED)
        missing |= (DOUBT_SPEED - 1) * bool(supervision.stale & STALE_WHEELS)
        doubted = command.doubted & ~missing
        self._loop.add(period_s, execution_s)
        self._steps += 1
        self._against_steps += is_against(command, asked_w)
        self._cut_steps += is_cut(command, supervision.motor_factor, asked_w)
        self._stuck_steps += is_stuck(command, supervision.motor_factor, asked_w)
        self._doubted.update(number for number in range(5) if doubted & 1 << number)
        if command.gate != GATE_NONE:
            self._activity["gate"] += 1
        if command.limits:
            self._activity.update(binding_limits(command.limits, supervision.motor_factor))

    def message(
        self,
        now_ns: int,
        lifecycle: str,
        controller: Controller | None,
        values: Mapping[str, Any],
        extra: Sequence[diagnostics.Status],
        silent: Mapping[str, tuple[Sequence[str], str]],
    ) -> DiagnosticArray:
        """State of the node since the last call.

        Parameters
        ----------
        now_ns : the node's clock
        lifecycle : label of the lifecycle state
        controller : None while the node is not configured
        values : the node's parameters
        extra : statuses of the node's own, as of the policy
        silent : of each input the topics that are missing if it is, and what is known of why
        """
        statuses: list[diagnostics.Status] = []
        command = controller.command if controller else None
        if controller and command and self._steps >= _FEW_STEPS:
            self._judge_drive(now_ns, controller, command)
        statuses.append(
            diagnostics.control_status(
                lifecycle,
                controller.supervision if controller else Supervision(),
                command.gate if command else GATE_NONE,
                command.limits if command else 0,
                self._activity,
                values["strategy"],
                self._car,
                self._cut or self._against or self._stuck,
            )
        )
        if lifecycle == "active" and controller:
            statuses.append(
                self._inputs.report(
                    now_ns,
                    controller.monitor.tallies,
                    controller.supervision.stale,
                    controller.monitor.verdicts,
                    self._wheel_names,
                    silent,
                )
            )
            self._apart = (self._apart or controller.monitor.apart) if self._doubted else ""  # the same words, as above
            agree = controller.monitor.agree
            sensors = diagnostics.sensors_status(
                self._doubted, self._steps, self._wheel_names, agree=agree, apart=self._apart
            )
            if self._steps >= _FEW_STEPS:
                self.doubts = [sensors.message] if sensors.level != diagnostics.OK else []
                self.doubts += [words for words in (self._cut, self._against, self._stuck) if words]
            statuses.append(sensors)
            friction_nm = controller.command.friction_torque_nm if controller.command else (0.0,) * 4
            later_s = controller.torques_later_s
            statuses.append(diagnostics.motors_status(controller.actuators, friction_nm, self._wheel_names, later_s))
            statuses.append(diagnostics.brakes_status(controller.brake_gain, self._wheel_names))
            statuses.append(self._loop.report(self._rate_hz, values))
        self._activity.clear()
        self._doubted.clear()
        self._steps = self._cut_steps = self._against_steps = self._stuck_steps = 0
        return diagnostics.to_message(now_ns, self._node_name, [*statuses, *extra])

    def _judge_drive(self, now_ns: int, controller: Controller, command: Command) -> None:
        """Whether the car does what its motors are asked for; the same words as long as it lasts."""
        most = _MOSTLY * self._steps
        self._cut = (self._cut or cut_in_words(controller)) if self._cut_steps > most else ""
        gained = abs(command.speed_mps) > abs(self._from_mps) + _GAINS_MPS
        against = self._against_steps > most and (gained or bool(self._against))
        self._against = (self._against or against_in_words(command)) if against else ""
        self._from_mps = command.speed_mps
        if self._stuck_steps <= most:
            self._stuck_since_ns, self._stuck = None, ""
        elif self._stuck_since_ns is None:
            self._stuck_since_ns = now_ns
        elif now_ns - self._stuck_since_ns >= _MOVES_OFF_NS:
            self._stuck = self._stuck or stuck_in_words(command)


class ChangeDetector:
    """Tells when something worth a report at once has changed, no more often than a least period."""

    def __init__(self, least_period_s: float) -> None:
        self._least_period_s = least_period_s
        self._reported: object = None
        self._reported_at_s = float("-inf")

    def changed(self, state: object, time_s: float) -> bool:
        """Whether `state` differs from the one last reported, and the last report is long enough ago."""
        if state == self._reported or time_s - self._reported_at_s < self._least_period_s:
            return False
        self._reported = state
        self._reported_at_s = time_s
        return True
