# SPDX-License-Identifier: Apache-2.0
"""A full stop on a road with less grip on one side: the car stays in its lane's middle and does not turn round."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iwm_sim.road_measures import driven, steering_deg
from iwm_sim.road_run import drive_scenario
from iwm_sim.scenario import Friction, load_scenario

BASE = load_scenario("split_stop")
MOST_DEG = 240.0
MOST_SLIP_ANGLE_DEG = 10.0


def it_stays_straight(speed_mps, low, times, left_low):
    sides = (low, min(low * times, 1.0))
    left, right = sides if left_low else sides[::-1]
    scenario = dataclasses.replace(
        BASE, speed_mps=speed_mps, friction=(Friction(-100.0, left, right),), assumed_friction=low, require=()
    )
    run = driven(drive_scenario(scenario), scenario.truth)
    sideways = np.degrees(np.arctan2(np.abs(run["lateral_speed_mps"]), np.maximum(np.abs(run["speed_mps"]), 3.0)))
    assert sideways.max() < MOST_SLIP_ANGLE_DEG
    assert steering_deg(run) <= MOST_DEG
    assert run.run.final.speed_mps == 0.0


DRAWN = given(st.floats(10.0, 30.0), st.floats(0.15, 0.5), st.floats(1.5, 6.0), st.booleans())


@settings(max_examples=6)
@DRAWN
def test_a_stop_on_a_split_road_turns_no_car_round(speed_mps, low, times, left_low):
    it_stays_straight(speed_mps, low, times, left_low)


@pytest.mark.nightly
@settings(max_examples=100)
@DRAWN
def test_a_stop_on_any_of_many_split_roads_turns_no_car_round(speed_mps, low, times, left_low):
    it_stays_straight(speed_mps, low, times, left_low)


@pytest.mark.parametrize(("speed_mps", "low", "times"), [(28.0, 0.15, 14.0 / 3.0), (33.0, 0.47, 2.2), (21.0, 0.1, 2.7)])
def test_stops_that_once_turned_the_car_round_do_no_more(speed_mps, low, times):
    it_stays_straight(speed_mps, low, times, False)
