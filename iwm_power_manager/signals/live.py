"""Inputs straight from their bytes: what a control step needs of a message, without the message.

rclpy builds each message as an object, field by field, which for the four inputs takes longer than the control law. The
messages of a topic are alike: same frame, same names, same lengths, other numbers. So a message is decoded in full
once; of the next ones the bytes that stand for its build are compared, and only stamp and numbers are read. Where
anything differs, the full way is taken again. What cannot be decoded at all becomes a reading that the checks of
`control.inputs` refuse and count, like any other bad message. (`bags.joint_state` does the like for bags, without ROS.)
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from contextlib import suppress
from typing import Any, NamedTuple

from geometry_msgs.msg import TwistStamped
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import BatteryState, JointState
from std_msgs.msg import Float64

from iwm_power_manager.control.monitor import BatteryReading, JointReading, SpeedReading
from iwm_power_manager.ros import messages

_U32, _STAMP = struct.Struct("<I"), struct.Struct("<iI")
_BODY = 4  # behind the encapsulation; alignment counts from here
_AFTER_STAMP = _BODY + _STAMP.size
_LITTLE_ENDIAN = b"\x00\x01"
_NS_PER_S = 1_000_000_000
#: Stamp of what cannot be read: older than anything.
_NEVER_NS = -(1 << 62)


class Layout(NamedTuple):
    """Where the numbers of a message are.

    Attributes
    ----------
    numbers, start : how they are packed, and their first byte
    build : first and behind-last bytes of what has to be the same in another message of this layout
    """

    numbers: struct.Struct
    start: int
    build: tuple[tuple[int, int], ...]


class QuickReader[T]:
    """Reads the messages of one topic.

    Parameters
    ----------
    kind : type of the messages
    read : reading of a decoded message
    lay_out : layout of a message's bytes; may raise `struct.error` for one it does not understand
    make : reading from the bytes, the numbers and the reading of the last message that was decoded in full
    unreadable : reading of a message that cannot be decoded
    """

    def __init__(
        self,
        kind: type,
        read: Callable[[Any], T],
        lay_out: Callable[[bytes], Layout],
        make: Callable[[bytes, tuple[Any, ...], T], T],
        unreadable: T,
    ) -> None:
        self._kind = kind
        self._read = read
        self._lay_out = lay_out
        self._make = make
        self._unreadable = unreadable
        self._decoded = unreadable
        self._length = -1
        self._layout = Layout(struct.Struct(""), 0, ())
        self._seen: tuple[tuple[int, int, bytes], ...] = ()

    def __call__(self, data: bytes) -> T:
        """Reading of a message in CDR."""
        if len(data) == self._length and all(data[begin:end] == seen for begin, end, seen in self._seen):
            return self._quickly(data)
        self._length = -1
        try:
            self._decoded = self._read(deserialize_message(data, self._kind))
        except Exception:  # noqa: BLE001 - whatever a decoder makes of bytes that are no message
            return self._unreadable
        with suppress(struct.error):
            self._layout = self._lay_out(data)
            # Learned only if it gives the same, NaN included.
            if data[:2] == _LITTLE_ENDIAN and repr(self._quickly(data)) == repr(self._decoded):
                self._length = len(data)
                spans = ((0, 2), *self._layout.build)
                self._seen = tuple((begin, end, data[begin:end]) for begin, end in spans)
        return self._decoded

    def _quickly(self, data: bytes) -> T:
        numbers, start, _ = self._layout
        return self._make(data, numbers.unpack_from(data, start), self._decoded)


def speed_reader() -> QuickReader[SpeedReading]:
    """Reader of `vehicle_speed`."""
    unreadable = SpeedReading(_NEVER_NS, math.nan)
    return QuickReader(TwistStamped, messages.read_vehicle_speed, _speed_layout, _speed, unreadable)


def wheel_reader() -> QuickReader[JointReading]:
    """Reader of `wheel_states`."""
    return QuickReader(
        JointState, messages.read_wheel_speeds, _velocity_layout, _wheels, JointReading(_NEVER_NS, (), ())
    )


def battery_reader() -> QuickReader[BatteryReading]:
    """Reader of `battery_state`."""
    unreadable = BatteryReading(_NEVER_NS, math.nan, math.nan, math.nan, math.nan)
    return QuickReader(BatteryState, messages.read_battery_state, _battery_layout, _battery, unreadable)


def number_reader() -> QuickReader[float]:
    """Reader of `power_demand` and `road_friction`."""
    return QuickReader(Float64, messages.read_number, _number_layout, _number, math.nan)


def _stamp_ns(data: bytes) -> int:
    seconds, nanoseconds = _STAMP.unpack_from(data, _BODY)
    return int(seconds) * _NS_PER_S + int(nanoseconds)


def _aligned(at: int, size: int) -> int:
    return _BODY + -(-(at - _BODY) // size) * size


def _behind_string(data: bytes, at: int) -> int:
    at = _aligned(at, 4)
    return at + 4 + int(_U32.unpack_from(data, at)[0])


def _speed_layout(data: bytes) -> Layout:
    behind = _behind_string(data, _AFTER_STAMP)
    return Layout(struct.Struct("<d"), _aligned(behind, 8), ((_AFTER_STAMP, behind),))


def _speed(data: bytes, numbers: tuple[Any, ...], _: SpeedReading) -> SpeedReading:
    return SpeedReading(_stamp_ns(data), numbers[0])


def _velocity_layout(data: bytes) -> Layout:
    at = _aligned(_behind_string(data, _AFTER_STAMP), 4)
    names = int(_U32.unpack_from(data, at)[0])
    at += 4
    for _ in range(names):
        at = _behind_string(data, at)
    at = _aligned(at, 4)
    positions = int(_U32.unpack_from(data, at)[0])
    head = (_AFTER_STAMP, at + 4)
    at = _aligned(at + 4, 8) + 8 * positions if positions else at + 4
    velocities = int(_U32.unpack_from(data, at)[0])
    numbers = struct.Struct(f"<{velocities}d")
    return Layout(numbers, _aligned(at + 4, 8) if velocities else at + 4, (head, (at, at + 4)))


def _wheels(data: bytes, numbers: tuple[Any, ...], decoded: JointReading) -> JointReading:
    return JointReading(_stamp_ns(data), decoded.names, numbers)


def _battery_layout(data: bytes) -> Layout:
    behind = _behind_string(data, _AFTER_STAMP)
    return Layout(struct.Struct("<7f"), _aligned(behind, 4), ((_AFTER_STAMP, behind),))


def _battery(data: bytes, numbers: tuple[Any, ...], _: BatteryReading) -> BatteryReading:
    voltage, temperature, current, _charge, _capacity, _design_capacity, percentage = numbers
    return BatteryReading(_stamp_ns(data), percentage, temperature, voltage, -current)


def _number_layout(_: bytes) -> Layout:
    return Layout(struct.Struct("<d"), _BODY, ())


def _number(_data: bytes, numbers: tuple[Any, ...], _: float) -> float:
    return float(numbers[0])
