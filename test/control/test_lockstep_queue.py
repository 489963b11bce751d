# SPDX-License-Identifier: Apache-2.0
"""Sets of lock-step messages are paired, whatever the order in which topics arrive."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from iwm_power_manager.control.lockstep import BATTERY, SPEED, WHEELS, LockstepQueue


def push_set(queue: LockstepQueue, stamp: int, sent: int, *, without: tuple[int | str, ...] = ()) -> None:
    for offset, topic in enumerate((SPEED, WHEELS, BATTERY)):
        if topic not in without:
            queue.push(topic, stamp, sent + offset, (topic, stamp))
    if "demand" not in without:
        queue.push_demand(sent + 3, float(stamp))


def test_a_complete_set_comes_out_once() -> None:
    queue = LockstepQueue()
    push_set(queue, 10, 100)
    found = queue.pop()
    assert found == (10, (SPEED, 10), (WHEELS, 10), (BATTERY, 10), 10.0)
    assert queue.pop() is None
    assert not queue.waiting


def test_nothing_comes_out_while_any_message_is_missing() -> None:
    for missing in (SPEED, WHEELS, BATTERY, "demand"):
        queue = LockstepQueue()
        push_set(queue, 10, 100, without=(missing,))
        assert queue.pop() is None
        assert queue.waiting == (missing != "demand")


def test_a_repeated_set_asks_for_the_answer_only() -> None:
    queue = LockstepQueue()
    push_set(queue, 10, 100)
    queue.pop()
    push_set(queue, 10, 200)
    repeated = queue.pop()
    assert repeated is not None
    assert repeated.stamp_ns == 10
    assert repeated.demand is None
    push_set(queue, 20, 300)
    following = queue.pop()
    assert following is not None
    assert following.demand == 20.0


def test_a_demand_left_over_from_an_incomplete_set_is_not_taken_for_the_next() -> None:
    queue = LockstepQueue()
    push_set(queue, 10, 100, without=(SPEED, WHEELS, BATTERY))
    push_set(queue, 20, 200)
    found = queue.pop()
    assert found is not None
    assert found.demand == 20.0


def test_an_incomplete_set_is_skipped_once_the_next_is_complete() -> None:
    for missing in ((SPEED,), (WHEELS,), (BATTERY,), (SPEED, WHEELS), (WHEELS, BATTERY), (BATTERY, SPEED)):
        queue = LockstepQueue()
        push_set(queue, 10, 100, without=missing)
        push_set(queue, 20, 200)
        assert queue.pop() == (20, (SPEED, 20), (WHEELS, 20), (BATTERY, 20), 20.0)
        assert queue.pop() is None


def test_a_clock_too_coarse_to_tell_messages_apart_loses_none() -> None:
    queue = LockstepQueue()
    for stamp in (10, 20):
        for topic in (SPEED, WHEELS, BATTERY):
            queue.push(topic, stamp, 100, stamp)
        queue.push_demand(100, float(stamp))
    assert queue.pop() == (10, 10, 10, 10, 10.0)
    assert queue.pop() == (20, 20, 20, 20, 20.0)


def test_a_set_whose_demand_was_lost_does_not_take_that_of_the_next() -> None:
    queue = LockstepQueue()
    push_set(queue, 10, 100, without=("demand",))
    push_set(queue, 20, 200)
    found = queue.pop()
    assert found is not None
    assert (found.stamp_ns, found.demand) == (20, 20.0)


def test_sets_sent_ahead_wait_for_their_own_demands() -> None:
    queue = LockstepQueue()
    push_set(queue, 10, 100, without=("demand",))
    push_set(queue, 20, 200, without=("demand",))
    queue.push_demand(150, 10.0)
    found = queue.pop()
    assert found is not None
    assert (found.stamp_ns, found.demand) == (10, 10.0)
    assert queue.pop() is None
    queue.push_demand(250, 20.0)
    found = queue.pop()
    assert found is not None
    assert (found.stamp_ns, found.demand) == (20, 20.0)


def test_a_stamp_may_go_back_when_a_new_run_begins() -> None:
    queue = LockstepQueue()
    push_set(queue, 50, 100)
    queue.pop()
    push_set(queue, 10, 200)
    found = queue.pop()
    assert found is not None
    assert (found.stamp_ns, found.demand) == (10, 10.0)


def test_a_new_run_after_an_incomplete_set_of_the_old_one_is_found() -> None:
    queue = LockstepQueue()
    push_set(queue, 50, 100, without=(BATTERY, "demand"))
    push_set(queue, 10, 200)
    found = queue.pop()
    assert found is not None
    assert found.stamp_ns == 10


def test_clearing_forgets_messages_and_the_last_answer() -> None:
    queue = LockstepQueue()
    push_set(queue, 10, 100)
    queue.pop()
    push_set(queue, 20, 200, without=(WHEELS,))
    queue.clear()
    assert not queue.waiting
    push_set(queue, 20, 250, without=(SPEED, BATTERY))
    assert queue.pop() is None
    queue.clear()
    push_set(queue, 10, 300)
    found = queue.pop()
    assert found is not None
    assert found.demand == 10.0


@given(st.integers(1, 8), st.randoms(use_true_random=False))
def test_sets_come_out_complete_and_in_order_however_topics_interleave(count, random) -> None:
    queue = LockstepQueue()
    lanes = [[(SPEED, i), (WHEELS, i), (BATTERY, i), ("demand", i)] for i in range(count)]
    topics = [
        [message for lane in lanes for message in lane if message[0] == t] for t in (SPEED, WHEELS, BATTERY, "demand")
    ]
    out = []
    while any(topics):
        topic, i = random.choice([t for t in topics if t]).pop(0)
        if topic == "demand":
            queue.push_demand(1000 * i + 3, float(i))
        else:
            queue.push(topic, 10 + i, 1000 * i + topic, i)
        while (found := queue.pop()) is not None:
            out.append(found)
    assert [found.stamp_ns for found in out] == [10 + i for i in range(count)]
    assert all(found.speed == found.wheels == found.battery == found.demand for found in out)
