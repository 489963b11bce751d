# SPDX-License-Identifier: Apache-2.0
"""The scenarios of real roads that have to hold: each meets all that its file requires."""

from __future__ import annotations

import pytest

from iwm_sim.road_report import text
from iwm_sim.road_run import check_scenario
from iwm_sim.scenario import load_scenario

HOLDS = (
    "demand_lost",
    "hill_hold",
    "jump_down",
    "jump_up",
    "loaded_stop",
    "motor_dead_drive",
    "motor_dead_stop",
    "motor_reversed",
    "motor_weak",
    "speed_drift_down",
    "speed_low",
    "speed_missing",
    "split_accelerate",
    "split_start",
    "stop_02",
    "stop_05",
    "stop_09",
    "told_too_much",
    "wheel_high",
)


@pytest.mark.parametrize("name", HOLDS)
def test_a_scenario_meets_what_it_requires(name):
    result = check_scenario(load_scenario(name))
    assert result.passed, text(result)
