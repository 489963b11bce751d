# SPDX-License-Identifier: Apache-2.0
"""docs/interface.md, docs/interface.json and config/security/ say what the sources say, and what running nodes show."""

from __future__ import annotations

import importlib.util
import json
import os
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import ModuleType
from xml.etree import ElementTree

import pytest
from bench import Running, arguments
from rcl_interfaces.srv import ListParameters
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, ReliabilityPolicy

from iwm_power_manager.ros.asking import Question

ROOT = Path(__file__).resolve().parents[2]
INTERFACE = json.loads((ROOT / "docs" / "interface.json").read_text())
RELIABILITIES = {"best_effort": ReliabilityPolicy.BEST_EFFORT, "reliable": ReliabilityPolicy.RELIABLE}
DURABILITIES = {"volatile": DurabilityPolicy.VOLATILE, "transient_local": DurabilityPolicy.TRANSIENT_LOCAL}
PERIOD_S = 0.01


@pytest.fixture(scope="module")
def module() -> ModuleType:
    path = ROOT / "scripts" / "update_interface"
    loader = SourceFileLoader("update_interface", str(path))
    found = importlib.util.module_from_spec(importlib.util.spec_from_loader("update_interface", loader))
    loader.exec_module(found)
    return found


def test_topics_signals_and_parameters_are_documented_as_they_are(module: ModuleType) -> None:
    page = (ROOT / "docs" / "interface.md").read_text()
    assert module.interface_page(page) == page, "run scripts/update_interface"
    assert module.interface_json() == (ROOT / "docs" / "interface.json").read_text(), "run scripts/update_interface"


def test_the_security_policies_allow_what_the_interface_names_and_nothing_else(module: ModuleType) -> None:
    for name, text in module.policies().items():
        assert (ROOT / "config" / "security" / name).read_text() == text, "run scripts/update_interface"
    profile = ElementTree.parse(ROOT / "config" / "security" / "power_manager.policy.xml").getroot().find(".//profile")
    allowed = {
        right: {item.text for group in profile.findall(f"*[@{right}='ALLOW']") for item in group}
        for right in ("publish", "subscribe", "reply")
    }
    named = {
        direction: {t["name"] for t in INTERFACE["topics"] if t["direction"] == direction}
        for direction in ("in", "out")
    }
    ros = {"/rosout", "/parameter_events", "~/transition_event"}
    assert allowed["publish"] == named["out"] | ros
    assert allowed["subscribe"] == named["in"] | {"/clock", "/parameter_events"}
    services = {s["name"] for s in INTERFACE["services"] if s["node"] == "power_manager"}
    assert allowed["reply"] == {f"~/{name}" for name in services}


def qualified(name: str, namespace: str, node: str) -> str:
    """A name of the interface as it is on a domain where `/diagnostics` and `/clock` live in the namespace, too."""
    if name.startswith("~"):
        return name.replace("~", f"{namespace}/{node}")
    return f"{namespace}/{name.lstrip('/')}"


@pytest.fixture(scope="module")
def all_three(start_pair, tmp_path_factory):
    """Simulator and recorder beside a power manager, each in a process of its own; the bench looks on."""
    pair = start_pair()
    namespace = pair.bench.node.get_namespace()
    folder = tmp_path_factory.mktemp("three")
    remaps = {"__ns": namespace, "/diagnostics": f"{namespace}/diagnostics", "/clock": f"{namespace}/clock"}
    domain = int(os.environ["ROS_DOMAIN_ID"])
    scenario = {"scenario_file": "stop_09", "speed_factor": 2.0, "wait_for_recorder": True}
    runs = [
        Running("iwm_sim.simulator", arguments(scenario, remaps), domain, folder),
        Running("iwm_power_manager.nodes.recorder", arguments({"output": folder / "bag"}, remaps), domain, folder),
    ]
    yield pair.bench
    for run in runs:
        run.process.kill()
        run.process.wait()


@pytest.mark.parametrize("name", ["power_manager", "simulator", "recorder"])
def test_a_running_node_advertises_the_interface(all_three, name: str) -> None:
    bench = all_three
    node, namespace = bench.node, bench.node.get_namespace()
    known = {qualified(t["name"], namespace, "power_manager"): t for t in INTERFACE["topics"]}

    def mine(infos):
        return [info for info in infos if (info.node_name, info.node_namespace) == (name, namespace)]

    shown = set()
    for direction, ask in (
        ("publishes", node.get_publishers_info_by_topic),
        ("subscribes", node.get_subscriptions_info_by_topic),
    ):
        for topic in INTERFACE["nodes"][name][direction]:
            if topic in ("~/transition_event", "/clock") and name == "power_manager":
                continue  # rclpy's own, the second only with use_sim_time
            full = qualified(topic, namespace, name)
            (info,) = bench.spin_until(lambda ask=ask, full=full: mine(ask(full)), f"{name} on {full}")
            shown.add(full)
            meant = known[full]
            assert (info.topic_type, str(info.topic_type_hash)) == (meant["type"], meant["type_hash"])
            # Of an input the interface says what is asked for, of all else what is offered.
            if name == "power_manager" or (direction == "publishes" and meant["direction"] != "in"):
                check_quality(info.qos_profile, meant["qos"])
    # Nothing is there that the interface does not name.
    own = {"/rosout", "/parameter_events", f"{namespace}/{name}/transition_event"}
    published = {found for found, _ in node.get_publisher_names_and_types_by_node(name, namespace)}
    subscribed = {found for found, _ in node.get_subscriber_names_and_types_by_node(name, namespace)}
    assert (published | subscribed) - shown <= own
    services = dict(node.get_service_names_and_types_by_node(name, namespace))
    expected = {
        f"{namespace}/{name}/{service['name']}": [service["type"]]
        for service in INTERFACE["services"]
        if service["node"] == name
    }
    assert {name: kinds for name, kinds in services.items() if "type_description" not in name} == expected


def check_quality(found, meant) -> None:
    assert found.reliability == RELIABILITIES[meant["reliability"]]
    assert found.durability == DURABILITIES[meant["durability"]]
    if meant["deadline_periods"]:
        assert found.liveliness == LivelinessPolicy.MANUAL_BY_TOPIC
        assert found.deadline == Duration(seconds=meant["deadline_periods"] * PERIOD_S)
        assert found.lifespan == Duration(seconds=meant["lifespan_periods"] * PERIOD_S)
        assert found.liveliness_lease_duration == Duration(seconds=meant["lease_periods"] * PERIOD_S)
    else:
        assert found.liveliness == LivelinessPolicy.AUTOMATIC


@pytest.mark.parametrize("name", ["power_manager", "simulator", "recorder"])
def test_a_running_node_has_the_parameters_of_the_interface(all_three, name: str) -> None:
    bench = all_three
    own = ("qos_overrides.", "use_sim_time", "start_type_description_service")
    request = ListParameters.Request()
    client = bench.node.create_client(ListParameters, f"{name}/list_parameters")
    bench.spin_until(client.service_is_ready, "the service")
    answer = bench.spin_until(Question(client, request).answer, "the answer")
    found = {parameter for parameter in answer.result.names if not parameter.startswith(own)}
    assert found == {parameter["name"] for parameter in INTERFACE["parameters"][name]}
