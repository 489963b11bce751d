# SPDX-License-Identifier: Apache-2.0
"""The budget of changes: what counts, what it costs, and that nothing gets past the bucket."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from iwm_power_manager.control import budget

MOVE = st.one_of(st.sampled_from([0.0, 0.05, -0.25, 0.5, -1.0]), st.floats(-1.0, 1.0))
RATE = st.floats(0.1, 100.0)


def test_a_quarter_of_the_power_counts_as_a_change_and_more_as_no_more():
    assert [budget.changes_counted(move) for move in (0.0, 0.05, -0.125, 0.25, 0.5, -1.0)] == pytest.approx(
        [0.0, 0.2, 0.5, 1.0, 1.0, 1.0]
    )


@given(MOVE)
def test_the_price_is_the_mean_of_three_counts(move):
    counts = (float(move != 0.0), min(abs(move) * 4.0, 1.0), abs(move))
    assert budget.price_units(move) == pytest.approx(sum(counts) / 3.0)


SHARE = st.one_of(st.sampled_from([0.0, 0.5, 1.0]), st.floats(0.0, 1.0))


@given(st.lists(st.tuples(SHARE, st.floats(0.02, 20.0)), min_size=1, max_size=60), RATE)
def test_no_stretch_of_time_sees_more_than_its_budget_and_a_bucket(wishes, rate):
    used, now, share, taken = budget.Used(0.0, 0.0), 0.0, 0.5, []
    for wish, pause in wishes:
        used, now = budget.leaked(used, pause, rate), now + pause
        if budget.affordable(wish, share, used, rate):
            used = budget.spent(used, wish - share)
            taken.append((now, budget.changes_counted(wish - share)))
            share = wish
        assert budget.affordable(0.5, share, used, rate), "the way back to the middle is never barred"
    times, counts = np.array(taken).reshape(-1, 2).T
    size = budget.buckets(rate)
    for first in range(times.size):
        for last in range(first, times.size):
            of_budget = rate / 60.0 * (times[last] - times[first])
            found = counts[first : last + 1].sum()
            assert found <= of_budget + size.lasting + 1e-6
            assert found <= 2.0 * of_budget + size.minute + 1e-6
            assert times[last] - times[first] > 60.0 or found <= rate + budget.burst(rate) + 1e-6


def test_a_minute_may_have_28_changes_beyond_a_budget_of_8():
    assert budget.burst(8.0) == 28.0
    assert budget.buckets(8.0) == (44.0, 20.0)
    assert budget.buckets(0.1) == (2.0, 2.0)


ELASTICITY = st.floats(0.1, 1.0)
USED = st.builds(budget.Used, st.floats(0.0, 600.0), st.floats(0.0, 200.0))


@given(USED, USED, SHARE, RATE, ELASTICITY)
def test_the_price_never_falls_with_what_is_used(one, other, share, rate, elasticity):
    both = budget.Used(max(one.lasting, other.lasting), max(one.minute, other.minute))
    low, high = (budget.price_factor(used, share, rate, elasticity) for used in (one, both))
    assert 1.0 <= low <= high < 1e11
    assert budget.price_factor(budget.Used(0.0, 0.0), share, rate, elasticity) == 1.0
    assert low <= budget.price_factor(one, share, rate, 0.5 * elasticity), "fewer changes go for a price: it rises more"


@given(st.floats(0.0, 1.5), st.floats(2.5, 100.0))
def test_where_no_change_fits_the_price_has_risen_beyond_what_one_is_worth(more, rate):
    """What comes first never gets the room that something of ten times its worth would have needed."""
    size = budget.buckets(rate)
    for used in (budget.Used(size.lasting - 2.0 + more, 0.0), budget.Used(0.0, size.minute - 2.0 + more)):
        assert budget.price_factor(used, 0.5, rate, 1.0) > 10.0
        assert more < 1e-6 or not budget.affordable(1.0, 0.5, used, rate)


@given(USED, SHARE, RATE)
def test_the_way_back_to_the_middle_costs_what_the_way_there_did(used, share, rate):
    """A share whose room for the return is set aside is never held because a bucket is full."""
    there = budget.spent(used, share - 0.5)
    here = budget.price_factor(used, 0.5, rate, 0.3)
    assert budget.price_factor(there, share, rate, 0.3) == pytest.approx(here, rel=1e-6)


@pytest.mark.parametrize(("rate", "elasticity"), [(1.0, 0.3), (8.0, 0.1), (8.0, 0.4), (30.0, 1.0)])
def test_a_bucket_costs_what_the_solution_of_its_hamilton_jacobi_bellman_equation_says(rate, elasticity):
    """w' = e w^2 + c from nothing at the empty bucket to no bound where a change and the way back fill it."""
    size = budget.buckets(rate)
    for bucket, other in (("minute", 0.0), ("lasting", 1.0)):
        holds = max(getattr(size, bucket) - 2.0, 1.0)
        steep = np.pi / (2.0 * holds * elasticity)
        for level in (0.0, 0.25, 0.5, 0.75, 0.9):
            used = budget.Used(0.0, 0.0)._replace(**{bucket: level * holds})
            expected = (1.0 + steep * np.tan(0.5 * np.pi * level)) * 2.0 ** (level * other)
            assert budget.price_factor(used, 0.5, rate, elasticity) == pytest.approx(expected)


def test_between_the_tabulated_prices_the_logarithm_counts_and_beyond_them_the_last():
    assert [budget.price_level(factor) for factor in (1.0, 3.0**0.5, 3.0, 9.0, 20.0)] == pytest.approx(
        [0.0, 0.5, 1.0, 2.0, 2.0]
    )


def test_without_a_budget_nothing_is_counted():
    assert budget.affordable(1.0, 0.0, budget.Used(1e9, 1e9), 0.0)
    assert budget.price_factor(budget.Used(1e9, 1e9), 0.5, 0.0, 0.3) == 1.0
