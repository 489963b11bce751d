# SPDX-License-Identifier: Apache-2.0
"""`learn_policy`: what is recorded is tried at several weights, and only what drives no worse is kept."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
import yaml

from bags_helpers import write_drive
from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.control.table import empty_table
from iwm_power_manager.cycle import load_cycle, make_cycle
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.exit_codes import BAD_INPUT, DONE
from iwm_power_manager.mdp.demand import Source
from iwm_power_manager.mdp.problem import load_problem
from iwm_power_manager.policy import load_policy
from iwm_power_manager.replay.recorded import RecordedDrive
from iwm_power_manager.share import share_path
from iwm_power_manager.tools import solve_policy
from iwm_power_manager.vehicle import load_vehicle
from iwm_sim import closed_loop, learning
from iwm_sim.learning import CYCLES_ALONE, RECORDING_ALONE, Candidate, Outcome, choose, recorded_cycle, sources_at
from iwm_sim.metrics import measure
from iwm_sim.tools import learn

CAR = "jalalmaab_2015"


def outcome(weight: float, energy: float, moves: float = 0.0, held: bool = True) -> Outcome:
    return Outcome(Candidate(weight, 1.0), energy, moves, 5.0, held)


class TestChoose:
    def test_the_least_cost_moves_included(self) -> None:
        best = outcome(2.0, 99.0, 0.5)
        assert choose([outcome(CYCLES_ALONE, 100.0), outcome(1.0, 98.0, 1.8), best, outcome(3.0, 99.8)]) is best

    def test_fewer_moves_are_no_reason_to_need_more_energy(self) -> None:
        cycles, frugal = outcome(CYCLES_ALONE, 100.0, 2.0), outcome(1.0, 100.0, 1.9)
        assert choose([cycles, outcome(2.0, 100.01, 0.1), frugal]) is frugal
        assert choose([cycles, outcome(2.0, 100.01, 0.1)]) is cycles

    def test_the_cycles_where_nothing_is_better(self) -> None:
        cycles = outcome(CYCLES_ALONE, 100.0)
        assert choose([outcome(1.0, 100.0), cycles, outcome(2.0, 99.0, 1.5)]) is cycles

    def test_a_gain_that_is_chance_keeps_the_cycles(self) -> None:
        cycles = outcome(CYCLES_ALONE, 100.0)
        assert choose([cycles, outcome(1.0, 99.992)]) is cycles
        better = outcome(1.0, 99.988)
        assert choose([cycles, better]) is better

    def test_a_lost_trace_is_no_saving(self) -> None:
        cycles, honest = outcome(CYCLES_ALONE, 100.0), outcome(2.0, 99.9)
        lost = outcome(1.0, 90.0, held=False)
        assert choose([cycles, lost, honest]) is honest
        assert choose([cycles, lost]) is cycles

    def test_a_trace_that_nobody_holds_is_no_reason(self) -> None:
        better = outcome(1.0, 90.0, held=False)
        assert choose([outcome(CYCLES_ALONE, 100.0, held=False), better]) is better


class TestRecordedCycle:
    def test_a_point_a_second_with_the_mean_around_it(self) -> None:
        time_s = np.arange(0.0, 10.001, 0.01)
        noise = 0.2 * np.cos(2 * math.pi * 5.0 * time_s)
        drive = RecordedDrive(time_s + 100.0, np.zeros_like(time_s), 2.0 * time_s + noise, 0, ())
        cycle = recorded_cycle("drive", drive)
        assert cycle.time_s.tolist() == list(range(11))
        assert cycle.speed_mps[1:-1] == pytest.approx(2.0 * np.arange(1, 10), abs=0.01)
        assert cycle.speed_mps[0] == pytest.approx(0.5, abs=0.05)  # of the half second there is
        assert cycle.name == "drive"

    def test_it_rolls_forwards(self) -> None:
        time_s = np.linspace(0.0, 5.0, 51)
        cycle = recorded_cycle("drive", RecordedDrive(time_s, time_s, np.full(51, -0.3), 0, ()))
        assert cycle.speed_mps.tolist() == [0.0] * 6

    def test_what_nobody_recorded_is_known(self) -> None:
        time_s = np.concatenate([np.arange(0.0, 5.0, 0.1), np.arange(65.0, 70.0, 0.1)])
        gap = recorded_cycle("drive", RecordedDrive(time_s, time_s, np.full(100, 8.0), 0, ())).gap
        assert gap.startswith("drive: the speed at 65 s is 60.1 s after the one before, where 0.1 s is usual: policies")
        assert recorded_cycle("drive", RecordedDrive(time_s, time_s, np.zeros(100), 0, ())).gap == ""

    def test_too_short(self) -> None:
        time_s = np.array([0.0, 1.9])
        with pytest.raises(ConfigError, match=r"drive.*too short"):
            recorded_cycle("drive", RecordedDrive(time_s, time_s, time_s, 0, ()))


def test_no_two_candidates_share_a_file() -> None:
    values = [
        (0.2, 1.0),
        (0.2000001, 1.0),
        (0.2, 1.0000001),
        (RECORDING_ALONE, 1.0),
    ]
    assert len({learning.policy_path("folder", Candidate(*each)) for each in values}) == len(values)


def test_the_baseline_comes_first_and_once() -> None:
    problem = load_problem(share_path("config/grids/coupled.yaml"))
    found = learning.candidates_of(problem, (RECORDING_ALONE, 1.0, CYCLES_ALONE), (1.3, 1.0))
    assert found[0] == learning.BASELINE and len(found) == len(set(found)) == 3 * 2
    assert [candidate.weight for candidate in found] == [0.0] * 2 + [1.0] * 2 + [RECORDING_ALONE] * 2
    without_speed = dataclasses.replace(problem, demand_by_speed=False)
    assert [each.bandwidth for each in learning.candidates_of(without_speed, (1.0,), (1.3, 2.0))] == [1.0, 1.0]


def test_a_candidate_changes_the_bandwidth_and_nothing_else() -> None:
    problem = load_problem(share_path("config/grids/coupled.yaml"))
    varied = learning.varied(problem, Candidate(1.0, 2.0))
    assert varied.speed_bandwidth_mps == 2.0 * problem.speed_bandwidth_mps
    assert varied.settings() == problem.settings() | {"speed_bandwidth_mps": varied.speed_bandwidth_mps}


def test_weights_are_those_of_the_recording() -> None:
    recorded = Source("bag", "", 1.0, (np.zeros(3),))
    general = Source("cycle", "", 1.0, (np.zeros(3),))

    def weights(weight: float) -> list[tuple[str, float]]:
        return [(source.name, source.weight) for source in sources_at(weight, [recorded], [general])]

    assert weights(CYCLES_ALONE) == [("cycle", 1.0)]
    assert weights(RECORDING_ALONE) == [("bag", 1.0)]
    assert weights(0.2) == [("bag", 0.2), ("cycle", 1.0)]


def drive_nycc(folder: Path, friction: float, idle_drive: str) -> Path:
    """A bag of the NYCC, driven with equal split."""
    cycle = load_cycle(share_path("config/cycles/nycc.csv"))
    car = load_vehicle(share_path(f"config/vehicles/{CAR}.yaml"), idle_drive)
    drive = closed_loop.run(cycle, car, default_settings("equal"), empty_table(), friction)
    path = folder / "nycc_drive"
    write_drive(path, drive["speed_mps"], drive["power_demand_w"])
    return path


@pytest.fixture(scope="module")
def nycc_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """NYCC on a dry road."""
    return drive_nycc(tmp_path_factory.mktemp("bags"), 0.9, "drag")


def cost_of(policy_file: Path, friction: float, idle_drive: str) -> tuple[float, float]:
    """Energy on the NYCC, and energy with the true price of moves, Wh/km."""
    policy = load_policy(policy_file)
    cycle = load_cycle(share_path("config/cycles/nycc.csv"))
    car = load_vehicle(share_path(f"config/vehicles/{CAR}.yaml"), idle_drive)
    run = closed_loop.run(cycle, car, default_settings("sdp_lookahead"), policy.table(), friction)
    found = measure(run, car.params)
    moves_j = learning.moves_j(np.diff(run["decided_share"]), policy.table())
    return found.wh_per_km, found.wh_per_km + moves_j / 3600.0 / (found.distance_m / 1000.0)


def learned_and_general(
    bag: Path, folder: Path, friction: float, idle_drive: str, tried: list[str], grid: str = "coupled"
) -> list[Path]:
    """Policy files: from the bag, and from the three standard cycles."""
    common = ["--vehicle", CAR, "--idle-drive", idle_drive, "--friction", str(friction), "--grid", grid, "--quiet"]
    learned, general = folder / "learned.npz", folder / "general.npz"
    trial = ["--bag", str(bag), "--drive", "nycc", *tried, "--jobs", "2", "--output", str(learned)]
    with (folder / "learn.json").open("w") as out, contextlib.redirect_stdout(out):  # which gets nothing else
        assert learn.main([*common[:-1], *trial, "--json", "-"]) == DONE
    cycles = [argument for name in ("ftp75", "hwfet", "nycc") for argument in ("--cycle", name)]
    assert solve_policy.main([*common, *cycles, "--output", str(general)]) == solve_policy.SOLVED
    return [learned, general]


def test_what_nycc_taught_drives_nycc_no_worse_than_what_three_cycles_taught(tmp_path: Path) -> None:
    tried = ["--weights", "1", "inf", "--bandwidths", "1"]
    settings = yaml.safe_load(share_path("config/grids/coupled.yaml").read_text())
    settings["power_w"]["of_car"] = settings["power_w"]["of_car"][1::2]
    settings["share"]["step"] = 0.1
    grid = tmp_path / "coarse.yaml"
    grid.write_text(yaml.safe_dump(settings))
    bag = drive_nycc(tmp_path, 0.2, "none")
    learned, general = learned_and_general(bag, tmp_path, 0.2, "none", tried, str(grid))
    energy, cost = cost_of(learned, 0.2, "none")
    general_energy, general_cost = cost_of(general, 0.2, "none")
    assert energy <= general_energy and cost <= general_cost
    (road,) = json.loads((tmp_path / "learn.json").read_text())["roads"]
    assert [row["weight"] for row in road["outcomes"]] == [0.0, 1.0, "inf"]
    # What it was chosen for is what it does.
    (chosen,) = (row for row in road["outcomes"] if row["weight"] == road["chosen_weight"])
    assert (chosen["energy_wh_per_km"], chosen["cost_wh_per_km"]) == pytest.approx((energy, cost))
    assert chosen["energy_wh_per_km"] < road["equal"]["energy_wh_per_km"]
    policy = load_policy(learned)
    assert policy.checksum == road["checksum"]
    # All candidates pay what keeps the cycles' policy within its budget.
    assert policy.problem.switching_cost_j == load_policy(general).problem.switching_cost_j


def test_every_candidate_pays_what_keeps_the_cycles_policy_within_its_budget(tmp_path: Path) -> None:
    car = load_vehicle(share_path(f"config/vehicles/{CAR}.yaml"))
    axes = {"power_w": np.arange(-12e3, 21e3, 4e3), "speed_mps": np.arange(0.0, 31.0, 5.0), "share": np.arange(5) / 4.0}
    grid = load_problem(share_path("config/grids/coupled.yaml")).for_car(car.params)
    problem = dataclasses.replace(grid, **axes, demand_by_speed=False)
    cycle = make_cycle("hill", np.arange(0.0, 41.0, 10.0), np.array([0.0, 8.0, 12.0, 6.0, 0.0]))
    general = Source("cycle", "", 1.0, (np.array([0.0, 8e3, 4e3, -4e3] * 50),))
    recorded = Source("bag", "", 1.0, (np.array([0.0, 4e3, 0.0, -8e3] * 50),))
    task = learning.Task(problem, car, 0.9, (recorded,), (general,), (cycle,), str(tmp_path))
    task, cycles_alone = learning.solve_cycles_alone(task)
    learning.try_candidate(Candidate(RECORDING_ALONE, 1.0), task)
    found = load_policy(learning.policy_path(str(tmp_path), Candidate(RECORDING_ALONE, 1.0)))
    assert found.problem.switching_cost_j == cycles_alone.problem.switching_cost_j > 0.0
    assert found.trials == cycles_alone.trials and len(found.trials) > 1
    assert found.checksum != cycles_alone.checksum


@pytest.mark.nightly
@pytest.mark.parametrize("friction", [0.9, 0.5, 0.2])
@pytest.mark.parametrize("idle_drive", ["none", "drag"])
def test_what_its_nycc_taught_is_kept_where_it_is_better_than_chance(
    tmp_path: Path, friction: float, idle_drive: str
) -> None:
    bag = drive_nycc(tmp_path, friction, idle_drive)
    learned, general = learned_and_general(bag, tmp_path, friction, idle_drive, [])
    energy, cost = cost_of(learned, friction, idle_drive)
    general_energy, general_cost = cost_of(general, friction, idle_drive)
    assert energy <= general_energy and cost <= general_cost
    (road,) = json.loads((tmp_path / "learn.json").read_text())["roads"]
    # What is kept from the bag is clearly ahead; what is not is the cycles' own policy.
    if road["chosen_weight"] == CYCLES_ALONE:
        assert load_policy(learned).checksum == load_policy(general).checksum
    else:
        assert cost < general_cost * (1.0 - learning.CHANCE_PERCENT / 100.0)


class TestCommand:
    def test_the_recorded_speed_is_what_is_driven(self, nycc_bag: Path, tmp_path: Path, capsys) -> None:
        grid = tmp_path / "coarse.yaml"
        grid.write_text(
            "format: 1\npower_w: {from: -12000, to: 20000, step: 2000}\nspeed_mps: {from: 0, to: 30, step: 5}\n"
            "slip_front: [0]\nslip_rear: [0]\nshare: {from: 0, to: 1, step: 0.25}\nprevious_share: true\n"
            "slip_model: quasi_steady\ndt_s: 0.2\ndiscount: 0.95\nalpha: 5.0\nswitching_cost_j: 20\n"
        )
        arguments = ["--vehicle", CAR, "--bag", str(nycc_bag), "--cycle", "udds", "--grid", str(grid)]
        arguments += ["--weights", "0.5", "--jobs", "1", "--friction", "0.9", "0.5", "--output", str(tmp_path / "out")]
        assert learn.main(arguments) == DONE
        text = capsys.readouterr().out
        assert "driven: nycc_drive (597 s)" in text or "driven: nycc_drive (598 s)" in text
        assert text.count("<- chosen") == 2 and text.count("nothing: cycles alone") == 2
        files = sorted((tmp_path / "out").iterdir())
        assert [load_policy(file).friction for file in files] == [0.5, 0.9]

    def test_what_nobody_recorded_or_drove_is_said(self, nycc_bag: Path, tmp_path: Path, monkeypatch, capsys) -> None:
        def gone(*_: object) -> None:
            raise ConfigError("so far", "", "and no further")

        driven = dataclasses.replace(load_cycle(share_path("config/cycles/nycc.csv")), gap="a tunnel")
        monkeypatch.setattr(learn, "recorded_cycle", lambda *_: driven)
        monkeypatch.setattr(learn, "candidates_of", gone)
        other = tmp_path / "tunnel.csv"
        other.write_text("time_s,speed_mps\n0,9\n1,10\n2,10\n62,10\n63,9\n64,9\n")
        given = ["--vehicle", CAR, "--bag", str(nycc_bag), "--friction", "0.9", "--output", str(tmp_path / "p.npz")]
        assert learn.main([*given, "--cycle", str(other)]) == BAD_INPUT
        said = capsys.readouterr().err
        assert f"learn_policy: warning: {other}: line 5: is 60 s after the one before" in said
        assert "learn_policy: warning: a tunnel\n" in said

    @pytest.mark.parametrize(
        ("arguments", "said"),
        [
            (["--weights", "-0.1"], "--weights"),
            (["--bandwidths", "0"], "--bandwidths"),
            (["--weights", "nan"], "--weights"),
            (["--friction", "7"], "--friction"),
            (["--bag", "no_such_bag"], "no_such_bag"),
            (["--drive", "no_such_cycle"], "no_such_cycle"),
        ],
    )
    def test_bad_input_is_one_line_and_leaves_nothing(
        self, nycc_bag: Path, tmp_path: Path, capsys, arguments: list[str], said: str
    ) -> None:
        given = ["--vehicle", CAR, "--bag", str(nycc_bag), "--friction", "0.9", "--output", str(tmp_path / "p.npz")]
        assert learn.main([*given, *arguments]) == BAD_INPUT
        captured = capsys.readouterr()
        assert captured.out == "" and captured.err.startswith("learn_policy: error: ") and said in captured.err
        assert list(tmp_path.iterdir()) == []
