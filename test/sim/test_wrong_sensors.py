# SPDX-License-Identifier: Apache-2.0
"""No single wrong sensor takes the brakes, over whole drives; and wheels that really skid are caught all the same.

Hypothesis draws sensor, error, speed, road and demand; `make nightly` drives many more of them than every run.
"""

from __future__ import annotations

import dataclasses
import math

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from iwm_power_manager.control.types import WHEEL_NAMES
from iwm_sim.faults import Fault
from iwm_sim.road_measures import driven, measured
from iwm_sim.road_run import check_scenario, drive_scenario
from iwm_sim.scenario import Bound, Demand, Friction, Scenario, load_scenario

BASE = load_scenario("speed_high")
SENSORS = [f"wheel_{name}" for name in WHEEL_NAMES]
MOST_S = 5.0
LEAST_MPS2 = 0.5


def wrong(target, kind, value, at_s):
    return Fault(target, kind, value, at_s, math.inf)


SPEEDS = st.one_of(
    st.tuples(st.just("factor"), st.floats(0.5, 2.0)),
    st.tuples(st.just("offset"), st.sampled_from((-5.0, 5.0))),
    st.tuples(st.just("stuck"), st.just(0.0)),
    st.tuples(st.just("drift_per_s"), st.sampled_from((-5.0, 5.0))),
)
#: Anything that a wheel's sensor may show: a part of the truth, beside it, stuck, a number.
ONE_WHEEL = st.one_of(
    st.tuples(st.just("factor"), st.floats(-1.0, 2.0)),
    st.tuples(st.just("offset"), st.floats(-20.0, 20.0)),
    st.tuples(st.just("stuck"), st.just(0.0)),
    st.tuples(st.just("value"), st.floats(0.0, 150.0)),
)


@st.composite
def faults(draw):
    """A fault of one sensor, or of what scales all wheels: from the start on, before the braking or in its midst."""
    at_s = draw(st.sampled_from((0.0, 0.3, 1.5)))
    which = draw(st.sampled_from(("speed", "wheel", "wheels")))
    if which == "speed":
        return (wrong("vehicle_speed", *draw(SPEEDS), at_s),)
    if which == "wheels":
        return (wrong("wheels", "factor", draw(st.floats(0.75, 1.25)), at_s),)
    return (wrong(draw(st.sampled_from(SENSORS)), *draw(ONE_WHEEL), at_s),)


def braking(speed_mps: float, power_w: float, friction: float, broken: tuple[Fault, ...]) -> Scenario:
    return dataclasses.replace(
        BASE,
        speed_mps=speed_mps,
        demand=(Demand(1.0, "power_w", -power_w),),
        friction=(Friction(0.0, friction, friction),),
        assumed_friction=0.9,
        faults=broken,
        duration_s=MOST_S,
    )


def it_brakes(speed_mps, power_w, friction, broken):
    # Of less, the idle drag that ends with it and the wheels' inertia are a sixth with all sensors whole.
    power_w = max(power_w, LEAST_MPS2 * BASE.truth.chassis.mass_kg * speed_mps)
    found = check_scenario(braking(speed_mps, power_w, friction, broken)).values
    assert found["least_braking"] >= 0.85
    assert found["longest_under_braked_s"] <= 0.3


DRAWN = given(st.floats(5.0, 40.0), st.floats(5e3, 60e3), st.sampled_from((0.5, 0.9)), faults())


@settings(max_examples=16)
@DRAWN
def test_no_single_wrong_sensor_takes_the_brakes(speed_mps, power_w, friction, broken):
    it_brakes(speed_mps, power_w, friction, broken)


@pytest.mark.nightly
@settings(max_examples=200)
@DRAWN
def test_no_single_wrong_sensor_of_many_takes_the_brakes(speed_mps, power_w, friction, broken):
    it_brakes(speed_mps, power_w, friction, broken)


WRONG_FROM_STANDSTILL = st.one_of(
    st.tuples(st.just("vehicle_speed"), st.floats(0.5, 2.0)), st.tuples(st.just("wheels"), st.floats(0.75, 1.25))
)


@settings(max_examples=5)
@given(WRONG_FROM_STANDSTILL, st.floats(10e3, 25e3), st.floats(5e3, 40e3))
def test_a_sensor_that_is_wrong_by_a_factor_from_standstill_on_takes_no_brakes(wrong_by, driven_w, braked_w):
    target, factor = wrong_by
    scenario = dataclasses.replace(
        braking(0.0, braked_w, 0.9, (wrong(target, "factor", factor, 0.0),)),
        demand=(Demand(0.0, "power_w", driven_w), Demand(4.0, "power_w", -braked_w)),
        duration_s=9.0,
        to_standstill=True,
    )
    run = driven(drive_scenario(scenario), scenario.truth)
    assume(run["speed_mps"][run.braking] > 4.0)
    found = measured(("least_braking", "longest_under_braked_s"), run)
    assert found["least_braking"] >= 0.85
    assert found["longest_under_braked_s"] <= 0.3


@pytest.mark.parametrize(("friction", "speed_mps", "pedal"), [(0.06, 9.6, 0.6), (0.06, 3.6, 0.7), (0.07, 2.1, 0.5)])
def test_with_true_sensors_no_wheel_spins_on_the_smoothest_ice(friction, speed_mps, pedal):
    scenario = dataclasses.replace(
        braking(speed_mps, 0.0, friction, ()), demand=(Demand(0.3, "accelerator", pedal),), assumed_friction=0.9
    )
    found = measured(("longest_spinning_s", "doubted_s"), driven(drive_scenario(scenario), scenario.truth))
    assert found["longest_spinning_s"] <= 0.1
    assert found["doubted_s"] == 0.0


@pytest.mark.parametrize("wrong_by", [("wheels", 1.2), ("vehicle_speed", 0.83)])
@pytest.mark.parametrize("friction", [0.5, 0.9])
def test_a_car_whose_wheels_show_a_fifth_more_than_its_sensor_drives_off(wrong_by, friction):
    target, factor = wrong_by
    scenario = dataclasses.replace(
        braking(0.0, 0.0, friction, (wrong(target, "factor", factor, 0.0),)),
        demand=(Demand(0.0, "power_w", 15e3),),
        duration_s=4.0,
    )
    assert drive_scenario(scenario).final.speed_mps > 7.0


@pytest.mark.parametrize(
    ("speed_mps", "power_w", "broken"),
    [
        (17.0, 51.5e3, wrong("wheel_front_left", "value", 38.2, 1.5)),
        (21.0, 42.3e3, wrong("wheel_rear_right", "offset", -2.85, 0.0)),
    ],
)
def test_a_wheel_that_shows_a_slip_it_does_not_have_takes_its_neighbours_no_brakes(speed_mps, power_w, broken):
    it_brakes(speed_mps, power_w, 0.9, (broken,))


@pytest.mark.parametrize(
    ("speed_mps", "power_w", "broken"),
    [
        (6.53, 26.7e3, wrong("wheel_rear_right", "offset", -1.706, 0.0)),
        (7.44, 8.84e3, wrong("wheel_rear_left", "factor", 0.896, 0.0)),
        (13.35, 59e3, wrong("wheel_rear_right", "offset", -3.768, 0.3)),
        (14.5, 37.5e3, wrong("wheel_rear_right", "offset", -1.397, 1.5)),
        (14.3, 61.7e3, wrong("wheel_front_right", "factor", 0.924, 0.3)),
        (7.8, 59.3e3, wrong("wheel_front_left", "offset", -1.662, 0.0)),
        (30.3, 55.9e3, wrong("wheel_front_left", "offset", -4.859, 0.0)),
        (14.84, 64.057e3, wrong("wheel_rear_right", "factor", 0.882, 0.0)),
    ],
)
def test_a_wheel_that_shows_a_slip_it_does_not_have_takes_no_brakes_at_the_limit(speed_mps, power_w, broken):
    """The others run over the same road: it gets no torque until it comes back, and does not."""
    it_brakes(speed_mps, power_w, 0.5, (broken,))


@pytest.mark.parametrize(
    ("speed_mps", "power_w", "broken"),
    [
        (5.71, 43.562e3, wrong("wheel_front_left", "stuck", 0.0, 0.0)),
        (9.75, 44.89e3, wrong("wheel_front_right", "factor", -0.075, 0.0)),
        (5.08, 31.631e3, wrong("wheel_front_left", "value", 31.441, 0.0)),
    ],
)
def test_a_wheel_that_is_not_believed_takes_no_brakes_in_a_stop_at_the_limit_from_low_speed(speed_mps, power_w, broken):
    """Slip is judged more strictly, but by no more than is meant: the limiter trails its target."""
    it_brakes(speed_mps, power_w, 0.9, (broken,))


@pytest.mark.parametrize(("speed_mps", "at_s"), [(14.94, 1.5), (13.9, 0.3)])
def test_a_front_wheel_that_sticks_in_a_stop_takes_the_rear_ones_no_brakes_once_it_is_found(speed_mps, at_s):
    """Until then the road had looked like two, and the rear wheels kept their grip for the steering."""
    it_brakes(speed_mps, 60e3, 0.5, (wrong("wheel_front_left", "stuck", 0.0, at_s),))


@pytest.mark.parametrize("friction", [0.2, 0.5, 0.9])
def test_a_speed_that_is_a_little_too_high_takes_no_brakes_for_good_at_the_limit(friction):
    """Slower, it looks like slip, until the torque is gone and the wheels do not come back: that lasted to the end."""
    broken = (wrong("vehicle_speed", "offset", 0.5, 0.0),)
    assert check_scenario(braking(12.0, 40e3, friction, broken)).values["least_braking"] >= 0.6


@pytest.mark.parametrize(("speed_mps", "power_w", "factor"), [(6.05, 58.6e3, 0.955), (15.9, 28.5e3, 0.944)])
def test_worn_tyres_take_no_brakes_at_the_limit(speed_mps, power_w, factor):
    it_brakes(speed_mps, power_w, 0.9, (wrong("wheels", "factor", factor, 0.0),))


@pytest.mark.parametrize(("speed_mps", "power_w", "factor"), [(12.5, 20.4e3, 1.218), (12.6, 22.8e3, 1.231)])
def test_wheels_that_lead_with_a_speed_that_forces_do_not_explain_take_no_brakes(speed_mps, power_w, factor):
    it_brakes(speed_mps, power_w, 0.9, (wrong("wheels", "factor", factor, 0.0),))


@pytest.mark.parametrize("offset_mps", [-0.5, -0.2, 0.2, 0.3, 0.5])
@pytest.mark.parametrize("driven_w", [6e3, 12e3])
def test_a_speed_that_is_a_little_off_from_standstill_on_takes_no_brakes(offset_mps, driven_w):
    scenario = dataclasses.replace(
        braking(0.0, 0.0, 0.9, (wrong("vehicle_speed", "offset", offset_mps, 0.0),)),
        demand=(Demand(0.0, "power_w", driven_w), Demand(6.0, "power_w", -15e3)),
        duration_s=9.0,
    )
    assert check_scenario(scenario).values["longest_under_braked_s"] <= 0.3


@settings(max_examples=5)
@given(st.floats(5.0, 40.0), st.floats(20e3, 200e3))
def test_with_true_sensors_no_wheel_skids_on_a_slippery_road(speed_mps, power_w):
    scenario = dataclasses.replace(
        braking(speed_mps, power_w, 0.2, ()),
        require=(Bound("longest_beyond_critical_s", -math.inf, 0.1, aim=False),),
        assumed_friction=0.9,
    )
    assert check_scenario(scenario).values["longest_beyond_critical_s"] <= 0.1
