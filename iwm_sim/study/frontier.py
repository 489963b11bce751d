# SPDX-License-Identifier: Apache-2.0
"""The frontier: what a strategy saves, against how often it changes the split to do so.

A saving alone says little: changing at every glimpse of a gain saves more than a strategy that a driver would want.
So a strategy is compared at the same number of changes: `instantaneous_slip` over thresholds, ours over budgets, in
the closed loop, on one `Place` (car, cycle, road, noise). Changes are counted in three ways, because a strategy could
win one count by cheating on it: changes by more than a quarter of the power, changes by more than a twentieth, and the
sum of all moves. The `margin` of a point is its saving minus the best a rival reaches with no more changes; equal
split, which saves nothing and never changes, is always among the rivals.

`bound` is what could be saved with the whole drive known in advance and no more changes: dynamic programming over the
demand, with the price of a change bisected until the changes fit (a Lagrangian), driven like any other strategy. What
another strategy did can be known in advance as well, so the bound is never below what any strategy reached.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.control.table import PolicyTable, empty_table
from iwm_power_manager.cycle import Cycle
from iwm_power_manager.policy import Policy
from iwm_power_manager.tools.command import made_with
from iwm_power_manager.vehicle import Vehicle
from iwm_sim import closed_loop, preview
from iwm_sim.closed_loop import Noise, Run
from iwm_sim.metrics import Metrics, measure, share_changes, share_swings
from iwm_sim.study import generate
from iwm_sim.study.report import Column
from iwm_sim.study.rows import saving_percent

FloatArray = npt.NDArray[np.float64]

#: Thresholds of `instantaneous_slip`, W.
THRESHOLDS_W = (0.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0, 60.0, 80.0, 100.0, 140.0, 200.0)
#: Budgets of ours, changes a minute; the last one is as good as none.
BUDGETS_PER_MIN = (2.0, 3.0, 4.0, 6.0, 8.0, 10.0, 14.0, 20.0, 1000.0)
OURS = "sdp_lookahead"
RIVAL = "instantaneous_slip"

#: Ways of counting changes, by the field of `Point`.
COUNTS = ("changes_per_min", "fine_changes_per_min", "travel_per_min")
FINE_CHANGE = 0.05
#: A fourth way, for what the first one is blind to; no part of any target.
SWINGS = "swings_per_min"
#: Ways of saying what was saved, by the field of `Point`; the second is no part of any target.
SAVED, SAVED_PER_KM = "saving_percent", "saving_per_km_percent"

_DT_S = 0.01


def _setting(point: Point) -> str:
    if point.strategy == "instantaneous":
        return ""
    return f"{point.setting:g} {'W' if point.strategy == RIVAL else 'a minute'}"


#: Columns of a table of points.
POINT_COLUMNS: tuple[Column[Point], ...] = (
    Column("strategy", lambda point: point.strategy),
    Column("threshold", _setting, "or budget"),
    Column("> 0.25", lambda point: point.changes_per_min, "1/min", 1, group="changes"),
    Column("> 0.05", lambda point: point.fine_changes_per_min, "1/min", 1, group="changes"),
    Column("moves", lambda point: point.travel_per_min, "1/min", 1),
    Column("minute", lambda point: point.busiest_minute, decimals=0, group="busiest"),
    Column("saving", lambda point: point.saving_percent, "%", 3),
    Column("trace", lambda point: "held" if point.held else "lost"),
    Column("policy", lambda point: point.policy),
)


class Place(NamedTuple):
    """Where a frontier is measured.

    Attributes
    ----------
    label : what tables call it
    vehicle, cycle, friction : what is driven
    noise_seed : of a foot that shakes by 1 % of the pedal's travel; None is a steady one
    """

    label: str
    vehicle: Vehicle
    cycle: Cycle
    friction: float
    noise_seed: int | None = None


class Point(NamedTuple):
    """One drive: what it saved against equal split, and with how many changes.

    Attributes
    ----------
    strategy, setting : threshold in W, or budget in changes a minute
    saving_percent : None where the runs do not cover the same distance
    changes_per_min : by more than a quarter
    fine_changes_per_min : by more than a twentieth
    travel_per_min : sum of all moves, 1 being all the power
    busiest_minute : most changes in any minute
    held : whether this run and that of equal split held the trace
    policy : grid and checksum of the policy it was driven with, of ours
    swings_per_min : out of a band of a quarter (`share_swings`); None in a file of before they were counted
    saving_per_km_percent : of the energy for a kilometre, which differs where the road is too slippery for the trace
        and one of both fell behind it; None as `saving_percent`, or in a file of before it was measured
    """

    strategy: str
    setting: float
    saving_percent: float | None
    changes_per_min: float
    fine_changes_per_min: float
    travel_per_min: float
    busiest_minute: int
    held: bool
    policy: str = ""
    swings_per_min: float | None = None
    saving_per_km_percent: float | None = None


class Frontier(NamedTuple):
    """All points of a place, and what they were driven with; a bound has no more changes than its point of ours."""

    label: str
    made_with: str
    rivals: tuple[Point, ...]
    ours: tuple[Point, ...]
    bounds: tuple[Point, ...]

    @property
    def points(self) -> tuple[Point, ...]:
        """All of them."""
        return (*self.rivals, *self.ours, *self.bounds)


class _Reference(NamedTuple):
    run: Run
    metrics: Metrics


def drive(place: Place, strategy: str, table: PolicyTable, threshold_w: float = 0.0) -> Run:
    """Drive a place with a strategy."""
    noise = closed_loop.NO_NOISE
    if place.noise_seed is not None:
        steps = int(place.cycle.duration_s / _DT_S) + 2
        noise = Noise(np.zeros(steps), np.zeros((steps, 4)), generate.pedal_noise(steps, _DT_S, place.noise_seed))
    settings = default_settings(strategy)._replace(switching_power_w=threshold_w)
    return closed_loop.run(place.cycle, place.vehicle, settings, table, place.friction, dt_s=_DT_S, noise=noise)


def busiest_minute(share: FloatArray, dt_s: float) -> int:
    """Most changes by more than a quarter in any 60 s."""
    level = share[0]
    at = []
    for k in np.flatnonzero(np.diff(share, prepend=share[0])):
        if abs(share[k] - level) > 0.25:
            at.append(k * dt_s)
            level = share[k]
    times = np.array(at)
    return int(max((np.count_nonzero((times >= t) & (times < t + 60.0)) for t in times), default=0))


def _point(strategy: str, setting: float, run: Run, place: Place, reference: _Reference) -> Point:
    metrics = measure(run, place.vehicle.params)
    minutes = run.series.shape[0] * run.dt_s / 60.0
    share = run["decided_share"]
    saving = saving_percent(metrics, reference.metrics)
    return Point(
        strategy=strategy,
        setting=setting,
        saving_percent=saving,
        changes_per_min=metrics.share_changes_per_min,
        fine_changes_per_min=share_changes(share, FINE_CHANGE) / minutes,
        travel_per_min=metrics.share_travel_per_min,
        busiest_minute=busiest_minute(share, run.dt_s),
        held=metrics.trace_held and reference.metrics.trace_held,
        swings_per_min=share_swings(share) / minutes,
        saving_per_km_percent=None if saving is None else _per_km(metrics, reference.metrics),
    )


def _per_km(one: Metrics, reference: Metrics) -> float:
    return 100.0 * (1.0 - one.wh_per_km / reference.wh_per_km)


def measure_frontier(
    place: Place,
    policies: Sequence[Policy],
    thresholds_w: Sequence[float] = THRESHOLDS_W,
    bounds: bool = False,
) -> Frontier:
    """Drive a place with all strategies.

    Parameters
    ----------
    policies : of ours, each solved for a budget of changes
    thresholds_w : of the rival
    bounds : whether to look for the bound of each of our points as well
    """
    equal = drive(place, "equal", empty_table())
    reference = _Reference(equal, measure(equal, place.vehicle.params))
    rivals = [
        _point(RIVAL, threshold, drive(place, RIVAL, empty_table(), threshold), place, reference)
        for threshold in thresholds_w
    ]
    blind = drive(place, "instantaneous", empty_table())
    rivals.append(_point("instantaneous", 0.0, blind, place, reference))
    ours, limits = [], []
    for policy in policies:
        run = drive(place, OURS, policy.table())
        point = _point(OURS, policy.problem.changes_per_min, run, place, reference)
        ours.append(point._replace(policy=policy.identity))
        if bounds:
            limits.append(_bound(place, reference, run, [*rivals, ours[-1]], ours[-1]))
    period_s = default_settings().decision_period_s
    how = made_with(f"{place.friction:g}", place.vehicle.idle_drive, 1.0 / _DT_S, period_s)
    return Frontier(place.label, how, tuple(rivals), tuple(ours), tuple(limits))


def margin(point: Point, rivals: Sequence[Point], count: str, saved: str = SAVED) -> float | None:
    """Saving of a point minus the best of its rivals with no more changes, in points; None where there is none.

    `count` and `saved` name the attributes of a point that say how often it changed and what it saved.
    """
    saving = getattr(point, saved)
    if saving is None or not point.held or getattr(point, count) is None:
        return None
    within = getattr(point, count) + 1e-9
    found = [getattr(rival, saved) for rival in rivals if rival.held and getattr(rival, count) <= within]
    best = max((value for value in found if value is not None), default=0.0)
    return float(saving - max(best, 0.0))


def _bound(place: Place, reference: _Reference, ours: Run, others: Sequence[Point], point: Point) -> Point:
    """The best of all schedules tried that change no more often than a point of ours, and of what strategies did."""
    found = [p for p in others if p.saving_percent is not None and p.changes_per_min <= point.changes_per_min + 1e-9]
    period_s = default_settings().decision_period_s
    for run in (reference.run, ours):
        share = preview.schedule(run, period_s, place.vehicle.params, place.friction, point.changes_per_min)
        table = empty_table(schedule=share.tolist())
        found.append(_point("preview", point.setting, drive(place, "preview", table), place, reference))
    best = max(found, key=lambda p: -np.inf if p.saving_percent is None else p.saving_percent)
    return best._replace(strategy="preview", setting=point.setting, policy="")
