# SPDX-License-Identifier: Apache-2.0
"""Preview: the cheapest path against every path, the schedule against the table it is read from, the rule's lines."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle
from iwm_sim.metrics import share_changes
from iwm_sim.preview import cheapest_path, cheapest_schedule, cheapest_within, fit_rule, step_costs
from oracles.splits import MISSING_PRICE, split_w

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml"), "none").params


def path_cost(path, cost, share, switching, fixed):
    total = sum(cost[k, u] for k, u in enumerate(path))
    for a, b in itertools.pairwise(path):
        total += switching * abs(share[a] - share[b]) + fixed * (a != b)
    return total


@settings(max_examples=60)
@given(
    st.integers(0, 10_000),
    st.integers(1, 5),
    st.integers(1, 4),
    st.sampled_from([0.0, 1.0, 30.0]),
    st.sampled_from([0.0, 2.0]),
)
def test_no_path_is_cheaper_than_the_one_found(seed, steps, shares, switching, fixed):
    rng = np.random.default_rng(seed)
    cost, share = rng.uniform(0.0, 10.0, (steps, shares)), np.linspace(0.0, 1.0, shares)
    path = np.empty(steps, np.int64)
    cheapest_path(cost, share, switching, fixed, path)
    best = min(path_cost(p, cost, share, switching, fixed) for p in itertools.product(range(shares), repeat=steps))
    assert path_cost(path, cost, share, switching, fixed) == pytest.approx(best)


def test_a_dear_change_is_not_made_and_a_free_one_is():
    cost, share, path = np.array([[0.0, 1.0], [1.0, 0.0], [0.0, 1.0]]), np.array([0.0, 1.0]), np.empty(3, np.int64)
    cheapest_path(cost, share, 0.0, 0.0, path)
    assert path.tolist() == [0, 1, 0]
    cheapest_path(cost, share, 5.0, 0.0, path)
    assert path.tolist() == [0, 0, 0]
    cheapest_path(cost, share, 0.0, 5.0, path)
    assert path.tolist() == [0, 0, 0]


POWER = np.array([0.0, 2000.0, 4000.0, 15000.0, -3000.0, -9000.0, 500.0])
SPEED = np.array([0.0, 2.0, 5.0, 15.0, 14.0, 12.0, 11.0])
SHARE = np.array([0.0, 0.25, 0.5, 1.0])


def decision_cost(first, last, dt, friction):
    """Each share's price over some control steps, what is missing included."""
    costs = []
    for share in SHARE:
        total = 0.0
        for p, v in zip(POWER[first:last], SPEED[first:last], strict=True):
            rolling = max(v, CAR.driver.power_speed_floor_mps)
            power, missing = split_w(p / rolling, rolling, share, friction, True, CAR)
            total += (power + MISSING_PRICE * missing * rolling) * dt
        costs.append(total)
    return np.array(costs)


@pytest.mark.parametrize("friction", [0.9, 0.2])
def test_without_switching_costs_each_decision_is_the_cheapest_of_its_steps(friction):
    chosen = schedule(POWER, SPEED, 0.1, 0.2, CAR, friction, SHARE)
    assert len(chosen) == 4  # 7 steps of 0.1 s, two to a decision, the last one alone
    for k, share in enumerate(chosen):
        costs = decision_cost(2 * k, min(2 * k + 2, 7), 0.1, friction)
        assert costs[list(SHARE).index(share)] == pytest.approx(costs.min(), rel=1e-6, abs=1e-3)


def schedule(power_w, speed_mps, dt_s, period_s, vehicle, friction, share, **prices):
    cost = step_costs(power_w, speed_mps, dt_s, period_s, vehicle, friction, share)
    return cheapest_schedule(cost, share, **prices)


def test_a_number_of_changes_is_kept_and_more_of_them_never_cost_more():
    cost = step_costs(POWER, SPEED, 0.1, 0.1, CAR, 0.9, SHARE)

    def total(chosen):
        return sum(cost[k, np.flatnonzero(u == SHARE)[0]] for k, u in enumerate(chosen))

    free = share_changes(cheapest_schedule(cost, SHARE))
    assert free == 3
    found = [cheapest_within(cost, SHARE, most) for most in (0, 2, free)]
    assert [share_changes(chosen) <= most for chosen, most in zip(found, (0, 2, free), strict=True)] == [True] * 3
    assert total(found[0]) >= total(found[1]) > total(found[2])


def test_switching_costs_hold_the_share():
    assert len(set(schedule(POWER, SPEED, 0.1, 0.1, CAR, 0.9, SHARE).tolist())) > 1
    assert len(set(schedule(POWER, SPEED, 0.1, 0.1, CAR, 0.9, SHARE, switching_fixed_cost_j=1e6).tolist())) == 1
    assert len(set(schedule(POWER, SPEED, 0.1, 0.1, CAR, 0.9, SHARE, switching_cost_j=1e6).tolist())) == 1


def test_the_rule_s_lines_go_through_the_points():
    power = np.array([-8000.0, -4000.0, -1000.0, -150.0, 0.0, 150.0, 1000.0, 5000.0, 9000.0])
    front = np.where(power > 0, 300.0 + 0.4 * power, -100.0 + 0.8 * power)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(power == 0.0, 0.5, front / power)
    assert fit_rule(power, share) == pytest.approx([300.0, 0.4, -100.0, 0.8])


def test_small_demands_do_not_bend_the_lines_and_without_points_it_is_equal_split():
    power = np.array([199.0, 1000.0, 5000.0, -199.0, -1000.0])
    share = np.array([9.0, 0.5, 0.5, 9.0, 0.3])
    assert fit_rule(power, share) == pytest.approx([0.0, 0.5, 0.0, 0.5], abs=1e-9)
