# SPDX-License-Identifier: Apache-2.0
"""Mapping files: units, names, and one clear line for every mistake."""

from __future__ import annotations

from pathlib import Path

import pytest

from iwm_power_manager.errors import BagError, ConfigError
from iwm_power_manager.share import share_path
from iwm_power_manager.signals.mapping import load_mapping, topic_named

JOINT_STATE = "sensor_msgs/msg/JointState"


def mapping_file(folder: Path, text: str) -> Path:
    path = folder / "mapping.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("name", ["standard.yaml", "odometry_and_pedals.yaml", "four_topics.yaml"])
def test_the_mappings_of_the_package_are_valid(name: str) -> None:
    load_mapping(share_path(f"config/signals/{name}")).check_live()


def test_a_mapping_of_the_first_format_still_loads(tmp_path: Path) -> None:
    """Without types, as it was for bags, which know their own."""
    text = (
        "signals:\n  speed: {topic: vehicle_speed, field: twist.linear.x, unit: m/s}\n"
        "  wheel_speed: [{topic: a, field: data, unit: rpm}, {topic: b, field: data, unit: rpm},"
        " {topic: c, field: data, unit: rpm}, {topic: d, field: data, unit: rpm}]\n"
        "  power_demand: {topic: power_demand, field: data, unit: kW, factor: -1}\n"
    )
    mapping = load_mapping(mapping_file(tmp_path, text))
    assert mapping.topics() == ["vehicle_speed", "a", "b", "c", "d", "power_demand"]
    assert {source.type for found in mapping.sources.values() for source in found} == {""}


def test_wheels_get_other_names_only_where_they_are_found_by_name(tmp_path: Path) -> None:
    names = ("a", "b", "c", "d")
    assert load_mapping().with_wheel_names(names).sources["wheel_speed"][0].names == names
    path = mapping_file(tmp_path, "signals: {wheel_speed: {topic: w, field: data, unit: rpm}}")
    assert load_mapping(path).with_wheel_names(names).sources["wheel_speed"][0].names == ()


def test_a_topic_without_slash_is_found_in_its_namespace_unless_there_are_two() -> None:
    assert topic_named("speed", ["/car/speed", "/other"]) == "/car/speed"
    assert topic_named("/car/speed", ["/car/speed"]) == "/car/speed"
    assert topic_named("/speed", ["/car/speed"]) is None
    assert topic_named("speed", ["/overspeed"]) is None
    with pytest.raises(BagError, match="recorded in several namespaces: /a/speed, /b/speed"):
        topic_named("speed", ["/b/speed", "/a/speed"])


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("signals: {velocity: {}}", "signals.velocity"),
        ("signals: {speed: {topic: x, field: data}}", "unit"),
        (
            "signals: {speed: {topic: x, field: data, unit: knots}}",
            "signals.speed.unit: 'knots' is unknown; allowed: m/s",
        ),
        ("signals: {speed: {topic: 3, field: data, unit: m/s}}", "signals.speed.topic: 3 is no name"),
        ("signals: {speed: {topic: x, field: data, unit: m/s, factor: .nan}}", "signals.speed.factor"),
        ("signals: {speed: {topic: x, field: data, unit: m/s, factor: 0}}", "signals.speed.factor"),
        ("signals: {speed: {topic: x, field: data, unit: m/s, names: [a, b, c, d]}}", "names"),
        ("signals: {wheel_speed: {topic: x, field: data, unit: rpm, names: [a, a, b, c]}}", "four different names"),
        ("signals: {wheel_speed: [{topic: x, field: data, unit: rpm}]}", "signals.wheel_speed: 1 sources"),
        ("signals: {speed: {topic: x, field: data, unit: m/s, sign: 2}}", "signals.speed.sign: 2 is not allowed"),
        ("signals: {speed: {topic: x, field: data, unit: m/s, sign: [1, 1, 1, 1]}}", "allowed: 1, -1"),
        ("signals: {speed: {topic: x, field: data, unit: m/s, qos: fast}}", "signals.speed.qos: 'fast' is unknown"),
        ("signals: {speed: {topic: x, field: data, unit: m/s, stamp: never}}", "signals.speed.stamp"),
        ("signals: {speed: {topic: x, type: 3, field: data, unit: m/s}}", "signals.speed.type: 3 is no name"),
        ("topics: {}", "topics"),
    ],
)
def test_a_mistake_in_the_file_is_named(tmp_path: Path, text: str, line: str) -> None:
    with pytest.raises(ConfigError, match=r"mapping\.yaml") as caught:
        load_mapping(mapping_file(tmp_path, text))
    assert line in str(caught.value)
    assert "\n" not in str(caught.value)
