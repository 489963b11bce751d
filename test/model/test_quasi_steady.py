# SPDX-License-Identifier: Apache-2.0
"""Power of a split with settled slips, against plain Python that finds each slip by root search."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iwm_power_manager.model import tyre as model
from iwm_power_manager.model.quasi_steady import axle_power_w, demand_force_n, split_power_w
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle
from oracles.physics import axle_w, slip_for
from oracles.splits import split_w

CARS = {
    name: load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml"), name).params
    for name in ("none", "drag", "enabled")
}
CAR = CARS["drag"]
# Another motor and a larger wheel at the rear.
UNEVEN = CAR._replace(
    rear=CAR.rear._replace(
        wheel=CAR.rear.wheel._replace(radius_m=0.4),
        motor=CAR.rear.motor._replace(
            peak_torque_nm=350.0, max_power_w=12e3, loss_linear_torque=1.1, idle_standby_w=25.0
        ),
    )
)
FORCE = st.one_of(st.sampled_from([0.0, 10.0, -10.0, 1000.0, -8000.0]), st.floats(-8000.0, 4000.0))
SHARE = st.one_of(st.sampled_from([0.0, 0.5, 1.0]), st.floats(0.01, 0.99))


@given(
    st.floats(-3000.0, 1500.0),
    st.floats(1.0, 40.0),
    st.floats(500.0, 3000.0),
    st.sampled_from([0.9, 0.2]),
    st.booleans(),
)
def test_an_axle_takes_the_power_of_its_two_motors_at_the_settled_slip(force, speed, normal, friction, slip_aware):
    ours = axle_power_w(force, speed, normal, friction, slip_aware, False, CAR.front)
    assert ours == pytest.approx(axle_w(force, speed, normal, friction, slip_aware, CAR.front), rel=1e-5, abs=1e-3)


@given(
    st.floats(-3000.0, 1500.0),
    st.floats(1.0, 40.0),
    st.floats(500.0, 3000.0),
    st.sampled_from([0.9, 0.2]),
    st.sampled_from([(10.0, 1.9, 1.0, 0.97), (10.0, 1.9, 1.0, -3.0), (30.0, 0.7)]),
    st.tuples(*[st.floats(-3.0, 3.0)] * 2, *[st.floats(-0.5, 0.5)] * 2),
)
def test_the_bound_of_an_axle_s_power_is_one_for_every_tyre_and_every_loss(
    force, speed, normal, friction, numbers, loss
):
    name = "magic_formula" if len(numbers) == 4 else "fiala"
    tyre = model.make(name, dict(zip(model.MODELS[name].ranges, numbers, strict=True)), 0.5)
    motor = CAR.front.motor._replace(
        loss_linear_speed=loss[0],
        loss_linear_torque=loss[1],
        loss_quadratic_speed=loss[2],
        loss_quadratic_torque=loss[3],
    )
    axle = CAR.front._replace(tyre=tyre, motor=motor)
    exact = axle_power_w(force, speed, normal, friction, True, False, axle)
    assert axle_power_w(force, speed, normal, friction, True, True, axle) <= exact + 1e-9 * (1.0 + abs(exact))


@pytest.mark.parametrize("force", [300.0, -300.0])
def test_the_bound_of_an_axle_s_power_is_near_where_little_slips(force):
    exact = axle_power_w(force, 15.0, 2000.0, 0.9, True, False, CAR.front)
    rolling = axle_power_w(force, 15.0, 2000.0, 0.9, False, False, CAR.front)
    assert rolling < axle_power_w(force, 15.0, 2000.0, 0.9, True, True, CAR.front) <= exact
    assert exact - axle_power_w(force, 15.0, 2000.0, 0.9, True, True, CAR.front) < 0.01 * (exact - rolling)


def test_an_axle_in_the_air_slips_no_further_than_rolling():
    assert axle_power_w(100.0, 10.0, 0.0, 0.9, True, False, CAR.front) == axle_power_w(
        100.0, 10.0, 1e9, 0.9, False, False, CAR.front
    )


@given(
    FORCE,
    st.floats(1.0, 40.0),
    SHARE,
    st.sampled_from([0.9, 0.5, 0.2]),
    st.booleans(),
    st.sampled_from([*CARS.values(), UNEVEN]),
)
def test_a_split_costs_what_its_axles_cost_and_what_nobody_can_give_is_said(
    force, speed, share, friction, slip_aware, car
):
    power, missing = split_power_w(force, speed, share, friction, slip_aware, car)
    known, known_missing = split_w(force, speed, share, friction, slip_aware, car)
    assert power == pytest.approx(known, rel=1e-5, abs=1e-2)
    assert missing == pytest.approx(known_missing, rel=1e-9, abs=1e-6)
    assert missing >= -1e-9


@pytest.mark.parametrize("share", [0.0, 1.0])
@pytest.mark.parametrize("car", [CAR, UNEVEN], ids=["the paper's", "axles unlike"])
def test_braking_with_less_than_an_idle_axle_drags_the_working_one_drives(car, share):
    idle = car.rear if share == 1.0 else car.front
    motor, radius = idle.motor, idle.wheel.radius_m
    drag_n = 2.0 * (motor.idle_drag_constant_nm + motor.idle_drag_linear_nm_per_radps * 15.0 / radius) / radius
    powers = [split_power_w(part * drag_n, 15.0, share, 0.9, True, car)[0] for part in (-0.1, -0.5, -0.9)]
    assert powers == pytest.approx(
        [split_w(part * drag_n, 15.0, share, 0.9, True, car)[0] for part in (-0.1, -0.5, -0.9)]
    )
    # Each newton less of braking is one more to drive with: at least its own power.
    assert powers[0] - powers[1] > 0.4 * drag_n * 15.0 < powers[1] - powers[2]


def test_slip_costs_power():
    aware, _ = split_power_w(700.0, 15.0, 0.5, 0.2, True, CAR)
    blind, _ = split_power_w(700.0, 15.0, 0.5, 0.2, False, CAR)
    assert aware > 1.01 * blind


def test_what_one_axle_cannot_give_goes_to_the_other():
    # One axle's motors give 2 * 200 N m / 0.33 m = 1212 N.
    assert split_power_w(2000.0, 5.0, 1.0, 0.9, False, CAR)[1] == 0.0
    assert split_power_w(3000.0, 5.0, 1.0, 0.9, False, CAR)[1] == pytest.approx(3000.0 - 2424.24, abs=0.01)


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_an_axle_that_has_to_help_is_not_idle_and_its_drag_brakes_nothing(share):
    """On ice, 2000 N of braking are beyond both axles: no share may seem to deliver more of it than another."""
    alone = split_power_w(-2000.0, 15.0, share, 0.2, True, CAR)[1]
    assert alone == pytest.approx(split_power_w(-2000.0, 15.0, 0.5, 0.2, True, CAR)[1], abs=1e-6)
    assert alone > 300.0


def test_a_demand_stands_for_a_force_at_no_less_than_the_floor_speed():
    for slip_aware, near in ((False, 0.0), (True, 0.02)):
        assert demand_force_n(1000.0, 20.0, 0.9, slip_aware, CAR) == pytest.approx(50.0, rel=near)
        assert demand_force_n(1000.0, 0.0, 0.9, slip_aware, CAR) == 1000.0
        assert demand_force_n(-1000.0, 0.5, 0.9, slip_aware, CAR) == pytest.approx(-1000.0, rel=near)


@given(st.floats(-20e3, 20e3), st.floats(2.0, 40.0), st.sampled_from([0.9, 0.5, 0.2]))
def test_a_demand_s_force_is_that_of_wheels_that_slip_for_it(power, speed, friction):
    force = demand_force_n(power, speed, friction, True, CAR)
    peak = friction * CAR.front.tyre.coefficients[2]
    used = min(abs(power) / speed / (800.0 * 9.81), 0.99 * peak)
    slip = math.copysign(slip_for(used, friction, CAR.front.tyre), power)
    rim = speed / (1.0 - slip) if power > 0.0 else speed * (1.0 + slip)
    assert force * rim == pytest.approx(power, rel=1e-6, abs=1e-6)
