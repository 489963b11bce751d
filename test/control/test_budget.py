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
def test_no_stretch_of_time_sees_more_than_its_budget_and_one_bucket(wishes, rate):
    used, now, share, taken = 0.0, 0.0, 0.5, []
    for wish, pause in wishes:
        used, now = budget.leaked(used, pause, rate), now + pause
        if budget.affordable(wish, share, used, rate):
            used += budget.changes_counted(wish - share)
            taken.append((now, budget.changes_counted(wish - share)))
            share = wish
        assert budget.affordable(0.5, share, used, rate), "the way back to the middle is never barred"
    times, counts = np.array(taken).reshape(-1, 2).T
    for first in range(times.size):
        for last in range(first, times.size):
            allowed = rate / 60.0 * (times[last] - times[first]) + budget.bucket(rate)
            assert counts[first : last + 1].sum() <= allowed + 1e-6


@given(st.floats(0.0, 200.0), st.floats(0.0, 200.0), RATE)
def test_the_price_never_falls_with_what_is_used_and_ends_at_the_dearest(one, other, rate):
    low, high = sorted((one, other))
    cheaper, dearer = budget.price_factor(low, rate), budget.price_factor(high, rate)
    assert 1.0 <= cheaper <= dearer <= budget.DEAREST
    assert budget.price_factor(0.0, rate) == 1.0
    assert budget.price_factor(0.5 * budget.bucket(rate), rate) == pytest.approx(budget.DEAREST**0.5)


def test_between_the_tabulated_prices_the_logarithm_counts_and_beyond_them_the_last():
    assert [budget.price_level(factor) for factor in (1.0, 3.0**0.5, 3.0, 9.0, 20.0)] == pytest.approx(
        [0.0, 0.5, 1.0, 2.0, 2.0]
    )


def test_without_a_budget_nothing_is_counted():
    assert budget.affordable(1.0, 0.0, 1e9, 0.0)
    assert budget.price_factor(1e9, 0.0) == 1.0
