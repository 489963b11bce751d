# SPDX-License-Identifier: Apache-2.0
"""Wheel speeds that come in coarse steps, as of a sensor that counts teeth: smoothed for as long as the step needs.

Of 48 teeth, one more or less in 10 ms is 13 rad/s, and a torque that nobody applied. The slope of the line through the
angles of ten such messages is off by a thirtieth of that. It is as old as half of them: an age that is known.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

from iwm_power_manager.control.types import Wheels

#: Smaller steps, rad/s, are noise as any sensor has; what a smoothed speed may be off by.
FINE_RADPS, LEFT_RADPS = 0.3, 0.25
#: So many rises and falls that are whole multiples of one step, within this part of it, are no chance and no ramp;
#: after so many changes that are not, nobody counts. For more messages than the last number no wheel can wait.
CERTAIN, WHOLE_PART = 6, 0.02
MOST_MESSAGES = 12


class Coarse:
    """Finds the step that wheel speeds come in, and smooths them.

    Attributes
    ----------
    weights : of the newest speeds, oldest first, that one is made of; one weight where they are as they came
    """

    def __init__(self) -> None:
        self.weights: Sequence[float] = (1.0,)
        self._fine = False
        self._step_radps, self._failed = 0.0, 0
        self._falls = self._rises = 0
        self._last: deque[Wheels] = deque(maxlen=MOST_MESSAGES)

    def smoothed(self, speed_radps: Wheels) -> Wheels:
        """Four wheel speeds by the newest of them and those before; NaN of a wheel that was NaN in one of them."""
        if self._fine:
            return speed_radps
        last = self._last
        if last and len(self.weights) == 1:
            self._learn(last[-1], speed_radps)
        last.append(speed_radps)
        weights = self.weights
        if len(weights) == 1 or len(last) < len(weights):
            return speed_radps
        newest = list(last)[-len(weights) :]
        a, b, c, d = (sum(w * speeds[i] for w, speeds in zip(weights, newest, strict=True)) for i in range(4))
        return a, b, c, d

    def _learn(self, before: Wheels, now: Wheels) -> None:
        """Hold changes against the step that those before were multiples of (Euclid's algorithm)."""
        for i in range(4):
            change = abs(now[i] - before[i])
            if not 0.0 < change < math.inf:
                continue
            small, large = sorted((self._step_radps or change, change))
            if small >= FINE_RADPS:
                off = abs(math.remainder(large, small))
                if off > WHOLE_PART * small:
                    small, self._falls, self._rises = off, 0, 0
            if small < FINE_RADPS:
                self._step_radps, self._falls, self._rises = 0.0, 0, 0
                self._failed += 1
                self._fine = self._failed >= CERTAIN
                return
            if not small > (1.0 - WHOLE_PART) * self._step_radps > 0.0:
                self._step_radps = small
            self._rises += now[i] > before[i]
            self._falls += now[i] < before[i]
        if min(self._rises, self._falls) >= CERTAIN:
            # A slope is off by the step over the number of messages to the power of 1.5.
            count = math.ceil((self._step_radps / LEFT_RADPS) ** (2.0 / 3.0))
            self.weights = line_weights(min(count, MOST_MESSAGES))


def line_weights(count: int) -> list[float]:
    """Weights of mean speeds by which they add up to the slope of the line through the angles between them."""
    scale = 6.0 / (count * (count + 1) * (count + 2))
    return [scale * (k + 1) * (count - k) for k in range(count)]
