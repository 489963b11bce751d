# SPDX-License-Identifier: Apache-2.0
"""Readings from bytes are those of the decoded message, whatever came before and however the signals are spread."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from geometry_msgs.msg import Twist, TwistStamped
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import serialize_message
from sensor_msgs.msg import BatteryState, JointState, MultiDOFJointState
from std_msgs.msg import Float32MultiArray, Float64, Int16, Int16MultiArray

from iwm_power_manager.control.inputs import Violation, check_names
from iwm_power_manager.control.monitor import BatteryReading, JointReading, SpeedReading
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.model.pedals import (
    acceleration_power_w,
    force_power_w,
    full_braking_w,
    pedal_power_w,
    torque_power_w,
)
from iwm_power_manager.ros import messages
from iwm_power_manager.share import share_path
from iwm_power_manager.signals.contract import WHEEL_NAMES
from iwm_power_manager.signals.mapping import load_mapping
from iwm_power_manager.signals.readings import (
    Assembly,
    DemandReading,
    DirectionReading,
    FrictionReading,
    MotionReading,
    TopicReader,
    TorqueReading,
    topic_readers,
)
from iwm_power_manager.signals.types import types_of
from iwm_power_manager.vehicle import load_vehicle
from oracles import readings as oracle

numbers = st.floats(width=64)
singles = st.floats(width=32)
names = st.lists(st.sampled_from(("front_left", "front_right", "x", "")), max_size=5)
frames = st.sampled_from(("", "a", "base_link", "a_frame_with_a_long_name"))
stamps = st.tuples(st.integers(-(2**31), 2**31 - 1), st.integers(0, 2**32 - 1))
CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params


def readers_of(mapping: Any, assembly: Assembly) -> dict[str, TopicReader]:
    types = {source.topic: types_of(source.type) for found in mapping.sources.values() for source in found}
    return topic_readers(mapping, types, assembly)


OWN = load_mapping()


def reader(topic: str) -> TopicReader:
    return readers_of(OWN, Assembly(WHEEL_NAMES))[topic]


def read_from(tmp_path: Path, text: str, speed_mps: float = 0.0) -> dict[str, TopicReader]:
    path = tmp_path / "signals.yaml"
    path.write_text(f"signals:\n{text}")
    return readers_of(load_mapping(path), Assembly(WHEEL_NAMES, CAR, lambda: speed_mps))


def number(value: float) -> bytes:
    return serialize_message(Float64(data=value))


def stamped(message, stamp: tuple[int, int], frame: str):
    message.header.stamp.sec, message.header.stamp.nanosec = stamp
    message.header.frame_id = frame
    return message


@st.composite
def speeds(draw) -> TwistStamped:
    message = stamped(TwistStamped(), draw(stamps), draw(frames))
    message.twist.linear.x, message.twist.linear.y = draw(numbers), draw(numbers)
    return message


@st.composite
def wheels(draw) -> JointState:
    message = stamped(JointState(), draw(stamps), draw(frames))
    message.name = draw(names)
    for field in ("position", "velocity", "effort"):
        count = draw(st.sampled_from((len(message.name), 0, 1)))
        setattr(message, field, draw(st.lists(numbers, min_size=count, max_size=count)))
    return message


@st.composite
def batteries(draw) -> BatteryState:
    message = stamped(BatteryState(), draw(stamps), draw(frames))
    for field in ("voltage", "temperature", "current", "charge", "capacity", "design_capacity", "percentage"):
        setattr(message, field, draw(singles))
    message.cell_voltage = draw(st.lists(singles, max_size=3))
    message.location = draw(frames)
    return message


@st.composite
def floats(draw) -> Float64:
    return Float64(data=draw(numbers))


#: Topic, its readings by way of rclpy's message, and any such message.
KINDS = {
    "vehicle_speed": (lambda m, _: (oracle.vehicle_speed(m),), speeds()),
    "wheel_states": (lambda m, _: (oracle.wheel_speeds(m), TorqueReading(*messages.read_torques(m))), wheels()),
    "battery_state": (lambda m, _: (oracle.battery_state(m),), batteries()),
    "power_demand": (lambda m, sent_ns: (DemandReading(sent_ns, m.data),), floats()),
    "road_friction": (lambda m, sent_ns: (FrictionReading(sent_ns, m.data),), floats()),
}
EXAMPLES = {
    "vehicle_speed": lambda i: messages.vehicle_speed_message(i, 2.0 * i),
    "wheel_states": lambda i: messages.joint_message(i, WHEEL_NAMES, velocity=(1.0 * i, 2.0, 3.0, 4.0)),
    "battery_state": lambda i: messages.battery_state_message(i, soc=0.5, voltage_v=2.0 * i, discharge_current_a=1.0),
    "power_demand": lambda i: messages.number_message(3.0 * i),
    "road_friction": lambda i: messages.number_message(0.1 * i),
}


@pytest.mark.parametrize("topic", KINDS)
@given(data=st.data())
def test_any_sequence_reads_as_if_decoded(topic: str, data: st.DataObject) -> None:
    read, any_message = KINDS[topic]
    quick = reader(topic)
    for message in data.draw(st.lists(any_message, min_size=1, max_size=6)):
        for _ in range(2):  # the second time quickly
            assert repr(quick(serialize_message(message), 9)) == repr(read(message, 9))


@pytest.mark.parametrize("topic", KINDS)
def test_only_the_first_of_a_kind_is_decoded(topic: str) -> None:
    quick = reader(topic)
    for i in range(1, 5):
        assert quick(serialize_message(EXAMPLES[topic](i)), i) == KINDS[topic][0](EXAMPLES[topic](i), i)
    assert quick.read.decoded == 1


@pytest.mark.parametrize("topic", KINDS)
@pytest.mark.parametrize("cut", [0, 3, 4, 11])
def test_bytes_that_are_no_message_are_a_bad_reading_and_the_next_is_read(topic: str, cut: int) -> None:
    quick, good = reader(topic), serialize_message(EXAMPLES[topic](1))
    for before in (b"", good):
        if before:
            quick(before, 1)
        (found,) = quick(good[:cut], 1)
        measured = found.values if isinstance(found, JointReading) else found[1:2]
        assert all(math.isnan(value) for value in measured)
        assert quick(good, 1) == KINDS[topic][0](EXAMPLES[topic](1), 1)


@pytest.mark.parametrize(
    ("msgtype", "field", "message"),
    [
        ("geometry_msgs/msg/Twist", "linear.x", lambda m: setattr(m.linear, "x", 36.0)),
        ("nav_msgs/msg/Odometry", "twist.twist.linear.x", lambda m: setattr(m.twist.twist.linear, "x", 36.0)),
        (
            "geometry_msgs/msg/TwistWithCovarianceStamped",
            "twist.twist.linear.x",
            lambda m: setattr(m.twist.twist.linear, "x", 36.0),
        ),
        ("std_msgs/msg/Float64MultiArray", "data[2]", lambda m: setattr(m, "data", [0.0, 1.0, 36.0])),
        ("std_msgs/msg/UInt16", "data", lambda m: setattr(m, "data", 36)),
    ],
)
def test_speed_from_any_numeric_field_in_its_unit(tmp_path: Path, msgtype: str, field: str, message: Any) -> None:
    sent = messages.message_class(msgtype)()
    message(sent)
    quick = read_from(tmp_path, f"  speed: {{topic: v, type: {msgtype}, field: '{field}', unit: km/h, offset: -18}}")[
        "v"
    ]
    for _ in range(2):
        (found,) = quick(serialize_message(sent), 77)
        assert isinstance(found, SpeedReading)
        assert found == (0 if quick.stamped else 77, pytest.approx(5.0))


def test_wheels_of_one_message_may_stand_in_any_order_and_in_lists_of_messages(tmp_path: Path) -> None:
    """docs/connect.md: an index for each wheel, four sources of the same topic."""

    def wheels(fields: list[str], msgtype: str) -> str:
        each = [f"{{topic: w, type: {msgtype}, field: '{field}', unit: rad/s}}" for field in fields]
        return f"  wheel_speed: [{', '.join(each)}]"

    swapped = wheels([f"data[{i}]" for i in (1, 0, 3, 2)], "std_msgs/msg/Float32MultiArray")
    twists = MultiDOFJointState(twist=[Twist() for _ in range(4)])
    for twist, speed in zip(twists.twist, (2.0, 1.0, 4.0, 3.0), strict=True):
        twist.angular.y = speed
    nested = wheels([f"twist[{i}].angular.y" for i in (1, 0, 3, 2)], "sensor_msgs/msg/MultiDOFJointState")
    for text, sent in ((swapped, Float32MultiArray(data=[2.0, 1.0, 4.0, 3.0])), (nested, twists)):
        quick = read_from(tmp_path, text)["w"]
        for _ in range(2):
            (found,) = quick(serialize_message(sent), 7)
            assert isinstance(found, JointReading)
            assert found.values == (1.0, 2.0, 3.0, 4.0)


@pytest.mark.parametrize("sign", ["[-1, -1, -1, -1]", "[1, 1, 1, -1]", "-1"])
def test_a_sign_turns_the_number_with_its_offset_around(tmp_path: Path, sign: str) -> None:
    """In an array and alone: counts of an encoder whose zero is not the wheel's."""
    text = f"{{topic: w, type: T, field: data, unit: rad/s, factor: 0.5, offset: 100, sign: {sign}}}"
    quick = read_from(tmp_path, "  wheel_speed: " + text.replace("T,", "std_msgs/msg/Int16MultiArray,"))["w"]
    (found,) = quick(serialize_message(Int16MultiArray(data=[0, 0, 0, -220])), 7)
    assert isinstance(found, JointReading)
    assert found.values[3] == 10.0
    alone = text.replace("T,", "std_msgs/msg/Int16,").replace(sign, "-1").replace("rad/s", "km/h")
    (speed,) = read_from(tmp_path, "  speed: " + alone)["w"](serialize_message(Int16(data=-220)), 7)
    assert isinstance(speed, SpeedReading)
    assert speed.speed_mps == pytest.approx(10.0 / 3.6)


def test_wheels_are_found_by_name_and_carry_the_controllers_names(tmp_path: Path) -> None:
    quick = read_from(
        tmp_path,
        "  wheel_speed: {topic: w, type: sensor_msgs/msg/JointState, field: velocity, unit: rpm,"
        " names: [fl, fr, rl, rr], sign: [1, -1, 1, -1]}",
    )["w"]
    rpm = math.pi / 30.0
    sent = messages.joint_message(5, ["rr", "x", "fl", "rl", "fr"], velocity=[-4.0, 9.0, 1.0, 3.0, -2.0])
    (found,) = quick(serialize_message(sent), 0)
    assert found.names == ("rear_right", "x", "front_left", "rear_left", "front_right")
    assert found.values == pytest.approx((4 * rpm, 9 * rpm, rpm, 3 * rpm, 2 * rpm))


def test_wheels_of_an_array_are_taken_in_order(tmp_path: Path) -> None:
    text = "  wheel_speed: {topic: w, type: std_msgs/msg/Float64MultiArray, field: data, unit: km/h}"
    quick = read_from(tmp_path, text)["w"]
    sent = messages.message_class("std_msgs/msg/Float64MultiArray")(data=[3.6, 7.2, 10.8, 14.4])
    radius = CAR.front.wheel.radius_m
    (found,) = quick(serialize_message(sent), 3)
    assert (found.stamp_ns, found.names) == (3, WHEEL_NAMES)
    assert found.values == pytest.approx(tuple(v / radius for v in (1.0, 2.0, 3.0, 4.0)))


def test_an_array_that_is_too_short_is_refused_for_its_length_and_not_for_its_stamp(tmp_path: Path) -> None:
    wanted = ", ".join(
        f"{{topic: w, type: std_msgs/msg/Float32MultiArray, field: 'data[{i}]', unit: rpm}}" for i in range(4)
    )
    quick = read_from(tmp_path, f"  wheel_speed: [{wanted}]")["w"]
    sent = messages.message_class("std_msgs/msg/Float32MultiArray")(data=[1.0, 2.0, 3.0])
    (found,) = quick(serialize_message(sent), 12)
    assert found.stamp_ns == 12
    assert check_names(found.names, len(found.values), WHEEL_NAMES) is Violation.LENGTH


def test_four_topics_make_one_reading_and_a_wheel_that_stays_away_is_missing(tmp_path: Path) -> None:
    sources = ", ".join(f"{{topic: w{i}, type: std_msgs/msg/Float64, field: data, unit: rad/s}}" for i in range(4))
    quick = read_from(tmp_path, f"  wheel_speed: [{sources}]")
    assert [quick[f"w{i}"](number(float(i)), i) for i in (2, 0, 3)] == [(), (), ()]
    assert quick["w1"](number(1.0), 9) == (JointReading(9, WHEEL_NAMES, (0.0, 1.0, 2.0, 3.0)),)
    found = [quick[f"w{i}"](number(5.0), 10 * i) for _ in range(3) for i in (0, 1, 3)]
    (reading,) = [readings[0] for readings in found if readings]
    assert repr(reading.values) == repr((5.0, 5.0, math.nan, 5.0))


def test_a_battery_in_single_numbers_comes_with_its_charge(tmp_path: Path) -> None:
    quick = read_from(
        tmp_path,
        '  soc: {topic: c, type: std_msgs/msg/Float64, field: data, unit: "%"}\n'
        "  battery_temperature: {topic: t, type: std_msgs/msg/Float64, field: data, unit: K}",
    )
    assert repr(quick["c"](number(50.0), 1)) == repr((BatteryReading(1, 0.5, math.nan, math.nan, math.nan),))
    assert quick["t"](number(300.0), 2) == ()
    assert quick["c"](number(40.0), 3)[0][1:3] == pytest.approx((0.4, 26.85))


def test_several_signals_of_one_message_are_read_at_once(tmp_path: Path) -> None:
    imu = "topic: imu, type: sensor_msgs/msg/Imu"
    quick = read_from(
        tmp_path,
        f"  yaw_rate: {{{imu}, field: angular_velocity.z, unit: rad/s}}\n"
        f"  longitudinal_acceleration: {{{imu}, field: linear_acceleration.x, unit: m/s2, factor: -1}}",
    )["imu"]
    sent = messages.message_class("sensor_msgs/msg/Imu")()
    sent.angular_velocity.z, sent.linear_acceleration.x = 0.5, 2.0
    assert quick(serialize_message(sent), 1) == (
        MotionReading(0, "yaw_rate", 0.5),
        MotionReading(0, "longitudinal_acceleration", -2.0),
    )


def test_torques_that_motors_report_come_beside_their_speeds(tmp_path: Path) -> None:
    joints = "topic: w, type: sensor_msgs/msg/JointState, names: [fl, fr, rl, rr]"
    speeds, torques = f"{joints}, field: velocity, unit: rad/s", f"{joints}, field: effort, unit: N m"
    quick = read_from(tmp_path, f"  wheel_speed: {{{speeds}}}\n  motor_torque: {{{torques}}}")["w"]
    sent = messages.joint_message(5, ["rr", "fl"], velocity=[4.0, 1.0], effort=[40.0, 10.0])
    names = ("rear_right", "front_left")
    assert quick(serialize_message(sent), 0) == (
        JointReading(5, names, (4.0, 1.0)),
        TorqueReading(5, names, (40.0, 10.0)),
    )


def test_a_direction_is_forwards_or_reverse_and_neutral_changes_nothing(tmp_path: Path) -> None:
    quick = read_from(tmp_path, '  direction: {topic: g, type: std_msgs/msg/Int8, field: data, unit: "1"}')["g"]
    kind = messages.message_class("std_msgs/msg/Int8")
    found = [quick(serialize_message(kind(data=gear)), 3) for gear in (3, -1, 0)]
    assert found == [(DirectionReading(3, 1.0),), (DirectionReading(3, -1.0),), ()]


def test_the_time_dds_says_counts_where_the_stamp_is_not_wanted(tmp_path: Path) -> None:
    text = "  speed: {topic: v, type: geometry_msgs/msg/TwistStamped, field: twist.linear.x, unit: m/s, stamp: source}"
    assert read_from(tmp_path, text)["v"](serialize_message(messages.vehicle_speed_message(5, 1.0)), 88) == (
        SpeedReading(88, 1.0),
    )


@pytest.mark.parametrize("speed_mps", [0.0, 0.3, 20.0])
@pytest.mark.parametrize(
    ("signal", "unit", "value", "expected"),
    [
        ("power_demand", "kW", 2.0, lambda v: 2000.0),
        ("force_demand", "kN", -3.0, lambda v: force_power_w(-3000.0, v, CAR)),
        ("torque_demand", "N m", 400.0, lambda v: torque_power_w(400.0, v, CAR)),
        ("acceleration_demand", "m/s2", -2.0, lambda v: acceleration_power_w(-2.0, v, CAR)),
        ("accelerator_pedal", '"%"', 25.0, lambda v: pedal_power_w(0.25, 0.0, v, CAR)),
        ("brake_pedal", '"1"', 1.5, lambda v: -full_braking_w(v, CAR)),
    ],
)
def test_a_demand_becomes_power_at_the_speed_of_the_car(
    tmp_path: Path, speed_mps: float, signal: str, unit: str, value: float, expected: Any
) -> None:
    text = f"  {signal}: {{topic: d, type: std_msgs/msg/Float64, field: data, unit: {unit}}}"
    assert read_from(tmp_path, text, speed_mps)["d"](number(value), 4) == (DemandReading(4, expected(speed_mps)),)


PEDALS = "\n".join(
    f'  {pedal}_pedal: {{topic: {pedal}, type: std_msgs/msg/Float64, field: data, unit: "1"}}'
    for pedal in ("accelerator", "brake")
)


def test_the_brake_overrides_the_accelerator_and_a_pedal_that_says_nothing_is_refused(tmp_path: Path) -> None:
    quick = read_from(tmp_path, PEDALS, 10.0)
    full = full_braking_w(10.0, CAR)
    assert quick["brake"](number(0.25), 2) == (DemandReading(2, -0.25 * full),)
    (braking,) = quick["accelerator"](number(math.nan), 3)  # braking gets through
    assert braking.power_w == -0.25 * full
    assert math.isnan(quick["brake"](number(0.0), 4)[0].power_w)
    assert quick["accelerator"](number(0.0), 4) == (DemandReading(4, 0.0),)
    assert math.isnan(quick["brake"](number(math.nan), 6)[0].power_w)


def test_pedals_that_have_not_both_come_are_no_demand_but_to_brake(tmp_path: Path) -> None:
    quick = read_from(tmp_path, PEDALS, 10.0)
    assert quick["accelerator"](number(0.5), 1) == ()
    quick = read_from(tmp_path, PEDALS, 10.0)
    assert quick["brake"](number(0.0), 1) == ()
    assert quick["brake"](number(0.5), 1) == (DemandReading(1, -0.5 * full_braking_w(10.0, CAR)),)


def test_a_demand_is_as_old_as_the_pedal_that_has_been_silent_longest(tmp_path: Path) -> None:
    quick = read_from(tmp_path, PEDALS, 10.0)
    driving = pedal_power_w(0.5, 0.0, 10.0, CAR)
    quick["brake"](number(0.0), 0)
    assert quick["accelerator"](number(0.5), 200_000_000) == (DemandReading(200_000_000, driving, 0.2),)
    assert quick["brake"](number(0.0), 500_000_000) == (DemandReading(500_000_000, driving, 0.3),)
    (braking,) = quick["brake"](number(0.1), 900_000_000)
    assert braking == DemandReading(900_000_000, -0.1 * full_braking_w(10.0, CAR))  # whatever the accelerator does
    assert quick["accelerator"](number(0.5), 2_000_000_000)[0].lag_s == pytest.approx(1.1)  # a brake that went silent


def test_a_pedal_from_before_the_clock_was_set_back_counts_as_never_come(tmp_path: Path) -> None:
    quick = read_from(tmp_path, PEDALS, 10.0)
    quick["brake"](number(0.0), 9_000_000_000)
    assert quick["accelerator"](number(0.5), 5_000_000_000) == ()
    quick["brake"](number(0.0), 5_000_000_000)
    assert len(quick["accelerator"](number(0.5), 5_000_000_000)) == 1


@pytest.mark.parametrize("travel", [30.0, -0.5, -30.0])
def test_an_accelerator_far_beyond_its_way_is_no_number_and_the_words_say_so(tmp_path: Path, travel: float) -> None:
    path = tmp_path / "signals.yaml"
    path.write_text(f"signals:\n{PEDALS}")
    assembly = Assembly(WHEEL_NAMES, CAR, lambda: 10.0)
    quick = readers_of(load_mapping(path), assembly)
    quick["brake"](number(0.0), 1)
    for pedal, value in (("accelerator", travel), ("brake", 0.0)):
        assert math.isinf(quick[pedal](number(value), 1)[0].power_w)
        assert assembly.wanted_in_words() == (
            f"accelerator_pedal {travel:g} on accelerator; a pedal's way is 0 to 1: right unit?"
        )
    assert quick["brake"](number(0.5), 1)[0].power_w == -0.5 * full_braking_w(10.0, CAR)
    assert quick["accelerator"](number(1.1), 1)[0].power_w == -0.5 * full_braking_w(10.0, CAR)
    quick["brake"](number(0.0), 1)
    assert quick["accelerator"](number(1.1), 1)[0].power_w == pedal_power_w(1.0, 0.0, 10.0, CAR)


@pytest.mark.parametrize(
    ("accelerator", "brake", "words"),
    [
        (100.0, 0.0, "accelerator_pedal 100 % on accelerator, which is "),
        (math.nan, 0.0, "accelerator_pedal nan % on accelerator"),
        (100.0, 20.0, "brake_pedal 20 % on brake, which is -"),
        (100.0, math.nan, "brake_pedal nan % on brake"),
        (30e2, 0.0, "accelerator_pedal 3000 % on accelerator; a pedal's way is 0 to 100 %: right unit?"),
    ],
)
def test_of_two_pedals_the_words_name_the_one_that_made_the_demand_in_its_own_unit(
    tmp_path: Path, accelerator: float, brake: float, words: str
) -> None:
    path = tmp_path / "signals.yaml"
    path.write_text(f"signals:\n{PEDALS}".replace('"1"', '"%"'))
    assembly = Assembly(WHEEL_NAMES, CAR, lambda: 10.0)
    quick = readers_of(load_mapping(path), assembly)
    for pedal, value in (("brake", brake), ("accelerator", accelerator), ("brake", brake)):
        quick[pedal](number(value), 1)
        said = assembly.wanted_in_words()
    assert said.startswith(words)


def test_a_brake_far_beyond_its_way_brakes_fully_and_one_of_the_wrong_sign_is_refused(tmp_path: Path) -> None:
    quick = read_from(tmp_path, PEDALS, 10.0)
    assert quick["brake"](number(30.0), 1)[0].power_w == -full_braking_w(10.0, CAR)
    assert not math.isfinite(quick["brake"](number(-30.0), 1)[0].power_w)


@pytest.mark.parametrize(
    ("entry", "problem"),
    [
        ("speed: {topic: j, type: JOINTS, field: speed, unit: m/s}", "signals.speed.field: JOINTS has no field speed"),
        ("speed: {topic: j, type: JOINTS, field: header.stamp, unit: m/s}", "header.stamp is a message"),
        ("speed: {topic: j, type: JOINTS, field: header.frame_id, unit: m/s}", "header.frame_id is a text"),
        ("speed: {topic: j, type: JOINTS, field: velocity, unit: m/s}", "velocity is an array; allowed: a field of"),
        (
            "wheel_speed: {topic: j, type: JOINTS, field: 'velocity[0]', unit: m/s}",
            "allowed: a field of JOINTS that is",
        ),
        (
            "wheel_speed: {topic: j, type: std_msgs/msg/Float64MultiArray, field: data, unit: rpm, names: NAMES}",
            "signals.wheel_speed.names: std_msgs/msg/Float64MultiArray has no field `name` beside data",
        ),
    ],
)
def test_a_field_that_cannot_be_read_is_named(tmp_path: Path, entry: str, problem: str) -> None:
    joints = "sensor_msgs/msg/JointState"
    with pytest.raises(ConfigError) as caught:
        read_from(tmp_path, f"  {entry.replace('JOINTS', joints).replace('NAMES', '[a, b, c, d]')}")
    assert problem.replace("JOINTS", joints) in str(caught.value)


def test_what_needs_a_vehicle_says_so(tmp_path: Path) -> None:
    path = tmp_path / "signals.yaml"
    path.write_text(f"signals:\n{PEDALS}\n")
    with pytest.raises(ConfigError, match="accelerator_pedal: is no power: name the vehicle"):
        readers_of(load_mapping(path), Assembly(WHEEL_NAMES))
