# SPDX-License-Identifier: Apache-2.0
"""Each strategy against plain Python that tries every share."""

from __future__ import annotations

import math
import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from iwm_power_manager.control import strategies
from iwm_power_manager.control.budget import Used
from iwm_power_manager.control.persistence import SAMPLES, no_jitter
from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.control.split import decide
from iwm_power_manager.control.strategies import STRATEGIES, instantaneous
from iwm_power_manager.control.strategy import Situation, Strategy
from iwm_power_manager.control.table import empty_table
from iwm_power_manager.model.decision import SLIP_DYNAMIC, step_cost_and_next
from iwm_power_manager.model.pedals import full_power_w
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle
from oracles import splits

CARS = [load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml"), name).params for name in ("none", "drag")]
CAR = CARS[1]
SHARES = [0.0, 0.25, 0.5, 0.75, 1.0]


def _solved(previous=(0.0, 0.5, 1.0)):
    """A table with every axis, filled at random: no optimum, but something to look up."""
    rng = np.random.default_rng(3)
    axes = {
        "power_w": np.array([-8000.0, -1000.0, 0.0, 4000.0, 15000.0]),
        "speed_mps": np.array([0.0, 5.0, 12.0, 25.0]),
        "slip_front": np.array([-1.0, -0.1, 0.0, 0.1]),
        "slip_rear": np.array([-0.5, 0.0, 0.5]),
        "previous_share": np.array(previous),
    }
    shape = tuple(map(len, axes.values()))
    return empty_table(SHARES, rule=(500.0, 0.3, -100.0, 0.8), schedule=(0.1, 0.9, 0.4))._replace(
        **axes,
        front_share=rng.uniform(0.0, 1.0, shape),
        expected_cost_j=rng.uniform(0.0, 300.0, shape),
        discount=0.6,
        switching_cost_j=20.0,
        switching_fixed_cost_j=5.0,
    )


TABLE = _solved()
ONE_SHARE = _solved((0.0,))
#: The same with a budget of changes, and what follows at dearer prices.
BUDGETED = TABLE._replace(
    changes_per_min=8.0,
    dearer_cost_j=np.stack([TABLE.expected_cost_j * 1.5, TABLE.expected_cost_j[::-1] * 2.0]),
    elasticity=0.2,
)
AXES = ("power_w", "speed_mps", "slip_front", "slip_rear", "previous_share")
POWER = st.one_of(st.floats(2.0, 30e3), st.floats(-40e3, -2.0))
SPEED = st.one_of(st.just(0.0), st.floats(0.0, 35.0))
SLIP = st.floats(-1.2, 0.9)
SHARE = st.one_of(st.sampled_from(SHARES), st.floats(0.01, 0.99))


def situation(power, speed=12.0, front=0.0, rear=0.0, previous=0.3, used=(0.0, 0.0), friction=0.9, decisions=0):
    return Situation(
        power_demand_w=power,
        speed_mps=speed,
        front_slip=front,
        rear_slip=rear,
        previous_share=previous,
        changes_used=Used(*used),
        jitter=no_jitter(),
        friction=friction,
        decisions=decisions,
    )


def rule_share(power, table):
    return STRATEGIES["rule"].choose(situation(power), default_settings("rule"), CAR, table)


def cheapest_share(power, speed, previous, friction, slip_aware, switching, car, table):
    at = situation(power, speed, previous=previous, friction=friction)
    return instantaneous.cheapest_share(at, slip_aware, switching, car, table)


def table_share(power, speed, front, rear, previous, table):
    at = situation(power, speed, front, rear, previous)
    return STRATEGIES["sdp"].choose(at, default_settings("sdp"), CAR, table)


def lookahead_share(power, speed, front, rear, previous, used, car, table):
    at = situation(power, speed, front, rear, previous, used)
    return STRATEGIES["sdp_lookahead"].choose(at, default_settings("sdp_lookahead"), car, table)


def within_rounding(costs, ours, slack):
    """Whether the share is as cheap as the cheapest, but for rounding."""
    return costs[ours] <= min(costs.values()) + slack


def it_changes_where_it_pays(worth_j, at, table, car=CAR):
    """The only other share there is, at a price a little below what the change is worth, and not a little above it."""
    previous, (other,) = at.previous_share, table.share
    pays = worth_j / splits.price_units(other - previous)
    assume(abs(pays) > 0.1)

    def share(price):
        chosen = table._replace(switching_cost_j=price)
        return STRATEGIES["sdp_lookahead"].choose(at, default_settings("sdp_lookahead"), car, chosen)

    assert share(max(pays * (1.0 + 1e-6), 0.0)) == previous
    assert share(max(pays * (1.0 - 1e-6), 0.0)) == (other if pays > 0.0 else previous)


@given(POWER)
def test_the_rule_is_one_line_for_driving_and_one_for_braking(power):
    assert rule_share(power, TABLE) == pytest.approx(splits.rule(power, TABLE.rule))


@pytest.mark.parametrize("power", [0.5, -0.5, 5000.0, -5000.0])
def test_a_rule_stays_within_0_and_1(power):
    backwards = TABLE._replace(rule=-TABLE.rule)
    assert rule_share(power, backwards) == pytest.approx(splits.rule(power, backwards.rule))
    assert rule_share(power, TABLE) == pytest.approx(splits.rule(power, TABLE.rule))


@settings(max_examples=60)
@given(
    POWER,
    SPEED,
    SHARE,
    st.sampled_from([0.9, 0.2]),
    st.booleans(),
    st.sampled_from([0.0, 100.0]),
    st.sampled_from(CARS),
)
def test_the_cheapest_share_is_the_cheapest_of_all(power, speed, previous, friction, slip_aware, switching, car):
    ours = cheapest_share(power, speed, previous, friction, slip_aware, switching, car, TABLE)
    _, costs = splits.cheapest(power, speed, previous, friction, slip_aware, switching, car, SHARES)
    assert ours in costs
    assert within_rounding(costs, ours, 0.05)


def test_a_change_has_to_save_the_switching_power():
    def shares(switching):
        return [
            cheapest_share(float(p), 12.0, 0.5, 0.9, True, switching, CARS[0], TABLE) for p in range(500, 8000, 500)
        ]

    assert set(shares(1e5)) == {0.5}
    assert len(set(shares(0.0))) > 1
    assert sum(s != 0.5 for s in shares(100.0)) < sum(s != 0.5 for s in shares(0.0))


def test_at_equal_cost_the_share_stays():
    # No loss, no drag: whatever the split, the power is the same.
    motor = CARS[0].front.motor._replace(
        loss_constant_w=0.0,
        loss_linear_speed=0.0,
        loss_quadratic_speed=0.0,
        loss_linear_torque=0.0,
        loss_quadratic_torque=0.0,
    )
    car = CARS[0].with_axles(motor=motor)
    assert cheapest_share(4000.0, 12.0, 0.37, 0.9, False, 0.0, car, TABLE) == 0.37
    assert decide(situation(4000.0, previous=0.37), default_settings("instantaneous"), car, TABLE) == 0.37


def test_a_change_is_made_for_a_saving_beyond_rounding():
    point = (4000.0, 12.0, 0.1, 0.9, True)
    _, costs = splits.cheapest(*point, 0.0, CARS[0], SHARES)
    saving = costs[0.1] + splits.TELLS_APART_W - min(costs.values())
    assert saving > 1.0
    assert cheapest_share(*point, saving - 0.5, CARS[0], TABLE) != 0.1
    assert cheapest_share(*point, saving - 5e-4, CARS[0], TABLE) == 0.1


def test_what_cannot_be_delivered_costs_more_than_any_loss():
    # Alone, the front axle spins on ice; both together do not.
    assert 0.0 < cheapest_share(9000.0, 10.0, 0.0, 0.2, True, 100.0, CAR, TABLE) < 1.0
    # What is beyond the grip of both is missing at every share: none may seem to deliver more of it.
    for previous in (0.0, 0.5, 1.0):
        assert cheapest_share(20e3, 17.6, previous, 0.1, True, 0.0, CAR, TABLE) == previous


@given(st.floats(-20e3, 20e3), st.floats(0.0, 40.0), SLIP, SLIP, SHARE)
def test_the_table_is_read_multilinearly_and_its_edge_holds_outside(power, speed, front, rear, previous):
    for table in (TABLE, ONE_SHARE):
        point = (power, speed, front, rear, previous)
        known = splits.interpolated([getattr(table, name) for name in AXES], table.front_share, point)
        assert table_share(*point, table) == pytest.approx(known, abs=1e-9)


@pytest.mark.parametrize(("power", "speed"), [(60e3, 10.0), (60e3, 0.0), (-60e3, 10.0), (-60e3, 30.0)])
def test_where_no_share_delivers_more_the_share_stays(power, speed):
    # On ice both axles give all they can, whatever the share.
    assert cheapest_share(power, speed, 0.37, 0.1, True, 0.0, CARS[0], TABLE) == 0.37


def test_a_share_from_a_table_stays_within_0_and_1():
    off = TABLE._replace(front_share=TABLE.front_share * 0.0 + 1.0 + 1e-9)
    assert table_share(1000.0, 10.0, 0.0, 0.0, 0.5, off) == 1.0
    assert table_share(1000.0, 10.0, 0.0, 0.0, 0.5, off._replace(front_share=-off.front_share)) == 0.0


@settings(max_examples=60)
@given(
    POWER,
    st.floats(0.0, 30.0),
    st.floats(-0.15, 0.15),
    st.floats(-0.15, 0.15),
    SHARE,
    st.sampled_from(
        [(0.0, 0.0), (4.0, 1.9), (16.0, 5.5), (30.0, 0.0), (38.2, 4.0), (39.0, 0.0), (10.0, 8.5), (9.0, 9.3)]
    ),
)
def test_the_lookahead_is_one_step_of_bellman_s_equation(power, speed, front, rear, previous, used):
    def outcome(share):
        step = step_cost_and_next(power, speed, front, rear, share, CAR, TABLE.problem)
        return step.cost_j, step.speed_mps, step.slip_front, step.slip_rear

    for table in (TABLE, BUDGETED):
        ours = lookahead_share(power, speed, front, rear, previous, used, CAR, table)
        motors_w = full_power_w(speed, CAR)
        costs = splits.bellman((power, speed, front, rear), previous, table, outcome, used, motors_w=motors_w)
        assert within_rounding(costs, ours, 1e-6)


@settings(max_examples=60)
@given(POWER, POWER, POWER, st.floats(0.0, 30.0), SHARE, st.sampled_from([0.0, 0.05]), st.booleans())
def test_of_now_and_a_step_of_the_chain_ago_the_mean_counts_and_what_both_ask_for(
    power, old, older, speed, previous, age, few
):
    # A step of 0.1 s, as the samples have.
    jitter = no_jitter()._replace(samples_w=(old, older, *(9e9,) * 8), taken=1 if few else 4, age_s=age)
    at = situation(power, speed, previous=previous)._replace(jitter=jitter)
    earlier_w = None if few else older if age == 0.0 else 0.5 * (old + older)
    motors_w = full_power_w(speed, CAR)

    def outcome(share):
        step = step_cost_and_next(power, speed, 0.0, 0.0, share, CAR, TABLE.problem)
        return step.cost_j, step.speed_mps, step.slip_front, step.slip_rear

    for table in (TABLE, BUDGETED):
        ours = STRATEGIES["sdp_lookahead"].choose(at, default_settings("sdp_lookahead"), CAR, table)
        point = (power, speed, 0.0, 0.0)
        costs = splits.bellman(point, previous, table, outcome, motors_w=motors_w, earlier_w=earlier_w)
        assert within_rounding(costs, ours, 1e-6)


@settings(max_examples=60)
@given(
    st.lists(POWER, min_size=4, max_size=4),
    st.floats(2.0, 35.0),
    st.lists(st.floats(0.5, 2.0), min_size=3, max_size=3),
    SHARE,
    st.sampled_from([0.2, 0.5, 0.9]),
    st.sampled_from([0.0, 0.6]),
)
def test_a_share_is_judged_by_the_mean_over_noise_and_the_step_counts_while_the_noise_lasts(
    demands, speed, faster_by, previous, friction, discount
):
    gain = 0.5
    demand, *latest = demands
    jitter = no_jitter()._replace(
        samples_w=(*latest, *(0.0,) * 7),
        speeds_mps=(*(by * speed for by in faster_by), *(0.0,) * 7),
        taken=3,
        gain=gain,
    )
    # Braking, the same force as then.
    demands = [demand, *(w if w > 0.0 else w / by for w, by in zip(latest, faster_by, strict=True))]
    at = situation(demand, speed, previous=previous)._replace(jitter=jitter)
    table = TABLE._replace(problem=TABLE.problem._replace(friction=friction), discount=discount)
    ours = STRATEGIES["sdp_lookahead"].choose(at, default_settings("sdp_lookahead"), CAR, table)
    # Two samples more at this gain: 0.2 s, for which the step's cost goes on.
    steps = 1.0 + 0.2 / table.problem.dt_s
    weights = gain * (1.0 - gain) ** np.arange(4)

    def settled_j(power, share):
        return step_cost_and_next(power, speed, 0.0, 0.0, share, CAR, table.problem).cost_j

    step_j = splits.lagging(demands, weights, speed, settled_j, table.problem, CAR)
    total = dict.fromkeys((previous, *table.share), 0.0)
    for power, weight in zip(demands, weights / weights.sum(), strict=True):

        def outcome(share, power=power):
            step = step_cost_and_next(power, speed, 0.0, 0.0, share, CAR, table.problem)
            return step_j(power, share), step.speed_mps, step.slip_front, step.slip_rear

        for share, cost in splits.bellman((power, speed, 0.0, 0.0), previous, table, outcome, steps=steps).items():
            total[share] += weight * cost
    assert within_rounding(total, ours, 1e-6)


@pytest.mark.parametrize(("stronger", "larger"), [(1.0, 1.0), (2.0, 1.0), (1.0, 0.6), (1.0, 1.6)])
@given(
    st.lists(st.floats(500.0, 20e3), min_size=4, max_size=4),
    st.floats(5.0, 30.0),
    st.sampled_from([(0.5, 1.0), (0.5, 0.0), (0.75, 1.0), (1.0, 0.5), (0.0, 0.5), (1.0, 0.75), (1.0, 0.25)]),
)
def test_with_a_budget_a_change_away_from_equal_load_has_to_be_worth_more_than_the_mean_over_noise_is_uncertain(
    stronger, larger, demands, speed, shares
):
    """Front motors have `stronger` times the force of the rear ones, their wheels `larger` times the radius."""
    gain, (previous, other) = 0.5, shares
    motor = CAR.front.motor._replace(peak_torque_nm=stronger * larger * CAR.rear.motor.peak_torque_nm)
    wheel = CAR.front.wheel._replace(radius_m=larger * CAR.rear.wheel.radius_m)
    car = CAR._replace(front=CAR.front._replace(motor=motor, wheel=wheel))
    balanced = stronger / (stronger + 1.0)
    jitter = no_jitter()._replace(samples_w=(*demands[1:], *(0.0,) * 7), taken=3, gain=gain)
    at = situation(demands[0], speed, previous=previous)._replace(jitter=jitter)
    problem = TABLE.problem._replace(dt_s=0.2)
    table = BUDGETED._replace(problem=problem, discount=0.0, share=np.array([other]), switching_fixed_cost_j=0.0)
    weights = gain * (1.0 - gain) ** np.arange(4)
    weights /= weights.sum()

    def settled_j(power, share):
        return step_cost_and_next(power, speed, 0.0, 0.0, share, car, problem).cost_j

    step_j = splits.lagging(demands, weights, speed, settled_j, problem, car)
    saved = np.array([settled_j(power, previous) - settled_j(power, other) for power in demands])
    chance = math.sqrt(np.average((saved - weights @ saved) ** 2, weights=weights) * (weights @ weights))
    mean = weights @ [step_j(power, previous) - step_j(power, other) for power in demands]
    if previous <= other <= balanced or balanced <= other <= previous:
        chance = 0.0
    # Two samples more at this gain: 0.2 s; and 0.8 s of which half count, for the forecast that does not.
    worth = (0.5 + (0.5 * 0.8 + 0.2) / 0.2) * (mean - chance) - splits.TELLS_APART_W * 0.2
    it_changes_where_it_pays(worth, at, table, car)


@given(
    st.lists(st.floats(500.0, 20e3), min_size=2, max_size=2),
    st.floats(5.0, 30.0),
    st.sampled_from([(0.1, -0.02), (-0.02, 0.1)]),
    st.sampled_from([(0.5, 1.0), (0.5, 0.0)]),
)
def test_so_it_has_in_a_dynamic_problem_from_each_axle_s_own_slip(demands, speed, slips, shares):
    previous, other = shares
    jitter = no_jitter()._replace(samples_w=(demands[1], *(0.0,) * 9), taken=1, gain=0.5)
    at = situation(demands[0], speed, *slips, previous)._replace(jitter=jitter)
    problem = TABLE.problem._replace(slip_model=SLIP_DYNAMIC, dt_s=0.2)
    table = BUDGETED._replace(problem=problem, discount=0.0, share=np.array([other]), switching_fixed_cost_j=0.0)
    weights = np.array([2.0, 1.0]) / 3.0

    def cost_j(power, share):
        return step_cost_and_next(power, speed, *slips, share, CAR, problem).cost_j

    saved = np.array([cost_j(power, previous) - cost_j(power, other) for power in demands])
    mean = weights @ saved
    chance = math.sqrt(weights @ (saved - mean) ** 2 * (weights @ weights))
    worth = (0.5 + (0.5 * 0.8 + 0.2) / 0.2) * (mean - chance) - splits.TELLS_APART_W * 0.2
    it_changes_where_it_pays(worth, at, table)


@pytest.mark.parametrize("k", range(SAMPLES))
def test_each_demand_that_a_jitter_holds_counts_in_its_place(k):
    # Only one of them has something dear to follow, with the share as it is; all else is less than a change costs.
    demands = tuple(1000.0 * (i == k) for i in range(SAMPLES))
    follows = np.zeros((2, 1, 1, 1, len(SHARES)))
    follows[1, ..., 0] = 1e9
    table = empty_table(SHARES)._replace(
        power_w=np.array([0.0, 1000.0]), previous_share=np.array(SHARES), discount=1.0, switching_fixed_cost_j=1e6
    )
    jitter = no_jitter()._replace(samples_w=demands, taken=20, gain=0.2)
    at = situation(0.0, 12.0, previous=SHARES[0])._replace(jitter=jitter)
    for expected, changes in ((follows, True), (0.0 * follows, False)):
        chosen = table._replace(expected_cost_j=expected)
        ours = STRATEGIES["sdp_lookahead"].choose(at, default_settings("sdp_lookahead"), CAR, chosen)
        assert (ours != SHARES[0]) == changes


@pytest.mark.parametrize(("axis", "sign"), [(2, 1.0), (2, -1.0), (3, 1.0), (3, -1.0)])
def test_the_lookahead_keeps_the_front_s_slip_and_the_rear_s_apart(axis, sign):
    # What follows depends steeply on the slip of one axle alone: the share goes where that axle slips least.
    slips = np.array([-0.3, 0.0, 0.3])
    shape = [1, 1, 1, 1, 1]
    shape[axis] = 3
    table = empty_table(SHARES)._replace(
        slip_front=slips if axis == 2 else np.zeros(1),
        slip_rear=slips if axis == 3 else np.zeros(1),
        expected_cost_j=(sign * np.array([0.0, 1e6, 2e6])).reshape(shape),
        discount=1.0,
        problem=TABLE.problem._replace(slip_model=SLIP_DYNAMIC),
    )
    ours = lookahead_share(6000.0, 12.0, 0.05, -0.02, 0.4, (0.0, 0.0), CAR, table)
    # Little slip is wanted of an axle that gets nothing, much of one that gets all.
    wanted_of_front = (sign < 0.0) == (axis == 2)
    assert ours == (1.0 if wanted_of_front else 0.0)


@given(POWER, st.floats(3.0, 30.0), st.floats(-0.15, 0.15), st.floats(-0.15, 0.15), SHARE)
def test_a_dynamic_problem_s_lookahead_starts_from_each_axle_s_own_slip(power, speed, front, rear, previous):
    problem = TABLE.problem._replace(slip_model=SLIP_DYNAMIC, dt_s=0.01, alpha=1.0)
    table = TABLE._replace(problem=problem, switching_cost_j=0.0, switching_fixed_cost_j=0.0)

    def outcome(share):
        step = step_cost_and_next(power, speed, front, rear, share, CAR, problem)
        return step.cost_j, step.speed_mps, step.slip_front, step.slip_rear

    costs = splits.bellman((power, speed, front, rear), previous, table, outcome)
    assert within_rounding(costs, lookahead_share(power, speed, front, rear, previous, (0.0, 0.0), CAR, table), 1e-6)


@given(st.lists(st.floats(500.0, 20e3), min_size=3, max_size=3), st.floats(5.0, 30.0), SHARE)
def test_over_noise_a_dynamic_problem_s_lookahead_takes_the_mean_of_all_of_the_cost(demands, speed, previous):
    """Its slip follows the demand by itself, whatever jitters."""
    problem = TABLE.problem._replace(slip_model=SLIP_DYNAMIC)
    table = TABLE._replace(problem=problem, switching_cost_j=0.0, switching_fixed_cost_j=0.0)
    jitter = no_jitter()._replace(samples_w=(*demands[1:], *(0.0,) * 8), taken=2, gain=0.5)
    at = situation(demands[0], speed, 0.02, -0.01, previous)._replace(jitter=jitter)
    ours = STRATEGIES["sdp_lookahead"].choose(at, default_settings("sdp_lookahead"), CAR, table)
    total = dict.fromkeys((previous, *table.share), 0.0)
    for power, weight in zip(demands, (4.0 / 7.0, 2.0 / 7.0, 1.0 / 7.0), strict=True):

        def outcome(share, power=power):
            step = step_cost_and_next(power, speed, 0.02, -0.01, share, CAR, problem)
            return step.cost_j, step.speed_mps, step.slip_front, step.slip_rear

        costs = splits.bellman((power, speed, 0.02, -0.01), previous, table, outcome, steps=1.0 + 0.2 / problem.dt_s)
        for share, cost in costs.items():
            total[share] += weight * cost
    assert within_rounding(total, ours, 1e-6)


def test_the_lookahead_stays_where_changing_gains_nothing():
    flat = TABLE._replace(expected_cost_j=TABLE.expected_cost_j * 0.0, discount=0.0)
    dear = flat._replace(switching_fixed_cost_j=1e6)
    assert lookahead_share(3000.0, 12.0, 0.0, 0.0, 0.3, (0.0, 0.0), CAR, dear) == 0.3
    assert lookahead_share(3000.0, 12.0, 0.0, 0.0, 0.3, (0.0, 0.0), CAR, flat._replace(switching_cost_j=1e6)) == 0.3
    free = flat._replace(switching_cost_j=0.0, switching_fixed_cost_j=0.0)
    assert lookahead_share(3000.0, 12.0, 0.0, 0.0, 0.3, (0.0, 0.0), CAR, free) in SHARES


def test_the_lookahead_does_not_change_for_less_than_rounding():
    twins = TABLE._replace(share=np.array([0.3 - 1e-9, 0.3 + 1e-9]), switching_cost_j=0.0, switching_fixed_cost_j=0.0)
    assert lookahead_share(3000.0, 12.0, 0.0, 0.0, 0.3, (0.0, 0.0), CAR, twins) == 0.3


def test_the_lookahead_changes_for_a_saving_beyond_rounding():
    problem = TABLE.problem._replace(dt_s=0.1)
    free = TABLE._replace(problem=problem, discount=0.0, switching_cost_j=0.0, switching_fixed_cost_j=0.0)
    costs = {
        share: step_cost_and_next(4000.0, 12.0, 0.0, 0.0, share, CARS[0], problem).cost_j for share in (0.1, *SHARES)
    }
    saving = costs[0.1] - min(costs.values())
    assert saving > 1.0

    def share(gain):
        return lookahead_share(
            4000.0, 12.0, 0.0, 0.0, 0.1, (0.0, 0.0), CARS[0], free._replace(switching_fixed_cost_j=saving - gain)
        )

    # A milliwatt for 0.1 s.
    assert share(2e-4) != 0.1
    assert share(5e-5) == 0.1


def test_a_change_gets_dearer_with_what_is_used_of_the_budget_and_at_last_there_is_none():
    # With nothing to follow, only the step's cost and the price of the change count.
    table = BUDGETED._replace(
        expected_cost_j=BUDGETED.expected_cost_j * 0.0, dearer_cost_j=BUDGETED.dearer_cost_j * 0.0, discount=0.0
    )._replace(switching_fixed_cost_j=0.0)

    def moves(price, used):
        """Whether the share leaves 0.5, at 0.3 kW and 12 m/s, where one axle alone is best."""
        return lookahead_share(300.0, 12.0, 0.0, 0.0, 0.5, used, CAR, table._replace(switching_cost_j=price)) != 0.5

    prices = np.geomspace(1e-3, 1e4, 400)

    def dearest(*used):
        return max((p for p in prices if moves(p, used)), default=0.0)

    free = dearest(0.0, 0.0)
    lasting, minute = [
        [dearest(each, 0.0) for each in (4.0, 21.0, 40.0, 44.0)],
        [dearest(0.0, each) for each in (4.0, 9.0, 16.0, 20.0)],
    ]
    for prices_at in (lasting, minute):
        assert free > prices_at[0] > prices_at[1] > prices_at[2] > prices_at[3] == 0.0
    # Half of what a bucket of five and a half minutes' budget holds for a change and the way back: hardly dearer.
    assert free / lasting[1] == pytest.approx(2.0**0.5 * (1.0 + np.pi / (2.0 * BUDGETED.elasticity * 42.0)), rel=0.05)
    assert free / minute[1] == pytest.approx(1.0 + np.pi / (2.0 * BUDGETED.elasticity * 18.0), rel=0.05)


def test_the_way_back_to_the_middle_gets_dearer_by_what_was_used_before_the_way_there():
    table = BUDGETED._replace(
        expected_cost_j=BUDGETED.expected_cost_j * 0.0, dearer_cost_j=BUDGETED.dearer_cost_j * 0.0, discount=0.0
    )._replace(switching_fixed_cost_j=0.0)

    def dearest(minute):
        """Price up to which the share leaves 1.0 at 12 kW and 12 m/s, where both axles together are best."""
        prices = np.geomspace(1e-2, 1e4, 800)
        state = (12e3, 12.0, 0.0, 0.0, 1.0, (0.0, minute), CAR)
        return max(
            (p for p in prices if lookahead_share(*state, table._replace(switching_cost_j=p)) != 1.0), default=0.0
        )

    assert dearest(1.0) / dearest(10.0) == pytest.approx(1.0 + np.pi / (2.0 * BUDGETED.elasticity * 18.0), rel=0.05)


def test_no_load_is_moved_off_an_axle_for_slip_that_a_jitter_does_not_reach():
    shares = np.linspace(0.0, 1.0, 21)
    free = empty_table(shares)._replace(discount=0.0, problem=TABLE.problem._replace(friction=0.2))
    gain, speed, demands = 0.2, 25.0, (28e3, *(8e3, 28e3) * 5)
    weights = gain * (1.0 - gain) ** np.arange(11)
    at = situation(demands[0], speed, previous=0.5)._replace(
        jitter=no_jitter()._replace(samples_w=demands[1:], taken=20, gain=gain)
    )
    ours = STRATEGIES["sdp_lookahead"].choose(at, default_settings("sdp_lookahead"), CAR, free)

    def settled_j(power, share):
        return step_cost_and_next(power, speed, 0.0, 0.0, share, CAR, free.problem).cost_j

    def cheapest(step_j):
        return min(shares, key=lambda share: sum(w * step_j(p, share) for w, p in zip(weights, demands, strict=True)))

    assert ours == cheapest(splits.lagging(demands, weights, speed, settled_j, free.problem, CAR)) == 0.5
    assert cheapest(settled_j) < 0.5


def test_a_demand_that_jitters_is_judged_by_the_mean_of_what_it_jitters_between():
    high, low, previous = 9000.0, 800.0, 0.5
    free = TABLE._replace(discount=0.0, switching_cost_j=1.0, switching_fixed_cost_j=0.0)
    gain = 0.4
    jitter = no_jitter()._replace(samples_w=(low, high) * 5, taken=20, gain=gain)

    def settled_j(power, share):
        return step_cost_and_next(power, 12.0, 0.0, 0.0, share, CAR, free.problem).cost_j

    weights = [gain * (1.0 - gain) ** age for age in range(11)]
    demands = (high, *(low, high) * 5)
    step_j = splits.lagging(demands, weights, 12.0, settled_j, free.problem, CAR)
    costs = dict.fromkeys(SHARES, 0.0)
    for weight, power in zip(weights, demands, strict=True):
        for share in SHARES:
            costs[share] += weight / sum(weights) * step_j(power, share)
    for share in SHARES:
        costs[share] += abs(share - previous)
    at = situation(high, previous=previous)._replace(jitter=jitter)
    ours = STRATEGIES["sdp_lookahead"].choose(at, default_settings("sdp_lookahead"), CAR, free)
    assert within_rounding(costs, ours, 1e-6)
    steady = STRATEGIES["sdp_lookahead"].choose(
        at._replace(jitter=jitter._replace(gain=1.0)), default_settings("sdp_lookahead"), CAR, free
    )
    assert steady == lookahead_share(high, 12.0, 0.0, 0.0, previous, (0.0, 0.0), CAR, free)


def choose(strategy, power=1500.0, decisions=0, previous=0.3, speed=12.0, friction=0.9, used=(0.0, 0.0)):
    s = default_settings(strategy)
    return decide(situation(power, speed, 0.01, -0.02, previous, used, friction, decisions), s, CAR, TABLE)


def test_every_strategy_is_behind_its_name():
    assert choose("equal") == 0.5
    chosen = {
        "rule": rule_share(1500.0, TABLE),
        "instantaneous": cheapest_share(1500.0, 12.0, 0.3, 0.9, False, 0.0, CAR, TABLE),
        "instantaneous_slip": cheapest_share(1500.0, 12.0, 0.3, 0.9, True, 100.0, CAR, TABLE),
        "sdp": table_share(1500.0, 12.0, 0.01, -0.02, 0.3, TABLE),
        "sdp_lookahead": lookahead_share(1500.0, 12.0, 0.01, -0.02, 0.3, (0.0, 0.0), CAR, TABLE),
    }
    assert {name: choose(name) for name in chosen} == chosen
    assert len({0.5, *chosen.values()}) == 6, "strategies that decide alike cannot be told apart"
    # On ice: one knows of slip, the other does not.
    blind, aware = (cheapest_share(9000.0, 5.0, 0.3, 0.2, slip, 0.0, CAR, TABLE) for slip in (False, True))
    assert blind != aware
    assert choose("instantaneous", 9000.0, speed=5.0, friction=0.2) == blind
    assert choose("instantaneous_slip", 9000.0, speed=5.0, friction=0.2) == aware


def test_codes_stand_in_bags_and_never_change():
    known = {name: strategy.code for name, strategy in STRATEGIES.items()}
    assert known == {
        "equal": 0,
        "rule": 1,
        "instantaneous": 2,
        "instantaneous_slip": 3,
        "sdp": 4,
        "sdp_lookahead": 5,
        "preview": 6,
    }
    assert list(known) == sorted(known, key=known.__getitem__)
    assert [strategies.name_of(code) for code in known.values()] == list(known)


@pytest.mark.parametrize("name", STRATEGIES)
def test_every_strategy_says_in_a_line_what_it_does(name):
    said = strategies.meaning(name)
    assert len(said) > 10
    assert f"`{name}`" not in said
    assert "\n" not in said


def test_two_strategies_need_a_policy_and_one_knows_the_future():
    assert [name for name, strategy in STRATEGIES.items() if strategy.needs_policy] == ["sdp", "sdp_lookahead"]
    assert set(STRATEGIES) - set(strategies.drivable()) == {"preview"}


def test_a_strategy_that_comes_after_the_law_is_refused():
    with pytest.raises(ValueError, match="mine: the control law is built already"):
        strategies.register(Strategy("mine", 99, STRATEGIES["equal"].choose))


_MINE = """
from iwm_power_manager.control.strategy import Strategy
from iwm_power_manager.jit import kernel

@kernel
def choose(situation, settings, vehicle, policy):
    return 0.25 if situation.front_slip > situation.rear_slip else 0.75

STRATEGY = Strategy("toward_grip", 40, choose)
"""
_DRIVE = """
import sys
sys.path.insert(0, sys.argv[1])
import pytest
from iwm_power_manager.control import strategies
import toward_grip
strategies.register(toward_grip.STRATEGY)
with pytest.raises(ValueError, match="toward_grip has code 40"):
    strategies.register(toward_grip.STRATEGY._replace(name="another"))
from iwm_power_manager.control.settings import parse, default_settings
from iwm_power_manager.control import law
from iwm_power_manager.control.table import empty_table
from iwm_power_manager.control.types import Measurement, initial_state
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle
assert parse("--strategy", "strategy", "toward_grip") == 40
car = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params
rolling = 15.0 / car.front.wheel.radius_m
for front, rear, share in ((1.05, 1.0, 0.25), (1.0, 1.05, 0.75)):
    measurement = Measurement(
        speed_mps=15.0, wheel_speed_radps=(front * rolling,) * 2 + (rear * rolling,) * 2, power_demand_w=4000.0,
        dt_s=0.01, friction=0.9, discharge_limit_w=47500.0, charge_limit_w=47500.0, soc=0.5,
    )
    command, _ = law.step(measurement, initial_state(), default_settings("toward_grip"), car, empty_table())
    print(command.decided_share)
"""


@pytest.mark.parametrize(("name", "code"), [("equal", 99), ("mine", STRATEGIES["sdp"].code)])
def test_a_name_or_a_code_that_is_taken_is_refused(name, code):
    with pytest.raises(ValueError, match="has code"):
        strategies.register(Strategy(name, code, STRATEGIES["equal"].choose))


def test_a_strategy_in_a_file_of_its_own_is_registered_and_drives(tmp_path):
    (tmp_path / "toward_grip.py").write_text(_MINE)
    (tmp_path / "drive.py").write_text(_DRIVE)
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    made = subprocess.run(
        [sys.executable, str(tmp_path / "drive.py"), str(tmp_path)], capture_output=True, text=True, env=environment
    )
    assert made.stdout.split() == ["0.25", "0.75"], made.stderr


def test_a_strategy_the_law_does_not_know_is_equal_split():
    unknown = default_settings()._replace(strategy=99)
    assert decide(situation(1500.0), unknown, CAR, TABLE) == 0.5


def test_the_preview_plays_its_schedule_and_holds_the_last_entry():
    assert [choose("preview", decisions=k) for k in range(5)] == [0.1, 0.9, 0.4, 0.4, 0.4]
    assert choose("preview", power=0.0, decisions=1) == 0.9


@pytest.mark.parametrize("strategy", ["rule", "instantaneous", "instantaneous_slip", "sdp", "sdp_lookahead"])
@pytest.mark.parametrize("power", [0.0, 0.999, -0.999])
def test_without_a_demand_the_split_stays_as_it_is(strategy, power):
    assert choose(strategy, power) == 0.3
    assert choose("equal", power) == 0.5


def test_a_watt_is_a_demand():
    assert choose("rule", 1.0) == 1.0
    assert choose("rule", -1.0) == 1.0


def test_without_a_policy_the_shares_to_choose_from_are_twentieths():
    assert empty_table().share == pytest.approx([part / 20.0 for part in range(21)])
