"""Keeping other work off the control path."""

from __future__ import annotations

import gc
import os

import pytest

from iwm_power_manager.ros import realtime


@pytest.mark.parametrize(
    ("text", "expected"), [("", set()), ("  ", set()), ("1", {1}), ("0,2", {0, 2}), ("0, 2", {0, 2})]
)
def test_processors_are_read_from_a_list(text, expected) -> None:
    assert realtime.parse_affinity(text) == expected


@pytest.mark.parametrize("text", ["one", "0,", "0-2", "-1", "1.5"])
def test_what_is_no_list_of_processors_is_refused(text) -> None:
    with pytest.raises(ValueError, match="processor"):
        realtime.parse_affinity(text)


def test_garbage_is_collected_only_when_asked_for() -> None:
    try:
        realtime.stop_automatic_collection()
        assert not gc.isenabled()
        assert gc.get_freeze_count() > 0
        cycle: list[object] = []
        cycle.append(cycle)
        del cycle
        realtime.collect()
        assert gc.get_count()[2] == 0
    finally:
        realtime.resume_automatic_collection()
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0


def test_nothing_is_asked_of_the_system_by_default() -> None:
    before = os.sched_getscheduler(0), os.sched_getaffinity(0)
    assert realtime.request(0, set(), lock_memory=False) == []
    assert (os.sched_getscheduler(0), os.sched_getaffinity(0)) == before


def test_an_affinity_that_exists_is_granted() -> None:
    before = os.sched_getaffinity(0)
    try:
        assert realtime.request(0, {min(before)}, lock_memory=False) == []
        assert os.sched_getaffinity(0) == {min(before)}
    finally:
        os.sched_setaffinity(0, before)


def test_what_the_system_refuses_is_told_in_words() -> None:
    refused = realtime.request(0, {1000}, lock_memory=False)
    assert len(refused) == 1
    assert refused[0].startswith("CPU affinity [1000]: ")
