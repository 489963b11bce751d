# SPDX-License-Identifier: Apache-2.0
"""Why the paper's program loses: what each of its choices costs, changed alone and all together.

The base is `paper_sdp`. Each change is one setting of its grid, or how the policy is used; the problem is
solved anew and driven. The single changes were named before any of them was driven, which two belong together after.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from iwm_power_manager.solve import load_grid
from iwm_sim.study import cases, labels
from iwm_sim.study.cases import Case
from iwm_sim.study.driving import Progress, drive_all
from iwm_sim.study.plan import STRATEGY, Policies, grid_file, variant
from iwm_sim.study.policies import solved
from iwm_sim.study.report import Column
from iwm_sim.study.rows import Place, by_place, rows_of
from iwm_sim.study.variants import VARIANTS


class Step(NamedTuple):
    """A change of the paper's program.

    Attributes
    ----------
    meaning : what becomes of what
    settings : of the grid, by name
    strategy : "" leaves interpolation in the table
    """

    meaning: str
    settings: Mapping[str, Any] = {}
    strategy: str = ""


#: Fine where it matters: at low speed, and near no slip.
_SPEEDS_MPS = (0, 0.1, 0.5, 1, 1.5, 2, 2.5, 3, 4, 5, 6, 7, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30, 33, 36)
_SLIPS = {"mirrored": (0, 0.004, 0.012, 0.03, 0.06, 0.1, 0.15, 0.21, 0.35, 1)}

STEPS = {
    "speed grid": Step("4 speeds become 26", {"speed_mps": _SPEEDS_MPS}),
    "slip grid": Step("11 slips an axle become 19", {"slip_front": _SLIPS, "slip_rear": _SLIPS}),
    "error at the road": Step("power error at the wheel becomes that at the road", {"power_error": "road"}),
    "size of the error": Step("the squared power error becomes its size", {"error_norm": "absolute"}),
    "alpha": Step("the weight of the power error, 2, becomes 20", {"alpha": 20.0}),
    "gamma": Step("discount 0.98 becomes 0.99", {"discount": 0.99}),
    "look-ahead": Step("one step ahead on the cost-to-go instead of interpolating shares", {}, "sdp_lookahead"),
}
#: Steps taken together: the two that help most alone, the grids with them, and all.
TOGETHER = {
    "speed grid, look-ahead": ("speed grid", "look-ahead"),
    "speed and slip grid, look-ahead": ("speed grid", "slip grid", "look-ahead"),
    "all of these": tuple(STEPS),
}

#: Where the variants are driven, idle drive none (that of the paper's eq. 23).
PLACES = (("nycc", 0.9), ("udds", 0.9), ("nycc", 0.2), ("udds", 0.2))


@dataclass(frozen=True)
class Ablated:
    """A program: what it saves against equal split, and how often it changes the split, both by place.

    `saving_percent` is None where the runs cannot be compared, as `Row.saving_percent` says.
    """

    program: str
    meaning: str
    saving_percent: dict[str, float | None]
    changes_per_min: dict[str, float]


def ablation(
    policies: Policies,
    folder: Path,
    jobs: int,
    say: Callable[[str], None],
    places: Sequence[tuple[str, float]] = PLACES,
    quiet: bool = True,
) -> list[Ablated]:
    """Solve and drive every variant; grids go to a folder, policies are kept in the user's cache.

    Parameters
    ----------
    policies : of the car
    folder : for the grids
    jobs : processes
    say : told of everything that is solved
    places : cycles with frictions
    quiet : no progress bar
    """
    wanted: list[Case] = []
    for cycle, friction in places:
        base = Case(cycle, policies.vehicle, "none", friction, "equal")
        wanted += [
            replace(base, label=labels.ED),
            variant(base, labels.PAPER_SDP, policies),
            *(_changed(base, name, [name], policies, folder, say) for name in STEPS),
            *(_changed(base, name, steps, policies, folder, say) for name, steps in TOGETHER.items()),
            replace(base, strategy=STRATEGY, label=labels.OURS, policy=policies.ours("none", friction)),
        ]
    with Progress(len(wanted), quiet) as progress:
        by = by_place(rows_of(drive_all(wanted, jobs, progress.done)))
    driven = {
        f"{cycle} {friction:g}": by[Place(cycle, friction, "none")]
        for cycle, friction in ((cases.cycle_of(path).name, friction) for path, friction in places)
    }
    meanings = {
        labels.PAPER_SDP: VARIANTS[labels.PAPER_SDP].meaning,
        **{name: step.meaning for name, step in STEPS.items()},
        **dict.fromkeys(TOGETHER, "together"),
        labels.OURS: "slip settled in the step, previous share a state, moves priced, demand by speed, of a driver, "
        "decided every 0.02 s",
    }
    return [
        Ablated(
            program,
            meaning,
            {place: cell[program].saving_percent for place, cell in driven.items()},
            {place: cell[program].metrics.share_changes_per_min for place, cell in driven.items()},
        )
        for program, meaning in meanings.items()
    ]


def _changed(
    base: Case, label: str, names: Sequence[str], policies: Policies, folder: Path, say: Callable[[str], None]
) -> Case:
    """The paper's strategy with some steps taken, solved on a grid of its own."""
    paper_grid = VARIANTS[labels.PAPER_SDP].grid
    settings: dict[str, Any] = {}
    for name in names:
        settings |= STEPS[name].settings
    problem = load_grid(paper_grid, policies.car(base.idle_drive).params)
    file = grid_file(folder, "_".join(label.replace("-", " ").split()), problem, settings)
    strategy = next((STEPS[name].strategy for name in names if STEPS[name].strategy), "")
    case = VARIANTS[labels.PAPER_SDP].case(base, label)
    if not strategy or len(names) > 1:
        policy = solved(policies.car(base.idle_drive), base.friction, str(file), say)
    else:
        policy = policies.of_variant(labels.PAPER_SDP, base.idle_drive, base.friction)
    return replace(case, strategy=strategy or case.strategy, policy=policy)


def columns(rows: Sequence[Ablated]) -> list[Column[Ablated]]:
    """The table's columns: saving and changes of the split for each place."""

    def of(values: str, place: str) -> Callable[[Ablated], float | None]:
        return lambda row: getattr(row, values)[place]

    places = rows[0].saving_percent
    return [
        Column("program", lambda row: row.program),
        *(Column(place, of("saving_percent", place), "%", 2, group="saving") for place in places),
        *(Column(place, of("changes_per_min", place), "1/min", 1, group="changes") for place in places),
        Column("what it is", lambda row: row.meaning),
    ]
