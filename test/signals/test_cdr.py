# SPDX-License-Identifier: Apache-2.0
"""Numbers out of CDR and into it against the generated decoders of rosbags, over types of every shape."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from iwm_power_manager.signals.cdr import MessageReader, MessageWriter, UnreadableError, blank, field_kind
from iwm_power_manager.signals.types import MSG, Types, types_of

FINITE = st.floats(allow_nan=False, width=32)
ODOMETRY, BATTERY = types_of("nav_msgs/msg/Odometry"), types_of("sensor_msgs/msg/BatteryState")
JOINTS, NUMBER = types_of("sensor_msgs/msg/JointState"), types_of("std_msgs/msg/Float64")
SHAPE = types_of(
    "shapes_msgs/msg/Shape",
    MSG,
    "string name\nfloat64[] values\nbool[] flags\nuint8 small\nint16[3] fixed\nPart[] parts\nint64 number\n"
    + "=" * 80
    + "\nMSG: shapes_msgs/Part\nstring<=8 name\nfloat32 weight\nuint8 flag\n",
)


def data_of(types: Types, message: Any) -> bytes:
    return bytes(types.store.serialize_cdr(message, types.name))


def reader(types: Types, *fields: str, names: str = "", stamped: bool = True) -> MessageReader[Any]:
    return MessageReader(types, fields, lambda time_ns, values, found: (time_ns, values, found), names, stamped=stamped)


def read_twice(read: MessageReader[Any], data: bytes) -> Any:
    """Decoded the first time, quickly the second: the same."""
    first = read(data, 5)
    decoded = read.decoded
    assert repr(read(data, 5)) == repr(first)
    assert read.decoded == decoded
    return first


@given(frame=st.text(max_size=9), child=st.text(max_size=9), value=FINITE, stamp=st.integers(-(2**31), 2**31 - 1))
def test_behind_strings_and_fixed_arrays(frame: str, child: str, value: float, stamp: int) -> None:
    message = blank(ODOMETRY)
    message.header.stamp.sec, message.header.frame_id, message.child_frame_id = stamp, frame, child
    message.twist.twist.linear.y, message.pose.covariance[7] = value, 2.5
    read = reader(ODOMETRY, "twist.twist.linear.y", "pose.covariance[7]")
    assert read_twice(read, data_of(ODOMETRY, message)) == (stamp * 10**9, (value, 2.5), ())


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
    message = blank(BATTERY)
    message.header.frame_id, message.location = frame, location
    message.percentage, message.present, message.power_supply_technology = soc, True, 3
    message.cell_voltage, message.cell_temperature = (np.array(v, np.float32) for v in (cells, temperatures))
    fields = ("cell_voltage", "percentage", "present", "power_supply_technology")
    assert read_twice(reader(BATTERY, *fields), data_of(BATTERY, message))[1] == (tuple(cells), soc, 1.0, 3.0)


@given(
    name=st.text(max_size=6),
    values=st.lists(FINITE, max_size=3),
    flags=st.lists(st.booleans(), max_size=3),
    parts=st.lists(FINITE, min_size=2, max_size=4),
    number=st.integers(-(2**53), 2**53),
)
def test_types_a_bag_describes_itself_with_lists_of_messages_in_them(
    name: str, values: list[float], flags: list[bool], parts: list[float], number: int
) -> None:
    message = blank(SHAPE)
    message.name, message.number, message.small = name, number, 200
    message.values, message.flags = np.array(values), np.array(flags, dtype=bool)
    message.fixed = np.array([-1, 2, 3], np.int16)
    part = SHAPE.store.types["shapes_msgs/msg/Part"]
    message.parts = [part(name="ab"[: i % 3], weight=weight, flag=1) for i, weight in enumerate(parts)]
    read = reader(SHAPE, "number", "fixed[2]", "parts[1].weight", "values", "fixed", stamped=True)
    expected = (7, (float(number), 3.0, parts[1], tuple(values), (-1.0, 2.0, 3.0)), ())
    assert read(data_of(SHAPE, message), 7) == expected
    assert read(data_of(SHAPE, message), 7) == expected


@given(stamp=st.integers(0, 2**31 * 10**9 - 1), values=st.lists(FINITE, min_size=1, max_size=5), data=st.data())
def test_what_is_written_is_what_the_generated_code_writes_and_reads_back(
    stamp: int, values: list[float], data: st.DataObject
) -> None:
    names = data.draw(st.lists(st.text("abcdef_", max_size=9), min_size=len(values), max_size=len(values)))
    field = data.draw(st.sampled_from(("position", "velocity", "effort")))
    message = blank(JOINTS)
    message.name = names
    setattr(message, field, np.zeros(len(values)))
    written = MessageWriter(JOINTS, data_of(JOINTS, message), field)(stamp, values)
    setattr(message, field, np.array(values, dtype=np.float64))
    message.header.stamp.sec, message.header.stamp.nanosec = stamp // 10**9, stamp % 10**9
    assert written == data_of(JOINTS, message)
    assert read_twice(reader(JOINTS, field, names="name"), written) == (stamp, (tuple(values),), tuple(names))


def test_other_names_other_frames_and_other_lengths_are_noticed() -> None:
    read = reader(JOINTS, "effort", names="name")
    for names, frame, count in ((["a", "b"], "", 2), (["a", "c"], "", 2), (["a", "c"], "x", 2), (["a", "b"], "", 0)):
        message = blank(JOINTS)
        message.name, message.header.frame_id = names, frame
        message.velocity, message.effort = np.full(2 - count, 9.0), np.arange(count, dtype=np.float64)
        for _ in range(2):
            assert read(data_of(JOINTS, message))[1:] == ((tuple(range(count)),), tuple(names))


def test_a_message_that_comes_in_many_lengths_is_read_quickly_in_the_end() -> None:
    read = reader(BATTERY, "percentage")
    for cells in [*range(10), *range(10)]:
        message = blank(BATTERY)
        message.cell_voltage, message.percentage = np.zeros(cells, np.float32), 0.5
        assert read(data_of(BATTERY, message))[1] == (0.5,)
    assert read.decoded == 10


GOOD = data_of(NUMBER, NUMBER.store.types[NUMBER.name](data=7.5))


@given(head=st.binary(min_size=4, max_size=4))
@example(head=b"\x00\x01\x01\x00")
@example(head=b"\x80\x01\x00\x00")
@example(head=b"\x00\x09\x00\x00")
@example(head=b"\x00\x00\x00\x00")
def test_a_spoilt_encapsulation_is_never_read_as_if_it_were_good(head: bytes) -> None:
    read = reader(NUMBER, "data")
    read(GOOD)  # a good one was there before
    spoilt = head + GOOD[4:]
    if head[:3] == b"\0\1\0" and head[3] < 4:
        assert read(spoilt)[1] == (7.5,)
    elif head[:3] == b"\0\0\0" and head[3] < 4:
        assert read(spoilt)[1] != (7.5,)  # big-endian, which these bytes are not
    else:
        with pytest.raises(UnreadableError, match="encapsulation"):
            read(spoilt)


def test_big_endian_goes_the_long_way() -> None:
    read = reader(NUMBER, "data")
    data = b"\0\0\0\0" + bytes(reversed(GOOD[4:]))
    assert [read(data)[1], read(data)[1]] == [(7.5,), (7.5,)]
    assert read.decoded == 2


@pytest.mark.parametrize("types", [JOINTS, BATTERY, ODOMETRY, SHAPE])
@given(data=st.data())
def test_damaged_bytes_are_read_as_the_library_reads_them_or_refused(types: Types, data: st.DataObject) -> None:
    """A changed byte, or some missing at the end, after a message of the same build that was good."""
    fields = {JOINTS: "velocity[0]", BATTERY: "percentage", ODOMETRY: "twist.twist.linear.x", SHAPE: "small"}
    message = blank(types)
    if types is JOINTS:
        message.name, message.velocity = ["ab"], np.array([3.0])
    good = data_of(types, message)
    changed = bytearray(good)
    changed[data.draw(st.integers(0, len(good) - 1))] = data.draw(st.integers(0, 255))
    changed = changed[: data.draw(st.sampled_from((len(good), len(good) - 1, len(good) // 2, 3, 0)))]
    used, fresh = reader(types, fields[types]), reader(types, fields[types])
    used(good)
    try:
        expected: Any = fresh(bytes(changed))
    except UnreadableError:
        with pytest.raises(UnreadableError):
            used(bytes(changed))
    else:
        assert repr(used(bytes(changed))) == repr(expected)


@pytest.mark.parametrize(
    ("types", "path", "kind"),
    [
        (JOINTS, "velocity", "array"),
        (JOINTS, "velocity[3]", "number"),
        (JOINTS, "name", "texts"),
        (JOINTS, "header.stamp", "message"),
        (JOINTS, "header.frame_id", "text"),
        (JOINTS, "nothing", ""),
        (JOINTS, "velocity.x", ""),
        (JOINTS, "", ""),
        (JOINTS, "velocity[x]", ""),
        (SHAPE, "fixed[3]", ""),
        (SHAPE, "parts", "messages"),
        (SHAPE, "parts[0].weight", "number"),
    ],
)
def test_what_a_field_is(types: Types, path: str, kind: str) -> None:
    assert field_kind(types, path) == kind
