# SPDX-License-Identifier: Apache-2.0
"""The page of the scenarios of real roads, `docs/roads.md`."""

from __future__ import annotations

from collections.abc import Sequence

from campaigns.unknown_friction import SKID_FIGURES, Jumped, Saved, differs
from iwm_sim.road_measures import MEASURES, OF_HEALTHY
from iwm_sim.road_report import bound_text, number_text
from iwm_sim.road_run import RoadResult

_HEAD = """\
# Real roads

Written by `make roads`: each scenario of `config/scenarios/` driven with strategy `{strategy}`, the power manager as
the node runs it, at 100 Hz, on the double-track plant. {passed} of {all} scenarios meet all that they require. What a
measure means stands [below](#measures); an aim that is missed is no failure. The plant, the driver and their numbers
are models: nothing here was measured in a car.

| scenario | what happens | measure | value | required | |
|---|---|---|---|---|---|
"""


def page(results: Sequence[RoadResult], strategy: str) -> str:
    """The page, in Markdown."""
    passed = sum(result.passed for result in results)
    lines = [_HEAD.format(strategy=strategy, passed=passed, all=len(results))]
    for result in results:
        first = f"| `{result.scenario.name}` | {result.scenario.about} "
        for check in result.checked:
            verdict = "pass" if check.holds else "aim missed" if check.bound.aim else "**fail**"
            told = f"`{check.bound.measure}` | {number_text(check.value)} | {bound_text(check)} | {verdict} |\n"
            lines.append(f"{first}| {told}")
            first = "| | "
    lines.append("\n## Measures\n\n")
    for name, measure in MEASURES.items():
        lines.append(f"- `{name}`: {' '.join((measure.__doc__ or '').split())}\n")
    for name, measure in OF_HEALTHY.items():
        lines.append(f"- `{name}`: `{measure.__name__}` over that of the same scenario without its faults.\n")
    return "".join(lines)


_UNKNOWN = """
## Unknown friction

The friction estimated beside the friction told, by the same command. Savings against equal split in the cells of the
study, %; {differ} of {cells} differ by more than 0.02 points, {held} have a saving both ways:

| cycle | friction | idle drive | told | estimated |
|---|---|---|---|---|
"""
_JUMPS = """
Skid figures from one second after a jump on, told / estimated, s, the worst of {drives} drives of each row (10, 20 and
30 m/s; braking hard and gently, driving, or beginning to after the jump); {worse} of all {jumps} drives is worse:

| road | {figures} |
|---|{rule}|
"""


def unknown(cells: Sequence[Saved], jumps: Sequence[Jumped]) -> str:
    """What it costs not to know the friction, in Markdown."""
    both = [cell for cell in cells if cell.told_percent is not None and cell.estimated_percent is not None]
    lines = [_UNKNOWN.format(differ=sum(map(differs, cells)), cells=len(cells), held=len(both))]
    for cell in cells:
        shown = ["-" if x is None else f"{x:.3f}" for x in cell[3:]]
        lines.append(f"| {cell.cycle} | {cell.friction:g} | {cell.idle_drive} | {shown[0]} | {shown[1]} |\n")
    roads = {jump.road: [other for other in jumps if other.road == jump.road] for jump in jumps}
    each = max((len(found) for found in roads.values()), default=0)
    lines.append(
        _JUMPS.format(
            drives=each,
            worse=sum(not jump.no_worse for jump in jumps) or "none",
            jumps=len(jumps),
            figures=" | ".join(f"`{name}`" for name in SKID_FIGURES),
            rule="|".join("---" for _ in SKID_FIGURES),
        )
    )
    for road, found in roads.items():
        worst = [
            f"{max(jump.told[i] for jump in found):.2f} / {max(jump.estimated[i] for jump in found):.2f}"
            for i in range(len(SKID_FIGURES))
        ]
        lines.append(f"| {road} | {' | '.join(worst)} |\n")
    return "".join(lines)
