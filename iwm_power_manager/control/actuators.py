# SPDX-License-Identifier: Apache-2.0
"""Motors that do not do what they are told: commanded against reported torque, motor by motor.

A report is late by up to `lag_s`, so it is held against all commands of that time: it has to lie between the least and
the largest of them, give or take a tolerance. A motor whose reports lie outside for `confirm_s` is judged by the ratio
of reported to commanded torque over that time: dead, weak, reversed, or stuck where the report does not follow at all.
The torque the law may count on is `gain` times what it commands; a motor that does not follow is switched off.

Reports are only judged once some motor has been seen to follow its commands: a car that fills the field with zeros does
not report, nor does one all of whose motors seem to be stuck or reversed. Before that only a motor is judged that
reports far more than it was commanded, while the others report what they were, one of them no less: that is no report
that is missing, late, unsigned or in other units. What else was found stays until the next activation, except a weak
motor that follows again for `recover_s`, and four that seem dead until one follows: their reports may be dead instead,
so that driving is still tried.

Pure functions over numbers; one call a step for each motor.
"""

from __future__ import annotations

import enum
import math
from typing import NamedTuple

from iwm_power_manager.control.types import Wheels


class MotorVerdict(enum.IntEnum):
    """What became of a motor's torque."""

    GOOD = 0
    WEAK = 1  # follows, with a part of the torque
    DEAD = 2
    STUCK = 3  # a torque of its own, whatever is commanded
    REVERSED = 4


class ActuatorLimits(NamedTuple):
    """What is believed of a reported torque.

    Attributes
    ----------
    tolerance_nm : error that is always believed, N m > 0
    tolerance_ratio : and as part of the torque, >= 0
    lag_s : a report may belong to any command of this time
    confirm_s : how long reports have to be outside before a motor is judged
    recover_s : how long a weak motor has to follow before it counts as good again
    delay_s : time after which a command is a torque, of motors and brakes
    """

    tolerance_nm: float
    tolerance_ratio: float
    lag_s: float
    confirm_s: float
    recover_s: float
    delay_s: float


class Evidence(NamedTuple):
    """What is remembered of one motor.

    Attributes
    ----------
    verdict, gain : as found; gain is the part of a commanded torque that arrives, 0 for a motor that is switched off
    stuck_nm : torque that a motor has although it is switched off
    outside_s : how long the reports have been outside
    inside_s : how long those of a weak motor have been inside while there was a torque to judge
    product, square : sums of commanded times reported and of commanded squared torque while outside, (N m)2
    least_nm, most_nm : of the reports while outside
    commanded_least_nm, commanded_most_nm : of the commands while outside
    """

    verdict: MotorVerdict = MotorVerdict.GOOD
    gain: float = 1.0
    stuck_nm: float = 0.0
    outside_s: float = 0.0
    inside_s: float = 0.0
    product: float = 0.0
    square: float = 0.0
    least_nm: float = math.inf
    most_nm: float = -math.inf
    commanded_least_nm: float = math.inf
    commanded_most_nm: float = -math.inf

    @property
    def spotless(self) -> bool:
        """Whether nothing speaks against the motor."""
        return self.verdict is MotorVerdict.GOOD and self.outside_s == 0.0


class Commanded(NamedTuple):
    """One command that was sent: how long ago, and its motor torques."""

    age_s: float
    torque_nm: Wheels


class ActuatorState(NamedTuple):
    """What is remembered of all motors.

    Attributes
    ----------
    motors : in the order of the wheels
    recent : commands of the last `lag_s`, the newest last
    reporting : some motor has been seen to follow its commands
    """

    motors: tuple[Evidence, Evidence, Evidence, Evidence] = (Evidence(),) * 4
    recent: tuple[Commanded, ...] = ()
    reporting: bool = False

    @property
    def all_dead(self) -> bool:
        """Whether no motor seems to give anything: one supply for all, or the reports."""
        return all(motor.verdict is MotorVerdict.DEAD for motor in self.motors)

    @property
    def gains(self) -> Wheels:
        """Part of a commanded torque that arrives, motor by motor."""
        a, b, c, d = self.motors
        return (a.gain, b.gain, c.gain, d.gain)

    @property
    def stuck_nm(self) -> Wheels:
        """Torque that each motor has whatever it is commanded."""
        a, b, c, d = self.motors
        return (a.stuck_nm, b.stuck_nm, c.stuck_nm, d.stuck_nm)


#: Ratio of reported to commanded torque below which a motor is dead, and below whose negative it is reversed.
DEAD_RATIO = 0.2


def commanded(state: ActuatorState, torque_nm: Wheels, dt_s: float, limits: ActuatorLimits) -> ActuatorState:
    """Remember a command that was sent, `dt_s` after the one before."""
    kept = [Commanded(age_s + dt_s, sent_nm) for age_s, sent_nm in state.recent if age_s + dt_s <= limits.lag_s]
    return ActuatorState(state.motors, (*kept, Commanded(0.0, torque_nm)), state.reporting)


def judge(state: ActuatorState, reported_nm: Wheels, dt_s: float, limits: ActuatorLimits) -> ActuatorState:
    """Hold the latest reports against the commands they can belong to.

    Parameters
    ----------
    state : what is remembered
    reported_nm : motor torques, driving positive; NaN: not reported
    dt_s : time since the previous reports, > 0
    limits : what is believed
    """
    if not state.recent:
        return state
    sent = zip(*[torque_nm for _, torque_nm in state.recent], strict=True)
    reports = [(reported, min(one), max(one)) for reported, one in zip(reported_nm, sent, strict=True)]
    obeyed = all(motor.spotless for motor in state.motors) and all(_within(*report, limits) for report in reports)
    if obeyed and (state.reporting or not any(_follows(*report, limits) for report in reports)):
        return state  # as nearly always
    if (state.all_dead or not state.reporting) and any(_follows(*report, limits) for report in reports):
        state = ActuatorState((Evidence(),) * 4 if state.all_dead else state.motors, state.recent, True)
    a, b, c, d = (
        _judged(motor, *report, dt_s, limits)
        if state.reporting or motor.verdict is not MotorVerdict.GOOD or _alone_astray(k, reports, limits)
        else Evidence()
        for k, (motor, report) in enumerate(zip(state.motors, reports, strict=True))
    )
    judged = ActuatorState((a, b, c, d), state.recent, state.reporting)
    if all(motor.verdict in (MotorVerdict.STUCK, MotorVerdict.REVERSED) for motor in judged.motors):
        return ActuatorState(recent=state.recent)  # four motors do not get stuck at once: the reports did
    return judged


def _tolerance_nm(least_nm: float, most_nm: float, limits: ActuatorLimits) -> float:
    return limits.tolerance_nm + limits.tolerance_ratio * max(abs(least_nm), abs(most_nm))


def _within(reported_nm: float, least_nm: float, most_nm: float, limits: ActuatorLimits) -> bool:
    """Whether a report is one of what was commanded, give or take the tolerance."""
    tolerance = _tolerance_nm(least_nm, most_nm, limits)
    return least_nm - tolerance <= reported_nm <= most_nm + tolerance


def _follows(reported_nm: float, least_nm: float, most_nm: float, limits: ActuatorLimits) -> bool:
    """Whether a report can only come from a motor that follows: a torque that is clearly there, and as commanded."""
    tolerance = _tolerance_nm(least_nm, most_nm, limits)
    clear = min(abs(least_nm), abs(most_nm)) > 2.0 * tolerance and least_nm * most_nm > 0.0
    return clear and _within(reported_nm, least_nm, most_nm, limits)


def _alone_astray(k: int, reports: list[tuple[float, float, float]], limits: ActuatorLimits) -> bool:
    """Whether a motor reports far more than commanded, beside three that report what was, one of them no less."""
    most = [max(abs(least_nm), abs(most_nm)) for _, least_nm, most_nm in reports]
    others = [i for i in range(len(reports)) if i != k]
    return (
        abs(reports[k][0]) > most[k] + 2.0 * _tolerance_nm(*reports[k][1:], limits)
        and all(_within(*reports[i], limits) for i in others)
        and any(most[i] >= most[k] for i in others)
    )


def _judged(
    motor: Evidence, reported_nm: float, least_nm: float, most_nm: float, dt_s: float, limits: ActuatorLimits
) -> Evidence:
    if math.isnan(reported_nm):
        return motor
    if motor.verdict not in (MotorVerdict.GOOD, MotorVerdict.WEAK):
        off = max(abs(least_nm), abs(most_nm)) <= limits.tolerance_nm
        return _switched_off(motor, reported_nm, dt_s, limits) if off else motor
    if _within(reported_nm, least_nm, most_nm, limits):
        clear = max(abs(least_nm), abs(most_nm)) > 2.0 * _tolerance_nm(least_nm, most_nm, limits)
        return _inside(motor, clear, dt_s, limits)
    nearest = min(max(reported_nm, least_nm), most_nm)
    motor = motor._replace(
        outside_s=motor.outside_s + dt_s,
        inside_s=0.0,
        product=motor.product + nearest * reported_nm,
        square=motor.square + nearest * nearest,
        least_nm=min(motor.least_nm, reported_nm),
        most_nm=max(motor.most_nm, reported_nm),
        commanded_least_nm=min(motor.commanded_least_nm, nearest),
        commanded_most_nm=max(motor.commanded_most_nm, nearest),
    )
    if motor.outside_s < limits.confirm_s - 0.5 * dt_s:
        return motor
    verdict, gain = _verdict(motor, limits)
    return Evidence(verdict=verdict, gain=gain)


def _switched_off(motor: Evidence, reported_nm: float, dt_s: float, limits: ActuatorLimits) -> Evidence:
    """A motor that is switched off and has a torque all the same is stuck, with that torque."""
    if abs(reported_nm) <= limits.tolerance_nm:
        return motor._replace(outside_s=0.0, stuck_nm=0.0)
    outside_s = motor.outside_s + dt_s
    if outside_s < limits.confirm_s - 0.5 * dt_s:
        return motor._replace(outside_s=outside_s)
    return motor._replace(verdict=MotorVerdict.STUCK, outside_s=outside_s, stuck_nm=reported_nm)


def _inside(motor: Evidence, clear: bool, dt_s: float, limits: ActuatorLimits) -> Evidence:
    """Evidence fades at the pace at which it came: a fault that flickers is found, too, if it is there more often."""
    if motor.spotless:
        return motor
    inside_s = motor.inside_s + dt_s if clear else motor.inside_s
    outside_s = max(motor.outside_s - dt_s, 0.0)
    if outside_s == 0.0:
        motor = Evidence(verdict=motor.verdict, gain=motor.gain)
    if motor.verdict is MotorVerdict.WEAK and inside_s >= limits.recover_s:
        return Evidence()
    return motor._replace(outside_s=outside_s, inside_s=inside_s)


def _verdict(motor: Evidence, limits: ActuatorLimits) -> tuple[MotorVerdict, float]:
    """What a motor whose reports were outside long enough is, and the part of its torque to count on."""
    ratio = motor.product / motor.square if motor.square > 0.0 else math.inf
    still = motor.most_nm - motor.least_nm <= limits.tolerance_nm
    moved = motor.commanded_most_nm - motor.commanded_least_nm > 2.0 * limits.tolerance_nm
    silent = max(abs(motor.most_nm), abs(motor.least_nm)) <= limits.tolerance_nm
    if silent or abs(ratio) < DEAD_RATIO:
        return MotorVerdict.DEAD, 0.0
    if (still and moved) or ratio > 1.0:
        return MotorVerdict.STUCK, 0.0
    if ratio < 0.0:
        return MotorVerdict.REVERSED, 0.0
    return MotorVerdict.WEAK, min(ratio, 1.0)
