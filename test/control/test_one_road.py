# SPDX-License-Identifier: Apache-2.0
"""What the road takes at least from a wheel: by the one of its side, by the one beside it where the others agree."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iwm_power_manager.control.one_road import LEAST_GRIP, UNEQUAL_PART, least_road_nm
from iwm_power_manager.control.types import initial_state
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml"), "drag").params
MASS, LENGTH, HEIGHT = CAR.chassis.mass_kg, CAR.chassis.front_axle_to_cg_m * 2.0, CAR.chassis.cg_height_m
RADIUS = CAR.front.wheel.radius_m
WHEELS = range(4)


def loads_nm(deceleration_mps2):
    """Torque that a road of friction 1 takes from each wheel."""
    shift = MASS * deceleration_mps2 * HEIGHT / LENGTH
    front, rear = ((0.5 * MASS * 9.81 + sign * shift) / 2.0 * RADIUS for sign in (1.0, -1.0))
    return front, front, rear, rear


def braked(used, slips, gated=(False,) * 4):
    """Wheels that take such parts of their loads from the road, in the deceleration that these make."""
    deceleration = 0.0
    for _ in range(50):
        loads = loads_nm(deceleration)
        deceleration = sum(part * load for part, load in zip(used, loads, strict=True)) / RADIUS / MASS
    wheel = initial_state().wheels[0]
    wheels = tuple(
        wheel._replace(road_nm=-part * load, slip=-slip, gated=away)
        for part, load, slip, away in zip(used, loads, slips, gated, strict=True)
    )
    return wheels, loads


def least(used, slips, gated=(False,) * 4):
    """The same, and what the road takes at least from each, as part of its load."""
    wheels, loads = braked(used, slips, gated)
    return [nm / load for nm, load in zip(least_road_nm(wheels, CAR), loads, strict=True)]


def one(wheel, value, others):
    return tuple(value if i == wheel else others for i in WHEELS)


@pytest.mark.parametrize("wheel", WHEELS)
@pytest.mark.parametrize(("slip", "part"), [(0.15, 1.0), (0.3, 1.0), (0.1, 1.0), (0.05, 0.5), (0.0, 0.0)])
def test_a_wheel_has_the_grip_of_the_one_of_its_side_as_far_as_it_slips_like_it(wheel, slip, part):
    slips = tuple(slip if i == wheel else 0.1 if i == wheel ^ 2 else 0.02 for i in WHEELS)
    used = tuple(0.45 if i == wheel ^ 2 else 0.1 for i in WHEELS)
    assert least(used, slips)[wheel] == pytest.approx(LEAST_GRIP * part * 0.45)


@pytest.mark.parametrize("wheel", WHEELS)
def test_where_the_other_axle_shows_one_road_a_wheel_has_the_grip_of_the_one_beside_it(wheel):
    used = tuple(0.3 if i == wheel ^ 1 else 0.25 if i == wheel else 0.2 for i in WHEELS)
    slips = tuple(0.06 if i == wheel ^ 1 else 0.1 if i == wheel else 0.04 for i in WHEELS)
    assert least(used, slips)[wheel] == pytest.approx((1.0 - UNEQUAL_PART) * 0.3)
    # The one of its side slips more than the one across, or takes less: a road for each side.
    slippery = tuple(0.06 if i == wheel ^ 2 else slip for i, slip in enumerate(slips))
    weaker = tuple(0.14 if i == wheel ^ 2 else part for i, part in enumerate(used))
    assert least(used, slippery)[wheel] == pytest.approx(LEAST_GRIP * 0.2)
    assert least(weaker, slips)[wheel] == pytest.approx(LEAST_GRIP * 0.14)


@pytest.mark.parametrize("wheel", WHEELS)
def test_wheels_that_take_next_to_nothing_do_not_tell_what_road_it_is(wheel):
    slips = one(wheel, 0.1, 0.01)
    for part, tells in ((0.11, False), (0.13, True)):
        used = tuple(0.25 if i == wheel else 0.3 if i == wheel ^ 1 else part for i in WHEELS)
        found = least(used, slips)[wheel]
        seen = min(0.3, part / LEAST_GRIP, 1.2 * 0.25)  # no road lets the one beside it slip by 0.01 with much more
        assert (found > LEAST_GRIP * part + 1e-9) == tells
        assert not tells or found <= (1.0 - UNEQUAL_PART) * seen + 1e-9


@pytest.mark.parametrize("wheel", WHEELS)
def test_a_brake_that_gives_nothing_says_nothing_of_the_road(wheel):
    """It rolls with a torque that no road takes at so little slip."""
    used = tuple(0.7 if i in (wheel ^ 1, wheel ^ 2) else 0.1 for i in WHEELS)
    slips = tuple(0.001 if i in (wheel ^ 1, wheel ^ 2) else 0.1 for i in WHEELS)
    assert least(used, slips)[wheel] < 0.03


@pytest.mark.parametrize("wheel", WHEELS)
def test_a_wheel_that_is_gated_for_it_has_to_come_back_all_the_way(wheel):
    used, slips = one(wheel, 0.1, 0.45), (0.15,) * 4
    assert least(used, slips, one(wheel, True, False))[wheel] == pytest.approx(0.45)


SIZES = st.tuples(*[st.floats(0.0, 1.0)] * 4)


@given(SIZES, SIZES, st.tuples(*[st.booleans()] * 4))
def test_left_and_right_and_both_directions_are_alike(used, slips, gated):
    wheels, _ = braked(used, slips, gated)
    a, b, c, d = least_road_nm(wheels, CAR)
    assert least_road_nm((wheels[1], wheels[0], wheels[3], wheels[2]), CAR) == (b, a, d, c)
    driven = tuple(wheel._replace(slip=-wheel.slip) for wheel in wheels)
    assert least_road_nm(driven, CAR) == (a, b, c, d)


@given(SIZES, SIZES)
def test_no_wheel_on_one_road_at_its_grip_is_asked_for_more_than_it_has(used, slips):
    """All at the peak of one road, whatever it is, and slipping as they like beyond it."""
    friction, beyond = used[0], tuple(0.16 + 0.84 * slip for slip in slips)
    assert all(part <= friction + 1e-9 for part in least((friction,) * 4, beyond))
