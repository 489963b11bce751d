# SPDX-License-Identifier: Apache-2.0
"""The signals a bag has recorded: as readings in their order, and demand and speed as arrays.

The solver learns the demand's Markov chain from the arrays.
"""

from __future__ import annotations

import itertools
import math
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iwm_power_manager.bags.limits import SET_BACK_NS
from iwm_power_manager.bags.reader import BagReader, Message
from iwm_power_manager.control.inputs import ValueLimits, Violation, check_value
from iwm_power_manager.control.monitor import BatteryReading, JointReading, SpeedReading
from iwm_power_manager.control.thresholds import RECORDED, input_limits
from iwm_power_manager.errors import BagError, ConfigError
from iwm_power_manager.mdp.demand import MAX_GAP_S, Source, signal_source
from iwm_power_manager.mdp.problem import Problem
from iwm_power_manager.model.parameters import VehicleParams
from iwm_power_manager.share import resolve
from iwm_power_manager.signals import readings
from iwm_power_manager.signals.cdr import UnreadableError
from iwm_power_manager.signals.contract import WHEEL_NAMES
from iwm_power_manager.signals.mapping import DEMANDS, PEDALS, SignalMapping, load_mapping, topic_named
from iwm_power_manager.signals.types import Types, types_of
from iwm_power_manager.trace_units import Energies
from iwm_power_manager.vehicle import Vehicle

#: Messages from a bag's start that show whether its stamps advance, and how many may have the same one.
_PROBE_MESSAGES = 2000
_STANDING = 10
#: No clock is so many times slower than the one of the log; one that counts milliseconds is.
_SLOW = 100
#: A stamp this far from the one before belongs to a clock that was set in between, unless the log shows such a pause.
_SET_NS = 86_400 * 10**9
#: A stamp that is the same for longer, by the log, while the car drives on, stands.
_STANDS_NS = 10**9

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
    reading: readings.Reading


class RecordedDrive(NamedTuple):
    """A recorded drive, one row per power demand.

    Attributes
    ----------
    time_s : strictly increasing, from 0
    power_demand_w : at the wheels, braking negative
    speed_mps : the speed known at that time
    bad_messages : messages that could not be decoded or held no number that a car may have
    damage : what could not be read of the bag, or not used, a line each
    """

    time_s: FloatArray
    power_demand_w: FloatArray
    speed_mps: FloatArray
    bad_messages: int
    damage: list[str]

    def source(self, name: str, problem: Problem, weight: float) -> Source:
        """The drive as a source of demand for the solver."""
        return signal_source(name, self.time_s, self.power_demand_w, problem.dt_s, weight, self.speed_mps)

    def demand_apart(self, mass_kg: float) -> str:
        """A line, if the demand cannot have moved a car of this mass as recorded; "" else."""
        energies = Energies(mass_kg)
        energies.add(float(self.speed_mps[0]), 0.0, 0.0)
        steps = np.diff(self.time_s)
        for demand_w, speed_mps, dt_s in zip(self.power_demand_w[:-1], self.speed_mps[1:], steps, strict=True):
            if dt_s > MAX_GAP_S:
                energies.cut()
            energies.add(float(speed_mps), float(demand_w), float(dt_s) * (dt_s <= MAX_GAP_S))
        return energies.apart()


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
    taken, bad : messages by topic so far: of all, and those that could not be decoded or held no number of use
    reasons : by topic, why its first message could not be decoded
    without : messages by topic and wheels they had no number for
    problems : topics that cannot be read, and stamps that are not used, a line each
    by_stamp : times are the stamps of the headers, where there are any; else those of the log
    """

    def __init__(
        self, bag: BagReader, mapping: SignalMapping, vehicle: VehicleParams | None = None, signals: Sequence[str] = ()
    ) -> None:
        self.taken: Counter[str] = Counter()
        self.bad: Counter[str] = Counter()
        self.reasons: dict[str, str] = {}
        self.without: Counter[str] = Counter()
        self.problems: list[str] = []
        self.by_stamp = True
        self._bag = bag
        held: dict[str, str] = {}
        types: dict[str, Types] = {}
        for topic in mapping.topics():
            name = topic_named(topic, bag.topics)
            if name is None:
                continue
            try:
                types[topic] = _types(bag, name)
                held[topic] = name
            except BagError as error:
                self.problems.append(str(error))
        wanted = [
            signal
            for signal, sources in mapping.sources.items()
            if any(source.topic in held for source in sources) and (not signals or signal in signals)
        ]
        if any(demand in wanted for demand in DEMANDS):
            wanted = [signal for signal in wanted if signal not in PEDALS]
        self.signals = set(wanted)
        sources = mapping.sources.get("wheel_speed", ())
        own = [held.get(source.topic, source.topic) for source in sources if len(sources) > 1]
        self._topic_of = dict(zip(WHEEL_NAMES, own, strict=False))  # of each wheel that has one of its own
        assembly = readings.Assembly(WHEEL_NAMES, vehicle)
        found = readings.topic_readers(mapping, types, assembly, wanted) if wanted else {}
        self._readers: dict[str, readings.TopicReader] = {held[topic]: reader for topic, reader in found.items()}
        for name, other in bag.topics.items():
            for topic in found if name != other.name else ():  # another definition of a topic
                try:
                    if held[topic] == other.name:
                        more = readings.topic_readers(mapping, {topic: _types(bag, name)}, assembly, wanted)
                        self._readers[name] = more[topic]
                except (BagError, ConfigError) as error:
                    self.problems.append(str(error))

    @property
    def bad_messages(self) -> int:
        """Bad messages of all topics."""
        return self.bad.total()

    def probe(self) -> list[Recorded]:
        """Readings of the first messages, which do not count; if their stamps do not advance, log times are used."""
        values, stamps = [], dict[str, list[tuple[int, int]]]()
        for message in itertools.islice(self._bag.messages(), _PROBE_MESSAGES):
            for value in self.values(message):
                values.append(value)
                if value.stamped:
                    stamps.setdefault(message.topic, []).append((value.reading.stamp_ns, value.log_time_ns))
        for counts in (self.taken, self.bad, self.without):
            counts.clear()
        if standing := sorted(topic for topic, found in stamps.items() if len(found) > 2 and not _advance(found)):
            self.by_stamp = False
            self.problems.append(f"the header stamps of {', '.join(standing)} do not advance: log times are used")
        return values

    @property
    def topics(self) -> set[str]:
        """Topics that carry a mapped signal."""
        return set(self._readers)

    def __iter__(self) -> Iterator[Recorded]:
        for message in self._bag.messages():
            yield from self.values(message)

    def values(self, message: Message) -> list[Recorded]:
        """Readings of one message; none if its topic carries no signal or the message is bad, which is counted."""
        log_time_ns, topic, data, publish_time_ns, _ = message
        reader = self._readers.get(topic)
        if reader is None:
            return []
        self.taken[topic] += 1
        try:
            found = reader.read(data, log_time_ns)
        except UnreadableError as error:
            self.bad[topic] += 1
            self.reasons.setdefault(topic, str(error))
            return []
        for reading in found:
            if not _usable(reading):
                self.bad[topic] += 1
                return []
            if isinstance(reading, JointReading) and not all(map(math.isfinite, reading.values)):
                pairs = zip(reading.names, reading.values, strict=False)  # in the order of the message
                missing = [name for name, value in pairs if not math.isfinite(value)]
                where = dict.fromkeys(self._topic_of.get(name, topic) for name in missing)
                self.without[f"{', '.join(where)}: {', '.join(missing)}"] += 1
        stamped = reader.stamped
        if stamped and not self.by_stamp:
            stamped = False
            found = tuple(reading._replace(stamp_ns=log_time_ns) for reading in found)
        return [Recorded(log_time_ns, publish_time_ns, stamped, reading) for reading in found]


def _advance(times: Sequence[tuple[int, int]]) -> bool:
    """Whether stamps go on, most of them forward, by one clock that is not much slower than that of the log."""
    stamps = [stamp_ns for stamp_ns, _ in times]
    steps = [after - before for before, after in itertools.pairwise(stamps)]
    forward, backward = sum(step > 0 for step in steps), sum(step < 0 for step in steps)
    spans = [max(column) - min(column) for column in zip(*times, strict=True)]
    one_clock = spans[0] * _SLOW >= spans[1] and max(map(abs, steps)) <= max(_SET_NS, spans[1])
    stands = len(set(stamps)) * _STANDING < len(stamps) or stamps.count(0) * _STANDING > len(stamps) + _STANDING
    return one_clock and forward > backward and not stands


def _types(bag: BagReader, name: str) -> Types:
    """The types of a recorded topic by the definition in its bag."""
    topic = bag.topics[name]
    if not topic.type:
        raise BagError(f"{name}: the bag does not say of which type its messages are")
    if topic.serialization.lower() not in ("cdr", ""):
        raise BagError(f"{name}: its messages are {topic.serialization!r}, not CDR")
    sample = b""
    if "wstring" in topic.definition:  # how wide its characters are, only a message tells
        first = first_message(bag, name)
        sample = first.data if first else b""
    try:
        return types_of(topic.type, topic.encoding, topic.definition, sample)
    except BagError as error:
        raise BagError(f"{name}: {error}") from None


def first_message(bag: BagReader, topic: str) -> Message | None:
    """The first message of a topic; None if the bag holds none."""
    return next((message for message in bag.messages() if message.topic == topic), None)


def _usable(reading: readings.Reading) -> bool:
    """Whether what has to be a number is one: of four wheels one, of a battery its state of charge."""
    if isinstance(reading, JointReading):
        return any(map(math.isfinite, reading.values))
    if isinstance(reading, readings.TorqueReading | readings.MotionReading):
        return True  # nobody needs them
    return math.isfinite(reading.soc if isinstance(reading, BatteryReading) else reading[1])


def read_signal(
    bag: Path | str, mapping: SignalMapping | None = None, vehicle: VehicleParams | None = None
) -> RecordedDrive:
    """Demand and speed of a bag, at the times of the demands.

    A demand carries no stamp. Its time is that of the speed it came with: in a lock-step run, recorded faster than
    real time, the clock on the wall says nothing. Where speeds have no stamps, or these stand, the log time counts;
    where stamps start again, as of a simulator that was, the time goes on.

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
    rows: list[tuple[int, int, float, float]] = []  # log time, stamp of the speed, demand, speed
    speed, stamp, wrong = math.nan, -1, 0
    believed = input_limits(RECORDED, 1.0, by_clock=False)
    with BagReader(bag) as reader:
        stream = SignalStream(reader, mapping, vehicle, ("speed", *DEMANDS, *PEDALS))
        check_signals(reader, mapping, stream)
        stream.probe()
        for log_time_ns, _, stamped, reading in stream:
            if isinstance(reading, SpeedReading) and _possible(reading.speed_mps, believed.speed):
                speed = reading.speed_mps
                stamp = reading.stamp_ns if stamped else -1
            elif isinstance(reading, readings.DemandReading) and _possible(reading.power_w, believed.demand):
                rows += [] if math.isnan(speed) else [(log_time_ns, stamp, reading.power_w, speed)]
            else:
                wrong += isinstance(reading, SpeedReading | readings.DemandReading)
        damage = [*reader.notes, *reader.damage, *stream.problems]
    if not rows:
        raise BagError(f"{bag}: holds no power demand with a speed before it")
    log_times, stamps, demands, speeds = map(np.array, zip(*rows, strict=True))
    time_ns, said = _times(log_times, stamps, np.column_stack((demands, speeds)))
    damage += said
    keep = _advancing(time_ns)
    if behind := np.count_nonzero(time_ns < np.maximum.accumulate(time_ns)):
        damage.append(f"{behind} of {time_ns.size} demands are left out: their stamps are behind those before them")
    if 2 * keep.size < time_ns.size:
        damage.append(f"only {keep.size} of {time_ns.size} demands have a time of their own: the others are left out")
    time_s = (time_ns[keep] - time_ns[keep[0]]) * 1e-9
    return RecordedDrive(time_s, demands[keep], speeds[keep], stream.bad_messages + wrong, damage)


def _possible(value: float, limits: ValueLimits) -> bool:
    return check_value(value, math.nan, 0.0, limits) is Violation.NONE


def read_drives(
    bags: Sequence[str], mapping: str | None, vehicle: Vehicle, command: str
) -> list[tuple[str, RecordedDrive]]:
    """Name and content of recorded drives; what is wrong with them goes to stderr in the name of a command."""
    known = load_mapping(resolve(mapping) if mapping else None) if bags else None
    drives = [(path, read_signal(path, known, vehicle.params)) for path in bags]
    for path, drive in drives:
        bad = [f"{drive.bad_messages} bad messages left out"] if drive.bad_messages else []
        unlike = drive.demand_apart(vehicle.params.chassis.mass_kg)
        for line in (*drive.damage, *bad, *([unlike] if unlike else [])):
            print(f"{command}: warning: {path}: {line}", file=sys.stderr)
    return [(Path(path).name, drive) for path, drive in drives]


def check_signals(reader: BagReader, mapping: SignalMapping, stream: SignalStream, wheels: bool = False) -> None:
    """Refuse a bag without speed or demand, or with `wheels` without wheel speeds; the line says what it holds."""
    held = ", ".join(sorted(reader.topics)) or "no topic"
    held += "".join(f"; {problem}" for problem in stream.problems)
    lacking = ["speed"] if "speed" not in stream.signals else []
    if not stream.signals.intersection(DEMANDS) and not stream.signals.issuperset(PEDALS):
        lacking.append("power_demand")
    if wheels and "wheel_speed" not in stream.signals:
        lacking.append("wheel_speed")
    if lacking:
        problem = f"holds no topic that {mapping.path} maps to {lacking[0]}; it holds {held}"
        raise BagError(f"{reader.path}: {problem}; other topics are named by a signals file: --mapping")


def _times(
    log_ns: NDArray[np.int64], stamp_ns: NDArray[np.int64], values: FloatArray
) -> tuple[NDArray[np.int64], list[str]]:
    """Times of the demands: stamps if speeds come about as often as demands, else log times; what is to be said of it.

    Where a clock was set back the time goes on.
    """
    set_back = np.diff(log_ns) < -SET_BACK_NS
    logged = _continued(log_ns, set_back)
    again = _started_again(stamp_ns, logged)
    stamped = _continued(stamp_ns, set_back | again)
    if np.any(stamp_ns < 0) or 2 * np.unique(stamped).size < stamped.size:
        return logged, []
    stood_ns = _stood_ns(stamped, logged, values)
    if stood_ns > _STANDS_NS:
        return logged, [f"the stamps of the speed stand still for {1e-9 * stood_ns:.1f} s: log times are used"]
    count = np.count_nonzero(again & ~set_back)
    said = f"the stamps start again {count} time(s), as of a simulator that was restarted: the time goes on there"
    return stamped, [said] if count else []


def _started_again(stamp_ns: NDArray[np.int64], log_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Where stamps go back for good: not those of two sources, which go back and forth."""
    steps = np.diff(stamp_ns)
    back, forth = steps < -SET_BACK_NS, steps - np.diff(log_ns) >= SET_BACK_NS
    return back & (2 * np.count_nonzero(forth) < np.count_nonzero(back))


def _stood_ns(stamp_ns: NDArray[np.int64], log_ns: NDArray[np.int64], values: FloatArray) -> int:
    """The longest time, by the log, over which stamps were the same and other values were not."""
    first = np.flatnonzero(np.diff(stamp_ns, prepend=stamp_ns[0] - 1))
    behind = np.append(first[1:], stamp_ns.size)
    lasted = log_ns[behind - 1] - log_ns[first]
    long = np.flatnonzero(lasted > _STANDS_NS)
    return max((int(lasted[i]) for i in long if np.ptp(values[first[i] : behind[i]], axis=0).any()), default=0)


def _continued(time_ns: NDArray[np.int64], was_set: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Times as of a clock that was not set back: where it was, one more step of the usual length."""
    steps = np.diff(time_ns)
    steps[was_set] = np.median(steps[~was_set]) if not was_set.all() else 0
    return np.concatenate((time_ns[:1], time_ns[0] + np.cumsum(steps)))


def _advancing(time_ns: NDArray[np.int64]) -> NDArray[np.intp]:
    """Rows whose times increase strictly: of several at one time the last, none from before a clock stepped back."""
    forward = np.flatnonzero(time_ns >= np.maximum.accumulate(time_ns))
    last = np.append(np.diff(time_ns[forward]) > 0, True)
    return forward[last]
