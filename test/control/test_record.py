# SPDX-License-Identifier: Apache-2.0
"""A recorded step: every number stands under its own name, and comes back as what it was."""

from __future__ import annotations

import itertools
import math
from typing import Any

import pytest

from iwm_power_manager.control import record
from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.control.strategies import STRATEGIES
from iwm_power_manager.control.supervision import Supervision
from iwm_power_manager.control.types import WHEEL_NAMES, Command, Measurement, initial_state

#: No two numbers are the same, so that none can stand in the place of another.
NUMBERS = itertools.count(3)


def unlike() -> float:
    return float(next(NUMBERS))


def four() -> tuple[float, float, float, float]:
    return unlike(), unlike(), unlike(), unlike()


MEASUREMENT = Measurement(
    speed_mps=unlike(),
    wheel_speed_radps=four(),
    power_demand_w=unlike(),
    dt_s=unlike(),
    friction=unlike(),
    discharge_limit_w=unlike(),
    charge_limit_w=unlike(),
    soc=unlike(),
    motor_gain=four(),
    direction=unlike(),
    motor_stuck_nm=four(),
    acceleration_mps2=unlike(),
    yaw_rate_radps=unlike(),
    lateral_mps2=unlike(),
    torque_shift_nm=four(),
)
COMMAND = Command(
    motor_torque_nm=four(),
    friction_torque_nm=four(),
    brake_gain=four(),
    front_share=unlike(),
    decided_share=unlike(),
    gate=next(NUMBERS),
    limits=next(NUMBERS),
    front_power_w=unlike(),
    rear_power_w=unlike(),
    front_slip=unlike(),
    rear_slip=unlike(),
    gated_wheels=next(NUMBERS),
    speed_mps=unlike(),
    doubted=next(NUMBERS),
    hold_nm=unlike(),
    left_friction=unlike(),
    right_friction=unlike(),
    left_confidence=unlike(),
    right_confidence=unlike(),
)
BEFORE = initial_state()._replace(steps=next(NUMBERS))
SUPERVISION = Supervision(
    mode=next(NUMBERS), stale=next(NUMBERS), motor_factor=unlike(), brake_factor=unlike(), healthy_s=unlike()
)
WATCH = record.Watch(wheels_lost=next(NUMBERS), requested_power_w=unlike(), age_s=four())
SETTINGS = default_settings()


def heated(heat: tuple[float, float, float, float]) -> Any:
    state = initial_state()
    fl, fr, rl, rr = (wheel._replace(heat=index) for wheel, index in zip(state.wheels, heat, strict=True))
    return state._replace(wheels=(fl, fr, rl, rr))


def numbers(heat: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)) -> list[float]:
    decided = record.decided(COMMAND, BEFORE, heated(heat))
    return record.to_numbers(MEASUREMENT, SETTINGS, decided, SUPERVISION, WATCH)


def with_number(name: str, value: float) -> list[float]:
    """A record with another number under one name."""
    values = numbers()
    values[record.SIGNAL_NAMES.index(name)] = value
    return values


def of_wheels(text: str, values: tuple[float, ...]) -> dict[str, float]:
    return {text.format(wheel): value for wheel, value in zip(WHEEL_NAMES, values, strict=True)}


def test_every_number_stands_under_its_own_name():
    expected: dict[str, Any] = {
        **{name: getattr(MEASUREMENT, name) for name in ("speed_mps", "power_demand_w", "dt_s", "friction")},
        **{name: getattr(MEASUREMENT, name) for name in ("discharge_limit_w", "charge_limit_w", "soc", "direction")},
        **of_wheels("{}_speed_radps", MEASUREMENT.wheel_speed_radps),
        **of_wheels("{}_motor_gain", MEASUREMENT.motor_gain),
        **of_wheels("{}_motor_stuck_nm", MEASUREMENT.motor_stuck_nm),
        "acceleration_mps2": MEASUREMENT.acceleration_mps2,
        "accelerometer": 1.0,
        "yaw_rate_radps": MEASUREMENT.yaw_rate_radps,
        "gyroscope": 1.0,
        "lateral_mps2": MEASUREMENT.lateral_mps2,
        "lateral_accelerometer": 1.0,
        **{f"{wheel}_torque_shift_nm": nm for wheel, nm in zip(WHEEL_NAMES, MEASUREMENT.torque_shift_nm, strict=True)},
        **of_wheels("{}_motor_torque_nm", COMMAND.motor_torque_nm),
        **of_wheels("{}_friction_torque_nm", COMMAND.friction_torque_nm),
        **of_wheels("{}_brake_gain", COMMAND.brake_gain),
        **{name: getattr(COMMAND, name) for name in ("front_share", "decided_share", "gate", "limits", "doubted")},
        **{name: getattr(COMMAND, name) for name in ("front_power_w", "rear_power_w", "front_slip", "rear_slip")},
        **{name: getattr(COMMAND, name) for name in ("gated_wheels", "hold_nm", "left_friction", "right_friction")},
        "estimated_speed_mps": COMMAND.speed_mps,
        "left_friction_confidence": COMMAND.left_confidence,
        "right_friction_confidence": COMMAND.right_confidence,
        "step": BEFORE.steps,
        "front_heat": 0.0,
        "rear_heat": 0.0,
        **{name: getattr(SUPERVISION, name) for name in ("mode", "stale", "motor_factor", "brake_factor")},
        "wheels_lost": WATCH.wheels_lost,
        "requested_power_w": WATCH.requested_power_w,
        "vehicle_speed_age_s": WATCH.age_s[0],
        "wheel_states_age_s": WATCH.age_s[1],
        "power_demand_age_s": WATCH.age_s[2],
        "battery_state_age_s": WATCH.age_s[3],
        **{f"setting.{name}": value for name, value in SETTINGS._asdict().items()},
    }
    assert dict(zip(record.SIGNAL_NAMES, numbers(), strict=True)) == expected


@pytest.mark.parametrize("wheel", range(4))
def test_an_axle_s_heat_is_that_of_its_hotter_motor(wheel):
    heat = [0.0, 0.1, 0.2, 0.3]
    heat[wheel] = 0.9
    named = dict(zip(record.SIGNAL_NAMES, numbers(tuple(heat)), strict=True))
    assert (named["front_heat"], named["rear_heat"]) == (max(heat[:2]), max(heat[2:]))


def test_measurement_command_and_settings_come_back():
    values = numbers()
    step = record.from_numbers(values)
    assert (step.measurement, step.settings, step.first) == (MEASUREMENT, SETTINGS, False)
    assert tuple(record.SIGNAL_NAMES[record.DECIDED]) == record.DECIDED_NAMES
    assert record.command_of(values[record.DECIDED]) == COMMAND
    assert [type(value) for value in record.command_of(values[record.DECIDED])] == [type(value) for value in COMMAND]


@pytest.mark.parametrize("steps", [0, 1, 2])
def test_only_step_zero_is_a_run_s_first(steps):
    values = record.to_numbers(
        MEASUREMENT,
        SETTINGS,
        record.decided(COMMAND, initial_state()._replace(steps=steps), BEFORE),
        SUPERVISION,
        WATCH,
    )
    assert (record.from_numbers(values).first, record.step_of(values)) == (steps == 0, steps)


IMU = pytest.mark.parametrize(
    ("number", "sensor"),
    [
        ("acceleration_mps2", "accelerometer"),
        ("yaw_rate_radps", "gyroscope"),
        ("lateral_mps2", "lateral_accelerometer"),
    ],
)


@IMU
def test_a_car_without_an_accelerometer_or_gyroscope_has_none_after_the_record_either(number, sensor):
    silent = MEASUREMENT._replace(**{number: math.nan})
    decided = record.decided(COMMAND, BEFORE, BEFORE)
    named = dict(
        zip(record.SIGNAL_NAMES, record.to_numbers(silent, SETTINGS, decided, SUPERVISION, WATCH), strict=True)
    )
    assert (named[number], named[sensor]) == (0.0, 0.0)
    assert math.isnan(getattr(record.measurement_of(list(named.values())), number))


@IMU
def test_an_accelerometer_or_gyroscope_that_shows_nothing_is_one(number, sensor):
    assert getattr(record.measurement_of(with_number(number, 0.0)), number) == 0.0


@pytest.mark.parametrize("largest", [0.0, 1.0, 2.0**53 - 1])
def test_what_counts_may_be_any_number_that_a_double_counts(largest):
    assert record.step_of(with_number("step", largest)) == largest


@pytest.mark.parametrize("value", [-1.0, -0.5, math.nan, math.inf, 2.0**53])
def test_what_counts_nothing_is_refused(value):
    with pytest.raises(ValueError, match="counts nothing"):
        record.step_of(with_number("step", value))


def test_a_strategy_that_does_not_exist_is_refused():
    codes = [strategy.code for strategy in STRATEGIES.values()]
    for code in codes:
        assert record.from_numbers(with_number("setting.strategy", float(code))).settings.strategy == code
    with pytest.raises(ValueError, match="does not exist"):
        record.from_numbers(with_number("setting.strategy", max(codes) + 1.0))


def test_a_setting_that_is_no_count_may_be_negative():
    assert record.from_numbers(with_number("setting.slip_target", -0.5)).settings.slip_target == -0.5


def test_names_and_values_have_to_be_as_many():
    with pytest.raises(ValueError, match="zip"):
        record.completed(record.SIGNAL_NAMES[:-1], numbers())


def test_an_older_record_has_neutral_values_for_what_it_does_not_know():
    older = [name for name in record.SIGNAL_NAMES if name not in record.YOUNGER_SIGNALS]
    named = dict(zip(record.SIGNAL_NAMES, record.completed(older, [9.0] * len(older)), strict=True))
    ones = {"direction", *(f"{wheel}_{what}_gain" for wheel in WHEEL_NAMES for what in ("brake", "motor"))}
    assert {name: named[name] for name in ones} == dict.fromkeys(ones, 1.0)
    others = record.YOUNGER_SIGNALS.keys() - ones
    assert {
        "gated_wheels",
        "doubted",
        "hold_nm",
        "accelerometer",
        "left_friction",
        f"{WHEEL_NAMES[0]}_motor_stuck_nm",
    } <= others
    assert {name: named[name] for name in others} == dict.fromkeys(others, 0.0)
    assert {named[name] for name in older} == {9.0}
