# SPDX-License-Identifier: Apache-2.0
"""Keeping other work off the control path."""

from __future__ import annotations

import gc
import os
import threading

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


def test_every_thread_gets_it_and_the_others_a_priority_less(monkeypatch) -> None:
    asked: dict[int, int] = {}
    monkeypatch.setattr(os, "sched_setscheduler", lambda thread, _, param: asked.update({thread: param.sched_priority}))
    placed: dict[int, set[int]] = {}
    monkeypatch.setattr(os, "sched_setaffinity", lambda thread, processors: placed.update({thread: processors}))
    end = threading.Event()
    other = threading.Thread(target=end.wait)
    other.start()
    try:
        assert realtime.request(7, {0}, lock_memory=False) == []
    finally:
        end.set()
        other.join()
    assert asked[threading.get_native_id()] == 7
    assert asked[other.native_id] == 6
    assert placed[threading.get_native_id()] == placed[other.native_id] == {0}


def test_the_lowest_priority_is_that_of_all_threads(monkeypatch) -> None:
    asked = set()
    monkeypatch.setattr(os, "sched_setscheduler", lambda _thread, _, param: asked.add(param.sched_priority))
    end = threading.Event()
    other = threading.Thread(target=end.wait)
    other.start()
    realtime.request(1, set(), lock_memory=False)
    end.set()
    other.join()
    assert asked == {1}


def test_a_thread_that_has_just_ended_is_no_refusal(monkeypatch) -> None:
    def ended(*_) -> None:
        raise ProcessLookupError

    monkeypatch.setattr(os, "sched_setscheduler", ended)
    assert realtime.request(7, set(), lock_memory=False) == []


def test_a_refused_priority_is_told_in_words(monkeypatch) -> None:
    def refuse(*_) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    assert realtime.request(7, set(), lock_memory=False) == ["SCHED_FIFO priority 7: Operation not permitted"]


def test_what_the_system_refuses_is_told_in_words() -> None:
    refused = realtime.request(0, {1000}, lock_memory=False)
    assert len(refused) == 1
    assert refused[0].startswith("CPU affinity [1000]: ")
