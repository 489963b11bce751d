# SPDX-License-Identifier: Apache-2.0
"""The motor: the check points of its fit, idle drives, maps, limits and heat."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import RegularGridInterpolator

from iwm_power_manager.model import motor as model
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle
from oracles import physics
from oracles.step import electrical_w, loss_w

MOTORS = {
    drive: load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml"), drive).params.front.motor
    for drive in ("none", "drag", "enabled")
}
MOTOR = MOTORS["none"]
TORQUE = st.one_of(st.just(0.0), st.floats(-80.0, 200.0))
SPEED = st.floats(0.0, 150.0)

MAPPED = MOTOR._replace(
    map_speed_radps=np.array([0.0, 20.0, 50.0, 120.0]),
    map_torque_nm=np.array([-80.0, -20.0, 0.0, 40.0, 200.0]),
    map_loss_w=np.random.default_rng(4).uniform(40.0, 3000.0, 20),
)


def efficiency(wheel, torque):
    return torque * wheel / model.electrical_power_w(torque, wheel, MOTOR)


@pytest.mark.parametrize(
    ("wheel", "torque", "known"), [(8.7, 80, 0.516), (30, 80, 0.779), (60, 40, 0.878), (90, 80, 0.897)]
)
def test_the_check_points_of_the_fit_come_out(wheel, torque, known):
    assert efficiency(float(wheel), float(torque)) == pytest.approx(known, abs=0.0006)


def test_the_best_point_within_the_power_limit_comes_out():
    # Up to 1000 rpm.
    best = max(
        efficiency(w, t) for w in np.linspace(5.0, 104.7, 200) for t in np.linspace(5.0, 200.0, 79) if w * t <= 7500.0
    )
    assert best == pytest.approx(0.906, abs=0.001)


@given(TORQUE, SPEED, st.sampled_from(list(MOTORS.values())))
def test_electrical_power_is_shaft_power_and_losses(torque, wheel, motor):
    assert model.electrical_power_w(torque, wheel, motor) == pytest.approx(electrical_w(torque, wheel, motor), abs=1e-9)


@given(st.floats(0.1, 200.0), SPEED)
def test_regenerating_loses_what_driving_loses(torque, wheel):
    loss = model.enabled_loss_w(torque, wheel, MOTOR)
    assert loss == model.enabled_loss_w(-torque, wheel, MOTOR)
    assert loss == pytest.approx(loss_w(torque, wheel, MOTOR))
    assert model.electrical_power_w(torque, wheel, MOTOR) + model.electrical_power_w(
        -torque, wheel, MOTOR
    ) == pytest.approx(2.0 * loss, abs=1e-9)


@pytest.mark.parametrize(
    ("drive", "power", "drag"),
    [("none", 0.0, 0.0), ("drag", 10.0, 0.69 + 0.0151 * 40.0), ("enabled", 46.0 + 0.69 * 40.0 + 0.0151 * 1600.0, 0.0)],
)
def test_what_an_idle_motor_costs_is_a_setting(drive, power, drag):
    assert model.electrical_power_w(0.0, 40.0, MOTORS[drive]) == pytest.approx(power)
    assert model.idle_drag_nm(0.0, 40.0, MOTORS[drive]) == pytest.approx(drag)
    assert model.idle_drag_nm(1.0, 40.0, MOTORS[drive]) == 0.0


@given(st.floats(-150.0, 300.0), st.floats(-10.0, 200.0))
def test_a_map_is_bilinear_inside_and_holds_its_edge_outside(torque, wheel):
    table = MAPPED.map_loss_w.reshape(4, 5)
    known = RegularGridInterpolator((MAPPED.map_speed_radps, MAPPED.map_torque_nm), table)
    expected = known((np.clip(wheel, 0.0, 120.0), np.clip(torque, -80.0, 200.0)))
    assert model.enabled_loss_w(torque, wheel, MAPPED) == pytest.approx(float(expected))


@given(st.floats(0.0, 200.0), st.floats(-0.5, 1.5))
def test_torque_is_limited_by_heat_and_by_power(wheel, heat):
    assert model.torque_limit_nm(wheel, heat, MOTOR) == pytest.approx(physics.torque_limit(wheel, heat, MOTOR))


@pytest.mark.parametrize(
    ("wheel", "heat", "limit"),
    [(0.0, 0.0, 200.0), (0.0, 0.5, 140.0), (0.0, 1.0, 80.0), (0.0, 2.0, 80.0), (75.0, 0.0, 100.0), (75.0, 1.0, 80.0)],
)
def test_torque_limits_by_hand(wheel, heat, limit):
    assert model.torque_limit_nm(wheel, heat, MOTOR) == pytest.approx(limit)


@given(st.floats(0.0, 200.0), st.floats(0.0, 60.0), st.floats(0.0, 1.2))
def test_regeneration_is_limited_and_fades_out(wheel, speed, heat):
    expected = physics.regeneration_limit(wheel, speed, heat, MOTOR)
    assert model.regeneration_limit_nm(wheel, speed, heat, MOTOR) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(("speed", "limit"), [(0.0, 0.0), (1.0, 0.0), (2.0, 40.0), (3.0, 80.0), (10.0, 80.0)])
def test_regeneration_limits_by_hand(speed, limit):
    assert model.regeneration_limit_nm(speed / 0.33, speed, 0.0, MOTOR) == pytest.approx(limit)


def test_heat_is_a_first_order_lag_towards_the_square_of_the_torque():
    heat, tau, dt = 0.0, MOTOR.thermal_time_constant_s, 0.01
    for _ in range(9000):
        heat = model.heat_after(heat, 60.0, dt, MOTOR)
    assert heat == pytest.approx((60.0 / 80.0) ** 2 * (1.0 - math.exp(-9000 * dt / tau)), rel=1e-4)


def test_continuous_torque_heats_to_one_and_rest_cools_to_nothing():
    assert model.heat_after(1.0, 80.0, 0.5, MOTOR) == pytest.approx(1.0)
    assert model.heat_after(1.0, -80.0, 0.5, MOTOR) == pytest.approx(1.0)
    assert model.heat_after(1.0, 0.0, 1e9, MOTOR) == pytest.approx(0.0, abs=1e-6)
