# SPDX-License-Identifier: Apache-2.0
"""Judging inputs: is this value finite, in range, not faster than physics, recent, and from a wheel that turns?

Pure functions over numbers, `violation = check(value, last, limits)`, without ROS: the nodes, the replay and the tests
judge alike. Nothing here raises on bad data; a bad value is named and the caller drops it.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Sequence
from typing import NamedTuple

from iwm_power_manager.control.types import Wheels

_NS_PER_S = 1e9


class Violation(enum.IntEnum):
    """Why an input was not accepted."""

    NONE = 0
    NOT_FINITE = 1
    OUT_OF_RANGE = 2
    TOO_FAST = 3
    STAMP_IN_FUTURE = 4
    STAMP_TOO_OLD = 5
    STAMP_NOT_NEWER = 6
    LENGTH = 7
    NAME_MISSING = 8
    NAME_TWICE = 9
    AXLE_LOST = 10
    LATE = 11


class ValueLimits(NamedTuple):
    """What a number may be and how fast it may change.

    Attributes
    ----------
    minimum, maximum : inclusive range
    rise_per_s, fall_per_s : fastest change either way that is believed, > 0 (infinite: any)
    tolerance : change that is always believed, for noise, >= 0
    """

    minimum: float
    maximum: float
    rise_per_s: float
    fall_per_s: float
    tolerance: float


class StampLimits(NamedTuple):
    """How far a stamp may lie from the receiver's clock.

    Attributes
    ----------
    oldest_s : oldest measurement that is accepted
    future_s : how far ahead a stamp may be (clocks of two computers are never quite equal)
    """

    oldest_s: float
    future_s: float


def check_value(value: float, last: float, elapsed_s: float, limits: ValueLimits) -> Violation:
    """Judge one number against its range and against the last accepted one.

    Parameters
    ----------
    value : the new number
    last : the last accepted number (NaN: there is none)
    elapsed_s : time between the two; the longer ago, the larger a change is believed
    limits : range and rates
    """
    if not math.isfinite(value):
        return Violation.NOT_FINITE
    if not limits.minimum <= value <= limits.maximum:
        return Violation.OUT_OF_RANGE
    if math.isnan(last):
        return Violation.NONE
    if value - last > limits.rise_per_s * elapsed_s + limits.tolerance:
        return Violation.TOO_FAST
    if last - value > limits.fall_per_s * elapsed_s + limits.tolerance:
        return Violation.TOO_FAST
    return Violation.NONE


class Rival(NamedTuple):
    """Messages that were refused but agree among themselves, as those of a second publisher of the topic do.

    Attributes
    ----------
    value : last one
    since_ns, last_ns : stamps of the first and the last
    """

    value: float
    since_ns: int
    last_ns: int

    @property
    def lasted_s(self) -> float:
        """For how long they have agreed."""
        return (self.last_ns - self.since_ns) / _NS_PER_S


def follow_rival(rival: Rival | None, value: float, stamp_ns: int, limits: ValueLimits, gap_s: float) -> Rival:
    """The rival with one more message that was refused; a new one if that does not follow from those before.

    Parameters
    ----------
    rival : so far; None: there is none
    value : possible by itself
    stamp_ns : of the message
    limits : range and rates
    gap_s : longest time between two messages of a rival
    """
    if rival is not None:
        elapsed_s = (stamp_ns - rival.last_ns) / _NS_PER_S
        if 0.0 < elapsed_s <= gap_s and check_value(value, rival.value, elapsed_s, limits) is Violation.NONE:
            return Rival(value, rival.since_ns, stamp_ns)
    return Rival(value, stamp_ns, stamp_ns)


def check_stamp(stamp_ns: int, last_ns: int | None, now_ns: int, limits: StampLimits) -> Violation:
    """Judge the stamp of a message against the clock and against the last accepted stamp of its topic."""
    ahead_s = (stamp_ns - now_ns) / _NS_PER_S
    if ahead_s > limits.future_s:
        return Violation.STAMP_IN_FUTURE
    if -ahead_s > limits.oldest_s:
        return Violation.STAMP_TOO_OLD
    if last_ns is not None and stamp_ns <= last_ns:
        return Violation.STAMP_NOT_NEWER
    return Violation.NONE


def check_names(names: Sequence[str], value_count: int, wanted: Sequence[str]) -> Violation:
    """Judge the shape of a JointState: as many values as names, none of the wanted names twice, all there.

    `NAME_MISSING` is the mildest of the three: the other wheels of such a message can still be used.
    """
    if len(names) != value_count:
        return Violation.LENGTH
    counts = [names.count(name) for name in wanted]
    if max(counts) > 1:
        return Violation.NAME_TWICE
    if min(counts) == 0:
        return Violation.NAME_MISSING
    return Violation.NONE


class WheelVerdict(enum.IntEnum):
    """What is wrong with one wheel speed."""

    GOOD = 0
    ABSENT = 1  # not in the message, or not finite
    OUT_OF_RANGE = 2
    JUMPED = 3
    OPPOSITE = 4  # turns backwards while the car drives forwards
    STUCK = 5  # the same number while the car and the other wheel of the axle change speed
    STRAYED = 6  # for long far from the other wheel of the axle and from the car
    DISTRUSTED = 7  # good again, but not yet for long enough


class WheelLimits(NamedTuple):
    """What a wheel speed may do.

    Attributes
    ----------
    value : range and rates, rad/s and rad/s2
    opposite_radps : backward speed that is believed while the car drives forwards
    moving_mps : the car counts as driving above this speed
    stuck_s, stuck_change_radps : a speed is stuck when it stays the same bit for bit for this long while the car and
        the other wheel of the axle changed by more than this. Longer than the gate needs to free a wheel that really
        is locked: a locked wheel turns again when its torque is gone, a broken sensor does not
    stray_s, stray_radps : a speed has strayed when it differs from the other wheel of the axle by more than this for
        this long, and it is the one farther from the speed of the car
    distrust_s : time a wheel must be good before it is used again
    """

    value: ValueLimits
    opposite_radps: float
    moving_mps: float
    stuck_s: float
    stuck_change_radps: float
    stray_s: float
    stray_radps: float
    distrust_s: float


class WheelMemory(NamedTuple):
    """What is remembered of one wheel.

    Attributes
    ----------
    speed_radps : last accepted speed (NaN: none yet)
    elapsed_s : time since it was accepted
    unchanged_s : how long the received number has been the same
    received_radps : last finite number received
    other_radps, car_radps : speed of the other wheel and of the car when the number last changed
    stray_s : how long it has been far from the other wheel and the car
    distrust_s : time still to be good
    """

    speed_radps: float = math.nan
    elapsed_s: float = 0.0
    unchanged_s: float = 0.0
    received_radps: float = math.nan
    other_radps: float = math.nan
    car_radps: float = math.nan
    stray_s: float = 0.0
    distrust_s: float = 0.0


class WheelsReading(NamedTuple):
    """Four wheel speeds after judgement.

    Attributes
    ----------
    speed_radps : speeds to use; a lost wheel has the speed of the other wheel of its axle (NaN: axle lost)
    verdicts : what was wrong with each
    memory : to be handed to the next call
    """

    speed_radps: Wheels
    verdicts: tuple[WheelVerdict, WheelVerdict, WheelVerdict, WheelVerdict]
    memory: tuple[WheelMemory, WheelMemory, WheelMemory, WheelMemory]


NEW_WHEELS = (WheelMemory(), WheelMemory(), WheelMemory(), WheelMemory())

_OTHER = (1, 0, 3, 2)  # the other wheel of the axle


def judge_wheels(
    received_radps: Sequence[float],
    car_radps: float,
    dt_s: float,
    memory: tuple[WheelMemory, WheelMemory, WheelMemory, WheelMemory],
    limits: WheelLimits,
    radius_m: float,
) -> WheelsReading:
    """Judge four wheel speeds and replace a lost one by the other wheel of its axle.

    Parameters
    ----------
    received_radps : four speeds, NaN for a wheel that is absent
    car_radps : speed of the car over the rolling radius
    dt_s : time since the previous call
    memory : of the previous call; `NEW_WHEELS` at first
    limits : what is believed
    radius_m : rolling radius
    """
    judged = [
        _judge_wheel(
            received_radps[i],
            received_radps[_OTHER[i]],
            car_radps,
            dt_s,
            memory[i],
            limits,
            limits.moving_mps / radius_m,
        )
        for i in range(4)
    ]
    speeds = []
    for i in range(4):
        if judged[i][0] is WheelVerdict.GOOD:
            speeds.append(received_radps[i])
        elif judged[_OTHER[i]][0] is WheelVerdict.GOOD:
            speeds.append(received_radps[_OTHER[i]])
        else:
            speeds.append(math.nan)
    verdicts, memories = zip(*judged, strict=True)
    return WheelsReading((speeds[0], speeds[1], speeds[2], speeds[3]), verdicts, memories)


def _judge_wheel(
    value: float,
    other: float,
    car: float,
    dt_s: float,
    memory: WheelMemory,
    limits: WheelLimits,
    moving_radps: float,
) -> tuple[WheelVerdict, WheelMemory]:
    changed = value != memory.received_radps
    other_then = other if changed else memory.other_radps
    car_then = car if changed else memory.car_radps
    unchanged_s = 0.0 if changed else memory.unchanged_s + dt_s
    strayed = abs(value - other) > limits.stray_radps and abs(value - car) > abs(other - car)
    stray_s = memory.stray_s + dt_s if strayed else 0.0
    elapsed_s = memory.elapsed_s + dt_s
    speed = memory.speed_radps
    distrust_s = max(memory.distrust_s - dt_s, 0.0)
    stuck = (
        unchanged_s > limits.stuck_s
        and abs(other - other_then) > limits.stuck_change_radps
        and abs(car - car_then) > limits.stuck_change_radps
    )
    opposite = car > moving_radps and value < -limits.opposite_radps
    verdict = _WHEEL_VERDICTS.get(check_value(value, speed, elapsed_s, limits.value))
    if verdict is None:
        if opposite:
            verdict = WheelVerdict.OPPOSITE
        elif stuck:
            verdict = WheelVerdict.STUCK
        elif stray_s > limits.stray_s:
            verdict = WheelVerdict.STRAYED
    if verdict is None:
        speed, elapsed_s = value, 0.0
        verdict = WheelVerdict.DISTRUSTED if distrust_s > 0.0 else WheelVerdict.GOOD
    else:
        distrust_s = limits.distrust_s
    return verdict, WheelMemory(speed, elapsed_s, unchanged_s, value, other_then, car_then, stray_s, distrust_s)


#: What a value that is not accepted says about its wheel.
_WHEEL_VERDICTS = {
    Violation.NOT_FINITE: WheelVerdict.ABSENT,
    Violation.OUT_OF_RANGE: WheelVerdict.OUT_OF_RANGE,
    Violation.TOO_FAST: WheelVerdict.JUMPED,
}
