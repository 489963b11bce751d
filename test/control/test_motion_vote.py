# SPDX-License-Identifier: Apache-2.0
"""Where the reference begins, begins anew, and what the road takes of a car that nobody drives."""

from __future__ import annotations

import math

import pytest

from iwm_power_manager.control.motion_vote import (
    ASKED_MPS2,
    ASKED_PART,
    fresh_motion,
    restarted_motion,
    road_resistance_mps2,
    started_motion,
    vote,
)
from iwm_power_manager.control.speed_doubt import AGREE_MPS, AGREE_PART
from iwm_power_manager.control.types import Agreed, Compared, Measurement, initial_state
from iwm_power_manager.control.wheel_doubt import SPEED_MPS, SPEED_PART, WHOLE_BRAKES, Turning, turning_of
from iwm_power_manager.model.chassis import aerodynamic_force_n, rolling_force_n
from iwm_power_manager.model.parameters import FrictionBrake
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params
RADIUS = CAR.front.wheel.radius_m


@pytest.mark.parametrize("speed", [3.0, 12.0, 40.0])
def test_air_and_tyres_slow_the_car_down_as_in_the_model(speed):
    force = aerodynamic_force_n(speed, CAR.chassis) + rolling_force_n(0.0, CAR.chassis)
    assert road_resistance_mps2(speed, CAR) == pytest.approx(force / CAR.chassis.mass_kg)
    assert road_resistance_mps2(-speed, CAR) == pytest.approx(-force / CAR.chassis.mass_kg)


def test_a_car_that_stands_is_not_slowed_down():
    assert road_resistance_mps2(0.0, CAR) == 0.0


@pytest.mark.parametrize("start", [0.0, 5.0, -5.0, 30.0])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_run_begins_with_the_sensor_where_it_agrees_with_the_wheels_and_with_these_where_not(start, sign):
    bound = SPEED_PART * abs(start) + SPEED_MPS
    near, far = start + sign * 0.9 * bound, start + sign * 1.1 * bound
    assert started_motion(near, (start,) * 4).speed_mps == near
    assert started_motion(far, (start,) * 4).speed_mps == start
    assert started_motion(math.nan, (start,) * 4).speed_mps == start


def test_a_reference_that_begins_anew_remembers_no_time_and_no_way():
    fresh = fresh_motion(7.0, 0.3, 6.5, WHOLE_BRAKES, 1.0, Compared(1.0, 0.0), 0.0)
    expected = initial_state().motion._replace(
        speed_mps=7.0, bias_mps2=0.3, shown_mps=6.5, brake_gain=WHOLE_BRAKES, compared=Compared(1.0, 0.0)
    )
    assert fresh == expected


def braked(rims, friction_nm=400.0):
    """Part of each brake's torque that is found when a car at 20 m/s has lost no speed for 0.5 s while braked."""
    start = initial_state()
    w = tuple(rim / RADIUS for rim in rims)
    fl, fr, rl, rr = (
        wheel._replace(total_nm=-friction_nm, speed_radps=speed, road_nm=-friction_nm)
        for wheel, speed in zip(start.wheels, w, strict=True)
    )
    motion = start.motion._replace(speed_mps=16.0, shown_mps=20.0)
    turning = turning_of(w, (fl, fr, rl, rr), 1.0, False, 0.01, motion.wheel_doubt_s, CAR)
    agreed = Agreed(0.5, 20.0, -3.0, math.nan)
    return restarted_motion(20.0, rims, agreed, 20.0, (fl, fr, rl, rr), turning, motion, CAR).brake_gain


@pytest.mark.parametrize("rim_part", [1.0, 0.9999, 0.999])
@pytest.mark.parametrize("weak", [(0, 1), (2, 3), (0, 3), (1,)])
def test_brakes_whose_wheels_slip_less_than_any_road_would_let_them_are_found_weak_and_no_others(rim_part, weak):
    rims = tuple(20.0 * (rim_part if i in weak else 0.8) for i in range(4))
    assert [gain < 1.0 for gain in braked(rims)] == [i in weak for i in range(4)]


def test_no_brake_is_weak_that_was_not_asked_for_anything():
    assert braked((20.0,) * 4, 0.0) == WHOLE_BRAKES


@pytest.mark.parametrize("bias", [-0.4, 0.4])
@pytest.mark.parametrize("speed", [-20.0, 20.0])
def test_a_slope_that_speeds_tell_is_added_to_the_one_that_was_known(bias, speed):
    start = initial_state()
    motion = start.motion._replace(bias_mps2=bias)
    turning = Turning((0.0,) * 4, (0.0,) * 4, (0.0,) * 4, (False,) * 4, 600.0, 600.0)
    agreed = Agreed(1.0, speed - 3.0, 0.0, math.nan)
    after = restarted_motion(speed, (speed,) * 4, agreed, speed, start.wheels, turning, motion, CAR)
    assert after.bias_mps2 == pytest.approx(bias + 3.0)
    assert (after.speed_mps, after.brake_gain) == (speed, WHOLE_BRAKES)


def voted(shown, rims, predicted, agreed, *, torque_nm=0.0, demand_w=0.0, felt_mps2=math.nan, doubt_s=0.0, car=CAR):
    """Speeds that agree by now, the one they agree on, and whether they are right."""
    measurement = Measurement(
        speed_mps=shown,
        wheel_speed_radps=tuple(rim / RADIUS for rim in rims),
        power_demand_w=demand_w,
        dt_s=0.01,
        friction=0.9,
        discharge_limit_w=1e5,
        charge_limit_w=1e5,
        soc=0.5,
        acceleration_mps2=felt_mps2,
    )
    turning = Turning((torque_nm,) * 4, (0.0,) * 4, (torque_nm,) * 4, (False,) * 4, 600.0, 600.0)
    before = initial_state().motion._replace(agreed=agreed, wheel_doubt_s=(doubt_s,) * 4)
    return vote(shown, rims, predicted, 0.0, measurement, turning, before, car)


NEVER = Agreed(0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("speed", [5.0, 20.0, 40.0])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_wheels_agree_with_the_sensor_within_a_part_of_its_speed(speed, sign):
    bound = sign * (AGREE_PART * speed + AGREE_MPS)
    assert voted(speed, (speed + 0.9 * bound,) * 4, 0.7 * speed, NEVER)[0] == Agreed(0.01, speed, 0.0, 0.0)
    assert voted(speed, (speed + 1.1 * bound,) * 4, 0.7 * speed, NEVER)[0] == NEVER


def test_wheels_outvote_the_forces_without_a_sensor_only_where_all_of_them_are_doubted():
    assert voted(math.nan, (20.0,) * 4, 15.0, NEVER, doubt_s=0.1)[0] == Agreed(0.01, 20.0, 0.0, 0.0)
    assert voted(math.nan, (20.0,) * 4, 15.0, NEVER)[0] == NEVER


def test_a_sensor_alone_is_right_where_an_accelerometer_has_felt_what_it_shows():
    agreed = Agreed(0.5, 21.0, 3.0, math.nan)
    for felt, right in ((-1.0, True), (3.0, False)):
        skid = agreed._replace(felt_mps=felt)
        assert voted(20.0, (12.0,) * 4, 25.0, skid, torque_nm=-300.0, felt_mps2=0.0)[2] is right
    assert not voted(20.0, (12.0,) * 4, 25.0, agreed, torque_nm=-300.0)[2]


@pytest.mark.parametrize("asked_mps2", [0.5, 2.0, 4.0])
def test_another_system_s_brakes_explain_what_the_driver_asks_for_and_little_more(asked_mps2):
    foreign = CAR.with_axles(friction_brake=FrictionBrake(0.0))
    demand_w = -asked_mps2 * CAR.chassis.mass_kg * 20.0
    most = ASKED_PART * asked_mps2 + ASKED_MPS2
    for part, right in ((0.9, True), (1.1, False)):
        agreed = Agreed(0.49, 20.0 + part * most * 0.5, 0.0, math.nan)
        assert voted(20.0, (20.0,) * 4, 25.0, agreed, torque_nm=-60.0, demand_w=demand_w, car=foreign)[2] is right


@pytest.mark.parametrize("speed", [1.0, 10.0])
def test_no_brake_of_another_system_makes_a_wheel_faster(speed):
    foreign = CAR.with_axles(friction_brake=FrictionBrake(0.0))
    off = 1.5 * (AGREE_PART * speed + AGREE_MPS)
    for sign, agreed in ((-1.0, Agreed(0.01, speed, 0.0, 0.0)), (1.0, NEVER)):
        rims = (speed + sign * off, speed, speed, speed)
        assert voted(speed, rims, speed + 3.0, NEVER, car=foreign)[0] == agreed
