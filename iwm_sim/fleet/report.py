# SPDX-License-Identifier: Apache-2.0
"""A fleet study on one page: saving by car and cycle, its distribution, the worst places; from its rows alone.

A saving counts only where the run and that of equal split held the trace over the same distance (`fair`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from iwm_power_manager.errors import ConfigError
from iwm_power_manager.tools.command import beside_json, write_json, write_picture
from iwm_sim.fleet.store import Store
from iwm_sim.fleet.task import Drive, Road, Solve
from iwm_sim.study.names import REFERENCE
from iwm_sim.study.palette import COLOURS
from iwm_sim.study.report import (
    Block,
    Column,
    Page,
    Picture,
    Pictures,
    Settings,
    Table,
    Text,
    Tile,
    Tiles,
    Verdict,
    format_value,
    write_page,
)
from iwm_sim.study.tables import plain_table

Rows = list[dict[str, Any]]

#: Places in the list of the worst, and cars and cycles in the table before it shows only the extremes.
WORST, MOST_CARS, MOST_CYCLES = 12, 40, 12


class Savings(NamedTuple):
    """A strategy's savings in a study, %: how many places, how many of them fair, and their distribution."""

    strategy: str
    places: int
    fair: int
    mean: float
    lowest: float
    twentieth: float
    median: float
    highest: float
    changes_per_min: float


def savings_of(rows: Rows) -> list[Savings]:
    """The distribution of the savings of each strategy."""
    made = []
    for strategy in dict.fromkeys(row["strategy"] for row in rows if row["strategy"] != REFERENCE):
        driven = [row for row in rows if row["strategy"] == strategy]
        fair = [row for row in driven if row["fair"]]
        saved = np.array([row["saving_percent"] for row in fair]) if fair else np.array([np.nan])
        low, twentieth, median, high = np.quantile(saved, (0.0, 0.05, 0.5, 1.0)).tolist()
        changes = float(np.mean([row["share_changes_per_min"] for row in fair])) if fair else np.nan
        mean = float(saved.mean())
        made.append(Savings(strategy, len(driven), len(fair), mean, low, twentieth, median, high, changes))
    return made


def car_of(row: Mapping[str, Any]) -> str:
    """A row's car with its idle drive."""
    return f"{row['car']}, {row['idle_drive']}"


def by_car_and_cycle(rows: Rows, strategy: str) -> dict[str, dict[str, float]]:
    """Mean saving over the roads, %, by car and cycle; cars by their mean, and of many the lowest and the highest."""
    found: dict[str, dict[str, list[float]]] = {}
    for row in rows:
        if row["strategy"] == strategy:
            cells = found.setdefault(car_of(row), {}).setdefault(row["cycle"], [])
            cells += [row["saving_percent"]] if row["fair"] else []
    means = {
        car: {cycle: float(np.mean(cells)) if cells else np.nan for cycle, cells in cycles.items()}
        for car, cycles in found.items()
    }
    order = sorted(
        means, key=lambda car: np.nanmean([*means[car].values(), -1e3 * np.isnan([*means[car].values()]).all()])
    )
    if len(order) > MOST_CARS:
        order = order[: MOST_CARS // 2] + order[-(MOST_CARS // 2) :]
    return {car: means[car] for car in order}


def distribution(rows: Rows) -> Figure:
    """Share of the fair places with no more saving than that, for each strategy."""
    figure = Figure(figsize=(6.4, 3.6), layout="constrained")
    axis = figure.subplots()
    for strategy, colour in zip([made.strategy for made in savings_of(rows)], COLOURS * 4, strict=False):
        saved = sorted(row["saving_percent"] for row in rows if row["strategy"] == strategy and row["fair"])
        axis.step(saved, 100.0 * np.arange(1, len(saved) + 1) / max(len(saved), 1), color=colour, label=strategy)
    axis.axvline(0.0, color=COLOURS[6], linewidth=0.8)
    axis.set_xlabel("saving against equal split, %")
    axis.set_ylabel("of all places, %")
    axis.grid(alpha=0.3)
    axis.legend(frameon=False)
    return figure


def spread(rows: Rows, strategy: str, group: Callable[[Mapping[str, Any]], str], least: int = 1) -> Figure | None:
    """Every fair saving of a strategy as a point, by group, the groups by their mean; None for too few or too many."""
    found: dict[str, list[float]] = {}
    for row in rows:
        if row["strategy"] == strategy and row["fair"]:
            found.setdefault(group(row), []).append(row["saving_percent"])
    if not least <= len(found) <= MOST_CARS:
        return None
    names = sorted(found, key=lambda name: float(np.mean(found[name])))
    figure = Figure(figsize=(6.4, 1.2 + 0.26 * len(names)), layout="constrained")
    axis = figure.subplots()
    for place, name in enumerate(names):
        axis.plot(found[name], [place] * len(found[name]), "o", color=COLOURS[0], markersize=4, alpha=0.5)
        axis.plot(np.mean(found[name]), place, "|", color=COLOURS[1], markersize=14, markeredgewidth=2)
    axis.axvline(0.0, color=COLOURS[6], linewidth=0.8)
    axis.set_yticks(range(len(names)), names, fontsize=8)
    axis.set_xlabel("saving against equal split, %")
    axis.grid(alpha=0.3, axis="x")
    return figure


_SAVINGS: list[Column[Savings]] = [
    Column("strategy", lambda made: made.strategy),
    Column("places", lambda made: made.places, decimals=0),
    Column("fair", lambda made: made.fair, decimals=0),
    Column("mean", lambda made: made.mean, "%", 3, "saving", "high"),
    Column("worst", lambda made: made.lowest, "%", 3, "saving"),
    Column("lowest twentieth below", lambda made: made.twentieth, "%", 3, "saving"),
    Column("median", lambda made: made.median, "%", 3, "saving"),
    Column("best", lambda made: made.highest, "%", 3, "saving"),
    Column("changes", lambda made: made.changes_per_min, "1/min", 1),
]


def _of(name: str) -> Callable[[Mapping[str, Any]], Any]:
    return lambda row: row[name]


_PLACE: list[Column[Mapping[str, Any]]] = [
    Column("car", _of("car")),
    Column("idle drive", _of("idle_drive")),
    Column("cycle", _of("cycle")),
    Column("friction", _of("friction")),
    Column("strategy", _of("strategy")),
]
_WORST = [
    *_PLACE,
    Column("saving", _of("saving_percent"), "%", 3),
    Column("energy", _of("wh_per_km"), "Wh/km", 1),
    Column("changes", _of("share_changes_per_min"), "1/min", 1),
]
_LOST = [
    *_PLACE,
    Column("trace", lambda row: Verdict(row["trace_held"], "held" if row["trace_held"] else "lost")),
    Column("beyond the band", _of("trace_excess_mps"), "m/s", 2),
    Column("distance", lambda row: row["distance_m"] / 1000.0, "km", 2),
]
_POLICIES: list[Column[Mapping[str, Any]]] = [
    Column("car", _of("car")),
    Column("idle drive", _of("idle_drive")),
    Column("friction", _of("friction")),
    Column("grid", _of("grid")),
    Column("budget", _of("budget_per_min"), "1/min", 1),
    Column("expected", _of("changes_per_min"), "1/min", 2),
    Column("price of a change", _of("price_j"), "J", 2),
    Column("bound", _of("bound_j"), "J", 4),
    Column("converged", lambda row: Verdict(row["converged"], "yes" if row["converged"] else "no")),
]
_ROADS: list[Column[Mapping[str, Any]]] = [
    Column("scenario", _of("scenario")),
    Column("car", car_of),
    Column("strategy", _of("strategy")),
    Column("measure", _of("measure")),
    Column("value", _of("value"), decimals=3),
    Column(
        "required", lambda row: Verdict(row["holds"], "met" if row["holds"] else "aim" if row["aim"] else "not met")
    ),
]


def _cell(cars: Mapping[str, Mapping[str, float]], cycle: str, car: str) -> float | None:
    return cars[car].get(cycle)


def _drive_blocks(rows: Rows, strategy: str) -> list[Block]:
    """Everything about drives; the pictures and the table by car are of the first strategy."""
    compared = [row for row in rows if row["strategy"] != REFERENCE]
    fair = [row for row in compared if row["fair"]]
    cars = by_car_and_cycle(rows, strategy)
    cycles = sorted({cycle for cells in cars.values() for cycle in cells})[:MOST_CYCLES]
    columns: list[Column[Any]] = [Column("car", lambda car: car)]
    columns += [Column(name, partial(_cell, cars, name), "%", 2) for name in cycles]
    pictures = [Picture("How savings are spread.", distribution(rows), "Each step is a place: a car, a cycle, a road.")]
    for group, words in ((car_of, "car"), (_of("cycle"), "cycle")):
        figure = spread(rows, strategy, group, 2)
        if figure:
            pictures.append(Picture(f"By {words}, {strategy}.", figure, "A point is a place, the bar the mean."))
    lost = [row for row in compared if not row["fair"]]
    blocks: list[Block] = [
        Table("Savings", _SAVINGS, savings_of(rows), "Against equal split, where both held the trace."),
        Pictures("Pictures", pictures),
        Table(
            "Saving by car and cycle", columns, list(cars), f"{strategy}, mean over the roads; – where none is fair."
        ),
        Table("Worst places", _WORST, sorted(fair, key=lambda row: row["saving_percent"])[:WORST]),
    ]
    if lost:
        note = "The trace was lost, here or with equal split, or the distances differ: no saving is given."
        blocks.append(Table("Places without a saving", _LOST, lost[:WORST], f"{len(lost)} in all. {note}"))
    return blocks


def page_of(store: Store) -> tuple[Page, list[Savings]]:
    """The page of a study, and its savings.

    Raises
    ------
    ConfigError
        The folder is none of a study, or holds no rows.
    """
    begun = store.begun()
    drives, roads, solves = (store.table(kind).to_pylist() for kind in (Drive, Road, Solve))
    if not (drives or roads or solves):
        raise ConfigError(store.folder, "", "holds no rows", "a folder that fleet drive or fleet solve has filled")
    savings = savings_of(drives)
    places, cars = len({row["key"] for row in drives}), len({car_of(row) for row in drives})
    tiles = [Tile("Places", str(places), "", f"{cars} cars, {len({row['cycle'] for row in drives})} cycles")]
    blocks: list[Block] = []
    if savings:
        first = savings[0]
        fair = f"{first.fair} of {first.places} places"
        tiles.append(Tile("Mean saving", format_value(first.mean, 2), "%", f"{first.strategy}, {fair}"))
        tiles.append(Tile("Worst place", format_value(first.lowest, 2), "%", "of those with a saving"))
    if roads:
        judged = [row for row in roads if not row["aim"]]
        tiles.append(Tile("Requirements met", f"{sum(row['holds'] for row in judged)} of {len(judged)}"))
    if solves:
        tiles.append(Tile("Policies", str(len(solves))))
    blocks = [Tiles(tiles), *(_drive_blocks(drives, savings[0].strategy) if savings else [])]
    if roads:
        ordered = sorted(roads, key=lambda row: (row["scenario"], car_of(row), row["strategy"], row["measure"]))
        blocks.append(Table("Scenarios", _ROADS, ordered))
    if solves:
        note = "Expected are the changes a minute under the policy's own demand."
        blocks.append(Table("Policies", _POLICIES, solves, note))
    blocks.append(Text("Rows, one for each drive, stand in rows/*.parquet beside this page.", "Rows"))
    blocks.append(Settings("Made with", begun["fingerprint"]))
    lead = "Every number is simulated; a saving is given only where both runs held the trace over the same distance."
    return Page("A fleet", lead, blocks, contents_after=0), savings


def make(folder: Path, page: Path, picture: Path | None = None, numbers: str | None = None) -> None:
    """Write the page of a study, its first picture and its numbers, and print the savings."""
    store = Store(folder)
    made, savings = page_of(store)
    write_page(page, made)
    with beside_json(numbers):
        if savings:
            print(plain_table(savings, _SAVINGS))
        print(f"page: {page}")
    if picture:
        write_picture(picture, distribution(store.table(Drive).to_pylist()))
    if numbers:
        write_json(numbers, {"savings": savings})
