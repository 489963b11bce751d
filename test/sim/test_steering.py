# SPDX-License-Identifier: Apache-2.0
"""The driver who keeps the lane: straight, after a jolt, beside a lasting push, and never faster than hands."""

from __future__ import annotations

import itertools
import math

import pytest

from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle
from iwm_sim.plant import Surroundings, advance, initial_plant
from iwm_sim.steering import MOST_RATE_RADPS, REACTION_S, LaneKeeper

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml"), "none").params
DT = 0.01


def drive(state, seconds, brakes=(0.0, 0.0, 0.0, 0.0), motors=(0.0, 0.0, 0.0, 0.0)):
    hands, rows = LaneKeeper(CAR, DT), []
    for _ in range(round(seconds / DT)):
        angle = hands.steer(state)
        rows.append((state.y_m, angle, state.heading_rad))
        steer = angle / CAR.chassis.steering_ratio
        state = advance(state, motors, brakes, steer, Surroundings((0.9,) * 4), DT, 1, CAR)
    return rows


def test_on_a_straight_road_the_hands_are_still_and_the_road_stays_straight():
    rows = drive(initial_plant(CAR, 0.8, 25.0), 5.0)
    assert all(row == (0.0, 0.0, 0.0) for row in rows)


@pytest.mark.parametrize("speed", [8.0, 15.0, 25.0, 35.0])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_car_beside_the_middle_comes_back_and_stays(speed, side):
    rows = drive(initial_plant(CAR, 0.8, speed)._replace(y_m=side), 15.0)
    assert max(abs(y) for y, _, _ in rows) < 1.3
    assert all(abs(y) < 0.15 for y, _, _ in rows[-200:])
    assert side * rows[30][1] < 0.0  # the first turn of the hands is towards the middle


@pytest.mark.parametrize("speed", [10.0, 25.0])
def test_a_lasting_pull_to_one_side_is_held_in_the_lane(speed):
    rows = drive(initial_plant(CAR, 0.8, speed), 12.0, motors=(20.0, 50.0, 20.0, 50.0))
    assert max(abs(y) for y, _, _ in rows) < 0.9
    assert abs(rows[-1][0]) < 0.3
    assert rows[-1][1] < 0.0  # the right wheels push to the left, the hands steer to the right


def test_hands_react_late_and_no_faster_than_they_can():
    rows = drive(initial_plant(CAR, 0.8, 25.0)._replace(heading_rad=0.5), 1.0)
    angles = [angle for _, angle, _ in rows]
    assert all(angle == 0.0 for angle in angles[: round(REACTION_S / DT)])
    assert max(abs(b - a) for a, b in itertools.pairwise(angles)) <= MOST_RATE_RADPS * DT + 1e-12
    assert min(angles) < -0.1
    assert math.isfinite(angles[-1])
