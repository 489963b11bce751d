# SPDX-License-Identifier: Apache-2.0
"""The swaps of a mutation run: a mistake of sides is one, another order of the same is none."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
swaps_of = runpy.run_path(str(ROOT / "scripts" / "swapped_sides.py"))["swaps_of"]


def law(body: str) -> str:
    return f"def share(front, rear, part):\n    return {body}\n\n\nwhole = share(front, rear, 0.5)\n"


@pytest.mark.parametrize(
    "body", ["front + rear", "part * (front.force_n * rear.force_n)", "max(abs(front), abs(rear)) + front * rear"]
)
def test_arguments_of_which_only_a_sum_a_product_or_an_extreme_is_taken_are_not_exchanged(body):
    assert law(body).replace("(front, rear, 0.5)", "(rear, front, 0.5)") not in swaps_of(law(body))


@pytest.mark.parametrize("body", ["front - rear", "part * front + rear", "max(front, rear) + front"])
def test_arguments_of_unlike_meaning_are_exchanged(body):
    assert law(body).replace("(front, rear, 0.5)", "(rear, front, 0.5)") in swaps_of(law(body))


def test_names_indexes_and_wheels_of_a_tuple_are_exchanged():
    source = "def f(fl, fr, rl, rr, w):\n    return fl - w[0], (fl, fr, rl, rr)\n"
    swaps = swaps_of(source)
    for old, new in [
        ("fl - w", "fr - w"),
        ("fl - w", "rl - w"),
        ("w[0]", "w[1]"),
        ("w[0]", "w[2]"),
        ("(fl, fr, rl, rr)\n", "(fr, fl, rl, rr)\n"),
        ("(fl, fr, rl, rr)\n", "(rl, fr, fl, rr)\n"),
    ]:
        assert source.replace(old, new) in swaps


def test_what_is_only_asked_for_membership_has_no_order():
    assert swaps_of('def f(side):\n    return side in ("left", "right", left, right)\n') == []
