"""JointState in and out of CDR, fast where messages repeat their names: which those of one topic do.

Decoding a message with sixty names takes most of a replay's time, and the names are the same every time. So the bytes
up to the numbers are compared with those of the message before; if they are the same, only the numbers are read.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any, NamedTuple

from iwm_power_manager.bags.definitions import typestore

JOINT_STATE = "sensor_msgs/msg/JointState"

_STAMP = struct.Struct("<iI")
_STAMP_OFFSET = 4  # behind the encapsulation
_AFTER_STAMP = _STAMP_OFFSET + _STAMP.size
_FIELDS = ("position", "velocity", "effort")
_LITTLE_ENDIAN = b"\x00\x01"
_NS_PER_S = 1_000_000_000


class NamedValues(NamedTuple):
    """One of a JointState's fields of numbers, with the names."""

    stamp_ns: int
    names: tuple[str, ...]
    values: tuple[float, ...]


class JointStateDecoder:
    """Decodes the messages of one topic.

    Parameters
    ----------
    field : "position", "velocity" or "effort"
    """

    def __init__(self, field: str) -> None:
        self._field = field
        self._start = 0
        self._head = b""
        self._length = 0
        self._names: tuple[str, ...] = ()
        self._numbers = struct.Struct("")

    def __call__(self, data: bytes) -> NamedValues:
        """Stamp, names and values of a message; raises what the generated decoder raises if it is damaged."""
        start = self._start
        if len(data) != self._length or data[_AFTER_STAMP:start] != self._head or not self._names:
            return self._decode(data)
        seconds, nanoseconds = _STAMP.unpack_from(data, _STAMP_OFFSET)
        return NamedValues(seconds * _NS_PER_S + nanoseconds, self._names, self._numbers.unpack_from(data, start))

    def _decode(self, data: bytes) -> NamedValues:
        message: Any = typestore().deserialize_cdr(data, JOINT_STATE)
        names = tuple(message.name)
        values = tuple(map(float, getattr(message, self._field)))
        if len(names) != len(values):
            raise ValueError(f"{len(names)} names and {len(values)} values")
        numbers = struct.Struct(f"<{len(values)}d")
        behind = _FIELDS[_FIELDS.index(self._field) + 1 :]
        # Each field is its length and, if it has any, its numbers on the next multiple of eight.
        tail_bytes = sum(8 + 8 * count if (count := len(getattr(message, name))) else 4 for name in behind)
        start = len(data) - tail_bytes - numbers.size
        if data[:2] == _LITTLE_ENDIAN and names and numbers.pack(*values) == data[start : start + numbers.size]:
            self._head, self._start, self._length = data[_AFTER_STAMP:start], start, len(data)
            self._names, self._numbers = names, numbers
        stamp = message.header.stamp
        return NamedValues(int(stamp.sec) * _NS_PER_S + int(stamp.nanosec), names, values)


class JointStateEncoder:
    """Encodes messages that have the same names and fill the same field.

    Parameters
    ----------
    names : of the joints
    field : "position", "velocity" or "effort"
    """

    def __init__(self, names: Sequence[str], field: str) -> None:
        import numpy as np

        types = typestore().types
        header = types["std_msgs/msg/Header"](stamp=types["builtin_interfaces/msg/Time"](sec=0, nanosec=0), frame_id="")
        empty = np.zeros(0)
        fields = {"position": empty, "velocity": empty, "effort": empty, field: np.zeros(len(names))}
        message = types[JOINT_STATE](header=header, name=list(names), **fields)
        self._template = bytes(typestore().serialize_cdr(message, JOINT_STATE))
        self._numbers = struct.Struct(f"<{len(names)}d")
        behind = len(_FIELDS) - 1 - _FIELDS.index(field)  # empty fields, a length of four bytes each
        self._start = len(self._template) - 4 * behind - self._numbers.size

    def __call__(self, stamp_ns: int, values: Sequence[float]) -> bytes:
        """The message's CDR bytes."""
        data = bytearray(self._template)
        _STAMP.pack_into(data, _STAMP_OFFSET, stamp_ns // _NS_PER_S, stamp_ns % _NS_PER_S)
        self._numbers.pack_into(data, self._start, *values)
        return bytes(data)
