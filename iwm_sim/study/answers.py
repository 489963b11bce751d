# SPDX-License-Identifier: Apache-2.0
"""What a study says, in sentences made from its numbers: does the paper hold, what does better, where nothing helps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from iwm_sim.study import labels, paper
from iwm_sim.study.content import Study
from iwm_sim.study.report import format_value
from iwm_sim.study.rows import Place, Row, by_place, most_saved

#: Where no strategy saves as much as this, %, nothing helps.
LITTLE_PERCENT = 0.15


class Answer(NamedTuple):
    """A question of the reader's, and what the numbers say."""

    question: str
    answer: str


def answers(study: Study) -> list[Answer]:
    """The study's answers, from its numbers alone."""
    return [
        Answer("Does the paper hold?", _holds(study)),
        Answer("Does its program save energy here?", _program(study)),
        Answer("What does better?", _better(study)),
        Answer("Where does nothing help?", _nothing(study)),
    ]


def savings(study: Study, label: str, idle_drive: str) -> dict[Place, float]:
    """What a strategy saves against equal split, %, wherever both may be compared."""
    return {
        row.place: row.saving_percent
        for row in study.cells
        if row.label == label
        and row.place.idle_drive == idle_drive
        and row.metrics.trace_held
        and row.saving_percent is not None
    }


def _holds(study: Study) -> str:
    printed = {
        (cycle, friction): paper.cell(cycle, friction)["saving"]
        for friction in paper.FRICTIONS
        for cycle in paper.CYCLES
        if cycle in study.cycles
    }
    cells = by_place(study.cells)
    reached = {}
    for idle_drive in ("none", "drag"):
        found = {key: most_saved(cells.get(Place(*key, idle_drive), {})) for key in printed}
        reached[idle_drive] = sum(best is not None and best >= printed[key] for key, best in found.items())
    made = study.paper
    wh = made.wh_per_km.values()
    without = made.mean_saving_without_nycc_on_ice_percent
    return (
        f"Not in its numbers. Of its {len(printed)} printed savings, {reached['none']} are within reach of some "
        f"strategy here if an idle axle costs nothing, {reached['drag']} if it drags. Their mean of "
        f"{made.mean_saving_percent:.2f} % hangs on one cell, NYCC on ice; without that it is {without:.2f} %. Its "
        f"depletions mean {min(wh):.0f} to {max(wh):.0f} Wh/km, on HWFET "
        "a mean power that its motors cannot give. Its idea holds: letting one axle rest saves energy where an idle "
        "axle costs little, and "
        "avoiding skids ends locked wheels."
    )


def _saving(study: Study, place: Place, label: str) -> float | None:
    row: Row | None = by_place(study.cells).get(place, {}).get(label)
    return row.saving_percent if row else None


def _program(study: Study) -> str:
    found = [value for idle in ("none", "drag") for value in savings(study, labels.PAPER_SDP, idle).values()]
    gains = sum(value > 0.0 for value in found)
    by = {row.program: row for row in study.ablation}
    printed = by[labels.PAPER_SDP].saving_percent
    place = next(iter(printed))
    ahead = by.get("look-ahead")
    alone = ahead.saving_percent[place] if ahead else None
    text = (
        f"As printed, on its grid ({labels.PAPER_SDP}), it saves in {gains} of {len(found)} cells "
        f"({format_value(min(found), 2)} to {format_value(max(found), 2)} %)."
    )
    if ahead and alone is not None:
        text += (
            f" What costs it most is interpolating shares between grid points: one step ahead on the same cost-to-go "
            f"saves {format_value(alone, 2)} % instead of {format_value(printed[place], 2)} %, at "
            f"{ahead.changes_per_min[place]:.0f} changes of "
            f"the split a minute ({place}, idle drive none)."
        )
    return text


def _better(study: Study) -> str:
    parts = []
    for idle_drive in ("none", "drag"):
        saved = list(savings(study, labels.OURS, idle_drive).values())
        if saved:
            mean = float(np.mean(saved))
            parts.append(f"{min(saved):.2f} to {max(saved):.2f} % (mean {mean:.2f} %) with idle drive {idle_drive}")
    ours = [row for row in study.cells if row.label == labels.OURS]
    changes = max(row.metrics.share_changes_per_min for row in ours)
    met = sum(criterion.met for criterion in study.criteria)
    return (
        f"Against equal split, our policy saves {' and '.join(parts)}, at {changes:.1f} changes of the split a minute "
        f"at most; {met} of the study's {len(study.criteria)} criteria are met. {_rival(study)}"
    )


def _rival(study: Study) -> str:
    ahead = [
        blind - ours
        for idle_drive in ("none", "drag")
        for place, ours in savings(study, labels.OURS, idle_drive).items()
        if (blind := _saving(study, place, labels.INSTANTANEOUS)) is not None
    ]
    better = [value for value in ahead if value > 0.0]
    if not better:
        return "No simple rival is ahead anywhere."
    return (
        "A blind search for the least power now (`instantaneous`), free to change as often as it likes, is ahead in "
        f"{len(better)} of {len(ahead)} cells by up to {max(better):.2f} points and behind by up to {-min(ahead):.2f} "
        "in the others."
    )


def _nothing(study: Study) -> str:
    most = {place: saving for place, cell in by_place(study.cells).items() if (saving := most_saved(cell)) is not None}
    little: dict[str, list[str]] = {}
    for place, saving in most.items():
        if place.idle_drive == "drag" and saving < LITTLE_PERCENT:
            little.setdefault(place.cycle, []).append(f"{place.friction:g}")
    none, drag = (
        [saving for place, saving in most.items() if place.idle_drive == idle_drive] for idle_drive in ("none", "drag")
    )
    where = ""
    if little:
        places = " and ".join(f"{cycle} at friction {', '.join(frictions)}" for cycle, frictions in little.items())
        where = f"With an idle axle that drags, no strategy saves {LITTLE_PERCENT} % on {places}. "
    return (
        f"{where}The best of all strategies, those that know the whole cycle and change the split at will included, "
        f"saves {min(drag):.2f} to {max(drag):.2f} % with idle drive drag, {min(none):.2f} to {max(none):.2f} % with "
        "none: what an idle axle costs decides more than the strategy does."
    )


#: Words of the study's tables.
WORDS = {
    "ED, equal": "equal distribution: half of the demand to each axle",
    "GRDP, rule": "the paper's generalized rule: straight lines fitted to dynamic programming on FTP-75",
    "paper_sdp": "the paper's stochastic program on the paper's grid, decided every 0.1 s",
    "paper_sdp_ungated, paper_sdp_table2": "the same without skid avoidance, and with it as Table 2 prints it",
    "ours": "strategy sdp_lookahead: one step ahead on the cost-to-go of grid coupled, decided every 0.02 s",
    "preview": "dynamic programming with the whole cycle known in advance; its budget or price of changes is beside it",
    "possible": labels.POSSIBLE,
    "instantaneous": "least battery power now; instantaneous_slip counts slip and load transfer, and a change has to "
    "save the power named beside it",
    "share": "front power over power demand, 0..1; a change of it by more than 0.25 counts",
    "saving": "energy drawn from the cells, less than equal split's, %; only where both held the trace and drove the "
    "same distance (0.1 %)",
    "trace": "the cycle's speed over time; held: within 2 mph inside 1 s (EPA)",
    "idle drive": "what a motor at zero torque costs: none, or drag of magnets and standby",
    "ΔSoC": "fall of the state of charge, %",
    "slip": "eq. 10 of the paper: -1 is a locked wheel",
    "gate": "holds an axle at zero torque while its slip is beyond the critical one (Table 2)",
}
