# SPDX-License-Identifier: Apache-2.0
"""The driver against plain Python, and whether it drives well."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iwm_power_manager.model.chassis import equivalent_mass_kg, road_load_n
from iwm_power_manager.model.driver import DriverState, drive
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle
from oracles.driver import look

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml"), "none").params
SPEED = st.one_of(st.sampled_from([0.0, 0.1, 0.2, 0.3]), st.floats(0.0, 40.0))


@given(
    st.floats(-20.0, 20.0),
    SPEED,
    SPEED,
    SPEED,
    st.floats(-8.0, 5.0),
    st.sampled_from([0.0, 0.1, -0.1]),
    st.sampled_from([0.01, 0.1]),
)
def test_the_pedals_are_those_of_the_plain_driver(integral, speed, trace, ahead, slope, grade, dt):
    pedals, after = drive(DriverState(integral), speed, trace, ahead, slope, grade, dt, CAR)
    accelerator, brake, demand, integral_after = look(integral, speed, trace, ahead, slope, grade, dt, CAR)
    assert pedals == pytest.approx((accelerator, brake, demand), rel=1e-9, abs=1e-9)
    assert after.error_integral_m == pytest.approx(integral_after)
    assert 0.0 <= pedals.accelerator <= 1.0
    assert 0.0 <= pedals.brake <= 1.0
    assert pedals.accelerator == 0.0 or pedals.brake == 0.0


def test_at_rest_on_a_standing_trace_the_foot_rests_on_the_brake():
    pedals, after = drive(DriverState(5.0), 0.0, 0.0, 0.0, 0.0, 0.0, 0.01, CAR)
    assert (pedals.accelerator, pedals.brake, after.error_integral_m) == (0.0, 0.1, 0.0)
    assert pedals.power_demand_w < 0.0


def follow(trace, seconds, start=0.0, dt=0.01, force_scale=1.0, state=None):
    """A point mass that gets exactly the demanded power; the speed it has each step, and the driver's memory."""
    speed, state, seen = start, state or DriverState(0.0), []
    for k in range(round(seconds / dt)):
        now = k * dt
        slope = (trace(now + 0.251) - trace(now + 0.249)) / 0.002
        pedals, state = drive(state, speed, trace(now), trace(now + 0.25), slope, 0.0, dt, CAR)
        force = force_scale * pedals.power_demand_w / max(speed, 1.0) - road_load_n(speed, 0.0, CAR.chassis)
        speed = max(speed + force / equivalent_mass_kg(CAR) * dt, 0.0)
        seen.append(speed)
    return seen, state


def test_a_ramp_is_followed_closely():
    speeds, _ = follow(lambda t: min(1.0 * t, 10.0), 20.0)
    assert max(abs(v - min(0.01 * (k + 1), 10.0)) for k, v in enumerate(speeds)) < 0.35
    assert speeds[-1] == pytest.approx(10.0, abs=0.01)


def test_the_integral_removes_what_the_driver_does_not_know():
    speeds, _ = follow(lambda t: 10.0, 60.0, start=10.0, force_scale=0.8)
    assert speeds[-1] == pytest.approx(10.0, abs=0.02)


def test_a_trace_too_fast_for_the_car_winds_nothing_up():
    speeds, state = follow(lambda t: 60.0, 30.0)
    assert state.error_integral_m < 2.0
    back, _ = follow(lambda t: speeds[-1], 5.0, start=speeds[-1], state=state)
    assert max(back) < speeds[-1] + 0.5
