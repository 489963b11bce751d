# SPDX-License-Identifier: Apache-2.0
"""What a policy has to reach, checked on the rows of a study: criterion, value, met or not.

Nothing here decides what the numbers are; a criterion that is not met is printed like any other.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from iwm_sim.study.labels import BOUND, ED, GRDP, INSTANTANEOUS, INSTANTANEOUS_SLIP, OURS
from iwm_sim.study.rows import Place, Row, by_place
from iwm_sim.study.skid import DEMAND_G, Stopped

Cell = Mapping[str, Row]
Cells = Mapping[Place, Cell]

#: Percentage points by which a rival may be better in a cell.
WORSE_POINTS = 0.05
#: A possible saving above this has to be used at all; above the other one, this part of it.
WORTH_POINTS = 0.1
LARGE_POINTS, LARGE_PART = 0.3, 0.9
CHANGES_PER_MIN = 10.0
LONGEST_LOCKED_S = 0.1
STOP_LONGER_PERCENT = 5.0


@dataclass(frozen=True)
class Criterion:
    """A requirement, the number it hangs on, and whether it is met; `where` names the worst cell."""

    text: str
    value: str
    where: str
    met: bool


def check(rows: Sequence[Row], stops: Sequence[Stopped], slew_nmps: float) -> list[Criterion]:
    """Every criterion, on the rows of the cells and of the emergency stops.

    Parameters
    ----------
    rows : all strategies under the law's normal settings
    stops : emergency stops with the policy
    slew_nmps : the law's fastest change of a motor torque
    """
    table = by_place(rows)
    held = {cell: by for cell, by in table.items() if by[OURS].metrics.trace_held and by[ED].metrics.trace_held}
    result = [_against(held, rival, functools.partial(_saving, label=rival)) for rival in (ED, GRDP, INSTANTANEOUS)]
    result.append(_against(held, f"{INSTANTANEOUS_SLIP} at as many share changes", _at_as_many_changes))
    return [*result, *_possible(held), *_not_held(table), *_drivable(rows, slew_nmps), *_skid(rows, stops)]


def _saving(by: Cell, label: str) -> float | None:
    return by[label].saving_percent if label in by else None


def _at_as_many_changes(by: Cell) -> float | None:
    """Saving of the slip-aware rival where it changes the share as often as the policy, along its price of a change.

    Linear between two of its prices. A rival that never changes as often counts with its best; one that always changes
    more often, with its fewest changes.
    """
    points = sorted(
        (row.metrics.share_changes_per_min, row.saving_percent)
        for label, row in by.items()
        if label.startswith(INSTANTANEOUS_SLIP) and row.saving_percent is not None
    )
    if not points:
        return None
    changes, savings = zip(*points, strict=True)
    ours = by[OURS].metrics.share_changes_per_min
    if ours >= changes[-1]:
        return float(max(savings))
    return float(np.interp(ours, changes, savings))


def _against(held: Cells, rival: str, saving: Callable[[Cell], float | None]) -> Criterion:
    """The policy is not worse than a rival."""
    text = f"never worse than {rival} by more than {WORSE_POINTS} points"
    ahead = {}
    for cell, by in held.items():
        theirs, ours = saving(by), by[OURS].saving_percent
        if theirs is not None and ours is not None:
            ahead[cell] = ours - theirs
    if not ahead:
        return Criterion(text, "no such cell", "", True)
    worst = min(ahead, key=lambda cell: ahead[cell])
    behind = sum(points < -WORSE_POINTS for points in ahead.values())
    value = f"{ahead[worst]:+.2f} points at worst; beyond that in {behind} of {len(ahead)} cells"
    return Criterion(text, value, str(worst), ahead[worst] >= -WORSE_POINTS)


def _possible(held: Cells) -> list[Criterion]:
    """The policy saves where there is anything to save, and most of it where there is much."""
    savings = {
        cell: (by[OURS].saving_percent, by[BOUND].saving_percent or 0.0)
        for cell, by in held.items()
        if (by[BOUND].saving_percent or 0.0) > WORTH_POINTS
    }
    ours = {cell: saving for cell, (saving, _) in savings.items() if saving is not None}
    parts = {cell: ours[cell] / possible for cell, (_, possible) in savings.items() if possible >= LARGE_POINTS}
    any_text = f"better than ED where more than {WORTH_POINTS} points are possible"
    part_text = f"takes {LARGE_PART:.0%} of the possible saving where that is {LARGE_POINTS} points or more"
    result = [Criterion(text, "no such cell", "", True) for text in (any_text, part_text)]
    if ours:
        least = min(ours, key=lambda cell: ours[cell])
        value = f"{ours[least]:+.2f} % at worst, {len(ours)} cells"
        result[0] = Criterion(any_text, value, str(least), ours[least] > 0.0)
    if parts:
        least = min(parts, key=lambda cell: parts[cell])
        few = sum(part < LARGE_PART for part in parts.values())
        value = f"{parts[least]:.0%} at worst; below it in {few} of {len(parts)} cells"
        result[1] = Criterion(part_text, value, str(least), parts[least] >= LARGE_PART)
    return result


def _not_held(table: Cells) -> list[Criterion]:
    """Where the trace is lost with equal split or with the policy, the policy follows better for no more energy."""
    result = []
    for cell, by in table.items():
        ours, equal = by[OURS].metrics, by[ED].metrics
        if ours.trace_held and equal.trace_held:
            continue
        better = ours.rms_speed_error_mps <= equal.rms_speed_error_mps + 1e-9
        cheaper = ours.wh_per_km <= equal.wh_per_km * (1.0 + 1e-9)
        result.append(
            Criterion(
                "where the trace is lost: follows it better than ED, at no more energy per metre",
                f"rms {ours.rms_speed_error_mps:.3f} to {equal.rms_speed_error_mps:.3f} m/s, "
                f"{ours.wh_per_km:.2f} to {equal.wh_per_km:.2f} Wh/km",
                str(cell),
                better and cheaper,
            )
        )
    return result or [Criterion("where the trace is lost: follows it better than ED", "held in every cell", "", True)]


def _drivable(rows: Sequence[Row], slew_nmps: float) -> list[Criterion]:
    ours = [row for row in rows if row.label == OURS]
    busiest = max(ours, key=lambda row: row.metrics.share_changes_per_min)
    fastest = max(ours, key=lambda row: row.metrics.max_torque_rate_nmps)
    return [
        Criterion(
            f"front share changes by more than 0.25 at most {CHANGES_PER_MIN:g} times a minute",
            f"{busiest.metrics.share_changes_per_min:.1f} at most",
            str(busiest.place),
            busiest.metrics.share_changes_per_min <= CHANGES_PER_MIN,
        ),
        Criterion(
            f"no wheel torque moves faster than the slew limit, {slew_nmps:g} N m/s",
            f"{fastest.metrics.max_torque_rate_nmps:.0f} N m/s at most",
            str(fastest.place),
            fastest.metrics.max_torque_rate_nmps <= slew_nmps * (1.0 + 1e-6),
        ),
    ]


def _skid(rows: Sequence[Row], stops: Sequence[Stopped]) -> list[Criterion]:
    longest = max((row for row in rows if row.label == OURS), key=lambda row: row.metrics.longest_locked_s)
    limited = [stop for stop in stops if stop.gate_mode == "limiter"]
    latest = max(limited, key=lambda stop: stop.longer_percent)
    slid = max(limited, key=lambda stop: stop.longest_locked_s)
    return [
        Criterion(
            f"no axle beyond a slip of -0.2 for more than {LONGEST_LOCKED_S} s above 1 m/s, on the cycles",
            f"{longest.metrics.longest_locked_s:.2f} s at most",
            str(longest.place),
            longest.metrics.longest_locked_s <= LONGEST_LOCKED_S + 1e-9,
        ),
        Criterion(
            f"no axle beyond a slip of -0.2 for more than {LONGEST_LOCKED_S} s above 1 m/s, in emergency stops",
            f"{slid.longest_locked_s:.2f} s at most",
            f"friction {slid.friction:g}, {slid.strategy}",
            slid.longest_locked_s <= LONGEST_LOCKED_S + 1e-9,
        ),
        Criterion(
            f"stops from 25 m/s, asked for {DEMAND_G:g} g, within {STOP_LONGER_PERCENT:g} % of the best "
            "constant-slip braking",
            f"{latest.longer_percent:+.1f} % at worst",
            f"friction {latest.friction:g}, {latest.strategy}",
            latest.longer_percent <= STOP_LONGER_PERCENT and all(stop.stopped for stop in limited),
        ),
    ]
