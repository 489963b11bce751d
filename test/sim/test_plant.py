# SPDX-License-Identifier: Apache-2.0
"""The simulated car: its battery, motors and brakes against closed forms, its motion against SciPy, its books."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle
from iwm_sim.plant import (
    Surroundings,
    advance,
    initial_plant,
    obeyed_torque_nm,
    ohmic_resistance_ohm,
    open_circuit_v,
)
from oracles import physics
from oracles import plant as oracle

CARS = {
    name: load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml"), name).params
    for name in ("none", "drag", "enabled")
}
CAR = CARS["none"]
RADIUS = CAR.front.wheel.radius_m
NOTHING = (0.0, 0.0, 0.0, 0.0)
DRY = (0.9, 0.9, 0.9, 0.9)
HELD = (-900.0, -900.0, -900.0, -900.0)

#: Standing and idle, its four motors draw 10 kW: a constant load for the battery.
LOADED = CARS["enabled"].with_axles(motor=CARS["enabled"].front.motor._replace(loss_constant_w=2500.0))


def four(x):
    return (x, x, x, x)


def hold(
    state, seconds, dt=0.01, motor=NOTHING, brake=NOTHING, grade=0.0, road=DRY, car=CAR, substeps=1, steer=0.0, wind=0.0
):
    for _ in range(round(seconds / dt)):
        state = advance(state, motor, brake, steer, Surroundings(road, grade, wind), dt, substeps, car)
    return state


# --- Battery ---------------------------------------------------------------------------------------------------------


@given(st.floats(-0.1, 1.1))
def test_open_circuit_voltage_and_resistance_follow_the_charge(soc):
    assert open_circuit_v(soc, CAR.battery) == pytest.approx(oracle.open_circuit_v(soc, CAR.battery))
    assert ohmic_resistance_ohm(soc, CAR.battery) == pytest.approx(oracle.ohmic_ohm(soc, CAR.battery))


def test_resistance_at_its_named_points():
    ohm = CAR.battery.ohmic_resistance_ohm
    assert [ohmic_resistance_ohm(x, CAR.battery) / ohm for x in (1.0, 0.3, 0.2, 0.1)] == pytest.approx(
        [1.0, 1.0, 1.2, 1.4]
    )


@pytest.mark.parametrize("seconds", [0.1, 16.0, 120.0])
@pytest.mark.parametrize("soc", [0.8, 0.15])
def test_a_constant_load_charges_the_polarisation_branch_as_the_circuit_says(seconds, soc):
    state = hold(initial_plant(LOADED, soc), seconds, 0.1, brake=HELD, car=LOADED)
    known_soc, polarisation, current = oracle.battery_at(10e3, seconds, soc, LOADED.battery)
    assert state.electrical_power_w == pytest.approx(10e3)
    assert state.polarisation_v == pytest.approx(polarisation, rel=2e-3)
    assert state.current_a == pytest.approx(current, rel=1e-4)
    assert soc - state.soc == pytest.approx(soc - known_soc, rel=1e-3)


def test_the_step_response_has_its_time_constant():
    """At an almost constant current, u = R1 I (1 - exp(-t / tau))."""
    after = {t: hold(initial_plant(LOADED, 0.6), t, 0.1, brake=HELD, car=LOADED) for t in (16.0, 160.0)}
    full = LOADED.battery.polarisation_resistance_ohm * after[160.0].current_a
    assert after[160.0].polarisation_v == pytest.approx(full, rel=1e-3)
    assert after[16.0].polarisation_v == pytest.approx((1.0 - math.exp(-1.0)) * full, rel=5e-3)
    state = after[160.0]
    assert state.terminal_v * state.current_a == pytest.approx(10e3)


def test_a_pack_without_polarisation_is_a_source_behind_a_resistance():
    battery = LOADED.battery._replace(polarisation_resistance_ohm=0.0)
    car = LOADED._replace(battery=battery)
    state = hold(initial_plant(car, 0.8), 5.0, 0.1, brake=HELD, car=car)
    assert state.polarisation_v == 0.0
    assert oracle.imbalance_j(initial_plant(car, 0.8), state, car) == pytest.approx(0.0, abs=1e-6)


# --- Motors and brakes -----------------------------------------------------------------------------------------------


@given(st.floats(-300.0, 300.0), st.floats(-150.0, 150.0), st.floats(-10.0, 40.0), st.floats(0.0, 1.2))
def test_a_motor_obeys_as_far_as_it_can(command, wheel, speed, heat):
    high = physics.torque_limit(abs(wheel), heat, CAR.front.motor)
    low = -physics.regeneration_limit(abs(wheel), speed, heat, CAR.front.motor) if speed > 0.1 else -high
    assert obeyed_torque_nm(command, wheel, speed, heat, CAR.front.motor) == pytest.approx(
        min(max(command, low), high), abs=1e-9
    )


def test_a_motor_heats_up_by_the_square_of_its_torque():
    state = hold(initial_plant(CAR), 45.0, 0.1, motor=(60.0, 50.0, 30.0, 0.0), brake=HELD)
    expected = [(t / 80.0) ** 2 * (1.0 - math.exp(-0.5)) for t in (60.0, 50.0, 30.0, 0.0)]
    assert state.heat == pytest.approx(tuple(expected), rel=2e-3, abs=1e-12)


def test_a_hot_motor_derates_to_its_continuous_torque():
    state = hold(initial_plant(CAR), 3000.0, 1.0, motor=four(500.0), brake=HELD)
    assert state.heat == pytest.approx(four(1.0), abs=0.01)
    assert state.motor_torque_nm == pytest.approx(four(80.0), rel=0.02)
    cold = hold(initial_plant(CAR), 1.0, 1.0, motor=four(500.0), brake=HELD)
    assert cold.motor_torque_nm == four(200.0)


def test_each_motor_is_held_back_by_its_own_heat():
    heat = (1.0, 0.2, 0.6, 0.4)
    state = hold(initial_plant(CAR)._replace(heat=heat), 0.01, motor=four(500.0), brake=HELD)
    assert state.motor_torque_nm == pytest.approx(tuple(200.0 - 120.0 * h for h in heat))


def test_brakes_only_brake_and_no_harder_than_they_can():
    start = initial_plant(CAR, 0.8, 20.0)
    assert hold(start, 0.01, brake=four(50.0)).friction_torque_nm == NOTHING
    assert hold(start, 0.001, 0.001, brake=four(-5000.0)).friction_torque_nm == pytest.approx(four(-900.0))
    assert hold(start, 0.01, brake=four(-100.0)).friction_torque_nm == pytest.approx(four(-100.0))


def test_idle_drives_drag_and_draw_what_they_are_set_to():
    start = initial_plant(CAR, 0.8, 20.0)
    slowed = {name: hold(start, 10.0, 0.01, car=car) for name, car in CARS.items()}
    assert slowed["none"].energies.idle_drag_j == slowed["enabled"].energies.idle_drag_j == 0.0
    assert slowed["drag"].speed_mps < slowed["none"].speed_mps == slowed["enabled"].speed_mps
    assert slowed["none"].electrical_power_w == 0.0
    assert slowed["drag"].electrical_power_w == pytest.approx(40.0)
    rolling = slowed["drag"].distance_m / RADIUS
    assert slowed["drag"].energies.idle_drag_j == pytest.approx(
        4.0 * rolling * (0.69 + 0.0151 * rolling / 10.0), rel=0.01
    )


def test_what_brake_and_drag_take_from_a_wheel_that_stops_is_shared_as_told():
    state = hold(initial_plant(CARS["drag"], 0.8, 0.5), 2.0, 0.01, brake=four(-100.0), car=CARS["drag"])
    assert state.energies.friction_brake_j > 20.0 * state.energies.idle_drag_j > 0.0


# --- Motion ----------------------------------------------------------------------------------------------------------


def test_it_moves_as_scipy_says():
    motors, brakes, grade, road = (60.0, 60.0, -40.0, -40.0), (0.0, 0.0, 80.0, 80.0), 0.02, (0.9, 0.9, 0.5, 0.5)
    start = initial_plant(CAR, 0.8, 15.0)
    state = hold(start, 0.5, 0.01, motors, tuple(-x for x in brakes), grade, road, substeps=20)
    speed, wheels = physics.dynamics(15.0, four(15.0 / RADIUS), motors, brakes, grade, road, 0.5, CAR)
    assert state.speed_mps == pytest.approx(speed, abs=2e-3)
    assert state.wheel_speed_radps == pytest.approx(tuple(wheels), abs=0.02)
    assert state.distance_m == pytest.approx(0.5 * 0.5 * (15.0 + speed), rel=1e-3)


def test_substeps_are_steps():
    start = initial_plant(CAR, 0.8, 10.0)
    once = hold(start, 0.02, 0.02, four(50.0), substeps=4)
    steps = hold(start, 0.02, 0.005, four(50.0))
    assert once._replace(heat=NOTHING) == steps._replace(heat=NOTHING)
    assert once.heat == pytest.approx(steps.heat, rel=1e-3)


def test_a_car_starts_rested_and_rolling():
    state = initial_plant(CAR, 0.7, 12.0)
    assert state.wheel_speed_radps == four(12.0 / RADIUS)
    assert state.terminal_v == pytest.approx(oracle.open_circuit_v(0.7, CAR.battery))
    assert (state.soc, state.speed_mps, state.distance_m) == (0.7, 12.0, 0.0)
    assert sum(state.energies) == 0.0


# --- Books -----------------------------------------------------------------------------------------------------------


@settings(max_examples=50)
@given(
    speed=st.floats(-10.0, 30.0),
    commands=st.lists(
        st.tuples(
            st.tuples(*[st.floats(-100.0, 200.0)] * 4),
            st.tuples(*[st.sampled_from([0.0, -50.0, -400.0])] * 4),
            st.sampled_from([0.0, 0.05, -0.05]),
        ),
        min_size=1,
        max_size=8,
    ),
    road=st.tuples(*[st.sampled_from([0.9, 0.2])] * 4),
    dt=st.sampled_from([0.002, 0.01, 0.05]),
    car=st.sampled_from(list(CARS.values())),
    steer=st.sampled_from([0.0, 0.05, -0.3]),
    wind=st.sampled_from([0.0, 15.0, -15.0]),
)
def test_every_joule_is_accounted_for_whatever_happens(speed, commands, road, dt, car, steer, wind):
    start = state = initial_plant(car, 0.5, speed)
    for motor, brake, grade in commands:
        state = hold(state, 5 * dt, dt, motor, brake, grade, road, car=car, steer=steer, wind=wind)
    turnover = sum(map(abs, state.energies)) + 0.5 * car.chassis.mass_kg * speed**2
    assert oracle.imbalance_j(start, state, car) == pytest.approx(0.0, abs=1e-9 * turnover + 1e-9)
    assert min(state.energies.ohmic_j, state.energies.friction_brake_j, state.energies.idle_drag_j) >= -1e-9
    assert np.isfinite([*state[:1], *state.wheel_speed_radps, *state.heat, *state.energies]).all()


def test_the_charge_that_left_the_pack_carried_its_energy():
    flat = LOADED._replace(battery=LOADED.battery._replace(ocv_cell_v=np.full(11, 3.3)))
    state = hold(initial_plant(flat, 0.8), 60.0, 0.1, brake=HELD, car=flat)
    assert state.energies.chemical_j == pytest.approx((0.8 - state.soc) * 200.0 * 3600.0 * 72.0 * 3.3)
