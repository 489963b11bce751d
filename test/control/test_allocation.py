# SPDX-License-Identifier: Apache-2.0
"""From the demand to the torques of four wheels: which axle's brakes decide what the other one may slip."""

from __future__ import annotations

import math

import pytest

from iwm_power_manager.control.allocation import drive
from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.control.table import empty_table
from iwm_power_manager.control.types import Measurement, initial_state
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params
SPEED = 20.0


def rear_nm(brake_gain=(1.0, 1.0, 1.0, 1.0), car=CAR, demand_w=-60e3):
    """Braking torque of the rear wheels, which slip by 0.1 while the front ones roll and more is asked for."""
    rims = [SPEED * part / CAR.front.wheel.radius_m for part in (1.0, 1.0, 0.9, 0.9)]
    start = initial_state()
    wheels = tuple(
        wheel._replace(speed_radps=rim, total_nm=-200.0, slip=rim * CAR.front.wheel.radius_m / SPEED - 1.0)
        for wheel, rim in zip(start.wheels, rims, strict=True)
    )
    state = start._replace(steps=1, wheels=wheels, motion=start.motion._replace(brake_gain=brake_gain))
    m = Measurement(
        SPEED, tuple(rims), demand_w, 0.01, 0.9, 47.5e3, 47.5e3, 0.6, (1.0,) * 4, acceleration_mps2=math.nan
    )
    command, _ = drive(m, state, False, 1.0, default_settings("equal"), car, empty_table())
    left, right = (-command.motor_torque_nm[i] - command.friction_torque_nm[i] for i in (2, 3))
    assert left == right
    return left


HELD_NM = rear_nm()


@pytest.mark.parametrize("weak", range(4))
def test_rear_wheels_are_held_to_the_slip_of_front_ones_whose_brakes_are_whole(weak):
    nm = rear_nm(tuple(0.5 if i == weak else 1.0 for i in range(4)))
    assert nm > HELD_NM + 100.0 if weak < 2 else nm == HELD_NM


def test_not_where_the_driver_asks_for_more_than_gentle_braking():
    """Of a car of 800 kg at 20 m/s, 64 kW are 4 m/s2: beyond, all wheels give what they can."""
    assert CAR.chassis.mass_kg == 800.0
    assert rear_nm(demand_w=-64e3) == HELD_NM
    assert rear_nm(demand_w=-64.1e3) > HELD_NM + 100.0


def test_not_where_the_front_brakes_are_another_system_s():
    none = CAR.front.friction_brake._replace(max_torque_nm=0.0)
    assert rear_nm(car=CAR._replace(front=CAR.front._replace(friction_brake=none))) > HELD_NM + 100.0
    without_rear = rear_nm(car=CAR._replace(rear=CAR.rear._replace(friction_brake=none)))
    assert without_rear <= HELD_NM
