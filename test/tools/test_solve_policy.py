# SPDX-License-Identifier: Apache-2.0
"""`solve_policy` as a user calls it: files in, policies out, one line and a code for every mistake."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys

import numpy as np
import pytest

from iwm_power_manager import solve
from iwm_power_manager.cycle import load_cycle
from iwm_power_manager.mdp.demand import chain_of, cycle_power_w, cycle_source, driven_source
from iwm_power_manager.mdp.problem import load_problem
from iwm_power_manager.policy import load_policy, load_policy_bank, policy_bytes
from iwm_power_manager.replay import recorded as recorded_drives
from iwm_power_manager.replay.recorded import RecordedDrive
from iwm_power_manager.share import share_path
from iwm_power_manager.tools import solve_policy
from iwm_power_manager.vehicle import load_vehicle

GRID = """\
format: 1
power_w: {from: -12000, to: 18000, step: 3000}
speed_mps: [0, 5, 10, 25]
slip_front: [-0.35, -0.01, 0, 0.01]
slip_rear: [-0.35, -0.01, 0, 0.01]
share: [0, 0.5, 1]
previous_share: true
dt_s: 0.1
discount: 0.9
alpha: 2.0
switching_cost_j: 20
"""


@pytest.fixture
def grid(tmp_path):
    path = tmp_path / "coarse.yaml"
    path.write_text(GRID)
    return str(path)


def _run(*arguments):
    return solve_policy.main([str(argument) for argument in arguments])


def _solve(grid, *arguments, vehicle="jalalmaab_2015", cycle="nycc"):
    return _run("--vehicle", vehicle, "--cycle", cycle, "--grid", grid, *arguments)


def test_the_exported_problem_has_the_price_that_was_found_for_a_budget(tmp_path, capsys):
    budget = tmp_path / "budget.yaml"
    budget.write_text(GRID.replace("switching_cost_j: 20", "changes_per_min: 4"))
    output, exported = tmp_path / "policy.npz", tmp_path / "mdp.npz"
    assert _solve(str(budget), "--friction", 0.9, "--output", output, "--export-mdp", exported) == 0
    price = load_policy(output).problem.switching_cost_j
    assert price > 0.0
    assert f"price of a change, J: changes a minute; {price:.4g} J is taken\n" in capsys.readouterr().out
    with np.load(exported) as data:
        assert data["switching_j"].max() >= price  # J, from one end of the shares to the other
        assert np.all(np.diag(data["switching_j"]) == 0.0)


def test_it_writes_one_verified_policy_for_each_road(grid, tmp_path, capsys):
    output = tmp_path / "new" / "policies"
    report = tmp_path / "run.json"
    assert _solve(grid, "--friction", 0.9, 0.2, "--output", output, "--idle-drive", "none", "--json", report) == 0
    bank = load_policy_bank(output)
    assert [policy.friction for policy in bank] == [0.2, 0.9]
    assert all(policy.converged and policy.bound_j <= policy.problem.tolerance_j for policy in bank)
    assert bank[0].idle_drive == "none"
    assert bank[0].problem.name == "coarse"
    assert {path.name for path in output.iterdir()} == {
        "jalalmaab_2015_none_coarse_mu020.npz", "jalalmaab_2015_none_coarse_mu090.npz",
    }  # fmt: skip
    text = capsys.readouterr().out
    for policy in bank:
        assert f"friction {policy.friction:g}\n" in text
        assert policy.checksum[:12] in text
        for iteration in policy.iterations:
            assert f"{iteration.bound_j:.3e}" in text
    numbers = json.loads(report.read_text())
    assert [p["checksum"] for p in numbers["policies"]] == [bank[1].checksum, bank[0].checksum]
    assert np.sum(numbers["demand"]["row_steps"]) == 5979.0


def test_roads_that_are_nearly_one_have_a_policy_each(grid, tmp_path):
    assert _solve(grid, "--friction", 0.9, 0.901, "--output", tmp_path / "bank", "--quiet") == 0
    assert sorted(load_policy(path).friction for path in (tmp_path / "bank").iterdir()) == [0.9, 0.901]


def test_verify_stores_the_residual_and_what_it_proves(grid, tmp_path, capsys):
    plain, verified, report = tmp_path / "plain.npz", tmp_path / "verified.npz", tmp_path / "run.json"
    assert _solve(grid, "--friction", 0.5, "--output", plain) == 0
    assert _solve(grid, "--friction", 0.5, "--output", verified, "--verify", "--json", report) == 0
    before, policy = load_policy(plain), load_policy(verified)
    assert before.residual_j is before.proven_j is None
    assert np.array_equal(policy.cost_j, before.cost_j)
    assert policy.checksum != before.checksum
    # Within b of the optimum the residual is (1 + gamma) b at most; a residual r proves r / (1 - gamma).
    assert 0.0 < policy.residual_j <= 1.9 * policy.bound_j
    assert policy.proven_j == pytest.approx(policy.residual_j / 0.1)
    (numbers,) = json.loads(report.read_text())["policies"]
    assert (numbers["residual_j"], numbers["proven_j"]) == (policy.residual_j, policy.proven_j)
    stored = json.loads(np.load(verified)["metadata"].tobytes())["solver"]
    assert (stored["residual_j"], stored["proven_j"]) == (policy.residual_j, policy.proven_j)
    assert f"proves {policy.proven_j:.2g} J" in capsys.readouterr().out
    # The check, which builds the problem anew, finds the same.
    assert _run("--vehicle", "jalalmaab_2015", "--check", verified) == 0
    assert f"residual proves {policy.proven_j:.3g} J" in capsys.readouterr().out


def test_the_price_of_a_change_is_that_of_the_road_and_is_paid(tmp_path):
    path = tmp_path / "by_road.yaml"
    path.write_text(GRID.replace("switching_cost_j: 20", "switching_cost_by_friction: [[0.2, 60], [0.6, 20]]"))
    assert _solve(path, "--friction", 0.2, 0.5, "--output", tmp_path / "out", "--quiet") == 0
    for policy, price in zip(load_policy_bank(tmp_path / "out"), (60, 30), strict=True):
        assert policy.problem.switching_cost_j == pytest.approx(price)
        path.write_text(GRID.replace("switching_cost_j: 20", f"switching_cost_j: {price}"))
        assert _solve(path, "--friction", policy.friction, "--output", tmp_path / "same.npz", "--quiet") == 0
        np.testing.assert_allclose(policy.cost_j, load_policy(tmp_path / "same.npz").cost_j, rtol=0.0, atol=0.05)


def test_a_cycle_s_demand_is_a_driver_s_where_the_grid_says_so(grid, tmp_path):
    driven = tmp_path / "driven.yaml"
    driven.write_text(GRID + "cycle_demand: driven\n")
    chains = {}
    for name, path in (("exact", grid), ("driven", driven)):
        assert _solve(path, "--friction", 0.5, "--output", tmp_path / f"{name}.npz", "--quiet") == 0
        chains[name] = load_policy(tmp_path / f"{name}.npz").chain.probability
    problem = load_problem(driven)
    vehicle = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params
    cycle = load_cycle(share_path("config/cycles/nycc.csv"))
    for name, source in (("exact", cycle_source), ("driven", driven_source)):
        wanted = chain_of(problem, [source(cycle, problem.dt_s, vehicle)]).probability
        np.testing.assert_array_equal(chains[name], wanted)
    assert not np.array_equal(chains["exact"], chains["driven"])


def test_the_shipped_policies_are_of_the_shipped_grid():
    vehicle = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params
    coupled = load_problem(share_path("config/grids/coupled.yaml")).for_car(vehicle)
    policies = [load_policy(path) for path in sorted(share_path("policies").glob("*.npz"))]
    assert len(policies) == 6
    for policy in policies:
        # The price of a change is the solver's: the one that keeps the budget.
        price = policy.problem.switching_cost_j
        assert policy.problem.settings() == dataclasses.replace(coupled, switching_cost_j=price).settings()
        found = {trial.price_j: trial.changes_per_min for trial in policy.trials}
        assert found[price] == pytest.approx(coupled.changes_per_min, rel=0.031)
        assert policy.dearer_cost_j.shape == (2, *policy.problem.shape)


def test_the_same_inputs_give_the_same_bytes(grid, tmp_path):
    for name in ("a.npz", "b.npz"):
        assert _solve(grid, "--friction", 0.5, "--output", tmp_path / name, "--quiet") == 0
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_quiet_prints_nothing_when_all_is_well(grid, tmp_path, capsys):
    assert _solve(grid, "--friction", 0.5, "--output", tmp_path / "a.npz", "--quiet", cycle="ftp75") == 0
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "error" not in captured.err


def test_options_replace_what_the_files_say(grid, tmp_path):
    assert _solve(grid, "--friction", 0.5, "--output", tmp_path / "a.npz", "--discount", 0.5, "--quiet") == 0
    assert load_policy(tmp_path / "a.npz").problem.discount == 0.5


def test_a_policy_that_misses_its_bound_is_written_and_reported(tmp_path, capsys):
    path = tmp_path / "hasty.yaml"
    path.write_text(GRID + "max_iterations: 1\n")
    assert _solve(path, "--friction", 0.5, "--output", tmp_path / "a.npz") == 1
    assert "NOT within the tolerance" in capsys.readouterr().out
    assert not load_policy(tmp_path / "a.npz").converged


def test_a_picture_shows_matrix_convergence_and_policies(grid, tmp_path):
    picture = tmp_path / "solution.png"
    assert _solve(grid, "--friction", 0.9, 0.2, "--output", tmp_path / "p", "--plot", picture, "--quiet") == 0
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_check_accepts_what_was_solved_and_nothing_else(grid, tmp_path, capsys):
    path = tmp_path / "a.npz"
    assert _solve(grid, "--friction", 0.5, "--output", path, "--quiet") == 0
    assert _run("--vehicle", "jalalmaab_2015", "--check", path) == 0
    assert f"{path}: ok; friction 0.5" in capsys.readouterr().out
    assert _run("--vehicle", "jalalmaab_2015", "--check", path, "--json", "-") == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert (row["friction"], row["keeps_its_bound"], row["checksum"]) == (0.5, True, load_policy(path).checksum)
    assert _run("--vehicle", "jalalmaab_2015", "--idle-drive", "enabled", "--check", path) == 2
    assert "was solved for" in capsys.readouterr().err


def test_check_notices_a_cost_to_go_that_is_not_the_problem_s(grid, tmp_path, capsys):
    import dataclasses

    path = tmp_path / "a.npz"
    assert _solve(grid, "--friction", 0.5, "--output", path, "--quiet") == 0
    policy = load_policy(path)
    policy.cost_j[0, 0, 0, 0, 0] += 5.0
    path.write_bytes(policy_bytes(dataclasses.replace(policy)))
    assert _run("--vehicle", "jalalmaab_2015", "--check", path, "--quiet") == 1
    assert "does NOT keep its bound" in capsys.readouterr().out


@pytest.fixture
def recorded(monkeypatch):
    """A bag that holds the demand of NYCC, every 10 ms."""
    car = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params
    power = np.repeat(cycle_power_w(load_cycle(share_path("config/cycles/nycc.csv")), 0.1, car), 10)
    drive = RecordedDrive(0.01 * np.arange(power.size), power, np.zeros(power.size), 3, ["file 2 ends early"])
    monkeypatch.setattr(recorded_drives, "read_signal", lambda bag, mapping, vehicle: drive)
    return drive


def test_a_bag_teaches_the_demand_instead_of_a_cycle(grid, tmp_path, recorded, capsys):
    path = tmp_path / "a.npz"
    options = ("--vehicle", "jalalmaab_2015", "--grid", grid, "--friction", 0.5, "--output", path)
    assert _run(*options, "--bag", "drives/monday") == 0
    captured = capsys.readouterr()
    assert "demand from monday (598 s x 1)" in captured.out
    assert "file 2 ends early" in captured.err
    assert "3 bad messages" in captured.err
    from_bag = load_policy(path)
    assert _solve(grid, "--friction", 0.5, "--output", path, "--quiet") == 0
    from_cycle = load_policy(path)
    assert from_bag.chain.probability == pytest.approx(from_cycle.chain.probability, abs=0.01)


def test_a_bag_mixes_with_cycles_by_weight(grid, tmp_path, recorded):
    path = tmp_path / "a.npz"
    assert (
        _solve(grid, "--friction", 0.5, "--output", path, "--quiet", "--bag", "x", "--bag-weight", 10, cycle="hwfet")
        == 0
    )
    policy = load_policy(path)
    assert [(source["name"], source["weight"]) for source in policy.sources] == [("hwfet", 1.0), ("x", 10.0)]
    assert policy.chain.row_steps.sum() == pytest.approx(7649.0 + 10.0 * 5979.0, abs=20.0)


def test_a_gap_in_a_cycle_is_said(tmp_path, grid, capsys):
    cycle = tmp_path / "tunnel.csv"
    cycle.write_text("time_s,speed_mps\n0,9\n1,10\n2,10\n62,10\n63,9\n64,9\n")
    assert _solve(grid, "--friction", 0.5, "--output", tmp_path / "a.npz", "--quiet", cycle=cycle) == 0
    assert f"warning: {cycle}: line 5: is 60 s after the one before" in capsys.readouterr().err


def test_thin_and_missing_data_is_warned_about(tmp_path, grid, capsys):
    calm = tmp_path / "calm.csv"
    calm.write_text("time_s,speed_mps\n0,10\n60,10\n65,14\n")
    assert _solve(grid, "--friction", 0.5, "--output", tmp_path / "a.npz", "--quiet", cycle=calm) == 0
    warnings = capsys.readouterr().err
    assert "no data at -12 to -3, 3 to 6, 15 to 18 kW" in warnings
    assert "less than 10 s of data at 9 to 12 kW" in warnings
    assert "replaces" not in warnings
    assert _solve(grid, "--friction", 0.5, "--output", tmp_path / "a.npz", "--quiet", cycle=calm) == 0
    assert f"note: replaces {tmp_path}/a.npz" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--cycle", "nycc", "--output", "x"], "--friction: is missing; allowed: each 0.01 to 2, as in --friction 0.9"),
        (["--cycle", "nycc", "--friction", "0.5"], "--output: is missing"),
        (["--friction", "0.5", "--output", "x"], "--cycle: is missing"),
        (
            ["--cycle", "nycc", "--friction", "0", "--output", "x"],
            "--friction: 0.0 is out of range; allowed: 0.01 to 2",
        ),
        (["--cycle", "nycc", "--friction", "nan", "--output", "x"], "--friction: nan is not finite"),
        (["--cycle", "nycc", "--friction", "0.5", "0.5", "--output", "x"], "--friction: names a value twice"),
        (
            ["--cycle", "nycc", "--friction", "0.5", "0.9", "--output", "x.npz"],
            "--output: x.npz is one file for 2 policies",
        ),
        (["--cycle", "nycc", "--friction", "0.5", "--output", "none/x.npz"], "none/x.npz: cannot be written"),
        (["--cycle", "nycc", "--friction", "0.5", "--output", "file"], "--output: file: File exists"),
        (
            ["--cycle", "nycc", "--friction", "0.5", "--output", "x", "--discount", "1"],
            "--discount: 1.0 is out of range",
        ),
        (
            ["--cycle", "nycc", "--friction", "0.5", "--output", "x", "--bag-weight", "0"],
            "--bag-weight: 0.0 is out of range",
        ),
        (["--cycle", "no_cycle.csv", "--friction", "0.5", "--output", "x"], "no_cycle.csv: cannot be read"),
        (["--cycle", "nycc", "--friction", "0.5", "--output", "x", "--grid", "coarser"], "coarser: cannot be read"),
        (["--bag", "no_bag", "--friction", "0.5", "--output", "x"], "no_bag"),
        (["--check", "no_policy.npz"], "no_policy.npz: cannot be read"),
    ],
)
def test_a_mistake_gives_one_line_and_code_2(arguments, words, grid, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    if not {"--grid", "--check"}.intersection(arguments):
        arguments = ["--grid", grid, *arguments]
    assert _run("--vehicle", "jalalmaab_2015", *arguments) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("solve_policy: error: ")
    assert words in error


def test_a_bad_vehicle_or_grid_is_named(grid, tmp_path, capsys):
    assert _solve(grid, "--friction", 0.5, "--output", tmp_path, vehicle="no_car.yaml") == 2
    assert "no_car.yaml: cannot be read" in capsys.readouterr().err
    bad = tmp_path / "bad.yaml"
    bad.write_text(GRID.replace("discount: 0.9", "discount: 1.1"))
    assert _solve(bad, "--friction", 0.5, "--output", tmp_path) == 2
    assert f"{bad}: discount: 1.1 is out of range; allowed: 0 to 0.9999" in capsys.readouterr().err


def test_an_interrupt_ends_it_without_a_traceback(grid, tmp_path, monkeypatch, capsys):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(solve, "build_model", interrupted)
    assert _solve(grid, "--friction", 0.5, "--output", tmp_path / "a.npz", "--quiet") == 130
    assert "interrupted" in capsys.readouterr().err
    assert not (tmp_path / "a.npz").exists()
    assert _solve(grid, "--friction", 0.5, "--output", tmp_path / "folder", "--quiet") == 130
    assert not (tmp_path / "folder").exists()


def test_as_a_process_it_teaches_and_exits_with_its_codes(tmp_path):
    def call(*arguments):
        command = [sys.executable, "-m", "iwm_power_manager.tools.solve_policy", *arguments]
        return subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=False)

    taught = call("--help")
    assert taught.returncode == 0
    assert "examples:" in taught.stdout
    assert "exit codes:" in taught.stdout
    missing = call("--vehicle", "none.yaml", "--cycle", "nycc", "--friction", "0.5", "--output", "x")
    assert missing.returncode == 2
    gone = f"none.yaml: cannot be read: No such file or directory (looked for from {tmp_path})"
    assert missing.stderr == f"solve_policy: error: {gone}\n"
    assert call("--cycle", "nycc").returncode == 2


def test_a_folder_that_may_not_be_written_to_is_said_before_anything_is_solved(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(os, "access", lambda path, mode: path != tmp_path)
    given = ["--vehicle", "jalalmaab_2015", "--cycle", "nycc", "--friction", "0.9", "--output", str(tmp_path)]
    assert solve_policy.main(given) == 2
    assert f"--output: {tmp_path}: may not be written to; allowed: a folder or a .npz file" in capsys.readouterr().err
