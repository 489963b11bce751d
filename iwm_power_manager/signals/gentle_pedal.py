# SPDX-License-Identifier: Apache-2.0
"""A pedal in % that comes as 0..1 asks for a hundredth of what is meant; how it is told from one pressed gently.

No foot holds a pedal within a hundredth of its way for seconds and never goes beyond: a car hardly rolls with that. But
a pedal that does not quite come back to 0 rests there, and one that has not been let go yet may be such a pedal.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from iwm_power_manager.signals.mapping import UNITS, Source

#: Parts of a pedal's way: less is noise of its sensor; 0..1 as % is no more (a pedal may show a little beyond its way).
_NOISE, _HUNDREDTH = 0.001, 0.011
_HELD_S = 3.0


@dataclass
class GentlePedal:
    """How a pedal has been used.

    Attributes
    ----------
    largest : farthest it was pressed, as part of its way
    released : it was let go
    held_s : longest time for which it was pressed
    """

    largest: float = 0.0
    released: bool = False
    held_s: float = 0.0
    _since_ns: int | None = None

    def note(self, time_ns: int, travel: float) -> None:
        """Take one message."""
        self.largest = max(self.largest, travel)
        if travel > _NOISE:
            self._since_ns = min(time_ns, time_ns if self._since_ns is None else self._since_ns)
            self.held_s = max(self.held_s, (time_ns - self._since_ns) * 1e-9)
        elif travel <= _NOISE:
            self.released, self._since_ns = True, None

    def remark(self, sources: Sequence[Source]) -> str:
        """What its source should be asked, in the words of the signals file; "" for nothing."""
        if not sources or sources[0].unit != UNITS["brake_pedal"]["%"]:
            return ""
        if self.held_s < _HELD_S or not _NOISE < self.largest <= _HUNDREDTH:
            return ""
        (source,) = sources
        shown = f"{100.0 * self.largest:.3g}"
        return f'{source.key} on {source.topic} was held, and never beyond {shown} %: where it is 0..1, write unit: "1"'
