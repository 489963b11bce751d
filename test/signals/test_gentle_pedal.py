# SPDX-License-Identifier: Apache-2.0
"""A pedal of another unit is told, and how sure that is; nobody who drives gently is."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iwm_power_manager.signals.gentle_pedal import GentlePedal
from iwm_power_manager.signals.mapping import UNITS, Source

PERCENT, RATIO = UNITS["brake_pedal"]["%"], UNITS["brake_pedal"]["1"]


def source(unit) -> list[Source]:
    return [Source("signals.brake_pedal", "/pedals/brake", "data", unit)]


def used(*presses: tuple[float, float]) -> GentlePedal:
    """A pedal in %, each press its value and for how many seconds, at 50 Hz."""
    pedal, at_s = GentlePedal(), 5.0
    for percent, lasts_s in presses:
        for _ in range(round(50 * lasts_s)):
            pedal.note(int(at_s * 1e9), 0.01 * percent)
            at_s += 0.02
    return pedal


@pytest.mark.parametrize(
    ("presses", "sure"),
    [
        ([(0.0, 1.0), (0.25, 4.0)], True),
        ([(0.0, 1.0), (0.3, 2.0), (0.0, 1.0), (1.0, 3.5)], True),
        ([(0.4, 10.0)], False),  # it has not been let go: an offset, or a script that holds it
        ([(1.02, 4.0), (float("nan"), 1.0)], False),  # a pedal shows a little beyond its way
    ],
)
def test_a_pedal_of_0_to_1_in_percent_is_told_with_its_key_and_what_to_write(presses, sure: bool) -> None:
    pedal = used(*presses)
    words = f"signals.brake_pedal on /pedals/brake was held, and never beyond {max(presses)[0]:g} %: where it is 0..1, "
    assert (pedal.released, pedal.remark(source(PERCENT))) == (sure, words + 'write unit: "1"')
    assert pedal.remark(source(RATIO)) == pedal.remark([]) == ""


@pytest.mark.parametrize(
    "presses",
    [
        [(0.0, 60.0)],
        [(0.0, 1.0), (0.08, 60.0)],  # noise of a pedal that nobody touches
        [(0.0, 0.5), (0.4, 0.5)] * 20,  # its lowest bit comes and goes
        [(0.0, 1.0), (0.5, 2.5), (0.0, 1.0)],  # touched
        [(0.0, 1.0), (3.0, 0.5), (0.6, 60.0)],  # pressed once, and then held as gently as can be
        [(0.0, 1.0), (0.8, 2.5), (1.4, 60.0)],
    ],
)
def test_a_pedal_that_is_not_touched_or_pressed_gently_is_not(presses) -> None:
    assert used(*presses).remark(source(PERCENT)) == ""


@given(st.lists(st.tuples(st.floats(0.0, 100.0), st.floats(0.0, 2.9)), max_size=8))
def test_what_is_pressed_beyond_two_percent_at_least_every_three_seconds_is_never_told(presses) -> None:
    driving = [press for found in presses for press in (found, (2.0, 0.1))]
    assert used((2.0, 0.1), *driving).remark(source(PERCENT)) == ""


def test_a_clock_that_was_set_back_makes_no_long_press() -> None:
    pedal = GentlePedal()
    for at_s in (9.0, 9.02, 2.0, 2.02, 4.9):
        pedal.note(int(at_s * 1e9), 0.005)
    assert pedal.held_s == pytest.approx(2.9)
