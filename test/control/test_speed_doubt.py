# SPDX-License-Identifier: Apache-2.0
"""Whether the speed sensor is believed: the bounds of one step."""

from __future__ import annotations

import math

import pytest

from iwm_power_manager.control.speed_doubt import (
    AGREE_MPS,
    AGREE_PART,
    COMPARED_S,
    compared_speeds,
    judged_speed,
    rolling_of,
    used_friction_of,
)
from iwm_power_manager.control.types import Compared, initial_state
from iwm_power_manager.control.wheel_doubt import DISTRUST_S, ICE_FRICTION, SPEED_MPS, SPEED_PART, Turning

NONE = (0.0, 0.0, 0.0, 0.0)
STILL = Turning(NONE, NONE, NONE, (False, False, False, False), 600.0, 300.0)
DT = 0.01


@pytest.mark.parametrize(
    ("torque_nm", "used"),
    [((60.0, -90.0, 0.0, 0.0), 0.15), ((-90.0, 60.0, 15.0, 30.0), 0.15), ((60.0, 0.0, 0.0, -60.0), 0.2)],
)
def test_the_friction_in_use_is_the_largest_part_of_a_wheel_s_own_load(torque_nm, used):
    assert used_friction_of(torque_nm, STILL) == pytest.approx(used)


@pytest.mark.parametrize("speed", [2.0, 20.0, 40.0])
def test_wheels_roll_freely_while_they_are_no_further_apart_than_a_part_of_their_speed(speed):
    bound = AGREE_PART * speed + AGREE_MPS
    for part, free in ((0.95, True), (1.05, False)):
        rolling = rolling_of((speed, speed - part * bound, speed, speed), NONE, STILL)
        assert (rolling.freely, rolling.nearly, rolling.believed) == (free, free, 4)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("wheel", range(4))
def test_wheels_are_pushed_where_each_has_what_the_smoothest_ice_takes_of_its_own_load(wheel, sign):
    least_nm = [sign * ICE_FRICTION * load for load in (600.0, 600.0, 300.0, 300.0)]
    for part, pushed in ((1.01, sign), (0.99, 0.0)):
        torque_nm = tuple((part if i == wheel else 1.05) * nm for i, nm in enumerate(least_nm))
        assert rolling_of((20.0,) * 4, NONE, STILL._replace(torque_nm=torque_nm)).pushed == pushed


def judged(shown, predicted, acceleration=0.0, **before):
    """The sensor after judgement by a reference alone: no wheel is believed."""
    nobody = rolling_of((predicted,) * 4, (0.1,) * 4, STILL)
    return judged_speed(shown, predicted, acceleration, DT, initial_state().motion._replace(**before), nobody)


@pytest.mark.parametrize("acceleration", [-3.0, 3.0])
def test_what_the_reference_did_is_summed_while_the_sensor_shows_the_same(acceleration):
    same = judged(20.0, 20.0, acceleration, shown_mps=20.0, shown_s=0.02, moved_mps=0.1)
    assert (same.moved_mps, same.shown_s) == (pytest.approx(0.1 + acceleration * DT), pytest.approx(0.02 + DT))
    other = judged(20.0, 20.0, acceleration, shown_mps=19.9, shown_s=0.02, moved_mps=0.1)
    assert (other.moved_mps, other.shown_s) == (0.0, 0.0)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("predicted", [3.0, 20.0, -20.0])
def test_a_sensor_is_doubted_beyond_a_part_of_the_speed_and_good_again_within_half_of_it(predicted, sign):
    bound = sign * (SPEED_PART * abs(predicted) + SPEED_MPS)
    assert judged(predicted + 1.05 * bound, predicted).doubt_s == DISTRUST_S
    assert judged(predicted + 0.95 * bound, predicted).doubt_s == 0.0
    assert judged(predicted + 0.55 * bound, predicted, doubt_s=0.2).doubt_s == 0.2
    assert judged(predicted + 0.45 * bound, predicted, doubt_s=0.2).doubt_s == pytest.approx(0.2 - DT)


def test_at_walking_pace_forces_say_too_little_to_doubt_it():
    assert judged(5.0, 0.5).doubt_s == 0.0


@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_wheels_that_show_by_themselves_what_the_sensor_does_are_right_again(factor):
    before = Compared(factor, COMPARED_S)
    again = compared_speeds(10.0, (10.0 * factor,) * 4, STILL, 0.0, factor, before, True, DT)
    assert again == (Compared(1.0, COMPARED_S), 1.0, True)
    assert compared_speeds(10.0, (10.0,) * 4, STILL, 0.0, factor, before, True, DT) == (before, factor, False)


@pytest.mark.parametrize("over", [-0.3, 0.3])
def test_a_small_difference_to_the_wheels_is_taken_off_them_while_all_are_believed(over):
    before = Compared(1.0, COMPARED_S)
    wheels = (10.0 - over,) * 4
    told, factor, anew = compared_speeds(10.0, wheels, STILL, 0.0, 1.0, before, True, DT)
    assert (told, anew) == (before, False)
    assert factor == pytest.approx(1.0 + math.copysign(0.05 * DT, over))
    assert compared_speeds(10.0, wheels, STILL, 0.0, 1.0, before, False, DT) == (before, 1.0, False)
    for speed, much in ((10.0, 0.1), (10.0, 1.2), (3.0, 0.3)):
        wheels = (speed - math.copysign(much, over),) * 4
        assert compared_speeds(speed, wheels, STILL, 0.0, 1.0, before, True, DT) == (before, 1.0, False)
