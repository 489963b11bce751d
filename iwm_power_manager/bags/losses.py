# SPDX-License-Identifier: Apache-2.0
"""What the counter of a topic's publisher shows to be missing; of several publishers, nothing."""

from __future__ import annotations


class Losses:
    """Numbers that were left out between the messages of a topic.

    Numbers that go back once are those of a publisher that was started again. Where they go back and forth several
    publish, each with a counter of its own: what is missing cannot be told, and nothing is counted.

    Attributes
    ----------
    last : the number before the next one; 0 before the first
    several : several publish
    """

    __slots__ = ("_between", "_count", "_top", "last", "several")

    def __init__(self) -> None:
        self.last = 0
        self.several = False
        self._count = 0
        self._top = 0  # the largest before numbers went back
        self._between = (0, 0)  # around what was left out last

    def take(self, number: int) -> None:
        """The next number; where it is the one after `last`, to set that is all there is to do."""
        last, self.last = self.last, number
        if number <= last:
            self.several |= self._between[0] < number < self._between[1]
            self._top = max(self._top, last)
        elif last and number > last + 1:
            self.several |= 0 < self._top < number
            self._between = last, number
            self._count += number - last - 1

    @property
    def count(self) -> int:
        """How many were left out, as far as it can be told."""
        return 0 if self.several else self._count
