# SPDX-License-Identifier: Apache-2.0
"""The step from a guess against the step from anywhere: the same motion, or no answer of its own."""

from __future__ import annotations

import math

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from iwm_power_manager.model.chassis import aerodynamic_force_n, grade_force_n, normal_forces_n
from iwm_power_manager.model.longitudinal import Speeds, Torques, step
from iwm_power_manager.model.two_axles import UNSURE, curve_of, step_from, step_onward
from iwm_power_manager.model.tyre import friction_coefficient, peak_slip, slip_ratio
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml"), "drag").params
FIALA = CAR.with_axles(tyre=CAR.front.tyre._replace(model=1, coefficients=(30.0, 0.7, 0.0, 0.0)))


def _from_anywhere(before, torques, friction, dt_s, car):
    return tuple(step(before, torques, 0.0, 0.0, (friction, friction), dt_s, car).speeds)


def _curves(friction, car):
    return curve_of(friction, car.front), curve_of(friction, car.rear)


@settings(max_examples=400)
@given(
    speed=st.floats(0.0, 40.0),
    slips=st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)),
    motors=st.tuples(st.floats(-80.0, 200.0), st.floats(-80.0, 200.0)),
    brakes=st.tuples(st.floats(0.0, 600.0), st.floats(0.0, 600.0)),
    friction=st.sampled_from([0.1, 0.2, 0.5, 0.9]),
    dt_s=st.sampled_from([0.01, 0.1]),
    car=st.sampled_from([CAR, FIALA]),
)
def test_from_any_guess_the_motion_is_that_of_the_general_step(speed, slips, motors, brakes, friction, dt_s, car):
    before = Speeds(speed, speed * (1.0 + slips[0]) / 0.33, speed * (1.0 + slips[1]) / 0.33)
    torques = Torques(*motors, *brakes)
    guess = Speeds(speed + 0.05, (speed + 0.05) / 0.33, (speed + 0.05) / 0.33)
    moved = step_from(before, torques, guess, friction, _curves(friction, car), dt_s, car)
    assert tuple(moved.speeds) == pytest.approx(
        _from_anywhere(before, torques, friction, dt_s, car), rel=1e-6, abs=1e-6
    )
    # The books: what acts on a wheel is what turns it and what the road takes (eq. 11).
    for i, axle in enumerate((car.front, car.rear)):
        held = (moved.front_resisting_nm, moved.rear_resisting_nm)[i]
        force = (moved.front_force_n, moved.rear_force_n)[i]
        turned = axle.wheel.inertia_kgm2 / dt_s * (moved.speeds[1 + i] - before[1 + i])
        assert motors[i] - held - axle.wheel.radius_m * force == pytest.approx(turned, abs=1e-6)


@settings(max_examples=400)
@given(
    speed=st.floats(0.0, 40.0),
    slips=st.tuples(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1)),
    motors=st.tuples(st.floats(-80.0, 200.0), st.floats(-80.0, 200.0)),
    brakes=st.tuples(st.floats(0.0, 300.0), st.floats(0.0, 300.0)),
    grade=st.sampled_from([-0.15, 0.0, 0.05]),
    friction=st.tuples(st.sampled_from([0.3, 0.9]), st.sampled_from([0.4, 0.8])),
    car=st.sampled_from([CAR, FIALA]),
)
# Newton's method finds a second solution there, beyond the peak: the motion does not lead to it.
@example(
    speed=4.0488472636530775,
    slips=(-0.31445026, 0.34593554),
    motors=(150.22881101, 175.93788586),
    brakes=(574.14343845, 0.0),
    grade=0.0,
    friction=(0.9, 0.4),
    car=FIALA,
)
@example(
    speed=5.430403937143089,
    slips=(-0.45056646, 0.04815725),
    motors=(-49.10025385, 80.06417915),
    brakes=(38.21450567, 0.0),
    grade=0.0,
    friction=(0.9, 0.8),
    car=FIALA,
)
def test_onward_the_motion_is_that_of_the_general_step_or_the_one_without_a_jump_to_sliding(
    speed, slips, motors, brakes, grade, friction, car
):
    before = Speeds(speed, speed * (1.0 + slips[0]) / 0.33, speed * (1.0 + slips[1]) / 0.33)
    moved = step_onward(before, Torques(*motors, *brakes), 0.5, grade, friction, 0.01, car)
    wanted = tuple(step(before, Torques(*motors, *brakes), 0.5, grade, friction, 0.01, car).speeds)
    # What acts on the car is what accelerates it (eq. 1), and each tyre's force is that of its slip (eq. 6, 9).
    air, slope = aerodynamic_force_n(moved.speeds.car_mps, car.chassis), grade_force_n(grade, car.chassis)
    force = 2.0 * (moved.front_force_n + moved.rear_force_n) - air - slope - moved.rolling_force_n
    assert moved.speeds.car_mps - speed == pytest.approx(force * 0.01 / car.chassis.mass_kg, abs=1e-8)
    loads = normal_forces_n((moved.speeds.car_mps - speed) / 0.01, moved.speeds.car_mps, grade, car.chassis)
    for i, axle in enumerate((car.front, car.rear)):
        slip = slip_ratio(moved.speeds[1 + i], moved.speeds.car_mps, 0.33, axle.tyre.slip_speed_floor_mps)
        wanted_n = loads[i] * friction_coefficient(slip, friction[i], axle.tyre)
        assert (moved.front_force_n, moved.rear_force_n)[i] == pytest.approx(wanted_n, abs=0.01)
        if tuple(moved.speeds) != pytest.approx(wanted, rel=1e-6, abs=1e-6):
            assert abs(slip) < peak_slip(axle.tyre, friction[i])


def test_without_a_curve_it_is_the_general_step_bit_by_bit():
    before = Speeds(12.0, 36.0, 37.0)
    torques = Torques(90.0, -20.0, 0.0, 100.0)
    moved = step_from(before, torques, before, 0.5, UNSURE, 0.1, CAR)
    assert tuple(moved.speeds) == _from_anywhere(before, torques, 0.5, 0.1, CAR)


def test_a_curve_knows_its_fall_and_what_a_sliding_tyre_has_left():
    magic, fiala = curve_of(0.9, CAR.front), curve_of(0.9, FIALA.front)
    assert magic.fall < 0.0 < magic.sliding < 0.9
    # Fiala's falls towards its sliding factor, and at full slip is not there yet.
    assert fiala.sliding == pytest.approx(0.9 * (0.7 + 0.3 * math.exp(1.0 - 30.0 / 2.7)), rel=1e-9)
    rising = CAR.front.tyre._replace(coefficients=(1.0, 1.0, 1.0, 0.0))
    assert curve_of(0.9, CAR.front._replace(tyre=rising)).fall == 0.0
