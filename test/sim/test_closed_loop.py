# SPDX-License-Identifier: Apache-2.0
"""Driver, law and plant together: books, determinism, convergence, and the same bits from Python."""

from __future__ import annotations

import numpy as np
import pytest

from iwm_power_manager.control import law
from iwm_power_manager.control.settings import GATE_MODE_LIMITER, GATE_MODE_OFF, default_settings
from iwm_power_manager.control.table import empty_table
from iwm_power_manager.control.types import initial_state
from iwm_power_manager.cycle import load_cycle, make_cycle
from iwm_power_manager.model.driver import DriverState, drive, sample
from iwm_power_manager.model.pedals import full_braking_w
from iwm_power_manager.model.tyre import slip_ratio
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle, with_params
from iwm_sim import closed_loop, plant
from iwm_sim.closed_loop import COLUMNS, Noise, run
from iwm_sim.metrics import longest_s, measure
from oracles.plant import imbalance_j, open_circuit_v

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml"))
NYCC = load_cycle(share_path("config/cycles/nycc.csv"))
EQUAL = default_settings("equal")
TABLE = empty_table()
SHORT = make_cycle("short", [0.0, 4.0, 8.0, 12.0, 15.0], [0.0, 12.0, 12.0, 1.0, 0.0], [0.0, 0.02, 0.02, -0.01, 0.0])


@pytest.fixture(scope="module")
def nycc():
    return run(NYCC, CAR, EQUAL, TABLE, 0.9)


def test_the_books_close_over_a_whole_cycle(nycc):
    start = plant.initial_plant(CAR.params, 0.8)
    assert abs(imbalance_j(start, nycc.final, CAR.params)) < 1e-9 * nycc.final.energies.chemical_j


def test_the_charge_that_left_is_the_chemical_energy_that_left(nycc):
    soc = np.linspace(nycc.final.soc, 0.8, 2001)
    volts = np.array([open_circuit_v(x, CAR.params.battery) for x in soc])
    carried = 3600.0 * CAR.params.battery.capacity_ah * np.trapezoid(volts, soc)
    assert nycc.final.energies.chemical_j == pytest.approx(carried, rel=1e-5)
    assert nycc["soc"][0] == 0.8
    current = np.sum(nycc["current_a"]) * nycc.dt_s
    assert 0.8 - nycc.final.soc == pytest.approx(current / 3600.0 / CAR.params.battery.capacity_ah, rel=1e-9)


def test_the_paper_s_car_drives_nycc_within_the_band_at_a_plausible_consumption(nycc):
    found = measure(nycc, CAR.params)
    assert found.trace_held
    assert found.rms_speed_error_mps < 0.2
    assert 76.0 < found.wh_per_km < 125.0
    assert found.distance_m == pytest.approx(NYCC.distance_m, rel=0.005)


def test_the_same_run_gives_the_same_bits(nycc):
    again = run(NYCC, CAR, EQUAL, TABLE, 0.9)
    assert again.series.tobytes() == nycc.series.tobytes()
    assert again.final == nycc.final


@pytest.mark.parametrize("finer", [{"dt_s": 0.005}, {"substeps": 2}])
def test_half_the_step_changes_the_energy_of_nycc_by_less_than_a_thousandth(nycc, finer):
    fine = run(NYCC, CAR, EQUAL, TABLE, 0.9, **finer)
    assert fine.final.energies.chemical_j == pytest.approx(nycc.final.energies.chemical_j, rel=1e-3)
    assert fine.final.distance_m == pytest.approx(nycc.final.distance_m, rel=1e-3)


def test_stepping_the_kernels_from_python_gives_the_bits_of_the_compiled_loop():
    params, dt, steps = CAR.params, 0.01, 1500
    rng = np.random.default_rng(5)
    noise = Noise(rng.normal(0.0, 0.1, steps), rng.normal(0.0, 0.3, (steps, 4)))
    settings = default_settings("instantaneous_slip")
    compiled = run(SHORT, CAR, settings, TABLE, 0.5, assumed_friction=0.4, substeps=2, noise=noise)
    trace = sample(SHORT, dt, params.driver.preview_s)
    car, driver, state = plant.initial_plant(params, 0.8, 0.0), DriverState(0.0), initial_state()
    for k in range(steps):
        at = [float(x[k]) for x in trace]
        pedals, driver = drive(driver, car.speed_mps, *at, dt, params)
        measurement = closed_loop.measure(
            car,
            pedals.power_demand_w,
            dt,
            0.4,
            float(noise.speed_mps[k]),
            tuple(map(float, noise.wheel_radps[k])),
            params,
        )
        command, state = law.step(measurement, state, settings, params, TABLE)
        row = dict(zip(COLUMNS, compiled.series[k], strict=True))
        assert (row["speed_mps"], row["power_demand_w"], row["soc"]) == (car.speed_mps, pedals.power_demand_w, car.soc)
        assert (row["decided_share"], row["front_share"]) == (command.decided_share, command.front_share)
        assert (row["gate"], row["limits"]) == (command.gate, command.limits)
        assert (row["front_power_w"], row["rear_power_w"]) == (command.front_power_w, command.rear_power_w)
        surroundings = plant.Surroundings((0.5,) * 4, at[3])
        car = plant.advance(car, command.motor_torque_nm, command.friction_torque_nm, 0.0, surroundings, dt, 2, params)
        assert (row["electrical_power_w"], row["chemical_j"]) == (car.electrical_power_w, car.energies.chemical_j)
    assert car == compiled.final
    assert compiled["speed_mps"].max() > 11.0


def test_the_trace_is_sampled_linearly_with_what_the_driver_sees_ahead():
    trace = sample(SHORT, 0.5, 0.25)
    assert len(trace.speed_mps) == 30
    assert trace.speed_mps[[0, 1, 8, 16]].tolist() == [0.0, 1.5, 12.0, 12.0]
    assert trace.ahead_mps[:2].tolist() == [0.75, 2.25]
    assert trace.ahead_mps2[0] == pytest.approx(3.0)
    assert trace.grade[4] == pytest.approx(0.01)


def test_a_run_can_end_before_the_cycle(nycc):
    part = run(NYCC, CAR, EQUAL, TABLE, 0.9, until_s=50.0)
    assert part.series.shape == (5000, len(COLUMNS))
    assert np.array_equal(part.series, nycc.series[:5000])


def test_the_car_that_is_driven_may_differ_from_the_one_the_law_knows():
    heavy = with_params(CAR, "heavy", CAR.params._replace(chassis=CAR.params.chassis._replace(mass_kg=960.0)))
    known = run(SHORT, CAR, EQUAL, TABLE, 0.9)
    surprised = run(SHORT, CAR, EQUAL, TABLE, 0.9, plant_vehicle=heavy)
    assert surprised["power_demand_w"].max() > known["power_demand_w"].max()
    # The pedals ask for less on the car the law believes in: it lags behind the trace a little more.
    assert measure(surprised, CAR.params).rms_speed_error_mps > measure(known, CAR.params).rms_speed_error_mps


def test_a_battery_nearly_empty_or_full_limits_what_the_law_may_do():
    empty = run(SHORT, CAR, EQUAL, TABLE, 0.9, soc=0.03)
    assert empty["electrical_power_w"].max() < 7000.0
    full = run(SHORT, CAR, EQUAL, TABLE, 0.9, soc=0.9999)
    # The charge limit fades from 95 % on; the plant's wheels turn a little from when the law looked.
    allowed = CAR.params.battery.charge_limit_w * np.minimum((1.0 - full["soc"]) / 0.05, 1.0)
    assert np.all(full["electrical_power_w"] > -1.01 * allowed - 5.0)
    assert full["front_friction_nm"].min() < -20.0
    assert run(SHORT, CAR, EQUAL, TABLE, 0.9)["electrical_power_w"].min() < -3000.0


def stop(friction, gate_mode):
    """Stopping distance from 25 m/s with more braking asked for than any road gives, and the slips above 1 m/s."""
    params, dt, settings = CAR.params, 0.01, EQUAL._replace(gate_mode=gate_mode)
    car, state, slips = plant.initial_plant(params, 0.8, 25.0), initial_state(), []
    while car.speed_mps > 0.01:
        demand = -1.5 * full_braking_w(car.speed_mps, params)
        measurement = closed_loop.measure(car, demand, dt, friction, 0.0, (0.0,) * 4, params)
        command, state = law.step(measurement, state, settings, params, TABLE)
        car = plant.advance(
            car,
            command.motor_torque_nm,
            command.friction_torque_nm,
            0.0,
            plant.Surroundings((friction,) * 4),
            dt,
            1,
            params,
        )
        if car.speed_mps > 1.0:
            slips.append(
                [slip_ratio(w, car.speed_mps, params.front.wheel.radius_m, 0.5) for w in car.wheel_speed_radps[1:3]]
            )
    return car.distance_m, np.array(slips)


@pytest.mark.parametrize("friction", [0.2, 0.5, 0.9])
def test_full_braking_stops_within_5_percent_of_the_best_constant_slip_without_locking(friction):
    distance, slips = stop(friction, GATE_MODE_LIMITER)
    assert distance < 1.05 * 25.0**2 / (2.0 * friction * 9.81)
    for axle in slips.T:
        assert longest_s(axle < -0.2, 0.01) <= 0.1


@pytest.mark.parametrize("friction", [0.1, 0.2, 0.3])
def test_a_launch_on_ice_holds_the_wheels_at_their_grip_from_walking_pace_on(friction):
    launch = run(make_cycle("launch", [0.0, 1.0, 11.0], [0.0, 0.0, 40.0]), CAR, EQUAL, TABLE, friction)
    speed, motor = launch["speed_mps"], launch["front_motor_nm"]
    first = int(np.argmax(launch["front_slip"] > 0.15))
    assert speed[first] < 1.0, "the trace asks for more than the road gives from the first"
    after = slice(first + 25, first + 400)
    assert not launch["gate"][after].any()
    assert motor[after].min() > 0.9 * motor[after].max()


def test_without_skid_avoidance_the_wheels_lock():
    distance, slips = stop(0.2, GATE_MODE_OFF)
    assert slips.min() == -1.0
    assert distance > stop(0.2, GATE_MODE_LIMITER)[0]
