# SPDX-License-Identifier: Apache-2.0
"""When the simulator steps: answers awaited in lock-step, steps due in real time. Plain numbers, no ROS, no clock."""

from __future__ import annotations

from iwm_power_manager.control.types import Wheels
from iwm_power_manager.errors import FailedError

#: The two commands that answer a set of inputs.
MOTOR, FRICTION = range(2)


class NoAnswerError(FailedError):
    """The power manager has not answered a set of inputs, however often it was sent."""


class Exchange:
    """One set of inputs at a time: which commands have answered it, and when to send it again.

    Parameters
    ----------
    resend_after_s : a set without a complete answer is sent again this often
    give_up_after_s : `NoAnswerError` after this long

    Attributes
    ----------
    awaited_ns : stamp of the set that waits for its answer; -1 if none does
    resent, unrelated : sets sent again, and commands that answered no awaited set
    """

    def __init__(self, resend_after_s: float, give_up_after_s: float) -> None:
        self._resend_after_s = resend_after_s
        self._give_up_after_s = give_up_after_s
        self.awaited_ns = -1
        self._asked_s = 0.0
        self._sent_s = 0.0
        self._answers: list[Wheels | None] = [None, None]
        self.resent = 0
        self.unrelated = 0

    def ask(self, stamp_ns: int, now_s: float) -> None:
        """Begin to wait for the answer to the set with this stamp."""
        self.awaited_ns = stamp_ns
        self._asked_s = self._sent_s = now_s
        self._answers = [None, None]

    def answer(self, kind: int, stamp_ns: int, torque_nm: Wheels) -> tuple[Wheels, Wheels] | None:
        """Take a command, MOTOR or FRICTION; returns both once both have come.

        A command with another stamp answers a set sent twice, or is somebody else's: it is counted and left alone.
        """
        if stamp_ns != self.awaited_ns:
            self.unrelated += 1
            return None
        self._answers[kind] = torque_nm
        motor, friction = self._answers
        if motor is None or friction is None:
            return None
        self.awaited_ns = -1
        return motor, friction

    def overdue(self, now_s: float) -> bool:
        """Whether the set has to be sent again now.

        Raises
        ------
        NoAnswerError
            The set has been waiting for `give_up_after_s`.
        """
        if self.awaited_ns < 0 or now_s - self._sent_s < self._resend_after_s:
            return False
        if now_s - self._asked_s >= self._give_up_after_s:
            names = ("wheel_torque_command", "friction_brake_command")
            missing = " and ".join(name for name, got in zip(names, self._answers, strict=True) if got is None)
            raise NoAnswerError(
                f"no {missing} with stamp {self.awaited_ns / 1e9:.3f} s within {self._give_up_after_s:g} s "
                f"(sent {1 + self.resent} times or more): has the power manager ended, or does it run without lockstep?"
            )
        self._sent_s = now_s
        self.resent += 1
        return True


class Pacer:
    """How many steps are due on a clock that runs `speed_factor` times as fast as the wall's.

    A short stall is caught up; after a long one the simulated time is late for good, because a car that takes a hundred
    steps at once no longer listens to its controller.

    Parameters
    ----------
    period_s : simulated time of one step
    speed_factor : simulated seconds per second
    catch_up : most steps taken at once

    Attributes
    ----------
    stalls, late_s : long stalls, and how late simulated time is for good because of them, wall s
    """

    def __init__(self, period_s: float, speed_factor: float, catch_up: int = 5) -> None:
        self.wall_period_s = period_s / speed_factor
        self._catch_up = catch_up
        self._start_s = 0.0
        self._taken = 0
        self.stalls = 0
        self.late_s = 0.0

    def start(self, now_s: float) -> None:
        """Begin: the first step is due one period from now."""
        self._start_s = now_s
        self._taken = 0

    def due(self, now_s: float) -> int:
        """Steps to take now; they count as taken."""
        # A timer that fires a hair early must not lose its step.
        steps = int((now_s - self._start_s - self.late_s) / self.wall_period_s + 0.01) - self._taken
        if steps > self._catch_up:
            self.stalls += 1
            self.late_s += (steps - self._catch_up) * self.wall_period_s
            steps = self._catch_up
        steps = max(steps, 0)
        self._taken += steps
        return steps
