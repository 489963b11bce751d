# SPDX-License-Identifier: Apache-2.0
"""The certificates themselves: they accept what is right and notice what is not."""

from __future__ import annotations

import numpy as np

from iwm_power_manager.mdp.certify import bellman_bound
from iwm_power_manager.mdp.policy_iteration import solve
from oracles.dense_mdp import dense, pack, policy_iteration, random_raw
from oracles.driven_policy import simulated_cost


def _problem(tracked=True, discount=0.9):
    raw = random_raw(np.random.default_rng(21), 4, (3, 2, 3), 3, tracked, discount)
    return raw, pack(raw)


def test_the_bellman_residual_bounds_the_error_of_any_cost_to_go():
    raw, model = _problem()
    value, _ = policy_iteration(*dense(raw), raw.discount)
    exact = value.reshape(model.state_shape)
    rng = np.random.default_rng(0)
    for size in (0.0, 1e-3, 10.0):
        wrong = exact + size * rng.normal(size=exact.shape)
        error = np.max(np.abs(wrong - exact))
        assert error <= bellman_bound(model, wrong) * (1 + 1e-9) + 1e-9
        assert bellman_bound(model, wrong) <= error * (1 + raw.discount) / (1 - raw.discount) + 1e-9


def test_driving_the_policy_costs_what_the_cost_to_go_says():
    for tracked in (False, True):
        _, model = _problem(tracked)
        solution = solve(model, np.linspace(0.0, 1.0, 3), 1e-6)
        for state in ((0, 0, 0), (3, model.state_shape[1] - 1, 17), (1, 0, 8)):
            mean, error = simulated_cost(model, solution.policy, state, steps=200, runs=4000, seed=1)
            assert abs(mean - solution.cost_j[state]) < 4.0 * error
            assert error < 0.1 * np.std(solution.cost_j)


def test_driving_notices_a_policy_that_is_not_the_one_that_was_evaluated():
    _, model = _problem()
    solution = solve(model, np.linspace(0.0, 1.0, 3), 1e-6)
    worse = np.where(solution.policy >= 0, 0, solution.policy).astype(np.int16)
    mean, error = simulated_cost(model, worse, (0, 1, 0), steps=200, runs=4000)
    assert mean - solution.cost_j[0, 1, 0] > 10.0 * error
