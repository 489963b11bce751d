# SPDX-License-Identifier: Apache-2.0
"""The skid gate: Table 2, its hysteresis, and whose power goes where."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iwm_power_manager.model.gate import axle_gated, gated_split


@pytest.mark.parametrize(
    ("slip", "power", "gated"),
    [
        (-0.2001, -1.0, True),
        (-0.2, -1.0, False),
        (0.5, -1.0, False),
        (-0.5, 1.0, False),
        (0.2001, 1.0, True),
        (0.2, 1.0, False),
        (-0.5, 0.0, False),
        (0.5, 0.0, False),
    ],
)
def test_slip_beyond_the_critical_one_in_the_direction_of_the_demand_gates(slip, power, gated):
    assert axle_gated(slip, power, False, 0.2, 0.0, True) is gated


@pytest.mark.parametrize(("slip", "gated"), [(0.5, False), (-0.5, False)])
def test_as_printed_only_braking_gates(slip, gated):
    assert axle_gated(slip, 1.0, False, 0.2, 0.0, False) is gated
    assert axle_gated(slip, -1.0, False, 0.2, 0.0, False) is (slip < 0.0)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize(("slip", "was", "gated"), [(0.18, False, False), (0.18, True, True), (0.15, True, False)])
def test_a_gated_axle_stays_so_until_its_slip_is_inside_by_the_hysteresis(sign, slip, was, gated):
    assert axle_gated(sign * slip, sign, was, 0.2, 0.05, True) is gated


@pytest.mark.parametrize(
    ("front", "rear", "split"),
    [
        (False, False, (-300.0, -700.0)),
        (True, False, (0.0, -1000.0)),
        (False, True, (-1000.0, 0.0)),
        (True, True, (0.0, 0.0)),
    ],
)
def test_a_gated_axle_s_power_goes_to_the_other_one(front, rear, split):
    assert gated_split(-1000.0, 0.3, (front, rear)) == pytest.approx(split)


@given(st.floats(-1e6, 1e6), st.floats(0.0, 1.0))
def test_ungated_parts_sum_to_the_whole(power, share):
    front, rear = gated_split(power, share, (False, False))
    assert front == share * power
    assert front + rear == pytest.approx(power)
