# SPDX-License-Identifier: Apache-2.0
"""docs/interface.md, docs/interface.json and config/security/ say what the sources say, and what running nodes show."""

from __future__ import annotations

import importlib.util
import json
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import ModuleType
from xml.etree import ElementTree

import pytest
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, ReliabilityPolicy

ROOT = Path(__file__).resolve().parents[2]
INTERFACE = json.loads((ROOT / "docs" / "interface.json").read_text())
RELIABILITIES = {"best_effort": ReliabilityPolicy.BEST_EFFORT, "reliable": ReliabilityPolicy.RELIABLE}
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


def test_a_running_node_advertises_the_interface(start_pair) -> None:
    bench = start_pair().bench
    bench.connect()
    node, namespace = bench.node, bench.node.get_namespace()

    def mine(infos):
        return [info for info in infos if (info.node_name, info.node_namespace) == ("power_manager", namespace)]

    shown = set()
    for topic in (topic for topic in INTERFACE["topics"] if topic["direction"]):
        name = topic["name"].replace("~", f"{namespace}/power_manager")
        name = f"{namespace}/diagnostics" if name == "/diagnostics" else name
        name = name if name.startswith("/") else f"{namespace}/{name}"
        ask = node.get_publishers_info_by_topic if topic["direction"] == "out" else node.get_subscriptions_info_by_topic
        (info,) = bench.spin_until(lambda ask=ask, name=name: mine(ask(name)), name)
        shown.add(name)
        assert info.topic_type == topic["type"]
        assert str(info.topic_type_hash) == topic["type_hash"]
        qos = topic["qos"]
        assert info.qos_profile.reliability == RELIABILITIES[qos["reliability"]]
        assert info.qos_profile.durability == DurabilityPolicy.VOLATILE
        if qos["deadline_periods"]:
            assert info.qos_profile.liveliness == LivelinessPolicy.MANUAL_BY_TOPIC
            assert info.qos_profile.deadline == Duration(seconds=qos["deadline_periods"] * PERIOD_S)
            assert info.qos_profile.liveliness_lease_duration == Duration(seconds=qos["lease_periods"] * PERIOD_S)
        else:
            assert info.qos_profile.liveliness == LivelinessPolicy.AUTOMATIC
    # Nothing is there that the interface does not name.
    own = {"/rosout", "/parameter_events", f"{namespace}/power_manager/transition_event"}
    published = {name for name, _ in node.get_publisher_names_and_types_by_node("power_manager", namespace)}
    subscribed = {name for name, _ in node.get_subscriber_names_and_types_by_node("power_manager", namespace)}
    assert (published | subscribed) - shown <= own
    services = dict(node.get_service_names_and_types_by_node("power_manager", namespace))
    expected = {
        f"{namespace}/power_manager/{service['name']}": [service["type"]]
        for service in INTERFACE["services"]
        if service["node"] == "power_manager"
    }
    assert {name: kinds for name, kinds in services.items() if "type_description" not in name} == expected
