# SPDX-License-Identifier: Apache-2.0
"""The drive cut open at the control law: the closed loop's numbers, bit for bit, and a run's file."""

import numpy as np
import pytest

from iwm_power_manager.control import law
from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.control.table import empty_table
from iwm_power_manager.control.types import initial_state
from iwm_power_manager.cycle import load_cycle, make_cycle
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.share import resolve
from iwm_power_manager.vehicle import load_vehicle
from iwm_sim import closed_loop
from iwm_sim.drive import CAR_COLUMNS, LAW_COLUMNS, Drive, load_run, save_run
from iwm_sim.scenario import on_cycle

DT = 0.01
NO_ERROR = (0.0, 0.0, 0.0, 0.0)
#: A NumPy file that is no archive.
NPY = (
    b"\x93NUMPY\x01\x00v\x00"
    + b"{'descr': '<f8', 'fortran_order': False, 'shape': (1,), }".ljust(117)
    + b"\n"
    + bytes(8)
)


@pytest.fixture(scope="module")
def vehicle():
    return load_vehicle(resolve("config/vehicles/jalalmaab_2015.yaml"))


@pytest.fixture(scope="module")
def cycle():
    return load_cycle(resolve("config/cycles/nycc.csv"))


@pytest.fixture(scope="module")
def driven(vehicle, cycle):
    """A drive with the law stepped outside of it, as over DDS, to the middle of NYCC's first hills."""
    drive = Drive(on_cycle(vehicle, cycle, 0.9, until_s=75.0), dt_s=DT)
    state, settings, policy = initial_state(), default_settings("equal"), empty_table()
    while not drive.finished:
        demand = drive.sense().power_demand_w
        measurement = closed_loop.measure(drive.car, demand, DT, 0.9, 0.0, NO_ERROR, vehicle.params)
        command, state = law.step(measurement, state, settings, vehicle.params, policy)
        drive.advance(command.motor_torque_nm, command.friction_torque_nm)
    return drive


def test_the_drive_repeats_the_closed_loop_bit_for_bit(vehicle, cycle, driven):
    whole = closed_loop.run(cycle, vehicle, default_settings("equal"), empty_table(), 0.9, dt_s=DT)
    run = driven.run()
    assert len(run.series) == 7500
    assert run["speed_mps"].max() > 8.0
    for name in CAR_COLUMNS:
        np.testing.assert_array_equal(run[name], whole[name][:7500], err_msg=name)


def test_what_only_the_law_knows_stays_empty(driven):
    run = driven.run()
    assert all(np.isnan(run[name]).all() for name in LAW_COLUMNS)


def test_sensing_twice_changes_nothing(vehicle, cycle):
    drive = Drive(on_cycle(vehicle, cycle, 0.9), dt_s=DT)
    assert drive.sense() == drive.sense()
    assert drive.step == 0


def test_warming_up_leaves_the_drive_at_its_start(vehicle, cycle):
    drive = Drive(on_cycle(vehicle, cycle, 0.9), dt_s=DT)
    assert drive.car == closed_loop.plant.initial_plant(vehicle.params, 0.8, 0.0)
    assert len(drive.run().series) == 0


def test_it_ends_with_the_cycle_or_before(vehicle, cycle):
    assert Drive(on_cycle(vehicle, cycle, 0.9), dt_s=DT).duration_s == pytest.approx(598.0)
    assert Drive(on_cycle(vehicle, cycle, 0.9, until_s=1.0), dt_s=DT).duration_s == pytest.approx(1.0)
    assert Drive(on_cycle(vehicle, cycle, 0.9, until_s=1e6), dt_s=DT).duration_s == pytest.approx(598.0)


def test_a_cycle_shorter_than_a_step_is_refused_by_name(vehicle):
    blink = make_cycle("blink", [0.0, 0.001], [0.0, 0.0])
    with pytest.raises(ConfigError, match=r"^blink: time_s: lasts no step of 0\.01 s; allowed: >= 0\.01 s"):
        Drive(on_cycle(vehicle, blink, 0.9), dt_s=DT)


def test_the_pedal_alone_brakes_with_the_force_the_demand_stands_for(vehicle):
    braking = make_cycle("braking", [0.0, 1.0, 9.0], [20.0, 20.0, 0.0])
    drive = Drive(on_cycle(vehicle, braking, 0.9), dt_s=DT)
    while drive.sense().brake == 0.0:
        drive.advance(NO_ERROR, NO_ERROR)
    sensors = drive.sense()
    torque = drive.pedal_brake_torque_nm()
    power = sum(torque) / vehicle.params.front.wheel.radius_m * sensors.speed_mps
    assert power == pytest.approx(sensors.power_demand_w)
    assert all(value < 0.0 for value in torque)


def test_a_car_without_commands_stops_by_its_brakes_alone(vehicle):
    braking = make_cycle("braking", [0.0, 1.0, 9.0, 20.0], [20.0, 20.0, 0.0, 0.0])
    drive = Drive(on_cycle(vehicle, braking, 0.9), dt_s=DT)
    while not drive.finished:
        drive.advance(NO_ERROR, drive.pedal_brake_torque_nm())
    assert drive.car.speed_mps < 0.05
    assert drive.run()["front_motor_nm"].max() == 0.0


def test_a_run_comes_back_from_its_file_as_it_was(tmp_path, driven):
    run = driven.run()
    save_run(tmp_path / "run.npz", run, {"resent": 2})
    again, notes = load_run(tmp_path / "run.npz")
    assert notes == {"resent": 2}
    np.testing.assert_array_equal(again.series, run.series)
    np.testing.assert_array_equal(again.road, run.road)
    assert again.final == run.final
    assert again.dt_s == run.dt_s


@pytest.mark.parametrize(
    "damage", [lambda data: data[:-40], lambda data: b"", lambda data: b"not a zip", lambda data: NPY]
)
def test_a_damaged_run_is_refused_by_name(tmp_path, driven, damage):
    path = tmp_path / "run.npz"
    save_run(path, driven.run())
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(ConfigError, match=r"run\.npz: is (no recorded run|empty|damaged)"):
        load_run(path)


def test_a_run_of_other_columns_is_refused(tmp_path):
    path = tmp_path / "run.npz"
    np.savez(path, columns=np.array(["time_s"]), dt_s=DT, series=np.zeros((2, 1)), final=np.zeros(3))
    with pytest.raises(ConfigError, match="columns: are those of another version"):
        load_run(path)
