# SPDX-License-Identifier: Apache-2.0
"""Pairing the messages of one lock-step set.

Each input topic has its own queue, because DDS keeps the order within a topic but not between topics. A set is complete
when the stamped topics agree on a stamp and a power demand of the same set is there. The publisher sends the demand,
which carries no stamp, last; so a demand sent before the set's `vehicle_speed` is left over from an incomplete set.
"""

from __future__ import annotations

from collections import deque
from typing import Any, NamedTuple


class LockstepSet(NamedTuple):
    """One complete set of inputs."""

    stamp_ns: int
    speed: Any
    wheels: Any
    battery: Any
    demand: Any


class _Stamped(NamedTuple):
    stamp_ns: int
    sent_ns: int
    value: Any


SPEED, WHEELS, BATTERY = range(3)


class LockstepQueue:
    """Collects messages in order of arrival, hands out complete sets in order of their stamps."""

    def __init__(self) -> None:
        self._stamped: tuple[deque[_Stamped], ...] = (deque(), deque(), deque())
        self._demands: deque[tuple[int, Any]] = deque()
        self._answered_ns: int | None = None

    def push(self, topic: int, stamp_ns: int, sent_ns: int, value: Any) -> None:
        """Add a message of a stamped topic: SPEED, WHEELS or BATTERY, with its DDS source time."""
        self._stamped[topic].append(_Stamped(stamp_ns, sent_ns, value))

    def push_demand(self, sent_ns: int, value: Any) -> None:
        """Add a power demand with its DDS source time."""
        self._demands.append((sent_ns, value))

    def pop(self) -> LockstepSet | None:
        """Next complete set, or None while something is missing.

        A set whose stamp is the one handed out last is a repetition; it comes with `demand=None`, because the caller
        only has to repeat its answer.
        """
        while self._align():
            speed, wheels, battery = (queue[0] for queue in self._stamped)
            if speed.stamp_ns == self._answered_ns:
                return self._hand_out(speed, wheels, battery, None)
            while self._demands and self._demands[0][0] < speed.sent_ns:
                self._demands.popleft()
            if not self._demands:
                return None
            if len(self._stamped[SPEED]) > 1 and self._demands[0][0] > self._stamped[SPEED][1].sent_ns:
                # Sent after the next set had begun: the demand of the set at hand was lost.
                self._drop_heads()
                continue
            return self._hand_out(speed, wheels, battery, self._demands.popleft()[1])
        return None

    def _hand_out(self, speed: _Stamped, wheels: _Stamped, battery: _Stamped, demand: Any) -> LockstepSet:
        self._drop_heads()
        self._answered_ns = speed.stamp_ns
        return LockstepSet(speed.stamp_ns, speed.value, wheels.value, battery.value, demand)

    def _drop_heads(self) -> None:
        for queue in self._stamped:
            queue.popleft()

    def _align(self) -> bool:
        """Drop what belongs to incomplete sets until the heads agree; False when a queue runs empty.

        The message sent first is the one whose partners were lost: later ones of its topic may still find theirs.
        """
        while all(self._stamped):
            heads = [queue[0] for queue in self._stamped]
            if heads[SPEED].stamp_ns == heads[WHEELS].stamp_ns == heads[BATTERY].stamp_ns:
                return True
            min(self._stamped, key=lambda queue: queue[0].sent_ns).popleft()
        return False

    @property
    def waiting(self) -> bool:
        """A demand is there that has not been handed out."""
        return bool(self._demands)

    def clear(self) -> None:
        """Forget everything, as at activation."""
        for queue in self._stamped:
            queue.clear()
        self._demands.clear()
        self._answered_ns = None
