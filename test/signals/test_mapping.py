"""Mapping files: units, names, and one clear line for every mistake."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from bags_helpers import topic
from iwm_power_manager.bags.definitions import typestore
from iwm_power_manager.bags.metadata import Topic
from iwm_power_manager.errors import BagError, ConfigError
from iwm_power_manager.share import share_path
from iwm_power_manager.signals.mapping import extractors, load_mapping, topic_named

JOINT_STATE = "sensor_msgs/msg/JointState"


def mapping_file(folder: Path, text: str) -> Path:
    path = folder / "mapping.yaml"
    path.write_text(text)
    return path


def joints(names: list[str], velocity: list[float]) -> object:
    types = typestore().types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, 0), "")
    return types[JOINT_STATE](header, names, np.zeros(0), np.array(velocity), np.zeros(0))


@pytest.mark.parametrize("name", ["project.yaml", "odometry_and_pedals.yaml"])
def test_the_mappings_of_the_package_are_valid(name: str) -> None:
    assert "speed" in load_mapping(share_path(f"config/bags/{name}")).sources


@pytest.mark.parametrize(
    ("signal", "unit", "factor"),
    [
        ("speed", "km/h", 1 / 3.6),
        ("speed", "mph", 0.44704),
        ("power_demand", "kW", 1000.0),
        ("accelerator_pedal", '"%"', 0.01),
    ],
)
def test_values_arrive_in_si_units(tmp_path: Path, signal: str, unit: str, factor: float) -> None:
    path = mapping_file(tmp_path, f"signals: {{{signal}: {{topic: x, field: data, unit: {unit}, factor: -2}}}}")
    found = extractors(load_mapping(path), {"/car/x": topic("/car/x")})
    (extractor,) = found["/car/x"]
    (value,) = extractor.read(typestore().types["std_msgs/msg/Float64"](10.0))
    assert value == pytest.approx(-20.0 * factor, rel=1e-15)


def test_wheels_are_found_by_name_whatever_their_order(tmp_path: Path) -> None:
    path = mapping_file(
        tmp_path, "signals: {wheel_speed: {topic: j, field: velocity, unit: rpm, names: [fl, fr, rl, rr]}}"
    )
    (extractor,) = extractors(load_mapping(path), {"/j": topic("/j", JOINT_STATE)})["/j"]
    rpm = math.pi / 30.0
    assert extractor.read(joints(["rr", "x", "fl", "rl", "fr"], [4, 9, 1, 3, 2])) == pytest.approx(
        (rpm, 2 * rpm, 3 * rpm, 4 * rpm)
    )
    read = extractor.read(joints(["rr", "fl", "fl", "rl"], [4, 1, 1, 3]))
    assert [math.isnan(value) for value in read] == [True, True, False, False]  # one doubled, one missing
    assert all(map(math.isnan, extractor.read(joints(["fl", "fr", "rl", "rr"], [1, 2]))))


def test_wheels_without_names_are_taken_in_order_and_only_if_there_are_four(tmp_path: Path) -> None:
    path = mapping_file(tmp_path, "signals: {wheel_speed: {topic: j, field: velocity, unit: rad/s}}")
    (extractor,) = extractors(load_mapping(path), {"/j": topic("/j", JOINT_STATE)})["/j"]
    assert extractor.read(joints([], [1, 2, 3, 4])) == (1.0, 2.0, 3.0, 4.0)
    assert all(map(math.isnan, extractor.read(joints([], [1, 2, 3]))))


def test_each_wheel_may_have_a_topic_of_its_own(tmp_path: Path) -> None:
    sources = ", ".join(f"{{topic: /w{i}, field: data, unit: rad/s}}" for i in range(4))
    path = mapping_file(tmp_path, f"signals: {{wheel_speed: [{sources}]}}")
    found = extractors(load_mapping(path), {f"/w{i}": topic(f"/w{i}") for i in range(4)})
    assert [found[f"/w{i}"][0].wheel for i in range(4)] == [0, 1, 2, 3]


def test_a_type_only_the_bag_knows_is_decoded_by_its_own_definition(tmp_path: Path) -> None:
    text = "foreign_msgs/Inner inner\n" + "=" * 80 + "\nMSG: foreign_msgs/Inner\nuint16 speed_kmh\n"
    foreign = Topic("/v", "foreign_msgs/msg/Outer", text, "")
    path = mapping_file(tmp_path, "signals: {speed: {topic: /v, field: inner.speed_kmh, unit: km/h}}")
    (extractor,) = extractors(load_mapping(path), {"/v": foreign})["/v"]
    message = typestore().deserialize_cdr(b"\0\1\0\0\x24\0\0\0", "foreign_msgs/msg/Outer")
    assert extractor.read(message) == pytest.approx((10.0,))


def test_a_type_nobody_knows_is_named() -> None:
    mapping = load_mapping()
    with pytest.raises(BagError, match="message type nobody_msgs/msg/None: no definition found"):
        extractors(mapping, {"/vehicle_speed": Topic("/vehicle_speed", "nobody_msgs/msg/None", "", "")})


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
        ("signals: {speed: {topic: x, field: data, unit: m/s, names: [a, b, c, d]}}", "names"),
        ("signals: {wheel_speed: {topic: x, field: data, unit: rpm, names: [a, a, b, c]}}", "four different names"),
        ("signals: {wheel_speed: [{topic: x, field: data, unit: rpm}]}", "signals.wheel_speed: 1 sources"),
        ("topics: {}", "topics"),
    ],
)
def test_a_mistake_in_the_file_is_named(tmp_path: Path, text: str, line: str) -> None:
    with pytest.raises(ConfigError, match=r"mapping\.yaml") as caught:
        load_mapping(mapping_file(tmp_path, text))
    assert line in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("field", "problem"),
    [
        ("speed", "sensor_msgs/msg/JointState has no field speed"),
        ("header.stamp", "header.stamp is a message"),
        ("header.frame_id", "header.frame_id is a text"),
        ("velocity.x", "sensor_msgs/msg/JointState has no field velocity.x"),
        ("velocity", "velocity is an array; allowed: a field of sensor_msgs/msg/JointState that is a number"),
    ],
)
def test_a_field_that_is_no_number_is_named(tmp_path: Path, field: str, problem: str) -> None:
    path = mapping_file(tmp_path, f"signals: {{speed: {{topic: j, field: {field}, unit: m/s}}}}")
    with pytest.raises(ConfigError) as caught:
        extractors(load_mapping(path), {"/j": topic("/j", JOINT_STATE)})
    assert problem in str(caught.value)
