# SPDX-License-Identifier: Apache-2.0
"""Short cycles and a small problem, so that a case takes a blink; `conftest.py` where they are used imports them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from iwm_power_manager.mdp.demand import DemandChain

VEHICLE = "jalalmaab_2015"
#: Two demands, 0 and 1 kW.
CHAIN = DemandChain(np.array([0.0, 1e3]), np.array([[0.9, 0.1], [0.0, 1.0]]), np.zeros((0, 2, 2)), np.full(2, 1e3), 0.0)

#: A coarse problem that solves at once.
SMALL_GRID = """
format: 1
power_w: {from: -12000, to: 18000, step: 6000}
speed_mps: [0, 5, 10, 25]
slip_front: [0]
slip_rear: [0]
share: [0, 0.5, 1]
previous_share: true
dt_s: 0.1
discount: 0.9
alpha: 20
power_error: road
error_norm: absolute
slip_model: quasi_steady
skid_avoidance: none
switching_fixed_cost_j: 20
tolerance_j: 1.0
"""


@pytest.fixture(scope="session")
def hill(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Half a minute from rest to 10 m/s and back."""
    path = tmp_path_factory.mktemp("cycles") / "hill.csv"
    rows = [f"{t},{10.0 * math.sin(math.pi * t / 30.0) ** 2:.5f}" for t in range(31)]
    path.write_text("time_s,speed_mps\n" + "\n".join(rows) + "\n")
    return path


@pytest.fixture(scope="session")
def small_grid(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("grids") / "small.yaml"
    path.write_text(SMALL_GRID)
    return path


@pytest.fixture(scope="session")
def small_policy(tmp_path_factory: pytest.TempPathFactory, small_grid: Path, hill: Path) -> Path:
    """A policy for the paper's car with idle drive none, friction 0.9."""
    from iwm_power_manager.tools import solve_policy

    path = tmp_path_factory.mktemp("policies") / "small.npz"
    arguments = ["--vehicle", VEHICLE, "--idle-drive", "none", "--cycle", str(hill), "--grid", str(small_grid)]
    assert solve_policy.main([*arguments, "--friction", "0.9", "--output", str(path), "--quiet"]) == 0
    return path
