"""The demand and speed a bag has recorded, as arrays: what the solver learns the demand's Markov chain from."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from iwm_power_manager.bags.definitions import typestore
from iwm_power_manager.bags.reader import BagReader
from iwm_power_manager.errors import BagError
from iwm_power_manager.model.parameters import VehicleParams
from iwm_power_manager.model.pedals import pedal_power_w
from iwm_power_manager.signals.cdr import PLAIN
from iwm_power_manager.signals.mapping import Extractor, SignalMapping, extractors, load_mapping

FloatArray = NDArray[np.float64]

#: A header stands first, and its stamp first in it: behind the four bytes of encapsulation.
_STAMP = struct.Struct("<iI")
_STAMP_OFFSET = 4

#: Signals that may be NaN in a good message: not measured.
MAY_BE_UNKNOWN = frozenset({"battery_temperature"})


class SignalValue(NamedTuple):
    """One value of one signal.

    Attributes
    ----------
    log_time_ns : when it was received
    stamp_ns : time in the message's header; None without one
    signal, wheel, values : as in `Extractor`
    publish_time_ns : when it was sent
    """

    log_time_ns: int
    stamp_ns: int | None
    signal: str
    wheel: int
    values: tuple[float, ...]
    publish_time_ns: int


class RecordedDrive(NamedTuple):
    """A recorded drive, one row per power demand.

    Attributes
    ----------
    time_s : strictly increasing, from 0
    power_demand_w : at the wheels, braking negative
    speed_mps : the speed known at that time
    bad_messages : messages that could not be decoded or held no finite number
    damage : what could not be read of the bag, a line each
    """

    time_s: FloatArray
    power_demand_w: FloatArray
    speed_mps: FloatArray
    bad_messages: int
    damage: list[str]


class SignalStream:
    """All values of all mapped signals of a bag, in the order of log times.

    Parameters
    ----------
    bag : an open bag
    mapping : topics, fields and units

    Attributes
    ----------
    signals : those the bag holds
    bad_messages : messages that could not be decoded, or held a number that is not finite, so far
    """

    def __init__(self, bag: BagReader, mapping: SignalMapping) -> None:
        self.bad_messages = 0
        self._bag = bag
        self._extractors = extractors(mapping, bag.topics)
        self.signals = {extractor.signal for found in self._extractors.values() for extractor in found}
        self._decoders = {name: decoder(bag.topics[name].type) for name in self._extractors}
        # Topics all of whose signals have a quick way: whether a header, and so a stamp, stands first.
        self._quick = {
            name: has_header(bag.topics[name].type)
            for name, found in self._extractors.items()
            if all(extractor.quick is not None for extractor in found)
        }

    @property
    def topics(self) -> set[str]:
        """Topics that carry a mapped signal."""
        return set(self._extractors)

    def __iter__(self) -> Iterator[SignalValue]:
        for log_time, topic, data, publish_time, _ in self._bag.messages():
            yield from self.values(topic, data, log_time, publish_time)

    def values(self, topic: str, data: bytes, log_time_ns: int, publish_time_ns: int) -> list[SignalValue]:
        """Values of one message; none if its topic carries no signal or the message is bad, which is counted."""
        found = self._extractors.get(topic)
        if found is None:
            return []
        try:
            if topic in self._quick and data[1] == PLAIN:
                values = self._quick_values(topic, found, data, log_time_ns, publish_time_ns)
            else:
                values = self._decoded_values(topic, found, data, log_time_ns, publish_time_ns)
        except Exception:  # noqa: BLE001 - generated decoders raise whatever a damaged message makes them raise
            self.bad_messages += 1
            return []
        for value in values:
            for number in value.values:
                if not math.isfinite(number):
                    return self._without_unknown(values)
        return values

    def _quick_values(
        self, topic: str, found: list[Extractor], data: bytes, log_time_ns: int, publish_time_ns: int
    ) -> list[SignalValue]:
        stamp_ns = None
        if self._quick[topic]:
            seconds, nanoseconds = _STAMP.unpack_from(data, _STAMP_OFFSET)
            stamp_ns = seconds * 1_000_000_000 + nanoseconds
        return [
            SignalValue(log_time_ns, stamp_ns, signal, wheel, quick(data), publish_time_ns)
            for signal, wheel, _, quick in found
            if quick is not None
        ]

    def _decoded_values(
        self, topic: str, found: list[Extractor], data: bytes, log_time_ns: int, publish_time_ns: int
    ) -> list[SignalValue]:
        message = self._decoders[topic](data)
        stamp_ns = stamp_of(message)
        return [
            SignalValue(log_time_ns, stamp_ns, signal, wheel, read(message), publish_time_ns)
            for signal, wheel, read, _ in found
        ]

    def _without_unknown(self, values: list[SignalValue]) -> list[SignalValue]:
        """The finite values, if only such are missing that may be: a battery without a thermometer says NaN."""
        finite = [value for value in values if all(map(math.isfinite, value.values))]
        missing = {value.signal for value in values} - {value.signal for value in finite}
        if missing <= MAY_BE_UNKNOWN:
            return finite
        self.bad_messages += 1
        return []


def decoder(msgtype: str) -> Callable[[bytes], Any]:
    """Function from CDR bytes to a message of a known type."""
    deserialize = typestore().deserialize_cdr
    return lambda data: deserialize(data, msgtype)


def stamp_of(message: Any) -> int | None:
    """Header stamp in ns; None for a message without a header."""
    header = getattr(message, "header", None)
    if header is None:
        return None
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def has_header(msgtype: str) -> bool:
    """Whether a known type begins with a `std_msgs/Header`."""
    fields = typestore().fielddefs[msgtype][1]
    return bool(fields) and fields[0][0] == "header" and fields[0][1][1] == "std_msgs/msg/Header"


def read_signal(
    bag: Path | str, mapping: SignalMapping | None = None, vehicle: VehicleParams | None = None
) -> RecordedDrive:
    """Demand and speed of a bag, at the times of the demands.

    A demand carries no stamp. Its time is that of the speed it came with: in a lock-step run, recorded faster than
    real time, the clock on the wall says nothing. Where speeds have no stamps, the log time counts.

    Parameters
    ----------
    bag : folder or file
    mapping : topics, fields and units; None for the project's own
    vehicle : needed where the demand comes from pedals

    Raises
    ------
    BagError
        The bag cannot be read, or holds no demand or no speed.
    """
    mapping = mapping or load_mapping()
    log_times: list[int] = []
    stamps: list[int] = []
    demands: list[float] = []
    speeds: list[float] = []
    speed = math.nan
    stamp = -1
    accelerator = brake = 0.0
    with BagReader(bag) as reader:
        stream = SignalStream(reader, mapping)
        from_pedals = "power_demand" not in stream.signals
        check_signals(reader, mapping, stream, vehicle)
        for value in stream:
            if value.signal == "speed":
                speed = value.values[0]
                stamp = -1 if value.stamp_ns is None else value.stamp_ns
                continue
            if value.signal == "accelerator_pedal":
                accelerator = value.values[0]
            elif value.signal == "brake_pedal":
                brake = value.values[0]
            elif value.signal != "power_demand":
                continue
            if from_pedals == (value.signal == "power_demand") or math.isnan(speed):
                continue
            demand = (
                pedal_power_w(accelerator, brake, max(speed, 0.0), vehicle)
                if from_pedals and vehicle is not None
                else value.values[0]
            )
            log_times.append(value.log_time_ns)
            stamps.append(stamp)
            demands.append(demand)
            speeds.append(speed)
        damage = reader.damage
        bad = stream.bad_messages
    if not demands:
        raise BagError(f"{bag}: holds no power demand with a speed before it")
    time_ns = _times(np.array(log_times, dtype=np.int64), np.array(stamps, dtype=np.int64))
    keep = _advancing(time_ns)
    time_s = (time_ns[keep] - time_ns[keep[0]]) * 1e-9
    return RecordedDrive(time_s, np.array(demands)[keep], np.array(speeds)[keep], bad, damage)


def check_signals(
    reader: BagReader, mapping: SignalMapping, stream: SignalStream, vehicle: VehicleParams | None
) -> None:
    """Refuse a bag without speed or demand, in one line that says what it holds instead."""
    pedals = {"accelerator_pedal", "brake_pedal"}
    held = ", ".join(sorted(reader.topics)) or "no topic"
    if "speed" not in stream.signals:
        raise BagError(f"{reader.path}: holds no topic that {mapping.path} maps to speed; it holds {held}")
    if "power_demand" in stream.signals:
        return
    if not pedals <= stream.signals:
        raise BagError(f"{reader.path}: holds no topic that {mapping.path} maps to power_demand; it holds {held}")
    if vehicle is None:
        raise BagError(f"{reader.path}: the demand comes from pedals; name the vehicle that says what they mean")


def _advancing(time_ns: NDArray[np.int64]) -> NDArray[np.intp]:
    """Rows whose times increase strictly: of several at one time the last, none from before a clock stepped back."""
    forward = np.flatnonzero(time_ns >= np.maximum.accumulate(time_ns))
    last = np.append(np.diff(time_ns[forward]) > 0, True)
    return forward[last]


def _times(log_ns: NDArray[np.int64], stamp_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Times of the demands: stamps if speeds come about as often as demands, else log times."""
    stamped = stamp_ns[stamp_ns >= 0]
    if stamped.size == stamp_ns.size and 2 * np.unique(stamped).size >= stamp_ns.size:
        return stamp_ns
    return log_ns
