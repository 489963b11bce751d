# SPDX-License-Identifier: Apache-2.0
"""Rate limits against plain Python that walks from where the torque is to where it should be."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iwm_power_manager.control.slew import approached, slewed
from oracles import control_law as oracle

TORQUE = st.one_of(st.sampled_from([0.0, -80.0, 200.0]), st.floats(-200.0, 200.0))
RATE = st.sampled_from([10.0, 300.0, 1600.0, 20000.0])


@given(TORQUE, TORQUE, st.sampled_from([0.001, 0.01, 0.1, 1.0]), RATE, RATE, RATE)
def test_a_torque_walks_towards_its_target_at_the_rate_of_its_direction(before, target, dt, up, down, regeneration):
    ours = slewed(before, target, dt, up, down, regeneration)
    assert ours == pytest.approx(oracle.slewed(before, target, dt, up, down, regeneration), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize(
    ("before", "target", "after"),
    [
        (10.0, 100.0, 12.0),  # up: 20 a second
        (10.0, -100.0, 5.0),  # down: 50 a second
        (10.0, 9.0, 9.0),
        (-10.0, -100.0, -13.0),  # regeneration: 30 a second
        (-10.0, 100.0, -5.0),
        (-10.0, -9.0, -9.0),
        (2.5, -100.0, -1.5),  # half of the step down to zero, the other half out
        (-2.5, 100.0, 1.0),
        (5.0, -100.0, 0.0),
        (-5.0, 100.0, 0.0),
        (7.0, 7.0, 7.0),
        (0.0, 100.0, 2.0),
        (0.0, -100.0, -3.0),
        (2.5, -1.0, -1.0),
        (-2.5, 0.5, 0.5),
    ],
)
def test_each_direction_has_its_own_rate(before, target, after):
    assert slewed(before, target, 0.1, 20.0, 50.0, 30.0) == pytest.approx(after, abs=1e-12)


@given(TORQUE, TORQUE, st.floats(0.0, 100.0))
def test_a_share_comes_as_near_to_its_target_as_it_may(before, target, change):
    after = approached(before, target, change)
    assert abs(after - before) <= change * (1.0 + 1e-12) + 1e-12
    assert abs(target - after) == pytest.approx(max(abs(target - before) - change, 0.0), abs=1e-9)
