# SPDX-License-Identifier: Apache-2.0
"""docs/safety.md, duty 7: the node shares no memory unless it is asked to, and still hears nodes that do."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from bench import Bench, Running, arguments
from member import domain

from campaigns import soak
from iwm_power_manager.ros.transport import leave_shared_memory

LOCAL = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}


@pytest.mark.parametrize(("more", "shares"), [({}, False), ({"FASTDDS_BUILTIN_TRANSPORTS": "DEFAULT"}, True)])
def test_it_drives_and_is_heard_and_shares_memory_only_if_asked_to(
    tmp_path: Path, compiled_law: None, more: dict[str, str], shares: bool
) -> None:
    namespace = f"/without_shared_memory_{os.getpid()}"
    # The bench runs with LOCALHOST, as all tests do, and has shared memory.
    bench = Bench(namespace=namespace)
    args = arguments(
        {"strategy": "equal", "policy_file": ""}, {"__ns": namespace, "/diagnostics": f"{namespace}/diagnostics"}
    )
    environment = {"FASTRTPS_DEFAULT_PROFILES_FILE": "", **more}
    running = Running("iwm_power_manager.nodes.power_manager", args, domain(), tmp_path, environment)
    try:
        bench.connect()
        bench.drive(lambda: bench.states and bench.states[-1]["mode"] == 1.0, "the normal mode")
        assert soak.shares_memory(running.process.pid) == shares
        assert soak.shares_memory(os.getpid())
        assert running.stop() == 0, running.text()
    finally:
        bench.close()
        running.process.kill()
        running.process.wait()
    assert not soak.shares_memory(running.process.pid)  # it has ended


@pytest.mark.parametrize("given", [{}, {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}])
def test_across_computers_fast_dds_brings_udp_only(given: dict[str, str]) -> None:
    environment = dict(given)
    leave_shared_memory(environment)
    assert environment == given | {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}


@pytest.mark.parametrize("given", [LOCAL, {"ROS_LOCALHOST_ONLY": "1", "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}])
def test_on_one_computer_the_profile_keeps_to_it(given: dict[str, str]) -> None:
    environment = dict(given)
    leave_shared_memory(environment)
    assert "ROS_LOCALHOST_ONLY" not in environment
    assert environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "SYSTEM_DEFAULT"
    profile = Path(environment["FASTRTPS_DEFAULT_PROFILES_FILE"]).read_text()
    assert "<address>127.0.0.1</address>" in profile


@pytest.mark.parametrize(
    "given",
    [
        LOCAL | {"FASTRTPS_DEFAULT_PROFILES_FILE": "mine.xml"},
        {"FASTDDS_BUILTIN_TRANSPORTS": "LARGE_DATA"},
        LOCAL | {"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"},
        LOCAL | {"ROS_STATIC_PEERS": "10.0.0.2"},
    ],
)
def test_what_was_chosen_by_others_is_left_alone(given: dict[str, str]) -> None:
    environment = dict(given)
    leave_shared_memory(environment)
    assert environment == given
