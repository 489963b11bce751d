"""Readings from bytes are those of the decoded message, whatever came before."""

from __future__ import annotations

import math
import struct

import pytest
from geometry_msgs.msg import TwistStamped
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import BatteryState, JointState
from std_msgs.msg import Float64

from iwm_power_manager.ros import messages
from iwm_power_manager.signals import live as quick

numbers = st.floats(width=64)
singles = st.floats(width=32)
names = st.lists(st.sampled_from(("front_left", "front_right", "x", "")), max_size=5)
frames = st.sampled_from(("", "a", "base_link", "a_frame_with_a_long_name"))
stamps = st.tuples(st.integers(-(2**31), 2**31 - 1), st.integers(0, 2**32 - 1))


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


KINDS = {
    "speed": (quick.speed_reader, messages.read_vehicle_speed, speeds()),
    "wheels": (quick.wheel_reader, messages.read_wheel_speeds, wheels()),
    "battery": (quick.battery_reader, messages.read_battery_state, batteries()),
    "number": (quick.number_reader, messages.read_number, floats()),
}


@pytest.mark.parametrize("kind", KINDS)
@given(data=st.data())
def test_any_sequence_reads_as_if_decoded(kind: str, data: st.DataObject) -> None:
    make, read, any_message = KINDS[kind]
    reader = make()
    for message in data.draw(st.lists(any_message, min_size=1, max_size=6)):
        for _ in range(2):  # the second time quickly
            assert repr(reader(serialize_message(message))) == repr(read(message))


def wheel_message(stamp_ns: int, speeds_radps: tuple[float, ...], angles: tuple[float, ...] = ()) -> JointState:
    return messages.joint_message(stamp_ns, messages.WHEEL_NAMES, position=angles, velocity=speeds_radps)


@pytest.fixture
def decoded(monkeypatch: pytest.MonkeyPatch) -> list[bytes]:
    """What was decoded in full."""
    found: list[bytes] = []

    def noting(data: bytes, kind: type):
        found.append(data)
        return deserialize_message(data, kind)

    monkeypatch.setattr(quick, "deserialize_message", noting)
    return found


EXAMPLES = {
    "speed": lambda i: messages.vehicle_speed_message(i, 2.0 * i),
    "wheels": lambda i: wheel_message(i, (1.0 * i, 2.0, 3.0, 4.0), (0.1 * i,) * 4),
    "battery": lambda i: messages.battery_state_message(i, soc=0.5, voltage_v=200.0 + i, discharge_current_a=1.0 * i),
    "number": lambda i: messages.number_message(3.0 * i),
}


@pytest.mark.parametrize("kind", EXAMPLES)
def test_only_the_first_of_a_kind_is_decoded(kind: str, decoded: list[bytes]) -> None:
    make, read, _ = KINDS[kind]
    reader = make()
    for i in range(1, 5):
        assert repr(reader(serialize_message(EXAMPLES[kind](i)))) == repr(read(EXAMPLES[kind](i)))
    assert len(decoded) == 1


def test_other_names_are_decoded_anew(decoded: list[bytes]) -> None:
    reader = quick.wheel_reader()
    reader(serialize_message(wheel_message(1, (1.0, 2.0, 3.0, 4.0))))
    swapped = wheel_message(2, (1.0, 2.0, 3.0, 4.0))
    swapped.name = [swapped.name[i] for i in (3, 1, 2, 0)]
    assert reader(serialize_message(swapped)) == messages.read_wheel_speeds(swapped)
    assert len(decoded) == 2


@pytest.mark.parametrize("kind", KINDS)
@given(data=st.data())
def test_bytes_that_are_no_message_are_a_bad_reading_and_the_next_is_read(kind: str, data: st.DataObject) -> None:
    make, read, _ = KINDS[kind]
    reader, good = make(), serialize_message(EXAMPLES[kind](1))
    cut = data.draw(st.integers(0, 11))
    for before in (b"", good):
        if before:
            reader(before)
        found = reader(good[:cut])
        assert all(math.isnan(value) for value in numbers_of(found))
        assert repr(reader(good)) == repr(read(EXAMPLES[kind](1)))


def numbers_of(reading) -> tuple[float, ...]:
    """What is measured, without the stamp."""
    if isinstance(reading, float):
        return (reading,)
    if hasattr(reading, "names"):
        return tuple(reading.values)
    return tuple(reading[1:])


@given(data=st.data())
def test_a_changed_byte_reads_as_if_decoded(data: st.DataObject) -> None:
    """A number, a name, a length: with the same number of bytes, and after a message that was understood."""
    good = serialize_message(EXAMPLES["wheels"](1))
    changed = bytearray(good)
    changed[data.draw(st.integers(2, len(good) - 1))] = data.draw(st.integers(0, 255))
    fresh, reader = quick.wheel_reader(), quick.wheel_reader()
    reader(good)
    assert repr(reader(bytes(changed))) == repr(fresh(bytes(changed)))


def test_big_endian_goes_the_long_way(decoded: list[bytes]) -> None:
    data = b"\x00\x00\x00\x00" + struct.pack(">d", 7.5)
    reader = quick.number_reader()
    assert [reader(data), reader(data)] == [7.5, 7.5]
    assert len(decoded) == 2
