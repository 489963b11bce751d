"""Single numbers out of CDR against the generated decoders of rosbags, over types of every shape."""

from __future__ import annotations

import math
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bags_helpers import ScriptedDrive, battery
from iwm_power_manager.bags.definitions import definition_of, typestore
from iwm_power_manager.bags.metadata import Topic
from iwm_power_manager.bags.reader import BagReader
from iwm_power_manager.signals.cdr import number_reader
from iwm_power_manager.signals.mapping import load_mapping
from iwm_power_manager.signals.recorded import SignalStream

FINITE = st.floats(allow_nan=False, width=32)


def types() -> Any:
    return typestore().types


def header(frame_id: str) -> Any:
    return types()["std_msgs/msg/Header"](types()["builtin_interfaces/msg/Time"](7, 8), frame_id)


@given(frame=st.text(max_size=9), child=st.text(max_size=9), value=FINITE)
def test_behind_strings_and_fixed_arrays(frame: str, child: str, value: float) -> None:
    vector, point = types()["geometry_msgs/msg/Vector3"], types()["geometry_msgs/msg/Point"](1.0, 2.0, 3.0)
    pose = types()["geometry_msgs/msg/Pose"](point, types()["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0))
    twist = types()["geometry_msgs/msg/Twist"](vector(5.0, value, 6.0), vector(0.0, 0.0, 0.0))
    covariance = np.arange(36.0)
    message = types()["nav_msgs/msg/Odometry"](
        header(frame),
        child,
        types()["geometry_msgs/msg/PoseWithCovariance"](pose, covariance),
        types()["geometry_msgs/msg/TwistWithCovariance"](twist, covariance),
    )
    read = number_reader("nav_msgs/msg/Odometry", ["twist", "twist", "linear", "y"])
    assert read is not None
    assert read(bytes(typestore().serialize_cdr(message, "nav_msgs/msg/Odometry"))) == value


@given(
    frame=st.text(max_size=9),
    cells=st.lists(FINITE, max_size=5),
    temperatures=st.lists(FINITE, max_size=5),
    soc=FINITE,
    location=st.text(max_size=5),
)
def test_between_and_behind_sequences(
    frame: str, cells: list[float], temperatures: list[float], soc: float, location: str
) -> None:
    kind = "sensor_msgs/msg/BatteryState"
    arrays = [np.array(values, dtype=np.float32) for values in (cells, temperatures)]
    message = types()[kind](header(frame), 1, 2, 3, 4, 5, 6, soc, 1, 2, 3, True, *arrays, location, "serial")
    data = bytes(typestore().serialize_cdr(message, kind))
    for field, expected in (("percentage", soc), ("present", True), ("power_supply_technology", 3), ("voltage", 1.0)):
        read = number_reader(kind, [field])
        assert read is not None
        assert read(data) == expected


@given(
    names=st.lists(st.text(max_size=6), max_size=3),
    values=st.lists(FINITE, max_size=3),
    flags=st.lists(st.booleans(), max_size=3),
    number=st.integers(-(2**63), 2**63 - 1),
)
def test_types_a_bag_describes_itself(names: list[str], values: list[float], flags: list[bool], number: int) -> None:
    from iwm_power_manager.bags.definitions import learn_definition

    kind = "shapes_msgs/msg/Shape"
    text = "string name\nfloat64[] values\nbool[] flags\nuint8 small\nint16[3] fixed\nint64 number\n"
    learn_definition(Topic("/shape", kind, text, ""))
    message = types()[kind](
        "".join(names), np.array(values), np.array(flags, dtype=bool), 3, np.arange(3, dtype=np.int16), number
    )
    read = number_reader(kind, ["number"])
    assert read is not None
    assert read(bytes(typestore().serialize_cdr(message, kind))) == number


@pytest.mark.parametrize(
    ("kind", "path"),
    [
        ("sensor_msgs/msg/JointState", ["velocity"]),
        ("std_msgs/msg/String", ["data"]),
        ("std_msgs/msg/Header", ["stamp"]),
        ("std_msgs/msg/Float64", ["nothing"]),
        ("trajectory_msgs/msg/JointTrajectoryPoint", ["time_from_start", "sec", "more"]),
        ("diagnostic_msgs/msg/DiagnosticArray", ["status"]),
    ],
)
def test_what_has_no_quick_way_is_left_to_the_decoder(kind: str, path: list[str]) -> None:
    definition_of(kind)
    assert number_reader(kind, path) is None


def test_behind_a_sequence_of_messages_there_is_no_quick_way() -> None:
    from iwm_power_manager.bags.definitions import learn_definition

    text = "geometry_msgs/Point[] points\nfloat64 value\n" + "=" * 80 + "\nMSG: geometry_msgs/Point\nfloat64 x\n"
    learn_definition(Topic("/p", "shapes_msgs/msg/Points", text, ""))
    assert number_reader("shapes_msgs/msg/Points", ["value"]) is None


def test_a_message_that_ends_too_early_is_refused() -> None:
    read = number_reader("sensor_msgs/msg/BatteryState", ["percentage"])
    assert read is not None
    data = battery(5, 0.5)
    assert read(data) == 0.5
    with pytest.raises(struct.error):
        read(data[:30])


def test_quick_and_decoded_values_of_a_drive_are_the_same(tmp_path: Any) -> None:
    path = ScriptedDrive("equal").write(tmp_path / "bag", 30)
    with BagReader(path) as bag:
        quick = list(SignalStream(bag, load_mapping()))
        slow_stream = SignalStream(bag, load_mapping())
        assert set(slow_stream._quick) == {"/vehicle_speed", "/wheel_states", "/battery_state", "/power_demand"}
        slow_stream._quick = {}
        slow = list(slow_stream)
    assert quick == slow
    assert len(quick) == 5 * 30
    assert all(math.isfinite(number) for value in quick for number in value.values)
