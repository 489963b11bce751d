# SPDX-License-Identifier: Apache-2.0
"""Numbers in documents: what stands between two markers of a Markdown page is made, not typed.

`<!-- study: NAME -->` ... `<!-- end -->` is filled from the stored study by the function of that name in `BLOCKS`;
`<!-- run: COMMAND -->` ... `<!-- end -->` holds what the command printed, below the command. `scripts/docs_numbers`
fills both. What takes too long, or another machine, stands between `<!-- measured: COMMAND -->` and `<!-- end -->`: by
hand, and the marker says what prints it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable

from iwm_power_manager.control.budget import DEAREST, bucket
from iwm_power_manager.control.settings import DEFAULTS
from iwm_power_manager.policy import load_policy
from iwm_power_manager.share import share_path
from iwm_sim.study import labels, paper
from iwm_sim.study.answers import answers, savings
from iwm_sim.study.content import Study
from iwm_sim.study.plan import IDLE_DRIVES
from iwm_sim.study.report import Column, format_value
from iwm_sim.study.rows import Place, Row, by_place
from iwm_sim.study.study_tables import in_order
from iwm_sim.study.tables import markdown_table

_BLOCK = re.compile(r"<!-- (study|run|measured): (.+?) -->\n(.*?)<!-- end -->", re.DOTALL)

#: The strongest simple rival, at the price it has by default.
RIVAL = f"{labels.INSTANTANEOUS_SLIP} {DEFAULTS.switching_power_w:g} W"


def filled(text: str, study: Study, run: Callable[[str], str] | None = None) -> str:
    """A page with its blocks filled; those of commands only where there is a `run`, which gives what one printed."""

    def block(match: re.Match[str]) -> str:
        kind, name, old = match.groups()
        if kind == "measured":
            return match.group(0)
        if kind == "study":
            new = BLOCKS[name](study)
        elif run is not None:
            new = f"```\n$ {name}\n{run(name).rstrip()}\n```"
        else:
            new = old.strip()
        return f"<!-- {kind}: {name} -->\n{new.strip()}\n<!-- end -->"

    return _BLOCK.sub(block, text)


def commands(text: str) -> list[tuple[str, str]]:
    """Commands of a page's blocks, and what stands there."""
    return [(name, content) for kind, name, content in _BLOCK.findall(text) if kind == "run"]


def measurements(text: str) -> list[str]:
    """Commands that print what a page holds by hand."""
    return [name for kind, name, _ in _BLOCK.findall(text) if kind == "measured"]


def without_blocks(text: str) -> str:
    """A page without what is filled."""
    return _BLOCK.sub("", text)


def savings_table(study: Study) -> str:
    """The README's table: friction 0.9, both idle drives."""
    by_cell = by_place(study.cells)
    friction = paper.FRICTIONS[0]
    places = [Place(cycle, friction, idle) for idle in IDLE_DRIVES for cycle in in_order(study)]
    rows = [by_cell[place] for place in places if place in by_cell]

    def saving(label: str) -> Callable[[dict[str, Row]], float | None]:
        return lambda by: by[label].saving_percent

    def changes(by: dict[str, Row]) -> str:
        pair = (by[label].metrics.share_changes_per_min for label in (labels.OURS, RIVAL))
        return " / ".join(format_value(value, 1) for value in pair)

    columns: list[Column[dict[str, Row]]] = [
        Column("cycle", lambda by: by[labels.ED].place.cycle),
        Column("idle drive", lambda by: by[labels.ED].place.idle_drive),
        Column("ours (`sdp_lookahead`)", saving(labels.OURS), decimals=2),
        Column("possible with its budget of changes", saving(labels.BOUND), decimals=2),
        Column(f"`{RIVAL}`", saving(RIVAL), decimals=2),
        Column("changes a minute: ours / that rival", changes),
        Column("the paper's program here (`paper_sdp`)", saving(labels.PAPER_SDP), decimals=2),
        Column("the paper prints", lambda by: paper.cell(by[labels.ED].place.cycle, friction)["saving"], decimals=2),
    ]
    return (
        "Battery energy saved against equal split, %, friction 0.9, control at 100 Hz; every run held the trace "
        f"(`make study`, [docs/study.json](docs/study.json)):\n\n{markdown_table(rows, columns)}"
    )


def summary(study: Study) -> str:
    """The answers as a list."""
    return "\n".join(f"- **{made.question}** {made.answer}" for made in answers(study))


def energy(study: Study) -> str:
    """What the car needs, beside what the paper's numbers mean."""
    needs = [row.metrics.wh_per_km for row in study.cells if row.label == labels.ED]
    wh = study.paper.wh_per_km.values()
    return (
        f"- **The paper's ΔSoC are not reproducible in absolute terms**: they imply {min(wh):.0f} to {max(wh):.0f} "
        f"Wh/km, on HWFET a mean power that its motors cannot give. This car needs {min(needs):.0f} to "
        f"{max(needs):.0f} Wh/km, by cycle "
        "and road."
    )


def by_friction(study: Study) -> str:
    """How the saving goes with friction."""
    parts = []
    for idle_drive in IDLE_DRIVES:
        saved = savings(study, labels.OURS, idle_drive)
        means = []
        for friction in paper.FRICTIONS:
            values = [value for place, value in saved.items() if place.friction == friction]
            means.append(f"{sum(values) / len(values):.2f} % at {friction:g}")
        parts.append(f"with idle drive {idle_drive} {', '.join(means)}")
    return f"Our mean saving over the cycles, by friction: {'; '.join(parts)}."


def policies(study: Study) -> str:
    """Whether the stored numbers are those of the shipped policies."""
    driven = {policy.checksum for policy in study.policies[labels.OURS]}
    shipped = {load_policy(path).checksum for path in sorted(share_path("policies").glob("*.npz"))}
    if driven <= shipped:
        return "These numbers were driven with the shipped policies."
    return (
        "**The shipped policies are newer than these numbers**, which were driven with those whose checksums stand in "
        "`docs/study.json`; `make study` drives the shipped ones."
    )


def trials(_: Study) -> str:
    """Prices that were tried for the shipped policy on a dry road, and what a full bucket of changes may cost."""
    policy = load_policy(share_path("policies/jalalmaab_2015_drag_coupled_mu090.npz"))
    tried = "".join(f"{trial.price_j:.4g}: {trial.changes_per_min:<8.3g}" for trial in policy.trials)
    problem = policy.problem
    rise = math.log(DEAREST) / bucket(problem.changes_per_min)
    loss_j = problem.changes_per_min * problem.switching_cost_j * rise / 4.0
    return (
        f"Of the shipped policy (idle drive drag, friction {policy.friction:g}, {policy.identity}; all trials are in "
        f"the file; b x price x a / 4, see below, is {loss_j:.1f} J a minute):\n\n"
        f"```\nprice of a change, J: changes a minute\n  {tried.rstrip()}\n```"
    )


def policies_named(text: str) -> set[str]:
    """Policies that a page's text names by grid and checksum, as results do: the first eight digits of each."""
    named = r"(?:\bcoupled |\bpolic(?:y|ies) (?:coupled )?)((?:[0-9a-f]{8,64}(?:, (?:coupled )?)?)+)"
    return {word[:8] for found in re.findall(named, text) for word in re.findall(r"[0-9a-f]{8,64}", found)}


BLOCKS: dict[str, Callable[[Study], str]] = {
    "savings": savings_table,
    "summary": summary,
    "energy": energy,
    "by friction": by_friction,
    "policies": policies,
    "trials": trials,
}
