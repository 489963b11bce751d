# SPDX-License-Identifier: Apache-2.0
"""Emergency stops, and the best a road allows."""

import numpy as np
import pytest

from iwm_sim.study import skid
from iwm_sim.study.cases import vehicle_of
from iwm_sim.study.skid import Stop

VEHICLE = "jalalmaab_2015"


@pytest.fixture(scope="module")
def car():
    return vehicle_of(VEHICLE, "none").params


@pytest.mark.parametrize("friction", [0.2, 0.9])
def test_the_best_stop_is_the_integral_of_the_motion_at_its_slip(car, friction):
    best_m, slip = skid.best_stop_m(friction, 25.0, car)
    assert slip == pytest.approx(0.18, abs=0.01)  # the tyre's peak
    speed, distance, step = 25.0, 0.0, 1e-4
    air = 0.5 * 1.2 * 1.66 * 0.34 / 800.0
    while speed > 0.0:
        slower = speed - (9.81 * (friction + 0.010) + air * speed * speed) * step
        distance += 0.5 * (speed + max(slower, 0.0)) * step
        speed = slower
    assert best_m == pytest.approx(distance, rel=1e-3)


@pytest.mark.parametrize("friction", [0.2, 0.9])
def test_the_limiter_stops_within_5_percent_of_the_best_and_locks_nothing(friction):
    row = skid.emergency_stop(Stop(VEHICLE, "drag", friction, "limiter", "equal"))
    assert row.stopped
    assert -0.5 < row.longer_percent < 5.0
    assert row.longest_locked_s <= 0.1


def test_without_a_gate_the_wheels_lock_and_the_car_slides_further():
    off = skid.emergency_stop(Stop(VEHICLE, "drag", 0.2, "off", "equal"))
    limiter = skid.emergency_stop(Stop(VEHICLE, "drag", 0.2, "limiter", "equal"))
    assert off.min_slip == -1.0
    assert off.locked_s > 5.0
    assert off.distance_m > 1.05 * limiter.distance_m


def test_nothing_stops_shorter_than_the_best(car):
    for gate_mode in ("off", "table2", "limiter"):
        row = skid.emergency_stop(Stop(VEHICLE, "none", 0.5, gate_mode, "equal", from_mps=10.0))
        assert row.distance_m > 0.99 * skid.best_stop_m(0.5, 10.0, car)[0]
        assert np.isfinite(row.rms_jerk_mps3)
