# SPDX-License-Identifier: Apache-2.0
"""What the node says, what it is called, and what it lets others change: seen from outside, over DDS."""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path
from typing import Any

import pytest
import rclpy
from bench import Bench, Running, arguments
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import State
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters
from rclpy.executors import SingleThreadedExecutor

from iwm_power_manager.nodes import power_manager_config as config
from iwm_power_manager.nodes import preparation
from iwm_power_manager.ros import messages, qos
from iwm_power_manager.ros.asking import Question
from iwm_power_manager.share import resolve

MODULE = "iwm_power_manager.nodes.power_manager"
DOMAIN = int(os.environ["ROS_DOMAIN_ID"])


def lines_with(running: Running, text: str) -> list[str]:
    return [line for line in running.text().splitlines() if text in line]


def test_the_log_tells_the_way_from_start_to_end(start_pair) -> None:
    pair = start_pair()
    bench, running = pair.bench, pair.running
    weak = bench.node.create_subscription(
        messages.TOPIC_TYPES[messages.WHEEL_TORQUE_COMMAND],
        messages.WHEEL_TORQUE_COMMAND,
        lambda _: None,
        rclpy.qos.QoSProfile(depth=1, durability=rclpy.qos.DurabilityPolicy.TRANSIENT_LOCAL),
    )
    silent = bench.publishers.pop(messages.BATTERY_STATE)
    bench.node.destroy_publisher(silent)
    bench.spin_until(lambda: lines_with(running, "battery_state (no publisher)"), "what it waits for, and why")
    battery = messages.TOPIC_TYPES[messages.BATTERY_STATE]
    bench.publishers[messages.BATTERY_STATE] = bench.node.create_publisher(
        battery, messages.BATTERY_STATE, qos.profile(lockstep=False)
    )
    bench.spin_until(lambda: len(lines_with(running, "waits for")) > 1, "the second word of what it waits for")
    waits = lines_with(running, "waits for")[0]
    assert all(name in waits for name in ("vehicle_speed", "wheel_states", "power_demand", "battery_state"))
    assert lines_with(running, "vehicle jalalmaab_2015 (")
    assert lines_with(running, "strategy equal, no policy")
    assert lines_with(running, "configured, 100 Hz: vehicle_speed from ")
    assert lines_with(running, ": active")
    bench.drive(lambda: lines_with(running, "first torque: "), "the first torque", soc=0.5)
    # "all inputs are there", or "recovered" where the machine made it miss some before it was looked at.
    bench.drive(lambda: lines_with(running, ": normal operation"), "normal operation")
    log = running.text()
    assert log.index("normal operation") < log.index("first torque: ")
    refused = "bench asks for another quality of service"
    bench.drive(lambda: lines_with(running, refused), "the subscriber that cannot hear")
    bench.drive(
        lambda: any("battery_state" in line for line in lines_with(running, "degraded, motor torque fades: ")),
        "the degraded state",
        without=(messages.BATTERY_STATE,),
    )
    bench.drive(lambda: lines_with(running, "recovered: normal operation"), "recovery")
    assert len(lines_with(running, refused)) == 1
    assert bench.status("command topics").level == b"\x02"
    bench.node.destroy_subscription(weak)
    assert running.stop() == 0
    assert lines_with(running, "inactive: zero torque was commanded")
    assert not lines_with(running, "ERROR")


def test_what_it_waits_for_says_why_nothing_is_heard(start_pair) -> None:
    """A sensor that offers less than the node was told to ask for, and stamps of another clock."""
    pair = start_pair({"qos_overrides.{namespace}/vehicle_speed.subscription.reliability": "reliable"})
    bench, running = pair.bench, pair.running
    bench.node.destroy_publisher(bench.publishers[messages.VEHICLE_SPEED])
    best_effort = qos.profile(lockstep=False, reliability="best_effort")
    kind = messages.TOPIC_TYPES[messages.VEHICLE_SPEED]
    bench.publishers[messages.VEHICLE_SPEED] = bench.node.create_publisher(kind, messages.VEHICLE_SPEED, best_effort)

    def told() -> bool:
        waits = lines_with(running, "waits for")
        return bool(waits) and "best effort publisher and reliable subscription" in waits[-1]

    unstamped = "stamp too old: by 1.8e+09 s, no stamp? then stamp: source"
    bench.drive(lambda: told() and unstamped in lines_with(running, "waits for")[-1], "the reasons", stamp_ns=1)
    assert len(lines_with(running, "offers another quality of service")) >= 1
    assert "best effort" in bench.status("input topics").message


def test_two_cars_on_one_domain_do_not_meet(tmp_path: Path, compiled_law: None) -> None:
    """Both with the shipped parameter file, one of them renamed; all on one /diagnostics."""
    params = str(resolve("config/nodes/power_manager.yaml"))
    names = [f"/car_{os.getpid()}_{i}" for i in range(2)]
    benches = [Bench(namespace=name) for name in names]
    heard: list[DiagnosticArray] = []
    benches[0].node.create_subscription(DiagnosticArray, "/diagnostics", heard.append, 100)
    states: list[Any] = []
    kind = messages.TOPIC_TYPES[messages.POWER_MANAGER_STATE]
    benches[1].node.create_subscription(kind, "splitter/state", states.append, 100)
    runs = []
    for i, name in enumerate(names):
        args = arguments({"strategy": "equal"}, {"__ns": name} | ({"__node": "splitter"} if i else {}))
        args[1:1] = ["--params-file", params]
        runs.append(Running(MODULE, args, DOMAIN, tmp_path))
    try:
        demands = (4000.0, -4000.0)

        def torques() -> list[float]:
            return [sum(bench.torques[-1].effort) if bench.torques else 0.0 for bench in benches]

        def driving() -> bool:
            for bench, demand in zip(benches, demands, strict=True):
                bench.send(demand=demand)
                bench.executor.spin_once(timeout_sec=0.0)
            return torques()[0] > 100.0 and torques()[1] < -100.0 and len(states) > 0

        benches[0].drive(driving, "two cars that do different things", demand=demands[0])
        full = [f"{names[0]}/power_manager", f"{names[1]}/splitter"]
        statuses = [status for array in heard for status in array.status]
        for name in full:
            mine = [status for status in statuses if status.hardware_id == name]
            assert {status.name for status in mine} >= {f"{name}: control"}
            assert all(status.name.startswith(f"{name}: ") for status in mine)
        for i in range(2):
            assert benches[i].node.count_publishers("wheel_torque_command") == 1
    finally:
        for run in runs:
            run.process.kill()
            run.process.wait()
        for bench in benches:
            bench.close()


def dump(bench: Bench) -> list[ParameterMessage]:
    """Every parameter with its value, as `ros2 param dump` asks for them."""
    names = bench.call(ListParameters, "list_parameters", ListParameters.Request()).result.names
    values = bench.call(GetParameters, "get_parameters", GetParameters.Request(names=names)).values
    return [ParameterMessage(name=name, value=value) for name, value in zip(names, values, strict=True)]


def test_an_active_node_loads_its_own_dump_and_still_refuses_a_change(start_pair) -> None:
    bench = start_pair().bench
    bench.connect()
    parameters = dump(bench)
    assert {"autostart", "lockstep", "vehicle_file", "use_sim_time"} <= {parameter.name for parameter in parameters}
    request = SetParameters.Request(parameters=parameters)
    results = bench.call(SetParameters, "set_parameters", request).results
    assert [(p.name, r.reason) for p, r in zip(parameters, results, strict=True) if not r.successful] == []
    assert bench.set_parameter("rate_hz", 50.0) != ""
    assert bench.set_parameter("autostart", False) != ""
    assert bench.set_parameter("friction", 0.4) == ""


def test_locked_parameters_change_only_while_it_is_not_active(start_pair) -> None:
    bench = start_pair({"lock_parameters": True}).bench
    bench.connect()
    assert "lock_parameters" in bench.set_parameter("friction", 0.4)
    assert bench.change_state("deactivate")
    assert bench.set_parameter("friction", 0.4) == ""
    assert bench.set_parameter("lock_parameters", False) != ""


def test_the_full_stop_and_full_throttle_of_a_strong_car_are_believed() -> None:
    car = {"vehicle_file": "config/vehicles/compact_two_motors.yaml", "policy_file": "", "strategy": "equal"}
    monitor = preparation.prepare(config.DEFAULTS | car).controller.monitor
    assert monitor.take_demand(300e3, 0.0, 10**9)
    assert monitor.take_demand(-750e3, 0.0, 2 * 10**9)


def test_services_are_answered_while_it_prepares(node: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    release, begun = threading.Event(), threading.Event()
    prepare = preparation.prepare

    def slow(values: Any) -> Any:
        begun.set()
        assert release.wait(60.0)
        return prepare(values)

    monkeypatch.setattr(preparation, "prepare", slow)
    client_node = rclpy.create_node("client", namespace="/here")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    executor.add_node(client_node)
    change = client_node.create_client(ChangeState, "power_manager/change_state")
    state = client_node.create_client(GetState, "power_manager/get_state")
    read = client_node.create_client(GetParameters, "power_manager/get_parameters")

    def spin_until(condition: Any) -> Any:
        end = time.monotonic() + 60.0
        while not (found := condition()):
            assert time.monotonic() < end
            executor.spin_once(timeout_sec=0.05)
        return found

    spin_until(lambda: all(client.service_is_ready() for client in (change, state, read)))
    request = ChangeState.Request()
    request.transition.label = "configure"
    configured = change.call_async(request)
    spin_until(begun.is_set)
    for client, asked in ((state, GetState.Request()), (read, GetParameters.Request(names=["friction"]))):
        spin_until(Question(client, asked).answer)
    assert not configured.done()
    answer = spin_until(Question(state, GetState.Request()).answer)
    assert answer.current_state.id == State.PRIMARY_STATE_UNCONFIGURED
    release.set()
    spin_until(configured.done)
    assert configured.result().success
    executor.remove_node(node)
    executor.shutdown()
    client_node.destroy_node()
