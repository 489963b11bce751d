# SPDX-License-Identifier: Apache-2.0
"""The price of a change that keeps a budget, against the chain simulated state by state."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from iwm_power_manager.control.budget import ELASTICITY
from iwm_power_manager.mdp.budget import Occupancy, Trial, elasticity_of, find_price
from iwm_power_manager.mdp.demand import Source, chain_of
from iwm_power_manager.mdp.policy_iteration import solve
from iwm_power_manager.mdp.problem import load_problem, price_matrix
from iwm_power_manager.mdp.sweep import corner_steps, flow
from iwm_power_manager.mdp.transitions import build_model
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml"), "none").params
PROBLEM = dataclasses.replace(
    load_problem(share_path("config/grids/coupled.yaml")).for_car(CAR),
    power_w=np.array([-8000.0, -2000.0, 0.0, 800.0, 2500.0, 5000.0, 9000.0, 14000.0]),
    speed_mps=np.array([0.0, 4.0, 9.0, 15.0, 25.0]),
    share=np.array([0.0, 0.25, 0.5, 1.0]),
    demand_by_speed=False,
)


@pytest.fixture(scope="module")
def model():
    rng = np.random.default_rng(4)
    walk = PROBLEM.power_w[np.clip(np.cumsum(rng.integers(-1, 2, 20_000)) % 14, 0, 7)]
    chain = chain_of(PROBLEM, [Source("walk", "", 1.0, (walk,))])
    return build_model(PROBLEM, CAR, 0.9, chain.matrix)


def test_a_distribution_moves_as_the_transitions_say(model):
    rng = np.random.default_rng(5)
    mass = rng.uniform(0.0, 1.0, model.state_shape)
    mass /= mass.sum()
    policy = rng.integers(0, 4, model.state_shape).astype(np.int16)
    wanted = np.zeros_like(mass)
    step = corner_steps(model.cell_shape)[0]
    for p, s, c in np.ndindex(*mass.shape):
        u = policy[p, s, c]
        first, n = model.free_start[p], model.free_start[p + 1] - model.free_start[p]
        i = first * 4 + u * n + np.searchsorted(model.free_cell[first : first + n], c)
        fast = model.free_fraction[i, 0]
        for q in range(mass.shape[0]):
            moved = mass[p, s, c] * model.demand[0, p, q]
            wanted[q, u, model.free_corner[i]] += moved * (1.0 - fast)
            wanted[q, u, model.free_corner[i] + step] += moved * fast
    out, scratch = np.empty_like(mass), np.empty_like(mass)
    flow(model, policy, mass, scratch, out)
    assert out == pytest.approx(wanted, abs=1e-15)
    assert out.sum() == pytest.approx(1.0)


def test_the_price_found_keeps_the_budget_and_a_smaller_budget_is_dearer(model):
    found = {rate: find_price(model, PROBLEM.share, PROBLEM.dt_s, rate, 0.5) for rate in (2.0, 6.0)}
    assert found[2.0].price_j > found[6.0].price_j > 0.0
    for rate, result in found.items():
        trial = result.trials[-1]
        assert trial.price_j == result.price_j
        # The rate is a step function of the price: near the budget, or the price is pinned down to a percent.
        below = [t.price_j for t in result.trials if t.changes_per_min > rate]
        above = [t.price_j for t in result.trials if t.changes_per_min <= rate]
        assert trial.changes_per_min == pytest.approx(rate, rel=0.031) or min(above) / max(below) < 1.02


@pytest.mark.parametrize("elasticity", [0.12, 0.3, 0.9])
@pytest.mark.parametrize("dearest", [2.0, 3.0, 12.0])
def test_what_prices_do_to_the_changes_is_told_by_those_that_were_tried(elasticity, dearest):
    def trial(times):
        return Trial(20.0 * times, 8.0 * (1.0 - elasticity * np.log(times)))

    tried = [trial(dearest), trial(0.25), trial(1.0), Trial(400.0, 0.0)][: 4 if dearest > 3.0 else 3]
    assert elasticity_of(tried, 20.0, 8.0) == pytest.approx(elasticity)
    # What lies beyond the first of the dearer prices does not count.
    beyond = [trial(1.0), trial(3.0), Trial(61.0, 0.0)]
    assert elasticity_of(beyond, 20.0, 8.0) == pytest.approx(elasticity)


def test_where_no_dearer_price_was_tried_or_the_rate_jumps_the_elasticity_stays_a_sane_number():
    assert elasticity_of([], 20.0, 8.0) == ELASTICITY
    assert elasticity_of([Trial(20.0, 8.0), Trial(5.0, 12.0)], 20.0, 8.0) == ELASTICITY
    assert elasticity_of([Trial(20.0, 8.0), Trial(80.0, 1.0)], 20.0, 0.0) == ELASTICITY
    assert elasticity_of([Trial(20.0, 8.0), Trial(80.0, 8.0)], 20.0, 8.0) == 0.1
    assert elasticity_of([Trial(20.0, 8.0), Trial(20.2, 1.0)], 20.0, 8.0) == 1.0


def test_the_rate_is_that_of_a_simulated_drive(model):
    solution = solve(model._replace(switching_j=30.0 * price_matrix(PROBLEM.share)), PROBLEM.share, 0.5)
    occupancy = Occupancy(model, PROBLEM.dt_s, PROBLEM.share)
    occupancy.settle(solution.policy)
    rng = np.random.default_rng(6)
    p, s, c, changes, steps = 3, 2, 2, 0.0, 60_000
    step = corner_steps(model.cell_shape)[0]
    for _ in range(steps):
        u = solution.policy[p, s, c]
        first, n = model.free_start[p], model.free_start[p + 1] - model.free_start[p]
        i = first * 4 + u * n + np.searchsorted(model.free_cell[first : first + n], c)
        changes += min(abs(PROBLEM.share[u] - PROBLEM.share[s]) / 0.25, 1.0)
        c = model.free_corner[i] + step * (rng.random() < model.free_fraction[i, 0])
        p, s = rng.choice(model.demand.shape[1], p=model.demand[0, p]), u
    simulated = changes / (steps * PROBLEM.dt_s / 60.0)
    assert occupancy.changes_per_min(solution.policy) == pytest.approx(simulated, rel=0.1)
