# SPDX-License-Identifier: Apache-2.0
"""Battery limits: derating by charge and temperature, and the part of the torques that fits in."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from iwm_power_manager.model.limits import battery_limits_w, battery_scale, car_power_w, fade
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle
from oracles.control_law import battery_factor
from oracles.step import electrical_w

CARS = [
    load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml"), drive).params
    for drive in ("none", "drag", "enabled")
]
BATTERY = CARS[0].battery
TORQUE = st.one_of(st.just(0.0), st.floats(0.1, 200.0), st.floats(-80.0, -0.1))
SPEED = st.floats(0.0, 120.0)


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


@given(TORQUE, TORQUE, SPEED, SPEED, st.sampled_from(CARS))
def test_the_car_takes_what_its_four_motors_take(front, rear, front_speed, rear_speed, car):
    expected = 2.0 * electrical_w(front, front_speed, car.front.motor) + 2.0 * electrical_w(
        rear, rear_speed, car.front.motor
    )
    assert car_power_w(front, rear, front_speed, rear_speed, car.front.motor) == pytest.approx(expected, abs=1e-9)


@given(TORQUE, TORQUE, SPEED, SPEED, st.floats(1.0, 47500.0), st.floats(1.0, 47500.0), st.sampled_from(CARS))
def test_the_scale_is_the_largest_factor_inside_the_limits(
    front, rear, front_speed, rear_speed, discharge, charge, car
):
    motor = car.front.motor
    torques, speeds = (front, front, rear, rear), (front_speed, front_speed, rear_speed, rear_speed)
    factor, _ = battery_factor(torques, speeds, discharge, charge, (motor,) * 4)
    assume(not math.isnan(factor))
    ours = battery_scale(front, rear, front_speed, rear_speed, discharge, charge, car.front.motor)
    assert ours == pytest.approx(factor, rel=1e-9, abs=1e-9)
    assert 0.0 <= ours <= 1.0
    if ours > 0.0:
        power = car_power_w(ours * front, ours * rear, front_speed, rear_speed, car.front.motor)
        assert -charge <= power <= discharge


def test_exactly_at_a_limit_nothing_is_cut():
    motor = CARS[0].front.motor
    drive, brake = car_power_w(50.0, 40.0, 45.0, 46.0, motor), car_power_w(-50.0, -40.0, 45.0, 46.0, motor)
    assert battery_scale(50.0, 40.0, 45.0, 46.0, drive, 0.0, motor) == 1.0
    assert battery_scale(-50.0, -40.0, 45.0, 46.0, 0.0, -brake, motor) == 1.0
    assert battery_scale(50.0, 40.0, 45.0, 46.0, drive - 1e-6, 0.0, motor) < 1.0
    assert battery_scale(-50.0, -40.0, 45.0, 46.0, 0.0, -brake - 1e-6, motor) < 1.0


def test_a_limit_that_a_factor_meets_exactly_is_used_up():
    motor = CARS[1].front.motor
    # One half is the first factor the search tries.
    drive, brake = car_power_w(25.0, 20.0, 45.0, 46.0, motor), car_power_w(-25.0, -20.0, 45.0, 46.0, motor)
    assert battery_scale(50.0, 40.0, 45.0, 46.0, drive, 0.0, motor) == 0.5
    assert battery_scale(-50.0, -40.0, 45.0, 46.0, 0.0, -brake, motor) == 0.5


def test_an_empty_battery_takes_the_regeneration_that_fits_and_not_none():
    motor = CARS[1].front.motor
    scale = battery_scale(-80.0, -80.0, 45.0, 45.0, 0.0, 500.0, motor)
    assert car_power_w(scale * -80.0, scale * -80.0, 45.0, 45.0, motor) == pytest.approx(-500.0, rel=1e-6)


def test_where_zero_torque_is_already_too_much_nothing_is_driven():
    assert battery_scale(50.0, 50.0, 45.0, 45.0, 10.0, 0.0, CARS[2].front.motor) == 0.0
    assert battery_scale(-50.0, -50.0, 45.0, 45.0, 0.0, 0.0, CARS[1].front.motor) == 0.0
