# SPDX-License-Identifier: Apache-2.0
"""Pictures of frontiers: saving against changes, and the margins of many cells."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from iwm_power_manager.tools.command import write_picture
from iwm_sim.study.frontier import COUNTS, RIVAL, Frontier, Point, margin
from iwm_sim.study.palette import COLOURS

_NAMES = {
    "changes_per_min": "changes by more than 0.25, 1/min",
    "fine_changes_per_min": "changes by more than 0.05, 1/min",
    "travel_per_min": "sum of all moves, 1/min",
}


def draw_frontier(frontier: Frontier, path: Path) -> None:
    """Saving of ours, its rivals and the bound against each way of counting changes."""
    figure = Figure(figsize=(12.0, 4.0), layout="constrained")
    axes = figure.subplots(1, len(COUNTS), sharey=True)
    for axis, count in zip(axes, COUNTS, strict=True):
        families = (
            (f"{RIVAL}, thresholds", [p for p in frontier.rivals if p.strategy == RIVAL], COLOURS[1], "o-"),
            ("instantaneous", [p for p in frontier.rivals if p.strategy != RIVAL], COLOURS[3], "s"),
            ("ours, budgets", frontier.ours, COLOURS[0], "o-"),
            # It bounds the changes of the first panel; those of the others are only counted.
            ("known in advance", frontier.bounds, COLOURS[6], "x--" if count == COUNTS[0] else "x"),
        )
        for name, points, colour, style in families:
            _curve(axis, name, points, count, colour, style)
        axis.set_xlabel(_NAMES[count])
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("saving against equal split, %")
    axes[0].legend(frameon=False)
    policies = ", ".join(point.policy for point in frontier.ours)
    words = textwrap.fill(f"{frontier.made_with}; policies of ours: {policies}", 150)
    figure.suptitle(f"{frontier.label}\n{words}", fontsize="medium")
    write_picture(path, figure)


def _curve(axis: Axes, name: str, points: Sequence[Point], count: str, colour: str, style: str) -> None:
    known = sorted((getattr(p, count), p.saving_percent) for p in points if p.saving_percent is not None)
    if not known:
        return
    changes, saving = zip(*known, strict=True)
    axis.plot(changes, saving, style[0], color=colour, label=name, markersize=4)
    if style[1:]:
        # With no more changes than a point between two others: the best so far; of a bound, at most the next.
        steps = "steps-pre" if style == "x--" else "steps-post"
        axis.plot(changes, np.maximum.accumulate(saving), style[1:], color=colour, drawstyle=steps, linewidth=1.2)


def draw_margins(frontiers: Sequence[Frontier], path: Path) -> None:
    """All cells' margins, sorted, for each way of counting changes."""
    figure = Figure(figsize=(8.0, 4.0), layout="constrained")
    axis = figure.subplots()
    for count, colour in zip(COUNTS, COLOURS, strict=False):
        found = (margin(point, f.rivals, count) for f in frontiers for point in f.ours)
        known = np.sort([value for value in found if value is not None])
        axis.plot(np.linspace(0.0, 100.0, known.size), known, color=colour, label=_NAMES[count])
    axis.axhline(-0.005, color=COLOURS[6], linewidth=0.8)
    axis.set_yscale("symlog", linthresh=0.02)
    axis.set_xlabel("cells, %")
    axis.set_ylabel("margin against the best rival\nwith no more changes, points")
    axis.legend(frameon=False)
    axis.grid(alpha=0.3)
    write_picture(path, figure)
