# SPDX-License-Identifier: Apache-2.0
"""What the two wheels of an axle may do: how much each may slip."""

from __future__ import annotations

import cmath

import pytest

from iwm_power_manager.control.axle import slip_targets
from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.model.chassis import GRAVITY_MPS2
from iwm_power_manager.model.tyre import friction_coefficient
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle

SETTINGS = default_settings("equal")
MOST, LEAST = SETTINGS.slip_target, SETTINGS.unequal_rear_slip_target


def targets(*slips: float, speed: float = 20.0, braking: bool = True, unequal_s: float = 0.0, brakes: bool = True):
    """Slip each wheel is held at, with wheels that slip so."""
    return slip_targets(unequal_s, speed, braking, False, slips, brakes, (1.0,) * 4, SETTINGS)


def driven_targets(*slips: float, gain: tuple[float, ...], speed: float = 20.0, braking: bool = False):
    """The same of wheels that are driven by motors that give so much of their torque."""
    return slip_targets(0.0, speed, braking, False, slips, True, gain, SETTINGS)


@pytest.mark.parametrize("fronts", [(-0.06, -0.08), (-0.08, -0.06)])
@pytest.mark.parametrize("rears", [(-0.2, -0.03), (-0.03, -0.2), (-0.2, -0.2)])
def test_braked_rear_wheels_slip_no_more_than_either_front_one(fronts, rears):
    assert targets(*fronts, *rears) == pytest.approx((MOST, MOST, 0.06, 0.06))


def test_they_may_slip_a_little_beside_front_wheels_that_roll_and_no_more_than_others_beside_locked_ones():
    assert targets(0.0, 0.0, -0.2, -0.2) == (MOST, MOST, LEAST, LEAST)
    assert targets(-1.0, -1.0, -0.2, -0.2) == (MOST, MOST, MOST, MOST)


def test_how_little_goes_with_one_over_the_speed_and_ends_where_the_yaw_budgets_are_at_their_most():
    for speed in (10.1, 15.0, 20.0):
        assert targets(0.0, 0.0, -0.2, -0.2, speed=speed)[2] == pytest.approx(LEAST * 20.0 / speed)
    assert targets(0.0, 0.0, -0.2, -0.2, speed=40.0)[2] == LEAST
    assert targets(0.0, 0.0, -0.2, -0.2, speed=10.0) == targets(0.0, 0.0, -0.2, -0.2, speed=0.0) == (MOST,) * 4


def test_where_a_rear_wheel_rolls_or_the_front_cannot_take_over_or_nothing_brakes_all_wheels_may_slip_alike():
    assert targets(0.0, 0.0, -0.016, -0.016) == (MOST, MOST, LEAST, LEAST)
    for rears in ((-0.2, -0.014), (-0.014, -0.2)):
        assert targets(0.0, 0.0, *rears) == (MOST,) * 4
    assert targets(0.0, 0.0, -0.2, -0.2, brakes=False) == (MOST,) * 4
    assert targets(0.0, 0.0, -0.2, -0.2, braking=False) == (MOST,) * 4


@pytest.mark.parametrize("unequal_s", [-0.03, -0.01, 0.01, 0.03])
def test_for_torques_that_have_just_become_unequal_too(unequal_s):
    assert targets(0.0, 0.0, -0.2, -0.2, unequal_s=unequal_s) == (MOST,) * 4


def growth_per_s(front_slip: float, rear_slip: float, speed: float, friction: float) -> float:
    """How fast a turn grows by itself on a car whose wheels slip so: the faster root of a single-track model."""
    car = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params
    mass, arm = car.chassis.mass_kg, car.chassis.front_axle_to_cg_m
    assert arm == car.chassis.rear_axle_to_cg_m
    # Of 0.8 of the braking that the road allows.
    moved = 0.8 * friction * mass * GRAVITY_MPS2 * car.chassis.cg_height_m / (2.0 * arm)
    # A tyre that slips along and a little across gives its force against the sum of both.
    front = (
        (0.5 * mass * GRAVITY_MPS2 + moved) * friction_coefficient(front_slip, friction, car.front.tyre) / front_slip
    )
    rear = (0.5 * mass * GRAVITY_MPS2 - moved) * friction_coefficient(rear_slip, friction, car.rear.tyre) / rear_slip
    # With a yaw inertia of mass x arm^2.
    both, apart = (front + rear) / (mass * speed), (front - rear) / (mass * arm)
    trace, determinant = -2.0 * both, both * both - (1.0 + apart * arm / speed**2) * apart
    return 0.5 * trace + cmath.sqrt(0.25 * trace * trace - determinant).real


@pytest.mark.parametrize("speed", [10.1, 12.5, 15.0, 20.0, 25.0, 30.0, 35.0])
@pytest.mark.parametrize("front", [0.03, 0.04])
def test_a_turn_grows_no_faster_than_a_driver_sees_it_where_rear_wheels_slip_as_much_as_they_may(speed, front):
    """On 0.2: by e in a second; his preview and delay are 1.1 s."""
    rear = targets(-front, -front, -0.2, -0.2, speed=speed)[2]
    assert growth_per_s(front, rear, speed, 0.2) <= 1.0
    assert growth_per_s(front, MOST, speed, 0.2) > 1.3


@pytest.mark.parametrize("weak", [0.0, 0.5, 0.9])
@pytest.mark.parametrize("wheel", [0, 1])
def test_a_driven_front_wheel_beside_a_weaker_motor_slips_no_more_than_that_one_s(wheel, weak):
    gain = tuple(weak if i == wheel else 1.0 for i in range(4))
    for slip, own in ((0.06, 0.16), (0.1, 0.16), (0.06, 0.03)):
        slips = tuple(slip if i == wheel else own for i in range(4))
        found = driven_targets(*slips, gain=gain)
        assert found[:2] == tuple(MOST if i == wheel else slip for i in range(2))
    assert driven_targets(*(0.5,) * 4, gain=gain) == (MOST,) * 4
    assert driven_targets(*(0.16,) * 4, gain=(weak, weak, 1.0, 1.0))[:2] == (MOST, MOST)


@pytest.mark.parametrize(
    ("gain", "front"), [((1.0, 0.0, 0.0, 1.0), (0.06, MOST)), ((0.0, 1.0, 1.0, 0.0), (MOST, 0.06))]
)
def test_a_weak_rear_motor_changes_nothing_for_the_front_wheels(gain, front):
    assert driven_targets(0.06, 0.06, 0.0, 0.0, gain=gain)[:2] == front


def test_with_one_of_their_own_motors_lost_too_driven_rear_wheels_slip_no_more_than_the_front_ones():
    for gain in ((0.0, 0.0, 1.0, 1.0), (1.0, 1.0, 0.5, 1.0), (1.0, 1.0, 1.0, 0.5)):
        for fronts in ((0.06, 0.1), (0.1, 0.06)):
            assert driven_targets(*fronts, 0.16, 0.16, gain=gain) == (MOST, MOST, 0.06, 0.06)


@pytest.mark.parametrize("wheel", range(4))
def test_whichever_motor_is_lost_they_do(wheel):
    gain = tuple(0.5 if i == wheel else 1.0 for i in range(4))
    assert driven_targets(0.06, 0.06, 0.16, 0.16, gain=gain)[2:] == (0.06, 0.06)


def test_what_they_may_slip_all_the_same_goes_with_the_square_of_the_speed():
    def least(speed):
        return driven_targets(0.0, 0.0, 0.2, 0.2, gain=(0.0, 1.0, 1.0, 1.0), speed=speed)[1:3]

    assert least(20.0) == pytest.approx((0.01, LEAST))
    assert least(30.0) == pytest.approx((0.01 / 2.25, LEAST / 2.25))
    assert least(10.0) == pytest.approx((0.04, 2.0 * LEAST))
    assert least(0.0) == (MOST, MOST)


def test_with_whole_motors_or_where_a_rear_wheel_rolls_all_driven_wheels_may_slip_alike():
    assert driven_targets(0.0, 0.0, 0.2, 0.2, gain=(1.0,) * 4) == (MOST,) * 4
    for rears in ((0.2, 0.014), (0.014, 0.2)):
        assert driven_targets(0.0, 0.0, *rears, gain=(0.0, 0.0, 1.0, 1.0)) == (MOST,) * 4
    assert driven_targets(0.0, 0.0, 0.016, 0.016, gain=(0.0, 0.0, 1.0, 1.0))[2:] == (LEAST, LEAST)


def test_braking_a_lost_motor_changes_no_slip():
    """The friction brakes do its work."""
    assert driven_targets(0.0, 0.0, -0.01, -0.01, gain=(0.0, 1.0, 1.0, 1.0), braking=True) == (MOST,) * 4
