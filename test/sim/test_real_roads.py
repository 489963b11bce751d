# SPDX-License-Identifier: Apache-2.0
"""The scenarios of real roads that have to hold: each meets all that its file requires."""

from __future__ import annotations

import pytest

from iwm_power_manager.share import resolve
from iwm_sim.road_report import text
from iwm_sim.road_run import check_scenario
from iwm_sim.scenario import load_scenario

HOLDS = sorted(path.stem for path in resolve("config/scenarios").glob("*.yaml"))


@pytest.mark.parametrize("name", HOLDS)
def test_a_scenario_meets_what_it_requires(name):
    result = check_scenario(load_scenario(name))
    assert result.passed, text(result)
