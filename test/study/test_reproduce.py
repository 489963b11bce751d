# SPDX-License-Identifier: Apache-2.0
"""The study as a whole, on a short cycle."""

import shutil

import pytest

from iwm_power_manager.errors import ConfigError
from iwm_power_manager.tools.command import plain
from iwm_sim.study import cases, paper, plan, policies, reproduce
from iwm_sim.study.content import Study


def test_a_folder_that_cannot_be_made_is_refused_at_once(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot be created"):
        reproduce.study(tmp_path / "file" / "out", vehicle="jalalmaab_2015", policy="policies", jobs=1, quiet=True)


def test_numbers_keep_six_digits_and_nan_becomes_null():
    made = plain({"a": [1.23456789, float("nan")], "b": True, 3: "x"}, 6)
    assert made == {"a": [1.23457, None], "b": True, "3": "x"}


@pytest.mark.nightly
@pytest.mark.timeout(1800)
def test_the_whole_study_runs_on_a_short_cycle(hill, tmp_path, small_grid, monkeypatch):
    monkeypatch.setattr(cases, "RULE_CYCLE", str(hill))
    bank = tmp_path / "bank"
    bank.mkdir()
    for idle_drive in plan.IDLE_DRIVES:
        for friction in paper.FRICTIONS:
            car = cases.vehicle_of("jalalmaab_2015", idle_drive)
            made = policies.solved(car, friction, str(small_grid), cycles=(str(hill),))
            shutil.copy(made, bank / f"{idle_drive}_{friction}.npz")
    out = tmp_path / "out"
    made = reproduce.study(out, vehicle="jalalmaab_2015", policy=str(bank), jobs=1, quiet=True, cycles=(str(hill),))
    assert Study.load(out / "study.json") == made
    assert len(made.cells) == 6 * 10
    assert len(made.gates) == 6 * 2
    assert (out / "study.html").stat().st_size > 100_000
    assert len(list((out / "figures").glob("*.svg"))) == 10
