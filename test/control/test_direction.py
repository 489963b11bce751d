# SPDX-License-Identifier: Apache-2.0
"""The direction of travel: what is remembered of the wheels when it changes."""

from __future__ import annotations

import pytest

from iwm_power_manager.control.direction import MOVING_MPS, hold_torque_nm, travel_direction, turned_to
from iwm_power_manager.control.motion import Motion
from iwm_power_manager.control.types import Measurement, WheelState, initial_state
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params


def remembered(k):
    return WheelState(
        motor_nm=10.0 + k,
        total_nm=-20.0 - k,
        speed_radps=3.0 + k,
        road_nm=40.0 + k,
        slip=-0.1,
        gated=True,
        heat=0.1 * k,
    )


@pytest.mark.parametrize("travel", [1.0, -1.0])
def test_what_is_remembered_of_a_wheel_has_the_other_sign_after_the_car_has_turned_round(travel):
    wheels = (remembered(0), remembered(1), remembered(2), remembered(3))
    state = initial_state()._replace(wheels=wheels, travel=-travel)
    motion = state.motion._replace(speed_mps=0.5)
    after = turned_to(state, wheels, motion, travel)
    assert (after.travel, after.motion) == (travel, motion)
    for old, new in zip(wheels, after.wheels, strict=True):
        assert (new.motor_nm, new.speed_radps, new.road_nm) == (-old.motor_nm, -old.speed_radps, -old.road_nm)
        # The friction brake goes on braking: its part is what is lost either way.
        assert new.total_nm - new.motor_nm == old.total_nm - old.motor_nm
        assert (new.slip, new.gated, new.heat) == (0.0, False, old.heat)


@pytest.mark.parametrize("travel", [1.0, -1.0])
def test_nothing_changes_while_the_direction_stays(travel):
    wheels = (remembered(0), remembered(1), remembered(2), remembered(3))
    state = initial_state()._replace(wheels=wheels, travel=travel)
    assert turned_to(state, wheels, state.motion, travel) == state


@pytest.mark.parametrize("before", [1.0, -1.0])
def test_driving_it_is_the_one_asked_for_and_braking_the_one_the_car_moves_in(before):
    for asked in (1.0, -1.0):
        for speed in (-3.0, 0.0, 3.0):
            assert travel_direction(speed, 0.0, asked, before) == asked
            assert travel_direction(speed, 5e3, asked, before) == asked
        assert travel_direction(1.01 * MOVING_MPS, -5e3, asked, before) == 1.0
        assert travel_direction(-1.01 * MOVING_MPS, -5e3, asked, before) == -1.0
        assert travel_direction(0.99 * MOVING_MPS, -5e3, asked, before) == before
        assert travel_direction(-0.99 * MOVING_MPS, -5e3, asked, before) == before


@pytest.mark.parametrize(("change_nm", "fades"), [(0.9, True), (-0.9, True), (1.1, False), (-1.1, False)])
def test_a_hold_fades_once_the_motors_change_by_less_than_one_newton_metre(change_nm, fades):
    motion = Motion(0.0, (0.0, 0.0, 0.0, 0.0), 1.0, 0)
    measurement = Measurement(0.0, (0.0, 0.0, 0.0, 0.0), 3e3, 0.01, 0.9, 1e5, 1e5, 0.5)
    held = hold_torque_nm(100.0, motion, measurement, 80.0 + change_nm, 80.0, CAR)
    assert held < 100.0 if fades else held == 100.0
