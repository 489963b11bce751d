"""Which topic and field of a bag is which signal, in which unit: read from YAML, applied to messages.

    signals:
      speed: {topic: /odom, field: twist.twist.linear.x, unit: km/h}
      wheel_speed: {topic: /joint_states, field: velocity, unit: rpm, names: [fl, fr, rl, rr]}
      power_demand: {topic: /demand, field: data, unit: kW, factor: -1}

Every signal ends up in SI units. The message types are those the bag itself describes, so that any type works whose
definition it carries or ROS 2 Jazzy knows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from iwm_power_manager.bags.definitions import learn_definition, typestore
from iwm_power_manager.bags.metadata import Topic
from iwm_power_manager.errors import BagError, ConfigError
from iwm_power_manager.files import check_choice, check_keys, check_number, dotted, read_yaml
from iwm_power_manager.share import share_path
from iwm_power_manager.signals.cdr import number_reader
from iwm_power_manager.signals.joint_state import JOINT_STATE, JointStateDecoder

DEFAULT_MAPPING = "config/bags/project.yaml"

WHEELS = 4

#: Factor from each unit to the SI unit of the signal.
_SPEED = {"m/s": 1.0, "km/h": 1.0 / 3.6, "mph": 0.44704}
_ANGULAR_SPEED = {"rad/s": 1.0, "rpm": 2.0 * math.pi / 60.0, "deg/s": math.pi / 180.0, "rev/s": 2.0 * math.pi}
_POWER = {"W": 1.0, "kW": 1e3}
_RATIO = {"1": 1.0, "%": 0.01}
_TEMPERATURE = {"degC": 1.0}

_ARTICLES = {"number": "a number", "array": "an array", "message": "a message", "text": "a text", "": "nothing"}

_UNITS: dict[str, dict[str, float]] = {
    "speed": _SPEED,
    "wheel_speed": _ANGULAR_SPEED,
    "power_demand": _POWER,
    "accelerator_pedal": _RATIO,
    "brake_pedal": _RATIO,
    "soc": _RATIO,
    "battery_temperature": _TEMPERATURE,
    "friction": _RATIO,
}
SIGNALS = tuple(_UNITS)


class Source(NamedTuple):
    """Where one signal, or one wheel of it, comes from.

    Attributes
    ----------
    topic : full name, or without leading slash a name in any namespace
    field : path of the number in the message, such as `twist.linear.x`
    factor : from the number to SI units
    names : of the four wheels in the order of this project, to be found in the message's field `name`; () if the field
        is a single number or an array in the right order
    """

    topic: str
    field: str
    factor: float
    names: tuple[str, ...] = ()


class SignalMapping(NamedTuple):
    """A checked mapping file.

    Attributes
    ----------
    path : the file
    sources : by signal; `wheel_speed` has one source for all wheels or four, each other signal one
    """

    path: Path
    sources: dict[str, tuple[Source, ...]]


class Extractor(NamedTuple):
    """Turns the bytes of one topic's messages into values of a signal.

    Attributes
    ----------
    signal : one of `SIGNALS`
    wheel : which wheel the value is for; -1 for all four, or for a signal that has no wheels
    read : values from a message of this topic, after deserialisation
    quick : the same from its little-endian CDR bytes; None if there is no quick way
    """

    signal: str
    wheel: int
    read: Callable[[Any], tuple[float, ...]]
    quick: Callable[[bytes], tuple[float, ...]] | None


def load_mapping(path: Path | str | None = None) -> SignalMapping:
    """Read a mapping file; without a path, the project's own.

    Raises
    ------
    ConfigError
        The file is unreadable, or a key, topic, field or unit is wrong.
    """
    file = Path(path) if path is not None else share_path(DEFAULT_MAPPING)
    content = check_keys(file, read_yaml(file), ["signals"])
    signals = check_keys(file, content["signals"], [], SIGNALS, "signals")
    sources: dict[str, tuple[Source, ...]] = {}
    for signal, entry in signals.items():
        key = dotted("signals", signal)
        if signal == "wheel_speed" and isinstance(entry, list):
            if len(entry) != WHEELS:
                raise ConfigError(file, key, f"{len(entry)} sources", "one for all wheels, or four")
            sources[signal] = tuple(_source(file, f"{key}[{i}]", signal, item, False) for i, item in enumerate(entry))
        else:
            sources[signal] = (_source(file, key, signal, entry, signal == "wheel_speed"),)
    return SignalMapping(file, sources)


def _source(file: Path, key: str, signal: str, entry: Any, wheels: bool) -> Source:
    values = check_keys(file, entry, ["topic", "field", "unit"], ["factor", *(["names"] if wheels else [])], key)
    for name in ("topic", "field"):
        if not isinstance(values[name], str) or not values[name]:
            raise ConfigError(file, dotted(key, name), f"{values[name]!r} is no name")
    units = _UNITS[signal]
    unit = check_choice(file, dotted(key, "unit"), values["unit"], units)
    factor = check_number(file, dotted(key, "factor"), values.get("factor", 1.0))
    names = values.get("names", ())
    if names and (
        not isinstance(names, list) or len(set(map(str, names))) != WHEELS or not all(isinstance(n, str) for n in names)
    ):
        raise ConfigError(
            file, dotted(key, "names"), f"{names!r} is not allowed", "four different names: fl, fr, rl, rr"
        )
    return Source(values["topic"], values["field"], factor * units[unit], tuple(names))


def topic_named(name: str, topics: Iterable[str]) -> str | None:
    """The recorded topic a name means; None if it was not recorded.

    Raises
    ------
    BagError
        The name has no leading slash and fits topics of several namespaces.
    """
    topics = list(topics)
    if name in topics:
        return name
    if name.startswith("/"):
        return None
    found = [topic for topic in topics if topic.endswith("/" + name)]
    if len(found) > 1:
        raise BagError(f"topic {name}: recorded in several namespaces: {', '.join(sorted(found))}; name one of them")
    return found[0] if found else None


def extractors(mapping: SignalMapping, topics: Mapping[str, Topic]) -> dict[str, list[Extractor]]:
    """For each recorded topic that carries a signal, how to read it.

    Raises
    ------
    ConfigError
        A field does not exist in the type of its topic, or is no number.
    BagError
        The definition of a type is nowhere to be found.
    """
    found: dict[str, list[Extractor]] = {}
    for signal, sources in mapping.sources.items():
        for wheel, source in enumerate(sources):
            name = topic_named(source.topic, topics)
            if name is None:
                continue
            topic = topics[name]
            learn_definition(topic)
            key = dotted("signals", signal)
            all_wheels = signal == "wheel_speed" and len(sources) == 1
            read = _reader(mapping.path, key, source, topic, all_wheels=all_wheels)
            quick = _quick_wheels(source, topic) if all_wheels else _quick_number(source, topic)
            found.setdefault(name, []).append(Extractor(signal, wheel if len(sources) > 1 else -1, read, quick))
    return found


def _reader(file: Path, key: str, source: Source, topic: Topic, all_wheels: bool) -> Callable[[Any], tuple[float, ...]]:
    path = source.field.split(".")
    kind = _field_kind(topic.type, path)
    wanted = "array" if all_wheels else "number"
    if kind != wanted:
        problem = f"{topic.type} has no field {source.field}" if kind == "" else f"{source.field} is {_ARTICLES[kind]}"
        raise ConfigError(file, dotted(key, "field"), problem, f"a field of {topic.type} that is {_ARTICLES[wanted]}")
    factor, names = source.factor, source.names
    if names and _field_kind(topic.type, [*path[:-1], "name"]) != "array":
        raise ConfigError(file, dotted(key, "names"), f"{topic.type} has no field `name` beside {source.field}")
    last = path[-1]

    def parent(message: Any) -> Any:
        for part in path[:-1]:
            message = getattr(message, part)
        return message

    def number(message: Any) -> tuple[float, ...]:
        return (factor * float(getattr(parent(message), last)),)

    def in_order(message: Any) -> tuple[float, ...]:
        values = getattr(parent(message), last)
        if len(values) != WHEELS:
            return (math.nan,) * WHEELS
        return tuple(factor * float(value) for value in values)

    def by_name(message: Any) -> tuple[float, ...]:
        owner = parent(message)
        values, present = getattr(owner, last), list(owner.name)
        if len(values) != len(present):
            return (math.nan,) * WHEELS
        return tuple(
            factor * float(values[present.index(name)]) if present.count(name) == 1 else math.nan for name in names
        )

    if not all_wheels:
        return number
    return by_name if names else in_order


def _quick_number(source: Source, topic: Topic) -> Callable[[bytes], tuple[float, ...]] | None:
    read = number_reader(topic.type, source.field.split("."))
    factor = source.factor
    return None if read is None else lambda data: (factor * float(read(data)),)


def _quick_wheels(source: Source, topic: Topic) -> Callable[[bytes], tuple[float, ...]] | None:
    if topic.type != JOINT_STATE or not source.names:
        return None
    decode, factor, wanted = JointStateDecoder(source.field), source.factor, source.names

    def read(data: bytes) -> tuple[float, ...]:
        _, names, values = decode(data)
        if names == wanted:
            return tuple(factor * value for value in values)
        return tuple(factor * values[names.index(name)] if names.count(name) == 1 else math.nan for name in wanted)

    return read


def _field_kind(msgtype: str, path: list[str]) -> str:
    """What a field is: "number", "array", "message", "text", or "" if it does not exist."""
    from rosbags.interfaces import Nodetype

    fields = dict(typestore().fielddefs[msgtype][1])
    if path[0] not in fields:
        return ""
    kind, argument = fields[path[0]]
    if kind == Nodetype.NAME:
        return _field_kind(str(argument), path[1:]) if len(path) > 1 else "message"
    if len(path) > 1:
        return ""
    if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        return "array"
    return "text" if argument[0] in ("string", "wstring") else "number"
