# SPDX-License-Identifier: Apache-2.0
"""Bytes of messages to readings, by a mapping: the same code for the live node and for bags.

A topic has one reader, whatever signals it carries. What belongs together and comes apart (four wheels on four topics,
two pedals, a battery in single numbers) is put together in an `Assembly`, which the readers of a mapping share. Values
are converted here and judged in `control.inputs`.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from difflib import SequenceMatcher
from pathlib import Path
from typing import Any, NamedTuple

from iwm_power_manager.control.monitor import BatteryReading, JointReading, SpeedReading
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.interpreted import interpreted
from iwm_power_manager.model.parameters import VehicleParams
from iwm_power_manager.model.pedals import ACCELERATION, FORCE, PEDAL_TRAVEL, TORQUE, demand_power_w
from iwm_power_manager.signals.cdr import (
    MessageReader,
    MessageWriter,
    UnreadableError,
    blank,
    field_kind,
    names_path,
    numbers_in,
)
from iwm_power_manager.signals.contract import JOINT_STATE
from iwm_power_manager.signals.gentle_pedal import GentlePedal
from iwm_power_manager.signals.mapping import (
    BATTERY,
    DEMANDS,
    OF_WHEELS,
    PEDALS,
    SIGNALS,
    UNITS,
    WHEELS,
    SignalMapping,
    Source,
)
from iwm_power_manager.signals.types import Types, types_of

_NAN = math.nan
#: Stamp of what cannot be read: older than anything.
_NEVER_NS = -(1 << 62)
#: Time of a pedal that no message tells of: newer than anything.
_UNMAPPED_NS = 1 << 62
#: A pedal from so far ahead is from before the clock was set back.
_AHEAD_NS = 1_000_000_000
_NS_PER_S = 1e9
#: A wheel of its own topic that has not come while another came so often is missing.
_MISSED_SETS = 3
#: A pedal may show a little more than its way; more than this is another unit, or another sign.
_TRAVEL = (-0.1, 1.1)
#: One number for each message: compiled code would only have more to convert.
_power_w = interpreted(demand_power_w)
#: What a demand that is no power is to it.
KINDS = {"force_demand": FORCE, "torque_demand": TORQUE, "acceleration_demand": ACCELERATION}
_ARTICLES = {
    "number": "a number",
    "array": "an array",
    "message": "a message",
    "messages": "a list of messages",
    "text": "a text",
    "texts": "a list of texts",
}


class DemandReading(NamedTuple):
    """What the driver wants, as power at the wheels, braking negative.

    Attributes
    ----------
    stamp_ns : time of the message
    power_w : the demand; infinite if a pedal is beyond its way
    lag_s : how much older the other pedal's last message is, where that one counts
    """

    stamp_ns: int
    power_w: float
    lag_s: float = 0.0


class FrictionReading(NamedTuple):
    """Peak friction coefficient of the road."""

    stamp_ns: int
    friction: float


class MotionReading(NamedTuple):
    """One of `mapping.MOTION`, in SI units: how the car turns, accelerates or is steered."""

    stamp_ns: int
    signal: str
    value: float


class TorqueReading(NamedTuple):
    """Torques the motors report, N m, with the names of their wheels."""

    stamp_ns: int
    names: tuple[str, ...]
    values: tuple[float, ...]


class DirectionReading(NamedTuple):
    """Direction the driver asks for: 1 forwards, -1 reverse."""

    stamp_ns: int
    direction: float


class NamedValues(NamedTuple):
    """One of a JointState's fields of numbers, with the names."""

    stamp_ns: int
    names: tuple[str, ...]
    values: tuple[float, ...]


type Reading = (
    SpeedReading
    | JointReading
    | BatteryReading
    | DemandReading
    | FrictionReading
    | DirectionReading
    | TorqueReading
    | MotionReading
)
#: The reading of each signal of four wheels.
_JOINTS: dict[str, type[JointReading | TorqueReading]] = {"wheel_speed": JointReading, "motor_torque": TorqueReading}
type _Bind = Callable[[int, tuple[Any, ...], tuple[str, ...]], tuple[Reading, ...]]


class Assembly:
    """What the readers of one mapping share.

    Parameters
    ----------
    wheel_names : of the four wheels as the controller knows them
    vehicle : the car, where a demand is no power or a wheel's speed is that of its rim; None where neither is so
    speed_mps : speed of the car as it is believed at present; None: the last finite one that was read

    Attributes
    ----------
    battery : last value of each of `mapping.BATTERY`, NaN before the first
    sources : of each signal that is mapped
    """

    def __init__(
        self,
        wheel_names: Sequence[str],
        vehicle: VehicleParams | None = None,
        speed_mps: Callable[[], float] | None = None,
    ) -> None:
        self.wheel_names = tuple(wheel_names)
        self.vehicle = vehicle
        self.battery = dict.fromkeys(BATTERY, _NAN)
        self.sources: Mapping[str, Sequence[Source]] = {}
        self.speed_read_mps = 0.0
        self._speed_mps = speed_mps or (lambda: self.speed_read_mps)
        self._wanted = "power_demand", _NAN, _NAN
        self._pedals = dict.fromkeys(PEDALS, (_UNMAPPED_NS, 0.0))
        self._use = {pedal: GentlePedal() for pedal in PEDALS}
        self._wheels = {signal: [_NAN] * WHEELS for signal in _JOINTS}
        self._came = {signal: [0] * WHEELS for signal in _JOINTS}

    def expect(self, sources: Mapping[str, Sequence[Source]]) -> None:
        """These are mapped: without one of the pedals among them there is no demand but to brake."""
        self.sources = sources
        self._pedals |= {signal: (_NEVER_NS, 0.0) for signal in PEDALS if signal in sources}

    def demand(self, signal: str, time_ns: int, value: float) -> tuple[DemandReading, ...]:
        """A demand in its own unit as power at the present speed; nothing as long as a pedal has never come."""
        if signal in PEDALS:
            return self._of_pedals(signal, time_ns, value)
        power_w = value
        if signal != "power_demand":
            assert self.vehicle is not None  # checked when the readers were made
            power_w = _power_w(KINDS[signal], value, 0.0, abs(self._speed_mps()), self.vehicle)
        self._wanted = signal, value, power_w
        return (DemandReading(time_ns, power_w),)

    def _of_pedals(self, signal: str, time_ns: int, value: float) -> tuple[DemandReading, ...]:
        """The demand of both pedals: as old as the older one, or as the brake if that is pressed."""
        assert self.vehicle is not None  # checked when the readers were made
        self._pedals[signal] = time_ns, value
        self._use[signal].note(time_ns, value)
        (_, accelerator), (brake_ns, brake) = (self._pedals[pedal] for pedal in PEDALS)
        travel = 1.0 if brake > _TRAVEL[1] else _way(brake)  # a brake demand gets through whatever its unit
        times_ns = [told for told, _ in self._pedals.values() if told != _UNMAPPED_NS]
        oldest_ns = min(times_ns)
        if travel > 0.0:  # and whatever the accelerator says, or does not
            signal, value, oldest_ns = PEDALS[1], brake, brake_ns
        elif oldest_ns == _NEVER_NS or max(times_ns) - time_ns > _AHEAD_NS:
            return ()
        else:
            signal, value = (PEDALS[1], brake) if math.isnan(travel) else (PEDALS[0], accelerator)
        power_w = _NAN
        if not math.isnan(travel):
            power_w = _power_w(PEDAL_TRAVEL, _way(accelerator), travel, abs(self._speed_mps()), self.vehicle)
        self._wanted = signal, value, power_w
        return (DemandReading(time_ns, power_w, max(time_ns - oldest_ns, 0) / _NS_PER_S),)

    def wanted_in_words(self) -> str:
        """The last demand as it was said, in the unit of the file, on which topic, and the power it became."""
        signal, value, power_w = self._wanted
        name, unit = next(iter(UNITS[signal].items()))
        where = ""
        for source in self.sources.get(signal, ()):
            name, unit = next((found, unit) for found, unit in UNITS[signal].items() if unit == source.unit)
            where = f" on {source.topic}"
        symbol = "" if name == "1" else f" {name}"
        power = f", which is {power_w:g} W" if signal != "power_demand" and math.isfinite(power_w) else ""
        way = ""
        if signal in PEDALS and math.isinf(_way(value)):
            way = f"; a pedal's way is 0 to {1.0 / unit.factor:g}{symbol}: right unit?"
        return f"{signal} {value / unit.factor:g}{symbol}{where}{power}{way}"

    def remarks(self) -> dict[str, tuple[bool, str]]:
        """What is odd about pedals, by signal, and whether it is sure: in %, and never beyond a hundredth."""
        found = {pedal: (use.released, use.remark(self.sources.get(pedal, ()))) for pedal, use in self._use.items()}
        return {pedal: (sure, text) for pedal, (sure, text) in found.items() if text}

    def wheel(self, signal: str, wheel: int, time_ns: int, value: float) -> tuple[Reading, ...]:
        """One wheel's number; a reading once all four have come, or one of them has stayed away for long."""
        held, came = self._wheels[signal], self._came[signal]
        held[wheel] = value
        came[wheel] += 1
        if 0 in came and came[wheel] < _MISSED_SETS:
            return ()
        values = tuple(one if count else _NAN for one, count in zip(held, came, strict=True))
        self._came[signal] = [0] * WHEELS
        return (_JOINTS[signal](time_ns, self.wheel_names, values),)


def _way(travel: float) -> float:
    """How far a pedal is pressed, 0..1; NaN stays NaN, and what is far from its way is infinite."""
    if math.isnan(travel):
        return _NAN
    return min(max(travel, 0.0), 1.0) if _TRAVEL[0] <= travel <= _TRAVEL[1] else math.inf


class TopicReader:
    """Bytes of one topic's messages to readings.

    Attributes
    ----------
    signals : that the topic carries
    sources : of these
    stamped : readings have the time of the message's header, else that given by the caller
    """

    def __init__(
        self, signals: Sequence[str], sources: Sequence[Source], reader: MessageReader[tuple[Reading, ...]]
    ) -> None:
        self.signals = tuple(signals)
        self.sources = tuple(sources)
        self.stamped = reader.stamped
        self.read = reader

    def __call__(self, data: bytes, time_ns: int) -> tuple[Reading, ...]:
        """Readings of a message; if it is none of its type, or too short, what the checks refuse and count."""
        try:
            return self.read(data, time_ns)
        except UnreadableError:
            every = (_unreadable(signal, time_ns) for signal in dict.fromkeys(self.signals))
            return tuple(reading for reading in every if reading)


def topic_readers(
    mapping: SignalMapping, types: Mapping[str, Types], assembly: Assembly, signals: Iterable[str] = ()
) -> dict[str, TopicReader]:
    """A reader for each topic that carries a mapped signal.

    Parameters
    ----------
    mapping : topics, fields and units
    types : by topic as the mapping names it; a topic that is not here is left out
    assembly : shared by the readers
    signals : those that are wanted; () for all

    Raises
    ------
    ConfigError
        A field does not exist in the type of its topic, or is no number; names the key.
    """
    assembly.expect(mapping.sources)
    by_topic: dict[str, list[tuple[str, int, Source]]] = defaultdict(list)
    for signal in sorted(mapping.sources, key=SIGNALS.index):  # the speed before what is judged or converted by it
        sources = mapping.sources[signal]
        for wheel, source in enumerate(sources):
            if source.topic in types and (not signals or signal in signals):
                by_topic[source.topic].append((signal, wheel if len(sources) > 1 else -1, source))
    return {topic: _topic_reader(mapping.path, types[topic], found, assembly) for topic, found in by_topic.items()}


def _topic_reader(file: Path, types: Types, found: list[tuple[str, int, Source]], assembly: Assembly) -> TopicReader:
    fields: dict[str, int] = {}
    names = ""
    stamped = True
    binds: list[_Bind] = []
    for signal, wheel, source in found:
        _check_source(file, types, source)
        _check_vehicle(file, signal, source, assembly.vehicle)
        place = fields.setdefault(source.field, len(fields))
        names = names or (names_path(source.field) if source.names else "")
        stamped = stamped and source.stamp == "header"
        if signal not in BATTERY:
            binds.append(_bind(signal, wheel, source, place, assembly))
    battery = {signal: (fields[source.field], _scale(source)) for signal, _, source in found if signal in BATTERY}
    if battery:
        binds.append(_bind_battery(battery, assembly))
    reader = MessageReader(types, list(fields), _together(binds), names, stamped=stamped)
    return TopicReader([signal for signal, _, _ in found], [source for _, _, source in found], reader)


def _together(binds: list[_Bind]) -> _Bind:
    first, *rest = binds
    if not rest:
        return first
    second, *rest = rest
    if not rest:
        return lambda time_ns, values, names: first(time_ns, values, names) + second(time_ns, values, names)

    def all_of_them(time_ns: int, values: tuple[Any, ...], names: tuple[str, ...]) -> tuple[Reading, ...]:
        return tuple([reading for bind in binds for reading in bind(time_ns, values, names)])

    return all_of_them


def _check_source(file: Path, types: Types, source: Source) -> None:
    msgtype = types.name
    if source.type and source.type != msgtype:
        raise ConfigError(file, f"{source.key}.type", f"{source.topic} carries {msgtype}, not {source.type}")
    kind = field_kind(types, source.field)
    wanted = "array" if source.of_all_wheels else "number"
    if kind != wanted:
        problem = f"{source.field} is {_ARTICLES[kind]}" if kind else f"{msgtype} has no field {source.field}"
        allowed = f"a field of {msgtype} that is {_ARTICLES[wanted]}"
        near = field_like(source, types)
        raise ConfigError(file, f"{source.key}.field", problem, allowed + (f", such as {near}" if near else ""))
    if source.names and field_kind(types, names_path(source.field)) != "texts":
        raise ConfigError(file, f"{source.key}.names", f"{msgtype} has no field `name` beside {source.field}")


def field_like(source: Source, types: Types) -> str:
    """The field of a type that is most like that of a source; "" if none could be its."""
    found = numbers_in(types, array=source.of_all_wheels)
    likeness = [SequenceMatcher(None, field, source.field).ratio() for field in found]
    best = max(likeness, default=0.0)
    return found[likeness.index(best)] if best >= 0.5 or len(found) == 1 else ""


def _check_vehicle(file: Path, signal: str, source: Source, vehicle: VehicleParams | None) -> None:
    if vehicle is None and source.unit.rolling:
        raise ConfigError(file, f"{source.key}.unit", "the speed of a rim needs the wheel's radius; name the vehicle")
    if vehicle is None and signal in (*PEDALS, *DEMANDS[1:]):
        raise ConfigError(file, source.key, "is no power: name the vehicle that says what it means")


def _scale(source: Source, radius_m: float = 1.0) -> Callable[[float], float] | None:
    """From a message's number to SI units; None if they are the same."""
    over = 1.0 / radius_m if source.unit.rolling else 1.0
    factor = source.factor * source.unit.factor * over
    offset = (source.offset * source.unit.factor + source.unit.offset) * over
    if offset:
        return lambda value: factor * value + offset
    return None if factor == 1.0 else lambda value: factor * value


def _bind(signal: str, wheel: int, source: Source, place: int, assembly: Assembly) -> _Bind:
    """Function from a message's wanted values to the readings they give."""
    scale = _scale(source, assembly.vehicle.front.wheel.radius_m if assembly.vehicle else 1.0)
    if signal == "speed":
        return _bind_speed(place, scale, assembly)
    if signal in OF_WHEELS and wheel < 0:
        return _bind_wheels(_JOINTS[signal], source, place, scale, assembly)
    scaled = scale or (lambda value: value)
    if signal in OF_WHEELS:
        return lambda time_ns, values, _: assembly.wheel(signal, wheel, time_ns, scaled(values[place]))
    if signal == "direction":
        return lambda time_ns, values, _: _direction(time_ns, scaled(values[place]))
    if signal in DEMANDS or signal in PEDALS:
        return lambda time_ns, values, _: assembly.demand(signal, time_ns, scaled(values[place]))
    if signal == "friction":
        return lambda time_ns, values, _: (FrictionReading(time_ns, scaled(values[place])),)
    return lambda time_ns, values, _: (MotionReading(time_ns, signal, scaled(values[place])),)


def _bind_speed(place: int, scale: Callable[[float], float] | None, assembly: Assembly) -> _Bind:
    def speed(time_ns: int, values: tuple[Any, ...], _: tuple[str, ...]) -> tuple[Reading, ...]:
        value = values[place] if scale is None else scale(values[place])
        if value == value:  # NaN is not
            assembly.speed_read_mps = value
        return (SpeedReading(time_ns, value),)

    return speed


def _direction(time_ns: int, value: float) -> tuple[Reading, ...]:
    """Above zero is forwards, below is reverse; zero (neutral) and NaN change nothing."""
    return (DirectionReading(time_ns, math.copysign(1.0, value)),) if value < 0.0 or value > 0.0 else ()


def _bind_wheels(
    kind: type[JointReading | TorqueReading],
    source: Source,
    place: int,
    scale: Callable[[float], float] | None,
    assembly: Assembly,
) -> _Bind:
    """Four wheels in one message: by name, under the controller's names, or as an array in the right order."""
    ours = dict(zip(source.names, assembly.wheel_names, strict=True)) if source.names else {}
    signs = dict(zip(source.names or assembly.wheel_names, source.signs, strict=True)) if source.signs else {}
    ordered = assembly.wheel_names
    seen: tuple[str, ...] = ()
    known: tuple[str, ...] = ()
    turned: tuple[float, ...] = ()

    def wheels(time_ns: int, values: tuple[Any, ...], names: tuple[str, ...]) -> tuple[Reading, ...]:
        nonlocal seen, known, turned
        speeds = values[place]
        if not ours:
            names = ordered
        if names is not seen:  # the reader gives the same object for the same names
            seen, known = names, tuple(ours.get(name, name) for name in names) if ours else names
            turned = tuple(signs.get(name, 1.0) for name in names) if signs else ()
        if scale is not None:
            speeds = tuple(map(scale, speeds))
        if turned and len(turned) == len(speeds):
            speeds = tuple(sign * speed for sign, speed in zip(turned, speeds, strict=True))
        return (kind(time_ns, known, speeds),)

    return wheels


def _bind_battery(places: Mapping[str, tuple[int, Callable[[float], float] | None]], assembly: Assembly) -> _Bind:
    held = assembly.battery
    items = tuple((signal, place, scale) for signal, (place, scale) in places.items())
    charge = "soc" in places

    def battery(time_ns: int, values: tuple[Any, ...], _: tuple[str, ...]) -> tuple[Reading, ...]:
        for signal, place, scale in items:
            held[signal] = values[place] if scale is None else scale(values[place])
        return (BatteryReading(time_ns, *held.values()),) if charge else ()

    return battery


def _unreadable(signal: str, time_ns: int) -> Reading | None:
    if signal == "speed":
        return SpeedReading(time_ns, _NAN)
    if signal == "wheel_speed":
        return JointReading(time_ns, (), (_NAN,))
    if signal == "soc":
        return BatteryReading(time_ns, _NAN, _NAN, _NAN, _NAN)
    if signal in DEMANDS or signal in PEDALS:
        return DemandReading(time_ns, _NAN)
    return FrictionReading(time_ns, _NAN) if signal == "friction" else None


def joint_state_reader(field: str) -> MessageReader[NamedValues]:
    """Reader of one of a JointState's fields with its names, as the project's own commands and reports carry them.

    It raises `UnreadableError` for damaged bytes and for as many names as there are not values.
    """

    def named(stamp_ns: int, values: tuple[Any, ...], names: tuple[str, ...]) -> NamedValues:
        if len(names) != len(values[0]):
            raise UnreadableError(f"{len(names)} names and {len(values[0])} values")
        return NamedValues(stamp_ns, names, values[0])

    return MessageReader(types_of(JOINT_STATE), [field], named, "name")


def joint_state_writer(names: Sequence[str], field: str) -> MessageWriter:
    """Writer of JointStates that have the same names and fill the same field."""
    types = types_of(JOINT_STATE)
    message = blank(types, field, len(names))
    message.name = list(names)
    return MessageWriter(types, bytes(types.store.serialize_cdr(message, JOINT_STATE)), field)
