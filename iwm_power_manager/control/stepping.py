# SPDX-License-Identifier: Apache-2.0
"""When the controller steps, and how long a step counts: in real time, in lock-step, and over a recording.

Three small steppers on one piece of code. The node and the replay decide nothing of this themselves.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

from iwm_power_manager.control.car_restart import CarRestart
from iwm_power_manager.control.controller import ControlFaultError, Controller, Step
from iwm_power_manager.control.lockstep import LockstepQueue, LockstepSet
from iwm_power_manager.control.thresholds import Thresholds

_NS_PER_S = 1e9
#: Of the age a command may have: the rest is the middleware's, which may have to wait for a lock that a thread without
#: a processor holds (12 ms and more were seen where five processes wanted each processor).
OWN_SHARE = 0.5
#: Why a run in real time begins anew by itself.
HELD_UP = "this process was held up (own_gap_s)"
CAR_STARTED_OVER = "vehicle_speed and wheels stayed away, and stand now: the car was started over"


class Taken(NamedTuple):
    """A step that was taken.

    Attributes
    ----------
    stamp_ns : time of the step
    since_s : time since the step before; None at the first of a run
    step : what came of it; None to repeat the last answer, or after a fault
    fault : why there is no command: the law returned one that no motor may be given
    """

    stamp_ns: int
    since_s: float | None
    step: Step | None
    fault: str = ""


class Stepper:
    """What the three have in common: the time of the step before, and starting over.

    Attributes
    ----------
    controller : takes the steps
    last_ns : time of the step before; None at the start of a run
    restarts : how often a run began anew by itself
    reason : why it did the last time, in real time
    """

    def __init__(self, controller: Controller, period_s: float) -> None:
        self.controller = controller
        self.period_s = period_s
        self.last_ns: int | None = None
        self.restarts = 0
        self.reason = ""

    def start_over(self) -> None:
        """Begin a new run, as at activation."""
        self.controller.reset()
        self.last_ns = None

    def since_s(self, now_ns: int) -> float | None:
        """Time since the step before; None at the first of a run."""
        return None if self.last_ns is None else (now_ns - self.last_ns) / _NS_PER_S

    def _restart(self, reason: str = "") -> None:
        self.restarts += 1
        self.reason = reason
        self.start_over()

    def _take(self, stamp_ns: int, dt_s: float, since_s: float | None) -> Taken:
        self.last_ns = stamp_ns
        try:
            return Taken(stamp_ns, since_s, self.controller.step(stamp_ns, dt_s, since_s))
        except ControlFaultError as error:
            return Taken(stamp_ns, since_s, None, str(error))


class RealTime(Stepper):
    """One step each time the clock says so; the step counts as long as it was, within bounds.

    A process that is held up does not notice by itself: its memory, and a command it has just computed, are older than
    any input may be. So each step begins and ends with a look at a clock that nobody sets.
    """

    def __init__(self, controller: Controller, period_s: float, thresholds: Thresholds) -> None:
        super().__init__(controller, period_s)
        self._thresholds = thresholds
        self._gap_s = max(thresholds.own_gap_s, thresholds.longest_step_periods * period_s)  # of a slow loop, steps
        self._began_s: float | None = None
        self._car_restart = CarRestart()

    def start_over(self) -> None:
        """Begin a new run, as at activation."""
        super().start_over()
        self._began_s = None
        self._car_restart = CarRestart()

    def begin(self, steady_s: float | None) -> None:
        """Before inputs are looked at: start over, as after activation, if this process was held up for too long, or
        the car was started over.

        Parameters
        ----------
        steady_s : monotonic clock; None where time is simulated and may well stand still
        """
        if steady_s is not None and self._began_s is not None and steady_s - self._began_s > self._gap_s:
            self._restart(HELD_UP)
        elif self._car_restart.found:
            self._restart(CAR_STARTED_OVER)
        self._began_s = steady_s

    def step(self, now_ns: int) -> Taken:
        """Step at a time of the node's clock."""
        since_s = self.since_s(now_ns)
        if since_s is not None and since_s <= 0.0:
            # The clock was set back: the stamps and ages of before mean nothing now, the values still do.
            self.controller.monitor.forget_times()
            since_s = None
        shortest_s = self._thresholds.shortest_step_periods * self.period_s
        longest_s = self._thresholds.longest_step_periods * self.period_s
        dt_s = self.period_s if since_s is None else min(max(since_s, shortest_s), longest_s)
        taken = self._take(now_ns, dt_s, since_s)
        self._car_restart.look(self.controller, now_ns)
        return taken

    def may_send(self, steady_s: float) -> bool:
        """Just before sending: whether the command is young enough; the run starts over if it is older than allowed."""
        age_s = 0.0 if self._began_s is None else steady_s - self._began_s
        if age_s > self._thresholds.command_oldest_s:
            self._restart(HELD_UP)
        return age_s <= OWN_SHARE * self._thresholds.command_oldest_s


class Lockstep(Stepper):
    """One step for each complete set of inputs; a set with the stamp before is answered as before."""

    def __init__(self, controller: Controller, period_s: float) -> None:
        super().__init__(controller, period_s)
        self.queue = LockstepQueue()

    def steps(self) -> Iterator[Taken]:
        """Steps of the sets that are complete by now."""
        while (inputs := self.queue.pop()) is not None:
            if inputs.demand is None:
                yield Taken(inputs.stamp_ns, None, None)
                continue
            if self.last_ns is not None and inputs.stamp_ns <= self.last_ns:
                self._restart()  # the stamps went back: a new run
            since_s = self.since_s(inputs.stamp_ns)
            self._judge(inputs)
            yield self._take(inputs.stamp_ns, self.period_s if since_s is None else since_s, since_s)

    def _judge(self, inputs: LockstepSet) -> None:
        monitor, stamp_ns = self.controller.monitor, inputs.stamp_ns
        monitor.take_speed(inputs.speed, stamp_ns)
        monitor.take_wheels(inputs.wheels, stamp_ns)
        monitor.take_battery(inputs.battery, stamp_ns)
        monitor.take_demand(inputs.demand, 0.0, stamp_ns)


class AsRecorded(Stepper):
    """One step for each set of wheel speeds of a recording whose inputs come as they please.

    Parameters
    ----------
    longest_pause_s : a longer pause in the recording starts the law anew
    """

    def __init__(self, controller: Controller, period_s: float, longest_pause_s: float) -> None:
        super().__init__(controller, period_s)
        self._longest_pause_s = longest_pause_s

    def step(self, wheels: Any, now_ns: int) -> Taken | None:
        """Judge wheel speeds and step; None where there is no step to take (yet)."""
        monitor = self.controller.monitor
        if not monitor.take_wheels(wheels, now_ns) or not monitor.driven or now_ns == self.last_ns:
            return None
        since_s = self.since_s(now_ns)
        if since_s is not None and not 0.0 < since_s <= self._longest_pause_s:
            self._restart()  # what came before the pause is of no use: wait for speed and demand
            return None
        return self._take(now_ns, self.period_s if since_s is None else since_s, since_s)
