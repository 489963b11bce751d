"""The signals a bag has recorded: as readings in their order, and demand and speed as arrays.

The solver learns the demand's Markov chain from the arrays.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iwm_power_manager.bags.metadata import Topic
from iwm_power_manager.bags.reader import BagReader
from iwm_power_manager.control.monitor import BatteryReading, JointReading, SpeedReading
from iwm_power_manager.errors import BagError
from iwm_power_manager.model.parameters import VehicleParams
from iwm_power_manager.signals.cdr import UnreadableError
from iwm_power_manager.signals.contract import WHEEL_NAMES
from iwm_power_manager.signals.mapping import DEMANDS, PEDALS, SignalMapping, load_mapping, topic_named
from iwm_power_manager.signals.readings import Assembly, DemandReading, Reading, TopicReader, topic_readers
from iwm_power_manager.signals.types import Types, types_of

FloatArray = NDArray[np.float64]


class Recorded(NamedTuple):
    """One reading of a bag.

    Attributes
    ----------
    log_time_ns, publish_time_ns : when its message was received, and sent
    stamped : its time is the stamp of the message's header; else that when it was received
    reading : as the live node has it
    """

    log_time_ns: int
    publish_time_ns: int
    stamped: bool
    reading: Reading


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
    """All readings of all mapped signals of a bag, in the order of log times.

    Parameters
    ----------
    bag : an open bag
    mapping : topics, fields and units
    vehicle : the car, where a demand is no power or a wheel's speed is that of its rim
    signals : those that are wanted; () for all

    Attributes
    ----------
    signals : those the bag holds; pedals only where it holds no other demand
    bad_messages : messages that could not be decoded, or held no number that can be used, so far
    """

    def __init__(
        self,
        bag: BagReader,
        mapping: SignalMapping,
        vehicle: VehicleParams | None = None,
        signals: Sequence[str] = (),
    ) -> None:
        self.bad_messages = 0
        self._bag = bag
        named = {topic: topic_named(topic, bag.topics) for topic in mapping.topics()}
        held = {topic: name for topic, name in named.items() if name is not None}
        types = {topic: _types(bag.topics[name]) for topic, name in held.items()}
        wanted = [
            signal
            for signal, sources in mapping.sources.items()
            if any(source.topic in held for source in sources) and (not signals or signal in signals)
        ]
        if any(demand in wanted for demand in DEMANDS):
            wanted = [signal for signal in wanted if signal not in PEDALS]
        self.signals = set(wanted)
        readers = topic_readers(mapping, types, Assembly(WHEEL_NAMES, vehicle), wanted) if wanted else {}
        self._readers: dict[str, TopicReader] = {held[topic]: reader for topic, reader in readers.items()}

    @property
    def topics(self) -> set[str]:
        """Topics that carry a mapped signal."""
        return set(self._readers)

    def __iter__(self) -> Iterator[Recorded]:
        for log_time, topic, data, publish_time, _ in self._bag.messages():
            yield from self.values(topic, data, log_time, publish_time)

    def values(self, topic: str, data: bytes, log_time_ns: int, publish_time_ns: int) -> list[Recorded]:
        """Readings of one message; none if its topic carries no signal or the message is bad, which is counted."""
        reader = self._readers.get(topic)
        if reader is None:
            return []
        try:
            readings = reader.read(data, log_time_ns)
        except UnreadableError:
            self.bad_messages += 1
            return []
        for reading in readings:
            if not _usable(reading):
                self.bad_messages += 1
                return []
        stamped = reader.stamped
        return [Recorded(log_time_ns, publish_time_ns, stamped, reading) for reading in readings]


def _types(topic: Topic) -> Types:
    """The types of a recorded topic by the definition in its bag."""
    try:
        return types_of(topic.type, topic.encoding, topic.definition)
    except BagError as error:
        raise BagError(f"{topic.name}: {error}") from None


def _usable(reading: Reading) -> bool:
    """Whether what has to be a number is one: of four wheels one, of a battery its state of charge."""
    if isinstance(reading, JointReading):
        return any(map(math.isfinite, reading.values))
    return math.isfinite(reading.soc if isinstance(reading, BatteryReading) else reading[-1])


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
    with BagReader(bag) as reader:
        stream = SignalStream(reader, mapping, vehicle, ("speed", *DEMANDS, *PEDALS))
        check_signals(reader, mapping, stream)
        for log_time_ns, _, stamped, reading in stream:
            if isinstance(reading, SpeedReading):
                speed = reading.speed_mps
                stamp = reading.stamp_ns if stamped else -1
            elif isinstance(reading, DemandReading) and not math.isnan(speed):
                log_times.append(log_time_ns)
                stamps.append(stamp)
                demands.append(reading.power_w)
                speeds.append(speed)
        damage = reader.damage
        bad = stream.bad_messages
    if not demands:
        raise BagError(f"{bag}: holds no power demand with a speed before it")
    time_ns = _times(np.array(log_times, dtype=np.int64), np.array(stamps, dtype=np.int64))
    keep = _advancing(time_ns)
    time_s = (time_ns[keep] - time_ns[keep[0]]) * 1e-9
    return RecordedDrive(time_s, np.array(demands)[keep], np.array(speeds)[keep], bad, damage)


def check_signals(reader: BagReader, mapping: SignalMapping, stream: SignalStream) -> None:
    """Refuse a bag without speed or demand, in one line that says what it holds instead."""
    held = ", ".join(sorted(reader.topics)) or "no topic"
    if "speed" not in stream.signals:
        raise BagError(f"{reader.path}: holds no topic that {mapping.path} maps to speed; it holds {held}")
    if not stream.signals.intersection(DEMANDS) and not stream.signals.issuperset(PEDALS):
        raise BagError(f"{reader.path}: holds no topic that {mapping.path} maps to power_demand; it holds {held}")


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
