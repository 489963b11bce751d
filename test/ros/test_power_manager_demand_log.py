# SPDX-License-Identifier: Apache-2.0
"""The power manager counts the driver's demand for the next policy, over DDS."""

from __future__ import annotations

import signal
from pathlib import Path

import numpy as np
import pytest

from iwm_power_manager.mdp.demand import count_steps
from iwm_power_manager.mdp.demand_counts import DemandTransitions, load_transitions, save_transitions
from iwm_power_manager.mdp.problem import load_problem
from iwm_power_manager.share import share_path

PERIOD_NS = 10_000_000
#: Sets of inputs in a decision step of the policies.
SETS = round(load_problem(share_path("config/grids/coupled.yaml")).dt_s * 1e9 / PERIOD_NS)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("log")


@pytest.fixture(scope="module")
def lockstep(start_pair, folder):
    return start_pair({"autostart": False, "lockstep": True, "demand_log": folder / "demand.npz"})


def demands(count: int) -> np.ndarray:
    return np.random.default_rng(5).uniform(-9000.0, 12000.0, count)


def drive(bench, demand_w: np.ndarray, first_ns: int) -> None:
    """The sets of inputs of a decision step for each demand, each set answered before the next is sent."""
    for k, power in enumerate(np.repeat(demand_w, SETS)):
        bench.answer_to(bench.send(demand=float(power), stamp_ns=first_ns + k * PERIOD_NS))


def test_each_transition_of_a_drive_is_in_the_file_after_deactivation_and_the_next_goes_on(lockstep, folder) -> None:
    bench, path = lockstep.bench, folder / "demand.npz"
    assert bench.change_state("configure")
    assert bench.change_state("activate")
    bench.connect()
    drive(bench, demands(30), 10**9)
    assert not path.exists()
    assert bench.change_state("deactivate")
    first = load_transitions(path)
    wanted = count_steps(first.power_w, demands(30))
    assert np.array_equal(first.counts.sum(axis=0), wanted)
    assert first.counts.sum(axis=(1, 2))[np.argmin(np.abs(first.speed_mps - 10.0))] == 29  # the bench's speed
    assert bench.change_state("activate")
    drive(bench, demands(10), 10**10)
    assert bench.change_state("deactivate")
    assert bench.change_state("cleanup")
    assert load_transitions(path).total == 29 + 9
    assert bench.change_state("configure")  # reads the file
    start = len(bench.diagnostics)
    bench.spin_until(lambda: len(bench.diagnostics) > start and bench.status("demand log"), "a report")
    assert {value.key: value.value for value in bench.status("demand log").values}["transitions"] == "38"
    assert bench.change_state("activate")
    drive(bench, demands(5), 10**11)
    assert bench.change_state("deactivate")
    assert load_transitions(path).total == 38 + 4
    assert bench.change_state("cleanup")


def test_a_file_that_cannot_be_gone_on_from_refuses_to_configure_and_stays_as_it_is(lockstep, folder) -> None:
    bench, path = lockstep.bench, folder / "demand.npz"
    foreign = DemandTransitions(np.array([0.0, 1.0]), np.array([0.0]), 0.1, np.ones((1, 2, 2), dtype=np.int64), 0)
    save_transitions(foreign, path)
    content = path.read_bytes()
    assert not bench.change_state("configure")
    assert f"{path}: was counted on the axes of another policy; choose another file" in lockstep.running.text()
    path.write_bytes(b"nothing")
    assert not bench.change_state("configure")
    assert f"{path}: is no file of demand transitions" in lockstep.running.text()
    assert path.read_bytes() == b"nothing"
    path.write_bytes(content)
    assert bench.set_parameter("demand_log", str(folder / "none" / "demand.npz")) == ""
    assert not bench.change_state("configure")
    assert (
        f"parameter demand_log: {folder / 'none' / 'demand.npz'}: is in a folder that does not exist"
        in lockstep.running.text()
    )


def test_a_file_that_can_no_longer_be_written_is_reported_and_never_in_the_way(lockstep, folder) -> None:
    bench = lockstep.bench
    gone = folder / "gone"
    gone.mkdir()
    assert bench.set_parameter("demand_log", str(gone / "demand.npz")) == ""
    assert bench.change_state("configure")
    assert bench.change_state("activate")
    bench.connect()
    gone.rmdir()
    drive(bench, demands(3), 10**12)
    assert bench.change_state("deactivate")
    start = len(bench.diagnostics)
    bench.spin_until(lambda: len(bench.diagnostics) > start + 1, "a report")
    status = bench.status("demand log")
    assert status.level == b"\x01"
    assert status.message == (f"{gone / 'demand.npz'}: cannot be written: No such file or directory")
    assert bench.change_state("cleanup")


def test_while_driving_the_file_is_written_now_and_then_and_once_more_at_the_end(start_pair, tmp_path: Path) -> None:
    path = tmp_path / "demand.npz"
    pair = start_pair({"demand_log": path, "demand_log_period_s": 1.0})
    pair.bench.connect()
    pair.bench.drive(lambda: path.exists() and load_transitions(path).total >= 3, "three transitions in the file")
    during = load_transitions(path).total
    pair.bench.drive(lambda: pair.bench.mode() == 1, "normal driving")
    assert pair.running.stop(signal.SIGINT) == 0
    assert load_transitions(path).total >= during
