# SPDX-License-Identifier: Apache-2.0
"""Numbers out of CDR messages and into them, fast where messages are alike: which those of one topic are.

Building a whole message to read one number of it takes most of the time of a replay, and live longer than the control
law. So a message is decoded in full by the library once; its bytes are then walked along the type's definition, and one
`struct.Struct` is made that holds everything: what has to be the same in another message of this build (encapsulation,
lengths, texts) and the numbers that are wanted. A message whose fixed parts differ goes to the library again. Damaged
bytes are never read as if they were good: what the library refuses is refused here.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Sequence
from contextlib import suppress
from operator import itemgetter
from typing import TYPE_CHECKING, Any, NamedTuple

from iwm_power_manager.signals.types import Types

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_BODY = 4  # behind the encapsulation; alignment counts from here
_NS_PER_S = 1_000_000_000
_HEADER = "std_msgs/msg/Header"
#: Builds of one topic's messages that are remembered; more than a few come only from arrays that change their length.
_MOST_LAYOUTS = 16
_NUMBERS = {
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
_STEP = re.compile(r"([A-Za-z_]\w*)((?:\[\d+\])*)$")

#: A wanted number, or all numbers of a wanted array.
type Value = float | tuple[float, ...]
type Make[T] = Callable[[int, tuple[Any, ...], tuple[str, ...]], T]


class UnreadableError(ValueError):
    """Bytes that are no message of their type."""


def steps_of(path: str) -> list[str | int] | None:
    """Names and indices of a path such as `wheels[2].speed`; None if it is no path."""
    steps: list[str | int] = []
    for part in path.split("."):
        match = _STEP.match(part)
        if match is None:
            return None
        steps.append(match[1])
        steps += [int(index) for index in re.findall(r"\d+", match[2])]
    return steps


def names_path(field: str) -> str:
    """Path of the field `name` beside a field, as a JointState has it."""
    return ".".join([*field.split(".")[:-1], "name"])


def field_kind(types: Types, path: str) -> str:
    """What a field is: "number", "array", "message", "text", "texts", or "" if it does not exist."""
    from rosbags.interfaces import Nodetype

    steps = steps_of(path)
    kind: Any = Nodetype.NAME
    argument: Any = types.name
    for step in steps or [""]:
        if isinstance(step, int):
            if kind not in (Nodetype.ARRAY, Nodetype.SEQUENCE) or (kind == Nodetype.ARRAY and step >= argument[1]):
                return ""
            kind, argument = argument[0]
        else:
            fields = dict(types.store.fielddefs[str(argument)][1]) if kind == Nodetype.NAME else {}
            if step not in fields:
                return ""
            kind, argument = fields[step]
    if kind == Nodetype.NAME:
        return "message"
    if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        kind, argument = argument[0]
        one = "number" if kind == Nodetype.BASE and argument[0] in _NUMBERS else ""
        return "array" if one else "texts" if kind == Nodetype.BASE else "messages"
    return "number" if argument[0] in _NUMBERS else "text"


def numbers_in(types: Types, array: bool) -> list[str]:
    """Paths of all numbers of a type outside of lists, or of all arrays of numbers."""
    from rosbags.interfaces import Nodetype

    found: list[str] = []
    waiting = [("", types.name)]
    while waiting:
        above, name = waiting.pop()
        for field, (kind, argument) in types.store.fielddefs[name][1]:
            path = f"{above}{field}"
            if kind == Nodetype.NAME:
                waiting.append((path + ".", str(argument)))
            elif field_kind(types, path) == ("array" if array else "number"):
                found.append(path)
    return found


def has_header(types: Types) -> bool:
    """Whether a type begins with a `std_msgs/Header`, and so with a stamp."""
    fields = types.store.fielddefs[types.name][1]
    return bool(fields) and fields[0][0] == "header" and fields[0][1][1] == _HEADER


def check_encapsulation(data: bytes) -> None:
    """Refuse what does not begin as plain CDR: two bytes of kind, one of zero, one of padding (0 to 3).

    Raises
    ------
    UnreadableError
        It begins otherwise.
    """
    if len(data) < _BODY or data[0] or data[1] > 1 or data[2] or data[3] > 3:
        raise UnreadableError(f"encapsulation {bytes(data[:_BODY]).hex()} is none of plain CDR")


class _Layout(NamedTuple):
    """How messages of one build are read: unpacked at once, `same` picks what has to equal `seen`."""

    unpack: Callable[[bytes], tuple[Any, ...]]
    same: Callable[[tuple[Any, ...]], Any]
    seen: Any
    pick: Callable[[tuple[Any, ...]], tuple[Any, ...]]
    names: tuple[str, ...]


class MessageReader[T]:
    """Reads the messages of one topic.

    Parameters
    ----------
    types : of the messages
    fields : paths of the wanted numbers, and of arrays of numbers
    make : from the time of a message (its stamp, ns; without a header, what the caller gave), the wanted values in
        their order, and the names, to the result
    names : path of a list of texts that is wanted as well; "" for none
    stamped : take the time from the header, if there is one

    Attributes
    ----------
    types : of the messages
    stamped : messages carry a stamp that is used
    decoded : messages that went the long way through the library
    """

    def __init__(
        self, types: Types, fields: Sequence[str], make: Make[T], names: str = "", *, stamped: bool = True
    ) -> None:
        self.stamped = stamped and has_header(types)
        self.decoded = 0
        self.types = types
        self._fields = tuple(fields)
        self._make = make
        self._getters = [(_getter(path), field_kind(types, path) == "array") for path in fields]
        self._get_names = _getter(names) if names else None
        self._layouts: dict[int, _Layout] = {}

    def __call__(self, data: bytes, time_ns: int = 0) -> T:
        """What `make` makes of a message.

        Raises
        ------
        UnreadableError
            The bytes are no message of this type.
        """
        layout = self._layouts.get(len(data))
        if layout is not None:
            unpack, same, seen, pick, names = layout
            found = unpack(data)
            if same(found) == seen:
                if self.stamped:
                    time_ns = found[1] * _NS_PER_S + found[2]
                return self._make(time_ns, pick(found), names)
        return self._make(*self._decode(data, time_ns))

    def _decode(self, data: bytes, time_ns: int) -> tuple[int, tuple[Any, ...], tuple[str, ...]]:
        self.decoded += 1
        check_encapsulation(data)
        try:
            message: Any = self.types.deserialize(data)
            values = tuple(_plain(get(message), is_array) for get, is_array in self._getters)
            names = tuple(self._get_names(message)) if self._get_names else ()
        except Exception as error:  # noqa: BLE001 - generated decoders raise whatever damaged bytes make them raise
            raise UnreadableError(f"is no {self.types.name}: {error}") from None
        if self.stamped:
            time_ns = int(message.header.stamp.sec) * _NS_PER_S + int(message.header.stamp.nanosec)
        if data[1]:
            self._learn(data, values, names)
        return time_ns, values, names

    def _learn(self, data: bytes, values: tuple[Any, ...], names: tuple[str, ...]) -> None:
        with suppress(struct.error, IndexError, _NoLayoutError):
            layout = _layout(_Walk(self.types.store, data, self._fields).message(self.types.name), names)
            if repr(layout.pick(layout.unpack(data))) == repr(values):  # NaN included
                if len(self._layouts) >= _MOST_LAYOUTS:
                    self._layouts.clear()
                self._layouts[len(data)] = layout


def _plain(value: Any, is_array: bool) -> Value:
    return tuple(map(float, value)) if is_array else float(value)


def _getter(path: str) -> Callable[[Any], Any]:
    steps = steps_of(path) or []

    def get(message: Any) -> Any:
        for step in steps:
            message = message[step] if isinstance(step, int) else getattr(message, step)
        return message

    return get


class _NoLayoutError(Exception):
    """The type holds something that only the library reads."""


class _Part(NamedTuple):
    """A wanted number, or array of numbers, in the bytes; `wanted` is its place among the fields, -1 for the stamp."""

    begin: int
    code: str
    length: int
    wanted: int
    is_array: bool


class _Walk:
    """Goes through the bytes of a good message along its type's definition, and notes what stands where.

    Attributes
    ----------
    size : of the message
    fixed : begin and end of what has to be the same in another message of this build
    parts : where wanted numbers stand
    fields : wanted paths
    """

    def __init__(self, store: Typestore, data: bytes, fields: Sequence[str]) -> None:
        self.size = len(data)
        self.data = data
        self.fields = fields
        self.fixed: list[tuple[int, int]] = [(0, _BODY)]
        self.parts: list[_Part] = []
        self._store = store
        self._wanted = {"header.stamp.sec": -1, "header.stamp.nanosec": -1} | {path: i for i, path in enumerate(fields)}
        self._at = _BODY

    def message(self, msgtype: str, path: str = "") -> _Walk:
        """Walk all fields of a message."""
        fields = self._store.fielddefs[msgtype][1]
        for name, (kind, argument) in fields:
            self._field(kind, argument, f"{path}.{name}" if path else name)
        if not fields:
            self._at += 1  # ROS 2 gives an empty message one byte
        return self

    def _field(self, kind: Any, argument: Any, path: str) -> None:
        from rosbags.interfaces import Nodetype

        if kind == Nodetype.NAME:
            self.message(str(argument), path)
        elif kind == Nodetype.BASE and argument[0] in _NUMBERS:
            self._number(_NUMBERS[argument[0]], path)
        elif kind == Nodetype.BASE and argument[0] == "string":
            self._text()
        elif kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            item, count = argument
            self._items(item, count if kind == Nodetype.ARRAY else self._length(), path)
        else:
            raise _NoLayoutError

    def _items(self, item: tuple[Any, Any], count: int, path: str) -> None:
        from rosbags.interfaces import Nodetype

        kind, argument = item
        if kind == Nodetype.BASE and argument[0] in _NUMBERS:
            code = _NUMBERS[argument[0]]
            if count:
                self._align(struct.calcsize("<" + code))
            if path in self._wanted:
                self.parts.append(_Part(self._at, code, count, self._wanted[path], True))
            for wanted in range(count) if any(name.startswith(path + "[") for name in self._wanted) else ():
                if (found := self._wanted.get(f"{path}[{wanted}]")) is not None:
                    place = self._at + wanted * struct.calcsize("<" + code)
                    self.parts.append(_Part(place, code, 1, found, False))
            self._at += count * struct.calcsize("<" + code)
        elif kind == Nodetype.BASE and argument[0] == "string":
            for _ in range(count):
                self._text()
        else:
            for i in range(count):
                self._field(kind, argument, f"{path}[{i}]")

    def _number(self, code: str, path: str) -> None:
        size = struct.calcsize("<" + code)
        self._align(size)
        if path in self._wanted:
            self.parts.append(_Part(self._at, code, 1, self._wanted[path], False))
        self._at += size

    def _length(self) -> int:
        before = self._at
        self._align(4)
        self._fix(before, self._at + 4)
        return int(struct.unpack_from("<I", self.data, self._at - 4)[0])

    def _text(self) -> None:
        length = self._length()
        self._fix(self._at, self._at + length)

    def _fix(self, before: int, end: int) -> None:
        """Step to `end` over bytes that have to be the same; what follows on another such part is one with it."""
        if self.fixed[-1][1] == before:
            self.fixed[-1] = (self.fixed[-1][0], end)
        else:
            self.fixed.append((self._at, end))
        self._at = end

    def _align(self, size: int) -> None:
        self._at = _BODY + -(-(self._at - _BODY) // size) * size


def _layout(walk: _Walk, names: tuple[str, ...]) -> _Layout:
    """One `Struct` over the whole message, and who finds what in what it unpacks."""
    spans: list[tuple[int, str, int, _Part | None]] = [(begin, f"{end - begin}s", 1, None) for begin, end in walk.fixed]
    spans += [(part.begin, part.code, part.length, part) for part in walk.parts if part.length]
    pattern, at, places = "<", 0, 0
    same: list[int] = []
    where: dict[int, int | slice] = {part.wanted: slice(0, 0) for part in walk.parts if not part.length}
    whole = False
    for begin, code, count, part in sorted(spans, key=itemgetter(0)):
        if begin < at:
            raise _NoLayoutError  # wanted twice, or nothing that can be
        pattern += f"{begin - at}x" + (f"{count}{code}" if part else code)
        at = begin + count * struct.calcsize("<" + code)
        if part is None:
            same.append(places)
        elif part.wanted >= 0:
            whole = whole or part.code not in "fd"
            where[part.wanted] = slice(places, places + count) if part.is_array else places
        places += count
    packed = struct.Struct(pattern + f"{walk.size - at}x")
    places_of = [where[i] for i in range(len(walk.fields))]
    pick = _picker(places_of, whole)
    pick_same = itemgetter(*same)
    return _Layout(packed.unpack, pick_same, pick_same(packed.unpack(walk.data)), pick, names)


def _picker(places: list[int | slice], whole: bool) -> Callable[[tuple[Any, ...]], tuple[Any, ...]]:
    """Function from what was unpacked to the wanted values, in their order."""
    if whole:  # integers and flags among them
        getters = [(itemgetter(place), isinstance(place, slice)) for place in places]
        return lambda found: tuple(_plain(get(found), is_array) for get, is_array in getters)
    if len(places) == 1:
        (place,) = places
        if isinstance(place, int):
            return itemgetter(slice(place, place + 1))
        return lambda found: (found[place],)
    return itemgetter(*places) if places else lambda _: ()


class MessageWriter:
    """Writes messages that differ from a template in their stamp and in the numbers of one field.

    Parameters
    ----------
    types : of the message
    template : its CDR bytes, little-endian, the field as long as it will be
    field : path of the number or array of numbers; whole ones with a sign are rounded
    """

    def __init__(self, types: Types, template: bytes, field: str) -> None:
        (part,) = [p for p in _Walk(types.store, template, [field]).message(types.name).parts if p.wanted == 0]
        self._template = template
        self._stamped = has_header(types)
        self._stamp = struct.Struct("<iI")
        self._numbers = struct.Struct(f"<{part.length}{part.code}")
        self._start = part.begin
        self._whole = part.code in "bhiq"

    def __call__(self, stamp_ns: int, values: Sequence[float]) -> bytes:
        """The message's CDR bytes."""
        data = bytearray(self._template)
        if self._stamped:
            self._stamp.pack_into(data, _BODY, stamp_ns // _NS_PER_S, stamp_ns % _NS_PER_S)
        values = [round(value) for value in values] if self._whole else values
        self._numbers.pack_into(data, self._start, *values)
        return bytes(data)


def blank(types: Types, path: str = "", length: int = 0) -> Any:
    """A message with zeros, empty texts and empty lists in it; arrays of fixed length full of zeros.

    Lists on the way of `path` are as long as its indices ask for, and one at its end as long as `length`.
    """
    import numpy as np
    from rosbags.interfaces import Nodetype

    def value(kind: Any, argument: Any, steps: Sequence[str | int] | None) -> Any:
        """Of a field; `steps` from there on, None beside the way."""

        def beyond(step: str | int) -> Sequence[str | int] | None:
            return steps[1:] if steps and steps[0] == step else None

        if kind == Nodetype.NAME:
            fields = types.store.fielddefs[str(argument)][1]
            return types.store.types[str(argument)](
                **{name: value(kind, argument, beyond(name)) for name, (kind, argument) in fields}
            )
        if kind == Nodetype.BASE:
            return "" if argument[0].endswith("string") else 0
        (item_kind, item), count = argument
        if kind != Nodetype.ARRAY:
            count = 0 if steps is None else int(steps[0]) + 1 if steps else length
        if item_kind == Nodetype.BASE and item[0] in _NUMBERS:
            return np.zeros(count, dtype=np.dtype("<" + _NUMBERS[item[0]]))
        return [value(item_kind, item, beyond(i)) for i in range(count)]

    return value(Nodetype.NAME, types.name, steps_of(path))
