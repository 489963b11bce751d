# SPDX-License-Identifier: Apache-2.0
"""Friction brakes that follow as a lag of first order which nobody tells: no wheel locks, on any road of the rows."""

from __future__ import annotations

import dataclasses

import pytest

from iwm_sim.road_report import text
from iwm_sim.road_run import check_scenario
from iwm_sim.scenario import load_scenario

LAGGING = load_scenario("brakes_lag_stop_02").faults


@pytest.mark.parametrize("lag_s", [0.02, 0.06])
@pytest.mark.parametrize("name", ["stop_02", "stop_09", "split_stop", "split_stop_imu"])
def test_no_wheel_locks_and_the_car_stays_in_its_lane(name, lag_s):
    row = load_scenario(name)
    kept = tuple(bound for bound in row.require if bound.measure in ("longest_locked_s", "lane_m"))
    assert kept
    faults = tuple(fault._replace(value=lag_s) for fault in LAGGING)
    result = check_scenario(dataclasses.replace(row, faults=faults, require=kept))
    assert result.passed, text(result)
