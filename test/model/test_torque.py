# SPDX-License-Identifier: Apache-2.0
"""From power to torque: the speed to divide by, what goes to the other axle, and who brakes."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iwm_power_manager.model.torque import allocate, between_wheels, blend, conversion_speed_radps
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle
from oracles.physics import regeneration_limit

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params
RADIUS = CAR.front.wheel.radius_m
POWER = st.floats(0.0, 60e3)


@pytest.mark.parametrize(
    ("wheel", "speed", "expected"),
    [
        (60.0, 15.0, 60.0),  # eq. 16 as printed
        (40.0, 15.0, 40.0),  # slip -0.12: inside the desired interval
        (30.0, 15.0, 0.8 * 15.0 / RADIUS),  # slip -0.34: a locking wheel is not pulled into the lock
        (0.0, 0.0, 1.0 / RADIUS),  # the speed floor
        (2.0, 1.1, 1.0 / RADIUS),  # 0.8 * 1.1 m/s is below the floor
        (-5.0, 0.0, 1.0 / RADIUS),
        (9.0, 1.0, 9.0),
    ],
)
def test_a_power_is_divided_by_the_wheel_s_speed_but_never_by_less_than_the_critical_slip_s(wheel, speed, expected):
    assert conversion_speed_radps(wheel, speed, 0.2, RADIUS, 1.0) == pytest.approx(expected)


def test_the_critical_slip_is_a_parameter():
    assert conversion_speed_radps(0.0, 10.0, 0.5, RADIUS, 1.0) == pytest.approx(5.0 / RADIUS)


@given(POWER, POWER, POWER, POWER)
def test_what_one_axle_has_no_room_for_goes_to_the_other(front, rear, front_capacity, rear_capacity):
    given_front, given_rear = allocate(front, rear, front_capacity, rear_capacity)
    assert 0.0 <= given_front <= front_capacity
    assert 0.0 <= given_rear <= rear_capacity
    slack = 1e-9 * (front + rear)
    assert given_front + given_rear == pytest.approx(min(front + rear, front_capacity + rear_capacity), abs=slack)
    # Nobody gives more than asked unless the other one could not.
    assert given_front <= front + slack or given_rear >= min(rear, rear_capacity) - slack
    if front <= front_capacity and rear <= rear_capacity:
        assert (given_front, given_rear) == pytest.approx((front, rear), abs=slack)
    if rear > rear_capacity:
        assert given_rear == pytest.approx(rear_capacity, abs=slack)
    if front > front_capacity:
        assert given_front == pytest.approx(front_capacity, abs=slack)


def test_rounding_never_gives_an_axle_less_than_nothing():
    assert allocate(1e16, 0.0, 1e16 / 3.0, 0.0)[1] == 0.0
    front, rear = allocate(0.1, 0.0, 0.3, 1.0)
    assert (front, rear) == (0.1, 0.0)


@given(st.floats(-400.0, 200.0), st.floats(0.0, 120.0), st.floats(0.0, 40.0), st.floats(0.0, 1.2))
def test_motor_and_friction_brake_share_the_braking(torque, wheel, speed, heat):
    motor, friction = blend(torque, wheel, speed, heat, 1.0, CAR.front.motor)
    if torque >= 0.0:
        assert (motor, friction) == (torque, 0.0)
        return
    limit = regeneration_limit(wheel, speed, heat, CAR.front.motor)
    assert motor == pytest.approx(max(torque, -limit), abs=1e-9)
    assert friction <= 0.0
    assert motor + friction == pytest.approx(torque, abs=1e-9)


@given(POWER, st.floats(1.0, 100.0), st.floats(1.0, 100.0), st.floats(0.0, 900.0), st.floats(0.0, 900.0), st.booleans())
def test_the_wheels_of_an_axle_share_equally_until_one_has_no_room(
    power, left, right, capacity_left, capacity_right, even
):
    if even:
        capacity_right = capacity_left
    power = min(power, left * capacity_left + right * capacity_right)
    torques = between_wheels(power, left, right, capacity_left, capacity_right)
    assert torques[0] * left + torques[1] * right == pytest.approx(power, rel=1e-9, abs=1e-9)
    for torque, room in zip(torques, (capacity_left, capacity_right), strict=True):
        assert 0.0 <= torque <= room * (1.0 + 1e-9) + 1e-9
    assert between_wheels(power, right, left, capacity_right, capacity_left)[::-1] == pytest.approx(
        torques, rel=1e-9, abs=1e-9
    )
    if torques[0] != torques[1]:
        assert min(torques) == min(capacity_left, capacity_right)
