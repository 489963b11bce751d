# SPDX-License-Identifier: Apache-2.0
"""Drive cycles: CSV -> `Cycle`, every mistake named with its line.

A file has the columns `time_s,speed_mps` and optionally `grade` (rise over run, uphill positive), in any order, after
one header line. Steps may be uneven and may have gaps: between two points, speed and grade change linearly with time.
Empty lines and lines that start with # are skipped. A file whose accelerations no car has is refused with the unit it
probably holds; `import_cycle` makes a cycle of a log in other units, with gaps or noise.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from dataclasses import field as attribute
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from iwm_power_manager import trace_units
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.files import sha256_of
from iwm_power_manager.tables import read_table

MAX_SPEED_MPS = 70.0
MAX_GRADE = 0.5
#: Two days at 10 Hz: beyond that, the time column is not in seconds.
MAX_SAMPLES = 2_000_000
#: A drive that is longer is none: a date in the column, or another unit. It would be sampled a hundred times a second.
MAX_DURATION_S = 100_000.0

#: A step of a trace that is so many times its usual one, and longer than this, may be one that nobody recorded.
_GAP_STEPS, _GAP_S = 10.0, 5.0

#: A sensor at rest shows as little as this below zero: rest. Five times the noise of a logged speed, 0.2 km/h rms.
REST_NOISE_MPS = 0.3

_REQUIRED = ("time_s", "speed_mps")
_RANGES = {"speed_mps": (0.0, MAX_SPEED_MPS), "grade": (-MAX_GRADE, MAX_GRADE)}


@dataclass(frozen=True, eq=False)
class Cycle:
    """A speed trace over time.

    Attributes
    ----------
    name : the file's name without its ending
    time_s : float64[n], strictly increasing, n >= 2
    speed_mps : float64[n], 0..70
    grade : float64[n], rise over run; zero where the file has no such column
    sha256 : hash of the file's bytes, or of the arrays if the cycle does not come from a file
    path : the file ("" if there is none)
    gap : where the file may lack a part of the drive, in words; "" if it does not
    """

    name: str
    time_s: NDArray[np.float64] = attribute(repr=False)
    speed_mps: NDArray[np.float64] = attribute(repr=False)
    grade: NDArray[np.float64] = attribute(repr=False)
    sha256: str
    path: str = ""
    gap: str = ""

    @property
    def duration_s(self) -> float:
        """Time from the first to the last point."""
        return float(self.time_s[-1] - self.time_s[0])

    @property
    def distance_m(self) -> float:
        """Length of the trace: its speed, integrated."""
        return float(np.sum(np.diff(self.time_s) * (self.speed_mps[1:] + self.speed_mps[:-1])) / 2.0)

    @property
    def source(self) -> str:
        """What errors name: the file, or the name where there is none."""
        return self.path or self.name

    def resample(self, dt_s: float) -> Cycle:
        """The same trace at an even step, from its first point to the last whole step inside it.

        Time starts at zero. A cycle shorter than one step is refused.
        """
        if not (math.isfinite(dt_s) and dt_s > 0.0):
            raise ConfigError(self.source, "dt_s", f"{dt_s} is out of range", "> 0 s")
        # A duration that is a whole number of steps must not lose its last one to rounding.
        steps = math.floor(self.duration_s / dt_s + 1e-9)
        if steps < 1:
            raise ConfigError(self.source, "time_s", f"{self.duration_s:g} s is shorter than a step", f">= {dt_s:g} s")
        if steps > MAX_SAMPLES:
            problem = f"{self.duration_s:g} s is too long for steps of {dt_s:g} s"
            raise ConfigError(self.source, "time_s", problem, f"<= {MAX_SAMPLES * dt_s:g} s")
        time: NDArray[np.float64] = np.arange(steps + 1, dtype=np.float64) * dt_s
        at = self.time_s[0] + time
        return Cycle(
            name=self.name,
            time_s=time,
            speed_mps=np.interp(at, self.time_s, self.speed_mps),
            grade=np.interp(at, self.time_s, self.grade),
            sha256=self.sha256,
            path=self.path,
            gap=self.gap,
        )


def make_cycle(name: str, time_s, speed_mps, grade=None) -> Cycle:
    """A `Cycle` from arrays, with the same checks as a file's."""
    time = np.ascontiguousarray(time_s, dtype=np.float64)
    speed = at_rest(np.ascontiguousarray(speed_mps, dtype=np.float64))
    slope = np.zeros_like(time) if grade is None else np.ascontiguousarray(grade, dtype=np.float64)
    if not (time.ndim == 1 and time.shape == speed.shape == slope.shape):
        raise ConfigError(name, "", f"columns of different lengths: {time.shape}, {speed.shape}, {slope.shape}")
    places = [f"sample {i}" for i in range(time.size)]
    _check_rows(name, places, {"time_s": time, "speed_mps": speed, "grade": slope})
    _check_duration(name, places, time)
    digest = hashlib.sha256(time.tobytes() + speed.tobytes() + slope.tobytes()).hexdigest()
    return Cycle(name, time, speed, slope, digest)


def load_cycle(path: Path | str) -> Cycle:
    """Read a cycle's CSV.

    Raises
    ------
    ConfigError
        The file is unreadable, empty or too short, lacks a column, has one that is unknown or stands twice, or holds
        a value that is no number, not finite or out of range, or a time that does not increase. The message names
        the line.
    """
    table = read_table(path, "comma", "point")
    (first, names), *rows = table.rows
    header = _header(path, first, names)
    if len(rows) > MAX_SAMPLES:
        raise ConfigError(path, "", f"has {len(rows)} rows", f"<= {MAX_SAMPLES}")
    values = np.empty((len(rows), len(header)))
    for row, (number, fields) in enumerate(rows):
        if len(fields) != len(header):
            hint = ": decimal commas? import_cycle reads them" if len(fields) == 2 * len(header) else ""
            problem = f"has {len(fields)} values{hint}"
            raise ConfigError(path, f"line {number}", problem, f"{len(header)}, as in the header")
        values[row] = [table.number(number, field, name) for name, field in zip(header, fields, strict=True)]
    columns = {name: np.ascontiguousarray(values[:, i]) for i, name in enumerate(header)}
    columns.setdefault("grade", np.zeros(len(values)))
    places = [f"line {number}" for number, _ in rows]
    columns["speed_mps"] = at_rest(columns["speed_mps"])
    _check_rows(path, places, columns)
    found = trace_units.implausible(columns["time_s"], columns["speed_mps"])
    if found:
        at, words = found
        words += trace_units.hint(columns["time_s"], columns["speed_mps"])
        raise ConfigError(path, places[at] if at >= 0 else "", f"speed_mps {words}")
    _check_duration(path, places, columns["time_s"])
    return Cycle(
        name=Path(path).stem,
        time_s=columns["time_s"],
        speed_mps=columns["speed_mps"],
        grade=columns["grade"],
        sha256=sha256_of(path),
        path=str(path),
        gap=_gap(path, places, columns),
    )


def at_rest(speed_mps: NDArray[np.float64]) -> NDArray[np.float64]:
    """The speeds with the noise of a sensor at rest taken for rest."""
    return np.where((speed_mps < 0.0) & (speed_mps >= -REST_NOISE_MPS), 0.0, speed_mps)


def _header(path: Path | str, number: int, header: list[str]) -> list[str]:
    allowed = "time_s,speed_mps[,grade]"
    where = f"line {number}"
    mark = next((mark for mark in ";\t|" if len(header) == 1 and mark in header[0]), "")
    if mark:
        problem = f"is separated by {'tabs' if mark == chr(9) else repr(mark)}: import_cycle reads that"
        raise ConfigError(path, where, problem, allowed)
    for name in _REQUIRED:
        if name not in header:
            raise ConfigError(path, where, f"column '{name}' is missing: import_cycle reads a log", allowed)
    for name in header:
        if name not in (*_REQUIRED, "grade") or header.count(name) > 1:
            problem = "stands twice" if header.count(name) > 1 else "is unknown"
            raise ConfigError(path, where, f"column '{name}' {problem}", allowed)
    return header


def _check_rows(path: Path | str, places: list[str], columns: dict[str, NDArray[np.float64]]) -> None:
    if len(places) < 2:
        raise ConfigError(path, "", f"has {len(places)} row(s)", "two or more")
    for name, values in columns.items():
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            raise ConfigError(path, places[bad[0]], f"{name} {values[bad[0]]} is not finite")
        if name in _RANGES:
            low, high = _RANGES[name]
            bad = np.flatnonzero((values < low) | (values > high))
            if bad.size:
                problem = f"{name} {values[bad[0]]:g} is out of range"
                if name == "grade":
                    problem += ": percent or degrees? it is rise over run"
                elif values[bad[0]] > high:
                    problem += _unit_hint(columns)
                raise ConfigError(path, places[bad[0]], problem, f"{low:g} to {high:g}")
    back = np.flatnonzero(np.diff(columns["time_s"]) <= 0.0)
    if back.size:
        at = int(back[0]) + 1
        before = columns["time_s"][at - 1]
        raise ConfigError(path, places[at], f"time_s {columns['time_s'][at]:g} does not increase", f"> {before:g} s")


def _check_duration(path: Path | str, places: list[str], time_s: NDArray[np.float64]) -> None:
    late = np.flatnonzero(time_s - time_s[0] > MAX_DURATION_S)
    if late.size:
        problem = f"time_s {time_s[late[0]]:g} is more than {MAX_DURATION_S:g} s after the first"
        raise ConfigError(path, places[late[0]], problem, "a drive in seconds")


def longest_gap(time_s: NDArray[np.float64], speed_mps: NDArray[np.float64]) -> tuple[int, str] | None:
    """The longest step in which a car moves and that is no step of this trace: the point behind it, and words."""
    steps = np.diff(time_s)
    usual_s = float(np.median(steps))
    moves = (speed_mps[1:] > 0.0) | (speed_mps[:-1] > 0.0)
    found = np.flatnonzero(moves & (steps > _GAP_S) & (steps >= _GAP_STEPS * usual_s))
    if not found.size:
        return None
    at = int(found[np.argmax(steps[found])])
    others = f", and {found.size - 1} more such" if found.size > 1 else ""
    words = f"is {steps[at]:.4g} s after the one before{others}, where {usual_s:.3g} s is usual"
    return at + 1, words


def _gap(path: Path | str, places: list[str], columns: dict[str, NDArray[np.float64]]) -> str:
    found = longest_gap(columns["time_s"], columns["speed_mps"])
    if found is None:
        return ""
    at, words = found
    advice = "if nobody recorded it, import_cycle --gaps cut leaves it out"
    return f"{path}: {places[at]}: {words}: taken for a straight line; {advice}"


def _unit_hint(columns: dict[str, NDArray[np.float64]]) -> str:
    """What speeds beyond every car's probably are."""
    time, speed = columns["time_s"], columns["speed_mps"]
    usable = np.all(np.isfinite(time)) and np.all(np.isfinite(speed)) and np.all(np.diff(time) > 0.0)
    return trace_units.hint(time, speed) if usable else ""
