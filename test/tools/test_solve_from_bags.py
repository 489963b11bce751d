# SPDX-License-Identifier: Apache-2.0
"""Learning from recorded driving, on real bags: what was driven is what is learned, and it is worth learning."""

from __future__ import annotations

import numpy as np
import pytest

from bags_helpers import write_drive
from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.control.table import empty_table
from iwm_power_manager.cycle import load_cycle
from iwm_power_manager.mdp.demand_counts import DemandCounter, save_transitions
from iwm_power_manager.mdp.problem import load_problem
from iwm_power_manager.policy import load_policy
from iwm_power_manager.share import share_path
from iwm_power_manager.tools import solve_policy
from iwm_power_manager.vehicle import load_vehicle
from iwm_sim import closed_loop

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml"), "none")
NYCC = load_cycle(share_path("config/cycles/nycc.csv"))

# Settled slip: small, and its policies drive well enough to be compared.
GRID = """\
format: 1
power_w: {from: -12000, to: 19000, step: 1000}
speed_mps: {from: 0, to: 28, step: 2}
slip_front: [0]
slip_rear: [0]
share: {from: 0, to: 1, step: 0.1}
previous_share: true
slip_model: quasi_steady
dt_s: 0.1
discount: 0.98
alpha: 5.0
switching_cost_j: 20
"""


@pytest.fixture(scope="module")
def drive():
    """NYCC, driven with equal split."""
    return closed_loop.run(NYCC, CAR, default_settings("equal"), empty_table(), 0.9)


@pytest.fixture(scope="module")
def bag(drive, tmp_path_factory):
    """Its speed and demand, as the recorder writes them."""
    path = tmp_path_factory.mktemp("bags") / "nycc_drive"
    write_drive(path, drive["speed_mps"], drive["power_demand_w"])
    return path


@pytest.fixture(scope="module")
def grid(tmp_path_factory):
    path = tmp_path_factory.mktemp("grid") / "settled.yaml"
    path.write_text(GRID)
    return path


def _solve(output, grid, *sources):
    arguments = [
        "--vehicle",
        "jalalmaab_2015",
        "--idle-drive",
        "none",
        "--grid",
        grid,
        "--friction",
        0.9,
        "--output",
        output,
    ]
    assert solve_policy.main([str(a) for a in [*arguments, *sources, "--quiet"]]) == 0
    return load_policy(output)


def test_the_matrix_is_counted_from_every_step_that_was_driven(drive, bag, grid, tmp_path):
    policy = _solve(tmp_path / "bag.npz", grid, "--bag", bag)
    demand = drive["power_demand_w"][::10]
    bins = np.clip(np.round(demand / 1000.0), -12, 19).astype(int) + 12
    counts = np.zeros((32, 32))
    np.add.at(counts, (bins[:-1], bins[1:]), 1.0)
    assert policy.chain.row_steps == pytest.approx(counts.sum(axis=1), abs=2.0)
    rows = counts.sum(axis=1) > 50
    expected = counts[rows] / counts[rows].sum(axis=1, keepdims=True)
    assert policy.chain.probability[rows] == pytest.approx(expected, abs=0.02)
    assert policy.sources[0]["name"] == "nycc_drive"


def test_what_was_counted_while_driving_teaches_what_the_bag_does(drive, bag, grid, tmp_path):
    problem = load_problem(grid)
    counter = DemandCounter(problem.power_w, problem.speed_mps, problem.dt_s)
    for i, (speed, demand) in enumerate(zip(drive["speed_mps"], drive["power_demand_w"], strict=True)):
        counter.add((i + 1) * 10_000_000, float(speed), float(demand))
    save_transitions(counter.transitions(), tmp_path / "demand.npz")
    counted = _solve(tmp_path / "counted.npz", grid, "--transitions", tmp_path / "demand.npz")
    learned = _solve(tmp_path / "bag.npz", grid, "--bag", bag)
    assert counted.sources[0]["name"] == "demand.npz"
    assert counted.chain.row_steps == pytest.approx(learned.chain.row_steps, abs=1.0)
    assert counted.front_share == pytest.approx(learned.front_share, abs=0.2)
    assert np.mean(counted.front_share != learned.front_share) < 0.01
    mixed = _solve(
        tmp_path / "mixed.npz", grid, "--cycle", "nycc", "--bag-weight", 3, "--transitions", tmp_path / "demand.npz"
    )
    assert [source["weight"] for source in mixed.sources] == [1.0, 3.0]


def test_what_nycc_taught_drives_nycc_no_worse_than_what_three_cycles_taught(bag, grid, tmp_path):
    def energy_j_per_m(policy):
        run = closed_loop.run(NYCC, CAR, default_settings("sdp_lookahead"), policy.table(), 0.9)
        return run["chemical_j"][-1] / run["distance_m"][-1]

    cycles = [argument for name in ("ftp75", "hwfet", "nycc") for argument in ("--cycle", name)]
    learned = energy_j_per_m(_solve(tmp_path / "bag.npz", grid, "--bag", bag))
    general = energy_j_per_m(_solve(tmp_path / "cycles.npz", grid, *cycles))
    equal = closed_loop.run(NYCC, CAR, default_settings("equal"), empty_table(), 0.9)
    # Both split better than equal; which of them is ahead is a matter of a hundredth of a percent.
    assert learned <= general * 1.0005
    assert max(learned, general) < equal["chemical_j"][-1] / equal["distance_m"][-1]
