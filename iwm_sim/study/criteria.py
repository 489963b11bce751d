"""What a policy has to reach, checked on the rows of a study: criterion, value, met or not.

Nothing here decides what the numbers are; a criterion that is not met is printed like any other.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

Row = Mapping[str, Any]

#: Labels of the rows.
OURS, ED, GRDP, INSTANTANEOUS, BOUND = "ours", "ED", "GRDP", "instantaneous", "preview"
#: Rows of the strongest rival start with this; behind it stands the power a change of the share has to save.
INSTANTANEOUS_SLIP = "instantaneous_slip"

#: Percentage points by which a rival may be better in a cell.
WORSE_POINTS = 0.05
#: A possible saving above this has to be used at all; above the other one, this part of it.
WORTH_POINTS = 0.1
LARGE_POINTS, LARGE_PART = 0.3, 0.9
CHANGES_PER_MIN = 10.0
LONGEST_LOCKED_S = 0.1
STOP_LONGER_PERCENT = 5.0


class Criterion(NamedTuple):
    """A requirement, the number it hangs on, and whether it is met; `where` names the worst cell."""

    text: str
    value: str
    where: str
    met: bool


def name(row: Row) -> str:
    """A cell in words."""
    return f"{row['cycle']} {row['friction']:g} {row['idle_drive']}"


def cells(rows: Iterable[Row]) -> dict[str, dict[str, Row]]:
    """Rows by cell and label."""
    result: dict[str, dict[str, Row]] = {}
    for row in rows:
        result.setdefault(name(row), {})[row["label"]] = row
    return result


def check(rows: Sequence[Row], stops: Sequence[Row], slew_nmps: float) -> list[Criterion]:
    """Every criterion, on the rows of the cells and of the emergency stops.

    Parameters
    ----------
    rows : all strategies under the law's normal settings
    stops : emergency stops with the policy
    slew_nmps : the law's fastest change of a motor torque
    """
    table = cells(rows)
    held = {cell: by for cell, by in table.items() if by[OURS]["trace_held"] and by[ED]["trace_held"]}
    result = [_against(held, rival, functools.partial(_saving, label=rival)) for rival in (ED, GRDP, INSTANTANEOUS)]
    result.append(_against(held, f"{INSTANTANEOUS_SLIP} at as many share changes", _at_as_many_changes))
    return [*result, *_possible(held), *_not_held(table), *_drivable(rows, slew_nmps), *_skid(rows, stops)]


def _saving(by: Mapping[str, Row], label: str) -> float | None:
    return by[label]["saving_percent"] if label in by else None


def _at_as_many_changes(by: Mapping[str, Row]) -> float | None:
    """Saving of the slip-aware rival where it changes the share as often as the policy, along its price of a change.

    Linear between two of its prices. A rival that never changes as often counts with its best; one that always changes
    more often, with its fewest changes.
    """
    points = sorted(
        (row["share_changes_per_min"], row["saving_percent"])
        for label, row in by.items()
        if label.startswith(INSTANTANEOUS_SLIP) and row["saving_percent"] is not None
    )
    if not points:
        return None
    changes, savings = zip(*points, strict=True)
    ours = by[OURS]["share_changes_per_min"]
    if ours >= changes[-1]:
        return float(max(savings))
    return float(np.interp(ours, changes, savings))


def _against(
    held: Mapping[str, Mapping[str, Row]], rival: str, saving: Callable[[Mapping[str, Row]], float | None]
) -> Criterion:
    """The policy is not worse than a rival."""
    text = f"never worse than {rival} by more than {WORSE_POINTS} points"
    ahead = {}
    for cell, by in held.items():
        theirs, ours = saving(by), by[OURS]["saving_percent"]
        if theirs is not None and ours is not None:
            ahead[cell] = ours - theirs
    if not ahead:
        return Criterion(text, "no such cell", "", True)
    worst = min(ahead, key=lambda cell: ahead[cell])
    behind = sum(points < -WORSE_POINTS for points in ahead.values())
    value = f"{ahead[worst]:+.2f} points at worst; beyond that in {behind} of {len(ahead)} cells"
    return Criterion(text, value, worst, ahead[worst] >= -WORSE_POINTS)


def _possible(held: Mapping[str, Mapping[str, Row]]) -> list[Criterion]:
    worth = {
        cell: by
        for cell, by in held.items()
        if (by[BOUND]["saving_percent"] or 0.0) > WORTH_POINTS and by[OURS]["saving_percent"] is not None
    }
    least = min(worth, key=lambda cell: worth[cell][OURS]["saving_percent"], default="")
    text = f"better than ED where more than {WORTH_POINTS} points are possible"
    result = [Criterion(text, "no such cell", "", True)]
    if least:
        saving = worth[least][OURS]["saving_percent"]
        result = [Criterion(text, f"{saving:+.2f} % at worst, {len(worth)} cells", least, saving > 0.0)]
    parts = {
        cell: by[OURS]["saving_percent"] / by[BOUND]["saving_percent"]
        for cell, by in worth.items()
        if by[BOUND]["saving_percent"] >= LARGE_POINTS
    }
    text = f"takes {LARGE_PART:.0%} of the possible saving where that is {LARGE_POINTS} points or more"
    if not parts:
        return [*result, Criterion(text, "no such cell", "", True)]
    least = min(parts, key=lambda cell: parts[cell])
    few = sum(part < LARGE_PART for part in parts.values())
    value = f"{parts[least]:.0%} at worst; below it in {few} of {len(parts)} cells"
    return [*result, Criterion(text, value, least, parts[least] >= LARGE_PART)]


def _not_held(table: Mapping[str, Mapping[str, Row]]) -> list[Criterion]:
    """Where the trace is lost with equal split or with the policy, the policy follows better for no more energy."""
    result = []
    for cell, by in table.items():
        ours, equal = by[OURS], by[ED]
        if ours["trace_held"] and equal["trace_held"]:
            continue
        better = ours["rms_speed_error_mps"] <= equal["rms_speed_error_mps"] + 1e-9
        cheaper = ours["wh_per_km"] <= equal["wh_per_km"] * (1.0 + 1e-9)
        result.append(
            Criterion(
                "where the trace is lost: follows it better than ED, at no more energy per metre",
                f"rms {ours['rms_speed_error_mps']:.3f} to {equal['rms_speed_error_mps']:.3f} m/s, "
                f"{ours['wh_per_km']:.2f} to {equal['wh_per_km']:.2f} Wh/km",
                cell,
                better and cheaper,
            )
        )
    return result or [Criterion("where the trace is lost: follows it better than ED", "held in every cell", "", True)]


def _drivable(rows: Sequence[Row], slew_nmps: float) -> list[Criterion]:
    ours = [row for row in rows if row["label"] == OURS]
    busiest = max(ours, key=lambda row: row["share_changes_per_min"])
    fastest = max(ours, key=lambda row: row["max_torque_rate_nmps"])
    return [
        Criterion(
            f"front share changes by more than 0.25 at most {CHANGES_PER_MIN:g} times a minute",
            f"{busiest['share_changes_per_min']:.1f} at most",
            name(busiest),
            busiest["share_changes_per_min"] <= CHANGES_PER_MIN,
        ),
        Criterion(
            f"no wheel torque moves faster than the slew limit, {slew_nmps:g} N m/s",
            f"{fastest['max_torque_rate_nmps']:.0f} N m/s at most",
            name(fastest),
            fastest["max_torque_rate_nmps"] <= slew_nmps * (1.0 + 1e-6),
        ),
    ]


def _skid(rows: Sequence[Row], stops: Sequence[Row]) -> list[Criterion]:
    ours = [row for row in rows if row["label"] == OURS]
    longest = max(ours, key=lambda row: row["longest_locked_s"])
    limited = [stop for stop in stops if stop["gate_mode"] == "limiter"]
    latest = max(limited, key=lambda stop: stop["longer_percent"])
    slid = max(limited, key=lambda stop: stop["longest_locked_s"])
    return [
        Criterion(
            f"no axle beyond a slip of -0.2 for more than {LONGEST_LOCKED_S} s above 1 m/s, on the cycles",
            f"{longest['longest_locked_s']:.2f} s at most",
            name(longest),
            longest["longest_locked_s"] <= LONGEST_LOCKED_S + 1e-9,
        ),
        Criterion(
            f"no axle beyond a slip of -0.2 for more than {LONGEST_LOCKED_S} s above 1 m/s, in emergency stops",
            f"{slid['longest_locked_s']:.2f} s at most",
            f"friction {slid['friction']:g}, {slid['strategy']}",
            slid["longest_locked_s"] <= LONGEST_LOCKED_S + 1e-9,
        ),
        Criterion(
            f"stops from 25 m/s within {STOP_LONGER_PERCENT:g} % of the best constant-slip braking",
            f"{latest['longer_percent']:+.1f} % at worst",
            f"friction {latest['friction']:g}, {latest['strategy']}",
            latest["longer_percent"] <= STOP_LONGER_PERCENT and all(stop["stopped"] for stop in limited),
        ),
    ]
