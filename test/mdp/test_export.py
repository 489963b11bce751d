# SPDX-License-Identifier: Apache-2.0
"""The exported problem is the solved one: another solver finds the same optimum in it."""

from __future__ import annotations

import numpy as np
import pytest

from iwm_power_manager.errors import ConfigError
from iwm_power_manager.mdp.export import NO_CHOICE, export_mdp
from iwm_power_manager.mdp.policy_iteration import solve
from oracles.dense_mdp import dense, pack, random_raw


def state_action_pairs(file):
    """State, action, cost and dense successor probabilities of every pair, by the form that docs/solver.md gives."""
    data = dict(np.load(file))
    shares = data["switching_j"].shape[0]
    groups, powers, _ = data["demand"].shape
    cells = int(np.prod(data["cell_shape"]))
    plane = int(np.prod(data["cell_shape"][1:]))
    states, actions, costs, rows = [], [], [], []
    for p, c, u, cost, successor, weight in zip(
        *(data[name] for name in ("power", "cell", "control", "cost_j", "successor", "weight")), strict=True
    ):
        if not np.isfinite(cost):
            continue
        for s in range(shares):
            after = s if u == NO_CHOICE or shares == 1 else u
            row = np.zeros((powers, shares, cells))
            for k, w in zip(successor, weight, strict=True):
                row[:, after, k] += w * data["demand"][k // plane if groups > 1 else 0, p]
            states.append((p * shares + s) * cells + c)
            actions.append(max(u, 0))
            costs.append(cost + (0.0 if u == NO_CHOICE else data["switching_j"][s, u]))
            rows.append(row.ravel())
    return np.array(states), np.array(actions), np.array(costs), np.array(rows), float(data["discount"])


@pytest.mark.parametrize("tracked", [False, True])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_quantecon_finds_the_same_cost_to_go_in_the_exported_problem(tracked, seed, tmp_path) -> None:
    markov = pytest.importorskip("quantecon.markov")
    model = pack(random_raw(np.random.default_rng(seed), 3, (3, 2, 2), 3, tracked, 0.9))
    export_mdp(model, tmp_path / "mdp.npz")
    states, actions, costs, rows, discount = state_action_pairs(tmp_path / "mdp.npz")
    theirs = markov.DiscreteDP(-costs, rows, discount, states, actions).solve(method="policy_iteration")
    ours = solve(model, np.linspace(0.0, 1.0, 3), 1e-6)
    assert np.max(np.abs(ours.cost_j.ravel() + theirs.v)) <= ours.bound_j + 1e-9 * np.max(np.abs(theirs.v))


def test_every_pair_and_probability_is_there(tmp_path) -> None:
    raw = random_raw(np.random.default_rng(5), 3, (3, 1, 2), 3, True, 0.9)
    export_mdp(pack(raw), tmp_path / "mdp.npz")
    states, actions, costs, rows, _ = state_action_pairs(tmp_path / "mdp.npz")
    cost, probability = dense(raw)
    assert len(states) == np.count_nonzero(np.isfinite(cost))
    assert np.array_equal(costs, cost[states, actions])
    assert np.allclose(rows, probability[states, actions], rtol=0.0, atol=1e-15)


def test_a_folder_that_is_not_there_is_one_clear_line(tmp_path) -> None:
    model = pack(random_raw(np.random.default_rng(5), 2, (2, 1, 1), 2, True, 0.9))
    with pytest.raises(ConfigError):
        export_mdp(model, tmp_path / "nowhere" / "mdp.npz")
