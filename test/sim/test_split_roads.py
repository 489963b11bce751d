# SPDX-License-Identifier: Apache-2.0
"""A full stop on a road with less grip on one side: the car stays in its lane's middle and does not turn round."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iwm_sim import road_run, steering
from iwm_sim.road_measures import driven, lane_m, steering_2s_deg, steering_deg, stopping_distance_m
from iwm_sim.road_run import drive_scenario
from iwm_sim.scenario import Friction, load_scenario

BASE = load_scenario("split_stop")
MOST_DEG = 240.0
MOST_SLIP_ANGLE_DEG = 10.0


def it_stays_straight(speed_mps, low, times, left_low, imu=False):
    sides = (low, min(low * times, 1.0))
    left, right = sides if left_low else sides[::-1]
    scenario = dataclasses.replace(
        BASE, speed_mps=speed_mps, friction=(Friction(-100.0, left, right),), assumed_friction=low, imu=imu, require=()
    )
    run = driven(drive_scenario(scenario), scenario.truth)
    sideways = np.degrees(np.arctan2(np.abs(run["lateral_speed_mps"]), np.maximum(np.abs(run["speed_mps"]), 3.0)))
    assert sideways.max() < MOST_SLIP_ANGLE_DEG
    assert steering_deg(run) <= MOST_DEG
    assert run.run.final.speed_mps == 0.0


DRAWN = given(st.floats(10.0, 30.0), st.floats(0.15, 0.5), st.floats(1.5, 6.0), st.booleans(), st.booleans())


@settings(max_examples=6)
@DRAWN
def test_a_stop_on_a_split_road_turns_no_car_round(speed_mps, low, times, left_low, imu):
    it_stays_straight(speed_mps, low, times, left_low, imu)


@pytest.mark.nightly
@settings(max_examples=100)
@DRAWN
def test_a_stop_on_any_of_many_split_roads_turns_no_car_round(speed_mps, low, times, left_low, imu):
    it_stays_straight(speed_mps, low, times, left_low, imu)


@pytest.mark.parametrize(("speed_mps", "low", "times"), [(28.0, 0.15, 14.0 / 3.0), (33.0, 0.47, 2.2), (21.0, 0.1, 2.7)])
def test_stops_that_once_turned_the_car_round_do_no_more(speed_mps, low, times):
    it_stays_straight(speed_mps, low, times, False)


def watched(monkeypatch, shown=lambda rate, time_s: rate, **changes):
    """The stop of the row, both sides' friction given, with a gyroscope that shows this of the yaw rate."""
    give = road_run.give

    def give_shown(controller, sensors, drive, now_ns):
        give(controller, sensors._replace(yaw_rate_radps=shown(sensors.yaw_rate_radps, drive.time_s)), drive, now_ns)

    monkeypatch.setattr(road_run, "give", give_shown)
    scenario = dataclasses.replace(BASE, imu=True, **changes)
    return driven(drive_scenario(scenario), scenario.truth)


@pytest.mark.parametrize("slower", [1.0, 1.5])
@pytest.mark.parametrize("left_low", [True, False])
def test_with_a_gyroscope_a_stop_is_shorter_and_also_a_slow_driver_keeps_his_lane(monkeypatch, left_low, slower):
    monkeypatch.setattr(steering, "REACTION_S", slower * steering.REACTION_S)
    monkeypatch.setattr(steering, "ARMS_S", slower * steering.ARMS_S)
    sides = (0.2, 0.9) if left_low else (0.9, 0.2)
    run = watched(monkeypatch, friction=(Friction(-100.0, *sides),))
    assert stopping_distance_m(run) <= 90.0
    assert lane_m(run) <= 3.5
    assert steering_2s_deg(run) <= 120.0
    assert steering_deg(run) <= MOST_DEG


@pytest.mark.parametrize("shown", [lambda rate, _: 0.0, lambda rate, _: -rate], ids=["stuck", "wrong sign"])
def test_a_gyroscope_that_is_wrong_changes_nothing(monkeypatch, shown):
    run, without = watched(monkeypatch, shown), driven(drive_scenario(BASE), BASE.truth)
    assert np.array_equal(run["y_m"], without["y_m"])


def test_a_gyroscope_that_fails_during_the_stop_turns_no_car_round(monkeypatch):
    run = watched(monkeypatch, lambda rate, time_s: rate if time_s < 3.0 else np.nan)
    assert lane_m(run) <= 3.5
    assert stopping_distance_m(run) < stopping_distance_m(driven(drive_scenario(BASE), BASE.truth))
