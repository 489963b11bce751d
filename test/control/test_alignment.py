# SPDX-License-Identifier: Apache-2.0
"""Which torque belongs to a change of wheel speed: against wheels that turn as torque and road say."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iwm_power_manager.control.alignment import LATEST_S, NO_SHIFT, Alignment, arrived_nm
from iwm_power_manager.control.coarse import line_weights
from iwm_power_manager.control.execution import braked
from iwm_power_manager.control.types import Measurement
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle

MS = 1_000_000
INERTIA = (0.8, 0.8, 1.3, 1.3)
PERIOD_MS = 10
CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params


class Turned:
    """Wheels under torques that change every step, on a road that takes a constant torque, seen at any millisecond."""

    def __init__(self, torques: list[float], road: float, delay_ms: int = 0) -> None:
        self.torques, self.road, self.delay_ms = torques, road, delay_ms

    def torque(self, k: int) -> tuple[float, float, float, float]:
        """Of the step `k`."""
        t = self.torques[min(k, len(self.torques) - 1)]
        return t, 0.5 * t, 2.0 * t, -t

    @property
    def roads(self) -> tuple[float, float, float, float]:
        """Torque the road takes from each wheel."""
        return self.road, 0.7 * self.road, 1.3 * self.road, -self.road

    def speeds(self, at_ms: int) -> tuple[float, float, float, float]:
        speed = [90.0] * 4
        for ms in range(at_ms):
            torque = self.torque(max(ms - self.delay_ms, 0) // PERIOD_MS)
            speed = [w + 1e-3 * (t - r) / i for w, t, r, i in zip(speed, torque, self.roads, INERTIA, strict=True)]
        return tuple(speed)


def shifted(turned: Turned, stamps_ms: list[int]) -> list[tuple[float, ...]]:
    """What the road takes as the law would reckon it in each step, `stamps_ms` the newest speeds it has."""
    alignment, roads, before = Alignment(INERTIA, turned.delay_ms / 1e3), [], None
    for k, stamp in enumerate(stamps_ms):
        now = k * PERIOD_MS
        speeds = turned.speeds(stamp)
        shift = alignment.shift_nm(now * MS, PERIOD_MS / 1e3, stamp * MS, speeds)
        if before is not None:
            last = turned.torque(k - 1)
            roads.append(
                tuple(last[i] + shift[i] - INERTIA[i] * (speeds[i] - before[i]) / (PERIOD_MS / 1e3) for i in range(4))
            )
        alignment.applied(now * MS, turned.torque(k))
        before = speeds
    return roads


TORQUES = st.lists(st.floats(-900.0, 300.0), min_size=30, max_size=30)


@given(TORQUES, st.floats(-500.0, 300.0), st.integers(0, 60), st.integers(1, 35), st.integers(0, 15))
def test_the_road_is_told_right_however_old_and_rare_the_speeds_are(torques, road, late_ms, every_ms, delay_ms) -> None:
    """Speeds measured every so often arrive so much later, and commands are torques after a while."""
    steps = range(30)
    stamps = [max((PERIOD_MS * k - late_ms) // every_ms * every_ms, 0) for k in steps]
    turned = Turned(torques, road, delay_ms)
    roads = shifted(turned, stamps)
    first = next((k for k in steps if stamps[k] >= max(every_ms, PERIOD_MS)), len(stamps))
    for found in roads[first:]:
        assert found == pytest.approx(turned.roads, abs=1e-6)


def test_speeds_that_are_nearly_of_one_time_tell_no_torque() -> None:
    """Of two that were measured 1 ms apart the noise is all there is; the road is as before."""
    turned = Turned([-100.0] * 30, -60.0)
    roads = shifted(turned, [0, 10, 11, 12, 30])
    assert roads == [pytest.approx(turned.roads)] * 4


@given(torques=st.lists(st.floats(-600.0, 200.0), min_size=40, max_size=40), road=st.floats(-150.0, 0.0))
def test_of_wheels_that_count_teeth_torques_are_weighted_as_their_counts(torques, road) -> None:
    """What is shown is the mean speed between two messages, of several of them: the road is found all the same."""
    turned, weights = Turned(torques, road), line_weights(5)
    ms = [turned.speeds(t) for t in range(0, 400, 5)]
    counted = [
        tuple((a + 4.0 * b + c) / 6.0 for a, b, c in zip(ms[2 * k - 2], ms[2 * k - 1], ms[2 * k], strict=True))
        for k in range(1, 40)
    ]
    alignment, before = Alignment(INERTIA, 0.0), None
    for k in range(5, 39):
        shown = tuple(sum(w * counted[k - 4 + i][n] for i, w in enumerate(weights)) for n in range(4))
        now = 10 * (k + 1)
        shift = alignment.shift_nm(now * MS, 0.01, now * MS, shown, weights)
        if before is not None and k > 12:
            last = turned.torque(k)
            found = [last[n] + shift[n] - INERTIA[n] * (shown[n] - before[n]) / 0.01 for n in range(4)]
            assert found == pytest.approx(turned.roads, abs=2.0)
        alignment.applied(now * MS, turned.torque(k + 1))
        before = shown


@pytest.mark.parametrize("late", [1000, -50])
def test_after_a_gap_the_road_is_as_it_was(late) -> None:
    """After a long silence, and where stamps have gone back, speeds differ from those before by what nobody knows."""
    alignment, torque = Alignment(INERTIA, 0.0), (-100.0,) * 4
    speeds = [tuple(80.0 - 0.01 * k / i for i in INERTIA) for k in range(40)]  # one N m more than the road takes
    for k in range(10):
        alignment.shift_nm(k * 10 * MS, 0.01, (k * 10 - 5) * MS, speeds[k])
        alignment.applied(k * 10 * MS, torque)
    stamp = 90 + late
    shift = alignment.shift_nm(max(100, stamp) * MS, 0.01, stamp * MS, (10.0,) * 4)
    jumped = [i * (10.0 - w) / 0.01 for i, w in zip(INERTIA, speeds[9], strict=True)]
    assert [s - j for s, j in zip(shift, jumped, strict=True)] == pytest.approx([1.0] * 4)


def test_where_messages_stay_away_no_torque_is_shifted() -> None:
    """What the road takes is not known any more."""
    alignment = Alignment(INERTIA, 0.0)
    shifts = []
    for k in range(20):
        shifts.append(alignment.shift_nm(k * 10 * MS, 0.01, min(k, 5) * 10 * MS, (80.0 - min(k, 5),) * 4))
        alignment.applied(k * 10 * MS, (-100.0,) * 4)
    assert NO_SHIFT not in shifts[6:12]
    assert shifts[12:] == [NO_SHIFT] * 8


def test_a_clock_that_was_set_back_begins_anew() -> None:
    alignment = Alignment(INERTIA, 0.0)
    alignment.shift_nm(50 * MS, 0.01, 45 * MS, (80.0,) * 4)
    alignment.applied(50 * MS, (-100.0,) * 4)
    assert alignment.shift_nm(20 * MS, 0.01, 15 * MS, (70.0,) * 4) == NO_SHIFT


def test_only_torques_of_the_last_moments_are_kept() -> None:
    """A mean over more than is kept takes the oldest for all before."""
    alignment = Alignment(INERTIA, 0.0)
    for k in range(1000):
        alignment.shift_nm(k * 10 * MS, 0.01, (k * 10 - round(LATEST_S * 1e3)) * MS, (80.0,) * 4)
        alignment.applied(k * 10 * MS, (float(k),) * 4)
    shift = alignment.shift_nm(10_000 * MS, 0.01, (10_000 - round(LATEST_S * 1e3)) * MS, (80.0,) * 4)
    assert shift == pytest.approx((974.0 - 999.0,) * 4)


def test_what_arrives_is_motor_brake_and_a_stuck_motor() -> None:
    m = Measurement(5.0, (15.0, 15.0, -15.0, 15.0), -4000.0, 0.01, 0.9, 1e4, 1e4, 0.5)
    m = m._replace(motor_gain=(1.0, 0.25, 1.0, 0.0), motor_stuck_nm=(0.0, 0.0, 0.0, 30.0))
    command = braked(m, CAR)._replace(
        motor_torque_nm=(-10.0, -20.0, -30.0, -40.0),
        friction_torque_nm=(-1.0, -2.0, -3.0, -4.0),
        brake_gain=(1.0, 0.5, 1.0, 1.0),
    )
    assert arrived_nm(command, m) == (-11.0, -6.0, -27.0, 26.0)


def test_a_torque_of_long_ago_that_still_acted_is_remembered():
    """Nothing else was commanded since: it belongs to speeds that come late."""
    alignment = Alignment((1.0,) * 4, 0.0)
    alignment.applied(0, (100.0,) * 4)
    alignment.shift_nm(850 * MS, 0.01, 850 * MS, (50.0,) * 4)
    alignment.applied(900 * MS, (-500.0,) * 4)
    assert alignment.shift_nm(910 * MS, 0.01, 860 * MS, (50.0,) * 4) == pytest.approx((600.0,) * 4)
