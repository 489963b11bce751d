# SPDX-License-Identifier: Apache-2.0
"""The tables of a study, from its numbers alone: a stored study gives the same tables again."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from iwm_sim.study import ablation, battery_fit, paper
from iwm_sim.study.content import PolicyIdentity, Robustness, Study
from iwm_sim.study.criteria import Criterion
from iwm_sim.study.frontier import POINT_COLUMNS
from iwm_sim.study.labels import (
    BOUND,
    ED,
    FREE_BOUND,
    GATE_OFF,
    GATE_TABLE_2,
    GRDP,
    INSTANTANEOUS,
    INSTANTANEOUS_SLIP,
    OURS,
    PAPER_SDP,
    POSSIBLE,
)
from iwm_sim.study.report import Column, Verdict
from iwm_sim.study.rows import Place, Row, by_place, most_saved
from iwm_sim.study.skid import DEMAND_G, Stopped

Cell = dict[str, Row]

#: What each idle drive means.
IDLE_DRIVES = {
    "none": "idle drive none: a motor at zero power costs nothing (eq. 23 as printed)",
    "drag": "idle drive drag: a blocked drive still drags and draws standby power (the physical case)",
}


#: Sections, each a heading above its tables and figures.
TABLES, TABLE_6, PROGRAM = (
    "Tables 3 to 5, beside the paper's",
    "Table 6, as it should have been",
    "Why the paper's program loses here",
)
FRONTIER, BATTERY, SENSITIVITY = (
    "What a change of the share is worth",
    "Battery (eq. 25)",
    "Sensitivity (Fig. 8 to 10)",
)


ABLATION_NOTE = (
    "Saving against equal split and changes of the split by more than 0.25, control at 100 Hz, idle drive none: the "
    "paper's program with one of its choices changed, with some and with all of these, and ours. Each is solved anew. "
    "The paper's program has no price of a change: what it gains one step ahead is paid for in changes."
)


class TableOf(NamedTuple):
    """A table with its place: the section it stands in, and the command that makes it alone."""

    section: str
    title: str
    columns: Sequence[Column[Any]]
    rows: Sequence[Any]
    note: str = ""
    command: str = "make study"


def tables(study: Study) -> list[TableOf]:
    """All tables of a study."""
    return [
        *paper_tables(study.cells, in_order(study)),
        cell_by_cell(study),
        ablation_table(study),
        *table_6([*study.gates, *study.cells]),
        *rivals(study),
        frontier_table(study),
        criteria_table(study),
        stops_table(study),
        *robustness_tables(study),
        battery_table(study),
        sensitivity_table(study),
        implied_table(study),
        policies_table(study),
    ]


def in_order(study: Study) -> list[str]:
    """Cycles as the paper orders them, others behind."""
    others = [name for name in study.cycles if name not in paper.CYCLES]
    return [name for name in paper.CYCLES if name in study.cycles] + others


def _first(by: Cell) -> Row:
    return next(iter(by.values()))


def _delta_soc(label: str) -> Callable[[Cell], float]:
    return lambda by: by[label].metrics.delta_soc_percent


def _saving(label: str) -> Callable[[Cell], float | None]:
    return lambda by: by[label].saving_percent


def _possible(by: Cell) -> float | None:
    return by[BOUND].possible_percent or by[BOUND].saving_percent


def _changes(label: str) -> Callable[[Cell], float]:
    return lambda by: by[label].metrics.share_changes_per_min


def _metric(label: str, name: str) -> Callable[[Cell], Any]:
    return lambda by: getattr(by[label].metrics, name)


def _trace(labels: Iterable[str] | None = None, names: Mapping[str, str] | None = None) -> Column[Cell]:
    """Whether the trace was held by all of these labels, or by all there are; `names` are what the table calls them."""

    def value(by: Cell) -> str:
        lost = [(names or {}).get(label, label) for label in labels or by if not by[label].metrics.trace_held]
        return f"lost: {', '.join(lost)}" if lost else "held"

    return Column("trace", value)


_CYCLE: Column[Cell] = Column("Cycle", lambda by: _first(by).place.cycle)
_FRICTION: Column[Cell] = Column("Friction", lambda by: _first(by).place.friction, decimals=1)


def _sorted(cells: Iterable[Cell]) -> list[Cell]:
    return sorted(cells, key=lambda by: (-_first(by).place.friction, _first(by).place.cycle))


def criteria_table(study: Study) -> TableOf:
    """What was asked for, and whether it is there."""
    columns: tuple[Column[Criterion], ...] = (
        Column("", lambda row: Verdict(row.met, "met" if row.met else "NOT met")),
        Column("Criterion", lambda row: row.text),
        Column("Value", lambda row: row.value),
        Column("Worst in", lambda row: row.where),
    )
    return TableOf("What was asked for", "", columns, study.criteria)


# --- beside the paper -----------------------------------------------------------------------------------------------


def _printed(name: str) -> Callable[[Cell], float | None]:
    def value(by: Cell) -> float | None:
        place = _first(by).place
        return paper.cell(place.cycle, place.friction)[name] if place.cycle in paper.CYCLES else None

    return value


def _as_printed(name: str) -> Callable[[Cell], str | None]:
    """The paper's number with all of its digits: one of them has three."""

    def value(by: Cell) -> str | None:
        number = _printed(name)(by)
        return None if number is None else max(f"{number:.2f}", f"{number:g}", key=len)

    return value


def paper_tables(rows: Sequence[Row], cycles: Sequence[str]) -> Iterator[TableOf]:
    """Tables 3 to 5 beside the paper's."""
    by_cell = by_place(rows)
    columns: tuple[Column[Cell], ...] = (
        _CYCLE,
        *(Column(name, _as_printed(name), "%", 2, group="printed ΔSoC") for name in ("ED", "GRDP", "SDP")),
        Column("saving", _printed("saving"), "%", 2, group="printed"),
        *(Column(label, _delta_soc(label), "%", 3, group="ΔSoC here") for label in (ED, GRDP, PAPER_SDP, OURS)),
        *(Column(label, _saving(label), "%", 2, group="saving here") for label in (GRDP, PAPER_SDP, OURS)),
        Column("possible", _possible, "%", 2, group="saving here"),
        _trace((ED, GRDP, PAPER_SDP, OURS)),
    )
    for friction in paper.FRICTIONS:
        for idle_drive, meaning in IDLE_DRIVES.items():
            places = [Place(cycle, friction, idle_drive) for cycle in cycles]
            yield TableOf(
                TABLES,
                f"Table {paper.TABLES[friction]}: friction {friction:g}, {meaning}",
                columns,
                [by_cell[place] for place in places if place in by_cell],
                "Left as printed, right as driven here. Savings are against ED of the same table. "
                f"Possible: {POSSIBLE}.",
                f"evaluate --paper {paper.TABLES[friction]} --idle-drive {idle_drive}",
            )


class _Both(NamedTuple):
    """A cell of the paper with either idle drive."""

    none: Cell
    drag: Cell


def cell_by_cell(study: Study) -> TableOf:
    """Every printed saving beside what is saved here, with a verdict."""
    by_cell = by_place(study.cells)
    places = [(c, mu) for mu in paper.FRICTIONS for c in in_order(study) if Place(c, mu, "none") in by_cell]
    rows = [
        _Both(by_cell[Place(cycle, friction, "none")], by_cell[Place(cycle, friction, "drag")])
        for cycle, friction in places
        if cycle in paper.CYCLES
    ]
    columns: list[Column[_Both]] = [
        Column("Cycle", lambda row: _CYCLE.value(row.none)),
        Column("Friction", lambda row: _FRICTION.value(row.none), decimals=1),
        Column("ED: printed ΔSoC over ours", lambda row: _ratio(row.none), decimals=2),
        Column("printed saving", lambda row: _printed("saving")(row.none), "%", 2),
    ]
    for idle_drive in IDLE_DRIVES:
        group = f"{idle_drive}:"
        for label, text in ((PAPER_SDP, "paper's problem"), (OURS, "ours")):
            columns.append(Column(text, _of(idle_drive, _saving(label)), "%", 2, group=group))
        columns.append(Column("best of all", _of(idle_drive, most_saved), "%", 2, group=group))
    columns.append(Column("The printed saving", lambda row: verdict(_printed("saving")(row.none), row.none, row.drag)))
    return TableOf(
        "Cell by cell",
        "",
        columns,
        rows,
        "Savings against equal split, each for idle drive none and drag. Best of all: the highest saving of all "
        "strategies driven there, those that know the whole cycle included, however often they change the split.",
    )


def _ratio(by: Cell) -> float | None:
    printed = _printed("ED")(by)
    return None if printed is None else printed / by[ED].metrics.delta_soc_percent


def _of(idle_drive: str, value: Callable[[Cell], float | None]) -> Callable[[_Both], float | None]:
    return lambda row: value(row.none if idle_drive == "none" else row.drag)


def verdict(printed_percent: float | None, none: Cell, drag: Cell) -> str:
    """What can be said of a printed saving, beside the two readings of an idle axle."""
    most_none, most_drag = most_saved(none), most_saved(drag)
    reached = none[PAPER_SDP].saving_percent
    if printed_percent is None or most_none is None or most_drag is None or reached is None:
        return "cannot be compared: the runs covered different distances"
    if printed_percent > most_none:
        first = "is more than any strategy saves here"
    elif printed_percent > most_drag:
        first = "is within reach only if an idle axle costs nothing"
    else:
        first = "is within reach, even with an idle axle that drags"
    if reached >= printed_percent:
        return f"{first}; the paper's problem reaches it"
    if reached > 0.0:
        return f"{first}; the paper's problem saves less"
    return f"{first}; the paper's problem saves nothing here"


def table_6(rows: Sequence[Row]) -> Iterator[TableOf]:
    """Skid avoidance: without, as printed, and ours."""
    by_cell = by_place(rows)
    labels = {GATE_OFF: "without", GATE_TABLE_2: "with Table 2", OURS: "ours"}
    columns: list[Column[Cell]] = [_CYCLE, _FRICTION]
    for name, text, unit, decimals in (
        ("delta_soc_percent", "ΔSoC", "%", 3),
        ("min_slip", "lowest slip", "", 2),
        ("locked_s", "locked", "s", 2),
        ("longest_locked_s", "longest", "s", 2),
        ("rms_jerk_mps3", "jerk", "m/s³", 1),
    ):
        columns += [Column(kind, _metric(label, name), unit, decimals, group=text) for label, kind in labels.items()]
    columns.append(_trace(labels, labels))
    for idle_drive, meaning in IDLE_DRIVES.items():
        yield TableOf(
            TABLE_6,
            meaning,
            columns,
            _sorted(by for place, by in by_cell.items() if place.idle_drive == idle_drive),
            "Without and with: the paper's SDP, its gate off, and on/off as Table 2 prints it. Ours holds the wheel "
            "short of the critical slip and has Table 2 as the last resort. Locked: an axle beyond a slip of -0.2 "
            "above 1 m/s, in all and at a stretch.",
            f"evaluate --paper 6 --idle-drive {idle_drive}",
        )


# --- beyond the paper -----------------------------------------------------------------------------------------------


def ablation_table(study: Study) -> TableOf:
    """What each choice of the paper's program costs."""
    return TableOf(PROGRAM, "", ablation.columns(study.ablation), study.ablation, ABLATION_NOTE, "evaluate --ablation")


def _percent(part: float | None) -> float | None:
    return None if part is None else 100.0 * part


def rivals(study: Study) -> Iterator[TableOf]:
    """Every strategy's saving, and how often it changes the split."""
    by_cell = by_place(study.cells)
    labels = [label for label in next(iter(by_cell.values())) if label != ED]
    slip_aware = [label for label in labels if label.startswith(INSTANTANEOUS_SLIP)]
    prices = {label: label.removeprefix(INSTANTANEOUS_SLIP).strip() for label in slip_aware}
    columns: list[Column[Cell]] = [
        _CYCLE,
        _FRICTION,
        *(
            Column(label, _saving(label), "%", 2, group="saving")
            for label in labels
            if label not in (*prices, BOUND, FREE_BOUND)
        ),
        *(Column(price, _saving(label), "%", 2, group=INSTANTANEOUS_SLIP) for label, price in prices.items()),
        Column("possible", _possible, "%", 2),
        Column("best of all", most_saved, "%", 2),
        Column("ours: part of possible", lambda by: _percent(by[OURS].share_of_possible), "%", 0),
        Column("ours", _changes(OURS), "1/min", 1, group="changes"),
        *(Column(price, _changes(label), "1/min", 1, group="changes") for label, price in prices.items()),
        Column("ours", _metric(OURS, "share_travel_per_min"), "1/min", 1, group="moved"),
        Column("blind", _metric(INSTANTANEOUS, "share_travel_per_min"), "1/min", 1, group="moved"),
        _trace(),
    ]
    for idle_drive, meaning in IDLE_DRIVES.items():
        yield TableOf(
            "Every strategy: saving against equal split",
            meaning,
            columns,
            _sorted(by for place, by in by_cell.items() if place.idle_drive == idle_drive),
            "Saving of battery energy against equal split on the same road; no number where one of them lost the "
            "trace or the distances differ by more than 0.1 %. instantaneous_slip changes the share only to save the "
            f"power shown. Possible: {POSSIBLE}. Best of all: the highest saving of all strategies, with those that "
            "know the whole cycle and change the split at will. Changes: those by more than 0.25; moved is the sum of "
            "all, 1 being all the power; blind is instantaneous.",
        )


def stops_table(study: Study) -> TableOf:
    """Emergency stops."""
    columns: tuple[Column[Stopped], ...] = (
        Column("Friction", lambda row: row.friction, decimals=1),
        Column("Strategy", lambda row: row.strategy),
        Column("Skid avoidance", lambda row: row.gate_mode),
        Column("Distance", lambda row: row.distance_m, "m", 1),
        Column("Best possible", lambda row: row.best_m, "m", 1),
        Column("Longer by", lambda row: row.longer_percent, "%", 1),
        Column("Lowest slip", lambda row: row.min_slip, "", 2),
        Column("Locked", lambda row: row.locked_s, "s", 2),
        Column("Longest", lambda row: row.longest_locked_s, "s", 2),
        Column("RMS jerk", lambda row: row.rms_jerk_mps3, "m/s³", 1),
    )
    return TableOf(
        "Emergency stops from 25 m/s",
        "",
        columns,
        study.stops,
        f"Asked for: {DEMAND_G:g} g throughout, more than any of these roads gives. Best possible: every wheel held "
        "at the one slip that stops shortest, from the equations of motion alone.",
    )


def frontier_table(study: Study) -> TableOf:
    """Saving against changes of the share."""
    frontier = study.frontier
    return TableOf(
        FRONTIER,
        f"{frontier.label}, {frontier.made_with}",
        POINT_COLUMNS,
        frontier.points,
        "instantaneous_slip changes the split only to save the power named; ours is solved anew for each budget of "
        "changes a minute (1000: free). Preview is the bound: the most that is saved with no more changes than ours at "
        "the same budget made, the whole drive known in advance. Moves: the sum of all changes, 1 being all the power.",
        "evaluate --frontier runs/frontier --cycle udds --idle-drive none --budgets 2 4 8 14 1000",
    )


def robustness_tables(study: Study) -> Iterator[TableOf]:
    """Cars, roads and sensors that are not what the policy was solved for."""
    for idle_drive, meaning in IDLE_DRIVES.items():
        rows = [row for row in study.robustness if row.idle_drive == idle_drive]
        columns: tuple[Column[Robustness], ...] = (
            Column("The car, the road, the sensors are", lambda row: row.variant),
            *(Column(name, _in_cycle(name), "saving %", 2) for name in rows[0].saving_percent),
            Column("Changes", lambda row: row.share_changes_per_min, "1/min", 1),
            Column("trace", lambda row: "held" if row.trace_held else "lost"),
        )
        yield TableOf(
            "Robustness",
            meaning,
            columns,
            rows,
            "Saving against equal split of the same car, with the policy solved for the nominal car; driver and law "
            "know of none of the changes. Friction 0.9 where nothing else is said.",
        )


def _in_cycle(name: str) -> Callable[[Robustness], float | None]:
    return lambda row: row.saving_percent[name]


def battery_table(study: Study) -> TableOf:
    """The fitted circuits (eq. 25)."""
    over = " and ".join(study.battery_fit["file"].rmse_by_cycle)
    return TableOf(
        BATTERY,
        "",
        battery_fit.COLUMNS,
        list(study.battery_fit.items()),
        f"The paper's estimate is {battery_fit.PAPER_RESISTANCE_OHM} Ω. RMSE with the 1/N that eq. 25 lacks, over "
        f"{over}.",
        "evaluate --fit-battery",
    )


class _Share(NamedTuple):
    figure: str
    case: str
    share: float


def sensitivity_table(study: Study) -> TableOf:
    """Where the least depletion lies in Fig. 8 to 10."""
    rows = [
        _Share(name.replace("_", " ").capitalize(), label, share)
        for name, cases in study.sensitivity.items()
        for label, share in cases.items()
    ]
    columns: tuple[Column[_Share], ...] = (
        Column("Figure", lambda row: row.figure),
        Column("Case", lambda row: row.case),
        Column("Front share of least depletion", lambda row: row.share, "", 2),
    )
    note = "At shares 0 and 1 of equal slips it is the same. In the figures: full circle, least; open, one axle alone."
    return TableOf(SENSITIVITY, "", columns, rows, note)


def implied_table(study: Study) -> TableOf:
    """What the printed numbers imply."""
    made = study.paper
    rows = [
        *((f"Energy of {cycle} that the printed ΔSoC means, Wh/km", value) for cycle, value in made.wh_per_km.items()),
        *(
            (f"Mean power of {cycle} that it means, kW (the motors have 30)", value / 1000.0)
            for cycle, value in made.mean_power_w.items()
        ),
        ("Mean of the 12 printed savings, %", made.mean_saving_percent),
        ("The same without NYCC at friction 0.2, %", made.mean_saving_without_nycc_on_ice_percent),
        ("Median of the 12, %", made.median_saving_percent),
        ("Largest difference of a printed saving from its ΔSoC, points", made.largest_misprint_percent),
        (f"Cells of {made.cells} in which GRDP beats ED", float(made.grdp_beats_ed)),
    ]
    columns: tuple[Column[tuple[str, float]], ...] = (
        Column("Quantity", lambda row: row[0]),
        Column("Value", lambda row: row[1], decimals=2),
    )
    return TableOf("What the paper's numbers mean", "", columns, rows)


def policies_table(study: Study) -> TableOf:
    """Which policies were used."""
    columns: tuple[Column[tuple[str, PolicyIdentity]], ...] = (
        Column("Used as", lambda row: row[0]),
        Column("Idle drive", lambda row: row[1].idle_drive),
        Column("Friction", lambda row: row[1].friction, decimals=1),
        Column("Grid", lambda row: row[1].grid),
        Column("Price of any change", lambda row: row[1].switching_fixed_cost_j, "J", 0),
        Column("of a whole one", lambda row: row[1].switching_cost_j, "J", 0),
        Column("Checksum", lambda row: row[1].checksum[:12]),
    )
    rows = [(used, policy) for used, policies in study.policies.items() for policy in policies]
    return TableOf("Policies", "", columns, rows)
