# SPDX-License-Identifier: Apache-2.0
"""An executor in a thread: nothing is taken away from under it."""

from __future__ import annotations

import threading
from typing import Any

from rclpy.executors import InvalidHandle

from iwm_power_manager.ros.spinning import in_thread


class Waiting:
    """An executor that waits until it is given a task, and keeps what happened to it."""

    def __init__(self, *problems: Exception) -> None:
        self.happened: list[str] = []
        self.begun, self._task = threading.Event(), threading.Event()
        self._problems = list(problems)

    def spin_once(self) -> None:
        if self._problems:
            raise self._problems.pop()
        self.happened.append("waits")
        self.begun.set()
        self._task.wait()
        self.happened.append("woken")

    def create_task(self, _: Any) -> None:
        self._task.set()

    def shutdown(self) -> None:
        self.happened.append("shut down")


def test_it_is_shut_down_when_nobody_waits_in_it_any_more() -> None:
    executor = Waiting()
    with in_thread(executor, "under test"):
        assert executor.begun.wait(60.0)
    assert executor.happened == ["waits", "woken", "shut down"]
    assert "under test" not in {thread.name for thread in threading.enumerate()}


def test_an_entity_that_is_destroyed_meanwhile_does_not_end_it() -> None:
    executor = Waiting(InvalidHandle("gone"))
    with in_thread(executor, "under test"):
        assert executor.begun.wait(60.0), "it went on"
    assert executor.happened[-1] == "shut down"
