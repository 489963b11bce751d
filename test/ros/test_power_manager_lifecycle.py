# SPDX-License-Identifier: Apache-2.0
"""Each transition of the managed node, asked for with the real services over DDS."""

from __future__ import annotations

import signal

import pytest
from bench import TRANSITIONS

from iwm_power_manager.ros import messages


@pytest.fixture(scope="module")
def pair(start_pair):
    return start_pair({"autostart": False})


@pytest.fixture
def bench(pair):
    bench = pair.bench
    yield bench
    # Whatever a test did, the next one finds the node unconfigured.
    if bench.lifecycle_state() == "active":
        assert bench.change_state("deactivate")
    if bench.lifecycle_state() == "inactive":
        assert bench.change_state("cleanup")
    bench.set_parameter("policy_file", "")
    bench.set_parameter("strategy", "equal")
    bench.set_parameter("fallback", "none")
    bench.set_parameter("vehicle_file", "config/vehicles/jalalmaab_2015.yaml")


def bring_up(bench) -> None:
    assert bench.change_state("configure")
    assert bench.change_state("activate")
    bench.connect()


def drive_to_torque(bench) -> None:
    bench.drive(lambda: bench.mode() == 1 and bench.last("front_left_motor_torque_nm") > 30.0, "torque")


def test_without_autostart_it_starts_unconfigured_and_is_on_no_topic(bench) -> None:
    assert bench.lifecycle_state() == "unconfigured"
    assert bench.node.count_publishers(messages.WHEEL_TORQUE_COMMAND) == 0


def test_configured_it_is_inactive_and_commands_nothing(bench) -> None:
    assert bench.change_state("configure")
    assert bench.lifecycle_state() == "inactive"
    bench.connect()
    before = len(bench.torques)
    start = len(bench.diagnostics)
    bench.drive(lambda: len(bench.diagnostics) > start, "a report")
    assert len(bench.torques) == before
    assert bench.status("control").message == "inactive"


def test_activated_it_drives(bench) -> None:
    bring_up(bench)
    drive_to_torque(bench)
    assert bench.lifecycle_state() == "active"


def test_deactivated_it_commands_zero_first_and_nothing_after(bench) -> None:
    bring_up(bench)
    drive_to_torque(bench)
    assert bench.change_state("deactivate")
    bench.spin_until(lambda: list(bench.torques[-1].effort) == [0.0] * 4, "zero torque")
    bench.spin_until(lambda: list(bench.frictions[-1].effort) == [0.0] * 4, "zero friction")
    count = len(bench.torques)
    start = len(bench.diagnostics)
    bench.drive(lambda: len(bench.diagnostics) > start, "a report")
    assert len(bench.torques) == count
    assert bench.lifecycle_state() == "inactive"


def test_activated_again_it_starts_from_the_beginning(bench) -> None:
    bring_up(bench)
    drive_to_torque(bench)
    steps = bench.last("step")
    assert bench.change_state("deactivate")
    bench.states.clear()
    assert bench.change_state("activate")
    bench.spin_until(lambda: bench.states, "a step")
    assert bench.states[0]["step"] < steps  # the very first may be overwritten on its way
    assert bench.states[0]["mode"] == 0
    assert bench.states[0]["front_left_motor_torque_nm"] == 0.0
    drive_to_torque(bench)


def test_cleaned_up_it_leaves_the_topics_and_can_be_configured_again(bench) -> None:
    bring_up(bench)
    assert bench.change_state("deactivate")
    assert bench.change_state("cleanup")
    assert bench.lifecycle_state() == "unconfigured"
    bench.spin_until(lambda: not bench.node.count_publishers(messages.WHEEL_TORQUE_COMMAND), "no publisher")
    bring_up(bench)
    drive_to_torque(bench)


@pytest.mark.parametrize("transition", ["activate", "deactivate", "cleanup"])
def test_a_transition_that_does_not_exist_is_refused(pair, bench, transition) -> None:
    assert not bench.change_state(transition)
    assert bench.lifecycle_state() == "unconfigured"
    line = f"{transition} ({TRANSITIONS[transition]}) is refused: the node is unconfigured, from where it can "
    bench.spin_until(lambda: line in pair.running.text(), "the reason")
    assert "configure (1), shutdown (5)" in pair.running.text().split(line)[1]


@pytest.mark.parametrize(
    ("parameter", "value", "reason"),
    [
        ("policy_file", "/nowhere/policy.npz", "/nowhere/policy.npz: cannot be read"),
        ("vehicle_file", "/nowhere/car.yaml", "/nowhere/car.yaml: cannot be read"),
        ("policy_file", "config/vehicles/jalalmaab_2015.yaml", "is no policy file"),
    ],
)
def test_what_cannot_be_loaded_refuses_to_configure_and_says_why(bench, parameter, value, reason) -> None:
    assert bench.set_parameter("strategy", "sdp") == ""
    assert bench.set_parameter(parameter, value) == ""
    assert not bench.change_state("configure")
    assert bench.lifecycle_state() == "unconfigured"
    bench.spin_until(lambda: bench.status("fault") and reason in bench.status("fault").message, "the reason")


def test_with_the_fallback_it_runs_equal_and_says_so(bench) -> None:
    assert bench.set_parameter("strategy", "sdp") == ""
    assert bench.set_parameter("policy_file", "/nowhere/policy.npz") == ""
    assert bench.set_parameter("fallback", "equal") == ""
    bring_up(bench)
    drive_to_torque(bench)
    assert bench.last("setting.strategy") == 0
    assert bench.last("front_share") == 0.5
    bench.spin_until(lambda: bench.status("policy") and bench.status("policy").level == b"\x01", "a warning")
    assert "fallback to equal: /nowhere/policy.npz" in bench.status("policy").message
    assert "needs a policy" in bench.set_parameter("strategy", "sdp_lookahead")


def test_shut_down_while_active_it_commands_zero(start_pair) -> None:
    pair = start_pair()
    bench = pair.bench
    bench.connect()
    drive_to_torque(bench)
    assert bench.change_state("shutdown_active")
    bench.spin_until(lambda: list(bench.torques[-1].effort) == [0.0] * 4, "zero torque")
    assert bench.lifecycle_state() == "finalized"
    assert pair.running.stop() == 0


@pytest.mark.parametrize("before", ["unconfigured", "inactive"])
def test_shut_down_before_it_is_active_it_is_finalized_and_commands_nothing(start_pair, before) -> None:
    pair = start_pair({"autostart": False})
    bench = pair.bench
    if before == "inactive":
        assert bench.change_state("configure")
    assert bench.lifecycle_state() == before
    assert bench.change_state(f"shutdown_{before}")
    assert bench.lifecycle_state() == "finalized"
    assert not bench.change_state("configure")
    assert bench.torques == []
    assert pair.running.stop() == 0


@pytest.mark.parametrize("sig", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_with_zero_torque_and_exit_code_0(start_pair, sig) -> None:
    pair = start_pair()
    bench = pair.bench
    bench.connect()
    drive_to_torque(bench)
    pair.running.process.send_signal(sig)
    bench.spin_until(lambda: list(bench.torques[-1].effort) == [0.0] * 4, "zero torque")
    assert pair.running.wait() == 0
    assert "Traceback" not in pair.running.text()
