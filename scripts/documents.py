# SPDX-License-Identifier: Apache-2.0
"""Numbers in documents: what stands between two markers of a Markdown page is made by a command, not typed.

Between `<!-- KIND: NAME -->` and `<!-- end -->` stands, by its kind,

- study, unseen: what the function of that name in `STUDY` or `UNSEEN` says of docs/study.json or docs/unseen.json;
- measured: the table that a benchmark makes of the JSON it left beside the page (`MEASURED`);
- run: a command and what it printed;
- slow: the same of what takes minutes: it is run only where it is asked for.

`scripts/docs_numbers` fills all of them.
"""

from __future__ import annotations

import json
import math
import operator
import re
import runpy
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from iwm_power_manager.control.budget import THERE_AND_BACK, buckets
from iwm_power_manager.control.settings import DEFAULTS
from iwm_power_manager.mdp.budget import elasticity_of
from iwm_power_manager.policy import load_policy
from iwm_power_manager.share import share_path
from iwm_power_manager.tools.command import plain
from iwm_sim.study import labels, paper, unseen
from iwm_sim.study.answers import answers, savings
from iwm_sim.study.content import Study
from iwm_sim.study.frontier import COUNTS, SAVED_PER_KM, SWINGS, Frontier, margin
from iwm_sim.study.plan import IDLE_DRIVES
from iwm_sim.study.report import Column, format_value
from iwm_sim.study.rows import Place, Row, by_place
from iwm_sim.study.study_tables import in_order
from iwm_sim.study.tables import markdown_table

_BLOCK = re.compile(r"<!-- (study|unseen|measured|run|slow): (.+?) -->\n(.*?)<!-- end -->", re.DOTALL)
_ROOT = Path(__file__).resolve().parents[1]

#: The strongest simple rival, at the price it has by default.
RIVAL = f"{labels.INSTANTANEOUS_SLIP} {DEFAULTS.switching_power_w:g} W"


class Stored(NamedTuple):
    """What long runs left: the study, and `unseen_summary` of `evaluate --unseen`."""

    study: Study
    unseen: dict[str, Any]

    @classmethod
    def load(cls) -> Stored:
        """What docs/ holds."""
        unseen = json.loads((_ROOT / "docs" / "unseen.json").read_text(encoding="utf-8"))
        return cls(Study.load(_ROOT / "docs" / "study.json"), unseen)


def filled(text: str, stored: Stored, run: Callable[[str], str] | None = None, slow: bool = False) -> str:
    """A page with its blocks filled; those of commands only where there is a `run`, which gives what one printed."""

    def block(match: re.Match[str]) -> str:
        kind, name, old = match.groups()
        if kind == "measured":
            new = MEASURED[name]()
        elif kind in ("run", "slow"):
            here = run is not None and (kind == "run" or slow)
            new = f"```\n$ {name}\n{run(name).rstrip()}\n```" if run is not None and here else old
        else:
            new = STUDY[name](stored.study) if kind == "study" else UNSEEN[name](stored.unseen)
        return f"<!-- {kind}: {name} -->\n{new.strip()}\n<!-- end -->"

    return _BLOCK.sub(block, text)


def commands(text: str) -> list[tuple[str, str]]:
    """Commands of a page's blocks, and what stands there."""
    return [(name, content) for kind, name, content in _BLOCK.findall(text) if kind in ("run", "slow")]


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
    elasticity = elasticity_of(policy.trials, problem.switching_cost_j, problem.changes_per_min)
    spread = elasticity * (buckets(problem.changes_per_min).lasting - THERE_AND_BACK) ** 2
    loss_j = problem.changes_per_min * problem.switching_cost_j * math.pi**2 / (8.0 * spread)
    return (
        f"Of the shipped policy (idle drive drag, friction {policy.friction:g}, {policy.identity}; all trials are in "
        f"the file; e, see below, is {elasticity:.2f}, and b x price x pi^2 / (8 e B^2) {loss_j:.2f} J a minute):\n\n"
        f"```\nprice of a change, J: changes a minute\n  {tried.rstrip()}\n```"
    )


def policies_named(text: str) -> set[str]:
    """Policies that a page's text names by grid and checksum, as results do: the first eight digits of each."""
    named = r"(?:\bcoupled |\bpolic(?:y|ies) (?:coupled )?)((?:[0-9a-f]{8,64}(?:, (?:coupled )?)?)+)"
    return {word[:8] for found in re.findall(named, text) for word in re.findall(r"[0-9a-f]{8,64}", found)}


STUDY: dict[str, Callable[[Study], str]] = {
    "savings": savings_table,
    "summary": summary,
    "energy": energy,
    "by friction": by_friction,
    "policies": policies,
    "trials": trials,
}


# --- drives and cars that nobody chose -------------------------------------------------------------------------------


def unseen_summary(frontiers: Sequence[Frontier]) -> dict[str, Any]:
    """What the pages say of `evaluate --unseen`, as plain values."""
    judged = []
    for f in frontiers:
        margins = [value for count in COUNTS if (value := margin(f.ours[0], f.rivals, count)) is not None]
        if margins:
            judged.append((f, f.ours[0], margins))
    worst = sorted(judged, key=lambda cell: cell[2][0])[:10]
    alone = [cell for cell in judged if not _has_rival(cell[0])]
    drawn = [cell for cell in alone if cell[0].label.startswith("car ")]
    found = {
        "made_with": unseen.common(frontiers),
        "first_seed": min(int(re.findall(r"cycle (\d+)", f.label)[0]) for f in frontiers),
        "cells": len(frontiers),
        "judged": len(judged),
        "alone": len(alone),
        "alone_drawn": len(drawn),
        "busiest_minute": max(point.busiest_minute for _, point, _ in judged),
        "part_above_10": sum(point.changes_per_min > 10.0 for _, point, _ in judged) / len(judged),
        "behind_equal_points": [-saved for _, point, _ in judged if (saved := point.saving_percent or 0.0) < 0.0],
        "far_behind": [sum(row[2][k] < -unseen.WORST for row in judged) for k in range(len(COUNTS))],
        "most_changes_per_min": max(point.changes_per_min for _, point, _ in judged),
        "verdicts": [verdict._asdict() | {"reached": verdict.reached} for verdict in unseen.judge(frontiers)],
        "swings": unseen.judge(frontiers, (SWINGS,)),
        "per_km": unseen.judge(frontiers, saved=SAVED_PER_KM),
        "kinds": unseen.kinds(frontiers),
        "with_rivals": _margins([cell[2] for cell in judged if _has_rival(cell[0])]),
        "close_by_kind": {
            name: _margins([cell[2] for cell in judged if name in (unseen.kind_of(cell[0].label), "all")])
            for name in [kind.name for kind in unseen.kinds(frontiers)]
        },
        "papers_car": _margins([cell[2] for cell in judged if not cell[0].label.startswith("car ")]),
        "worst": [[margins[0], point.saving_percent, point.changes_per_min, f.label] for f, point, margins in worst],
    }
    papers_car = frontiers[0].label.partition(",")[0]
    renamed: dict[str, Any] = json.loads(json.dumps(plain(found, 6)).replace(papers_car, "paper's car"))
    return renamed


def _has_rival(f: Frontier) -> bool:
    """Whether any threshold changes the split no more often than ours."""
    most = f.ours[0].changes_per_min + 1e-9
    return any(r.held and r.saving_percent is not None and r.changes_per_min <= most for r in f.rivals)


def _margins(rows: Sequence[Sequence[float]]) -> dict[str, Any]:
    """Of the first way of counting; and the part that is close, in each."""
    first = [row[0] for row in rows]
    close = [sum(value >= -unseen.CLOSE for value in column) / len(rows) for column in zip(*rows, strict=True)]
    numbers = {"mean": statistics.fmean(first), "median": statistics.median(first), "worst": min(first)}
    return {"cells": len(rows), "behind": sum(value < -unseen.CLOSE for value in first), "close": close, **numbers}


def unseen_answer(found: dict[str, Any]) -> str:
    """The question and its answer."""
    whole = found["kinds"][-1]
    return (
        "- **What is it worth where nobody chose the drive?** On generated cycles and drawn cars that were not there "
        f"when the policy was made, our policy saves {whole['mean']:.2f} % in the mean against equal split, "
        f"{format_value(whole['worst'], 2)} % at worst; at the same number of changes the best simple rival saves "
        f"{whole['margin']:.3f} points less in the mean, and {-whole['worst_margin']:.3f} more at worst "
        f"({found['made_with'].partition(', control')[0]})."
    )


def unseen_kinds(found: dict[str, Any]) -> str:
    """Savings and margins by kind of cell."""
    table = markdown_table([unseen.Kind(**kind) for kind in found["kinds"]], unseen.KIND_COLUMNS)
    return (
        f"`evaluate --unseen runs/unseen --seeds {found['first_seed']}`: generated cycles on the paper's car, as they "
        f"are or logged with noise, and drawn cars with three cycles each "
        f"({found['made_with']}): battery energy saved against equal split, and that less the saving of the best rival "
        "(`instantaneous_slip` at any threshold, `instantaneous`, equal split) with no more changes of the split:\n\n"
        f"{table}\n\n{found['cells'] - found['judged']} of {found['cells']} cells do not count: the trace was lost. In "
        f"{found['alone']} ({found['alone_drawn']} of them drawn cars) every rival changes more often, so that only "
        "equal split is left and the margin is our whole saving. Ours is at most "
        f"{unseen.CLOSE:g} points behind in {100 * found['verdicts'][0]['part_close']:.1f} % of the cells. With a "
        f"budget of 8 changes a minute, {100 * found['part_above_10']:.0f} % of the drives, which are short, have more "
        f"than 10 changes a minute, at most {found['most_changes_per_min']:.1f}; the busiest minute "
        f"has {found['busiest_minute']}."
    )


def unseen_verdicts(found: dict[str, Any]) -> str:
    """The judgement, with what to know before its mean is read."""
    rivals, own = found["with_rivals"], found["papers_car"]
    swings = "".join(
        f" Counting swings out of a band of 0.25, the worst margin is {row['worst']:+.3f}, and "
        f"{100.0 * row['part_close']:.1f} % are at most {unseen.CLOSE:g} behind."
        for row in found.get("swings", ())  # a file of before they were counted has none
    )
    per_km = found.get("per_km", ())  # likewise
    if per_km:
        worst = " / ".join(f"{row['worst']:+.3f}" for row in per_km)
        close = " / ".join(f"{100.0 * row['part_close']:.1f}" for row in per_km)
        swings += (
            " By energy for a kilometre, which does not count against a car that it followed a trace better where the "
            f"road is too slippery for it, the worst are {worst}, and {close} % are close."
        )
    columns: list[Column[dict[str, Any]]] = [
        Column("changes counted", lambda row: _COUNTED[row["counted"]]),
        Column("cells", lambda row: row["cells"], decimals=0),
        Column("mean", lambda row: row["mean"], "points", 3, group="margin:"),
        Column("lowest twentieth below", lambda row: row["lowest_twentieth"], "points", 3, group="margin:"),
        Column("worst", lambda row: row["worst"], "points", 3, group="margin:"),
        Column(f"at most {unseen.CLOSE:g} behind", lambda row: 100.0 * row["part_close"], "%", 1),
        Column("aim", lambda row: "reached" if row["reached"] else "not reached"),
    ]
    return (
        f"{markdown_table(found['verdicts'], columns)}\n\n"
        f"{found['cells'] - found['judged']} of {found['cells']} cells do not count: equal split or ours lost the "
        f"trace there ({found['made_with']}).\n\n"
        f"**Read the mean with care.** In {found['alone']} of the {found['judged']} cells every threshold up to 200 W "
        "changes more often than ours, so that only equal split is left to compare with, and the margin is our whole "
        f"saving. In the other {rivals['cells']} cells: mean {rivals['mean']:+.3f}, median {rivals['median']:+.3f}, "
        f"worst {rivals['worst']:+.3f}, {100 * rivals['close'][0]:.1f} % at most {unseen.CLOSE:g} behind. The paper's "
        f"car alone: {own['cells']} cells, mean {own['mean']:+.3f}, median {own['median']:+.3f}, "
        f"{100 * own['close'][0]:.1f} %.{swings} More than {unseen.WORST:g} behind are "
        f"{' / '.join(map(str, found['far_behind']))} cells by the three counts; behind equal split itself "
        f"{len(found['behind_equal_points'])}, by {max(found['behind_equal_points'], default=0.0):.3f} at most."
    )


def unseen_worst(found: dict[str, Any]) -> str:
    """The worst cells, and how many of each kind are behind."""
    worst: list[Column[list[Any]]] = [
        Column("margin", lambda row: row[0], "points", 3),
        Column("saving", lambda row: row[1], "%", 3),
        Column("changes", lambda row: row[2], "1/min", 1),
        Column("cell", lambda row: row[3]),
    ]
    kinds: list[Column[tuple[str, dict[str, Any]]]] = [
        Column("kind", lambda row: row[0]),
        Column("cells", lambda row: row[1]["cells"], decimals=0),
        Column("> 0.25", lambda row: 100.0 * row[1]["close"][0], "%", 1),
        Column("> 0.05", lambda row: 100.0 * row[1]["close"][1], "%", 1),
        Column("moves", lambda row: 100.0 * row[1]["close"][2], "%", 1),
        Column("behind, in the first count", lambda row: row[1]["behind"], decimals=0),
    ]
    return (
        "The worst cells, with the saving and the changes a minute of ours:\n\n"
        f"{markdown_table(found['worst'], worst)}\n\n"
        f"By kind of cell, at most {unseen.CLOSE:g} behind when changes by more than 0.25, by more than 0.05, and all "
        f"moves are counted:\n\n{markdown_table(list(found['close_by_kind'].items()), kinds)}"
    )


_COUNTED = dict(zip(COUNTS, ("by more than 0.25", "by more than 0.05", "sum of moves"), strict=True))

UNSEEN: dict[str, Callable[[dict[str, Any]], str]] = {
    "answer": unseen_answer,
    "kinds": unseen_kinds,
    "verdicts": unseen_verdicts,
    "worst": unseen_worst,
}


# --- benchmarks ------------------------------------------------------------------------------------------------------


def _of_benchmark(name: str, make: str, stored: str) -> str:
    """What a benchmark's function makes of the numbers it stored."""
    program = runpy.run_path(str(_ROOT / "benchmarks" / f"{name}.py"))
    return str(program[make](json.loads((_ROOT / "docs" / stored).read_text(encoding="utf-8"))))


def _mutants(stored: str) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = json.loads((_ROOT / "docs" / stored).read_text(encoding="utf-8"))["rows"]
    return [row for row in rows if row["mutants"]]


def mutation_table(stored: str) -> str:
    """How many changes of each module the tests noticed."""
    columns: list[Column[dict[str, Any]]] = [
        Column("module", lambda row: row["module"]),
        *(Column(name, operator.itemgetter(name), decimals=0) for name in ("places", "mutants", "killed")),
        Column("percent", lambda row: row["percent"], decimals=1),
    ]
    return markdown_table(_mutants(stored), columns)


def mutation_sample() -> str:
    """What a sample of all changes said: how many, with the interval that it leaves open, and of which modules."""
    stored = json.loads((_ROOT / "docs" / "mutation_sample.json").read_text(encoding="utf-8"))
    rows = _mutants("mutation_sample.json")
    columns: list[Column[dict[str, Any]]] = [
        Column("module", lambda row: row["module"]),
        *(Column(name, operator.itemgetter(name), decimals=0) for name in ("places", "mutants", "killed")),
    ]
    return (
        f'`make mutation ARGS="--sample {stored["sample"]} --seed {stored["seed"]}"`: {_killed_of_sample(rows[-1])}.'
        f"\n\n{markdown_table(rows, columns)}"
    )


def _killed_of_sample(row: dict[str, Any]) -> str:
    """Wilson's interval at 95 %."""
    n, part, z2 = row["mutants"], row["percent"] / 100.0, 1.96**2
    middle, half = part + z2 / (2 * n), math.sqrt(z2 * (part * (1.0 - part) / n + z2 / (4 * n * n)))
    low, high = (100.0 * (middle + side * half) / (1.0 + z2 / n) for side in (-1.0, 1.0))
    return (
        f"of {n} changes drawn from all {row['places']} places {row['killed']} ({row['percent']:.1f} %) made a test "
        f"fail; with 95 % confidence {low:.1f} to {high:.1f} % of all do"
    )


def mutation_sentence() -> str:
    """The same in a sentence."""
    (*_, whole), (*_, swaps), (*_, drawn) = map(_mutants, ("mutation.json", "swaps.json", "mutation_sample.json"))
    return (
        f"All {whole['mutants']} changes that `make mutation` made in these modules in version 0.1.0 were tried, and "
        f"{whole['killed']} of them ({whole['percent']:.1f} %) made a test fail. Of today's law a sample was tried: "
        f"{_killed_of_sample(drawn)}, before tests were written for those that went unnoticed. Today "
        f"{swaps['killed']} of all {swaps['mutants']} swaps of front and rear or left and right do. "
        "[mutation.md](mutation.md) has the tables and says of survivors why no test can tell."
    )


def soak_table() -> str:
    """Half hours at 100 Hz, as `make soak` stored them."""
    runs = json.loads((_ROOT / "docs" / "soak.json").read_text(encoding="utf-8"))
    columns: list[Column[dict[str, Any]]] = [
        Column("run", lambda row: row["run"]),
        Column("steps", lambda row: row["steps"], decimals=0),
        Column("late", lambda row: row["late"], decimals=0),
        Column("not explained by the machine", lambda row: row["late_by_itself"], decimals=0),
        Column("a step's processor time, by minute", lambda row: "{:.2f} to {:.2f} ms".format(*row["step_ms"])),
        Column("processors stood still", lambda row: f"{row['stood_still']} times, {row['stood_still_s']:.1f} s"),
    ]
    return markdown_table(runs, columns)


def faults_table() -> str:
    """What `make faults` stored; a row may stand for several faults that end alike."""
    rows = json.loads((_ROOT / "docs" / "faults.json").read_text(encoding="utf-8"))
    columns: list[Column[dict[str, Any]]] = [
        Column("fault", lambda row: row["name"]),
        Column("must", lambda row: row["expect"]),
        Column("zero torque after", lambda row: row["to_zero_s"], "s", 2),
        Column("torque later", lambda row: row["largest_nm"], "N m", 1),
        Column("normal again", lambda row: row["recovery_s"], "s", 2),
        Column("reported", lambda row: re.split(r";(?![^()]*\))", row["said"])[0]),
    ]
    return markdown_table(rows, columns)


MEASURED: dict[str, Callable[[], str]] = {
    "make faults": faults_table,
    "make mutation: table": lambda: mutation_table("mutation.json"),
    "make mutation: swaps": lambda: mutation_table("swaps.json"),
    "make mutation: sample": mutation_sample,
    "make mutation: sentence": mutation_sentence,
    "make soak": soak_table,
    "benchmarks/performance.py": lambda: _of_benchmark("performance", "table", "performance.json"),
    "benchmarks/fleet.py": lambda: _of_benchmark("fleet", "text", "scale.json"),
}
