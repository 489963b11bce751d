# SPDX-License-Identifier: Apache-2.0
"""What the power manager reports on `/diagnostics`: collects between two reports, writes one on request."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray

from iwm_power_manager.control.controller import Controller
from iwm_power_manager.control.supervision import Supervision, binding_limits
from iwm_power_manager.control.types import GATE_NONE, Command
from iwm_power_manager.ros import diagnostics

#: Fewer steps since the last report do not say whether a sensor is believed.
_FEW_STEPS = 5


class PowerManagerReport:
    """Counts steps, gates and limits; turns them and the node's present state into diagnostics.

    Parameters
    ----------
    node_name, wheel_names : in full; in their order
    rate_hz : of the control loop; None without one
    car : what is said of the car, by key

    Attributes
    ----------
    doubts : what the last report said of sensors that are not believed, for the log
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
        self.doubts: list[str] = []

    def note_step(self, command: Command, motor_factor: float, period_s: float | None, execution_s: float) -> None:
        """Count one step of the active node."""
        self._loop.add(period_s, execution_s)
        self._steps += 1
        self._doubted.update(number for number in range(5) if command.doubted & 1 << number)
        if command.gate != GATE_NONE:
            self._activity["gate"] += 1
        if command.limits:
            self._activity.update(binding_limits(command.limits, motor_factor))

    def message(
        self,
        now_ns: int,
        lifecycle: str,
        controller: Controller | None,
        values: Mapping[str, Any],
        extra: Sequence[diagnostics.Status],
    ) -> DiagnosticArray:
        """State of the node since the last call.

        Parameters
        ----------
        now_ns : the node's clock
        lifecycle : label of the lifecycle state
        controller : None while the node is not configured
        values : the node's parameters
        extra : statuses of the node's own, as of the policy
        """
        statuses: list[diagnostics.Status] = []
        command = controller.command if controller else None
        statuses.append(
            diagnostics.control_status(
                lifecycle,
                controller.supervision if controller else Supervision(),
                command.gate if command else GATE_NONE,
                command.limits if command else 0,
                self._activity,
                values["strategy"],
                self._car,
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
                )
            )
            agree = controller.monitor.agree
            sensors = diagnostics.sensors_status(self._doubted, self._steps, self._wheel_names, agree=agree)
            if self._steps >= _FEW_STEPS:
                self.doubts = [sensors.message] if sensors.level != diagnostics.OK else []
            statuses.append(sensors)
            statuses.append(diagnostics.motors_status(controller.actuators, self._wheel_names))
            statuses.append(diagnostics.brakes_status(controller.brake_gain, self._wheel_names))
            statuses.append(self._loop.report(self._rate_hz, values))
        self._activity.clear()
        self._doubted.clear()
        self._steps = 0
        return diagnostics.to_message(now_ns, self._node_name, [*statuses, *extra])


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
