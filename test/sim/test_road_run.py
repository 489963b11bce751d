# SPDX-License-Identifier: Apache-2.0
"""Scenarios driven with the power manager: roads, faults, messages and bounds do what the file says."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from campaigns.road_page import page
from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle
from iwm_sim import road_run
from iwm_sim.closed_loop import RoadRow
from iwm_sim.drive import Drive
from iwm_sim.faults import Fault
from iwm_sim.road_measures import driven
from iwm_sim.road_report import text
from iwm_sim.scenario import Bound, Demand, Friction, Scenario, load_scenario

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml"))
EQUAL = default_settings("equal")
STOP = Scenario("stop", CAR, CAR.params, 4.0, demand=(Demand(0.2, "brake", 0.5),), speed_mps=10.0, about="A stop.")


def drive(scenario):
    return road_run.drive_scenario(scenario, road_run.controller_of(scenario, EQUAL), substeps=1)


def test_a_stop_ends_at_standstill_if_it_is_told_to():
    run = drive(dataclasses.replace(STOP, to_standstill=True, duration_s=20.0))
    assert run.final.speed_mps == 0.0
    assert len(run.series) < 600
    assert run.road is not None
    assert len(run.road) == len(run.series)
    assert np.all(run["brake"][25:] == 0.5)
    assert np.all(run["power_demand_w"][:20] == 0.0)
    assert np.all(np.diff(run["speed_mps"][30:]) <= 1e-9)


def test_on_a_straight_road_left_and_right_stay_alike_to_the_bit_whoever_steers():
    plain, lane = drive(STOP), drive(dataclasses.replace(STOP, steering=None))
    np.testing.assert_array_equal(plain.series, lane.series)
    assert lane.road is not None
    assert not lane.road[:, :7][:, 1:].any()


@pytest.mark.parametrize(
    ("demand", "sign"),
    [
        (Demand(0.0, "accelerator", 0.3), 1.0),
        (Demand(0.0, "brake", 0.3), -1.0),
        (Demand(0.0, "power_w", 4000.0), 1.0),
        (Demand(0.0, "power_w", -4000.0), -1.0),
        (Demand(0.0, "braking_mps2", 2.0), -1.0),
    ],
)
def test_each_way_of_asking_moves_the_car_its_way(demand, sign):
    run = drive(dataclasses.replace(STOP, demand=(demand,), duration_s=1.0))
    coasting = drive(dataclasses.replace(STOP, demand=(), duration_s=1.0))
    assert sign * (run.final.speed_mps - coasting.final.speed_mps) > 0.1
    assert not coasting["power_demand_w"].any()


def test_the_road_is_where_each_wheel_stands():
    split = dataclasses.replace(
        STOP, friction=(Friction(0.0, 0.2, 0.8), Friction(5.0, 0.5, 0.5)), assumed_friction=0.2, duration_s=1.0
    )
    first = Drive(split, dt_s=0.01)
    assert first.friction == (0.2, 0.8, 0.2, 0.8)
    first.car = first.car._replace(x_m=4.5)
    assert first.friction == (0.5, 0.5, 0.2, 0.8)
    first.car = first.car._replace(y_m=2.0, x_m=0.0)
    assert first.friction == (0.2,) * 4
    first.car = first.car._replace(heading_rad=math.pi, x_m=2.0, y_m=0.0)
    assert first.friction == (0.8, 0.2, 0.8, 0.2)


def test_grade_by_distance_and_wind_slow_the_car():
    plain = drive(dataclasses.replace(STOP, demand=(), duration_s=2.0))
    hill = drive(dataclasses.replace(STOP, demand=(), duration_s=2.0, grade=((0.0, 0.0), (5.0, 0.1))))
    wind = drive(dataclasses.replace(STOP, demand=(), duration_s=2.0, headwind_mps=20.0))
    assert hill.final.speed_mps < wind.final.speed_mps < plain.final.speed_mps
    assert hill.road is not None
    assert set(np.unique(hill.road[:, 7])) == {0.0, 0.1}


def test_a_steering_wheel_that_is_turned_turns_the_car():
    run = drive(dataclasses.replace(STOP, demand=(), steering=((0.5, 0.5), (1.5, 0.0)), duration_s=2.0))
    assert run.final.heading_rad > 0.1
    assert run.road is not None
    assert set(np.unique(run.road[:, 6])) == {0.0, 0.5}


def test_a_dead_motor_gives_nothing_and_the_power_manager_is_not_told():
    fault = Fault("motor_front_left", "dead", 0.0, 0.5, math.inf)
    run = drive(dataclasses.replace(STOP, demand=(Demand(0.0, "accelerator", 0.3),), faults=(fault,), duration_s=1.0))
    assert (run["front_motor_nm"][:50] > 0.0).any()
    assert not run["front_motor_nm"][51:].any()
    assert run["rear_motor_nm"][-1] > 0.0


def test_a_lost_message_degrades_the_power_manager():
    fault = Fault("vehicle_speed", "lost", 0.0, 0.5, 1.0, message=True)
    run = drive(dataclasses.replace(STOP, demand=(), faults=(fault,), duration_s=2.0))
    assert run.road is not None
    mode = run.road[:, RoadRow._fields.index("mode")]
    assert set(mode[:50]) == {1.0}
    assert 2.0 in set(mode[55:95])


INPUTS = ("vehicle_speed", "wheel_states", "power_demand", "battery_state", "imu")


def test_a_late_message_tells_the_power_manager_its_age_unless_its_stamp_lies():
    def ages_s(topics, **wrong):
        faults = tuple(Fault(t, kind, value, 0.0, 99.0, message=True) for t in topics for kind, value in wrong.items())
        scenario = dataclasses.replace(STOP, faults=faults)
        manager, shown = road_run.controller_of(scenario, EQUAL), Drive(scenario, dt_s=0.01)
        for now_ns in range(10**9, 10**9 + 60_000_000, 10_000_000):
            road_run.give(manager, shown.sense(), shown, now_ns)
        return manager.monitor.ages_s(now_ns)

    late, lying = INPUTS[:2], ("wheel_states", "battery_state")
    assert ages_s(late, delay_s=0.02) == (0.02, 0.02, 0.0, 0.0)
    assert ages_s(lying, delay_s=0.02, stamp_error_s=0.01) == (0.0, 0.01, 0.0, 0.01)
    assert ages_s(("vehicle_speed",), rate_hz=50.0) == (0.01, 0.0, 0.0, 0.0)


def test_what_arrives_without_a_delay_gives_the_same_bits_and_20_ms_later_others():
    def series(**wrong):
        faults = tuple(Fault(t, kind, value, 0.0, 99.0, message=True) for t in INPUTS for kind, value in wrong.items())
        return drive(dataclasses.replace(STOP, faults=faults, imu=True, duration_s=1.0)).series

    plain = series()
    np.testing.assert_array_equal(series(delay_s=0.0, jitter_s=0.0, stamp_error_s=0.0, rate_hz=100.0), plain)
    late = series(delay_s=0.02, jitter_s=0.005)
    assert not np.array_equal(late, plain)
    np.testing.assert_array_equal(series(delay_s=0.02, jitter_s=0.005), late)


def test_the_power_manager_says_by_how_much_torques_act_later_than_told():
    """Of 20 ms that no stamp shows `actuator_delay_s` explains 2; the plant's motors have none of their own."""
    scenario = load_scenario("unstamped_stop_02")
    manager = road_run.controller_of(scenario)
    assert manager.torques_later_s == 0.0
    road_run.drive_scenario(scenario, manager)
    assert manager.torques_later_s == pytest.approx(0.018, abs=0.0051)


@pytest.mark.parametrize("road", ["stop_02", "stop_09", "split_stop", "split_stop_imu"])
def test_in_a_stop_at_the_limit_torques_do_not_swing(road):
    scenario = load_scenario(road)
    run = driven(road_run.drive_scenario(scenario), scenario.truth)
    there = np.diff(run.wheels("motor_{}_nm") + run.wheels("friction_{}_nm"), axis=0)
    back_and_forth = (there[1:] * there[:-1] < 0.0) & (np.abs(there[1:] - there[:-1]) > 100.0)
    assert back_and_forth.mean(axis=0).max() < 0.05


def test_requirements_are_checked_and_said():
    bounds = (Bound("stopping_distance_m", -math.inf, 20.0), Bound("steering_deg", 1.0, math.inf))
    result = road_run.check_scenario(
        dataclasses.replace(STOP, require=bounds, to_standstill=True, duration_s=9.0), EQUAL
    )
    assert [check.holds for check in result.checked] == [True, False]
    assert not result.passed
    assert "FAIL  stop: A stop." in text(result)
    assert "! steering_deg" in text(result)
    aims = tuple(bound._replace(aim=True) for bound in bounds)
    aimed = result._replace(
        checked=tuple(check._replace(bound=b) for check, b in zip(result.checked, aims, strict=True))
    )
    assert aimed.passed
    assert "~ steering_deg" in text(aimed)
    assert "aim missed" in page([aimed], "equal")
    written = page([result], "equal")
    assert "| `stop` | A stop. | `stopping_distance_m` |" in written
    assert "0 of 1 scenarios" in written


def test_some_requirements_are_against_the_healthy_car():
    bound = Bound("stopping_distance_of_healthy", 1.01, math.inf)
    fault = Fault("brake_front_left", "dead", 0.0, 0.0, math.inf)
    hard = dataclasses.replace(
        STOP, demand=(Demand(0.2, "brake", 0.9),), steering=None, duration_s=9.0, to_standstill=True
    )
    result = road_run.check_scenario(dataclasses.replace(hard, require=(bound,), faults=(fault,)), EQUAL)
    assert result.passed
