# SPDX-License-Identifier: Apache-2.0
"""Which wheel speeds are believed: the bounds of one step, wheel by wheel and of all four."""

from __future__ import annotations

import pytest

from iwm_power_manager.control.types import initial_state
from iwm_power_manager.control.wheel_doubt import (
    CALM_S,
    COMMON_RADPS,
    HELD_MPS,
    HELD_PART,
    JUMP_RADPS,
    LEAST_FACTOR,
    RETURN_S,
    WORN_PART,
    Turning,
    combined_factor,
    common_jump,
    wheel_doubts,
)
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params
RADIUS = CAR.front.wheel.radius_m
DT = 0.01
NONE = (0.0, 0.0, 0.0, 0.0)
WHEELS = pytest.mark.parametrize("wheel", range(4))


def one(wheel, value, other):
    return tuple(value if i == wheel else other for i in range(4))


def judged(wheel, off_mps, change_radps=0.0, gated=False, stray_s=0.0, speed=20.0):
    """What is found of one wheel that is off while the others roll: time it has stayed away, time of its doubt."""
    w = one(wheel, (speed + off_mps) / RADIUS, speed / RADIUS)
    change = one(wheel, change_radps, 0.0)
    turning = Turning(NONE, change, NONE, one(wheel, gated, False), 600.0, 600.0)
    stray, doubt = wheel_doubts(w, turning, speed, 0.0, DT, one(wheel, stray_s, 0.0), NONE, CAR)
    assert [value for i, value in enumerate(stray + doubt) if i % 4 != wheel] == [0.0] * 6
    return stray[wheel], doubt[wheel]


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


def jump_of(jump_radps):
    """Factor that undoes a jump of all four wheels of a car that rolls at 8 m/s."""
    start = initial_state()
    rolling = 8.0 / RADIUS
    fl, fr, rl, rr = (wheel._replace(speed_radps=rolling) for wheel in start.wheels)
    motion = start.motion._replace(speed_mps=8.0, shown_mps=8.0, calm_s=2.0 * CALM_S)
    w = (rolling + jump_radps,) * 4
    return common_jump(8.0, w, (fl, fr, rl, rr), 1.0, DT, motion, CAR)[0]


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_four_wheels_that_jump_by_more_than_noise_either_way_are_undone_by_their_factor(sign):
    assert jump_of(sign * 0.9 * COMMON_RADPS) == 1.0
    jump = sign * 1.5 * COMMON_RADPS
    assert jump_of(jump) == pytest.approx(8.0 / (8.0 + RADIUS * jump))


@pytest.mark.parametrize("before", [1.0, 0.8, 1.25])
def test_no_factor_is_beyond_the_bounds_and_one_near_to_one_is_tyre_wear(before):
    for inside in (1.01 * LEAST_FACTOR, 0.9, 1.1, 0.99 / LEAST_FACTOR):
        assert combined_factor(before, inside / before) == pytest.approx(inside)
    for outside in (0.99 * LEAST_FACTOR, 1.01 / LEAST_FACTOR):
        assert combined_factor(before, outside / before) == before
    for worn in (1.0 - 0.9 * WORN_PART, 1.0 + 0.9 * WORN_PART):
        assert combined_factor(before, worn / before) == 1.0
