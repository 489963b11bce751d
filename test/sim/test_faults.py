# SPDX-License-Identifier: Apache-2.0
"""What fails in a drive: each kind of fault, its time, and several at once."""

from __future__ import annotations

import math

import pytest

from iwm_sim.faults import Fault, Faults

WHEELS = (10.0, 20.0, 30.0, 40.0)


@pytest.mark.parametrize(
    ("kind", "value", "time_s", "shown"),
    [
        ("factor", 1.2, 3.0, 24.0),
        ("offset", -5.0, 3.0, 15.0),
        ("drift_per_s", 2.0, 3.0, 24.0),
        ("value", 7.0, 3.0, 7.0),
        ("factor", 1.2, 0.9, 20.0),
        ("factor", 1.2, 5.0, 20.0),
    ],
)
def test_a_sensor_shows_something_else_while_its_fault_lasts(kind, value, time_s, shown):
    faults = Faults([Fault("vehicle_speed", kind, value, 1.0, 5.0)])
    assert faults.speed(20.0, time_s) == pytest.approx(shown)
    assert faults.wheels(WHEELS, time_s) == WHEELS


def test_a_stuck_sensor_keeps_what_it_showed_first_each_wheel_its_own():
    faults = Faults([Fault("wheels", "stuck", 0.0, 1.0, math.inf)])
    assert faults.wheels(WHEELS, 0.5) == WHEELS
    assert faults.wheels(WHEELS, 1.0) == WHEELS
    assert faults.wheels((1.0, 2.0, 3.0, 4.0), 2.0) == WHEELS


def test_a_missing_sensor_shows_nothing_and_one_wheel_is_one_wheel():
    faults = Faults([Fault("wheel_rear_left", "missing", 0.0, 0.0, 9.0), Fault("wheels", "factor", 2.0, 0.0, 9.0)])
    a, b, c, d = faults.wheels(WHEELS, 1.0)
    assert (a, b, d) == (20.0, 40.0, 80.0)
    assert math.isnan(c)


@pytest.mark.parametrize(
    ("kind", "value", "torque"),
    [("dead", 0.0, 0.0), ("factor", 0.5, 15.0), ("torque_nm", -40.0, -40.0), ("reversed", 0.0, -30.0)],
)
def test_an_actuator_does_something_else_and_only_that_one(kind, value, torque):
    faults = Faults(
        [Fault("motor_rear_left", kind, value, 0.0, 9.0), Fault("brake_front_right", kind, value, 5.0, 9.0)]
    )
    assert faults.motors(WHEELS, 1.0) == (10.0, 20.0, torque, 40.0)
    assert faults.brakes(WHEELS, 1.0) == WHEELS
    assert faults.brakes(WHEELS, 6.0)[2:] == WHEELS[2:]
    assert faults.brakes((30.0,) * 4, 6.0)[1] == torque


def test_a_lost_message_leaves_the_sensor_of_the_same_name_alone():
    faults = Faults([Fault("vehicle_speed", "lost", 0.0, 1.0, 2.0, message=True)])
    assert [faults.lost("vehicle_speed", t) for t in (0.5, 1.0, 1.9, 2.0)] == [False, True, True, False]
    assert not faults.lost("wheel_states", 1.5)
    assert faults.speed(20.0, 1.5) == 20.0
