# SPDX-License-Identifier: Apache-2.0
"""Slip and Magic Formula against their definitions, and each inverse against its direct form."""

from __future__ import annotations

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from iwm_power_manager.model import tyre as model
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle
from oracles import physics
from oracles.step import friction_coefficient

PAPER = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params.front.tyre
TYRES = st.builds(
    lambda *values: model.make(
        "magic_formula", dict(zip(model.MODELS["magic_formula"].ranges, values, strict=True)), 0.5
    ),
    st.floats(5.0, 30.0),
    st.floats(1.2, 2.0),
    st.floats(0.5, 1.5),
    st.floats(-2.0, 0.99),
)


def peak_factor(tyre):
    return model.numbers(tyre)[1]["peak_factor"]


@given(st.floats(-10.0, 200.0), st.floats(0.0, 60.0))
def test_slip_follows_eq_10_by_the_sign_of_the_slip_speed(wheel, speed):
    assert model.slip_ratio(wheel, speed, 0.33, 0.5) == pytest.approx(physics.slip(wheel, speed, 0.33, 0.5), abs=1e-12)


@pytest.mark.parametrize(
    ("wheel", "speed", "slip"),
    [
        (0.0, 10.0, -1.0),
        (10.0, 0.0, 1.0),
        (20.0, 10.0, 0.5),
        (5.0, 10.0, -0.5),
        (10.0, 10.0, 0.0),
        (0.0, 0.0, 0.0),
        (0.25, 0.0, 0.5),
        (0.0, 0.25, -0.5),
    ],
)
def test_slip_by_hand_standstill_included(wheel, speed, slip):
    assert model.slip_ratio(wheel, speed, 1.0, 0.5) == pytest.approx(slip)


@given(st.floats(-1.0, 0.95), st.floats(1.0, 60.0))
def test_a_wheel_at_a_slip_has_that_slip(slip, speed):
    wheel = model.wheel_speed_at_slip(slip, speed, 0.33)
    assert model.slip_ratio(wheel, speed, 0.33, 0.5) == pytest.approx(slip, abs=1e-12)


@given(st.floats(-1.0, 1.0), st.floats(0.0, 1.2), TYRES)
def test_friction_follows_eq_9(slip, peak, tyre):
    expected = friction_coefficient(slip, peak, tyre)
    assert model.friction_coefficient(slip, peak, tyre) == pytest.approx(expected, abs=1e-12)
    assert model.friction_and_slope(slip, peak, tyre)[0] == pytest.approx(expected, abs=1e-12)
    assert abs(expected) <= peak * peak_factor(tyre)


@given(st.floats(-1.0, 1.0), TYRES)
def test_the_slope_is_the_derivative(slip, tyre):
    h = 1e-6
    secant = (friction_coefficient(slip + h, 0.9, tyre) - friction_coefficient(slip - h, 0.9, tyre)) / (2.0 * h)
    assert model.friction_and_slope(slip, 0.9, tyre)[1] == pytest.approx(secant, rel=1e-5, abs=1e-5)


def test_the_slope_at_rest_is_b_c_d():
    slope = model.friction_and_slope(0.0, 0.5, PAPER)[1]
    assert slope == pytest.approx(0.5 * 10.0 * 1.9 * 1.0)


@given(st.floats(-1.5, 1.5), st.floats(0.05, 1.2), TYRES)
def test_the_inverse_is_the_slip_below_the_peak_or_the_peak(friction, peak, tyre):
    # Where the shape never comes down again there is no peak to speak of.
    assume(physics.peak_slip(tyre) < 0.99)
    slip = model.slip_at_friction(friction, peak, tyre)
    reachable = peak * peak_factor(tyre)
    assert abs(slip) <= physics.peak_slip(tyre) + 1e-6
    assert friction_coefficient(slip, peak, tyre) == pytest.approx(min(max(friction, -reachable), reachable), abs=1e-9)


def test_without_grip_or_without_demand_there_is_no_slip():
    assert model.slip_at_friction(0.3, 0.0, PAPER) == 0.0
    assert model.slip_at_friction(0.0, 0.9, PAPER) == 0.0


def test_the_paper_s_tyre_peaks_at_a_slip_of_0_18():
    assert model.peak_slip(PAPER) == pytest.approx(0.18, abs=0.005)
    assert model.peak_slip(PAPER) == pytest.approx(physics.peak_slip(PAPER), abs=1e-6)
    weak = model.make("magic_formula", model.numbers(PAPER)[1] | {"peak_factor": 0.7}, 0.5)
    assert model.peak_slip(weak) == pytest.approx(physics.peak_slip(PAPER), abs=1e-6)
    assert model.peak_ratio(weak) == 0.7
    assert model.friction_coefficient(model.peak_slip(PAPER), 0.9, PAPER) == pytest.approx(0.9)
