# SPDX-License-Identifier: Apache-2.0
"""A motor is dead while the driver accelerates: whatever the road and the pedal, the car stays in its lane.

Hypothesis draws motor, speed, pedal and road; `make nightly` drives many more than every run.
"""

from __future__ import annotations

import dataclasses
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iwm_power_manager.control.types import WHEEL_NAMES
from iwm_sim.faults import Fault
from iwm_sim.road_measures import driven, lane_m
from iwm_sim.road_run import drive_scenario
from iwm_sim.scenario import Demand, Friction, load_scenario

BASE = load_scenario("motor_dead_drive_02")


def accelerated(speed_mps, pedal, friction, *lost, grade=0.0, from_s=0.0, factor=0.0):
    scenario = dataclasses.replace(
        BASE,
        speed_mps=speed_mps,
        demand=(Demand(0.5, "accelerator", pedal),),
        friction=(Friction(-100.0, *friction),),
        assumed_friction=min(friction),
        grade=((0.0, grade),),
        faults=tuple(Fault(f"motor_{wheel}", "factor", factor, from_s, math.inf) for wheel in lost),
    )
    return driven(drive_scenario(scenario), scenario.truth)


def it_stays_in_its_lane(speed_mps, pedal, friction, wheel, from_s):
    assert lane_m(accelerated(speed_mps, pedal, (friction, friction), wheel, from_s=from_s)) <= 3.5


DRAWN = given(
    st.floats(0.0, 25.0),
    st.floats(0.4, 1.0),
    st.floats(0.2, 0.9),
    st.sampled_from(WHEEL_NAMES),
    st.sampled_from((0.0, 2.0)),
)


@settings(max_examples=6)
@DRAWN
def test_a_dead_motor_takes_no_car_out_of_its_lane(speed_mps, pedal, friction, wheel, from_s):
    it_stays_in_its_lane(speed_mps, pedal, friction, wheel, from_s)


@pytest.mark.nightly
@settings(max_examples=100)
@DRAWN
def test_none_of_many_dead_motors_takes_a_car_out_of_its_lane(speed_mps, pedal, friction, wheel, from_s):
    it_stays_in_its_lane(speed_mps, pedal, friction, wheel, from_s)


@pytest.mark.parametrize("speed_mps", [6.0, 15.0, 25.0])
@pytest.mark.parametrize("wheel", ["front_left", "front_right"])
def test_on_little_grip_a_dead_front_motor_turns_no_car_at_full_accelerator(speed_mps, wheel):
    """It had turned round from 8 m/s on, and left its lane at 6."""
    it_stays_in_its_lane(speed_mps, 1.0, 0.2, wheel, 0.0)


def test_a_motor_that_has_half_of_its_torque_takes_no_car_out_of_its_lane():
    assert lane_m(accelerated(20.0, 1.0, (0.2, 0.2), "front_left", factor=0.5)) <= 3.5


def test_on_a_good_road_the_motor_beside_a_dead_one_gives_all_it_can():
    run = accelerated(15.0, 1.0, (0.9, 0.9), "front_left")
    assert run["motor_fr_nm"][-1] * run["wheel_fr_radps"][-1] >= 0.99 * 7500.0
