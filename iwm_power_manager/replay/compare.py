# SPDX-License-Identifier: Apache-2.0
"""What a replay finds; recomputed against recorded: how far apart, since when, by stamp."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace

#: A message of one side: its log time (ns), names and values.
_Side = tuple[int, Sequence[str], Sequence[float]]
#: Stamps one side may be ahead of the other before they count as having no counterpart.
_WINDOW = 10_000


@dataclass(frozen=True)
class Difference:
    """One value that differs.

    Attributes
    ----------
    message : number of the compared message, from 0
    stamp_ns, log_time_ns : of that message
    name : of the value
    recorded, recomputed : the values
    """

    message: int
    stamp_ns: int
    log_time_ns: int
    name: str
    recorded: float
    recomputed: float


@dataclass
class TopicComparison:
    """Result for one topic.

    Attributes
    ----------
    topic : its name
    compared, differing : messages compared, and those with at least one value beyond the tolerance
    largest, rms : of all differences of values (infinite: one is NaN and the other is not)
    worst : name of the value with the largest difference
    first : first difference beyond the tolerance
    only_recorded, only_recomputed : messages whose stamp the other side lacks
    """

    topic: str
    compared: int = 0
    differing: int = 0
    largest: float = 0.0
    rms: float = 0.0
    worst: str = ""
    first: Difference | None = None
    only_recorded: int = 0
    only_recomputed: int = 0

    @property
    def has_record(self) -> bool:
        """At least one message was recorded."""
        return self.compared + self.only_recorded > 0


@dataclass
class ReplayReport:
    """What a replay did.

    Attributes
    ----------
    notes : what was done other than asked, a line each
    exact : steps were repeated from the recorded state; else made from the inputs
    messages, steps : messages read, and control steps taken
    first_stamp_ns, last_stamp_ns : of the steps
    span_ns : driven: from each step to the next, jumps back left out
    gaps : times at which steps are missing in the record, so that the law's memory is unknown
    several : numbers of steps go back and forth, as of two nodes that published one state
    changed : steps whose torques are not the recorded ones, whatever the law remembers at a gap
    restarts : pauses in the inputs after which the law started anew
    bad_messages : messages that could not be decoded
    dropped : inputs that were not believed, by topic, or wheel, and reason
    faults : steps whose command no motor may be given, by reason
    damage : what could not be read of the bag
    comparison : recomputed against recorded, by topic
    not_compared : commands that were not compared and why, a line each
    """

    notes: list[str]
    exact: bool
    messages: int = 0
    steps: int = 0
    first_stamp_ns: int = 0
    last_stamp_ns: int = 0
    span_ns: int = 0
    gaps: int = 0
    several: bool = False
    changed: int = 0
    restarts: int = 0
    bad_messages: int = 0
    dropped: dict[str, dict[str, int]] = field(default_factory=dict)
    faults: dict[str, int] = field(default_factory=dict)
    damage: list[str] = field(default_factory=list)
    comparison: list[TopicComparison] = field(default_factory=list)
    not_compared: list[str] = field(default_factory=list)

    def count_fault(self, reason: str) -> None:
        """One more step without a command; "" is no reason."""
        if reason:
            self.faults[reason] = self.faults.get(reason, 0) + 1


class TopicComparer:
    """Pairs messages of one topic by stamp and compares their values, as they come.

    Parameters
    ----------
    topic : its name
    tolerance : largest absolute difference that is none
    younger : names that an older record may lack: they are not compared then
    """

    def __init__(self, topic: str, tolerance: float, younger: Collection[str] = ()) -> None:
        self._found = TopicComparison(topic)
        self._younger = younger
        self._tolerance = tolerance
        # By stamp; an answer that was sent again has the stamp of the first.
        self._waiting: tuple[OrderedDict[int, list[_Side]], ...] = (OrderedDict(), OrderedDict())
        self._unpaired = [0, 0]
        self._count = 0
        self._squares = 0.0

    def recorded(self, stamp_ns: int, log_time_ns: int, names: Sequence[str], values: Sequence[float]) -> None:
        """Add a recorded message."""
        self._add(0, stamp_ns, (log_time_ns, names, values))

    def recomputed(self, stamp_ns: int, log_time_ns: int, names: Sequence[str], values: Sequence[float]) -> None:
        """Add a recomputed message."""
        self._add(1, stamp_ns, (log_time_ns, names, values))

    def result(self) -> TopicComparison:
        """What has been found so far."""
        recorded, recomputed = (
            count + sum(map(len, held.values())) for count, held in zip(self._unpaired, self._waiting, strict=True)
        )
        rms = math.sqrt(self._squares / self._count) if self._count else 0.0
        return replace(self._found, rms=rms, only_recorded=recorded, only_recomputed=recomputed)

    def _add(self, side: int, stamp_ns: int, new: _Side) -> None:
        waiting, others = self._waiting[side], self._waiting[1 - side]
        if stamp_ns in others:
            other = others[stamp_ns].pop(0)
            if not others[stamp_ns]:
                del others[stamp_ns]
            self._compare(stamp_ns, *((new, other) if side == 0 else (other, new)))
            return
        waiting.setdefault(stamp_ns, []).append(new)
        if len(waiting) > _WINDOW:
            self._unpaired[side] += len(waiting.popitem(last=False)[1])

    def _compare(self, stamp_ns: int, recorded: _Side, recomputed: _Side) -> None:
        result = self._found
        result.compared += 1
        log_time_ns, *was_there = recorded
        _, names, values = recomputed
        self._count += len(values)
        if was_there == [names, values]:
            return  # NaN is not equal to itself, and goes the long way
        found = dict(zip(*was_there, strict=False))
        beyond: Difference | None = None
        for name, value in zip(names, values, strict=True):
            if name not in found and name in self._younger:
                continue
            was = found.get(name, math.nan)
            difference = _distance(was, value)
            self._squares += difference * difference
            if difference > result.largest:
                result.largest, result.worst = difference, name
            if difference > self._tolerance and beyond is None:
                beyond = Difference(result.compared - 1, stamp_ns, log_time_ns, name, was, value)
        result.differing += beyond is not None
        result.first = result.first or beyond


def _distance(a: float, b: float) -> float:
    if math.isnan(a) or math.isnan(b):
        return 0.0 if math.isnan(a) and math.isnan(b) else math.inf
    return abs(a - b) if a != b else 0.0
