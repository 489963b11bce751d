# SPDX-License-Identifier: Apache-2.0
"""The numbers that docs/safety.md and the other pages state are those of the tables, the paper's car and the code."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from iwm_power_manager.control.car_restart import AWAY_S, STANDS_S
from iwm_power_manager.control.direction import HOLD_GRADE, MOVING_MPS
from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.ros.ending import LIMIT_S
from iwm_power_manager.share import resolve, roots
from iwm_power_manager.vehicle import load_vehicle

DOCS = roots()[0] / "docs"
PARAMETERS = {
    parameter["name"]: parameter["default"]
    for node in json.loads((DOCS / "interface.json").read_text())["parameters"].values()
    for parameter in node
    if type(parameter["default"]) in (int, float)
}
#: `name` (number unit)
STATED = re.compile(r"`([a-z0-9_.]+)` \((-?[0-9.]+)( [A-Za-z/%]+[0-9]?)?\)")
S = default_settings("sdp_lookahead")
YAW_NM, MORE_NMPS, MOST_YAW_NM = S.front_yaw_nm, S.front_yaw_growth_nmps, S.front_yaw_most_nm
CAR = load_vehicle(resolve("jalalmaab_2015")).params
MOTOR, BATTERY = CAR.front.motor, CAR.battery
BRAKE_NM, KILOWATT = CAR.front.friction_brake.max_torque_nm, MOTOR.max_power_w / 1e3
FULL_SOC, EMPTY_SOC = BATTERY.charge_full_below_soc, BATTERY.discharge_full_above_soc


def stated(page: Path) -> list[tuple[str, float]]:
    found = STATED.findall(page.read_text())
    return [(name, float(number)) for name, number, _ in found if name in PARAMETERS]


def test_a_default_that_a_page_states_is_the_default() -> None:
    found = {page.name: stated(page) for page in sorted(DOCS.glob("*.md")) if page.name != "interface.md"}
    assert len(found["safety.md"]) >= 10
    wrong = [
        f"{page}: `{name}` ({number:g}), which is {PARAMETERS[name]:g}"
        for page, pairs in found.items()
        for name, number in pairs
        if number != PARAMETERS[name]
    ]
    assert not wrong


@pytest.mark.parametrize("period", ["vehicle_speed", "battery_state"])
def test_the_longest_time_to_zero_torque_is_its_parts(period: str) -> None:
    missing_s = PARAMETERS["missed_periods"] * PARAMETERS[f"input_period_s.{period}"]
    whole_s = missing_s + 1.0 / PARAMETERS["rate_hz"] + PARAMETERS["fade_s"]
    text = " ".join((DOCS / "safety.md").read_text().split())
    (sentence,) = re.findall(r"Worst case from the last good message to zero motor torque: [^)]*\)", text)
    assert f"{whole_s:.2f} s" in sentence


@pytest.mark.parametrize(
    "sentence",
    [
        f"braking at {S.yaw_speed_mps:g} m/s: {YAW_NM:g} N m, growing by {MORE_NMPS:g} N m/s up to {MOST_YAW_NM:g}",
        f"driving {MOST_YAW_NM:g}. Rear: none",
        f"keep to a slip of {S.unequal_rear_slip_target:g}",
        f"{MOTOR.peak_torque_nm:g} N m cold, fading to {MOTOR.continuous_torque_nm:g} N m with the heat index",
        f"with the heat index; ≤ {KILOWATT:g} kW / wheel speed",
        f"{MOTOR.regeneration_torque_nm:g} N m, ≤ {KILOWATT:g} kW / wheel speed, fading to zero from "
        f"{MOTOR.regeneration_full_above_mps:g} to {MOTOR.regeneration_zero_below_mps:g} m/s",
        f"{BRAKE_NM:g} N m per wheel, never positive",
        f"≤ peak torque; friction -{BRAKE_NM:g} .. 0",
        f"{BATTERY.discharge_limit_w / 1e3:g} kW, derated live by charge",
        f"(below {100 * EMPTY_SOC:g} %, above {100 * FULL_SOC:g} %)",
        f"(below {BATTERY.charge_full_above_degc:g} °C for charging, above {BATTERY.power_full_below_degc:g} °C)",
        f"up {S.slew_up_nmps:g} N m/s, regeneration {S.slew_regeneration_nmps:g} N m/s",
        f"to zero {S.slew_down_nmps:g} N m/s",
        f"held by friction from {MOVING_MPS:g} m/s on, for slopes up to {100 * HOLD_GRADE:g} %",
        f"missing for {AWAY_S:g} s, or the clock was set back, and then stand for {STANDS_S:g} s",
        f"leaves DDS within {LIMIT_S:g} s",
    ],
)
def test_what_the_safety_page_says_of_limits_is_what_holds(sentence: str) -> None:
    text = " ".join((DOCS / "safety.md").read_text().replace("**", "").split())
    assert sentence in text
    assert S.rear_yaw_nm == S.rear_yaw_most_nm == 0.0
    assert BATTERY.charge_limit_w == BATTERY.discharge_limit_w
    assert CAR.front.motor[:7] == CAR.rear.motor[:7]
