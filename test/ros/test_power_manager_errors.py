# SPDX-License-Identifier: Apache-2.0
"""Errors nobody expects lead to a defined state: zero torque, and the node says why."""

from __future__ import annotations

import time

import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import TransitionCallbackReturn
from sensor_msgs.msg import JointState

from iwm_power_manager.control.controller import ControlFaultError, Controller
from iwm_power_manager.nodes import power_manager_node, preparation
from iwm_power_manager.ros import messages, qos


@pytest.fixture
def executor(node):
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    yield executor
    executor.shutdown()


def faults(node) -> list[str]:
    return [status.message for status in node.own_statuses() if status.name == "fault"]


@pytest.mark.parametrize(("module", "function"), [(preparation, "prepare"), (power_manager_node, "Outputs")])
def test_an_error_while_configuring_leads_to_unconfigured_and_can_be_overcome(
    node, monkeypatch, module, function
) -> None:
    def broken(*_) -> None:
        raise RuntimeError("out of luck")

    with monkeypatch.context() as patch:
        patch.setattr(module, function, broken)
        assert node.trigger_configure() == TransitionCallbackReturn.FAILURE
        assert node.lifecycle_state() == "unconfigured"
        assert faults(node) == ["RuntimeError: out of luck"]
        assert node.count_publishers(messages.WHEEL_TORQUE_COMMAND) == 0
    assert node.trigger_configure() == TransitionCallbackReturn.SUCCESS
    assert node.lifecycle_state() == "inactive"
    assert node.trigger_cleanup() == TransitionCallbackReturn.SUCCESS


def test_a_fault_of_the_law_ends_in_zero_torque_and_inactive(node, executor, monkeypatch) -> None:
    received: list[JointState] = []
    node.create_subscription(JointState, messages.WHEEL_TORQUE_COMMAND, received.append, qos.profile(lockstep=True))
    assert node.start()

    def until(condition, what) -> None:
        end = time.monotonic() + 60.0
        while not condition():
            assert time.monotonic() < end, what
            executor.spin_once(timeout_sec=0.1)

    until(lambda: received, "a command")

    def broken(*_args) -> None:
        raise ControlFaultError("torque of wheel 0 is not finite")

    monkeypatch.setattr(Controller, "step", broken)
    until(lambda: node.lifecycle_state() == "inactive", "inactive")
    assert faults(node) == ["torque of wheel 0 is not finite"]
    # What was under way arrives; after that there is nothing more.
    counts = []
    for _ in range(2):
        for _ in range(20):
            executor.spin_once(timeout_sec=0.02)
        counts.append(len(received))
    assert counts[0] == counts[1]
    assert list(received[-1].effort) == [0.0] * 4


def test_any_other_error_while_active_ends_there_too(node) -> None:
    assert node.start()
    node.fail("KeyError: 'x'")
    assert node.lifecycle_state() == "inactive"
    assert faults(node) == ["KeyError: 'x'"]
    assert node.trigger_activate() == TransitionCallbackReturn.SUCCESS
    assert faults(node) == []
