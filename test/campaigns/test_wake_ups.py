# SPDX-License-Identifier: Apache-2.0
"""The witness's compiled loop: when it wakes, what it writes down, and that nothing of it is lost."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from campaigns import wake_ups, witness
from iwm_power_manager.errors import IwmError

TICK_NS = 1_000_000


class Loop:
    """Runs beside the test."""

    def __init__(self, rows: int) -> None:
        self.ring = np.zeros((rows, wake_ups.COLUMNS), dtype=np.int64)
        self.state = np.zeros(2, dtype=np.int64)
        self.pages = np.zeros(3, dtype=np.uint8)
        arguments = (self.ring, self.state, self.pages, np.zeros(2, dtype=np.int64), TICK_NS)
        self.thread = threading.Thread(target=wake_ups.wake_up, args=arguments)

    def run_until(self, count: int) -> None:
        self.thread.start()
        deadline_s = time.monotonic() + 60.0
        while self.state[wake_ups.COUNT] < count:
            assert time.monotonic() < deadline_s
            time.sleep(0.001)
        self.state[wake_ups.STOP] = 1
        self.thread.join()


@pytest.fixture(scope="module")
def rows() -> np.ndarray:
    began_ns = time.time_ns()
    loop = Loop(5000)
    loop.run_until(300)
    ended_ns = time.time_ns()
    count = int(loop.state[wake_ups.COUNT])
    assert not loop.ring[count:].any()
    assert loop.pages.tolist() == [count % 256] * 3
    found = loop.ring[:count]
    assert found[0, wake_ups.DUE] >= began_ns and found[-1, wake_ups.SLEPT] <= ended_ns
    return found


def test_it_wakes_when_it_is_due_and_not_before(rows) -> None:
    assert np.all(rows[:, wake_ups.WOKE] >= rows[:, wake_ups.DUE])
    assert np.all(rows[:, wake_ups.SLEPT] >= rows[:, wake_ups.WOKE] + rows[:, wake_ups.WORK])
    assert np.all(rows[1:, wake_ups.WOKE] >= rows[:-1, wake_ups.SLEPT])
    assert np.all(rows[:, wake_ups.WORK] >= 0)


def test_the_next_is_due_on_the_grid_after_what_was_missed(rows) -> None:
    """Against plain Python; the wall clock, which is written down, is read a moment after the one slept by."""
    due_ns, woke_ns = rows[:, wake_ups.DUE].tolist(), rows[:, wake_ups.WOKE].tolist()
    right = 0
    for i in range(len(rows) - 1):
        missed = (woke_ns[i] - due_ns[i]) // TICK_NS
        right += abs(due_ns[i + 1] - due_ns[i] - (1 + missed) * TICK_NS) < 0.05 * TICK_NS
    assert right > 0.9 * len(rows)  # what interrupts between the two clocks shifts a row


def test_a_small_ring_keeps_the_last() -> None:
    loop = Loop(8)
    loop.run_until(30)
    count = int(loop.state[wake_ups.COUNT])
    order = np.arange(count - 8, count) % 8
    assert np.all(np.diff(loop.ring[order, wake_ups.DUE]) > 0.9 * TICK_NS)


def watch_for(watch: witness.Watch, ticks: int, *, put_away: bool) -> None:
    thread = threading.Thread(target=watch.run)
    thread.start()
    deadline_s = time.monotonic() + 60.0
    while watch.count < ticks:
        assert time.monotonic() < deadline_s
        if put_away:
            watch.put_away()
        time.sleep(0.001)
    watch.stop()
    thread.join()


def test_what_is_put_away_in_time_is_complete() -> None:
    watch = witness.Watch(rows=1000)
    watch_for(watch, 2500, put_away=True)
    watch.put_away()
    watch.put_away()  # nothing twice
    found = watch.found()
    assert len(found) == watch.count >= 2500
    assert np.all(np.diff(found[:, wake_ups.DUE]) > 0)


def test_what_is_put_away_too_late_is_told() -> None:
    watch = witness.Watch(rows=10)
    watch_for(watch, 30, put_away=False)
    with pytest.raises(IwmError, match="put away in time"):
        watch.put_away()
