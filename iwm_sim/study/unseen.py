# SPDX-License-Identifier: Apache-2.0
"""Frontiers of drives and cars that nobody chose: what our strategy is worth there, said with its worst cells.

One setting for all: the default budget, the default grid, policies solved from the same three cycles as the shipped
ones. A cell is one car, cycle, road and noise. `judge` turns cells into a distribution of margins, for each way of
counting changes; cells whose trace was lost count as such and have no margin.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from iwm_power_manager import __version__
from iwm_power_manager.policy import load_policy
from iwm_power_manager.vehicle import Vehicle
from iwm_sim.study import generate
from iwm_sim.study.cases import drawn_car, vehicle_of
from iwm_sim.study.frontier import COUNTS, SAVED, SAVED_PER_KM, SWINGS, Frontier, Place, margin, measure_frontier
from iwm_sim.study.names import DEFAULT_GRID, DEFAULT_POLICY
from iwm_sim.study.policies import PolicySource, solved
from iwm_sim.study.report import Column
from iwm_sim.study.tables import plain_table

#: Points of saving ours may be below a rival with no more changes, and the part of the cells in which it is to be so.
CLOSE, PART = 0.005, 0.95
WORST = 0.03
FRICTIONS = (0.9, 0.5, 0.2)
NOISE_KMH = (0.0, 0.05, 0.1, 0.2)
CAR_CYCLES = 3


class Cell(NamedTuple):
    """What to drive: seeds, road and noise, which travel to a worker process; car -1 is the vehicle itself."""

    vehicle: str
    idle_drive: str
    car: int
    cycle: int
    friction: float
    noise_kmh: float | None

    @property
    def label(self) -> str:
        """What tables call it."""
        car = Path(self.vehicle).stem if self.car < 0 else f"car {self.car}"
        noise = "" if self.noise_kmh is None else f", logged with {self.noise_kmh:g} km/h, foot shaking"
        return f"{car}, cycle {self.cycle}, friction {self.friction:g}{noise}"


def cells(vehicle: str, idle_drive: str, first_seed: int, cycles: int, cars: int) -> list[Cell]:
    """Generated cycles on a car and on generated cars, on three roads in turn, each without and with noise."""
    made = [(-1, first_seed + k, FRICTIONS[k % 3], NOISE_KMH[k % 4]) for k in range(cycles)]
    for k in range(cars):
        made += [
            (first_seed + k, first_seed + CAR_CYCLES * k + i, FRICTIONS[(k + i) % 3], NOISE_KMH[(k + i) % 4])
            for i in range(CAR_CYCLES)
        ]
    return [
        Cell(vehicle, idle_drive, car, cycle, friction, noise)
        for car, cycle, friction, rms in made
        for noise in (None, rms)
    ]


def car_of(cell: Cell) -> Vehicle:
    """The car of a cell."""
    if cell.car < 0:
        return vehicle_of(cell.vehicle, cell.idle_drive)
    return drawn_car(cell.car, cell.vehicle, cell.idle_drive)


def place_of(cell: Cell) -> Place:
    """Car, trace and road of a cell."""
    cycle = generate.cycle(cell.cycle)
    if cell.noise_kmh is None:
        return Place(cell.label, car_of(cell), cycle, cell.friction)
    logged = generate.logged(cycle, cell.noise_kmh, cell.cycle)
    return Place(cell.label, car_of(cell), logged, cell.friction, noise_seed=cell.cycle)


def drive_cell(cell: Cell) -> Frontier:
    """The rivals, and ours at the default budget, on one cell."""
    place = place_of(cell)
    policy = load_policy(PolicySource(DEFAULT_POLICY, DEFAULT_GRID).find(place.vehicle, cell.friction))
    return measure_frontier(place, [policy])


def budgets_of(place: Place, budgets: Sequence[float]) -> Frontier:
    """The rivals, and ours solved for each budget, on one place, with the bound of each."""
    found = (solved(place.vehicle, place.friction, DEFAULT_GRID, budget_per_min=budget) for budget in budgets)
    return measure_frontier(place, list(map(load_policy, found)), bounds=True)


class Verdict(NamedTuple):
    """Margins of all cells in one way of counting, in points of saving."""

    counted: str
    cells: int
    mean: float
    lowest_twentieth: float
    worst: float
    part_close: float

    @property
    def reached(self) -> bool:
        """Whether the target is: close in nearly all cells, never far below, above on average."""
        return self.part_close >= PART and self.worst >= -WORST and self.mean > 0.0


def judge(frontiers: Sequence[Frontier], counts: Sequence[str] = COUNTS, saved: str = SAVED) -> list[Verdict]:
    """The distribution of the margins, for each way of counting changes."""
    verdicts = []
    for count in counts:
        found = [margin(point, f.rivals, count, saved) for f in frontiers for point in f.ours]
        known = np.array([value for value in found if value is not None])
        if known.size:
            low = float(np.quantile(known, 0.05))
            close = float(np.mean(known >= -CLOSE))
            verdicts.append(Verdict(count, known.size, float(known.mean()), low, float(known.min()), close))
    return verdicts


class Kind(NamedTuple):
    """What ours saves in the cells of one kind, %, and its margin in the first way of counting, points.

    Attributes
    ----------
    name : car, road, and whether the trace was logged with noise
    cells : with a held trace
    mean, low, high, worst : saving; 90 % of the cells are between `low` and `high`
    margin, worst_margin : mean and least
    """

    name: str
    cells: int
    mean: float
    low: float
    high: float
    worst: float
    margin: float
    worst_margin: float


KIND_COLUMNS: tuple[Column[Kind], ...] = (
    Column("drives", lambda row: row.name),
    Column("cells", lambda row: row.cells, decimals=0),
    Column("mean", lambda row: row.mean, "%", 2, group="our saving:"),
    Column("5 % below", lambda row: row.low, "%", 2, group="our saving:"),
    Column("5 % above", lambda row: row.high, "%", 2, group="our saving:"),
    Column("worst", lambda row: row.worst, "%", 2, group="our saving:"),
    Column("mean", lambda row: row.margin, "points", 3, group="less the best rival's:"),
    Column("worst", lambda row: row.worst_margin, "points", 3, group="less the best rival's:"),
)


def kind_of(label: str) -> str:
    """Kind of a cell, by its label."""
    parts = label.split(", ")  # car, cycle, friction, and of a logged one more
    return "drawn cars" if label.startswith("car ") else f"{parts[0]}, {'logged' if len(parts) > 3 else parts[-1]}"


def kinds(frontiers: Sequence[Frontier]) -> list[Kind]:
    """Savings and margins of ours by kind of cell, those of all last."""
    by_name: dict[str, list[tuple[float, float]]] = {}
    for f in frontiers:
        for point in f.ours:
            value = margin(point, f.rivals, COUNTS[0])
            if value is not None and point.saving_percent is not None:
                for name in (kind_of(f.label), "all"):
                    by_name.setdefault(name, []).append((point.saving_percent, value))
    found = []
    for name in sorted(by_name, key=lambda name: (name == "all", name)):
        saving, margins = np.array(by_name[name]).T
        low, high = np.quantile(saving, (0.05, 0.95))
        numbers = (saving.mean(), low, high, saving.min(), margins.mean(), margins.min())
        found.append(Kind(name, saving.size, *map(float, numbers)))
    return found


def report(frontiers: Sequence[Frontier], worst: int = 10) -> str:
    """The verdicts and the worst cells, as text."""
    lost = sum(not point.held for f in frontiers for point in f.ours)
    lines = [
        f"{len(frontiers)} cells, {lost} of them without a held trace or an equal split that held it",
        common(frontiers),
    ]
    lines += [
        f"{verdict.counted}: {verdict.cells} cells, margin mean {verdict.mean:+.3f}, lowest twentieth below "
        f"{verdict.lowest_twentieth:+.3f}, worst {verdict.worst:+.3f} points; no more than {CLOSE:g} below in "
        f"{verdict.part_close:.1%}; target {'reached' if verdict.reached else 'NOT reached'}"
        for verdict in judge(frontiers)
    ]
    beside = [(verdict, "") for verdict in judge(frontiers, (SWINGS,))]
    beside += [(verdict, " and by Wh/km") for verdict in judge(frontiers, saved=SAVED_PER_KM)]
    lines += [
        f"{verdict.counted}{how}, no part of the target: worst {verdict.worst:+.3f} points; no more than {CLOSE:g} "
        f"below in {verdict.part_close:.1%}"
        for verdict, how in beside
    ]
    known = [(margin(f.ours[0], f.rivals, COUNTS[0]), f) for f in frontiers]
    ranked = sorted(((m, f) for m, f in known if m is not None), key=lambda pair: pair[0])
    lines.append(
        "saving against equal split, and less that of the best rival with no more changes (by more than 0.25)\n"
        + plain_table(kinds(frontiers), KIND_COLUMNS)
    )
    lines.append("worst cells: margin, saving %, changes/min, busiest minute")
    for value, f in ranked[:worst]:
        point = f.ours[0]
        lines.append(
            f"{value:+.3f}  {point.saving_percent:.3f}  {point.changes_per_min:.1f}  {point.busiest_minute}  {f.label}"
        )
    return "\n".join(lines)


def common(frontiers: Sequence[Frontier]) -> str:
    """What all cells have in common, with the policies; of drawn cars, which have some each, their number."""
    common = dict.fromkeys(f.made_with.partition(", ")[2] for f in frontiers)
    drawn = {(f.label.startswith("car "), point.policy) for f in frontiers for point in f.ours}
    own = sorted(policy for of_drawn, policy in drawn if not of_drawn)
    of_cars = [f"{len(drawn) - len(own)} of drawn cars, each solved for its own"] if len(drawn) > len(own) else []
    return f"{'; '.join(common)}; policies: {', '.join(own + of_cars)}"


def to_json(frontiers: Sequence[Frontier]) -> dict[str, Any]:
    """Everything measured."""
    return {
        "package_version": __version__,
        "verdicts": [verdict._asdict() | {"reached": verdict.reached} for verdict in judge(frontiers)],
        "swings": judge(frontiers, (SWINGS,)),
        "per_km": judge(frontiers, saved=SAVED_PER_KM),
        "kinds": kinds(frontiers),
        "cells": frontiers,
    }
