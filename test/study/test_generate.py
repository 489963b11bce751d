# SPDX-License-Identifier: Apache-2.0
"""Generated cycles, cars and noise: the same from the same seed, and sane whatever the seed."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from iwm_power_manager.model.chassis import GRAVITY_MPS2
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle
from iwm_sim.study import generate

BASE = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml"))
MAPPED = load_vehicle(share_path("config/vehicles/jalalmaab_2015_map.yaml")).params.front.motor
SEEDS = st.integers(0, 10_000)


@given(SEEDS)
def test_a_cycle_starts_and_ends_at_rest_and_asks_for_nothing_no_car_does(seed):
    cycle = generate.cycle(seed, 200)
    acceleration = np.diff(cycle.speed_mps)
    assert cycle.speed_mps[0] == cycle.speed_mps[-1] == 0.0
    assert acceleration.max() <= 2.3 and acceleration.min() >= -4.0
    assert cycle.speed_mps.max() <= 36.0 and np.abs(cycle.grade).max() <= 0.08
    assert np.array_equal(cycle.speed_mps, generate.cycle(seed, 200).speed_mps)


def test_cycles_reach_from_town_to_motorway_and_differ():
    means = [generate.cycle(seed).speed_mps.mean() for seed in range(40)]
    assert min(means) < 6.0 and max(means) > 22.0 and len(set(means)) == 40


@given(SEEDS)
def test_a_car_can_be_driven_and_keeps_to_the_ranges(seed):
    car = generate.car(seed, BASE, MAPPED).params
    chassis = car.chassis
    assert 350.0 <= chassis.mass_kg <= 2800.0
    assert chassis.cg_height_m < min(chassis.front_axle_to_cg_m, chassis.rear_axle_to_cg_m)
    pull = sum(2.0 * axle.motor.peak_torque_nm / axle.wheel.radius_m for axle in (car.front, car.rear))
    assert 2.7 <= pull / chassis.mass_kg <= 4.3
    for axle in (car.front, car.rear):
        assert axle.motor.continuous_torque_nm <= axle.motor.peak_torque_nm
        assert axle.motor.regeneration_torque_nm <= axle.motor.peak_torque_nm
        assert np.all(axle.motor.map_loss_w >= 0.0)
    assert car.front.friction_brake.max_torque_nm * 4.0 > 0.8 * chassis.mass_kg * GRAVITY_MPS2 * 0.35


def test_cars_are_small_and_large_with_equal_and_unequal_axles_with_and_without_a_map():
    cars = [generate.car(seed, BASE, MAPPED) for seed in range(40)]
    masses = [car.params.chassis.mass_kg for car in cars]
    assert min(masses) < 500.0 and max(masses) > 2200.0
    uneven = [car.params.front.motor.max_power_w != car.params.rear.motor.max_power_w for car in cars]
    mapped = [car.params.front.motor.map_torque_nm.size > 0 for car in cars]
    assert 10 <= sum(uneven) <= 30 and 6 <= sum(mapped) <= 22
    assert len({car.hash for car in cars}) == 40


def test_a_logged_cycle_has_steps_of_a_tenth_of_a_kilometre_an_hour_at_ten_hertz():
    cycle = generate.cycle(3, 60)
    logged = generate.logged(cycle, 0.1, seed=1)
    assert np.allclose(np.diff(logged.time_s), 0.1)
    assert np.allclose(np.round(logged.speed_mps * 36.0), logged.speed_mps * 36.0)
    true = np.interp(logged.time_s, cycle.time_s, cycle.speed_mps)
    moving = true > 1.0
    # Rounding to steps of q adds q^2 / 12.
    expected = np.hypot(0.1 / 3.6, 0.1 / 3.6 / np.sqrt(12.0))
    assert np.std((logged.speed_mps - true)[moving]) == pytest.approx(expected, rel=0.15)
    assert np.all(logged.speed_mps[true == 0.0] == 0.0)


def test_a_foot_shakes_at_ten_hertz():
    noise = generate.pedal_noise(100_000, 0.01, seed=4)
    assert noise.size == 100_000
    assert np.std(noise) == pytest.approx(0.01, rel=0.05)
    assert np.all(noise.reshape(-1, 10) == noise[::10, None])
