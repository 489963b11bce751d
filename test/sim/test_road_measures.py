# SPDX-License-Identifier: Apache-2.0
"""Measures of a drive, each on a run made by hand that has it in plain sight."""

from __future__ import annotations

import math

import numpy as np
import pytest

from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle
from iwm_sim import road_measures as m
from iwm_sim.closed_loop import COLUMNS, ROAD_COLUMNS, Run
from iwm_sim.plant import initial_plant

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params
DT = 0.01
AIRLESS = CAR._replace(chassis=CAR.chassis._replace(drag_coefficient=0.0, rolling_resistance=0.0))
MASS = CAR.chassis.mass_kg


def made(seconds, final=None, vehicle=AIRLESS, **columns):
    """A run of zeros on dry road, with these columns; values or arrays."""
    steps = round(seconds / DT)
    series, road = np.zeros((steps, len(COLUMNS))), np.zeros((steps, len(ROAD_COLUMNS)))
    for wheel in ("fl", "fr", "rl", "rr"):
        road[:, ROAD_COLUMNS.index(f"road_{wheel}")] = 0.9
    for name, values in columns.items():
        (series if name in COLUMNS else road)[:, (COLUMNS if name in COLUMNS else ROAD_COLUMNS).index(name)] = values
    end = initial_plant(vehicle)._replace(**(final or {}))
    return m.driven(Run(DT, series, end, road), vehicle)


def braked(deceleration=5.0, speed=20.0, given=1.0, **more):
    """A second at a speed, then braking with `given` of what is asked for, to standstill."""
    t = np.arange(0.0, 1.0 + speed / (deceleration * given) + 0.1, DT)
    v = np.maximum(speed - deceleration * given * np.maximum(t - 1.0, 0.0), 0.0)
    s = np.concatenate(([0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * DT)))
    demand = np.where(t >= 1.0, -MASS * deceleration * np.maximum(v, 1.0), 0.0)
    acceleration = np.concatenate((np.diff(v) / DT, [0.0]))
    columns = {"speed_mps": v, "distance_m": s, "x_m": s, "power_demand_w": demand, "acceleration_mps2": acceleration}
    return made(len(t) * DT, **(columns | more))


def test_a_stop_has_its_distance_time_and_rate():
    d = braked(5.0, 20.0)
    assert m.stopping_distance_m(d) == pytest.approx(40.0, rel=0.01)
    assert m.stopping_time_s(d) == pytest.approx(4.0, rel=0.01)
    assert m.braking_rate(d) == pytest.approx(5.0 / 9.81, rel=0.01)
    assert m.adhesion_used(d) == pytest.approx(5.0 / 9.81 / 0.9, rel=0.01)
    assert m.least_braking(d) == pytest.approx(1.0, rel=0.02)
    assert m.longest_under_braked_s(d) <= 0.02


def test_without_a_stop_or_a_demand_there_is_no_distance():
    rolling = made(2.0, {"speed_mps": 10.0}, speed_mps=10.0, power_demand_w=-1000.0)
    assert m.stopping_distance_m(rolling) == m.stopping_time_s(rolling) == math.inf
    assert m.braking_rate(rolling) == 0.0
    still = made(1.0)
    assert m.stopping_distance_m(still) == math.inf
    assert m.least_braking(still) == 0.0


def test_a_run_that_ends_at_standstill_has_stopped():
    d = made(1.0, {"x_m": 7.0}, speed_mps=1.0, power_demand_w=-1.0)
    assert m.stopping_distance_m(d) == 7.0


def test_braking_that_is_not_given_is_missed_for_its_time():
    d = braked(5.0, 20.0, given=0.8)
    assert m.least_braking(d) == pytest.approx(0.8, rel=0.02)
    assert m.longest_under_braked_s(d) == pytest.approx(19.0 / 4.0, rel=0.02)
    assert m.longest_under_braked_s(braked(5.0, 20.0, given=0.9)) <= 0.02


def test_more_than_the_road_can_give_is_not_missed():
    icy = {f"road_{wheel}": 0.2 for wheel in ("fl", "fr", "rl", "rr")}
    d = braked(5.0, 20.0, given=0.2 * 9.81 / 5.0, **icy)
    assert m.least_braking(d) == pytest.approx(1.0, rel=0.02)


def test_backwards_uphill_braking_is_what_the_tyres_do():
    """Rolling back at -3 m/s on 10 %, gravity pulls back with 0.976: the tyres give 1 m/s2 more than is seen."""
    t = np.arange(0.0, 1.0, DT)
    d = made(1.0, speed_mps=-3.0 + t, grade=0.1, acceleration_mps2=1.0, power_demand_w=-MASS * (3.0 - t) * 1.976)
    assert m.longest_under_braked_s(d) == 0.0
    assert m.least_braking(d) == pytest.approx(1.0, rel=0.01)


def test_a_split_road_asks_for_three_quarters_of_its_mean_or_the_lower():
    split = {"road_fl": 0.2, "road_rl": 0.2}
    d = braked(0.255 * 9.81, 20.0, **split)
    assert m.split_rate(d) == pytest.approx(1.0, rel=0.01)  # 0.75 (0.8 + 0.9) / 5 = 0.255
    even = {"road_fl": 0.8, "road_rl": 0.8}
    assert m.split_rate(braked(0.8 * 9.81, 20.0, **even)) == pytest.approx(1.0, rel=0.01)


def test_a_wheel_is_locked_beyond_critical_or_spinning_for_its_longest_time():
    t = np.arange(0.0, 2.0, DT)
    slip = np.where((t >= 0.5) & (t < 0.8), -1.0, np.where(t >= 1.5, -0.5, 0.0))
    d = made(2.0, speed_mps=10.0, slip_rr=slip)
    assert m.longest_locked_s(d) == pytest.approx(0.3)
    assert m.longest_beyond_critical_s(d) == pytest.approx(0.5)
    assert m.longest_locked_s(made(2.0, speed_mps=4.0, slip_rr=slip)) == 0.0
    spun = made(2.0, speed_mps=2.0, slip_fl=np.where(t < 0.4, 0.5, 0.0), wheel_fl_radps=np.where(t < 0.4, 12.0, 6.0))
    assert m.longest_spinning_s(spun) == pytest.approx(0.4)


def test_after_a_jump_braking_grows_within_a_time():
    t = np.arange(0.0, 3.0, DT)
    road = np.where(t < 1.0, 0.2, 0.9)
    decel = np.where(t < 1.25, 0.2 * 9.81, 0.9 * 9.81)
    d = made(
        3.0,
        speed_mps=30.0 - 2.0 * t,
        power_demand_w=-MASS * 12.0 * 30.0,
        acceleration_mps2=-decel,
        **{f"road_{wheel}": road for wheel in ("fl", "fr", "rl", "rr")},
    )
    assert m.rise_after_jump_s(d) == pytest.approx(0.25)
    assert m.rise_after_jump_s(braked()) == math.inf


def test_after_a_jump_braking_that_falls_back_has_not_grown_yet():
    t = np.arange(0.0, 3.0, DT)
    decel = np.where((t < 1.0) | ((t > 1.1) & (t < 1.4)), 0.2 * 9.81, 0.9 * 9.81)
    changes = {f"road_{wheel}": np.where(t < 1.0, 0.2, 0.9) for wheel in ("fl", "fr", "rl", "rr")}
    common = {"speed_mps": 30.0 - 2.0 * t, "power_demand_w": -MASS * 12.0 * 30.0, **changes}
    assert m.rise_after_jump_s(made(3.0, acceleration_mps2=-decel, **common)) == pytest.approx(0.4, abs=0.02)
    assert m.rise_after_jump_s(made(3.0, acceleration_mps2=-1.0, **common)) == math.inf


def test_hands_lane_and_yaw():
    t = np.arange(0.0, 5.0, DT)
    wheel = np.where(t < 3.5, np.radians(100.0), np.radians(-200.0))
    d = made(
        5.0,
        speed_mps=10.0,
        power_demand_w=np.where(t < 1.0, 0.0, -1.0),
        steering_wheel_rad=wheel,
        y_m=np.where(t > 4.0, -0.5, 0.0),
        yaw_rate_radps=-0.1,
        friction_fr_nm=-33.0,
    )
    assert m.steering_2s_deg(d) == pytest.approx(100.0)
    assert m.steering_deg(d) == pytest.approx(200.0)
    assert m.lane_m(d) == pytest.approx(2.0 * (0.5 + 0.5 * (CAR.front.track_width_m + 0.2)))
    assert m.largest_yaw_rate_dps(d) == pytest.approx(math.degrees(0.1))
    assert m.largest_yaw_moment_nm(d) == pytest.approx(100.0 * 0.5 * CAR.front.track_width_m)
    turned = made(1.0, heading_rad=0.3)
    assert m.lane_m(turned) == pytest.approx(
        2.0 * (math.sin(0.3) * 0.92 + math.cos(0.3) * 0.5 * (CAR.front.track_width_m + 0.2))
    )


def test_where_the_car_went_and_what_the_power_manager_said():
    t = np.arange(0.0, 2.0, DT)
    d = made(
        2.0,
        {"distance_m": -0.4, "speed_mps": -0.1},
        distance_m=-0.3 * t,
        mode=np.where(t < 0.5, 2.0, 1.0),
        wheels_lost=1.0,
    )
    assert m.rolled_back_m(d) == m.moved_m(d) == pytest.approx(0.597)
    assert (m.distance_m(d), m.final_speed_mps(d)) == (-0.4, -0.1)
    assert m.degraded_s(d) == pytest.approx(0.5)
    assert m.wheels_lost_s(d) == pytest.approx(2.0)


def test_some_measures_are_of_the_healthy_car():
    healthy, ill = braked(5.0), braked(4.0)
    values = m.measured(["stopping_distance_of_healthy", "lane_m"], ill, healthy)
    assert values["stopping_distance_of_healthy"] == pytest.approx(1.25, rel=0.01)
    assert values["lane_m"] == m.lane_m(ill)
