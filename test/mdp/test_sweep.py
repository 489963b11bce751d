# SPDX-License-Identifier: Apache-2.0
"""One sweep over a problem without any physics, against every transition probability written into one dense matrix."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iwm_power_manager.mdp.sweep import GATED, TIE_J, apply_policy, expect_over_demand, flow, improve
from oracles.dense_mdp import dense, pack, random_raw

_ONE = st.just(1)
PROBLEMS = given(
    rng=st.integers(0, 10_000).map(np.random.default_rng),
    powers=st.integers(1, 6),
    # Without slip a cell is a speed alone.
    cell_shape=st.tuples(st.integers(1, 3), st.integers(1, 3), st.integers(1, 3))
    | st.tuples(st.integers(2, 4), _ONE, _ONE),
    controls=st.integers(2, 4),
    tracked=st.booleans(),
)


class Problem:
    """A problem both ways, with a policy and a cost-to-go drawn for it."""

    def __init__(self, rng, powers, cell_shape, controls, tracked) -> None:
        self.raw = random_raw(rng, powers, cell_shape, controls, tracked, 0.9, infeasible=0.0)
        self.model = pack(self.raw)
        self.cost, self.probability = dense(self.raw)
        shape = self.model.state_shape
        self.gated = np.broadcast_to(self.raw.gated[:, None, :], shape)
        drawn = rng.integers(0, controls, shape).astype(np.int16)
        self.policy = np.where(self.gated, np.int16(GATED), drawn)
        self.to_go = rng.normal(size=shape) * 100.0
        self.mass = rng.random(shape)

    @property
    def actions(self):
        """Of each state, as the dense matrix counts them: a gated one has a single action."""
        return np.maximum(self.policy, 0).ravel()

    def ahead(self):
        """Expectation of the cost-to-go over the next demand."""
        cost = self.to_go.reshape(self.to_go.shape[0], -1)
        ahead = np.empty_like(cost)
        period = self.to_go.shape[2]
        plane = period // self.model.cell_shape[0]
        columns = cost.shape[1]
        for first, last in ((0, columns // 2), (columns // 2, columns)):
            expect_over_demand(self.model.demand, cost, period, plane, first, last, ahead)
        return ahead.reshape(self.to_go.shape)

    def values(self):
        """Of each state and action."""
        return self.cost + self.raw.discount * self.probability @ self.to_go.ravel()


@settings(max_examples=60)
@PROBLEMS
def test_an_expectation_is_summed_in_the_order_of_the_rows_to_the_bit(rng, powers, cell_shape, controls, tracked):
    problem = Problem(rng, 3 * powers, cell_shape, controls, tracked)
    for (p, s, c), found in np.ndenumerate(problem.ahead()):
        matrix = problem.model.demand[c // (cell_shape[1] * cell_shape[2]) if problem.model.demand.shape[0] > 1 else 0]
        total = 0.0
        for weight, cost in zip(matrix[p], problem.to_go[:, s, c], strict=True):
            total += weight * cost
        assert found == total


@settings(max_examples=60)
@PROBLEMS
def test_the_bellman_operator_is_the_smallest_of_all_actions_values(rng, powers, cell_shape, controls, tracked):
    problem = Problem(rng, powers, cell_shape, controls, tracked)
    out, policy = np.empty_like(problem.to_go), np.empty_like(problem.policy)
    improve(problem.model, problem.ahead(), 0, powers, out, policy)
    values = problem.values()
    assert out.ravel() == pytest.approx(values.min(axis=1), abs=1e-9)
    assert np.array_equal(policy == GATED, problem.gated)
    chosen = values[np.arange(values.shape[0]), np.maximum(policy, 0).ravel()]
    assert np.all(chosen <= values.min(axis=1) + 2.0 * TIE_J)


@settings(max_examples=60)
@PROBLEMS
def test_a_policy_costs_what_its_actions_cost(rng, powers, cell_shape, controls, tracked):
    problem = Problem(rng, powers, cell_shape, controls, tracked)
    states = np.arange(problem.cost.shape[0])
    for factor in (1.0, 0.0, 0.3):
        out = np.empty_like(problem.to_go)
        for first, last in ((0, powers // 2), (powers // 2, powers)):
            apply_policy(problem.model, problem.ahead(), problem.policy, factor, first, last, out)
        later = problem.probability[states, problem.actions] @ problem.to_go.ravel()
        wanted = factor * problem.cost[states, problem.actions] + problem.raw.discount * later
        assert out.ravel() == pytest.approx(wanted, abs=1e-9)


@settings(max_examples=60)
@PROBLEMS
def test_a_distribution_moves_as_the_transitions_say(rng, powers, cell_shape, controls, tracked):
    problem = Problem(rng, powers, cell_shape, controls, tracked)
    out, scratch = np.full_like(problem.mass, np.nan), np.full_like(problem.mass, np.nan)
    flow(problem.model, problem.policy, problem.mass, scratch, out)
    states = np.arange(problem.cost.shape[0])
    wanted = problem.mass.ravel() @ problem.probability[states, problem.actions]
    assert out.ravel() == pytest.approx(wanted, abs=1e-12)
