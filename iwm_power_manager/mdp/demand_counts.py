# SPDX-License-Identifier: Apache-2.0
"""Driving, kept as counts: how often one power demand was followed by another, and at which speed.

What `solve_policy` learns from is the demand's transition matrix (`mdp.demand`). A car that counts its transitions
while driving needs some kilobytes for all of them, where bags would take gigabytes. The counts are
on the axes of a policy, or of the package's own grid, and can be used for a problem on any others.
"""

from __future__ import annotations

import io
import json
import math
from bisect import bisect_left
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from iwm_power_manager import __version__
from iwm_power_manager.archive import read_npz
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.files import atomic_write, sha256_of
from iwm_power_manager.mdp.demand import Source
from iwm_power_manager.mdp.problem import MAX_AXIS_POINTS

FORMAT_NAME = "iwm_power_manager demand transitions"
FORMAT_VERSION = 1
_MEMBERS = ("metadata", "power_w", "speed_mps", "cells", "counts")
_NS_PER_S = 1_000_000_000
#: Cells of a table of counts, and transitions in it (six years at 0.2 s): beyond, a file is no log of driving.
MAX_CELLS = 20_000_000
MAX_TRANSITIONS = 1_000_000_000
#: Transitions that are walked through one by one; where there are more, each stands for several.
_MAX_STEPS = 5_000_000


class DemandTransitions(NamedTuple):
    """Counted transitions.

    Attributes
    ----------
    power_w, speed_mps : float64[P], float64[V], the axes; a value counts for the nearest point
    dt_s : time from one demand to the next
    counts : int64[V, P, P], by speed at the arrival, demand before and demand after
    clipped : demands beyond the ends of the axis
    """

    power_w: NDArray[np.float64]
    speed_mps: NDArray[np.float64]
    dt_s: float
    counts: NDArray[np.int64]
    clipped: int

    @property
    def total(self) -> int:
        """Transitions counted."""
        return int(self.counts.sum())

    def fits(self, power_w: NDArray[np.float64], speed_mps: NDArray[np.float64], dt_s: float) -> bool:
        """Whether these are the axes and the step."""
        return np.array_equal(self.power_w, power_w) and np.array_equal(self.speed_mps, speed_mps) and self.dt_s == dt_s


class DemandCounter:
    """Counts transitions step by step, in constant time and memory.

    Parameters
    ----------
    power_w, speed_mps : rising axes
    dt_s : a demand is taken this often
    before : counts to go on from, on the same axes

    Attributes
    ----------
    total : transitions counted
    """

    def __init__(
        self,
        power_w: NDArray[np.float64],
        speed_mps: NDArray[np.float64],
        dt_s: float,
        before: DemandTransitions | None = None,
    ) -> None:
        self._axes = np.array(power_w, dtype=np.float64), np.array(speed_mps, dtype=np.float64)
        self._dt_s = float(dt_s)
        points, speeds = self._axes[0].size, self._axes[1].size
        self._counts = np.zeros((speeds, points, points), dtype=np.int64) if before is None else before.counts.copy()
        self._clipped = 0 if before is None else before.clipped
        # Plain lists: bisecting one takes a tenth of the time that NumPy needs for a single number.
        self._power_edges, self._speed_edges = ([float(x) for x in 0.5 * (a[1:] + a[:-1])] for a in self._axes)
        self._low_w, self._high_w = float(power_w[0]), float(power_w[-1])
        self._dt_ns = round(dt_s * _NS_PER_S)
        self.total = int(self._counts.sum())
        self._bin = -1  # of the last demand taken
        self._due_ns = 0

    def add(self, stamp_ns: int, speed_mps: float, power_w: float) -> None:
        """Note what holds at a time; most calls come before the next demand is due and do nothing.

        A demand that is half a step late, or a time that goes back, begins a new sequence.
        """
        late_ns = stamp_ns - self._due_ns
        if self._bin >= 0 and -self._dt_ns < late_ns < -self._dt_ns // 40:
            return
        last = self._bin
        self._bin = bisect_left(self._power_edges, power_w)
        self._clipped += not self._low_w <= power_w <= self._high_w
        if last >= 0 and -self._dt_ns < late_ns <= self._dt_ns // 2:
            self._counts[bisect_left(self._speed_edges, speed_mps), last, self._bin] += 1
            self.total += 1
            self._due_ns += self._dt_ns
        else:
            self._due_ns = stamp_ns + self._dt_ns

    def pause(self) -> None:
        """What comes next does not follow from what came last."""
        self._bin = -1

    def transitions(self) -> DemandTransitions:
        """A copy of what was counted so far."""
        return DemandTransitions(*self._axes, self._dt_s, self._counts.copy(), self._clipped)


def save_transitions(transitions: DemandTransitions, path: Path | str) -> None:
    """Write the counts as one `.npz` without pickles, atomically; `ConfigError` if that fails."""
    cells = np.argwhere(transitions.counts).astype(np.int32)
    metadata = {
        "format": FORMAT_NAME,
        "format_version": FORMAT_VERSION,
        "package_version": __version__,
        "dt_s": transitions.dt_s,
        "clipped": transitions.clipped,
    }
    output = io.BytesIO()
    np.savez_compressed(
        output,
        metadata=np.frombuffer(json.dumps(metadata).encode(), dtype=np.uint8),
        power_w=transitions.power_w,
        speed_mps=transitions.speed_mps,
        cells=cells,
        counts=transitions.counts[tuple(cells.T)],
    )
    atomic_write(path, output.getvalue())


def load_transitions(path: Path | str) -> DemandTransitions:
    """Read a file of counts and check all of it.

    Raises
    ------
    ConfigError
        It is missing, no such file, damaged, or of another version.
    """
    members = read_npz(path, _MEMBERS, "file of demand transitions")
    try:
        metadata = json.loads(members["metadata"].tobytes())
        ours = metadata["format"] == FORMAT_NAME
        version = metadata["format_version"]
    except (ValueError, KeyError, TypeError, RecursionError):
        raise ConfigError(path, "", "is no file of demand transitions, or a damaged one") from None
    if not ours:
        raise ConfigError(path, "format", f"{metadata['format']!r} is unknown", FORMAT_NAME)
    if version != FORMAT_VERSION:
        raise ConfigError(path, "format_version", f"{version!r} cannot be read", str(FORMAT_VERSION))
    try:
        return _checked(members, metadata)
    except (ValueError, KeyError, TypeError, IndexError, OverflowError) as error:
        raise ConfigError(path, "", f"is damaged: {error}") from None


def _checked(members: dict[str, NDArray[Any]], metadata: dict[str, Any]) -> DemandTransitions:
    axes = []
    for name in ("power_w", "speed_mps"):
        axis = members[name]
        if axis.dtype != np.float64 or axis.ndim != 1 or not 1 <= axis.size <= MAX_AXIS_POINTS:
            raise ValueError(f"{name} is no axis of 1 to {MAX_AXIS_POINTS} points")
        if not np.all(np.isfinite(axis)):
            raise ValueError(f"{name} is no axis")
        if np.any(np.diff(axis) <= 0.0):
            raise ValueError(f"{name} does not rise")
        axes.append(axis)
    dt_s, clipped = float(metadata["dt_s"]), int(metadata["clipped"])
    if not 0.0 < dt_s < 1e3 or clipped < 0:
        raise ValueError("dt_s or clipped is out of range")
    cells, counts = members["cells"], members["counts"]
    shape = (axes[1].size, axes[0].size, axes[0].size)
    if cells.dtype.kind != "i" or counts.dtype.kind != "i" or cells.shape != (counts.size, 3) or counts.ndim != 1:
        raise ValueError("cells and counts do not fit each other")
    if np.any(counts < 1) or np.any(cells < 0) or np.any(cells >= shape):
        raise ValueError("a cell or a count is out of range")
    if math.prod(shape) > MAX_CELLS or float(counts.sum(dtype=np.float64)) > MAX_TRANSITIONS:
        raise ValueError(f"it has more than {MAX_CELLS:.0e} cells or {MAX_TRANSITIONS:.0e} transitions")
    table = np.zeros(shape, dtype=np.int64)
    np.add.at(table, tuple(cells.T), counts)
    return DemandTransitions(axes[0], axes[1], dt_s, table, clipped)


def transitions_source(path: Path | str, dt_s: float, weight: float = 1.0) -> Source:
    """A file of counts as a source of demand: sequences with exactly these transitions.

    Raises
    ------
    ConfigError
        The file cannot be used, holds no transition, or was counted at another step.
    """
    transitions = load_transitions(path)
    if transitions.dt_s != dt_s:
        raise ConfigError(path, "dt_s", f"{transitions.dt_s:g} s is not the grid's step", f"{dt_s:g} s")
    if not transitions.total:
        raise ConfigError(path, "counts", "holds no transition yet")
    each = -(-transitions.total // _MAX_STEPS)
    walks = walk_through(-(-transitions.counts // each))
    return Source(
        Path(path).name,
        sha256_of(path),
        weight * each,
        tuple(transitions.power_w[bins] for bins, _ in walks),
        tuple(transitions.speed_mps[speeds] for _, speeds in walks),
    )


def walk_through(counts: NDArray[np.int64]) -> list[tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Walks from bin to bin that together make each transition as often as it was counted.

    Returns
    -------
    bins and speeds of each walk; the speed of a walk's first bin has no transition behind it and means nothing

    Where a walk cannot go on, the next begins; as driving leaves a demand as often as it arrives there, that is seldom.
    """
    onward: dict[int, list[list[int]]] = {}
    for speed, before, after in np.argwhere(counts).tolist():
        onward.setdefault(before, []).append([speed, after, int(counts[speed, before, after])])
    walks = []
    for start, choices in onward.items():
        while choices:
            bins, speeds = [start], [choices[-1][0]]
            while possible := onward.get(bins[-1]):
                step = possible[-1]
                bins.append(step[1])
                speeds.append(step[0])
                step[2] -= 1
                if not step[2]:
                    possible.pop()
            walks.append((np.array(bins), np.array(speeds)))
    return walks
