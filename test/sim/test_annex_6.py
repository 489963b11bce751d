# SPDX-License-Identifier: Apache-2.0
"""The rows of UN R13-H, Annex 6, at other initial speeds than theirs: what they require holds there, too."""

from __future__ import annotations

import dataclasses

import pytest

from iwm_sim.road_report import text
from iwm_sim.road_run import check_scenario
from iwm_sim.scenario import load_scenario

KMH = 1.0 / 3.6
ROWS = ["stop_02", "stop_05", "stop_09", "jump_down", "jump_up", "split_stop", "split_stop_mirrored"]


@pytest.mark.parametrize("speed_kmh", [50.0, 80.0, 120.0])
@pytest.mark.parametrize("name", ROWS)
def test_a_row_meets_what_it_requires_at_other_initial_speeds(name, speed_kmh):
    result = check_scenario(dataclasses.replace(load_scenario(name), speed_mps=speed_kmh * KMH))
    assert result.passed, text(result)


@pytest.mark.parametrize("name", ROWS)
def test_no_wheel_locks_from_40_kmh_either(name):
    """From where no rate of braking from 45 to 15 km/h can be told."""
    row = load_scenario(name)
    locked = tuple(bound for bound in row.require if bound.measure == "longest_locked_s")
    assert locked
    result = check_scenario(dataclasses.replace(row, speed_mps=40.0 * KMH, require=locked))
    assert result.passed, text(result)
