# SPDX-License-Identifier: Apache-2.0
"""What the two wheels of an axle may do: how much each may slip."""

from __future__ import annotations

import pytest

from iwm_power_manager.control.axle import slip_targets
from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.control.types import initial_state

SETTINGS = default_settings("equal")
MOST, LEAST = SETTINGS.slip_target, SETTINGS.unequal_rear_slip_target


def targets(*slips: float, gain: tuple[float, float, float, float] = (1.0, 0.0, 1.0, 1.0), braking: bool = True):
    """Slip each wheel is held at, with wheels that slipped so in the step before."""
    wheels = initial_state().wheels
    before = tuple(wheel._replace(slip=slip) for wheel, slip in zip(wheels, slips, strict=True))
    return slip_targets(0.0, braking, False, gain, before, SETTINGS)


@pytest.mark.parametrize("fronts", [(-0.06, -0.08), (-0.08, -0.06)])
@pytest.mark.parametrize("rears", [(-0.2, -0.01), (-0.01, -0.2), (-0.2, -0.2), (-0.01, -0.01)])
def test_beside_a_motor_that_does_not_obey_braked_rear_wheels_slip_no_more_than_either_front_one(fronts, rears):
    assert targets(*fronts, *rears) == pytest.approx((MOST, MOST, 0.06, 0.06))


def test_they_may_slip_a_little_beside_front_wheels_that_roll_and_no_more_than_others_beside_locked_ones():
    assert targets(0.0, 0.0, -0.2, -0.2) == (MOST, MOST, LEAST, LEAST)
    assert targets(-1.0, -1.0, -0.2, -0.2) == (MOST, MOST, MOST, MOST)


@pytest.mark.parametrize("weak", range(4))
def test_with_motors_that_obey_or_without_braking_all_wheels_may_slip_alike(weak):
    slips = (-0.06, -0.06, -0.2, -0.2)
    assert targets(*slips, gain=(1.0, 1.0, 1.0, 1.0)) == targets(*slips, braking=False) == (MOST,) * 4
    assert targets(*slips, gain=tuple(0.5 if i == weak else 1.0 for i in range(4)))[3] == pytest.approx(0.06)
