# SPDX-License-Identifier: Apache-2.0
"""The latest accepted input of each topic, with its age and its counters.

Takes readings, which are messages turned into numbers, judges them with `control.inputs`, keeps what is good and counts
what is not. It knows no ROS object, so that the node, the replay and the tests use the same code.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from iwm_power_manager.control.coarse import Coarse
from iwm_power_manager.control.inputs import (
    NEW_WHEELS,
    Rival,
    StampLimits,
    ValueLimits,
    Violation,
    WheelLimits,
    WheelVerdict,
    check_names,
    check_stamp,
    check_value,
    follow_rival,
    judge_wheels,
)
from iwm_power_manager.control.types import Wheels
from iwm_power_manager.trace_units import apart

SPEED = "vehicle_speed"
WHEELS = "wheel_states"
DEMAND = "power_demand"
BATTERY = "battery_state"
FRICTION = "road_friction"

_NS_PER_S = 1e9
#: An accelerometer or a gyroscope that shows more, m/s2 and rad/s, or is silent for longer, s, says nothing.
_MOST_OF_IMU = {"longitudinal_acceleration": 30.0, "lateral_acceleration": 30.0, "yaw_rate": 10.0}
_IMU_OLDEST_S = 0.1
#: Refused for what was accepted before, not for what they are.
_REFUSED_BY_ANOTHER = (Violation.TOO_FAST, Violation.STAMP_NOT_NEWER)
#: Refused for its values.
_OF_VALUES = {Violation.OUT_OF_RANGE, Violation.NOT_FINITE, Violation.AXLE_LOST, Violation.LENGTH}
#: Refused for its time.
_OF_STAMPS = (Violation.STAMP_TOO_OLD, Violation.STAMP_IN_FUTURE, Violation.LATE)
#: No message is that long on its way; a stamp of 0 is that old.
_OTHER_CLOCK_S, _UNSTAMPED_S = 1.0, 1e9
#: Speeds that agree differ by no more than this, and this part of the largest.
_SAME_MPS, _SAME = 0.5, 0.1
#: At less, the ratio of two speeds says nothing.
_MOVING_MPS = 2.0
#: The battery comes a tenth as often as the other inputs.
_SLOW = 10.0


class SpeedReading(NamedTuple):
    """`vehicle_speed` as numbers."""

    stamp_ns: int
    speed_mps: float


class JointReading(NamedTuple):
    """A JointState as numbers: one of its value fields, with the names it came with."""

    stamp_ns: int
    names: tuple[str, ...]
    values: tuple[float, ...]


class BatteryReading(NamedTuple):
    """`battery_state` as numbers. `soc` and `temperature_c` are single precision, as the message carries them.

    Attributes
    ----------
    stamp_ns : time of the measurement
    soc : state of charge, 0..1 (NaN: not measured)
    temperature_c : pack temperature (NaN: not measured)
    voltage_v : terminal voltage
    discharge_current_a : positive when discharging
    """

    stamp_ns: int
    soc: float
    temperature_c: float
    voltage_v: float
    discharge_current_a: float


def select_by_name(reading: JointReading, wanted: Sequence[str]) -> tuple[float, ...]:
    """Values of a JointState in the order of `wanted`; NaN where a name is absent, doubled, or has no value."""
    if len(reading.names) != len(reading.values):
        return (math.nan,) * len(wanted)
    if reading.names == tuple(wanted):
        return reading.values
    found = dict(zip(reading.names, reading.values, strict=True))
    return tuple(found[name] if reading.names.count(name) == 1 else math.nan for name in wanted)


class InputLimits(NamedTuple):
    """Everything an input is judged by.

    Attributes
    ----------
    stamp : of `vehicle_speed`, `wheel_states` and `battery_state`; None does not judge stamps (lock-step)
    demand_delay_s : longest time between sending and receiving a power demand, which carries no stamp
    speed, demand, soc, temperature, friction : range and rates
    wheels : see `WheelLimits`
    rival_s : time after which messages that agree among themselves are believed against those that were accepted
    radius_m : rolling radius
    """

    stamp: StampLimits | None
    demand_delay_s: float
    speed: ValueLimits
    demand: ValueLimits
    soc: ValueLimits
    temperature: ValueLimits
    friction: ValueLimits
    wheels: WheelLimits
    rival_s: float
    radius_m: float


@dataclass
class Tally:
    """What became of the messages of one topic.

    Attributes
    ----------
    received : all messages
    dropped : by reason
    in_a_row : of these, those since the last accepted one
    accepted_ns : time of the last accepted one: its stamp, or when it was received if it has none (None: none yet)
    violation : why the last message was dropped, or was accepted with a reservation
    describe : says more of a message whose values were refused; None: the value, and what is allowed
    stamp : limits of stamps; None where they are not judged
    stamp_off_s : how far the last stamp that was judged lay from the clock, or how long ago a demand was sent
    refused : the last value that was refused, and what it may be
    """

    received: int = 0
    dropped: Counter[Violation] = field(default_factory=Counter)
    in_a_row: Counter[Violation] = field(default_factory=Counter)
    accepted_ns: int | None = None
    violation: Violation = Violation.NONE
    describe: Callable[[], str] | None = None
    stamp: StampLimits | None = None
    stamp_off_s: float = 0.0
    refused: tuple[float, ValueLimits] | None = None

    def why(self) -> str:
        """What was wrong with the last message, in words; "" if nothing was."""
        if self.violation is Violation.NONE:
            return ""
        more = self.described()
        if self.violation in _OF_STAMPS and self.stamp_off_s:
            more = f"by {self.stamp_off_s:.3g} s"
            if self.stamp_off_s > _UNSTAMPED_S:
                more += ", no stamp? then stamp: source; simulated time? then use_sim_time for both"
            elif self.stamp_off_s > _OTHER_CLOCK_S:
                more += ", another clock? then stamp: source"
            elif self.stamp and self.violation is Violation.STAMP_IN_FUTURE:
                more += f"; allowed: stamp_future_s {self.stamp.future_s:g}"
            elif self.stamp:
                more += f"; allowed: stamp_oldest_s {self.stamp.oldest_s:g}"
        elif self.violation is Violation.TOO_FAST and self.refused:
            value, limits = self.refused
            more = f"{value:g}; allowed: a change of {min(limits.rise_per_s, limits.fall_per_s):g} a second"
        return self.violation.name.lower().replace("_", " ") + (f": {more}" if more else "")

    def described(self) -> str:
        """What there is to say of the last message, where its values were refused."""
        if self.violation not in _OF_VALUES:
            return ""
        if self.describe or not self.refused:
            return self.describe() if self.describe else ""
        value, limits = self.refused
        return f"{value:g}; allowed: {limits.minimum:g} to {limits.maximum:g}"

    def check_value(self, value: float, last: float, elapsed_s: float, limits: ValueLimits) -> Violation:
        """Judge a number as `inputs.check_value` does, and remember one that is refused."""
        violation = check_value(value, last, elapsed_s, limits)
        if violation is not Violation.NONE:
            self.refused = value, limits
        return violation

    def age_s(self, now_ns: int) -> float:
        """Time since the last accepted message; infinite before the first."""
        return math.inf if self.accepted_ns is None else max(now_ns - self.accepted_ns, 0) / _NS_PER_S

    def note(self, violation: Violation, time_ns: int) -> bool:
        """Count a message; True if it may be used."""
        self.received += 1
        self.violation = violation
        if violation is Violation.NONE:
            self.accepted_ns = time_ns
            self.in_a_row.clear()
            return True
        self.dropped[violation] += 1
        self.in_a_row[violation] += 1
        return False


class InputMonitor:
    """Latest good inputs.

    Attributes
    ----------
    speed_mps, wheel_speed_radps, demand_w, soc, temperature_c, friction : last accepted values
    speed_interval_s : between the last two accepted speeds; 0 before
    demand_speed_mps : speed of the car when the last demand was accepted
    direction : the driver asks for, 1 forwards, -1 reverse
    coarse : smooths wheel speeds that come in coarse steps
    wheels_behind_s : how much older than its stamp that makes them
    verdicts : what was wrong with each wheel in the last `wheel_states`
    wheels_refused : how often a wheel was not believed, by its name and why
    motor_torque_nm : torques the motors reported since `collect_torques` was called last, NaN for each that did not
    tallies : counters by topic
    """

    def __init__(self, wheel_names: tuple[str, ...], limits: InputLimits) -> None:
        self._wheel_names = wheel_names
        self._limits = limits
        self.tallies = {topic: Tally(stamp=limits.stamp) for topic in (SPEED, WHEELS, DEMAND, BATTERY, FRICTION)}
        self.tallies[WHEELS].describe = self._why_no_wheels
        self._last_wheels = JointReading(0, (), ())
        self.wheels_refused: Counter[tuple[str, WheelVerdict]] = Counter()
        self.forget()

    def forget(self) -> None:
        """Start again without history, as at activation; counters stay."""
        self.speed_mps = 0.0
        self.speed_interval_s = 0.0
        self.wheel_speed_radps: Wheels = (0.0, 0.0, 0.0, 0.0)
        self.demand_w = 0.0
        self.direction = 1.0
        self.demand_speed_mps = 0.0
        self.soc = 0.5
        self.temperature_c = math.nan
        self.friction = math.nan
        self.verdicts = (WheelVerdict.GOOD,) * 4
        self.motor_torque_nm: Wheels | None = None
        self._motion: dict[str, tuple[float, int]] = {}
        self._wheel_memory = NEW_WHEELS
        self.coarse = Coarse()
        self.wheels_behind_s = 0.0
        self.forget_times()

    def forget_times(self) -> None:
        """Keep the values, but not how old they are: after the clock was set back. All inputs count as missing."""
        self._wheels_ns: int | None = None
        self._rivals: dict[str, Rival] = {}
        for tally in self.tallies.values():
            tally.accepted_ns = None

    def ages_s(self, now_ns: int) -> tuple[float, float, float, float]:
        """Ages of speed, wheels, demand and battery."""
        tallies = self.tallies
        return (
            tallies[SPEED].age_s(now_ns),
            tallies[WHEELS].age_s(now_ns),
            tallies[DEMAND].age_s(now_ns),
            tallies[BATTERY].age_s(now_ns),
        )

    @property
    def driven(self) -> bool:
        """A speed and a demand have been accepted: the least a step needs beside wheel speeds."""
        return self.tallies[SPEED].accepted_ns is not None and self.tallies[DEMAND].accepted_ns is not None

    @property
    def shown_mps(self) -> list[float]:
        """What `vehicle_speed` and the wheels show."""
        return [self.speed_mps, *(speed * self._limits.radius_m for speed in self.wheel_speed_radps)]

    @property
    def agree(self) -> bool:
        """`vehicle_speed` and all wheels show the same motion."""
        shown = self.shown_mps
        return max(shown) - min(shown) <= _SAME_MPS + _SAME * max(map(abs, shown))

    @property
    def apart(self) -> str:
        """By what factor `vehicle_speed` and the wheels contradict each other, and the unit probably meant; or ""."""
        speed, *rims = map(abs, self.shown_mps)
        moving = max(speed, *rims) > _MOVING_MPS
        return apart(speed, sum(rims) / len(rims), self._limits.radius_m, 1.0 + _SAME) if moving else ""

    def take_speed(self, reading: SpeedReading, now_ns: int) -> bool:
        """Judge `vehicle_speed`; True if it was accepted."""
        tally = self.tallies[SPEED]
        violation = self._check_stamp(tally, reading.stamp_ns, now_ns)
        if violation is Violation.NONE:
            last = math.nan if tally.accepted_ns is None else self.speed_mps
            violation = tally.check_value(reading.speed_mps, last, tally.age_s(reading.stamp_ns), self._limits.speed)
        if violation in _REFUSED_BY_ANOTHER and self._outlasts(
            SPEED, reading.stamp_ns, reading.speed_mps, self._limits.speed, self._limits.rival_s
        ):
            told = self._shown_by_wheels(reading.stamp_ns)
            farther = abs(reading.speed_mps - told) >= abs(self.speed_mps - told)  # never so where nobody tells
            violation = violation if farther else self._believe_rival(SPEED)
        interval_s = tally.age_s(reading.stamp_ns)
        if tally.note(violation, reading.stamp_ns):
            self.speed_mps = reading.speed_mps
            self.speed_interval_s = 0.0 if math.isinf(interval_s) else interval_s
            return True
        return False

    def take_wheels(self, reading: JointReading, now_ns: int) -> bool:
        """Judge `wheel_states`; True if it was accepted.

        A message that lacks a wheel is counted and reported, and still used for the others.
        """
        tally = self.tallies[WHEELS]
        self._last_wheels = reading
        violation = self._check_stamp(tally, reading.stamp_ns, now_ns)
        if violation is Violation.NONE:
            violation = check_names(reading.names, len(reading.values), self._wheel_names)
        if violation not in (Violation.NONE, Violation.NAME_MISSING):
            return tally.note(violation, reading.stamp_ns)
        elapsed_s = 0.0 if self._wheels_ns is None else max(reading.stamp_ns - self._wheels_ns, 0) / _NS_PER_S
        self._wheels_ns = reading.stamp_ns
        shown = select_by_name(reading, self._wheel_names)
        if self._limits.stamp:
            a, b, c, d = shown
            shown = self.coarse.smoothed((a, b, c, d))
            weights = self.coarse.weights
            self.wheels_behind_s = 0.5 * len(weights) * elapsed_s if len(weights) > 1 else 0.0
        judged = judge_wheels(
            shown,
            self.speed_mps / self._limits.radius_m,
            elapsed_s,
            self._wheel_memory,
            self._limits.wheels,
            self._limits.radius_m,
        )
        self._wheel_memory = judged.memory
        self.verdicts = judged.verdicts
        if any(judged.verdicts):
            self.wheels_refused.update(
                (name, verdict) for name, verdict in zip(self._wheel_names, judged.verdicts, strict=True) if verdict
            )
        if any(math.isnan(speed) for speed in judged.speed_radps):
            return tally.note(Violation.AXLE_LOST, reading.stamp_ns)
        self.wheel_speed_radps = judged.speed_radps
        tally.note(Violation.NONE, reading.stamp_ns)
        if violation is Violation.NAME_MISSING:
            tally.violation = violation
            tally.dropped[violation] += 1
        return True

    def take_torques(self, reading: JointReading, now_ns: int) -> None:
        """Keep what the motors report: `control.actuators` holds it against the commands of the last moments.

        A report of another time would make every motor a stuck one.
        """
        if self._limits.stamp and check_stamp(reading.stamp_ns, None, now_ns, self._limits.stamp):
            return
        a, b, c, d = select_by_name(reading, self._wheel_names)
        self.motor_torque_nm = (a, b, c, d)

    def collect_torques(self) -> Wheels | None:
        """The latest report of the motors' torques, once; None if none has come since."""
        reported, self.motor_torque_nm = self.motor_torque_nm, None
        return reported

    def take_motion(self, signal: str, value: float, now_ns: int) -> None:
        """Keep what an IMU shows: a signal that the law uses, within what a car does; to the left is positive."""
        if abs(value) <= _MOST_OF_IMU.get(signal, -1.0):
            self._motion[signal] = (value, now_ns)

    def motion(self, signal: str, now_ns: int) -> float:
        """What an IMU shows; NaN where there is none, or it has been silent for long."""
        value, heard_ns = self._motion.get(signal, (math.nan, now_ns))
        return value if now_ns - heard_ns <= _IMU_OLDEST_S * _NS_PER_S else math.nan

    def take_demand(self, demand_w: float, delay_s: float, now_ns: int, lag_s: float = 0.0) -> bool:
        """Judge `power_demand`, received `delay_s` after it was sent; True if it was accepted.

        Its age begins `lag_s` earlier: it was put together from a part that is so much older.
        """
        tally = self.tallies[DEMAND]
        tally.stamp_off_s = delay_s
        violation = Violation.LATE if delay_s > self._limits.demand_delay_s else Violation.NONE
        if violation is Violation.NONE:
            last = math.nan if tally.accepted_ns is None else self.demand_w
            violation = check_value(demand_w, last, tally.age_s(now_ns), self._limits.demand)
            violation = Violation.OUT_OF_RANGE if math.isinf(demand_w) else violation  # of a pedal beyond its way
        if tally.note(violation, now_ns - int(lag_s * _NS_PER_S)):
            self.demand_w = demand_w
            self.demand_speed_mps = self.speed_mps
            return True
        return False

    def take_battery(self, reading: BatteryReading, now_ns: int) -> bool:
        """Judge `battery_state`; True if it was accepted. A temperature that is not measured (NaN) is allowed."""
        tally = self.tallies[BATTERY]
        violation = self._check_stamp(tally, reading.stamp_ns, now_ns)
        first = tally.accepted_ns is None
        elapsed_s = tally.age_s(reading.stamp_ns)
        if violation is Violation.NONE:
            violation = tally.check_value(reading.soc, math.nan if first else self.soc, elapsed_s, self._limits.soc)
        if violation is Violation.NONE and not math.isnan(reading.temperature_c):
            violation = tally.check_value(
                reading.temperature_c, self.temperature_c, elapsed_s, self._limits.temperature
            )
        if violation in _REFUSED_BY_ANOTHER and self._outlasts(
            BATTERY, reading.stamp_ns, reading.soc, self._limits.soc, _SLOW * self._limits.rival_s
        ):
            violation = self._believe_rival(BATTERY)
        if tally.note(violation, reading.stamp_ns):
            self.soc = reading.soc
            self.temperature_c = reading.temperature_c
            return True
        return False

    def take_friction(self, friction: float, now_ns: int) -> bool:
        """Judge `road_friction`; True if it was accepted."""
        tally = self.tallies[FRICTION]
        if tally.note(tally.check_value(friction, math.nan, 0.0, self._limits.friction), now_ns):
            self.friction = friction
            return True
        return False

    def _why_no_wheels(self) -> str:
        _, names, values = self._last_wheels
        if len(names) != len(values):
            some = "; four sources, with an index each, take some of them"
            return f"{len(values)} values for {len(names)} wheels" + some * (len(values) > len(names))
        lost = [(n, v) for n, v in zip(self._wheel_names, self.verdicts, strict=True) if v is not WheelVerdict.GOOD]
        words = ", ".join(f"{name} {verdict.name.lower().replace('_', ' ')}" for name, verdict in lost)
        absent = set(self._wheel_names).difference(names)
        return words + (f"; the message names {', '.join(map(repr, names[:8])) or 'nothing'}" if absent else "")

    def _outlasts(self, topic: str, stamp_ns: int, value: float, limits: ValueLimits, rival_s: float) -> bool:
        """Whether a refused message is of a second source that has agreed with itself for long, beside a live first.

        What was accepted last must not be believed for ever: whoever drew it away would have the topic for himself.
        """
        if check_value(value, math.nan, 0.0, limits) is not Violation.NONE:
            return False
        rival = self._rivals[topic] = follow_rival(self._rivals.get(topic), value, stamp_ns, limits, rival_s)
        accepted_ns = self.tallies[topic].accepted_ns
        alive = accepted_ns is not None and abs(stamp_ns - accepted_ns) <= rival_s * _NS_PER_S
        return alive and rival.lasted_s >= rival_s

    def _believe_rival(self, topic: str) -> Violation:
        """From now on the others are the rival."""
        del self._rivals[topic]
        return Violation.NONE

    def _shown_by_wheels(self, stamp_ns: int) -> float:
        """Speed of the car by its two middle wheels; NaN if they have not come of late."""
        if self.tallies[WHEELS].age_s(stamp_ns) > self._limits.rival_s:
            return math.nan
        slow, fast = sorted(self.wheel_speed_radps)[1:3]
        return 0.5 * (slow + fast) * self._limits.radius_m

    def _check_stamp(self, tally: Tally, stamp_ns: int, now_ns: int) -> Violation:
        if self._limits.stamp is None:
            return Violation.NONE
        tally.stamp_off_s = abs(stamp_ns - now_ns) / _NS_PER_S
        return check_stamp(stamp_ns, tally.accepted_ns, now_ns, self._limits.stamp)
