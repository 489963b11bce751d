# SPDX-License-Identifier: Apache-2.0
"""Torques to bytes: every shape a command may have, and one clear line for one it cannot have."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rclpy.serialization import deserialize_message

from iwm_power_manager.errors import ConfigError
from iwm_power_manager.ros import messages
from iwm_power_manager.signals.commands import COMMANDS, FRICTION, MOTOR, CommandWriter, standard
from iwm_power_manager.signals.contract import WHEEL_NAMES
from iwm_power_manager.signals.mapping import load_mapping

TORQUES = (1.0, -2.0, 3.5, 4.0)
SIGNALS = "signals: {speed: {topic: v, field: data, unit: m/s}}\n"
FILE = Path("signals.yaml")


def writer(folder: Path, motor: str, friction: str = "none") -> dict[str, CommandWriter]:
    path = folder / "signals.yaml"
    path.write_text(f"{SIGNALS}commands:\n  motor_torque: {motor}\n  friction_torque: {friction}\n")
    mapping = load_mapping(path)
    return {kind: CommandWriter(path, sinks) for kind, sinks in mapping.commands.items()}


def test_without_a_section_the_projects_own_commands_are_sent(tmp_path: Path) -> None:
    path = tmp_path / "signals.yaml"
    path.write_text(SIGNALS)
    assert load_mapping(path).commands == standard()
    assert load_mapping().commands == standard()
    assert tuple(standard()) == COMMANDS


def test_without_friction_brakes_alone_the_motors_have_the_projects_own_topic(tmp_path: Path) -> None:
    path = tmp_path / "signals.yaml"
    path.write_text(f"{SIGNALS}commands: {{friction_torque: none}}\n")
    assert load_mapping(path).commands == {MOTOR: standard()[MOTOR], FRICTION: ()}
    path.write_text(f"{SIGNALS}commands: {{friction_torque: {{}}}}\n")
    with pytest.raises(ConfigError, match=r"commands\.motor_torque: is missing; allowed: left out only with"):
        load_mapping(path)


@pytest.mark.parametrize("kind", COMMANDS)
def test_the_standard_command_is_the_joint_state_that_rclpy_writes(kind: str) -> None:
    ((topic, data),) = CommandWriter(FILE, standard()[kind])(5_000_000_007, TORQUES)
    expected = messages.joint_message(5_000_000_007, WHEEL_NAMES, effort=TORQUES)
    assert topic == {MOTOR: messages.WHEEL_TORQUE_COMMAND, FRICTION: messages.FRICTION_BRAKE_COMMAND}[kind]
    assert deserialize_message(data, messages.TOPIC_TYPES[topic]) == expected


def test_an_array_has_its_own_order_factor_and_signs(tmp_path: Path) -> None:
    write = writer(
        tmp_path,
        "{topic: a, type: std_msgs/msg/Float32MultiArray, field: data, unit: N m, factor: 2, sign: [1, -1, 1, -1],"
        " order: [rear_right, front_left, front_right, rear_left]}",
    )[MOTOR]
    ((topic, data),) = write(0, TORQUES)
    found = deserialize_message(data, messages.message_class("std_msgs/msg/Float32MultiArray"))
    assert (topic, list(found.data)) == ("a", [-8.0, 2.0, 4.0, 7.0])


def test_wheels_of_an_array_may_have_a_factor_each(tmp_path: Path) -> None:
    write = writer(
        tmp_path,
        "{topic: a, type: std_msgs/msg/Float64MultiArray, field: data, unit: N m, factor: [1, 2, 4, 8], sign: -1,"
        " order: [rear_right, front_left, front_right, rear_left]}",
    )[MOTOR]
    ((_, data),) = write(0, TORQUES)
    found = deserialize_message(data, messages.message_class("std_msgs/msg/Float64MultiArray"))
    assert list(found.data) == [-32.0, -1.0, 4.0, -14.0]


def test_whole_numbers_are_rounded_and_have_to_hold_the_largest_torque(tmp_path: Path) -> None:
    """As gateways to a CAN bus have them: tenths of N m in an Int16."""
    entry = "{topic: a, type: std_msgs/msg/Int16MultiArray, field: data, unit: N m, factor: -10}"
    write = writer(tmp_path, entry)[MOTOR]
    ((_, data),) = write(0, (200.04, -0.06, 0.0, -80.0))
    assert list(deserialize_message(data, messages.message_class("std_msgs/msg/Int16MultiArray")).data) == [
        -2000,
        1,
        0,
        800,
    ]
    sinks = load_mapping(tmp_path / "signals.yaml").commands[MOTOR]
    CommandWriter(FILE, sinks, 3276.7)
    with pytest.raises(ConfigError, match=r"cannot hold 4 torques of up to 3300 N m with their factor"):
        CommandWriter(FILE, sinks, 3300.0)


def test_names_follow_the_order_of_the_array(tmp_path: Path) -> None:
    write = writer(
        tmp_path,
        "{topic: a, type: sensor_msgs/msg/JointState, field: effort, unit: N m, names: [fl, fr, rl, rr],"
        " order: [rear_left, rear_right, front_left, front_right]}",
    )[MOTOR]
    ((_, data),) = write(0, TORQUES)
    found = deserialize_message(data, messages.message_class("sensor_msgs/msg/JointState"))
    assert dict(zip(found.name, found.effort, strict=True)) == dict(zip(("fl", "fr", "rl", "rr"), TORQUES, strict=True))


def test_four_topics_carry_a_wheel_each_and_none_carries_nothing(tmp_path: Path) -> None:
    entry = "{topic: tI, type: std_msgs/msg/Float64, field: data, unit: N m, sign: SIGN}"
    entries = [entry.replace("I,", f"{i},").replace("SIGN", str(1 - 2 * (i % 2))) for i in range(4)]
    written = writer(tmp_path, f"[{', '.join(entries)}]")
    kind = messages.message_class("std_msgs/msg/Float64")
    found = [(topic, deserialize_message(data, kind).data) for topic, data in written[MOTOR](0, TORQUES)]
    assert found == [("t0", 1.0), ("t1", 2.0), ("t2", 3.5), ("t3", -4.0)]
    assert written[FRICTION](0, TORQUES) == []


@pytest.mark.parametrize(
    ("msgtype", "field", "place"),
    [
        ("std_msgs/msg/Float64MultiArray", "data[2]", lambda found: found.data),
        ("sensor_msgs/msg/JointState", "effort[0]", lambda found: found.effort),
        ("trajectory_msgs/msg/JointTrajectory", "points[1].effort[2]", lambda found: found.points[1].effort),
    ],
)
def test_a_wheel_may_have_a_place_in_a_list_that_is_no_longer_than_that(
    tmp_path: Path, msgtype: str, field: str, place: Callable[[Any], Any]
) -> None:
    entries = [f'{{topic: t{i}, type: {msgtype}, field: "{field}", unit: N m}}' for i in range(4)]
    written = writer(tmp_path, f"[{', '.join(entries)}]")[MOTOR](0, TORQUES)
    found = [place(deserialize_message(data, messages.message_class(msgtype))) for _, data in written]
    last = int(field[-2])
    assert [list(one) for one in found] == [[0.0] * last + [torque] for torque in TORQUES]


def test_an_array_may_stand_in_a_message_of_a_list(tmp_path: Path) -> None:
    entry = '{topic: a, type: trajectory_msgs/msg/JointTrajectory, field: "points[0].effort", unit: N m}'
    ((_, data),) = writer(tmp_path, entry)[MOTOR](0, TORQUES)
    found = deserialize_message(data, messages.message_class("trajectory_msgs/msg/JointTrajectory"))
    assert [list(point.effort) for point in found.points] == [list(TORQUES)]


@pytest.mark.parametrize(
    ("motor", "problem"),
    [
        ("none", "commands.motor_torque"),
        ("{topic: a, type: std_msgs/msg/Float64, field: data, unit: N m}", "has no array data"),
        ("{topic: a, type: std_msgs/msg/Float64MultiArray, field: date, unit: N m}", "commands.motor_torque.field"),
        ("{topic: a, type: std_msgs/msg/UInt32MultiArray, field: data, unit: N m}", "data cannot hold 4 torques"),
        ("{topic: a, type: nobody_msgs/msg/None, field: data, unit: N m}", "commands.motor_torque.type"),
        ("{topic: a, type: std_msgs/msg/Float64MultiArray, field: data, unit: Nm}", "'Nm' is unknown; allowed: N m"),
        ("{topic: a, type: std_msgs/msg/Float64MultiArray, field: data, unit: N m, factor: 0}", "0 is out of"),
        ("{topic: a, type: std_msgs/msg/Float64MultiArray, field: data, unit: N m, factor: [1, 2]}", "factor"),
        ("[{topic: a, type: std_msgs/msg/Float64, field: data, unit: N m, factor: [1, 2, 4, 8]}, b, c, d]", "factor"),
        (
            "{topic: a, type: std_msgs/msg/Float64MultiArray, field: data, unit: N m, order: [rear_left]}",
            "allowed: an order of front_left, front_right, rear_left, rear_right",
        ),
        (
            "{topic: a, type: std_msgs/msg/Float64MultiArray, field: data, unit: N m, names: [a, b, c, d]}",
            "has no field `name` beside data",
        ),
        (
            "{topic: a, type: trajectory_msgs/msg/JointTrajectory, field: 'points[1000].effort', unit: N m}",
            "field: points[1000].effort is far back in a list; allowed: up to [999]",
        ),
        ("[{topic: a, type: std_msgs/msg/Float64, field: data, unit: N m}]", "1 topics; allowed: one for all wheels"),
    ],
)
def test_a_command_that_cannot_be_sent_is_one_line(tmp_path: Path, motor: str, problem: str) -> None:
    with pytest.raises(ConfigError) as caught:
        writer(tmp_path, motor)
    assert problem in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_topic_carries_one_command(tmp_path: Path) -> None:
    entry = "{topic: a, type: std_msgs/msg/Float64MultiArray, field: data, unit: N m}"
    with pytest.raises(ConfigError, match=r"friction_torque\.topic: a carries a command as well"):
        writer(tmp_path, entry, entry)
