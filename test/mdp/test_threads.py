# SPDX-License-Identifier: Apache-2.0
"""Ranges: each place once, whatever the threads do; a failure is the caller's."""

from __future__ import annotations

import threading

import numba
import pytest

from iwm_power_manager.mdp.threads import over_ranges


@pytest.mark.parametrize(
    ("size", "numbers"), [(0, 0), (1, 10**9), (7, 10**9), (1000, 10**9), (1000, 50_000), (1000, 1)]
)
def test_every_place_is_in_one_range(size, numbers, monkeypatch):
    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", 3)
    places, seen = [], threading.Lock()

    def note(first, last):
        with seen:
            places.extend(range(first, last))

    over_ranges(size, numbers, note)
    assert sorted(places) == list(range(size))


def test_a_range_that_fails_fails_for_the_caller(monkeypatch):
    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", 3)

    def fail(first, last):
        raise ArithmeticError(first)

    with pytest.raises(ArithmeticError):
        over_ranges(100, 10**9, fail)
