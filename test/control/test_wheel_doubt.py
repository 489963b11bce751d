# SPDX-License-Identifier: Apache-2.0
"""Which wheel speeds are believed: the bounds of one step, wheel by wheel and of all four."""

from __future__ import annotations

import itertools
import math
import random

import pytest

from iwm_power_manager.control.types import initial_state
from iwm_power_manager.control.wheel_doubt import (
    CALM_S,
    COMMON_RADPS,
    FREE_PART,
    GOOD_MPS,
    GOOD_PART,
    HELD_MPS,
    HELD_PART,
    ICE_FRICTION,
    JUMP_RADPS,
    LAG_S,
    LEAST_FACTOR,
    MOVED_RADPS,
    RETURN_S,
    WORN_PART,
    Turning,
    acting_nm,
    combined_factor,
    common_jump,
    middle_of,
    turning_of,
    wheel_doubts,
    wheels_to_use,
)
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params
RADIUS = CAR.front.wheel.radius_m
DT = 0.01
LOAD_NM = 617.0
NONE = (0.0, 0.0, 0.0, 0.0)
WHEELS = pytest.mark.parametrize("wheel", range(4))


def one(wheel, value, other):
    return tuple(value if i == wheel else other for i in range(4))


def judged(wheel, off_mps, change_radps=0.0, gated=False, stray_s=0.0, doubt_s=0.0, speed=20.0, **torques):
    """What is found of one wheel that is off while the others roll: time it has stayed away, time of its doubt."""
    torque_nm = torques.get("torque_nm", 0.0)
    last_nm, acted_nm = torques.get("last_nm", torque_nm), torques.get("acted_nm", 0.0)
    w = one(wheel, (speed + off_mps) / RADIUS, speed / RADIUS)
    change = one(wheel, change_radps, 0.0)
    turning = Turning(one(wheel, torque_nm, 0.0), change, NONE, one(wheel, gated, False), LOAD_NM, LOAD_NM)
    shift, least, most = (one(wheel, nm, 0.0) for nm in (torque_nm - last_nm, min(acted_nm, 0.0), max(acted_nm, 0.0)))
    stray, doubt = wheel_doubts(
        w, turning, shift, least, most, speed, 0.0, DT, one(wheel, stray_s, 0.0), one(wheel, doubt_s, 0.0), CAR
    )
    assert [value for i, value in enumerate(stray + doubt) if i % 4 != wheel] == [0.0] * 6
    return stray[wheel], doubt[wheel]


@WHEELS
@pytest.mark.parametrize("travel", [-1.0, 1.0])
def test_what_the_road_takes_from_a_wheel_is_its_torque_less_what_turns_it(wheel, travel):
    car = CAR._replace(rear=CAR.rear._replace(wheel=CAR.rear.wheel._replace(inertia_kgm2=2.0)))
    totals = one(wheel, 50.0, 20.0)
    wheels = tuple(initial_state().wheels[0]._replace(total_nm=nm, speed_radps=40.0) for nm in totals)
    speeds = one(wheel, travel * 40.1, travel * 40.0)
    road = turning_of(speeds, wheels, travel, False, DT, NONE, car).road_nm
    inertia = (car.front if wheel < 2 else car.rear).wheel.inertia_kgm2
    assert road == pytest.approx(one(wheel, travel * (50.0 - inertia * 10.0), travel * 20.0))


@WHEELS
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_change_is_explained_by_the_last_torque_too_and_by_no_more(wheel, sign):
    """A stamp that looks too old belongs to a torque of before."""
    inertia = (CAR.front if wheel < 2 else CAR.rear).wheel.inertia_kgm2
    most = 1.5 * 400.0 / inertia * DT + JUMP_RADPS
    given = {"torque_nm": sign * 50.0, "last_nm": sign * 400.0}
    assert judged(wheel, sign * 3.0, sign * 0.98 * most, **given)[1] == 0.0
    assert judged(wheel, sign * 3.0, sign * 1.02 * most, **given)[1] > 0.0
    assert judged(wheel, sign * 3.0, sign * 0.98 * most, torque_nm=sign * 50.0)[1] > 0.0


@WHEELS
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_change_is_explained_by_a_torque_that_may_act_still_without_a_margin(wheel, sign):
    inertia = (CAR.front if wheel < 2 else CAR.rear).wheel.inertia_kgm2
    most = 400.0 / inertia * DT + JUMP_RADPS
    assert judged(wheel, sign * 3.0, sign * 0.98 * most, acted_nm=sign * 400.0)[1] == 0.0
    assert judged(wheel, sign * 3.0, sign * 1.02 * most, acted_nm=sign * 400.0)[1] > 0.0
    assert judged(wheel, sign * 3.0, sign * 0.98 * most, acted_nm=-sign * 400.0)[1] > 0.0


@WHEELS
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_gated_wheel_is_away_beyond_its_own_bound_only(wheel, sign):
    bound = HELD_PART * 20.0 + HELD_MPS
    assert judged(wheel, sign * 0.95 * bound, gated=True)[0] == 0.0
    assert judged(wheel, sign * 1.05 * bound, gated=True)[0] == DT
    assert judged(wheel, sign * 1.05 * bound)[0] == 0.0


@WHEELS
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_noise_of_a_wheel_that_is_away_is_no_jump(wheel, sign):
    assert judged(wheel, sign * 8.0, sign * 0.9 * JUMP_RADPS)[1] == 0.0
    assert judged(wheel, sign * 8.0, sign * 1.1 * JUMP_RADPS)[1] > 0.0


@WHEELS
def test_a_wheel_that_nothing_holds_is_doubted_when_it_has_stayed_away_for_too_long(wheel):
    assert judged(wheel, -8.0, stray_s=RETURN_S - 1.5 * DT)[1] == 0.0
    assert judged(wheel, -8.0, stray_s=RETURN_S - 0.5 * DT)[1] > 0.0


@WHEELS
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_wheel_that_comes_back_slower_than_on_the_smoothest_ice_has_stayed_away(wheel, sign):
    least = ICE_FRICTION * LOAD_NM / CAR.front.wheel.inertia_kgm2 * DT
    assert judged(wheel, sign * 8.0, -sign * 0.99 * least)[0] == DT
    assert judged(wheel, sign * 8.0, -sign * 1.01 * least)[0] == 0.0


@WHEELS
@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("gated", [False, True])
def test_a_wheel_that_a_torque_of_before_still_moves_has_not_stayed_away(wheel, sign, gated):
    little = 0.99 * FREE_PART * LOAD_NM
    assert judged(wheel, sign * 8.0, sign * 1.01 * MOVED_RADPS, gated, acted_nm=sign * 200.0)[0] == 0.0
    assert judged(wheel, sign * 8.0, sign * 0.99 * MOVED_RADPS, gated, acted_nm=sign * 200.0)[0] == DT
    assert judged(wheel, sign * 8.0, sign * 1.01 * MOVED_RADPS, gated, acted_nm=sign * little)[0] == DT
    assert judged(wheel, sign * 8.0, sign * 1.01 * MOVED_RADPS, gated, acted_nm=-sign * 200.0)[0] == DT


@pytest.mark.parametrize("lag_s", [0.001, 0.01, 0.03, LAG_S])
@pytest.mark.parametrize("travel", [-1.0, 1.0])
def test_whatever_a_lag_makes_of_commands_is_between_the_torques_that_may_act(lag_s, travel):
    draw = random.Random(7)
    motion = initial_state().motion
    acts = (0.0,) * 4
    for _ in range(400):
        commanded = tuple(travel * draw.choice([0.0, -900.0, 300.0, -50.0]) for _ in range(4))
        kept = math.exp(-DT / lag_s)
        acts = tuple(c + (a - c) * kept for c, a in zip(commanded, acts, strict=True))
        least, most = acting_nm(commanded, motion, DT)
        motion = motion._replace(least_nm=least, most_nm=most)
        for i in range(4):
            assert least[i] - 1e-9 <= acts[i] <= most[i] + 1e-9


@WHEELS
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_doubted_wheel_is_good_again_by_the_time_it_is_near(wheel, sign):
    bound = GOOD_PART * 20.0 + GOOD_MPS
    assert judged(wheel, sign * 0.95 * bound, doubt_s=0.2)[1] == pytest.approx(0.2 - DT)
    assert judged(wheel, sign * 1.05 * bound, doubt_s=0.2)[1] == 0.2


@pytest.mark.parametrize("rims", list(itertools.permutations((1.0, 4.0, 6.0, 30.0))))
def test_the_middle_of_four_speeds_is_the_mean_of_the_two_between_the_others(rims):
    assert middle_of(rims) == pytest.approx(5.0)


#: The rear wheels are smaller.
UNLIKE = CAR._replace(rear=CAR.rear._replace(wheel=CAR.rear.wheel._replace(radius_m=0.2)))
RADII = (RADIUS, RADIUS, 0.2, 0.2)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize(("demand_w", "rolls"), [(-1e3, 12.0), (1e3, 9.0)])
@pytest.mark.parametrize("order", [(0, 1, 2, 3), (3, 2, 1, 0)])
def test_where_no_wheel_is_believed_the_one_that_slips_least_rolls_and_the_others_slip_beside_it(
    sign, demand_w, rolls, order
):
    rims = tuple((12.0, 11.0, 10.0, 9.0)[i] for i in order)
    w = tuple(sign * rim / radius for rim, radius in zip(rims, RADII, strict=True))
    used = wheels_to_use(w, (0.1,) * 4, sign * 13.0, 0, demand_w, UNLIKE)
    assert used == pytest.approx(tuple(13.0 / rolls * value for value in w))


@pytest.mark.parametrize("part", [0.99 * LEAST_FACTOR, 1.01 / LEAST_FACTOR])
def test_wheels_that_are_wrong_by_more_than_any_factor_are_taken_as_rolling(part):
    w = tuple(rim / radius for rim, radius in zip((10.0, 12.0, 11.0, 10.0), RADII, strict=True))
    used = wheels_to_use(w, (0.1,) * 4, 10.0 * part, 0, 1e3, UNLIKE)
    assert used == pytest.approx(tuple(10.0 * part / radius for radius in RADII))


def jumped(jump_radps):
    """Factor that undoes a jump of all four wheels of a car that rolls at 8 m/s; for how long they have been calm."""
    start = initial_state()
    rolling = 8.0 / RADIUS
    fl, fr, rl, rr = (wheel._replace(speed_radps=rolling) for wheel in start.wheels)
    motion = start.motion._replace(speed_mps=8.0, shown_mps=8.0, calm_s=2.0 * CALM_S)
    w = (rolling + jump_radps,) * 4
    return common_jump(8.0, w, (fl, fr, rl, rr), 1.0, DT, motion, CAR)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_four_wheels_that_jump_by_more_than_noise_either_way_are_undone_by_their_factor(sign):
    factor, calm_s = jumped(sign * 0.9 * COMMON_RADPS)
    assert (factor, calm_s) == (1.0, pytest.approx(2.0 * CALM_S + DT))
    jump = sign * 1.5 * COMMON_RADPS
    assert jumped(jump) == (pytest.approx(8.0 / (8.0 + RADIUS * jump)), 0.0)


@pytest.mark.parametrize("before", [1.0, 0.8, 1.25])
def test_no_factor_is_beyond_the_bounds_and_one_near_to_one_is_tyre_wear(before):
    for inside in (1.01 * LEAST_FACTOR, 0.9, 1.1, 0.99 / LEAST_FACTOR):
        assert combined_factor(before, inside / before) == pytest.approx(inside)
    for outside in (0.99 * LEAST_FACTOR, 1.01 / LEAST_FACTOR):
        assert combined_factor(before, outside / before) == before
    for worn in (1.0 - 0.9 * WORN_PART, 1.0 + 0.9 * WORN_PART):
        assert combined_factor(before, worn / before) == 1.0


@WHEELS
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_torque_towards_the_car_s_speed_explains_no_jump_away_from_it(wheel, sign):
    assert judged(wheel, sign * 3.0, sign * 1.1 * JUMP_RADPS, torque_nm=-sign * 400.0)[1] > 0.0


@WHEELS
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_gated_wheel_that_is_hardly_away_and_comes_back_has_not_stayed_away(wheel, sign):
    inertia = (CAR.front if wheel < 2 else CAR.rear).wheel.inertia_kgm2
    back = -sign * ICE_FRICTION * LOAD_NM / inertia * DT
    assert judged(wheel, sign * 0.7, 1.1 * back, gated=True)[0] == 0.0
    assert judged(wheel, sign * 0.7, 0.9 * back, gated=True)[0] == DT
