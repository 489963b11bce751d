"""The study's tables and figures as one HTML page, as Markdown and as pictures.

Tables come from the study's JSON alone, so that a stored one gives the same tables again; figures need the series too.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from iwm_power_manager.files import atomic_write
from iwm_power_manager.vehicle import VehicleParams
from iwm_sim.metrics import CRITICAL_SLIP
from iwm_sim.study import criteria, figures, paper, sensitivity
from iwm_sim.study.report import Block, Column, Page, Picture, Pictures, Settings, Table, Text, Tile, Tiles, write_page
from iwm_sim.study.report import format_value as shown
from iwm_sim.study.tables import markdown_table

if TYPE_CHECKING:
    from iwm_sim.study.reproduce import Material

Row = Mapping[str, Any]
Content = Mapping[str, Any]

#: Labels of the rows beyond those in `criteria`.
PAPER_SDP = "SDP, paper's problem"
FREE_BOUND = "preview, changes free"
GATE_OFF = "SDP without skid avoidance"
GATE_TABLE_2 = "SDP with Table 2"

TITLE = "A stochastic power split, reproduced and compared"

_IDLE_DRIVES = {
    "none": "idle drive none: a motor at zero power costs nothing (eq. 23 as printed)",
    "drag": "idle drive drag: a blocked drive still drags and draws standby power (the physical case)",
}


class TableOf(NamedTuple):
    """A table with its place: `section` is a heading above the first table of that name."""

    section: str
    title: str
    columns: Sequence[Column]
    rows: Sequence[Row]
    note: str = ""


class Drawn(NamedTuple):
    """A figure with the name of its file."""

    file: str
    title: str
    note: str
    figure: Figure


# --- tables ---------------------------------------------------------------------------------------------------------


def tables(content: Content) -> list[TableOf]:
    """All tables of a study."""
    return [
        _criteria(content),
        *_paper_tables(content),
        _cell_by_cell(content),
        *_table_6(content),
        *_rivals(content),
        _stops(content),
        _frontier(content),
        *_robustness(content),
        _battery(content),
        _sensitivity(content),
        _implied(content),
        _policies(content),
    ]


def _criteria(content: Content) -> TableOf:
    rows = [{**row, "met": "met" if row["met"] else "NOT met"} for row in content["criteria"]]
    columns = (Column("text", "Criterion"), Column("value", "Value"), Column("where", "Where"), Column("met", ""))
    return TableOf("What was asked for", "", columns, rows)


def _paper_tables(content: Content) -> Iterator[TableOf]:
    """Tables 3 to 5 beside the paper's."""
    by_cell = criteria.cells(content["cells"])
    columns = (
        Column("cycle", "Cycle"),
        Column("paper_ED", "paper ED", "ΔSoC %", 2),
        Column("paper_GRDP", "paper GRDP", "ΔSoC %", 2),
        Column("paper_SDP", "paper SDP", "ΔSoC %", 2),
        Column("paper_saving", "paper saving", "%", 2),
        Column("ED", "ED", "ΔSoC %", 3),
        Column("GRDP", "GRDP", "ΔSoC %", 3),
        Column("SDP", "SDP, paper's problem", "ΔSoC %", 3),
        Column("ours", "ours", "ΔSoC %", 3),
        Column("GRDP_saving", "GRDP saving", "%", 2),
        Column("SDP_saving", "SDP saving", "%", 2),
        Column("ours_saving", "our saving", "%", 2),
        Column("bound", "possible", "%", 2),
        Column("trace", "trace"),
    )
    for friction in paper.FRICTIONS:
        for idle_drive, meaning in _IDLE_DRIVES.items():
            rows = []
            for cycle in _cycles(content):
                by = by_cell.get(f"{cycle} {friction:g} {idle_drive}")
                if by is None:
                    continue
                printed = paper.cell(cycle, friction) if cycle in paper.CYCLES else {}
                rows.append(
                    {
                        "cycle": cycle,
                        **{f"paper_{name}": value for name, value in printed.items()},
                        "ED": by[criteria.ED]["delta_soc_percent"],
                        "GRDP": by[criteria.GRDP]["delta_soc_percent"],
                        "SDP": by[PAPER_SDP]["delta_soc_percent"],
                        "ours": by[criteria.OURS]["delta_soc_percent"],
                        "GRDP_saving": by[criteria.GRDP]["saving_percent"],
                        "SDP_saving": by[PAPER_SDP]["saving_percent"],
                        "ours_saving": by[criteria.OURS]["saving_percent"],
                        "bound": by[criteria.BOUND]["saving_percent"],
                        "trace": _traces(by[name] for name in (criteria.ED, criteria.GRDP, PAPER_SDP, criteria.OURS)),
                    }
                )
            title = f"Table {paper.TABLES[friction]}: friction {friction:g}, {meaning}"
            yield TableOf("Tables 3 to 5, beside the paper's", title, columns, rows)


def _traces(rows: Iterator[Row]) -> str:
    lost = [str(row["label"]) for row in rows if not row["trace_held"]]
    return f"lost: {', '.join(lost)}" if lost else "held"


def _cell_by_cell(content: Content) -> TableOf:
    """Every printed saving beside what is possible here, with a verdict."""
    by_cell = criteria.cells(content["cells"])
    rows = []
    for friction in paper.FRICTIONS:
        for cycle in _cycles(content):
            none, drag = (by_cell.get(f"{cycle} {friction:g} {idle_drive}") for idle_drive in _IDLE_DRIVES)
            if cycle not in paper.CYCLES or none is None or drag is None:
                continue
            printed = paper.cell(cycle, friction)
            rows.append(
                {
                    "cycle": cycle,
                    "friction": friction,
                    "ratio": printed["ED"] / none[criteria.ED]["delta_soc_percent"],
                    "printed": printed["saving"],
                    "SDP none": none[PAPER_SDP]["saving_percent"],
                    "ours none": none[criteria.OURS]["saving_percent"],
                    "bound none": none[FREE_BOUND]["saving_percent"],
                    "SDP drag": drag[PAPER_SDP]["saving_percent"],
                    "ours drag": drag[criteria.OURS]["saving_percent"],
                    "bound drag": drag[FREE_BOUND]["saving_percent"],
                    "verdict": _verdict(printed["saving"], none, drag),
                }
            )
    columns = (
        Column("cycle", "Cycle"),
        Column("friction", "Friction", "", 1),
        Column("ratio", "ED: printed ΔSoC over ours", "", 2),
        Column("printed", "printed saving", "%", 2),
        *(
            Column(f"{kind} {idle_drive}", f"{label}, {idle_drive}", "%", 2)
            for idle_drive in _IDLE_DRIVES
            for kind, label in (("SDP", "paper's problem"), ("ours", "ours"), ("bound", "possible"))
        ),
        Column("verdict", "The printed saving"),
    )
    return TableOf(
        "Cell by cell",
        "",
        columns,
        rows,
        "Savings against equal split, each for idle drive none and drag. Possible: with the whole cycle known and "
        "changes of the split free.",
    )


def _verdict(printed_percent: float, none: Mapping[str, Row], drag: Mapping[str, Row]) -> str:
    possible_none, possible_drag = (by[FREE_BOUND]["saving_percent"] for by in (none, drag))
    reached = none[PAPER_SDP]["saving_percent"]
    if possible_none is None or possible_drag is None or reached is None:
        return "cannot be compared: the runs covered different distances"
    if printed_percent > possible_none:
        first = "is more than any split can save here"
    elif printed_percent > possible_drag:
        first = "is possible only if an idle axle costs nothing"
    else:
        first = "is possible, even with an idle axle that drags"
    if reached >= printed_percent:
        return f"{first}; the paper's problem reaches it"
    if reached > 0.0:
        return f"{first}; the paper's problem saves less"
    return f"{first}; the paper's problem saves nothing here"


def _table_6(content: Content) -> Iterator[TableOf]:
    by_cell = criteria.cells([*content["gates"], *content["cells"]])
    labels = {"off": GATE_OFF, "table2": GATE_TABLE_2, "ours": criteria.OURS}
    names = {"off": "without", "table2": "with Table 2", "ours": "ours"}
    columns = [Column("cycle", "Cycle"), Column("friction", "Friction", "", 1)]
    for key, label, unit, decimals in (
        ("delta_soc_percent", "ΔSoC", "%", 3),
        ("min_slip", "lowest slip", "", 2),
        ("locked_s", "locked", "s", 2),
        ("longest_locked_s", "longest", "s", 2),
        ("rms_jerk_mps3", "jerk", "m/s³", 1),
    ):
        columns += [Column(f"{key} {kind}", f"{label} {names[kind]}", unit, decimals) for kind in labels]
    for idle_drive, meaning in _IDLE_DRIVES.items():
        rows = []
        for by in by_cell.values():
            first = by[GATE_OFF]
            if first["idle_drive"] == idle_drive:
                row = {"cycle": first["cycle"], "friction": first["friction"]}
                for kind, label in labels.items():
                    for column in columns[2:]:
                        key, _, of = column.key.partition(" ")
                        if of == kind:
                            row[column.key] = by[label][key]
                rows.append(row)
        rows.sort(key=lambda row: (-row["friction"], row["cycle"]))
        yield TableOf(
            "Table 6, as it should have been",
            meaning,
            columns,
            rows,
            "Without and with: the paper's SDP, its gate off, and on/off as Table 2 prints it. Ours holds the wheel "
            "short of the critical slip and has Table 2 as the last resort. Locked: an axle beyond a slip of -0.2 "
            "above 1 m/s, in all and at a stretch.",
        )


def _rivals(content: Content) -> Iterator[TableOf]:
    by_cell = criteria.cells(content["cells"])
    labels = [label for label in next(iter(by_cell.values())) if label != criteria.ED]
    columns = [Column("cycle", "Cycle"), Column("friction", "Friction", "", 1)]
    columns += [Column(label, label, "%", 2, best="") for label in labels]
    columns += [
        Column("part", "ours of possible", "", 2),
        Column("changes", "changes ours", "1/min", 1),
        *(Column(f"changes {label}", f"changes {label}", "1/min", 1) for label in labels if "slip" in label),
        Column("trace", "trace"),
    ]
    for idle_drive, meaning in _IDLE_DRIVES.items():
        rows = []
        for by in by_cell.values():
            ours = by[criteria.OURS]
            if ours["idle_drive"] != idle_drive:
                continue
            rows.append(
                {
                    "cycle": ours["cycle"],
                    "friction": ours["friction"],
                    **{label: by[label]["saving_percent"] for label in labels},
                    "part": ours["share_of_possible"],
                    "changes": ours["share_changes_per_min"],
                    **{f"changes {label}": by[label]["share_changes_per_min"] for label in labels if "slip" in label},
                    "trace": _traces(iter(by.values())),
                }
            )
        rows.sort(key=lambda row: (-row["friction"], row["cycle"]))
        yield TableOf(
            "Every strategy: saving against equal split",
            meaning,
            columns,
            rows,
            "Saving of battery energy against equal split on the same road; no number where the distances differ by "
            "more than 0.1 %. Preview knows the whole cycle; its changes of the share have the price they have in our "
            "policy, or none.",
        )


def _stops(content: Content) -> TableOf:
    columns = (
        Column("friction", "Friction", "", 1),
        Column("strategy", "Strategy"),
        Column("gate_mode", "Skid avoidance"),
        Column("distance_m", "Distance", "m", 1),
        Column("best_m", "Best possible", "m", 1),
        Column("longer_percent", "Longer by", "%", 1),
        Column("min_slip", "Lowest slip", "", 2),
        Column("locked_s", "Locked", "s", 2),
        Column("longest_locked_s", "Longest", "s", 2),
        Column("rms_jerk_mps3", "RMS jerk", "m/s³", 1),
    )
    return TableOf(
        "Emergency stops from 25 m/s",
        "",
        columns,
        content["stops"],
        "Best possible: every wheel held at the one slip that stops shortest, from the equations of motion alone.",
    )


def _frontier(content: Content) -> TableOf:
    frontier = content["frontier"]
    columns = (
        Column("family", "Strategy"),
        Column("price", "Price of a change"),
        Column("saving_percent", "Saving", "%", 3),
        Column("share_changes_per_min", "Changes of the share", "1/min", 1),
    )
    return TableOf(
        "What a change of the share is worth",
        f"{frontier['cycle']}, friction {frontier['friction']:g}, idle drive none",
        columns,
        [row for row in frontier["rows"] if row["family"] != criteria.ED],
        "The price of instantaneous_slip is the power a change has to save; that of preview and ours is a cost per "
        "change. Ours: the shipped policy with its price multiplied at run time.",
    )


def _robustness(content: Content) -> Iterator[TableOf]:
    for idle_drive, meaning in _IDLE_DRIVES.items():
        rows = [row for row in content["robustness"] if row["idle_drive"] == idle_drive]
        names = [key for key in rows[0] if key not in ("variant", "idle_drive", "trace_held", "share_changes_per_min")]
        columns = (
            Column("variant", "The car, the road, the sensors are"),
            *(Column(name, name, "saving %", 2) for name in names),
            Column("share_changes_per_min", "Changes", "1/min", 1),
            Column("held", "trace"),
        )
        yield TableOf(
            "Robustness",
            meaning,
            columns,
            [{**row, "held": "held" if row["trace_held"] else "lost"} for row in rows],
            "Saving against equal split of the same car, with the policy solved for the nominal car; driver and law "
            "know of none of the changes. Friction 0.9 where nothing else is said.",
        )


def _battery(content: Content) -> TableOf:
    fit = content["battery_fit"]
    names = {
        "nominal": "R fitted at the nominal voltage",
        "plant": "R fitted at the plant's mean voltage",
        "free": "R and voltage fitted",
        "file": "as in the vehicle's file",
    }
    rows = [
        {
            "circuit": text,
            "resistance_ohm": fit[key]["resistance_ohm"],
            "voltage_v": fit[key]["voltage_v"],
            "rmse": 100.0 * fit[key]["rmse"],
        }
        for key, text in names.items()
    ]
    columns = (
        Column("circuit", "Control model"),
        Column("resistance_ohm", "Resistance", "Ω", 4),
        Column("voltage_v", "Voltage", "V", 2),
        Column("rmse", "RMSE", "% SoC", 5),
    )
    return TableOf(
        "Battery (eq. 25)",
        "",
        columns,
        rows,
        f"The paper's estimate is {fit['paper_resistance_ohm']} Ω. RMSE with the 1/N that eq. 25 lacks, over "
        f"{' and '.join(fit['file']['rmse_by_cycle'])}.",
    )


def _sensitivity(content: Content) -> TableOf:
    rows = [
        {"figure": name.replace("_", " ").capitalize(), "case": label, "share": share}
        for name, cases in content["sensitivity"].items()
        for label, share in cases.items()
    ]
    columns = (
        Column("figure", "Figure"),
        Column("case", "Case"),
        Column("share", "Front share of least depletion", "", 2),
    )
    return TableOf(
        "Sensitivity (Fig. 8 to 10)", "", columns, rows, "At shares 0 and 1 of equal slips the depletion is the same."
    )


def _implied(content: Content) -> TableOf:
    made = content["paper"]
    rows = [
        {"claim": f"Energy of {cycle} that the printed ΔSoC means, Wh/km", "value": value}
        for cycle, value in made["wh_per_km"].items()
    ]
    rows += [
        {"claim": f"Mean power of {cycle} that it means, kW (the motors have 30)", "value": value / 1000.0}
        for cycle, value in made["mean_power_w"].items()
    ]
    rows += [
        {"claim": "Mean of the 12 printed savings, %", "value": made["mean_saving_percent"]},
        {
            "claim": "The same without NYCC at friction 0.2, %",
            "value": made["mean_saving_without_nycc_on_ice_percent"],
        },
        {"claim": "Median of the 12, %", "value": made["median_saving_percent"]},
        {
            "claim": "Largest difference of a printed saving from its ΔSoC, points",
            "value": made["largest_misprint_percent"],
        },
        {"claim": f"Cells of {made['cells']} in which GRDP beats ED", "value": float(made["grdp_beats_ed"])},
    ]
    return TableOf(
        "What the paper's numbers mean", "", (Column("claim", "Quantity"), Column("value", "Value", "", 2)), rows
    )


def _policies(content: Content) -> TableOf:
    rows = [
        {**policy, "used": used, "checksum": policy["checksum"][:12]}
        for used, policies in content["policies"].items()
        for policy in policies
    ]
    columns = (
        Column("used", "Used as"),
        Column("idle_drive", "Idle drive"),
        Column("friction", "Friction", "", 1),
        Column("grid", "Grid"),
        Column("switching_fixed_cost_j", "Price of any change", "J", 0),
        Column("switching_cost_j", "of a whole one", "J", 0),
        Column("checksum", "Checksum"),
    )
    return TableOf("Policies", "", columns, rows)


def _cycles(content: Content) -> list[str]:
    names = list(content["cycles"])
    return [name for name in paper.CYCLES if name in names] + [name for name in names if name not in paper.CYCLES]


# --- figures --------------------------------------------------------------------------------------------------------


def drawn(content: Content, material: Material, vehicle: VehicleParams) -> list[Drawn]:
    """All figures of a study."""
    window = material.window
    ed, ours = window[criteria.ED], window[criteria.OURS]
    demand = material.rule.power_demand_w
    line_w = np.linspace(demand.min(), demand.max(), 400)
    result = [
        Drawn(
            "figure_07_battery",
            "Figure 7: plant and control model",
            "Speed and state of charge, equal split; the control model has a static circuit, fitted.",
            figures.model_comparison(*material.battery.comparison),
        ),
        Drawn(
            "figure_08_speed",
            "Figure 8: depletion over the split, by speed",
            f"Demand {sensitivity.FIG_8_DEMAND_W / 1000:g} kW, both slips 0.01.",
            figures.depletion_over_split(sensitivity.figure_8(vehicle)),
        ),
        Drawn(
            "figure_09_slip",
            "Figure 9: depletion over the split, by front slip",
            f"{sensitivity.FIG_9_SPEED_MPS:g} m/s, demand {sensitivity.FIG_9_DEMAND_W / 1000:g} kW at the wheels, rear "
            "slip 0.01.",
            figures.depletion_over_split(sensitivity.figure_9(vehicle)),
        ),
        Drawn(
            "figure_10_demand",
            "Figure 10: depletion over the split, by demand",
            f"{sensitivity.FIG_10_SPEED_MPS:g} m/s, both slips 0.01.",
            figures.depletion_over_split_panels(sensitivity.figure_10(vehicle)),
        ),
        Drawn(
            "figure_12_convergence",
            "Figure 12: policy iteration",
            "The paper's problem, friction 0.9: change of the policy in each iteration, and the proven distance from "
            "the optimal cost-to-go.",
            figures.policy_convergence(*material.convergence),
        ),
        Drawn(
            "transition_matrix",
            "Demand as a Markov chain",
            "Transition matrix of the paper's problem, a step of 0.1 s, from FTP-75, HWFET and NYCC.",
            figures.transition_matrix(*material.chain),
        ),
        Drawn(
            "figure_13_rule",
            "Figure 13: the generalized rule",
            "Dynamic programming on FTP-75, friction 0.9, and the line fitted to it.",
            figures.fitted_rule(
                demand, material.rule.front_share * demand, line_w, _rule_power(material.rule.coefficients, line_w)
            ),
        ),
    ]
    time_s = ed["time_s"]
    span = (float(time_s[0]), float(time_s[-1]))
    result += [
        Drawn(
            "figure_14_powers",
            "Figure 14: powers of the axles",
            "Friction 0.2, idle drive none.",
            figures.axle_powers(
                time_s,
                [
                    figures.SplitRun("ED", ed["front_power_w"], ed["rear_power_w"]),
                    figures.SplitRun("ours", ours["front_power_w"], ours["rear_power_w"]),
                ],
                span,
            ),
        ),
        Drawn(
            "figure_15_slips",
            "Figure 15: slips with and without skid avoidance",
            "Friction 0.2, idle drive none: the paper's SDP without skid avoidance, and ours.",
            figures.slips(
                time_s,
                [
                    figures.SlipRun("without", window[GATE_OFF]["front_slip"], window[GATE_OFF]["rear_slip"]),
                    figures.SlipRun("ours", ours["front_slip"], ours["rear_slip"]),
                ],
                CRITICAL_SLIP,
                span,
            ),
        ),
        Drawn(
            "frontier",
            "What a change of the share is worth",
            f"{content['frontier']['cycle']}, friction {content['frontier']['friction']:g}, idle drive none: saving "
            "over changes of the share by more than 0.25, along the price of a change.",
            figures.switching_frontier(_families(content)),
        ),
    ]
    return result


def _rule_power(rule: Sequence[float], demand_w: np.ndarray) -> np.ndarray:
    """Front power of the rule, as the law applies it (the share stays within 0..1)."""
    line = np.where(demand_w > 0.0, rule[0] + rule[1] * demand_w, rule[2] + rule[3] * demand_w)
    return np.clip(line, np.minimum(demand_w, 0.0), np.maximum(demand_w, 0.0))


def _families(content: Content) -> dict[str, tuple[list[float], list[float]]]:
    families: dict[str, tuple[list[float], list[float]]] = {}
    for row in content["frontier"]["rows"]:
        if row["family"] != criteria.ED and row["saving_percent"] is not None:
            changes, saving = families.setdefault(row["family"], ([], []))
            changes.append(row["share_changes_per_min"])
            saving.append(row["saving_percent"])
    return families


# --- files ----------------------------------------------------------------------------------------------------------


def write(output: Path, content: Content, pictures: Sequence[Drawn]) -> None:
    """Write page, Markdown tables and pictures into a folder."""
    for picture in pictures:
        stream = io.BytesIO()
        picture.figure.savefig(stream, format="svg", facecolor="white", metadata={"Date": None})
        atomic_write(output / "figures" / f"{picture.file}.svg", stream.getvalue())
    atomic_write(output / "study.md", (f"# {TITLE}\n\n{lead(content)}\n\n{markdown(content)}\n").encode())
    write_page(output / "study.html", page(content, pictures))


def lead(content: Content) -> str:
    """The sentence to take away."""
    ours = [row for row in content["cells"] if row["label"] == criteria.OURS and row["trace_held"]]
    parts = []
    for idle_drive in _IDLE_DRIVES:
        savings = [
            row["saving_percent"]
            for row in ours
            if row["idle_drive"] == idle_drive and row["saving_percent"] is not None
        ]
        if savings:
            parts.append(
                f"{min(savings):.2f} to {max(savings):.2f} % (mean {np.mean(savings):.2f} %) with idle drive "
                f"{idle_drive}"
            )
    met = sum(row["met"] for row in content["criteria"])
    return (
        f"Against equal split, our policy saves {' and '.join(parts)}; {met} of {len(content['criteria'])} criteria "
        "are met."
    )


def markdown(content: Content) -> str:
    """All tables in Markdown."""
    parts = []
    section = ""
    for table in tables(content):
        if table.section != section:
            section = table.section
            parts.append(f"## {section}")
            if table.note:
                parts.append(table.note)
        if table.title:
            parts.append(f"**{table.title}**")
        parts.append(markdown_table(table.rows, table.columns))
    return "\n\n".join(parts)


def page(content: Content, pictures: Sequence[Drawn]) -> Page:
    """The study as a page."""
    blocks: list[Block] = [Tiles(_tiles(content))]
    section = ""
    for table in tables(content):
        title = table.section if table.section != section else ""
        section = table.section
        if title and table.title:
            blocks.append(Text(table.note or table.title, title))
            blocks.append(Table(table.title, table.columns, table.rows))
        else:
            blocks.append(Table(title or table.title, table.columns, table.rows, "" if table.title else table.note))
    blocks.append(Pictures("Figures", [Picture(made.title, made.figure, made.note) for made in pictures]))
    blocks.append(
        Settings(
            "Settings",
            {
                "version": content["package_version"],
                "car": content["vehicle"],
                "strategy of ours": content["strategy"],
                **{f"car's hash, idle drive {name}": value for name, value in content["vehicle_hashes"].items()},
                **content["settings"],
            },
        )
    )
    return Page(TITLE, lead(content), blocks)


def _tiles(content: Content) -> list[Tile]:
    ours = [row for row in content["cells"] if row["label"] == criteria.OURS]
    tiles = []
    for idle_drive in _IDLE_DRIVES:
        savings = [row["saving_percent"] for row in ours if row["idle_drive"] == idle_drive and row["trace_held"]]
        known = [value for value in savings if value is not None]
        tiles.append(
            Tile(
                f"Saving, idle drive {idle_drive}",
                shown(float(np.mean(known)) if known else None, 2),
                "%",
                f"{len(known)} cells, against equal split",
            )
        )
    changes = max(row["share_changes_per_min"] for row in ours)
    locked = max(row["longest_locked_s"] for row in ours)
    limited = [stop["longer_percent"] for stop in content["stops"] if stop["gate_mode"] == "limiter"]
    return [
        *tiles,
        Tile("Front share", shown(changes, 1), "/ min", "changes at most"),
        Tile("Beyond −0.2 slip", shown(locked, 2), "s", "at a stretch, at most"),
        Tile("Emergency stop", shown(max(limited), 1), "%", "longer than the best, at worst"),
    ]
