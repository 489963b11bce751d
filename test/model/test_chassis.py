# SPDX-License-Identifier: Apache-2.0
"""Road load and load transfer against the balance of forces and moments."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iwm_power_manager.model import chassis as model
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle
from oracles import physics

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params
CHASSIS = CAR.chassis._replace(front_axle_to_cg_m=0.8, rear_axle_to_cg_m=1.04)
SPEED, GRADE = st.floats(0.0, 60.0), st.floats(-0.3, 0.3)


@given(SPEED, GRADE)
def test_road_load_is_the_sum_of_air_rolling_and_slope(speed, grade):
    assert model.road_load_n(speed, grade, CHASSIS) == pytest.approx(physics.road_load(speed, grade, CHASSIS))


def test_road_load_by_hand():
    assert model.aerodynamic_force_n(20.0, CAR.chassis) == pytest.approx(0.5 * 1.2 * 1.66 * 0.34 * 400.0)
    assert model.rolling_force_n(0.0, CAR.chassis) == pytest.approx(78.48)
    assert model.grade_force_n(0.75, CAR.chassis) == pytest.approx(0.6 * 800.0 * 9.81)
    assert model.rolling_force_n(0.75, CAR.chassis) == pytest.approx(0.8 * 78.48)


@given(st.floats(-15.0, 15.0), SPEED, GRADE)
def test_normal_forces_balance_weight_and_moments(acceleration, speed, grade):
    ours = model.normal_forces_n(acceleration, speed, grade, CHASSIS)
    assert ours == pytest.approx(physics.normal_forces(acceleration, speed, grade, CHASSIS), abs=1e-6)
    assert min(ours) >= 0.0
    assert 2.0 * sum(ours) == pytest.approx(CHASSIS.mass_kg * 9.81 * math.cos(math.atan(grade)))


def test_load_moves_to_the_rear_under_acceleration():
    # m a h / 2L: 800 * 3 * 0.6 / 3.68 N from each front wheel to each rear wheel.
    front, rear = model.normal_forces_n(3.0, 0.0, 0.0, CAR.chassis)
    assert (front, rear) == pytest.approx((1962.0 - 391.304, 1962.0 + 391.304), abs=1e-3)


def test_wheels_add_to_the_mass_that_accelerates():
    assert model.equivalent_mass_kg(CAR) == pytest.approx(800.0 + 4.4 / 0.33**2)
