# SPDX-License-Identifier: Apache-2.0
"""Units of a speed trace, told by its accelerations: what no car does is probably another unit."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

#: In m/s and in s.
SPEED_UNITS = {"m/s": 1.0, "km/h": 1.0 / 3.6, "mph": 0.44704, "kn": 1852.0 / 3600.0, "cm/s": 0.01, "ft/s": 0.3048}
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "d": 86400.0}

#: Beyond these, m/s2 as the mean of a second, a trace is no car's: a tyre on a dry road gives 1 g and a little more.
MAX_ACCELERATION_MPS2 = 9.0
MAX_DECELERATION_MPS2 = 13.0
#: A car that goes through a range of speeds does so faster than this at least once.
MIN_ACCELERATION_MPS2 = 0.02
#: A single sample further from its neighbour than braking and this is wrong: noise and a sensor's steps are less.
_JUMP_MPS = 5.0
_MIN_SAMPLES, _MIN_SPEED_RANGE_MPS = 10, 3.0
_WINDOW_S, _SHORTEST_S = 1.0, 1e-3
#: A drive is livelier than driving on roads is where the 95th percentile of speed times acceleration, over the seconds
#: with more than 0.1 m/s2, exceeds these W/kg by mean speed: Regulation (EU) 2017/1151, annex IIIA, appendix 7a, 4.1.1,
#: 0.136 v + 14.44 to 74.6 km/h and 0.0742 v + 18.966 above (there for the urban, rural and motorway part each; such a
#: drive is no valid test of emissions). Cycles and drives are at 0.3 to 1.0 of it, in km/h at 2.6 and more.
_LIVELY_MPS2, _LIVELY_FROM_KMH = 0.1, 74.6
_LIVELY_BELOW, _LIVELY_ABOVE = (14.44, 0.136), (18.966, 0.0742)
_TOO_LIVELY, _LIVELIEST = 1.7, 1.2
#: What driving looks like, m/s2: the harder of acceleration and braking is more than this, and neither beyond its own.
_USUAL_LOW, _USUAL_RISE, _USUAL_FALL = 0.3, 5.0, 9.0
_MAX_SPEED_MPS = 70.0
#: Speed and wheels that are further apart are not in the units they were read in.
_APART = 1.25
#: How many times too fast the speed seems, by what was read in a wrong unit, and how near to that counts.
_LIKELY = {
    3.6: "speed in km/h",
    2.237: "speed in mph",
    1.0 / 3.6: "speed in m/s, read as km/h",
    math.pi / 30.0: "wheel_speed in rpm",
    math.pi / 180.0: "wheel_speed in deg/s",
}
_NEAR = 0.05
#: A demand explains the car's motion where so many seconds correlate so much; so many times more energy than was asked
#: for is no other car's mass and no slope.
_LEAST_SECONDS, _EXPLAINS, _TIMES_DEMAND = 10, 0.7, 5.0
#: A demand that differs from its mean by no more than this part is one that does not change, and this little is none.
_STEADY, _LITTLE_J = 0.02, 1000.0
#: So many times more it is where kilowatts were taken for watts, whatever the road load and the mass that was meant.
_KILO = (300.0, 3000.0)


class Steepest(NamedTuple):
    """Hardest change of speed over a second (or a sample, if that is longer), with where it begins.

    Attributes
    ----------
    rise_mps2, fall_mps2 : both >= 0
    rise_at, fall_at : index of the sample
    """

    rise_mps2: float
    fall_mps2: float
    rise_at: int
    fall_at: int


#: A trace of more windows is no drive, whatever its unit.
_MOST_WINDOWS = 1e7


def steepest(time_s: FloatArray, speed_mps: FloatArray) -> Steepest:
    """The hardest acceleration and braking of a trace of two points or more, times rising."""
    span = time_s[-1] - time_s[0]
    window = max(min(_WINDOW_S, span), _SHORTEST_S)
    # A window from every sample; what lies behind the end counts up to the end.
    start = np.minimum(time_s, time_s[-1] - min(window, span))
    change = np.interp(start + window, time_s, speed_mps) - np.interp(start, time_s, speed_mps)
    rate = change / window
    up, down = int(np.argmax(rate)), int(np.argmin(rate))
    return Steepest(max(float(rate[up]), 0.0), max(-float(rate[down]), 0.0), up, down)


def liveliness(time_s: FloatArray, speed_mps: FloatArray) -> float:
    """How lively a trace is, by the bound of the regulation on real driving emissions; 0 for one that never gains."""
    span = time_s[-1] - time_s[0]
    window = max(min(_WINDOW_S, span), _SHORTEST_S)
    if span > _MOST_WINDOWS * window:
        return 0.0
    start = np.arange(time_s[0], time_s[-1] - window, window)
    before, after = (np.interp(start + shift, time_s, speed_mps) for shift in (0.0, window))
    rate, speed = (after - before) / window, 0.5 * (before + after)
    gains = rate > _LIVELY_MPS2
    if not np.any(gains):
        return 0.0
    mean_kmh = 3.6 * float(np.mean(speed[speed > 0.0]))
    base, slope = _LIVELY_BELOW if mean_kmh <= _LIVELY_FROM_KMH else _LIVELY_ABOVE
    return float(np.percentile((speed * rate)[gains], 95)) / (base + slope * mean_kmh)


def too_lively(time_s: FloatArray, speed_mps: FloatArray) -> str:
    """A line, where a trace is too lively for a road and would not be in km/h; "" else."""
    found = liveliness(time_s, speed_mps)
    if found <= _TOO_LIVELY or liveliness(time_s, speed_mps / 3.6) > _LIVELIEST:
        return ""
    return (
        f"its accelerations at its speeds are {found:.1f} times what driving on roads has (EU 2017/1151, IIIA 7a): "
        "is it in km/h?"
    )


def likely_units(
    time: FloatArray,
    speed: FloatArray,
    time_units: Mapping[str, float] = TIME_UNITS,
    speed_units: Mapping[str, float] = SPEED_UNITS,
) -> tuple[str, str] | None:
    """Units of speed and time, of these, in which a trace looks like driving; None if there are none."""
    for time_unit, seconds in time_units.items():
        if time.size >= _MIN_SAMPLES and (time[-1] - time[0]) * seconds < _WINDOW_S:
            continue  # no drive, and shorter than what its accelerations are told by
        for speed_unit, metres in speed_units.items():
            if float(np.max(speed)) * metres > _MAX_SPEED_MPS:
                continue
            with np.errstate(over="ignore"):
                found = steepest(time * seconds, speed * metres)
            hardest = max(found.rise_mps2, found.fall_mps2)
            if hardest >= _USUAL_LOW and found.rise_mps2 <= _USUAL_RISE and found.fall_mps2 <= _USUAL_FALL:
                return speed_unit, time_unit
    return None


def implausible(time_s: FloatArray, speed_mps: FloatArray) -> tuple[int, str] | None:
    """Why a trace is no car's, with the sample at fault; None if it may be one."""
    found = steepest(time_s, speed_mps)
    jumps = np.flatnonzero(np.abs(np.diff(speed_mps)) > MAX_DECELERATION_MPS2 * np.diff(time_s) + _JUMP_MPS)
    at, problem = -1, ""
    if found.rise_mps2 > MAX_ACCELERATION_MPS2:
        at, problem = found.rise_at, f"gains {found.rise_mps2:.3g} m/s in a second, and no car does"
    elif found.fall_mps2 > MAX_DECELERATION_MPS2:
        at, problem = found.fall_at, f"loses {found.fall_mps2:.3g} m/s in a second, and no car does"
    elif jumps.size:
        at = int(jumps[0])
        problem = (
            f"jumps by {abs(speed_mps[at + 1] - speed_mps[at]):.3g} m/s from one sample to the next, and no car does"
        )
    elif (
        time_s.size >= _MIN_SAMPLES
        and float(np.ptp(speed_mps)) > _MIN_SPEED_RANGE_MPS
        and max(found.rise_mps2, found.fall_mps2) < MIN_ACCELERATION_MPS2
    ):
        problem = f"never changes by more than {max(found.rise_mps2, found.fall_mps2):.2g} m/s in a second"
    if not problem:
        return None
    return at, problem


def apart(shown: float, rolled: float, radius_m: float, least: float = _APART) -> str:
    """A line, if a speed is `least` times that of the wheels' rims, or they of it: which unit was meant; "" else."""
    ratio = shown / rolled if rolled else math.inf
    if 1.0 / least < ratio < least:
        return ""
    likely = {**_LIKELY, 1.0 / radius_m: "wheel_speed in m/s"}
    meant = [text for factor, text in likely.items() if math.isclose(ratio, factor, rel_tol=_NEAR)]
    words = " or ".join(meant) or "another unit, or another wheel radius"
    return f"speed is {ratio:.3g} times what wheel_speed and a radius of {radius_m:g} m give: {words}?"


class Energies:
    """What was asked for, and how the car's kinetic energy changed, second by second."""

    def __init__(self, mass_kg: float) -> None:
        self._half_kg = 0.5 * mass_kg
        self._demanded_j: list[float] = []
        self._gained_j: list[float] = []
        self.cut()

    def cut(self) -> None:
        """Begin a second anew, as after a pause."""
        self._lasts_s = self._asked_j = 0.0
        self._before_mps: float | None = None

    def add(self, speed_mps: float, demand_w: float, dt_s: float) -> None:
        """One step: its demand, its speed and how long it lasts."""
        before = self._before_mps = speed_mps if self._before_mps is None else self._before_mps
        self._lasts_s += dt_s
        self._asked_j += demand_w * dt_s
        if self._lasts_s >= 1.0:
            self._demanded_j.append(self._asked_j)
            self._gained_j.append(self._half_kg * (speed_mps**2 - before**2))
            self.cut()
            self._before_mps = speed_mps

    def apart(self) -> str:
        """A line, if the demand's sign or unit cannot be the one it was read with; "" else."""
        if len(self._demanded_j) < _LEAST_SECONDS:
            return ""
        (demand, both), (_, gain) = np.cov(self._demanded_j, self._gained_j)
        usual, most = float(np.mean(self._demanded_j)), max(self._gained_j)
        if demand <= (_STEADY * usual) ** 2 and most > _TIMES_DEMAND * max(usual, _LITTLE_J):
            return "power_demand does not change, and yet the car speeds up: is it another signal?"
        if not demand or not gain or both**2 < _EXPLAINS**2 * demand * gain:
            return ""
        if both < 0.0:
            return "the car slows down where power_demand drives, and speeds up where it brakes: is its sign wrong?"
        ratio = both / demand
        if ratio < _TIMES_DEMAND:
            return ""
        words = "is it in kW" if _KILO[0] < ratio < _KILO[1] else "another unit, or another car"
        return f"the car gains {ratio:.3g} times the energy that power_demand asks for: {words}?"


def hint(time_s: FloatArray, speed_mps: FloatArray) -> str:
    """What the columns probably hold, as the end of a sentence; "" where no unit would help."""
    units = likely_units(time_s, speed_mps)
    if units is None or units == ("m/s", "s"):
        return ""
    speed_unit, time_unit = units
    likely = [f"{speed_unit} in the m/s column"] if speed_unit != "m/s" else []
    likely += [f"{time_unit} in the s column"] if time_unit != "s" else []
    return f": looks like {' and '.join(likely)} (import_cycle converts)"
