# SPDX-License-Identifier: Apache-2.0
"""Control steps come when they are due, ahead of the executor, and never keep it from serving the rest."""

from __future__ import annotations

import time

import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.timer import Timer

from iwm_power_manager.control.stepping import RealTime
from iwm_power_manager.nodes.pace import spin
from iwm_power_manager.ros.interruption import Interruption

#: Of the node's default rate.
PERIOD_S = 0.01


@pytest.fixture
def stamps(monkeypatch):
    """When steps were taken, monotonic s."""
    found: list[float] = []
    take = RealTime.step

    def noting(stepper, now_ns):
        found.append(time.monotonic())
        return take(stepper, now_ns)

    monkeypatch.setattr(RealTime, "step", noting)
    return found


def test_without_steps_there_is_nothing_to_wait_for(node) -> None:
    assert not node.step_when_due()
    assert node.trigger_configure() == TransitionCallbackReturn.SUCCESS
    assert not node.step_when_due()
    assert node.trigger_activate() == TransitionCallbackReturn.SUCCESS
    assert node.step_when_due()
    assert node.trigger_deactivate() == TransitionCallbackReturn.SUCCESS
    assert not node.step_when_due()


def test_it_waits_for_each_step_and_takes_it_once(node, stamps) -> None:
    assert node.start()
    began_s = time.monotonic()
    for _ in range(20):
        assert node.step_when_due()
    lasted_s = time.monotonic() - began_s
    assert len(stamps) == 20
    assert lasted_s > 18.5 * PERIOD_S  # never before it is due; how late it is, is the machine's affair
    # A call that came much too late is followed by the next due one, not by one for each that was missed.
    time.sleep(5.5 * PERIOD_S)
    for _ in range(3):
        assert node.step_when_due()
    assert stamps[-1] - stamps[-3] > PERIOD_S


def test_any_executor_steps_it_too_and_not_a_second_time(node, stamps) -> None:
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    assert node.start()
    assert node.step_when_due()
    taken = len(stamps)
    due_s = stamps[-1] + 0.5 * PERIOD_S
    executor.spin_once(timeout_sec=0.0)
    assert len(stamps) == taken or time.monotonic() > due_s
    deadline_s = time.monotonic() + 30.0
    while len(stamps) < taken + 5:
        assert time.monotonic() < deadline_s
        executor.spin_once(timeout_sec=0.1)
    executor.shutdown()


def test_the_nodes_own_loop_takes_its_steps_like_that_and_serves_the_rest(node, stamps, monkeypatch) -> None:
    assert node.start()
    interruption, waited, served = Interruption(started=True), [], []
    step_when_due = node.step_when_due

    def noting() -> bool:
        waited.append(len(stamps))
        interruption.requested = len(stamps) >= 20 and bool(served)
        return step_when_due()

    monkeypatch.setattr(node, "step_when_due", noting)

    def serve() -> None:
        served.append(len(stamps))
        interruption.requested |= len(served) > 400  # nobody asked for a step

    node.create_timer(0.5 * PERIOD_S, serve)
    spin(node, interruption)
    assert len(waited) >= 20 and served
    assert node.lifecycle_state() == "inactive"


def test_a_clock_set_back_does_not_stop_the_rest(node, monkeypatch) -> None:
    assert node.start()
    monkeypatch.setattr(Timer, "time_until_next_call", lambda _timer: 3_600_000_000_000)
    assert not node.step_when_due()


def test_on_simulated_time_the_executor_decides(node) -> None:
    assert node.start()
    assert node.set_parameters([Parameter("use_sim_time", value=True)])[0].successful
    assert node.get_clock().ros_time_is_active
    assert not node.step_when_due()
