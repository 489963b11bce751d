"""Read one number out of CDR bytes without decoding the message around it.

A generated decoder builds the whole message, arrays and all; most of a replay from inputs went there. From the type's
definition this writes a small function that steps over the fields in front of the wanted one and unpacks that one.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

from iwm_power_manager.bags.definitions import typestore

#: Encapsulation of little-endian CDR, all that is read here; others go the general way.
PLAIN = 0x01
_BODY = 4

_FORMATS = {
    "bool": "?",
    "byte": "B",
    "char": "B",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}


def number_reader(msgtype: str, path: list[str]) -> Callable[[bytes], float] | None:
    """Function from a message's bytes to the number at `path`; None if there is no such quick way.

    The function raises `struct.error` or `IndexError` for a message that ends too early.
    """
    writer = _Writer()
    if not writer.walk(msgtype, path):
        return None
    source = "\n".join(["def read(data):", *(f"    {line}" for line in writer.lines)])
    scope: dict[str, Any] = {"u32": struct.Struct("<I").unpack_from, "value": writer.value}
    exec(source, scope)  # noqa: S102 - written here, from a parsed definition, of digits and fixed words only
    read: Callable[[bytes], float] = scope["read"]
    return read


class _Writer:
    """Writes the lines of the function. Offsets count from the body's begin, as alignment does."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.value: Any = None
        self._offset: int | None = 0  # None: known only when the function runs, as `p`

    def walk(self, msgtype: str, path: list[str]) -> bool:
        """Step to the field at `path`; False where that is not possible."""
        from rosbags.interfaces import Nodetype

        for name, (kind, argument) in typestore().fielddefs[msgtype][1]:
            if name != path[0]:
                if not self._skip(kind, argument):
                    return False
                continue
            if kind == Nodetype.NAME and len(path) > 1:
                return self.walk(str(argument), path[1:])
            if kind != Nodetype.BASE or len(path) > 1 or argument[0] not in _FORMATS:
                return False
            number = struct.Struct("<" + _FORMATS[argument[0]])
            self._align(number.size)
            self.value = number.unpack_from
            self.lines.append(f"return value(data, {self._at()})[0]")
            return True
        return False

    def _skip(self, kind: Any, argument: Any) -> bool:
        from rosbags.interfaces import Nodetype

        if kind == Nodetype.NAME:
            return all(self._skip(*field) for _, field in typestore().fielddefs[str(argument)][1])
        if kind == Nodetype.BASE:
            if argument[0] in _FORMATS:
                self._advance(struct.calcsize("<" + _FORMATS[argument[0]]), 1)
                return True
            if argument[0] == "string":
                self._skip_counted(1)
                return True
            return False
        (item_kind, item), length = argument
        if item_kind != Nodetype.BASE or item[0] not in _FORMATS:
            return False
        size = struct.calcsize("<" + _FORMATS[item[0]])
        if kind == Nodetype.ARRAY:
            self._advance(size, length)
        else:
            self._skip_counted(size)
        return True

    def _at(self) -> str:
        return str(self._offset + _BODY) if self._offset is not None else f"p + {_BODY}"

    def _align(self, size: int) -> None:
        if self._offset is not None:
            self._offset = -(-self._offset // size) * size
        elif size > 1:
            self.lines.append(f"p = (p + {size - 1}) & -{size}")

    def _advance(self, size: int, count: int) -> None:
        self._align(size)
        if self._offset is not None:
            self._offset += size * count
        else:
            self.lines.append(f"p += {size * count}")

    def _skip_counted(self, size: int) -> None:
        """Step over a string or a sequence: a length of four bytes, then as many items."""
        self._align(4)
        self.lines.append(f"n = u32(data, {self._at()})[0]")
        self.lines.append(f"p = {self._offset + 4}" if self._offset is not None else "p += 4")
        self._offset = None
        if size > 1:
            self.lines.append("if n:")
            self.lines.append(f"    p = ((p + {size - 1}) & -{size}) + n * {size}")
        else:
            self.lines.append("p += n")
