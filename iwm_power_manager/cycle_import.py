# SPDX-License-Identifier: Apache-2.0
"""A drive cycle out of a logged drive: units, gaps, noise. What is guessed or left out is said."""

from __future__ import annotations

import dataclasses
import datetime
import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from iwm_power_manager.cycle import MAX_GRADE, MAX_SAMPLES, Cycle, at_rest, make_cycle
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.tables import Table, is_nothing, read_table
from iwm_power_manager.trace_units import SPEED_UNITS, TIME_UNITS, FloatArray, implausible, likely_units

#: At a cut, the speed goes from one piece's end to the next one's start at this, m/s2.
JOINT_MPS2 = 1.0
_SHORTEST_STEP_S = 1e-4
_DAY_S, _HOUR_S = 86_400.0, 3600.0
_SECONDS = r"(?P<s>[0-5][0-9](?:\.[0-9]{1,9})?)"
#: What `time_unit` calls clocks: hours:minutes[:seconds], and [hours:]minutes:seconds.
_CLOCKS = {
    "clock": rf"(?P<h>[0-9]{{1,3}}):(?P<min>[0-5][0-9])(?::{_SECONDS})?",
    "min:s": rf"(?:(?P<h>[0-9]{{1,3}}):)?(?P<min>[0-9]{{1,3}}):{_SECONDS}",
}
#: A log of which more rows than this lie behind others in time was set back, or holds several drives.
_MOST_BEHIND = 0.1
#: A log that shows more than this below zero drives backwards, or has another sign.
_BACKWARDS_MPS = 0.5
_UNIT_NAMES = {
    "km/h": r"km[\W_]?/?p?h|kph",
    "mph": r"(?<![a-z])mph|mi/h",
    "kn": r"(?<![a-z])(kn|kts?)(?![a-z])|knot",
    "cm/s": r"cm/s|cmps",
    "ft/s": r"ft/s|fps",
    "m/s": r"(?<![a-z])m[/_]?s(?![a-z])|(?<![a-z])mps|(?<![a-z])m\W?s-1",
}
_TIME_NAMES = {
    "ns": r"\bns\b|_ns|nsec|nanos",
    "us": r"\bus\b|_us|µs|usec|micros",
    "ms": r"\bms\b|_ms|msec|milli",
    "min": r"(?<![a-z])min\b|minutes",
    "h": r"(?<![a-z])h\b|hours",
    "d": r"\bdays?\b",
    "s": r"\[s\]|\(s\)|_s\b|sec",
}
#: Speeds that a log has beside the car's.
_NOT_OF_CAR = r"limit|target|desired|(?<![a-z])set|(?<![a-z])max|av(g|erage)|mean|wind|soll"
_SLOPE = r"grade|slope|gradient|incline|steigung|neigung|pente"


@dataclass
class Log:
    """A logged speed, in SI units.

    Attributes
    ----------
    path : of the file
    time_s, speed_mps, grade : of the samples that are usable, times rising from 0
    speed_unit, time_unit : of the file
    begins_s : time of the first sample in the file
    said : what was guessed or left out, one line each
    """

    path: Path | str
    time_s: FloatArray
    speed_mps: FloatArray
    grade: FloatArray
    speed_unit: str
    time_unit: str
    begins_s: float = 0.0
    said: list[str] = field(default_factory=list)

    @property
    def step_s(self) -> float:
        """The usual distance of two samples."""
        return float(np.median(np.diff(self.time_s)))

    def gaps_after(self, longer_s: float) -> list[int]:
        """Index of the last sample before every gap."""
        return np.flatnonzero(np.diff(self.time_s) > longer_s).tolist()

    def gaps(self, longer_s: float) -> list[tuple[float, float]]:
        """Start and length of every gap."""
        at = self.gaps_after(longer_s)
        return [(float(self.time_s[i]), float(self.time_s[i + 1] - self.time_s[i])) for i in at]

    def across_gaps_m(self, longer_s: float) -> float:
        """Length of straight lines over the gaps."""
        at = np.array(self.gaps_after(longer_s), dtype=int)
        return float(np.sum(0.5 * (self.speed_mps[at] + self.speed_mps[at + 1]) * np.diff(self.time_s)[at]))

    def noise_mps(self) -> float:
        """Scatter of the speed about its own trend, rms, from third differences; only where the car moves."""
        third = np.diff(self.speed_mps, 3)
        moving = (self.speed_mps[3:] > 0.5) & (np.diff(self.time_s, 1)[2:] <= 1.5 * self.step_s)
        # The third difference of white noise has twenty times its variance; the median is not moved by manoeuvres.
        return float(np.median(np.abs(third[moving])) / 0.6745 / np.sqrt(20.0)) if np.any(moving) else 0.0


def read_log(
    path: Path | str,
    *,
    time: str = "",
    speed: str = "",
    grade: str = "",
    time_unit: str = "auto",
    speed_unit: str = "auto",
    separator: str = "auto",
    decimal: str = "auto",
) -> Log:
    """Read a log's table.

    Parameters
    ----------
    time, speed, grade : names of the columns; "" finds them by their names, the last only where that is `grade`
    time_unit : a unit of `TIME_UNITS`, "clock" (dates or hours:minutes[:seconds]), "min:s" (minutes:seconds), or auto
    speed_unit : a unit of `SPEED_UNITS`, or auto: by the column's name, else by the accelerations
    separator, decimal : see `tables.read_table`

    Raises
    ------
    ConfigError
        Nothing usable, a column that is not there, a text that is no number, units that cannot be told.
    """
    table = _with_units(read_table(path, separator, decimal))
    line, header = table.rows[0]
    found = {
        "time": _columns(table, header, "time", time, r"time|stamp|\bt(?![a-z0-9])|zeit"),
        "speed": _columns(table, header, "speed", speed, r"speed|veloc|\bv(?![a-z0-9])|geschw|vitesse", _UNIT_NAMES),
    }
    slopes = [cell for cell in header if re.search(_SLOPE, cell, re.IGNORECASE)]
    grade = grade or next((cell for cell in slopes if cell.lower() == "grade"), "")
    if grade:
        found["grade"] = _columns(table, header, "grade", grade, "")
    columns = {name: those[0] for name, those in found.items()}
    said = [f"columns: {', '.join(f'{name} is {header[i]!r}' for name, i in columns.items())}"]
    for name, (_, *others) in found.items():
        if others:
            named = ", ".join(repr(header[i]) for i in others)
            said.append(f"{named} look{'s' * (len(others) == 1)} like {name}, too: --{name} takes another column")
    if slopes and not grade:
        said.append(f"{slopes[0]!r} is left out: --grade takes it, as rise over run")
    if table.decimal == ",":
        said.append("decimal commas")
    values: dict[str, list[float]] = {name: [] for name in columns}
    clock = _clock(table, columns["time"], said) if time_unit == "auto" else time_unit if time_unit in _CLOCKS else ""
    left_out = 0
    for line, cells in table.rows[1:]:
        if any(cells[len(header) :]):
            problem = f"has {len(cells)} values: decimal commas between commas?"
            raise ConfigError(path, f"line {line}", problem, f"{len(header)}, as in the header")
        row = {name: cells[i] if i < len(cells) else "" for name, i in columns.items()}
        if any(map(is_nothing, row.values())):
            left_out += 1
            continue
        for name, text in row.items():
            read = (
                _clock_s(table, line, text, clock)
                if name == "time" and clock
                else table.number(line, text, header[columns[name]])
            )
            values[name].append(read)
    arrays = {name: np.array(found) for name, found in values.items()}
    arrays.setdefault("grade", np.zeros(arrays["time"].size))
    good = np.all([np.isfinite(x) for x in arrays.values()], axis=0)
    left_out += int(np.count_nonzero(~good))
    arrays = {name: x[good] for name, x in arrays.items()}
    if left_out:
        said.append(f"{left_out} rows without a value left out")
    if arrays["time"].size:
        rising = _rising(path, arrays["time"], {"clock": _DAY_S, "min:s": _HOUR_S}.get(clock, np.inf), said)
        arrays = {name: x[rising] for name, x in arrays.items()}
    if arrays["time"].size < 2:
        problem = f"has {arrays['time'].size} usable rows: {'; '.join(said)}"
        raise ConfigError(path, "", problem, "two or more")
    if np.max(np.abs(arrays["grade"])) > MAX_GRADE:
        problem = f"{header[columns['grade']]} reaches {np.max(np.abs(arrays['grade'])):g}: percent or degrees?"
        raise ConfigError(path, "", problem, f"rise over run, -{MAX_GRADE:g} to {MAX_GRADE:g}")
    return _in_si(path, arrays, header, columns, clock or time_unit, speed_unit, said)


def _with_units(table: Table) -> Table:
    """A table whose header names the units, where they stood in a line of their own below it."""
    (line, header), units = table.rows[0], table.rows[1][1] if len(table.rows) > 1 else []
    words = [unit.strip("[]() ") for unit in units]
    known = any(_named(f"[{word}]", names) for word in words if word for names in (_TIME_NAMES, _UNIT_NAMES))
    if not known or any(character.isdigit() for word in words for character in word):
        return table
    named = [f"{name} [{word}]" if word else name for name, word in zip(header, words, strict=False)]
    return table._replace(rows=[(line, named + header[len(words) :]), *table.rows[2:]])


def _rising(path: Path | str, time: FloatArray, period_s: float, said: list[str]) -> NDArray[np.bool_]:
    """Which rows have a later time than all before them; a clock that passes its end goes on (in place)."""
    back = np.diff(time)
    if np.max(time) < period_s < np.inf and np.any(back < -0.5 * period_s):
        said.append(f"the clock passes {'midnight' if period_s == _DAY_S else 'the hour'}")
        time[1:] += period_s * np.cumsum(back < -0.5 * period_s)
    before = np.maximum.accumulate(time)[:-1]
    rising: NDArray[np.bool_] = np.concatenate(([True], time[1:] > before))
    behind = np.flatnonzero(time[1:] < before)
    if behind.size > _MOST_BEHIND * time.size:
        at = behind[0]
        problem = f"its time falls from {before[at]:.12g} to {time[at + 1]:.12g}, and {behind.size} rows lie behind"
        raise ConfigError(path, "", problem, "rows in the order of time, one drive")
    if not np.all(rising):
        said.append(f"{int(np.count_nonzero(~rising))} rows whose time does not rise left out")
    return rising


def _columns(
    table: Table, header: list[str], what: str, name: str, pattern: str, units: dict[str, str] | None = None
) -> list[int]:
    """Indices of the columns of this name, else of those that look like it, likest first: rather one that names a unit.

    One that is empty is the last choice, and before it a speed that is not the car's.
    """
    wanted = [i for i, cell in enumerate(header) if (cell == name if name else re.search(pattern, cell, re.IGNORECASE))]
    wanted.sort(
        key=lambda i: (
            all(map(is_nothing, _cells(table, i))),
            bool(units and re.search(_NOT_OF_CAR, header[i], re.IGNORECASE)),
            not _named(header[i], units or {}),
        )
    )
    if not wanted:
        where = f"line {table.rows[0][0]}"
        if not any(re.search(r"[^\W\d_]", cell) for cell in header):
            raise ConfigError(table.path, where, "has no header", "a first line that names the columns")
        problem = f"has no column {name!r}" if name else f"has no column that looks like {what}: name it with --{what}"
        raise ConfigError(table.path, where, problem, ", ".join(header))
    return wanted


def _cells(table: Table, column: int) -> list[str]:
    """What stands below a column's name."""
    return [cells[column] for _, cells in table.rows[1:] if column < len(cells)]


def _clock(table: Table, column: int, said: list[str]) -> str:
    """Which of `_CLOCKS` a column's first cell that says something shows; "" for none."""
    first = next((cell for cell in _cells(table, column) if not is_nothing(cell)), "")
    if not re.search(r"[0-9]:[0-9]", first):
        return ""
    if re.search("h:m", table.rows[0][1][column], re.IGNORECASE) or not re.fullmatch("[0-9]+:[0-9.,]+", first):
        return "clock"
    said.append("time in minutes:seconds: guessed; --time-unit clock says hours:minutes")
    return "min:s"


def _clock_s(table: Table, line: int, text: str, clock: str) -> float:
    """Seconds of a date with time, or of a clock."""
    plain = text.replace(",", ".")
    parts = re.fullmatch(_CLOCKS[clock], plain, re.ASCII)
    if parts:
        return sum(TIME_UNITS[unit] * float(value or 0) for unit, value in parts.groupdict().items())
    try:
        moment = datetime.datetime.fromisoformat(plain)
        return (moment.replace(tzinfo=moment.tzinfo or datetime.UTC)).timestamp()
    except (ValueError, OverflowError):
        raise ConfigError(
            table.path, f"line {line}", f"{text!r} is no time", "2026-03-01T12:00:00.1 | 12:00:00.1"
        ) from None


def _named(text: str, names: dict[str, str]) -> str:
    return next((unit for unit, pattern in names.items() if re.search(pattern, text, re.IGNORECASE)), "")


def _in_si(
    path: Path | str,
    arrays: dict[str, FloatArray],
    header: list[str],
    columns: dict[str, int],
    time_unit: str,
    speed_unit: str,
    said: list[str],
) -> Log:
    time, speed = arrays["time"] - arrays["time"][0], arrays["speed"]
    units = {"time": "s" if time_unit in _CLOCKS else time_unit, "speed": speed_unit}
    for name, names in (("time", _TIME_NAMES), ("speed", _UNIT_NAMES)):
        named = _named(header[columns[name]], names)
        if units[name] == "auto" and named:
            units[name] = named
            said.append(f"{name} in {named}, as the column's name says")
        elif named not in ("", units[name]):
            said.append(f"{name} in {units[name]}, as --{name}-unit says, although the column's name says {named}")
    guess = [name for name in units if units[name] == "auto"]
    if guess:
        possible = [
            every if units[name] == "auto" else {units[name]: every[units[name]]}
            for name, every in (("time", TIME_UNITS), ("speed", SPEED_UNITS))
        ]
        found = likely_units(time, np.maximum(speed, 0.0), *possible)
        if found is None:
            look = f"{' and '.join(guess)} look{'s' * (len(guess) == 1)}"
            raise ConfigError(path, "", f"its {look} like driving in no unit", "name the unit")
        for name, unit in zip(("speed", "time"), found, strict=True):
            if name in guess:
                units[name] = unit
                said.append(f"{name} in {unit}: guessed from the accelerations; --{name}-unit says otherwise")
    time = time * TIME_UNITS[units["time"]]
    speed = at_rest(speed * SPEED_UNITS[units["speed"]])
    lowest = float(np.min(speed))
    if lowest < -_BACKWARDS_MPS:
        raise ConfigError(path, "", f"its speed falls to {lowest:.3g} m/s: driving backwards is no cycle", ">= 0")
    if lowest < 0.0:
        said.append(f"speeds below zero, down to {lowest:.2g} m/s, taken for rest")
        speed = np.maximum(speed, 0.0)
    begins_s = float(arrays["time"][0]) * TIME_UNITS[units["time"]]
    return Log(path, time, speed, arrays["grade"], units["speed"], units["time"], begins_s, said)


def to_cycle(log: Log, gaps: str, max_gap_s: float, smooth_s: float, rate_hz: float) -> Cycle:
    """A cycle of a log.

    Parameters
    ----------
    gaps : refuse, bridge (a straight line) or cut (the gap's time is left out, the pieces are joined at `JOINT_MPS2`)
    max_gap_s : shorter ones are bridged
    smooth_s : width (standard deviation) of the bell the speed is smoothed with; 0 leaves it
    rate_hz : samples a second; 0 keeps the log's own

    Raises
    ------
    ConfigError
        Gaps that are not wanted, or a result no car drives.
    """
    found = log.gaps(max_gap_s)
    if found and gaps == "refuse":
        start, length = max(found, key=lambda gap: gap[1])
        problem = f"has {len(found)} gap{'s' * (len(found) > 1)}, the longest of {length:.4g} s from {start:.6g} s"
        raise ConfigError(log.path, "", problem, "--gaps bridge, --gaps cut, or a larger --max-gap")
    time: FloatArray = log.time_s
    speed, grade = log.speed_mps, log.grade
    if gaps == "cut":
        time = _without_gaps(time, speed, max_gap_s, log.step_s)
    if smooth_s > 0.0 or rate_hz > 0.0:
        step = 1.0 / rate_hz if rate_hz > 0.0 else log.step_s
        # Smoothed at the log's own pace: fewer samples would alias what the smoothing is to remove.
        fine_step = min(step, log.step_s)
        if fine_step < _SHORTEST_STEP_S or (time[-1] - time[0]) / fine_step > MAX_SAMPLES:
            problem = f"lasts {time[-1] - time[0]:.4g} s with samples {fine_step:.2g} s apart"
            raise ConfigError(log.path, "", problem, f"{MAX_SAMPLES} samples, {_SHORTEST_STEP_S:g} s apart or more")
        even: FloatArray = np.arange(int((time[-1] - time[0]) / step + 1e-9) + 1) * np.float64(step)
        fine = np.arange(int((time[-1] - time[0]) / fine_step + 1e-9) + 1) * fine_step
        smoothed = _smoothed(np.interp(fine, time, speed), smooth_s / fine_step)
        speed, grade = np.interp(even, fine, smoothed), np.interp(even, time, grade)
        time = even
    wrong = implausible(time, speed)
    if wrong:
        at, problem = wrong
        where = f"{time[at] + log.begins_s:.10g} s" if at >= 0 else ""
        raise ConfigError(log.path, where, f"speed {problem}", "another unit, or --smooth against single wrong samples")
    try:
        return dataclasses.replace(make_cycle(str(log.path), time, speed, grade), name=Path(log.path).stem)
    except ConfigError as error:  # which sends those who read a cycle here
        problem = error.problem.replace("(import_cycle converts)", "(--speed-unit and --time-unit say so)")
        raise ConfigError(log.path, error.key, problem, error.allowed) from None


def _without_gaps(time: FloatArray, speed: FloatArray, max_gap_s: float, step_s: float) -> FloatArray:
    steps = np.diff(time)
    joint = np.maximum(step_s, np.abs(np.diff(speed)) / JOINT_MPS2)
    steps = np.where(steps > max_gap_s, np.minimum(joint, steps), steps)
    return np.concatenate(([0.0], np.cumsum(steps)))


def _smoothed(speed: FloatArray, width: float) -> FloatArray:
    """A bell-shaped mean; where the car stands, it stands."""
    if width <= 0.0:
        return speed
    reach = min(int(np.ceil(4.0 * width)), speed.size)
    bell = np.exp(-0.5 * (np.arange(-reach, reach + 1) / width) ** 2)
    padded = np.concatenate((np.full(reach, speed[0]), speed, np.full(reach, speed[-1])))
    smooth = np.convolve(padded, bell / bell.sum(), mode="valid")
    return np.where(speed > 0.0, smooth, 0.0)


def cycle_text(cycle: Cycle, grade: bool) -> str:
    """The cycle as its CSV."""
    rows = [
        f"{t:.10g},{v:.10g}" + (f",{g:.8g}" if grade else "")
        for t, v, g in zip(cycle.time_s, cycle.speed_mps, cycle.grade, strict=True)
    ]
    return "\n".join(["time_s,speed_mps" + (",grade" if grade else ""), *rows]) + "\n"
