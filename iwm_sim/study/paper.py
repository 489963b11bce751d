# SPDX-License-Identifier: Apache-2.0
"""What the paper prints, and what follows from its numbers alone."""

from __future__ import annotations

import functools
import json
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

CYCLES = ("ftp75", "hwfet", "nycc", "udds")
FRICTIONS = (0.9, 0.5, 0.2)

#: Table of each friction.
TABLES = {0.9: 3, 0.5: 4, 0.2: 5}


@functools.cache
def printed() -> dict[str, Any]:
    """The paper's tables 3 to 6 as printed."""
    text = (files("iwm_sim.study") / "assets" / "paper_tables.json").read_text("utf-8")
    content: dict[str, Any] = json.loads(text)
    return content


def cell(cycle: str, friction: float) -> dict[str, float]:
    """Printed ΔSoC of ED, GRDP and SDP, and the printed saving, %."""
    result: dict[str, float] = printed()["delta_soc_percent"][f"{friction:g}"][cycle]
    return result


def as_printed(table: int, cycles: Sequence[str]) -> list[dict[str, Any]]:
    """Rows of one of the paper's tables, 3 to 6, for those of these cycles that it has."""
    known = [cycle for cycle in cycles if cycle in CYCLES]
    if table not in TABLES.values():
        return [{"cycle": cycle, **printed()["table_6"][cycle]} for cycle in known]
    (friction,) = (friction for friction, number in TABLES.items() if number == table)
    rows = []
    for cycle in known:
        depleted = dict(cell(cycle, friction))
        saving = depleted.pop("saving")
        rows.append({"cycle": cycle, "friction": friction, "delta_soc_percent": depleted, "saving_percent": saving})
    return rows


@dataclass(frozen=True)
class Consequences:
    """What the printed numbers imply.

    Attributes
    ----------
    wh_per_km, mean_power_w : of ED at friction 0.9, by cycle
    mean_saving_percent, median_saving_percent : of all cells; one mean is without NYCC at friction 0.2
    largest_misprint_percent : largest difference of a printed saving from the one its ΔSoC give, points
    grdp_beats_ed, cells : number of cells in which the rule is better than equal split, and of all
    """

    wh_per_km: dict[str, float]
    mean_power_w: dict[str, float]
    mean_saving_percent: float
    mean_saving_without_nycc_on_ice_percent: float
    median_saving_percent: float
    largest_misprint_percent: float
    grdp_beats_ed: int
    cells: int
    table_6_repeats_table_3: bool


def consequences(pack_energy_wh: float, distance_m: dict[str, float], mean_speed_mps: dict[str, float]) -> Consequences:
    """What the printed numbers imply for a pack of this energy; distance and mean speed are those of each cycle."""
    cells = {(cycle, friction): cell(cycle, friction) for friction in FRICTIONS for cycle in CYCLES}
    savings = [values["saving"] for values in cells.values()]
    usual = [values["saving"] for key, values in cells.items() if key != ("nycc", 0.2)]
    wh_per_km = {c: cell(c, 0.9)["ED"] / 100.0 * pack_energy_wh / (distance_m[c] / 1000.0) for c in CYCLES}
    return Consequences(
        wh_per_km=wh_per_km,
        mean_power_w={c: wh_per_km[c] * 3.6 * mean_speed_mps[c] for c in CYCLES},
        mean_saving_percent=statistics.fmean(savings),
        mean_saving_without_nycc_on_ice_percent=statistics.fmean(usual),
        median_saving_percent=statistics.median(savings),
        largest_misprint_percent=max(
            abs(100.0 * (1.0 - values["SDP"] / values["ED"]) - values["saving"]) for values in cells.values()
        ),
        grdp_beats_ed=sum(values["GRDP"] < values["ED"] for values in cells.values()),
        cells=len(cells),
        table_6_repeats_table_3=all(
            printed()["table_6"][c]["with_skid_avoidance"] == cell(c, 0.9)["saving"] for c in CYCLES
        ),
    )
