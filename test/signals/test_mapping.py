# SPDX-License-Identifier: Apache-2.0
"""Mapping files: units, names, and one clear line for every mistake."""

from __future__ import annotations

import re
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


def test_a_short_name_of_a_type_is_the_long_one(tmp_path: Path) -> None:
    path = mapping_file(tmp_path, "signals: {speed: {topic: x, type: std_msgs/Float64, field: data, unit: m/s}}")
    assert load_mapping(path).sources["speed"][0].type == "std_msgs/msg/Float64"


def resolved(name: str) -> str:
    """Full name of a topic in the namespace /car; ROS fails at one that is far too long."""
    assert len(name) < 248
    return name if name.startswith("/") else f"/car/{name}"


@pytest.mark.parametrize(
    ("entries", "problem"),
    [
        ("topic: 'a b'", "signals.speed.topic: 'a b' is no name of a topic; allowed: words of letters, digits and _"),
        *(
            (f"topic: '{name}'", "is no name of a topic")
            for name in ("/a//b", "/a/", "/", "/1", "/a-b", "/ö", "/a/~b", "/" + "a" * 300, "a" * 245)
        ),
        ("topic: odom", "signals.soc.topic: /car/odom is /car/odom, and so is odom of signals.speed; allowed"),
        ("topic: splitter/state", "signals.speed.topic: /car/splitter/state is this node's own"),
        ("topic: /car/wheel_torque_command", "commands.motor_torque.topic: /car/wheel_torque_command is an input as"),
    ],
)
def test_a_topic_is_refused_where_the_node_has_its_name_and_namespace(
    tmp_path: Path, entries: str, problem: str
) -> None:
    soc = "soc: {topic: /car/odom, field: b, unit: '1'}"
    mapping = load_mapping(mapping_file(tmp_path, f"signals: {{speed: {{{entries}, field: a, unit: m/s}}, {soc}}}"))
    with pytest.raises(ConfigError, match=r"mapping\.yaml") as caught:
        mapping.check_topics(resolved, ["/car/splitter/state"])
    assert problem in str(caught.value)


def test_a_joint_state_needs_names_live(tmp_path: Path) -> None:
    text = share_path("config/signals/odometry_and_pedals.yaml").read_text()
    names = next(line for line in text.splitlines() if "names:" in line)
    with pytest.raises(ConfigError, match=r"signals.wheel_speed.names: is missing; .*; allowed: four names"):
        load_mapping(mapping_file(tmp_path, text.replace(names, ""))).check_live()


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


def test_the_unit_one_may_be_a_number(tmp_path: Path) -> None:
    text = "signals: {accelerator_pedal: {topic: x, field: data, unit: %s}}"
    one, quoted = (load_mapping(mapping_file(tmp_path, text % unit)).sources for unit in ("1", "'1'"))
    assert one == quoted


def test_a_topic_without_slash_is_found_in_its_namespace_unless_there_are_two() -> None:
    assert topic_named("speed", ["/car/speed", "/other"]) == "/car/speed"
    assert topic_named("/car/speed", ["/car/speed"]) == "/car/speed"
    assert topic_named("/speed", ["/car/speed"]) is None
    assert topic_named("speed", ["/overspeed"]) is None
    with pytest.raises(BagError, match="recorded in several namespaces: /a/speed, /b/speed"):
        topic_named("speed", ["/b/speed", "/a/speed"])


@pytest.mark.parametrize(("signal", "refused"), [("force_demand", True), ("brake_pedal", True), ("direction", False)])
@pytest.mark.parametrize("first", [True, False])
def test_a_demand_that_is_what_a_sensor_shows_is_refused(
    tmp_path: Path, signal: str, refused: bool, first: bool
) -> None:
    unit = {"force_demand": "N"}.get(signal, "'1'")
    lines = [
        "  speed: {topic: /odom, field: x, unit: m/s}\n",
        f"  {signal}: {{topic: /odom, field: x, unit: {unit}}}\n",
    ]
    path = tmp_path / "signals.yaml"
    path.write_text("signals:\n" + "".join(lines if first else lines[::-1]))
    if not refused:
        load_mapping(path).check_topics()
        return
    with pytest.raises(ConfigError, match=r"field: x of /odom is signals\.\w+ as well; allowed: a demand of its own"):
        load_mapping(path).check_topics()


@pytest.mark.parametrize(
    ("entries", "problem"),
    [
        (
            "signals: {wheel_speed: [fl, fr, fl, rr]}",
            "signals.wheel_speed[2].field: data of fl is another wheel's as well (signals.wheel_speed[0]); allowed: a",
        ),
        (
            "signals: {motor_torque: [fl, fr, rl, rl]}",
            "signals.motor_torque[3].field: data of rl is another wheel's as well (signals.motor_torque[2])",
        ),
        (
            "signals: {}\ncommands: {friction_torque: none, motor_torque: [fl, fl, rl, rr]}",
            "commands.motor_torque[1].topic: fl carries a command as well (commands.motor_torque[0])",
        ),
    ],
)
def test_one_number_for_two_wheels_is_refused_with_both(tmp_path: Path, entries: str, problem: str) -> None:
    text = entries
    for wheel in ("fl", "fr", "rl", "rr"):
        unit = "rpm" if "wheel_speed" in entries else "N m"
        text = re.sub(rf"\b{wheel}\b", f"{{topic: {wheel}, type: std_msgs/Float64, field: data, unit: {unit}}}", text)
    with pytest.raises(ConfigError) as caught:
        load_mapping(mapping_file(tmp_path, text))
    assert problem in str(caught.value)


def test_two_wheels_may_have_places_of_one_list_and_two_signals_one_number(tmp_path: Path) -> None:
    wheels = ", ".join(f"{{topic: w, field: 'data[{i}]', unit: rpm}}" for i in range(4))
    pedals = ", ".join(f"{p}_pedal: {{topic: axis, field: data, unit: '1'}}" for p in ("accelerator", "brake"))
    mapping = load_mapping(mapping_file(tmp_path, f"signals: {{wheel_speed: [{wheels}], {pedals}}}"))
    assert mapping.topics() == ["w", "axis"]


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
        ("signals: {speed: {topic: x, field: data, unit: m/s, factor: 0}}", "signals.speed.factor: 0 is out of range"),
        ("signals: {speed: {topic: x, field: data, unit: m/s, factor: -1e300}}", "allowed: 1e-09 to 1e+09, or as far"),
        ("signals: {speed: {topic: x, field: data, unit: m/s, offset: 1e300}}", "signals.speed.offset"),
        ("signals: {speed: {topic: x, field: a..b, unit: m/s}}", "signals.speed.field: 'a..b' is no path; allowed"),
        ("signals: {speed: {topic: x, field: 'data[-1]', unit: m/s}}", "signals.speed.field"),
        ("signals: {speed: {topic: x, type: a.msg.B, field: data, unit: m/s}}", "allowed: package/msg/Type"),
        (
            "signals: {speed: {topic: wheel_torque_command, field: data, unit: m/s}}",
            "commands.motor_torque.topic: wheel_torque_command is an input as well (signals.speed); allowed: a",
        ),
        ("signals: {speed: {topic: /diagnostics, field: data, unit: m/s}}", "speed.topic: /diagnostics is ROS's"),
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
