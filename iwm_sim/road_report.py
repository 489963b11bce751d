# SPDX-License-Identifier: Apache-2.0
"""What came out of a scenario, in lines for the terminal."""

from __future__ import annotations

import math

from iwm_sim.road_run import Checked, RoadResult


def number_text(value: float) -> str:
    """A measure's value; an infinite one never happened."""
    return "never" if value == math.inf else f"{value:.3g}" if abs(value) < 10.0 else f"{value:.1f}"


def bound_text(check: Checked) -> str:
    """What a measure has to be."""
    low, high = check.bound.at_least, check.bound.at_most
    parts = [f"≥ {low:g}"] if low > -math.inf else []
    return " and ".join(parts + ([f"≤ {high:g}"] if high < math.inf else []))


def text(result: RoadResult) -> str:
    """A scenario in lines: its name and verdict, and each requirement."""
    lines = [f"{'pass' if result.passed else 'FAIL'}  {result.scenario.name}: {result.scenario.about}"]
    for check in result.checked:
        mark = " " if check.holds else "~" if check.bound.aim else "!"
        word = "aimed at" if check.bound.aim else "required"
        lines.append(f"    {mark} {check.bound.measure:<30} {number_text(check.value):>8}   {word} {bound_text(check)}")
    return "\n".join(lines)
