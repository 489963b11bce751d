# SPDX-License-Identifier: Apache-2.0
"""What the road takes at least from a wheel: by the one of its side, by the one beside it where the others agree."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iwm_power_manager.control.motion_vote import BEST_ROAD
from iwm_power_manager.control.one_road import UNEQUAL_PART, least_road_nm
from iwm_power_manager.control.types import initial_state
from iwm_power_manager.model import tyre
from iwm_power_manager.model.tyre import friction_coefficient
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml"), "drag").params
#: Axles that have neither loads nor wheels nor tyres in common.
UNLIKE = CAR._replace(
    chassis=CAR.chassis._replace(front_axle_to_cg_m=0.8, rear_axle_to_cg_m=1.6),
    rear=CAR.rear._replace(
        wheel=CAR.rear.wheel._replace(radius_m=0.4),
        tyre=tyre.make("fiala", {"slip_stiffness": 18.0, "sliding_factor": 0.9}, 0.5),
    ),
)
CARS = pytest.mark.parametrize("car", [CAR, UNLIKE], ids=["the paper's", "axles unlike"])
WHEELS = range(4)
#: Of two wheels on one road.
EVEN = 1.0 - UNEQUAL_PART


def axles(car):
    return car.front, car.front, car.rear, car.rear


def loads_nm(deceleration_mps2, car):
    """Torque that a road of friction 1 takes from each wheel."""
    c = car.chassis
    length = c.front_axle_to_cg_m + c.rear_axle_to_cg_m
    front_n = c.mass_kg * (9.81 * c.rear_axle_to_cg_m + deceleration_mps2 * c.cg_height_m) / length
    loads_n = (front_n, front_n, c.mass_kg * 9.81 - front_n, c.mass_kg * 9.81 - front_n)
    return tuple(0.5 * load * axle.wheel.radius_m for load, axle in zip(loads_n, axles(car), strict=True))


def braked(used, slips, gated=(False,) * 4, car=CAR):
    """Wheels that take such parts of their loads from the road, in the deceleration that these make."""
    deceleration = 0.0
    for _ in range(50):
        loads = loads_nm(deceleration, car)
        forces = [part * nm / axle.wheel.radius_m for part, nm, axle in zip(used, loads, axles(car), strict=True)]
        deceleration = sum(forces) / car.chassis.mass_kg
    wheel = initial_state().wheels[0]
    wheels = tuple(
        wheel._replace(road_nm=-part * load, slip=-slip, gated=away)
        for part, load, slip, away in zip(used, loads, slips, gated, strict=True)
    )
    return wheels, loads


def least(used, slips, gated=(False,) * 4, car=CAR):
    """The same, and what the road takes at least from each, as part of its load."""
    wheels, loads = braked(used, slips, gated, car)
    return [nm / load for nm, load in zip(least_road_nm(wheels, car), loads, strict=True)]


def one(wheel, value, others):
    return tuple(value if i == wheel else others for i in WHEELS)


@CARS
@pytest.mark.parametrize("wheel", WHEELS)
@pytest.mark.parametrize(("slip", "part"), [(1.0, 1.0), (0.3, 1.0), (0.15, 1.0), (0.1, 1.0), (0.05, 0.5), (0.0, 0.0)])
def test_a_wheel_has_the_grip_of_the_one_of_its_side_as_far_as_it_slips_like_it(wheel, slip, part, car):
    """Beyond the peak, what its tyre has left there."""
    slips = tuple(slip if i == wheel else 0.1 if i == wheel ^ 2 else 0.02 for i in WHEELS)
    used = tuple(0.45 if i == wheel ^ 2 else 0.1 for i in WHEELS)
    own, along = (friction_coefficient(slips[i], 1.0, axles(car)[i].tyre) for i in (wheel, wheel ^ 2))
    left = min(own / along, 1.0) if slip >= 0.1 else 1.0
    assert slip < 1.0 or left < 0.97 or car is UNLIKE
    assert least(used, slips, car=car)[wheel] == pytest.approx(EVEN * left * part * 0.45)


@pytest.mark.parametrize("wheel", WHEELS)
def test_where_the_other_axle_shows_one_road_a_wheel_has_the_grip_of_the_one_beside_it(wheel):
    used = tuple(0.3 if i == wheel ^ 1 else 0.25 if i == wheel else 0.2 for i in WHEELS)
    slips = tuple(0.06 if i == wheel ^ 1 else 0.1 if i == wheel else 0.04 for i in WHEELS)
    assert least(used, slips)[wheel] == pytest.approx(EVEN * 0.3)
    # The one of its side slips more than the one across, or takes less: a road for each side.
    slippery = tuple(0.06 if i == wheel ^ 2 else slip for i, slip in enumerate(slips))
    weaker = tuple(0.14 if i == wheel ^ 2 else part for i, part in enumerate(used))
    assert least(used, slippery)[wheel] == pytest.approx(EVEN * 0.2)
    assert least(weaker, slips)[wheel] == pytest.approx(EVEN * 0.14)


@pytest.mark.parametrize("wheel", WHEELS)
def test_wheels_that_take_next_to_nothing_do_not_tell_what_road_it_is(wheel):
    slips = one(wheel, 0.1, 0.01)
    for part, tells in ((0.11, False), (0.13, True)):
        used = tuple(0.25 if i == wheel else 0.3 if i == wheel ^ 1 else part for i in WHEELS)
        found = least(used, slips)[wheel]
        seen = min(0.3, part / EVEN, 1.2 * 0.25)  # no road lets the one beside it slip by 0.01 with much more
        assert (found > EVEN * part + 1e-9) == tells
        assert not tells or found <= EVEN * seen + 1e-9


@pytest.mark.parametrize("wheel", WHEELS)
def test_a_brake_that_gives_nothing_says_nothing_of_the_road(wheel):
    """It rolls with a torque that no road takes at so little slip."""
    used = tuple(0.7 if i in (wheel ^ 1, wheel ^ 2) else 0.1 for i in WHEELS)
    slips = tuple(0.001 if i in (wheel ^ 1, wheel ^ 2) else 0.1 for i in WHEELS)
    assert least(used, slips)[wheel] < 0.03


@CARS
@pytest.mark.parametrize("wheel", WHEELS)
def test_a_torque_counts_as_far_as_the_wheel_s_own_tyre_takes_it_at_its_slip(wheel, car):
    used, slips = one(wheel ^ 2, 0.5, 0.1), one(wheel, 0.02, 0.01)
    most = BEST_ROAD * friction_coefficient(0.01, 1.0, axles(car)[wheel ^ 2].tyre)
    assert most < 0.5
    assert least(used, slips, car=car)[wheel] == pytest.approx(EVEN * most)


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
