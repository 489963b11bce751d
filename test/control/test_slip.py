# SPDX-License-Identifier: Apache-2.0
"""Slip of an axle, its filter, the road's torque and the limiter's room, against plain Python and by hand."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iwm_power_manager.control.slip import (
    UNLIMITED_NM,
    driven_slip_for_gate,
    filtered,
    gained_radps,
    limiter_torque_nm,
    road_torque_nm,
    worse_slip,
)
from iwm_power_manager.control.types import initial_state
from iwm_power_manager.model.tyre import slip_ratio
from oracles import control_law as oracle

RADIUS, INERTIA = 0.33, 1.1


@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_the_worse_wheel_speaks_for_its_axle(left, right):
    ours = worse_slip(left, right)
    assert ours in (left, right)
    assert abs(ours) == max(abs(left), abs(right))


def test_of_two_equally_bad_wheels_the_right_one_counts():
    assert worse_slip(-0.5, 0.5) == 0.5
    assert worse_slip(0.5, -0.5) == -0.5


@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(0.001, 0.1), st.sampled_from([0.0, 0.02, 1.0]))
def test_the_filter_is_an_implicit_first_order_lag(before, value, dt, constant):
    assert filtered(before, value, dt, constant) == pytest.approx(
        oracle.low_pass(before, value, dt, constant), abs=1e-12
    )


def test_a_filter_covers_63_percent_of_a_step_in_its_time_constant():
    value = 0.0
    for _ in range(1000):
        value = filtered(value, 1.0, 1e-4, 0.1)
    assert value == pytest.approx(1.0 - math.exp(-1.0), abs=1e-3)


def test_the_road_takes_what_does_not_turn_the_wheel():
    assert road_torque_nm(50.0, 0.0, 0.01, INERTIA) == 50.0
    # 20 N m speed the wheel up by 0.1818 rad/s in 0.01 s; the other 30 went into the road.
    assert road_torque_nm(50.0, 20.0 * 0.01 / INERTIA, 0.01, INERTIA) == pytest.approx(30.0)


SETTINGS = st.builds(
    SimpleNamespace,
    slip_target=st.sampled_from([0.15, 0.05]),
    slip_limiter_s=st.sampled_from([0.03, 0.1]),
    slip_speed_floor_mps=st.sampled_from([0.5, 1.0]),
)
AXLE = SimpleNamespace(wheel=SimpleNamespace(radius_m=RADIUS, inertia_kgm2=INERTIA))


@given(
    st.booleans(),
    st.floats(-500.0, 500.0),
    st.floats(-20.0, 200.0),
    st.one_of(st.floats(0.0, 3.0), st.floats(0.0, 60.0)),
    SETTINGS,
)
def test_the_room_is_the_road_s_torque_and_what_turns_the_wheel_to_its_target(braking, road, wheel, speed, s):
    room = limiter_torque_nm(
        braking, road, wheel, speed, s.slip_target, s.slip_limiter_s, s.slip_speed_floor_mps, RADIUS, INERTIA
    )
    expected = oracle.grip(braking, road, wheel, speed, s.slip_target, s, AXLE)
    if math.isinf(expected):
        assert room == UNLIMITED_NM
    else:
        assert room == pytest.approx(expected, rel=1e-9, abs=1e-9)
        assert room >= 0.0


def test_brakes_can_always_hold_a_car_at_rest():
    assert limiter_torque_nm(True, 0.0, 0.0, 0.0, 0.15, 0.03, 1.0, RADIUS, INERTIA) == UNLIMITED_NM
    assert limiter_torque_nm(True, 0.0, 0.0, 1.0, 0.15, 0.03, 1.0, RADIUS, INERTIA) < UNLIMITED_NM


def test_at_walking_pace_braking_steers_the_wheel_to_a_stop_and_never_backwards():
    # A slip speed of 0.3 m/s would be backwards at 0.1 m/s.
    room = limiter_torque_nm(True, -10.0, 0.0, 0.1, 0.15, 0.03, 0.05, RADIUS, INERTIA)
    assert room == pytest.approx(10.0)


def test_a_car_at_rest_can_start():
    # 0.3 m/s of slip speed within 0.03 s.
    assert limiter_torque_nm(False, 0.0, 0.0, 0.0, 0.15, 0.03, 1.0, RADIUS, INERTIA) == pytest.approx(
        0.3 / RADIUS * INERTIA / 0.03
    )


@given(st.floats(-50.0, 50.0), st.floats(-5.0, 5.0), st.floats(-3.0, 3.0), st.floats(-3.0, 3.0))
def test_wheels_that_turn_alike_share_what_they_gain_and_others_have_their_own(before, apart, own_gain, other_gain):
    wheel = initial_state().wheels[0]
    own, other = wheel._replace(speed_radps=before), wheel._replace(speed_radps=before + apart)
    now, there = own.speed_radps + own_gain, other.speed_radps + other_gain
    gained = gained_radps(own, now, other, there, RADIUS)
    mean = pytest.approx(0.5 * (own_gain + other_gain), abs=1e-9)
    assert gained == (mean if abs(now - there) * RADIUS < 0.3 else pytest.approx(own_gain, abs=1e-9))


SPEED = st.one_of(st.floats(0.0, 3.0), st.floats(0.0, 60.0))
TARGETS = st.sampled_from([(0.16, 0.2), (0.01, 0.2), (0.08, 0.1), (0.3, 0.5)])


@given(SPEED, TARGETS, st.floats(0.1, 3.0))
def test_a_driven_wheel_that_the_limiter_holds_at_its_target_is_short_of_the_gate_at_any_speed(speed, slips, floor):
    target, critical = slips
    # Where it wants no torque that the road does not take, there it holds the wheel.
    low, high = speed / RADIUS, 2.0 * speed / RADIUS + 9.0
    for _ in range(80):
        wheel = 0.5 * (low + high)
        room = limiter_torque_nm(False, 0.0, wheel, speed, target, 0.025, 0.0, RADIUS, INERTIA)
        low, high = (low, wheel) if room == 0.0 else (wheel, high)
    slip = driven_slip_for_gate(slip_ratio(wheel, speed, RADIUS, floor), wheel, speed, critical, floor, RADIUS)
    assert slip <= max(target, 0.8 * critical) * (1.0 + 1e-9)


@given(st.floats(0.0, 60.0), st.floats(0.0, 200.0), TARGETS, st.floats(0.1, 3.0))
def test_the_gate_goes_by_the_slip_itself_unless_it_is_a_matter_of_walking_pace(speed, wheel, slips, floor):
    critical = slips[1]
    slip = slip_ratio(wheel, speed, RADIUS, floor)
    for_gate = driven_slip_for_gate(slip, wheel, speed, critical, floor, RADIUS)
    if max(speed, wheel * RADIUS, floor) * critical >= 0.375:
        assert for_gate == pytest.approx(slip)
    else:
        assert for_gate == pytest.approx((wheel * RADIUS - speed) / 0.375 * critical)
