# SPDX-License-Identifier: Apache-2.0
"""Motors held against their commands: what is found, how soon, and what is never called a fault."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iwm_power_manager.control import law
from iwm_power_manager.control.actuators import (
    ActuatorLimits,
    ActuatorState,
    Evidence,
    MotorVerdict,
    commanded,
    judge,
)
from iwm_power_manager.control.guard import violated_bound
from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.control.table import empty_table
from iwm_power_manager.control.types import Measurement, initial_state
from iwm_power_manager.share import resolve
from iwm_power_manager.vehicle import load_vehicle

LIMITS = ActuatorLimits(tolerance_nm=6.0, tolerance_ratio=0.1, lag_s=0.05, confirm_s=0.1, recover_s=2.0, delay_s=0.0)
DT = 0.01


def drive(state, commands, reports):
    """Command and report step by step; the state after each step."""
    states = []
    for torque, report in zip(commands, reports, strict=True):
        state = commanded(state, tuple(torque), DT, LIMITS)
        state = judge(state, tuple(report), DT, LIMITS)
        states.append(state)
    return states


def steady(torque, steps=60):
    return [(torque,) * 4] * steps


def following(torque=60.0):
    """A car whose motors have been seen to follow."""
    return drive(ActuatorState(), steady(torque), steady(torque))[-1]


def first_found(states, wheel):
    return next((i for i, state in enumerate(states) if state.motors[wheel].verdict is not MotorVerdict.GOOD), None)


@pytest.mark.parametrize("wheel", range(4))
@pytest.mark.parametrize("torque", [-70.0, -25.0, 25.0, 60.0, 180.0])
@pytest.mark.parametrize(
    ("factor", "verdict"), [(0.0, MotorVerdict.DEAD), (0.5, MotorVerdict.WEAK), (-1.0, MotorVerdict.REVERSED)]
)
def test_a_motor_that_fails_is_found_within_a_fifth_of_a_second_and_named(wheel, torque, factor, verdict):
    report = [torque] * 4
    report[wheel] = factor * torque
    states = drive(following(torque), steady(torque), [report] * 60)
    found = first_found(states, wheel)
    assert (found + 1) * DT <= 0.2
    assert states[-1].motors[wheel].verdict is verdict
    assert states[-1].gains[wheel] == pytest.approx(max(factor, 0.0))
    assert all(states[-1].gains[other] == 1.0 for other in range(4) if other != wheel)


@pytest.mark.parametrize("wheel", range(4))
def test_a_torque_that_nobody_asked_for_is_a_stuck_motor(wheel):
    report = [0.0] * 4
    report[wheel] = 60.0
    state = drive(following(), steady(0.0), [report] * 60)[-1]
    assert (state.motors[wheel].verdict, state.gains[wheel]) == (MotorVerdict.STUCK, 0.0)


def test_a_motor_that_keeps_its_torque_while_the_command_moves_is_stuck():
    commands = [(60.0 + 2.0 * i,) * 4 for i in range(50)]
    reports = [(60.0, *torque[1:]) for torque in commands]
    state = drive(following(), commands, reports)[-1]
    assert state.motors[0].verdict is MotorVerdict.STUCK


@given(
    st.lists(st.floats(-80.0, 200.0), min_size=20, max_size=60),
    st.integers(0, 5),
    st.lists(st.floats(-5.0, 5.0), min_size=60, max_size=60),
)
def test_no_motor_that_follows_late_and_with_noise_is_ever_suspected(torques, lag, noise):
    commands = [(torque,) * 4 for torque in torques]
    late = [torques[max(i - lag, 0)] + noise[i] for i in range(len(torques))]
    state = following()
    state = commanded(state, commands[0], LIMITS.lag_s + DT, LIMITS)
    for after in drive(state, commands, [(value,) * 4 for value in late]):
        assert all(motor.verdict is MotorVerdict.GOOD and motor.gain == 1.0 for motor in after.motors)


def test_zeros_from_a_car_that_does_not_report_are_no_fault():
    state = drive(ActuatorState(), steady(100.0, 500), steady(0.0, 500))[-1]
    assert not state.reporting
    assert state.gains == (1.0,) * 4


def test_a_motor_dead_from_the_start_is_found_as_soon_as_another_follows():
    states = drive(ActuatorState(), steady(60.0), [(0.0, 60.0, 60.0, 60.0)] * 60)
    assert states[-1].motors[0].verdict is MotorVerdict.DEAD


@pytest.mark.parametrize("wheel", range(4))
@pytest.mark.parametrize("torque", [-10.0, 0.0, 10.0, 14.0])
@pytest.mark.parametrize("stuck", [-80.0, 60.0, 150.0])
def test_a_motor_stuck_from_the_start_is_found_before_any_has_followed_a_clear_torque(wheel, torque, stuck):
    report = [torque + 2.0] * 4
    report[wheel] = stuck
    states = drive(ActuatorState(), steady(torque), [report] * 60)
    assert (first_found(states, wheel) + 1) * DT <= 0.2
    assert states[-1].gains == tuple(float(i != wheel) for i in range(4))
    assert not states[-1].reporting
    # Switched off, it still pulls; the others begin to follow, and are judged by that.
    told = [60.0] * 4
    told[wheel] = 0.0
    after = [60.0] * 4
    after[wheel] = stuck
    states = drive(states[-1], [tuple(told)] * 40, [after] * 40)
    assert all(state.gains == tuple(float(i != wheel) for i in range(4)) for state in states)
    assert states[-1].reporting
    assert states[-1].stuck_nm == tuple(stuck if i == wheel else 0.0 for i in range(4))


REPORTS = {
    "none": lambda torque: math.nan,
    "zeros": lambda torque: 0.0,
    "unsigned": abs,
    "turned round": lambda torque: -torque,
    "in hundredths": lambda torque: 100.0 * torque,
    "of a motor behind a gear": lambda torque: torque / 9.0,
    "of a wheel in front of one": lambda torque: 9.0 * torque,
}


@given(
    st.lists(
        st.tuples(*[st.sampled_from((-80.0, -14.0, -5.0, 0.0, 0.5, 5.0, 14.0, 100.0))] * 4), min_size=1, max_size=8
    ),
    st.lists(st.integers(1, 30), min_size=8, max_size=8),
    st.integers(0, 5),
    st.sampled_from(sorted(REPORTS)),
)
def test_reports_that_are_no_torques_of_motors_switch_none_off(torques, steps, lag, kind):
    commands = [torque for torque, times in zip(torques, steps, strict=False) for _ in range(times)]
    late = [(0.0,) * 4] * lag + commands
    reports = [tuple(map(REPORTS[kind], torque)) for torque in late[: len(commands)]]
    state = commanded(ActuatorState(), (0.0,) * 4, DT, LIMITS)
    for after in drive(state, commands, reports):
        if after.reporting:
            break  # a torque in between that happens to be right
        assert after.gains == (1.0,) * 4


def test_one_report_gone_wrong_before_any_motor_has_followed_is_forgotten():
    reports = [(80.0, 0.0, 0.0, 0.0)] * 8 + [(0.0,) * 4] + [(80.0, 0.0, 0.0, 0.0)] * 8
    assert drive(ActuatorState(), steady(0.0, 17), reports)[-1].gains == (1.0,) * 4


@pytest.mark.parametrize("torque", [0.0, 60.0])
def test_what_is_not_reported_is_not_judged(torque):
    state = drive(following(), steady(torque), [(math.nan,) * 4] * 60)[-1]
    assert state.gains == (1.0,) * 4


def test_nothing_is_judged_before_a_command_was_sent():
    assert judge(ActuatorState(), (50.0,) * 4, DT, LIMITS) == ActuatorState()


def test_a_weak_motor_that_follows_again_is_believed_after_a_while_and_a_dead_one_is_not():
    weak = drive(following(), steady(60.0), [(30.0, 60.0, 60.0, 60.0)] * 60)[-1]
    assert weak.motors[0].verdict is MotorVerdict.WEAK
    steps = round(LIMITS.recover_s / DT)
    states = drive(weak, steady(60.0, steps + 1), steady(60.0, steps + 1))
    assert states[steps // 2].motors[0].verdict is MotorVerdict.WEAK
    assert states[-1].motors[0].verdict is MotorVerdict.GOOD
    dead = drive(following(), steady(60.0), [(0.0, 60.0, 60.0, 60.0)] * 60)[-1]
    assert drive(dead, steady(60.0, 500), steady(60.0, 500))[-1].motors[0].verdict is MotorVerdict.DEAD


def test_one_report_gone_wrong_is_forgotten():
    reports = [(60.0,) * 4] * 5 + [(0.0, 60.0, 60.0, 60.0)] * 5 + [(60.0,) * 4] * 50
    state = drive(following(), steady(60.0), reports)[-1]
    assert state.motors[0] == state.motors[1]._replace(inside_s=state.motors[0].inside_s)
    assert state.gains == (1.0,) * 4


@given(st.lists(st.tuples(*[st.floats(-300.0, 300.0)] * 4), min_size=1, max_size=40))
def test_a_gain_is_a_part_whatever_is_reported(reports):
    for state in drive(following(), steady(60.0, len(reports)), reports):
        assert all(0.0 <= gain <= 1.0 for gain in state.gains)


# --- In the law ------------------------------------------------------------------------------------------------------

CAR = load_vehicle(resolve(Path("config/vehicles/jalalmaab_2015.yaml"))).params


def settled(demand_w, gain, steps=100):
    """The command of a car at 10 m/s that has followed the same demand for a second."""
    state = initial_state()
    for _ in range(steps):
        measurement = Measurement(
            speed_mps=10.0,
            wheel_speed_radps=(10.0 / 0.33,) * 4,
            power_demand_w=demand_w,
            dt_s=DT,
            friction=0.9,
            discharge_limit_w=47500.0,
            charge_limit_w=47500.0,
            soc=0.8,
            motor_gain=gain,
        )
        command, state = law.step(measurement, state, default_settings("equal"), CAR, empty_table())
    return command


@pytest.mark.parametrize("wheel", range(4))
@pytest.mark.parametrize("gain", [0.0, 0.4, 0.8])
@pytest.mark.parametrize("demand_w", [-8000.0, -5000.0, 3000.0, 6000.0])
def test_what_a_motor_has_lost_comes_from_the_others_and_the_brakes(wheel, gain, demand_w):
    gains = tuple(gain if i == wheel else 1.0 for i in range(4))
    command = settled(demand_w, gains)
    arrived = [g * m + f for g, m, f in zip(gains, command.motor_torque_nm, command.friction_torque_nm, strict=True)]
    assert sum(arrived) * 10.0 / 0.33 == pytest.approx(demand_w, rel=1e-6)
    if gain == 0.0:
        assert command.motor_torque_nm[wheel] == 0.0
    assert not violated_bound(command, CAR)
    if demand_w < 0.0:
        assert arrived == pytest.approx([demand_w * 0.33 / 40.0] * 4)


def test_a_motor_that_pulls_although_it_is_switched_off_is_stuck_with_that_torque_until_it_stops():
    # It looks reversed at first, since it is braked with and pulls.
    looks = drive(following(), steady(-60.0, 20), [(60.0, -60.0, -60.0, -60.0)] * 20)[-1]
    assert looks.motors[0].verdict is MotorVerdict.REVERSED
    states = drive(looks, steady(0.0, 30), [(55.0, 0.0, 0.0, 0.0)] * 30)
    assert states[2].stuck_nm == (0.0,) * 4, "its last command may still be under way"
    assert states[-1].motors[0].verdict is MotorVerdict.STUCK
    assert states[-1].stuck_nm == (55.0, 0.0, 0.0, 0.0)
    assert states[-1].gains == (0.0, 1.0, 1.0, 1.0)
    unknown = drive(states[-1], steady(0.0, 5), [(math.nan,) * 4] * 5)[-1]
    assert unknown.stuck_nm == (55.0, 0.0, 0.0, 0.0)
    assert drive(unknown, steady(0.0, 5), steady(0.0, 5))[-1].stuck_nm == (0.0,) * 4


@pytest.mark.parametrize("torque", [0.0, -60.0, 150.0])
def test_reports_of_all_motors_that_stand_still_switch_none_off_for_good(torque):
    states = drive(following(), steady(torque, 100), [(60.0, 61.0, 59.0, 60.0)] * 100)
    again = drive(states[-1], steady(60.0, 250), steady(60.0, 250))[-1]
    assert again.gains == (1.0,) * 4
    dead = drive(again, steady(60.0, 30), [(60.0, 0.0, 60.0, 60.0)] * 30)[-1]
    assert dead.motors[1].verdict is MotorVerdict.DEAD


@pytest.mark.parametrize("wheel", range(4))
def test_four_motors_that_seem_dead_are_judged_anew_once_one_follows_and_three_are_not(wheel):
    dead = drive(following(), steady(60.0), steady(0.0))[-1]
    assert dead.all_dead
    assert dead.gains == (0.0,) * 4
    follows = tuple(60.0 if i == wheel else 0.0 for i in range(4))
    states = drive(dead, steady(60.0), [follows] * 60)
    assert states[0].gains == (1.0,) * 4
    assert states[-1].gains == tuple(float(i == wheel) for i in range(4)), "those that do not follow are found again"
    assert not states[-1].all_dead
    assert drive(states[-1], steady(60.0), steady(60.0))[-1].gains == states[-1].gains


@pytest.mark.parametrize("wheel", range(4))
def test_friction_makes_up_for_a_stuck_motor_while_braking(wheel):
    car = load_vehicle(resolve(Path("config/vehicles/jalalmaab_2015.yaml"))).params
    stuck = tuple(60.0 if i == wheel else 0.0 for i in range(4))
    gain = tuple(0.0 if i == wheel else 1.0 for i in range(4))
    state = initial_state()
    for _ in range(20):
        m = Measurement(15.0, (15.0 / 0.33,) * 4, -20e3, DT, 0.9, 1e5, 1e5, 0.5, gain, 1.0, stuck)
        command, state = law.step(m, state, default_settings("equal"), car, empty_table())
    totals = [a + b + c for a, b, c in zip(command.motor_torque_nm, command.friction_torque_nm, stuck, strict=True)]
    assert totals == pytest.approx([-20e3 / 4.0 / 15.0 * 0.33] * 4)
    assert violated_bound(command, car) == ""


def test_gain_and_stuck_torque_belong_to_the_motor_that_has_them():
    motors = tuple(Evidence(MotorVerdict.STUCK, gain=0.1 * i, stuck_nm=10.0 + i) for i in range(4))
    state = ActuatorState(motors)
    assert state.gains == (0.0, 0.1, 0.2, 0.1 * 3)
    assert state.stuck_nm == (10.0, 11.0, 12.0, 13.0)
