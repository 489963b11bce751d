# SPDX-License-Identifier: Apache-2.0
"""Commands to bytes, by the same YAML as the signals: which topic, type and field carries the torques of the wheels.

    commands:
      motor_torque: {topic: /effort_controller/commands, type: std_msgs/msg/Float64MultiArray, field: data, unit: N m,
                     order: [front_left, front_right, rear_left, rear_right]}
      friction_torque: none

A command is one message with an array of four (in a stated order, or by name in a JointState) or four messages with a
number each. What is sent is torque * factor * sign. `none` leaves the friction brakes to another system; with it alone
in the section, motor torques go to the project's own topic.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple

from iwm_power_manager.control.types import WHEEL_NAMES
from iwm_power_manager.errors import BagError, ConfigError
from iwm_power_manager.files import check_choice, check_keys, check_number, dotted
from iwm_power_manager.signals.cdr import MessageWriter, blank, field_kind, names_path, steps_of
from iwm_power_manager.signals.contract import FRICTION_BRAKE_COMMAND, JOINT_STATE, WHEEL_TORQUE_COMMAND
from iwm_power_manager.signals.types import Types, full_name, types_of

MOTOR, FRICTION = "motor_torque", "friction_torque"
COMMANDS = (MOTOR, FRICTION)
_WHEELS = len(WHEEL_NAMES)
_UNITS = {"N m": 1.0}
#: Largest factor, and one over the smallest.
_MOST = 1e9
#: Furthest place in a list that a command may have.
_LAST = 999


class Sink(NamedTuple):
    """Where one command, or one wheel of it, goes.

    Attributes
    ----------
    key : where it stands in the file
    topic, type, field : what carries it
    factors : of each wheel, with its sign
    wheels : indices of the wheels it carries, in the order of the message
    names : of the joints, in the order of the wheels; () for none
    """

    key: str
    topic: str
    type: str
    field: str
    factors: tuple[float, ...]
    wheels: tuple[int, ...] = (0, 1, 2, 3)
    names: tuple[str, ...] = ()


def standard(names: Sequence[str] = WHEEL_NAMES) -> dict[str, tuple[Sink, ...]]:
    """The project's own commands: JointStates whose field `effort` holds the torques by name."""
    return {
        kind: (Sink(f"commands.{kind}", topic, JOINT_STATE, "effort", (1.0,) * _WHEELS, names=tuple(names)),)
        for kind, topic in ((MOTOR, WHEEL_TORQUE_COMMAND), (FRICTION, FRICTION_BRAKE_COMMAND))
    }


def read_commands(file: Path, content: Any) -> dict[str, tuple[Sink, ...]]:
    """The section `commands` of a signals file.

    Raises
    ------
    ConfigError
        A key, name, unit or order is wrong.
    """
    entries = check_keys(file, content, [FRICTION], [MOTOR], "commands")
    found: dict[str, tuple[Sink, ...]] = {}
    if MOTOR not in entries:
        if entries[FRICTION] != "none":
            raise ConfigError(file, dotted("commands", MOTOR), "is missing", "left out only with friction_torque: none")
        found[MOTOR] = standard()[MOTOR]
    for kind, entry in entries.items():
        key = dotted("commands", kind)
        if kind == FRICTION and entry == "none":
            found[kind] = ()
        elif isinstance(entry, list):
            if len(entry) != _WHEELS:
                raise ConfigError(file, key, f"{len(entry)} topics", "one for all wheels, or four")
            found[kind] = tuple(_one(file, f"{key}[{i}]", item, i) for i, item in enumerate(entry))
        else:
            found[kind] = (_all(file, key, entry),)
    return found


def _base(file: Path, key: str, entry: Any, more: list[str]) -> dict[str, Any]:
    values = dict(check_keys(file, entry, ["topic", "type", "field", "unit"], ["factor", "sign", *more], key))
    check_choice(file, dotted(key, "unit"), values["unit"], _UNITS)
    return values | place(file, key, values)


def place(file: Path, key: str, values: Mapping[str, Any]) -> dict[str, str]:
    """Topic, field and type of an entry, the type's name in full; `ConfigError` for what cannot be one."""
    for name in ("topic", "field", "type"):
        if not isinstance(values.get(name, "x"), str) or not values.get(name, "x"):
            raise ConfigError(file, dotted(key, name), f"{values[name]!r} is no name")
    if steps_of(values["field"]) is None:
        allowed = "names with a dot between, as in twist.linear.x, and indices, as in data[2]"
        raise ConfigError(file, dotted(key, "field"), f"{values['field']!r} is no path", allowed)
    try:
        msgtype = full_name(values["type"]) if "type" in values else ""
    except BagError:
        problem = f"{values['type']!r} is no name of a message type"
        raise ConfigError(file, dotted(key, "type"), problem, "package/msg/Type, as in std_msgs/msg/Float64") from None
    return {"topic": values["topic"], "field": values["field"], "type": msgtype}


def check_factor(file: Path, key: str, value: Any) -> float:
    """A factor that does not make nothing, or anything, of a number."""
    number = check_number(file, key, value)
    if not 1.0 / _MOST <= abs(number) <= _MOST:
        raise ConfigError(file, key, f"{value} is out of range", f"{1.0 / _MOST:g} to {_MOST:g}, or as far below 0")
    return number


def _factors(file: Path, key: str, factor: Any, *, wheels: bool) -> tuple[float, ...]:
    """A factor, or where wheels have one each, four; `ConfigError` for anything else."""
    found = factor if wheels and isinstance(factor, list) and len(factor) == _WHEELS else [factor]
    return tuple(check_factor(file, key, one) for one in found)


def _one(file: Path, key: str, entry: Any, wheel: int) -> Sink:
    values = _base(file, key, entry, [])
    (factor,) = _factors(file, dotted(key, "factor"), values.get("factor", 1.0), wheels=False)
    (sign,) = signs(file, dotted(key, "sign"), values.get("sign", 1), wheels=False)
    return Sink(key, values["topic"], values["type"], values["field"], (factor * sign,), (wheel,))


def _all(file: Path, key: str, entry: Any) -> Sink:
    values = _base(file, key, entry, ["names", "order"])
    factor = _factors(file, dotted(key, "factor"), values.get("factor", 1.0), wheels=True)
    sign = signs(file, dotted(key, "sign"), values.get("sign", 1), wheels=True)
    factors = tuple(a * b for a, b in zip(cycle(factor), sign * _WHEELS if len(sign) == 1 else sign, strict=False))
    names = wheel_names(file, dotted(key, "names"), values["names"]) if "names" in values else ()
    order = values.get("order", list(WHEEL_NAMES))
    if not isinstance(order, list) or sorted(map(str, order)) != sorted(WHEEL_NAMES):
        raise ConfigError(
            file, dotted(key, "order"), f"{order!r} is not allowed", f"an order of {', '.join(WHEEL_NAMES)}"
        )
    wheels = tuple(WHEEL_NAMES.index(name) for name in order)
    return Sink(key, values["topic"], values["type"], values["field"], factors, wheels, names)


def wheel_names(file: Path, key: str, names: Any) -> tuple[str, ...]:
    """Four different names of wheels; `ConfigError` for anything else."""
    texts = isinstance(names, list) and all(isinstance(name, str) and name for name in names)
    if texts and len(names) == len(set(names)) == _WHEELS:
        return tuple(names)
    raise ConfigError(file, key, f"{names!r} is not allowed", "four different names: fl, fr, rl, rr")


def signs(file: Path, key: str, sign: Any, *, wheels: bool) -> tuple[float, ...]:
    """A sign, or where wheels have one each, four; `ConfigError` for anything else."""
    found = sign if wheels and isinstance(sign, list) and len(sign) == _WHEELS else [sign]
    if any(isinstance(one, bool) or one not in (1, -1) for one in found):
        raise ConfigError(file, key, f"{sign!r} is not allowed", "1, -1" + (", or four of them" if wheels else ""))
    return tuple(float(one) for one in found)


class CommandWriter:
    """Four torques to the bytes of the messages that carry them.

    Parameters
    ----------
    file, sinks : of one command
    most_nm : largest torque, either way, that the messages have to hold

    Raises
    ------
    ConfigError
        A type is not known, or a field is not there or cannot hold torques.
    """

    def __init__(self, file: Path, sinks: Sequence[Sink], most_nm: float = 0.5) -> None:
        self._writers = [(sink.topic, parts_of(sink), _writer(file, sink, most_nm)) for sink in sinks]

    def __call__(self, stamp_ns: int, torque_nm: Sequence[float]) -> list[tuple[str, bytes]]:
        """Topic and bytes of each message."""
        return [
            (topic, write(stamp_ns, [factor * torque_nm[wheel] for wheel, factor in parts]))
            for topic, parts, write in self._writers
        ]


def parts_of(sink: Sink) -> list[tuple[int, float]]:
    """Wheel and factor of each number of the message."""
    return [(wheel, sink.factors[wheel if len(sink.factors) > 1 else 0]) for wheel in sink.wheels]


def _writer(file: Path, sink: Sink, most_nm: float) -> MessageWriter:
    try:
        types = types_of(sink.type)
    except BagError as error:
        raise ConfigError(file, dotted(sink.key, "type"), str(error)) from None
    wanted = "number" if len(sink.wheels) == 1 else "array"
    if field_kind(types, sink.field) != wanted:
        raise ConfigError(
            file,
            dotted(sink.key, "field"),
            f"{sink.type} has no {wanted} {sink.field}",
            f"a field that is one {wanted}",
        )
    if any(isinstance(step, int) and step > _LAST for step in steps_of(sink.field) or ()):
        raise ConfigError(file, dotted(sink.key, "field"), f"{sink.field} is far back in a list", f"up to [{_LAST}]")
    writer = MessageWriter(types, _template(file, types, sink), sink.field)
    try:
        for sign in (-1.0, 1.0):
            writer(0, [sign * factor * most_nm for _, factor in parts_of(sink)])
    except struct.error:
        problem = f"{sink.field} cannot hold {len(sink.wheels)} torques of up to {most_nm:g} N m with their factor"
        allowed = "a float for each wheel, or a whole number with a sign that is large enough"
        raise ConfigError(file, dotted(sink.key, "field"), problem, allowed) from None
    return writer


def _template(file: Path, types: Types, sink: Sink) -> bytes:
    """A message as long as those that are sent, with names where it has such."""
    message = owner = blank(types, sink.field, len(sink.wheels))
    for step in (steps_of(sink.field) or [""])[:-1]:
        owner = owner[step] if isinstance(step, int) else getattr(owner, step)
    if sink.names:
        if field_kind(types, names_path(sink.field)) != "texts":
            raise ConfigError(file, dotted(sink.key, "names"), f"{sink.type} has no field `name` beside {sink.field}")
        owner.name = [sink.names[wheel] for wheel in sink.wheels]
    return bytes(types.store.serialize_cdr(message, types.name))
