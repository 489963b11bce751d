# SPDX-License-Identifier: Apache-2.0
"""What every command does with the files it leaves."""

import pytest
from matplotlib.figure import Figure

from iwm_power_manager.share import share_path
from iwm_power_manager.tools import command, import_cycle, import_motor

LOG = share_path("config/cycles/nycc.csv")
SHEET = share_path("config/motors/siemens_pm_7500w.csv")


def imported_cycle(path):
    assert import_cycle.main([str(LOG), "--output", str(path), "--quiet"]) == 0


def imported_motor(path):
    assert import_motor.main([str(SHEET), "--output", str(path), "--quiet"]) == 0


def numbers(path):
    command.write_json(path, {"a": 1})


def picture(path):
    command.write_picture(path.with_suffix(".svg"), Figure())


@pytest.mark.parametrize("write", [imported_cycle, imported_motor, numbers, picture])
def test_a_file_that_is_replaced_is_named_and_a_new_one_is_not(write, tmp_path, capsys):
    write(tmp_path / "out.csv")
    assert "replaces" not in capsys.readouterr().err
    (made,) = tmp_path.iterdir()
    made.write_text("mine")
    write(tmp_path / "out.csv")
    assert f"note: replaces {made}\n" in capsys.readouterr().err
    assert made.read_text() != "mine"


def test_standard_output_replaces_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "-").write_text("a file of that name")
    command.write_json("-", [])
    assert not capsys.readouterr().err
