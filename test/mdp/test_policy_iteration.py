# SPDX-License-Identifier: Apache-2.0
"""The structure-aware solver against two that know nothing of the structure, and its bound against the truth."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iwm_power_manager.mdp import policy_iteration as solver
from iwm_power_manager.mdp.policy_iteration import certified_bound, solve
from iwm_power_manager.mdp.sweep import GATED, TIE_J, dot
from oracles.dense_mdp import dense, pack, policy_iteration, random_raw


def _share(controls):
    return np.linspace(0.0, 1.0, controls)


def _small(seed, tracked, discount=0.97, cell_shape=(3, 3, 2), powers=4, controls=4):
    return random_raw(np.random.default_rng(seed), powers, cell_shape, controls, tracked, discount)


def _assert_optimal(raw, solution, tolerance):
    cost, probability = dense(raw)
    value, _ = policy_iteration(cost, probability, raw.discount)
    error = np.max(np.abs(solution.cost_j.ravel() - value))
    assert solution.converged
    assert solution.bound_j <= tolerance
    assert error <= solution.bound_j + 1e-9 * np.max(np.abs(value))
    # The chosen action is optimal: within what the bound and the tie rule leave open.
    action_value = cost + raw.discount * probability @ value
    chosen = solution.policy.ravel()
    gated = np.repeat(raw.gated[:, None, :], raw.switching.shape[0], axis=1).ravel()
    assert np.array_equal(chosen == GATED, gated)
    rows = np.flatnonzero(~gated)
    loss = action_value[rows, chosen[rows]] - action_value[rows].min(axis=1)
    assert np.max(loss, initial=0.0) <= 2.0 * solution.bound_j + TIE_J + 1e-9
    # Where the best action is clearly the best, it is the same action.
    ordered = np.sort(action_value[rows], axis=1)
    clear = ordered[:, 1] - ordered[:, 0] > 4.0 * solution.bound_j + 2.0 * TIE_J
    assert np.array_equal(chosen[rows][clear], np.argmin(action_value[rows], axis=1)[clear])


@pytest.mark.parametrize("tracked", [False, True])
@pytest.mark.parametrize("cell_shape", [(3, 3, 2), (4, 1, 1), (1, 1, 3), (1, 1, 1), (1, 3, 2)])
def test_it_finds_the_optimum_of_a_dense_solver(tracked, cell_shape):
    raw = _small(7, tracked, cell_shape=cell_shape)
    _assert_optimal(raw, solve(pack(raw), _share(4), 1e-6), 1e-6)


@pytest.mark.parametrize("tracked", [False, True])
def test_it_agrees_with_quantecon(tracked):
    markov = pytest.importorskip("quantecon.markov")
    raw = _small(11, tracked)
    cost, probability = dense(raw)
    ddp = markov.DiscreteDP(-cost, probability, raw.discount)
    theirs = ddp.solve(method="policy_iteration")
    ours = solve(pack(raw), _share(4), 1e-6)
    assert np.max(np.abs(ours.cost_j.ravel() + theirs.v)) <= ours.bound_j + 1e-9 * np.max(np.abs(theirs.v))
    free = ours.policy.ravel() != GATED
    assert np.array_equal(ours.policy.ravel()[free], theirs.sigma[free])


@settings(max_examples=25)
@given(
    seed=st.integers(0, 10_000),
    powers=st.integers(1, 4),
    cell_shape=st.tuples(st.integers(1, 3), st.integers(1, 3), st.integers(1, 3)),
    controls=st.integers(2, 4),
    tracked=st.booleans(),
    discount=st.sampled_from([0.0, 0.5, 0.9, 0.99, 0.998]),
)
def test_it_is_optimal_for_any_small_problem(seed, powers, cell_shape, controls, tracked, discount):
    raw = random_raw(np.random.default_rng(seed), powers, cell_shape, controls, tracked, discount)
    _assert_optimal(raw, solve(pack(raw), _share(controls), 1e-5), 1e-5)


def test_the_certified_bound_holds_after_every_policy():
    raw = _small(3, tracked=True, discount=0.99)
    value, _ = policy_iteration(*dense(raw), raw.discount)
    for count in range(1, 8):
        solution = solve(pack(raw), _share(4), 1e-9, max_iterations=count)
        assert np.max(np.abs(solution.cost_j.ravel() - value)) <= solution.bound_j * (1 + 1e-9) + 1e-8
        assert solution.iterations[-1].bound_j == solution.bound_j


def test_it_says_when_it_was_stopped_before_the_bound():
    raw = _small(3, tracked=True, discount=0.99)
    solution = solve(pack(raw), _share(4), 1e-6, max_iterations=1)
    assert not solution.converged
    assert solution.bound_j > 1e-6


def test_a_bound_beyond_the_arithmetic_ends_without_a_claim():
    raw = _small(5, tracked=False, discount=0.998)
    solution = solve(pack(raw), _share(4), 1e-14)
    assert not solution.converged
    assert solution.bound_j < 1e-4


def test_the_bound_is_that_of_a_known_process():
    # One state, cost 5 a step: J = 5 / (1 - gamma). From J = 0, T J - J = 5, and the bounds meet at once.
    shift, bound = certified_bound(0.9, np.array([5.0]))
    assert 5.0 + shift == pytest.approx(50.0)
    assert bound == 0.0


def test_controls_that_are_equally_good_do_not_make_the_share_move():
    raw = _small(1, tracked=True)
    raw.cost[...] = raw.cost[:, :, :1]
    raw.corner[...] = raw.corner[:, :, :1]
    raw.fraction[...] = raw.fraction[:, :, :1]
    raw.switching[...] = 0.0
    raw.gated[...] = False
    solution = solve(pack(raw), _share(4), 1e-6)
    assert np.array_equal(solution.policy, np.broadcast_to(np.arange(4)[None, :, None], solution.policy.shape))


def test_equally_good_controls_without_a_previous_share_prefer_the_front_axle():
    raw = _small(1, tracked=False)
    raw.cost[...] = raw.cost[:, :, :1]
    raw.corner[...] = raw.corner[:, :, :1]
    raw.fraction[...] = raw.fraction[:, :, :1]
    raw.gated[...] = False
    assert np.all(solve(pack(raw), _share(4), 1e-6).policy == 3)


def test_a_gated_state_keeps_the_previous_share_and_pays_no_switching():
    raw = _small(2, tracked=True)
    raw.gated[...] = True
    solution = solve(pack(raw), _share(4), 1e-6)
    _assert_optimal(raw, solution, 1e-6)
    assert np.ptp(solution.cost_j, axis=1) == pytest.approx(0.0, abs=1e-5)


def test_the_result_does_not_depend_on_the_number_of_threads(monkeypatch):
    raw = _small(9, tracked=True, cell_shape=(4, 3, 3), powers=9)
    first = solve(pack(raw), _share(4), 1e-6)

    def backwards(size, numbers, function):
        for place in reversed(range(size)):
            function(place, place + 1)

    monkeypatch.setattr(solver, "over_ranges", backwards)
    second = solve(pack(raw), _share(4), 1e-6)
    assert np.array_equal(first.cost_j, second.cost_j)
    assert np.array_equal(first.policy, second.policy)
    assert first.iterations == second.iterations


def test_the_history_counts_what_changed_from_policy_to_policy():
    raw = _small(4, tracked=False)
    seen = []
    solution = solve(pack(raw), _share(4), 1e-6, progress=seen.append)
    assert tuple(seen) == solution.iterations
    assert [i.number for i in seen] == list(range(1, len(seen) + 1))
    assert seen[-1].changed_states == 0
    assert all((i.changed_states == 0) == (i.policy_change == 0.0) for i in seen)
    assert np.all(np.diff([i.evaluation_sweeps for i in seen]) > 0)


@given(st.integers(0, 5000), st.integers(0, 1000))
@settings(max_examples=20)
def test_dot_sums_every_element_once(size, seed):
    a, b = np.random.default_rng(seed).normal(size=(2, size))
    assert dot(a, b) == pytest.approx(np.dot(a, b), abs=1e-9)
