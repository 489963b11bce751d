# SPDX-License-Identifier: Apache-2.0
"""The table of thresholds: what the checks take comes from it, for the node and for a replay alike."""

from __future__ import annotations

import dataclasses
import math

import pytest

from iwm_power_manager.control import settings, thresholds
from iwm_power_manager.control.inputs import Violation, check_value
from iwm_power_manager.control.settings import Change
from iwm_power_manager.control.thresholds import RECORDED, Thresholds, actuator_limits, input_limits, supervision_limits
from iwm_power_manager.model.pedals import PEDAL_TRAVEL, demand_power_w
from iwm_power_manager.share import resolve
from iwm_power_manager.vehicle import load_vehicle

DIFFERENT = Thresholds(*(float(k + 1) for k in range(len(thresholds.TABLE))))


def numbers_in(value):
    """Every number of nested tuples."""
    return [x for item in value for x in numbers_in(item)] if isinstance(value, tuple) else [value]


def test_every_default_is_inside_its_range_and_has_a_meaning():
    for table, defaults in ((thresholds.TABLE, Thresholds()), (settings.TABLE, settings.DEFAULTS)):
        for name, known in table.items():
            value = (
                settings.shown(name, getattr(defaults, name)) if table is settings.TABLE else getattr(defaults, name)
            )
            assert settings.problem_with(known, value) == ""
            assert known.meaning


@pytest.mark.parametrize("name", thresholds.TABLE)
def test_no_threshold_is_without_effect(name):
    changed = dataclasses.replace(DIFFERENT, **{name: 1000.0})
    stepping = ("shortest_step_periods", "longest_step_periods", "own_gap_s", "command_oldest_s")
    same = (
        numbers_in(input_limits(changed, 0.3, True)) == numbers_in(input_limits(DIFFERENT, 0.3, True)),
        supervision_limits(changed) == supervision_limits(DIFFERENT),
        actuator_limits(changed) == actuator_limits(DIFFERENT),
    )
    assert same.count(False) == (0 if name in stepping else 1)


def test_each_threshold_is_where_it_belongs():
    t = DIFFERENT
    limits = input_limits(t, 0.3, by_clock=True)
    assert limits.stamp == (t.stamp_oldest_s, t.stamp_future_s)
    assert limits.demand_delay_s == t.stamp_oldest_s
    assert limits.speed == (t.speed_min_mps, t.speed_max_mps, t.speed_rate_mps2, t.speed_rate_mps2, t.speed_noise_mps)
    assert limits.demand == (t.demand_min_w, t.demand_max_w, t.demand_rise_wps, math.inf, t.demand_noise_w)
    assert limits.soc == (0.0, 1.0, t.soc_rate_per_s, t.soc_rate_per_s, t.soc_noise)
    assert limits.temperature[:2] == (t.temperature_min_c, t.temperature_max_c)
    assert limits.temperature[2:] == (t.temperature_rate_cps, t.temperature_rate_cps, t.temperature_noise_c)
    assert limits.friction == (t.friction_min, t.friction_max, math.inf, math.inf, 0.0)
    assert (limits.rival_s, limits.radius_m) == (t.rival_s, 0.3)
    wheels = limits.wheels
    assert wheels.value[:2] == (-t.wheel_speed_max_radps, t.wheel_speed_max_radps)
    assert wheels.value[2:] == (t.wheel_rate_radps2, t.wheel_rate_radps2, t.wheel_noise_radps)
    assert (wheels.opposite_radps, wheels.moving_mps) == (t.wheel_opposite_radps, t.wheel_moving_mps)
    assert (wheels.stuck_s, wheels.stuck_change_radps) == (t.wheel_stuck_s, t.wheel_stuck_change_radps)
    assert (wheels.stray_s, wheels.stray_radps, wheels.distrust_s) == (
        t.wheel_stray_s, t.wheel_stray_radps, t.wheel_distrust_s,
    )  # fmt: skip
    times = supervision_limits(t)
    assert (times.fade_s, times.brake_release_s) == (t.fade_s, t.brake_release_s)
    assert (times.recover_s, times.resume_s) == (t.recover_s, t.resume_s)


def test_without_a_clock_no_stamp_and_no_delay_is_judged():
    limits = input_limits(Thresholds(), 0.3, by_clock=False)
    assert limits.stamp is None
    assert limits.demand_delay_s == math.inf


def test_a_recording_is_judged_more_mildly_but_by_the_same_supervision():
    assert supervision_limits(RECORDED) == supervision_limits(Thresholds())
    node, replay = input_limits(Thresholds(), 0.3, False), input_limits(RECORDED, 0.3, False)
    assert replay.speed.maximum > node.speed.maximum
    assert replay.wheels.stuck_s == math.inf
    assert replay.friction == node.friction


@pytest.mark.parametrize("value", [math.nan, math.inf, -1.0, 1e9, True, "much"])
def test_a_value_outside_its_range_is_refused_with_the_range(value):
    known = settings.TABLE["critical_slip"]
    assert settings.problem_with(known, value) == f"{value!r} is not allowed; allowed: 0.02 to 0.9"
    assert settings.problem_with(known, 0.02) == settings.problem_with(known, 0.9) == ""


def test_a_flag_is_true_or_false_and_a_choice_one_of_its_names():
    assert settings.problem_with(settings.TABLE["gate_driving"], False) == ""
    assert settings.problem_with(settings.TABLE["gate_driving"], 1) == "1 is not allowed; allowed: true | false"
    assert settings.problem_with(settings.TABLE["strategy"], "preview").startswith("'preview' is not allowed")


def test_text_becomes_a_value_and_comes_back():
    for name, text in (("strategy", "sdp"), ("gate_mode", "off"), ("gate_driving", "false"), ("slip_target", "0.1")):
        value = settings.parse("--set", name, text)
        assert settings.from_shown({name: settings.shown(name, value)}) == {name: value}
        assert type(value) is type(getattr(settings.DEFAULTS, name))


def test_when_each_may_change_is_known():
    assert {known.change for known in settings.TABLE.values()} == {Change.ALWAYS}
    assert {known.change for known in thresholds.TABLE.values()} == {Change.UNCONFIGURED}


@pytest.mark.parametrize("name", ["jalalmaab_2015", "compact_two_motors"])
@pytest.mark.parametrize("mass", [1.0, 4.0], ids=["", "heavy"])
def test_what_a_car_s_own_pedals_ask_for_is_believed_at_any_speed_that_is(name, mass):
    params = load_vehicle(resolve(name)).params
    params = params._replace(chassis=params.chassis._replace(mass_kg=mass * params.chassis.mass_kg))
    found = input_limits(thresholds.for_car(Thresholds(), params), 0.3, by_clock=True)
    for speed in (0.0, 20.0, found.speed.maximum):
        assert demand_power_w(PEDAL_TRAVEL, 1.0, 0.0, speed, params) <= found.demand.maximum
        assert demand_power_w(PEDAL_TRAVEL, 0.0, 1.0, speed, params) >= found.demand.minimum


def test_a_threshold_that_is_wider_than_the_car_s_pedals_and_speeds_stays_as_it_is():
    wide = Thresholds(
        demand_max_w=5e6, demand_min_w=-2e7, speed_max_mps=150.0, wheel_speed_max_radps=2000.0, wheel_rate_radps2=1e5
    )
    assert thresholds.for_car(wide, load_vehicle(resolve("compact_two_motors")).params) == wide


@pytest.mark.parametrize("small", ["", "front", "rear"])
def test_what_a_fast_car_and_its_wheels_do_is_believed(small):
    """350 km/h; on the level its motors reach them, and its brakes stop a wheel without grip within 50 ms."""
    car = load_vehicle(resolve("compact_two_motors")).params
    if small:
        axle = getattr(car, small)
        wheel = axle.wheel._replace(radius_m=0.5 * axle.wheel.radius_m, inertia_kgm2=0.2 * axle.wheel.inertia_kgm2)
        car = car._replace(**{small: axle._replace(wheel=wheel)})
    chassis = car.chassis._replace(drag_coefficient=0.9 * car.chassis.drag_coefficient)
    found = input_limits(thresholds.for_car(Thresholds(), car._replace(chassis=chassis)), 0.33, by_clock=True)
    fast = 350.0 / 3.6
    assert check_value(fast, fast - 0.1, 0.01, found.speed) is Violation.NONE
    for axle in (car.front, car.rear):
        rolling = fast / axle.wheel.radius_m
        torque = axle.friction_brake.max_torque_nm + axle.motor.peak_torque_nm
        locking = rolling - torque / axle.wheel.inertia_kgm2 * 0.01
        assert check_value(1.3 * rolling, 1.3 * rolling, 0.01, found.wheels.value) is Violation.NONE
        assert check_value(locking, rolling, 0.01, found.wheels.value) is Violation.NONE


def test_the_paper_s_car_is_judged_as_the_table_says():
    assert thresholds.for_car(Thresholds(), load_vehicle(resolve("jalalmaab_2015")).params) == Thresholds()
