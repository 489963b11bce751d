# SPDX-License-Identifier: Apache-2.0
"""A motor is stuck at a torque that drives while nobody brakes: the car stays in its lane and goes no faster by it.

Hypothesis draws motor, torque, speed, pedal and road; `make nightly` drives many more than every run.
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

BASE = load_scenario("motor_stuck_drive_02")
HEALTHY_FOR_S = 1.0


def pushed(speed_mps, pedal, friction, wheel, torque_nm):
    demand = (Demand(0.0, "accelerator", pedal) if pedal else Demand(0.0, "power_w", 0.0),)
    scenario = dataclasses.replace(
        BASE,
        speed_mps=speed_mps,
        demand=demand,
        friction=(Friction(0.0, friction, friction),),
        assumed_friction=friction,
        faults=(Fault(f"motor_{wheel}", "torque_nm", torque_nm, HEALTHY_FOR_S, math.inf),) if torque_nm else (),
    )
    return driven(drive_scenario(scenario), scenario.truth)


def it_goes_as_asked(speed_mps, pedal, friction, wheel, torque_nm):
    run = pushed(speed_mps, pedal, friction, wheel, torque_nm)
    assert lane_m(run) <= 3.5
    # What it is given before it is found, and what a report may differ by all the time.
    healthy = pushed(speed_mps, pedal, friction, wheel, 0.0)
    given_nms = 0.5 * torque_nm + BASE.duration_s * (8.0 + 0.15 * torque_nm)
    given_mps = given_nms / run.vehicle.front.wheel.radius_m / run.vehicle.chassis.mass_kg
    assert run.run.final.speed_mps <= healthy.run.final.speed_mps + given_mps


DRAWN = given(
    st.floats(0.0, 25.0),
    st.one_of(st.just(0.0), st.floats(0.1, 1.0)),
    st.floats(0.2, 0.9),
    st.sampled_from(WHEEL_NAMES),
    st.floats(20.0, 200.0),
)


@settings(max_examples=4)
@DRAWN
def test_a_stuck_motor_takes_no_car_out_of_its_lane_and_makes_it_no_faster(
    speed_mps, pedal, friction, wheel, torque_nm
):
    it_goes_as_asked(speed_mps, pedal, friction, wheel, torque_nm)


@pytest.mark.nightly
@settings(max_examples=100)
@DRAWN
def test_none_of_many_stuck_motors_does(speed_mps, pedal, friction, wheel, torque_nm):
    it_goes_as_asked(speed_mps, pedal, friction, wheel, torque_nm)


@pytest.mark.parametrize("wheel", ["front_left", "rear_right"])
@pytest.mark.parametrize("pedal", [0.0, 0.2])
def test_on_little_grip_it_turns_no_car(wheel, pedal):
    """Without a pedal, and with a light one, it had."""
    it_goes_as_asked(25.0, pedal, 0.2, wheel, 100.0)
