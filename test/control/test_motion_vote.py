# SPDX-License-Identifier: Apache-2.0
"""Where the reference begins, begins anew, and what the road takes of a car that nobody drives."""

from __future__ import annotations

import math

import pytest

from iwm_power_manager.control.motion_vote import (
    ASKED_MPS2,
    ASKED_PART,
    BEST_ROAD,
    DEAD,
    HALF,
    fresh_motion,
    restarted_motion,
    road_resistance_mps2,
    started_motion,
    vote,
)
from iwm_power_manager.control.speed_doubt import AGREE_MPS, AGREE_PART
from iwm_power_manager.control.types import Agreed, Compared, Measurement, initial_state
from iwm_power_manager.control.wheel_doubt import SLOW_MPS, SPEED_MPS, SPEED_PART, WHOLE_BRAKES, Turning, turning_of
from iwm_power_manager.model.chassis import aerodynamic_force_n, rolling_force_n
from iwm_power_manager.model.parameters import FrictionBrake
from iwm_power_manager.model.tyre import friction_coefficient
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params
RADIUS = CAR.front.wheel.radius_m


@pytest.mark.parametrize("speed", [3.0, 12.0, 40.0])
def test_air_and_tyres_slow_the_car_down_as_in_the_model(speed):
    force = aerodynamic_force_n(speed, CAR.chassis) + rolling_force_n(0.0, CAR.chassis)
    assert road_resistance_mps2(speed, CAR) == pytest.approx(force / CAR.chassis.mass_kg)
    assert road_resistance_mps2(-speed, CAR) == pytest.approx(-force / CAR.chassis.mass_kg)


def test_a_car_that_comes_to_rest_is_slowed_down_less_and_less_by_its_tyres():
    for part in (0.0, 0.25, 0.5):
        force = aerodynamic_force_n(part * SLOW_MPS, CAR.chassis) + part * rolling_force_n(0.0, CAR.chassis)
        assert road_resistance_mps2(part * SLOW_MPS, CAR) == pytest.approx(force / CAR.chassis.mass_kg)


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


def restarted(rims, friction_nm, *, gain=WHOLE_BRAKES, moved_mps=-3.0, car=CAR):
    """What is found of a car at 20 m/s that has lost no speed for 0.5 s, each brake asked for its torque."""
    start = initial_state()
    radii = (car.front.wheel.radius_m,) * 2 + (car.rear.wheel.radius_m,) * 2
    w = tuple(rim / radius for rim, radius in zip(rims, radii, strict=True))
    fl, fr, rl, rr = (
        wheel._replace(total_nm=-torque, speed_radps=speed, road_nm=-torque)
        for wheel, speed, torque in zip(start.wheels, w, friction_nm, strict=True)
    )
    motion = start.motion._replace(speed_mps=16.0, shown_mps=20.0, brake_gain=gain)
    turning = turning_of(w, (fl, fr, rl, rr), 1.0, False, 0.01, motion.wheel_doubt_s, car)
    agreed = Agreed(0.5, 20.0, moved_mps, math.nan)
    return restarted_motion(20.0, rims, agreed, 20.0, (fl, fr, rl, rr), turning, motion, car)


def braked(rims, friction_nm=400.0):
    """Part of each brake's torque that is found where all were to give the same."""
    return restarted(rims, (friction_nm,) * 4).brake_gain


@pytest.mark.parametrize("rim_part", [1.0, 0.9999, 0.999])
@pytest.mark.parametrize("weak", [(0, 1), (2, 3), (0, 3), (1,)])
def test_brakes_whose_wheels_slip_less_than_any_road_would_let_them_are_found_weak_and_no_others(rim_part, weak):
    rims = tuple(20.0 * (rim_part if i in weak else 0.8) for i in range(4))
    assert [gain < 1.0 for gain in braked(rims)] == [i in weak for i in range(4)]


#: Front and rear are unlike in size and load.
UNLIKE = CAR._replace(
    rear=CAR.rear._replace(wheel=CAR.rear.wheel._replace(radius_m=0.3)),
    chassis=CAR.chassis._replace(front_axle_to_cg_m=0.7, rear_axle_to_cg_m=1.6),
)
TORQUES, GAINS = (420.0, 360.0, 330.0, 280.0), (1.0, 0.9, 0.8, 0.7)


@pytest.mark.parametrize("blamed", [(0,), (1,), (2,), (3,), (0, 2), (0, 1, 2, 3), ()])
def test_a_brake_loses_the_part_of_its_force_that_is_missing(blamed):
    rims = tuple(20.0 * (1.0 if i in blamed else 0.8) for i in range(4))
    radii = (UNLIKE.front.wheel.radius_m,) * 2 + (UNLIKE.rear.wheel.radius_m,) * 2
    who = blamed or range(4)
    # Not so much that any of them would count as dead.
    force_n = sum(TORQUES[i] / radii[i] for i in who)
    lack_mps2 = 2.6
    part = 1.0 - lack_mps2 * UNLIKE.chassis.mass_kg / force_n
    part = part if part >= DEAD else 0.0
    found = restarted(rims, TORQUES, gain=GAINS, moved_mps=-0.5 * lack_mps2, car=UNLIKE).brake_gain
    assert found == pytest.approx([part * gain if i in who else gain for i, gain in enumerate(GAINS)])


@pytest.mark.parametrize("wheel", range(4))
@pytest.mark.parametrize("slip", [0.01, 0.03])
def test_half_of_what_the_best_road_takes_at_its_slip_is_what_a_whole_brake_may_give(wheel, slip):
    axle = UNLIKE.front if wheel < 2 else UNLIKE.rear
    turning = turning_of((0.0,) * 4, initial_state().wheels, 1.0, False, 0.01, (0.0,) * 4, UNLIKE)
    load_nm = turning.front_nm if wheel < 2 else turning.rear_nm
    bound = BEST_ROAD * load_nm * friction_coefficient(slip, 1.0, axle.tyre) / HALF
    rims = tuple(20.0 * (1.0 - slip if i == wheel else 0.8) for i in range(4))
    for part, alone in ((1.05, True), (0.95, False)):
        torques = tuple(part * bound if i == wheel else 60.0 for i in range(4))
        weak = [gain < 1.0 for gain in restarted(rims, torques, car=UNLIKE).brake_gain]
        assert weak == [i == wheel or not alone for i in range(4)]


def test_brakes_that_are_back_are_whole_and_no_wheel_is_doubted_for_it():
    after = restarted((20.0,) * 4, TORQUES, gain=GAINS, moved_mps=3.0)
    assert (after.brake_gain, after.wheel_doubt_s) == (WHOLE_BRAKES, (0.0,) * 4)


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
    # The forces say 3 m/s more and the speeds 1 m/s less: what is felt has to be nearer to the speeds by half.
    for felt, right in ((-1.0, True), (0.3, True), (0.4, False), (3.0, False)):
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


def test_speeds_that_agree_without_any_torque_are_right_soon():
    agreed = Agreed(0.2, 20.0, 0.0, math.nan)
    for predicted in (15.0, 25.0):
        assert voted(20.0, (20.0,) * 4, predicted, agreed)[2]


def test_an_accelerometer_that_has_felt_what_the_forces_say_keeps_wheels_that_might_skid_from_being_right():
    agreed = Agreed(1.5, 24.0, 0.8, 0.0)
    assert not voted(20.0, (20.0,) * 4, 25.0, agreed, torque_nm=-60.0, felt_mps2=0.0)[2]
    assert voted(20.0, (20.0,) * 4, 25.0, agreed, torque_nm=-60.0)[2]
    # Of the 4 m/s that the speeds have lost it has felt none: the forces have to be nearer to that by half.
    for moved, right in ((1.9, False), (2.1, True), (3.0, True)):
        skid = agreed._replace(moved_mps=moved)
        assert voted(20.0, (20.0,) * 4, 25.0, skid, torque_nm=-60.0, felt_mps2=0.0)[2] is right
