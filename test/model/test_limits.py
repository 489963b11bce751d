# SPDX-License-Identifier: Apache-2.0
"""Battery limits: derating by charge and temperature, and the part of the torques that fits in."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from iwm_power_manager.model.limits import battery_limits_w, fade, wheels_power_w, wheels_scale
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle
from oracles.control_law import battery_factor
from oracles.step import electrical_w

CARS = [
    load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml"), drive).params
    for drive in ("none", "drag", "enabled")
]
#: Its rear motors lose more, and drag when they are idle.
TWO_KINDS = CARS[0]._replace(
    rear=CARS[1].rear._replace(motor=CARS[1].rear.motor._replace(loss_quadratic_torque=0.2, loss_constant_w=150.0))
)
CARS.append(TWO_KINDS)
BATTERY = CARS[0].battery
TORQUE = st.one_of(st.just(0.0), st.floats(0.1, 200.0), st.floats(-80.0, -0.1))
SPEED = st.floats(0.0, 120.0)
FOUR_TORQUES, FOUR_SPEEDS = st.tuples(*[TORQUE] * 4), st.tuples(*[SPEED] * 4)


def motors(car):
    return (car.front.motor, car.front.motor, car.rear.motor, car.rear.motor)


@given(st.floats(-100.0, 100.0), st.floats(-50.0, 50.0), st.floats(-50.0, 50.0))
def test_a_fade_is_a_clamped_line_either_way_round(value, zero, full):
    assume(abs(full - zero) > 1e-3)
    points = sorted(((zero, 0.0), (full, 1.0)))
    assert fade(value, zero, full) == pytest.approx(np.interp(value, *zip(*points, strict=True)), abs=1e-9)


@pytest.mark.parametrize(
    ("soc", "discharge", "charge"),
    [
        (0.0, 0.0, 1.0),
        (0.02, 0.0, 1.0),
        (0.06, 0.5, 1.0),
        (0.1, 1.0, 1.0),
        (0.5, 1.0, 1.0),
        (0.95, 1.0, 1.0),
        (0.975, 1.0, 0.5),
        (1.0, 1.0, 0.0),
    ],
)
def test_charge_derates_each_limit_at_its_own_end(soc, discharge, charge):
    limits = battery_limits_w(soc, 25.0, BATTERY)
    assert limits == pytest.approx((discharge * BATTERY.discharge_limit_w, charge * BATTERY.charge_limit_w), abs=1e-6)


@pytest.mark.parametrize(
    ("degc", "discharge", "charge"),
    [
        (-20.0, 1.0, 0.0),
        (0.0, 1.0, 0.0),
        (5.0, 1.0, 0.5),
        (10.0, 1.0, 1.0),
        (45.0, 1.0, 1.0),
        (52.5, 0.5, 0.5),
        (60.0, 0.0, 0.0),
        (math.nan, 1.0, 1.0),
    ],
)
def test_cold_stops_charging_and_heat_stops_both(degc, discharge, charge):
    limits = battery_limits_w(0.5, degc, BATTERY)
    assert limits == pytest.approx((discharge * BATTERY.discharge_limit_w, charge * BATTERY.charge_limit_w), abs=1e-6)


def test_deratings_multiply():
    discharge, charge = battery_limits_w(0.06, 52.5, BATTERY._replace(discharge_limit_w=30e3))
    assert discharge == pytest.approx(7500.0)
    assert charge == pytest.approx(0.5 * BATTERY.charge_limit_w)
    assert battery_limits_w(0.975, 5.0, BATTERY._replace(charge_limit_w=20e3))[1] == pytest.approx(5000.0)


@given(FOUR_TORQUES, FOUR_SPEEDS, st.floats(0.0, 1.0), st.sampled_from(CARS))
def test_the_car_takes_what_its_four_motors_take(torques, speeds, factor, car):
    expected = sum(electrical_w(factor * t, w, motor) for t, w, motor in zip(torques, speeds, motors(car), strict=True))
    assert wheels_power_w(torques, speeds, factor, car) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("wheel", range(4))
def test_each_motor_takes_power_of_its_own_torque_speed_and_losses(wheel):
    torques = tuple(37.0 if i == wheel else 0.0 for i in range(4))
    speeds = tuple(41.0 if i == wheel else 17.0 for i in range(4))
    resting = [electrical_w(0.0, w, motor) for w, motor in zip(speeds, motors(TWO_KINDS), strict=True)]
    expected = electrical_w(37.0, 41.0, motors(TWO_KINDS)[wheel]) + sum(resting) - resting[wheel]
    assert wheels_power_w(torques, speeds, 1.0, TWO_KINDS) == pytest.approx(expected, abs=1e-9)


@given(FOUR_TORQUES, FOUR_SPEEDS, st.floats(1.0, 47500.0), st.floats(1.0, 47500.0), st.sampled_from(CARS))
def test_the_scale_is_the_largest_factor_inside_the_limits(torques, speeds, discharge, charge, car):
    factor, _ = battery_factor(torques, speeds, discharge, charge, motors(car))
    assume(not math.isnan(factor))
    ours = wheels_scale(torques, speeds, discharge, charge, car)
    assert ours == pytest.approx(factor, rel=1e-9, abs=1e-9)
    assert 0.0 <= ours <= 1.0
    if ours > 0.0:
        assert -charge <= wheels_power_w(torques, speeds, ours, car) <= discharge


DRIVEN, BRAKED = (50.0, 48.0, 40.0, 38.0), (-50.0, -48.0, -40.0, -38.0)
SPEEDS = (45.0, 45.5, 46.0, 46.5)


def test_exactly_at_a_limit_nothing_is_cut():
    car = CARS[0]
    drive, brake = wheels_power_w(DRIVEN, SPEEDS, 1.0, car), wheels_power_w(BRAKED, SPEEDS, 1.0, car)
    assert wheels_scale(DRIVEN, SPEEDS, drive, 0.0, car) == 1.0
    assert wheels_scale(BRAKED, SPEEDS, 0.0, -brake, car) == 1.0
    assert wheels_scale(DRIVEN, SPEEDS, drive - 1e-6, 0.0, car) < 1.0
    assert wheels_scale(BRAKED, SPEEDS, 0.0, -brake - 1e-6, car) < 1.0


def test_a_limit_that_a_factor_meets_exactly_is_used_up():
    car = CARS[1]
    # One half is the first factor the search tries.
    drive, brake = wheels_power_w(DRIVEN, SPEEDS, 0.5, car), wheels_power_w(BRAKED, SPEEDS, 0.5, car)
    assert wheels_scale(DRIVEN, SPEEDS, drive, 0.0, car) == 0.5
    assert wheels_scale(BRAKED, SPEEDS, 0.0, -brake, car) == 0.5


def test_an_empty_battery_takes_the_regeneration_that_fits_and_not_none():
    torques, speeds = (-80.0,) * 4, (45.0,) * 4
    scale = wheels_scale(torques, speeds, 0.0, 500.0, CARS[1])
    assert wheels_power_w(torques, speeds, scale, CARS[1]) == pytest.approx(-500.0, rel=1e-6)


def test_where_zero_torque_is_already_too_much_nothing_is_driven():
    assert wheels_scale((50.0,) * 4, (45.0,) * 4, 10.0, 0.0, CARS[2]) == 0.0
    assert wheels_scale((-50.0,) * 4, (45.0,) * 4, 0.0, 0.0, CARS[1]) == 0.0
