# SPDX-License-Identifier: Apache-2.0
"""An option that would change nothing is refused by every command, in one line, before anything is done."""

import pytest

from campaigns import roads
from iwm_power_manager.tools import import_motor, replay, solve_policy, watch_car
from iwm_sim.tools import demo, learn

SOLVE = ("--vehicle", "jalalmaab_2015", "--cycle", "nycc", "--friction", "0.9", "--output", "no_such_folder")
LEARN = ("--vehicle", "jalalmaab_2015", "--bag", "no_such_bag", "--friction", "0.9", "--output", "no_such_folder")


@pytest.mark.parametrize(
    ("command", "arguments", "option"),
    [
        (demo, ["--scenario", "split_stop", "--cycle", "nycc"], "--cycle"),
        (demo, ["--scenario", "split_stop", "--friction", "0.5"], "--friction"),
        (demo, ["--strategy", "equal", "--policy", "policies"], "--policy"),
        (solve_policy, [*SOLVE, "--bag-weight", "5"], "--bag-weight"),
        (solve_policy, [*SOLVE, "--mapping", "no_such.yaml"], "--mapping"),
        (solve_policy, ["--vehicle", "jalalmaab_2015", "--check", "a.npz", "--discount", "0.9"], "--discount"),
        (learn, [*LEARN, "--grid", "paper", "--bandwidths", "2"], "--bandwidths"),
        *((replay, ["no_such_bag", *given], given[0]) for given in (["--rate", "2"], ["--loop"], ["--listeners", "2"])),
        (replay, ["no_such_bag", "--tolerance", "1"], "--tolerance"),
        (replay, ["no_such_bag", "--publish", "--friction", "0.5"], "--friction"),
        (watch_car, ["--terminal", "--port", "8000"], "--port"),
        (import_motor, ["sheet.csv", "--quantity", "loss", "--percent", "--output", "no_such.csv"], "--percent"),
        (roads, ["split_stop", "--policy", "policies"], "--policy"),
    ],
    ids=lambda value: getattr(value, "__name__", "").rsplit(".", maxsplit=1)[-1],
)
def test_an_option_without_effect_is_refused(command, arguments, option, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sheet.csv").write_text("speed,torque,loss\n")
    try:
        code = command.main(arguments)
    except SystemExit as ended:
        code = ended.code
    assert code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{option}: has no effect: " in line
    assert [path.name for path in tmp_path.iterdir()] == ["sheet.csv"]
