# SPDX-License-Identifier: Apache-2.0
"""The degraded state: what fades, how fast, and how torque comes back."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iwm_power_manager.control.supervision import (
    LOCKSTEP_SUPERVISION,
    MODE_DEGRADED,
    MODE_NAMES,
    MODE_NORMAL,
    MODE_RECOVERING,
    MODE_WAITING,
    STALE_BATTERY,
    STALE_DEMAND,
    STALE_NAMES,
    STALE_SPEED,
    STALE_WHEELS,
    Supervision,
    SupervisionLimits,
    binding_limits,
    shape_demand,
    stale_inputs,
    supervise,
)
from iwm_power_manager.control.types import LIMIT_BATTERY_CHARGE, LIMIT_BATTERY_DISCHARGE, LIMIT_NAMES, LIMIT_SLIP

# Powers of two, so that sums of steps are exact.
LIMITS = SupervisionLimits(fade_s=0.5, brake_release_s=2.0, recover_s=0.25, resume_s=1.0)
DT = 0.0625
NORMAL = Supervision(MODE_NORMAL, 0, 1.0, 1.0, 10.0)


def run(state: Supervision, stale: int, steps: int) -> Supervision:
    for _ in range(steps):
        state = supervise(state, stale, DT, LIMITS)
    return state


class TestStaleInputs:
    def test_each_input_has_its_bit(self) -> None:
        limits = (0.03, 0.03, 0.03, 0.3)
        good = (0.0, 0.0, 0.0, 0.0)
        assert stale_inputs(good, limits) == 0
        for i, bit in enumerate((STALE_SPEED, STALE_WHEELS, STALE_DEMAND, STALE_BATTERY)):
            old = tuple(1.0 if j == i else 0.0 for j in range(4))
            assert stale_inputs(old, limits) == bit
        assert stale_inputs((1.0,) * 4, limits) == 15

    def test_an_input_is_missing_beyond_its_limit_not_at_it(self) -> None:
        limits = (0.03, 0.03, 0.03, 0.3)
        assert stale_inputs((0.03, 0.03, 0.03, 0.3), limits) == 0
        assert stale_inputs((0.0300001, 0.0, 0.0, 0.0), limits) == STALE_SPEED

    @pytest.mark.parametrize("age", [math.inf, math.nan])
    def test_an_input_that_never_came_or_has_no_age_is_missing(self, age: float) -> None:
        assert stale_inputs((0.0, age, 0.0, 0.0), (1.0,) * 4) == STALE_WHEELS

    def test_every_bit_and_mode_has_a_name(self) -> None:
        assert STALE_NAMES == {1: "vehicle_speed", 2: "wheel_states", 4: "power_demand", 8: "battery_state"}
        assert MODE_NAMES == ("waiting", "normal", "degraded", "recovering")
        assert [MODE_WAITING, MODE_NORMAL, MODE_DEGRADED, MODE_RECOVERING] == [0, 1, 2, 3]


class TestSupervise:
    def test_a_new_node_waits_and_allows_no_torque(self) -> None:
        state = Supervision()
        assert (state.mode, state.motor_factor, state.brake_factor, state.healthy_s) == (MODE_WAITING, 0.0, 1.0, 0.0)
        assert run(state, STALE_SPEED, 100) == Supervision(MODE_WAITING, STALE_SPEED, 0.0, 1.0, 0.0)

    def test_a_healthy_run_keeps_every_factor_at_exactly_one(self) -> None:
        state = run(NORMAL, 0, 1000)
        assert state[:4] == (MODE_NORMAL, 0, 1.0, 1.0)
        assert LOCKSTEP_SUPERVISION[:4] == (MODE_NORMAL, 0, 1.0, 1.0)

    @pytest.mark.parametrize("stale", [STALE_SPEED, STALE_WHEELS, STALE_DEMAND, STALE_BATTERY, 15])
    def test_any_missing_input_fades_motor_torque_in_the_stated_time(self, stale: int) -> None:
        assert run(NORMAL, stale, 1).mode == MODE_DEGRADED
        assert run(NORMAL, stale, 1).stale == stale
        assert run(NORMAL, stale, 1).motor_factor == 0.875
        assert run(NORMAL, stale, 7).motor_factor == 0.125
        assert run(NORMAL, stale, 8).motor_factor == 0.0
        assert run(NORMAL, stale, 9).motor_factor == 0.0

    def test_a_held_brake_is_released_in_its_own_time_and_only_without_a_demand(self) -> None:
        assert run(NORMAL, STALE_DEMAND, 16).brake_factor == 0.5
        assert run(NORMAL, STALE_DEMAND, 32).brake_factor == 0.0
        assert run(NORMAL, STALE_DEMAND, 40).brake_factor == 0.0
        assert run(NORMAL, STALE_SPEED | STALE_WHEELS | STALE_BATTERY, 40).brake_factor == 1.0

    def test_a_fresh_brake_demand_counts_in_full_at_once(self) -> None:
        released = run(NORMAL, STALE_DEMAND, 40)
        assert run(released, STALE_SPEED, 1).brake_factor == 1.0
        assert run(released, 0, 1).brake_factor == 1.0

    def test_torque_comes_back_after_the_stated_time_in_the_stated_time(self) -> None:
        degraded = run(NORMAL, STALE_DEMAND, 20)
        assert degraded.healthy_s == 0.0
        waiting = run(degraded, 0, 3)
        assert waiting[:4] == (MODE_DEGRADED, 0, 0.0, 1.0)
        first = run(degraded, 0, 4)  # healthy for 0.25 s
        assert (first.mode, first.motor_factor) == (MODE_RECOVERING, 0.0625)
        last = run(degraded, 0, 18)
        assert (last.mode, last.motor_factor) == (MODE_RECOVERING, 0.9375)
        assert run(degraded, 0, 19)[:4] == (MODE_NORMAL, 0, 1.0, 1.0)
        slower = LIMITS._replace(resume_s=4.0)
        assert supervise(waiting, 0, DT, slower).motor_factor == 0.015625

    def test_a_relapse_starts_the_healthy_time_anew(self) -> None:
        degraded = run(NORMAL, STALE_SPEED, 20)
        relapsed = run(run(degraded, 0, 3), STALE_SPEED, 1)
        assert relapsed.healthy_s == 0.0
        assert run(relapsed, 0, 3).motor_factor == 0.0

    def test_a_short_gap_resumes_from_where_the_fade_had_come(self) -> None:
        faded = run(NORMAL, STALE_SPEED, 4)
        assert faded.motor_factor == 0.5
        assert run(faded, 0, 3).motor_factor == 0.5
        assert run(faded, 0, 4).motor_factor == 0.5625

    def test_waiting_ends_like_degraded_does(self) -> None:
        assert run(Supervision(), 0, 3)[:3] == (MODE_WAITING, 0, 0.0)
        assert run(Supervision(), 0, 4).mode == MODE_RECOVERING
        assert run(Supervision(), 0, 19).mode == MODE_NORMAL

    def test_recovering_falls_back_to_degraded(self) -> None:
        recovering = run(run(NORMAL, STALE_SPEED, 20), 0, 6)
        assert recovering.mode == MODE_RECOVERING
        assert run(recovering, STALE_WHEELS, 1).mode == MODE_DEGRADED

    def test_the_healthy_time_adds_up(self) -> None:
        assert run(NORMAL, 0, 4).healthy_s == 10.25

    @given(st.lists(st.tuples(st.integers(0, 15), st.floats(1e-4, 0.1)), max_size=200))
    def test_factors_stay_between_zero_and_one_and_rise_no_faster_than_stated(self, steps) -> None:
        state = Supervision()
        for stale, dt in steps:
            after = supervise(state, stale, dt, LIMITS)
            assert 0.0 <= after.motor_factor <= 1.0
            assert 0.0 <= after.brake_factor <= 1.0
            assert after.motor_factor - state.motor_factor <= dt / LIMITS.resume_s + 1e-12
            if stale:
                assert after.motor_factor <= max(state.motor_factor - dt / LIMITS.fade_s, 0.0)
                assert after.mode in (MODE_DEGRADED, MODE_WAITING)
            assert (after.mode == MODE_NORMAL) <= (after.motor_factor == 1.0)
            state = after


class TestShapeDemand:
    def test_nothing_changes_in_a_healthy_run(self) -> None:
        for demand in (12345.678, -9876.54321, 0.0):
            assert shape_demand(demand, 20.0, 3.0, NORMAL) == demand

    def test_a_drive_demand_fades_with_the_motors(self) -> None:
        state = NORMAL._replace(stale=STALE_SPEED, motor_factor=0.25)
        assert shape_demand(8000.0, 20.0, 20.0, state) == 2000.0
        assert shape_demand(8000.0, 20.0, 5.0, state._replace(stale=STALE_DEMAND)) == 2000.0
        assert shape_demand(0.5, 20.0, 20.0, state) == 0.125

    def test_a_live_brake_demand_gets_through_in_full_whatever_else_is_missing(self) -> None:
        state = Supervision(MODE_DEGRADED, STALE_SPEED | STALE_WHEELS | STALE_BATTERY, 0.0, 1.0, 0.0)
        assert shape_demand(-8000.0, 20.0, 5.0, state) == -8000.0
        assert shape_demand(-0.5, 20.0, 5.0, state) == -0.5

    def test_a_stale_brake_demand_holds_its_force_and_lets_go_of_it(self) -> None:
        state = Supervision(MODE_DEGRADED, STALE_DEMAND, 0.0, 0.5, 0.0)
        # Half the force: half the power at the speed of then, a quarter at half that speed.
        assert shape_demand(-8000.0, 20.0, 20.0, state) == -4000.0
        assert shape_demand(-8000.0, 20.0, 10.0, state) == -2000.0
        assert shape_demand(-8000.0, 16.0, 0.001, state) == -0.25
        assert shape_demand(-8000.0, 20.0, 0.0, state) == 0.0

    def test_a_stale_brake_demand_never_grows(self) -> None:
        state = Supervision(MODE_DEGRADED, STALE_DEMAND, 0.0, 1.0, 0.0)
        assert shape_demand(-8000.0, 20.0, 30.0, state) == -8000.0
        assert shape_demand(-8000.0, 0.0, 0.0, state) == -8000.0
        assert shape_demand(-8000.0, 0.0, 10.0, state) == -8000.0

    @given(
        st.floats(-6e5, 1.5e5),
        st.floats(0.0, 60.0),
        st.floats(0.0, 60.0),
        st.integers(0, 15),
        st.floats(0.0, 1.0),
        st.floats(0.0, 1.0),
    )
    def test_the_shaped_demand_lies_between_zero_and_the_demand(self, demand, then, now, stale, motor, brake) -> None:
        shaped = shape_demand(demand, then, now, Supervision(MODE_DEGRADED, stale, motor, brake, 0.0))
        assert min(demand, 0.0) <= shaped <= max(demand, 0.0)


@pytest.mark.parametrize("battery", [LIMIT_BATTERY_CHARGE, LIMIT_BATTERY_DISCHARGE])
def test_motors_that_are_faded_out_are_not_put_down_to_the_battery(battery: int) -> None:
    assert binding_limits(0, 0.0) == binding_limits(0, 1.0) == []
    assert binding_limits(battery | LIMIT_SLIP, 0.5) == [
        name for bit, name in LIMIT_NAMES.items() if bit in (battery, LIMIT_SLIP)
    ]
    assert binding_limits(battery | LIMIT_SLIP, 0.0) == [LIMIT_NAMES[LIMIT_SLIP], "motors faded out"]
    assert binding_limits(LIMIT_SLIP, 0.0) == [LIMIT_NAMES[LIMIT_SLIP]]
