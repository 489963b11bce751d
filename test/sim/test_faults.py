# SPDX-License-Identifier: Apache-2.0
"""What fails in a drive: each kind of fault, its time, and several at once."""

from __future__ import annotations

import math

import pytest

from iwm_sim.faults import Fault, Faults

DT_S = 0.01
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
    faults = Faults([Fault("vehicle_speed", kind, value, 1.0, 5.0)], DT_S)
    assert faults.speed(20.0, time_s) == pytest.approx(shown)
    assert faults.wheels(WHEELS, time_s) == WHEELS


def test_a_stuck_sensor_keeps_what_it_showed_first_each_wheel_its_own():
    faults = Faults([Fault("wheels", "stuck", 0.0, 1.0, math.inf)], DT_S)
    assert faults.wheels(WHEELS, 0.5) == WHEELS
    assert faults.wheels(WHEELS, 1.0) == WHEELS
    assert faults.wheels((1.0, 2.0, 3.0, 4.0), 2.0) == WHEELS


def test_a_missing_sensor_shows_nothing_and_one_wheel_is_one_wheel():
    faults = Faults(
        [Fault("wheel_rear_left", "missing", 0.0, 0.0, 9.0), Fault("wheels", "factor", 2.0, 0.0, 9.0)], DT_S
    )
    a, b, c, d = faults.wheels(WHEELS, 1.0)
    assert (a, b, d) == (20.0, 40.0, 80.0)
    assert math.isnan(c)


@pytest.mark.parametrize(
    ("kind", "value", "torque"),
    [("dead", 0.0, 0.0), ("factor", 0.5, 15.0), ("torque_nm", -40.0, -40.0), ("reversed", 0.0, -30.0)],
)
def test_an_actuator_does_something_else_and_only_that_one(kind, value, torque):
    faults = Faults(
        [Fault("motor_rear_left", kind, value, 0.0, 9.0), Fault("brake_front_right", kind, value, 5.0, 9.0)], DT_S
    )
    assert faults.motors(WHEELS, 1.0) == (10.0, 20.0, torque, 40.0)
    assert faults.brakes(WHEELS, 1.0) == WHEELS
    assert faults.brakes(WHEELS, 6.0)[2:] == WHEELS[2:]
    assert faults.brakes((30.0,) * 4, 6.0)[1] == torque


@pytest.mark.parametrize("lag_s", [0.001, 0.02, 0.5])
def test_an_actuator_that_lags_comes_nearer_by_its_time_constant_and_for_itself(lag_s):
    faults = Faults([Fault("brake_rear_left", "lag_s", lag_s, 0.0, 9.0)], DT_S)
    steps = range(1, 21)
    acted = [faults.brakes((-300.0,) * 4, DT_S * k) for k in steps]
    # Its integral: what a lag of first order has made of a step by then.
    made = [DT_S * sum(nm[2] for nm in acted[:k]) for k in steps]
    left = [1.0 - math.exp(-DT_S * k / lag_s) for k in steps]
    assert made == pytest.approx([-300.0 * (DT_S * k - lag_s * part) for k, part in zip(steps, left, strict=True)])
    assert {nm[:2] + nm[3:] for nm in acted} == {(-300.0,) * 3}
    assert faults.motors(WHEELS, 0.3) == WHEELS


def test_a_lost_message_leaves_the_sensor_of_the_same_name_alone():
    faults = Faults([Fault("vehicle_speed", "lost", 0.0, 1.0, 2.0, message=True)], DT_S)
    arrived = [list(faults.arriving("vehicle_speed", 7, t, 90)) for t in (0.5, 1.0, 1.9, 2.0)]
    assert arrived == [[(90, 7)], [], [], [(90, 7)]]
    assert list(faults.arriving("wheel_states", 8, 1.5, 90)) == [(90, 8)]
    assert faults.speed(20.0, 1.5) == 20.0


def over_time(steps, *wrong, message="vehicle_speed"):
    """What arrives in each step, (step measured, its stamp in ms), when a message of each step is shown its number."""
    faults = Faults([Fault(message, kind, value, *when, message=True) for kind, value, *when in wrong], DT_S)
    return [
        [(shown, stamp / 1e6) for stamp, shown in faults.arriving(message, k, DT_S * k, 10_000_000 * k)]
        for k in range(steps)
    ]


def test_a_late_message_keeps_the_stamp_of_its_measurement():
    assert over_time(5, ("delay_s", 0.02, 0.0, 9.0)) == [[], [], [(0, 0.0)], [(1, 10.0)], [(2, 20.0)]]
    assert over_time(4, ("delay_s", 0.015, 0.0, 9.0)) == [[], [], [(0, 0.0)], [(1, 10.0)]]


def test_without_a_delay_a_message_arrives_at_once():
    late_for_nothing = over_time(
        9, ("delay_s", 0.0, 0.0, 9.0), ("jitter_s", 0.0, 0.0, 9.0), ("rate_hz", 100.0, 0.0, 9.0)
    )
    assert late_for_nothing == [[(k, 10.0 * k)] for k in range(9)]


def test_what_is_under_way_when_a_delay_ends_arrives_first():
    assert over_time(6, ("delay_s", 0.03, 0.0, 0.015)) == [
        [],
        [],
        [],
        [(0, 0.0)],
        [(1, 10.0), (2, 20.0), (3, 30.0), (4, 40.0)],
        [(5, 50.0)],
    ]


def test_jitter_lies_within_its_bound_never_overtakes_and_is_the_same_each_time():
    wrong = (("delay_s", 0.01, 0.0, 99.0), ("jitter_s", 0.03, 0.0, 99.0))
    arrived = over_time(2000, *wrong)
    assert arrived == over_time(2000, *wrong)
    assert arrived != over_time(2000, *wrong, message="wheel_states")
    flat = [(k, measured, stamp) for k, step in enumerate(arrived) for measured, stamp in step]
    assert [measured for _, measured, _ in flat] == list(range(len(flat)))
    assert all(stamp == 10.0 * measured for _, measured, stamp in flat)
    late = [k - measured for k, measured, _ in flat]
    assert (min(late), max(late)) == (2, 4)
    assert {late.count(n) > 300 for n in (2, 3, 4)} == {True}


@pytest.mark.parametrize("rate_hz", [100.0, 60.0, 50.0, 33.0, 7.0, 500.0])
def test_a_lower_rate_is_kept_on_average_each_message_at_the_step_nearest_to_it(rate_hz):
    sent = [k for k, step in enumerate(over_time(1000, ("rate_hz", rate_hz, 0.0, 99.0))) if step]
    expected = sorted({math.floor(100.0 / rate_hz * n + 0.5 - 1e-9) for n in range(5000)} & set(range(1000)))
    assert sent == expected
    assert len(sent) == pytest.approx(min(rate_hz, 100.0) * 10.0, abs=1)


def test_a_stamp_may_lie_as_where_a_message_is_stamped_when_it_is_sent():
    late = ("delay_s", 0.02, 0.0, 9.0)
    assert over_time(4, late, ("stamp_error_s", 0.02, 0.0, 9.0)) == [[], [], [(0, 20.0)], [(1, 30.0)]]
    assert over_time(4, late, ("stamp_error_s", -0.02, 0.0, 9.0)) == [[], [], [(0, -20.0)], [(1, -10.0)]]


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_counted_teeth_are_whole_ones_and_none_is_lost(way):
    faults = Faults([Fault("wheels", "teeth", 48.0, 0.0, math.inf)], DT_S)
    shown = [faults.wheels((way * 20.0,) * 4, DT_S * k)[2] for k in range(1000)]
    tooth_radps = 2.0 * math.pi / 48.0 / DT_S
    counts = [value / tooth_radps for value in shown]
    assert {round(count) for count in counts} == {way * 1.0, way * 2.0}
    assert all(count == pytest.approx(round(count)) for count in counts)
    assert sum(shown) / 1000 == pytest.approx(way * 20.0, abs=tooth_radps / 1000)


def test_teeth_are_counted_once_a_step_and_for_each_wheel_by_itself():
    faults = Faults([Fault("wheels", "teeth", 48.0, 0.0, math.inf)], DT_S)
    for k in range(20):
        assert faults.wheels(WHEELS, DT_S * k) == faults.wheels(WHEELS, DT_S * k)
    missing = [Fault("wheels", kind, 48.0, 0.0, math.inf) for kind in ("missing", "teeth")]
    assert all(map(math.isnan, Faults(missing, DT_S).wheels(WHEELS, 0.0)))
    one = Faults([Fault("wheel_rear_left", "teeth", 48.0, 0.0, math.inf)], DT_S)
    assert one.wheels(WHEELS, 0.0)[:2] == WHEELS[:2]
    assert one.wheels(WHEELS, 0.0)[2] != WHEELS[2]
