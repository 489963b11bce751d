# SPDX-License-Identifier: Apache-2.0
"""A brake circuit is empty: whatever the road, no wheel locks and no sensor is doubted for long.

Hypothesis draws circuit, speed, pedal and road; `make nightly` drives many more than every run.
"""

from __future__ import annotations

import dataclasses
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iwm_sim.faults import Fault
from iwm_sim.road_measures import driven, measured
from iwm_sim.road_run import controller_of, drive_scenario
from iwm_sim.scenario import Demand, Friction, load_scenario

BASE = load_scenario("speed_high")
CIRCUITS = {"front": ("front_left", "front_right"), "rear": ("rear_left", "rear_right")}


def stop(speed_mps, pedal, friction, broken):
    return dataclasses.replace(
        BASE,
        speed_mps=speed_mps,
        demand=(Demand(0.5, "brake", pedal),),
        friction=(Friction(0.0, friction, friction),),
        assumed_friction=0.9,
        faults=broken,
        duration_s=60.0,
        to_standstill=True,
    )


def it_stops_whole(speed_mps, pedal, friction, circuit, at_s):
    broken = tuple(Fault(f"brake_{wheel}", "dead", 0.0, at_s, math.inf) for wheel in CIRCUITS[circuit])
    scenario = stop(speed_mps, pedal, friction, broken)
    run = driven(drive_scenario(scenario), scenario.truth)
    found = measured(("longest_locked_s", "doubted_s"), run)
    assert found["longest_locked_s"] <= 0.1
    assert found["doubted_s"] <= 0.5


DRAWN = given(
    st.floats(8.0, 35.0),
    st.sampled_from((0.1, 0.4, 1.0)),
    st.sampled_from((0.2, 0.3, 0.5, 0.9)),
    st.sampled_from(sorted(CIRCUITS)),
    st.sampled_from((0.0, 2.0)),
)


@settings(max_examples=5)
@DRAWN
def test_an_empty_circuit_locks_no_wheel(speed_mps, pedal, friction, circuit, at_s):
    it_stops_whole(speed_mps, pedal, friction, circuit, at_s)


@pytest.mark.nightly
@settings(max_examples=100)
@DRAWN
def test_none_of_many_empty_circuits_locks_a_wheel(speed_mps, pedal, friction, circuit, at_s):
    it_stops_whole(speed_mps, pedal, friction, circuit, at_s)


@pytest.mark.parametrize("circuit", CIRCUITS)
def test_the_brakes_of_an_empty_circuit_are_counted_on_for_less_than_half(circuit):
    broken = tuple(Fault(f"brake_{wheel}", "dead", 0.0, 0.0, math.inf) for wheel in CIRCUITS[circuit])
    scenario = stop(25.0, 1.0, 0.2, broken)
    manager = controller_of(scenario)
    drive_scenario(scenario, manager)
    dead = manager.brake_gain[:2] if circuit == "front" else manager.brake_gain[2:]
    assert max(dead) < 0.5


def test_whole_brakes_are_never_named():
    for friction in (0.2, 0.9):
        scenario = stop(25.0, 1.0, friction, ())
        manager = controller_of(scenario)
        drive_scenario(scenario, manager)
        assert manager.brake_gain == (1.0,) * 4
