# SPDX-License-Identifier: Apache-2.0
"""Which topic and field is which signal, in which unit: one YAML for the live node and for bags.

    signals:
      speed: {topic: /odom, type: nav_msgs/msg/Odometry, field: twist.twist.linear.x, unit: km/h}
      wheel_speed: {topic: /joint_states, type: sensor_msgs/msg/JointState, field: velocity, unit: rpm,
                    names: [fl, fr, rl, rr], sign: [1, -1, 1, -1]}
      power_demand: {topic: /demand, type: std_msgs/msg/Float64, field: data, unit: kW, factor: -1}

Every signal ends up in SI units: (value * factor + offset) * sign, then the unit. A bag knows its own types, so that
`type` may be left out there; live it is needed. docs/connect.md explains every key.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

from iwm_power_manager.errors import BagError, ConfigError, one_line
from iwm_power_manager.files import check_choice, check_keys, check_number, dotted, read_yaml
from iwm_power_manager.model.parameters import VehicleParams
from iwm_power_manager.share import share_path
from iwm_power_manager.signals.commands import (
    FRICTION,
    Sink,
    check_factor,
    place,
    read_commands,
    signs,
    standard,
    wheel_names,
)
from iwm_power_manager.signals.contract import CLOCK, DIAGNOSTICS, JOINT_STATE

DEFAULT_MAPPING = "config/signals/standard.yaml"

WHEELS = 4
#: Largest offset.
_OFFSET = 1e9
_TOPIC = re.compile(r"(?!.{248})(~/|/)?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)
#: Longest name of a topic, with its namespace, that ROS allows.
_LONGEST = 247
#: Nobody's topics to command on or to take a number from.
_OF_ROS = (DIAGNOSTICS, CLOCK, "/rosout", "/parameter_events")


class Unit(NamedTuple):
    """SI value = factor * value + offset; `rolling`: a speed of the rim, over the wheel's radius."""

    factor: float = 1.0
    offset: float = 0.0
    rolling: bool = False


_G = 9.80665
_SPEED = {"m/s": Unit(), "km/h": Unit(1.0 / 3.6), "mph": Unit(0.44704)}
_TURNING = {
    "rad/s": Unit(),
    "rpm": Unit(2.0 * math.pi / 60.0),
    "deg/s": Unit(math.pi / 180.0),
    "rev/s": Unit(2.0 * math.pi),
}
_RIM = {name: unit._replace(rolling=True) for name, unit in _SPEED.items()}
_RATIO = {"1": Unit(), "%": Unit(0.01)}
_ACCELERATION = {"m/s2": Unit(), "g": Unit(_G)}

#: Units of each signal.
UNITS: dict[str, dict[str, Unit]] = {
    "speed": _SPEED,
    "wheel_speed": _TURNING | _RIM,
    "power_demand": {"W": Unit(), "kW": Unit(1e3)},
    "force_demand": {"N": Unit(), "kN": Unit(1e3)},
    "torque_demand": {"N m": Unit()},
    "acceleration_demand": _ACCELERATION,
    "accelerator_pedal": _RATIO,
    "brake_pedal": _RATIO,
    "direction": {"1": Unit()},
    "motor_torque": {"N m": Unit()},
    "soc": _RATIO,
    "battery_temperature": {"degC": Unit(), "K": Unit(1.0, -273.15), "degF": Unit(5.0 / 9.0, -160.0 / 9.0)},
    "battery_voltage": {"V": Unit()},
    "battery_current": {"A": Unit()},
    "friction": _RATIO,
    "yaw_rate": {name: _TURNING[name] for name in ("rad/s", "deg/s")},
    "longitudinal_acceleration": _ACCELERATION,
    "lateral_acceleration": _ACCELERATION,
    "steering_angle": {"rad": Unit(), "deg": Unit(math.pi / 180.0)},
}
SIGNALS = tuple(UNITS)
#: Signals that are four numbers, one for each wheel.
OF_WHEELS = ("wheel_speed", "motor_torque")
PEDALS = ("accelerator_pedal", "brake_pedal")
#: Ways to say what the driver wants; a live mapping has one of them, or both pedals.
DEMANDS = ("power_demand", "force_demand", "torque_demand", "acceleration_demand")
BATTERY = ("soc", "battery_temperature", "battery_voltage", "battery_current")
MOTION = ("yaw_rate", "longitudinal_acceleration", "lateral_acceleration", "steering_angle")

RELIABILITIES = ("best_effort", "reliable")
STAMPS = ("header", "source")


class Source(NamedTuple):
    """Where one signal, or one wheel of it, comes from.

    Attributes
    ----------
    key : where it stands in the file, for messages about it
    topic : full name, or without leading slash a name in any namespace
    field : path of the number in the message, such as `twist.linear.x` or `data[2]`
    unit : of the value after `factor`, `signs` and `offset`
    type : of the message; "" where the bag says it
    factor, offset : applied in the message's unit, with the sign that is in common
    signs : +1 or -1 for each of four wheels; () for all +1
    names : of the four wheels in the order of this project, to be found in the message's field `name`; () if the field
        is a single number or an array in the right order
    qos : "best_effort" or "reliable": what the live subscription asks for
    stamp : "header" takes the header's stamp, if there is one; "source" the time DDS says it was sent
    """

    key: str
    topic: str
    field: str
    unit: Unit
    type: str = ""
    factor: float = 1.0
    offset: float = 0.0
    signs: tuple[float, ...] = ()
    names: tuple[str, ...] = ()
    qos: str = "best_effort"
    stamp: str = "header"

    @property
    def of_one_wheel(self) -> bool:
        """One of four sources of a signal of wheels."""
        return self.key.endswith("]")

    @property
    def of_all_wheels(self) -> bool:
        """The one source of a signal of wheels: its field is an array."""
        return self.key.rpartition(".")[2] in OF_WHEELS


class SignalMapping(NamedTuple):
    """A checked mapping file.

    Attributes
    ----------
    path : the file
    sources : by signal; one of `OF_WHEELS` has one source for all wheels or four, each other signal one
    commands : by command; one sink for all wheels, four, or none
    """

    path: Path
    sources: dict[str, tuple[Source, ...]]
    commands: dict[str, tuple[Sink, ...]]

    def topics(self) -> list[str]:
        """Topics as the file names them, each once."""
        return list(dict.fromkeys(source.topic for sources in self.sources.values() for source in sources))

    def with_wheel_names(self, names: tuple[str, ...]) -> SignalMapping:
        """The same with other names of the wheels, where wheels are found by name."""
        sources = {
            signal: tuple(s._replace(names=names) if s.names else s for s in found)
            for signal, found in self.sources.items()
        }
        commands = {
            kind: tuple(sink._replace(names=names) if sink.names else sink for sink in sinks)
            for kind, sinks in self.commands.items()
        }
        return self._replace(sources=sources, commands=commands)

    def car(self, vehicle: VehicleParams) -> VehicleParams:
        """The car as the law may count on it: where another system has the brakes, without any."""
        without = vehicle.front.friction_brake._replace(max_torque_nm=0.0)
        return vehicle if self.commands[FRICTION] else vehicle.with_axles(friction_brake=without)

    def check_live(self) -> None:
        """Refuse what the node could not drive with.

        Raises
        ------
        ConfigError
            A signal it needs, or a type, is missing, or the demand comes twice.
        """
        for signal in ("speed", "wheel_speed", "soc"):
            if signal not in self.sources:
                raise ConfigError(self.path, f"signals.{signal}", "is missing; the node needs it")
        demands = [signal for signal in (*DEMANDS, *PEDALS) if signal in self.sources]
        if demands != list(PEDALS) and (len(demands) != 1 or demands[0] in PEDALS):
            found = ", ".join(demands) or "none"
            allowed = f"one of {', '.join(DEMANDS)}, or both pedals"
            raise ConfigError(self.path, "signals", f"the demand comes from {found}", allowed)
        for sources in self.sources.values():
            for source in sources:
                if not source.type:
                    raise ConfigError(self.path, f"{source.key}.type", "is missing; a live signal needs it")
        arrays: list[Source | Sink] = [one for sources in self.sources.values() for one in sources if one.of_all_wheels]
        arrays += [one for sinks in self.commands.values() for one in sinks if len(one.wheels) > 1]
        for one in arrays:
            if one.type == JOINT_STATE and not one.names:
                problem = "is missing; a JointState says by name which wheel is which"
                raise ConfigError(self.path, f"{one.key}.names", problem, "four names, as in the message's `name`")

    def check_topics(self, resolve: Callable[[str], str] | None = None, own: Iterable[str] = ()) -> None:
        """Refuse topics that get in each other's way.

        Parameters
        ----------
        resolve : full name of a topic, with namespace and remaps; then names that ROS cannot have are refused, too
        own : full names of the topics the node publishes beside the commands

        Raises
        ------
        ConfigError
            A name is none, one topic has two names, two wheels are one number, a demand is what a sensor shows, or a
            command goes where something else comes from or goes to.
        """
        taken = dict.fromkeys(_OF_ROS, "is ROS's own") | dict.fromkeys(own, "is this node's own")
        inputs: dict[str, Source] = {}
        numbers: dict[tuple[str, str, str], Source] = {}
        fields: dict[tuple[bool, str, str], Source] = {}  # of what is asked for, and of what is measured
        for signal, source in ((signal, source) for signal, sources in self.sources.items() for source in sources):
            full = self._resolved(source, resolve, taken)
            first = inputs.setdefault(full, source)
            if first.topic != source.topic:
                problem = f"{source.topic} is {full}, and so is {first.topic} of {first.key}"
                raise ConfigError(self.path, f"{source.key}.topic", problem, "the same name for the same topic")
            wheel = numbers.setdefault((signal, full, source.field), source)
            if wheel is not source:
                problem = f"{source.field} of {full} is another wheel's as well ({wheel.key})"
                raise ConfigError(self.path, f"{source.key}.field", problem, "a number of its own for each wheel")
            if signal != "direction":  # may well be the sign of a demand, or of the speed
                asks = signal in (*DEMANDS, *PEDALS)
                fields[asks, full, source.field] = source
                if found := fields.get((not asks, full, source.field)):
                    problem = f"{source.field} of {full} is {found.key} as well"
                    raise ConfigError(self.path, f"{source.key}.field", problem, "a demand of its own")
        taken |= {full: f"is an input as well ({source.key})" for full, source in inputs.items()}
        for sink in (sink for sinks in self.commands.values() for sink in sinks):
            taken[self._resolved(sink, resolve, taken)] = f"carries a command as well ({sink.key})"

    def _resolved(self, one: Source | Sink, resolve: Callable[[str], str] | None, taken: dict[str, str]) -> str:
        """Full name of a topic that is not taken."""
        key = f"{one.key}.topic"
        full = one.topic
        if resolve and (not _TOPIC.fullmatch(full) or len(full := resolve(full)) > _LONGEST):
            allowed = f"words of letters, digits and _ with a / between, {_LONGEST} characters at most: /wheels/speed_1"
            raise ConfigError(self.path, key, f"{one_line(one.topic, 60)!r} is no name of a topic", allowed)
        if full in taken:
            raise ConfigError(self.path, key, f"{full} {taken[full]}", "a topic of its own")
        return full


def load_mapping(path: Path | str | None = None) -> SignalMapping:
    """Read a mapping file; without a path, the project's own.

    Raises
    ------
    ConfigError
        The file is unreadable, or a key, topic, field or unit is wrong.
    """
    file = Path(path) if path is not None else share_path(DEFAULT_MAPPING)
    content = check_keys(file, read_yaml(file), ["signals"], ["commands"])
    signals = check_keys(file, content["signals"], [], SIGNALS, "signals")
    sources: dict[str, tuple[Source, ...]] = {}
    for signal, entry in signals.items():
        key = dotted("signals", signal)
        if signal in OF_WHEELS and isinstance(entry, list):
            if len(entry) != WHEELS:
                raise ConfigError(file, key, f"{len(entry)} sources", "one for all wheels, or four")
            sources[signal] = tuple(_source(file, f"{key}[{i}]", signal, item) for i, item in enumerate(entry))
        else:
            sources[signal] = (_source(file, key, signal, entry, wheels=signal in OF_WHEELS),)
    commands = read_commands(file, content["commands"]) if "commands" in content else standard()
    mapping = SignalMapping(file, sources, commands)
    mapping.check_topics()
    return mapping


def _source(file: Path, key: str, signal: str, entry: Any, *, wheels: bool = False) -> Source:
    optional = ["type", "factor", "offset", "sign", "qos", "stamp", *(["names"] if wheels else [])]
    values = check_keys(file, entry, ["topic", "field", "unit"], optional, key)
    units = UNITS[signal]
    unit = check_choice(file, dotted(key, "unit"), str(values["unit"]), units)  # YAML's 1 is a number
    sign = signs(file, dotted(key, "sign"), values.get("sign", 1), wheels=wheels)
    factor = check_factor(file, dotted(key, "factor"), values.get("factor", 1.0))
    offset = check_number(file, dotted(key, "offset"), values.get("offset", 0.0), -_OFFSET, _OFFSET)
    common = sign[0] if len(set(sign)) == 1 else 1.0
    return Source(
        key=key,
        **place(file, key, values),
        unit=units[unit],
        factor=factor * common,
        offset=offset * common,
        signs=sign if len(set(sign)) > 1 else (),
        names=wheel_names(file, dotted(key, "names"), values["names"]) if "names" in values else (),
        qos=check_choice(file, dotted(key, "qos"), values.get("qos", "best_effort"), RELIABILITIES),
        stamp=check_choice(file, dotted(key, "stamp"), values.get("stamp", "header"), STAMPS),
    )


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
