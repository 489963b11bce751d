# SPDX-License-Identifier: Apache-2.0
"""The command `fleet`, as a user calls it: what it prints, refuses, leaves behind when stopped, and goes on with."""

import json
import os
import signal
import subprocess
import sys

import psutil
import pytest

from iwm_sim.fleet.store import Store
from iwm_sim.fleet.task import Drive
from iwm_sim.tools import fleet

PROGRAM = "import sys; from iwm_sim.executables import fleet; sys.exit(fleet())"
CAR = ["--vehicle", "jalalmaab_2015", "--idle-drive", "none"]


def test_a_small_fleet_is_driven_and_its_page_made(hill, tmp_path, capsys):
    study, out = tmp_path / "study", tmp_path / "out.json"
    drive = ["drive", *CAR, "--cycle", str(hill), "--strategy", "instantaneous", "--jobs", "1", "--output", str(study)]
    assert fleet.main([*drive, "--json", str(out)]) == 0
    assert "drive: 1 tasks, 0 known before, 1 batches" in capsys.readouterr().out
    assert json.loads(out.read_text())["drive"]["batches"] == 1
    assert fleet.main([*drive, "--friction", "0.9", "0.5", "--quiet"]) == 0
    assert capsys.readouterr().out == ""
    assert fleet.main(["report", str(study)]) == 0
    assert (study / "fleet.html").exists()
    assert "instantaneous       2     2" in capsys.readouterr().out
    for command in (["report", str(study)], drive):
        assert fleet.main([*command, "--json", "-"]) == 0
        assert {"savings", "drive"} & set(json.loads(capsys.readouterr().out))


def test_a_misspelled_name_is_said_before_a_library_that_is_not_there(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert fleet.main(["drive", "smal", "--output", str(tmp_path / "study")]) == 2
    assert "smal" in (said := capsys.readouterr().err) and "small" in said and "distributed" not in said
    assert fleet.main(["drive", "small", "--output", str(tmp_path / "study")]) == 2
    assert "distributed: is not installed" in capsys.readouterr().err


def test_policies_are_solved_alone(small_grid, tmp_path, capsys):
    study = tmp_path / "study"
    solve = ["solve", *CAR, "--friction", "0.9", "0.5", "--grid", str(small_grid), "--jobs", "1"]
    assert fleet.main([*solve, "--output", str(study)]) == 0
    assert len(list((study / "policies").glob("*.npz"))) == 2
    assert fleet.main(["report", str(study)]) == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["drive"], "arguments: names no fleet; allowed: a YAML file, or --vehicle"),
        (["drive", "--vehicle", "jalalmaab_2015"], "arguments: cycles: is missing"),
        (["drive", "--idle-drive", "drag"], "names no fleet"),
        (["drive", "smal"], "did you mean small"),
        (["drive", "small", "--idle-drive", "drag"], "--idle-drive: has no effect: it is for --vehicle"),
        (["drive", "small", "--strategy", "equal", "--grid", "fine"], "--grid: has no effect: no strategy here"),
        (["drive", "small", "--strategy", "equal", "--budget", "4"], "--budget: has no effect: no strategy here"),
        (["drive", "small", "--scheduler", "tcp://nowhere:1", "--jobs", "2"], "--jobs: has no effect"),
        (["drive", *CAR, "--cycle", "nycc", "--friction", "0.9", "--output", "/proc/no/study"], "cannot be created"),
    ],
)
def test_a_mistake_ends_in_one_line(arguments, words, tmp_path, capsys):
    assert (
        fleet.main([("--output" in arguments and arguments) or [*arguments, "--output", str(tmp_path / "x")]][0]) == 2
    )
    shown = capsys.readouterr().err
    assert words in shown
    assert shown.count("\n") == 1
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGKILL])
def test_a_study_that_is_stopped_leaves_whole_parts_and_no_process_and_ends_with_the_rows_of_one_that_was_not(
    stop, hill, tmp_path
):
    study = tmp_path / "study"
    roads = [f"{0.3 + 0.001 * k:.3f}" for k in range(250)]
    (tmp_path / "many.yaml").write_text(
        f"format: 1\ncars: {{vehicle: jalalmaab_2015}}\ncycles: [{hill}]\nfriction: [{', '.join(roads)}]\ndt_s: 0.05\n"
    )
    command = ["drive", str(tmp_path / "many.yaml"), "--output", str(study), "--batch", "0"]
    started = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, *command, "--jobs", "2"],
        start_new_session=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    while not any(study.glob("rows/*.parquet")):
        assert started.poll() is None
        os.sched_yield()
    children = psutil.Process(started.pid).children(recursive=True)
    if stop == signal.SIGINT:
        os.killpg(started.pid, stop)  # as a terminal does
    else:
        started.kill()
    printed = started.communicate(timeout=120)
    assert started.returncode == (130 if stop == signal.SIGINT else -stop)
    assert b"Traceback" not in b"".join(printed)
    assert not psutil.wait_procs(children, timeout=60)[1]
    assert stop == signal.SIGKILL or all(path.suffix == ".parquet" for path in (study / "rows").iterdir())
    known = Store(study).table(Drive).num_rows
    assert 0 < known < 250
    assert fleet.main([*command, "--batch", "60", "--jobs", "1", "--quiet", "--json", str(tmp_path / "out.json")]) == 0
    assert json.loads((tmp_path / "out.json").read_text())["drive"]["known"] == known
    alone = ["drive", str(tmp_path / "many.yaml"), "--output", str(tmp_path / "alone"), "--jobs", "1", "--quiet"]
    assert fleet.main(alone) == 0
    rows = Store(study).table(Drive)
    assert rows.num_rows == 250
    assert rows.equals(Store(tmp_path / "alone").table(Drive))
