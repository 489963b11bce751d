# SPDX-License-Identifier: Apache-2.0
"""The budget of changes: what a change of the share counts as, what it costs, and what it costs when little is left.

A change is counted in three ways, so that no strategy can win one count at the cost of another: any change counts as
one; one by a quarter of the power or more counts as one, a smaller one in proportion; and a move counts as its length.
The price of a change goes by the mean of the three. What is budgeted is the second: it is never less than the number of
changes by more than a quarter, and swinging just around that is no way out.

Every change fills two buckets. One holds five and a half minutes' budget and leaks at the rate of the budget: it leaves
a busy stretch of a drive what quiet ones did not use. The other holds two and a half minutes' and leaks twice as fast:
it keeps a single minute bearable. A share whose change does not fit into both, or from which the way back to the
middle would not fit, is not offered: so no minute sees more than the budget and `burst`, no hour more than sixty
budgets and the first bucket, whatever is driven, and nothing can hold the split at a share that has become wrong.

The price of a change is the multiplier of the constrained problem. A constant one is optimal: it is the solver's, while
the buckets are empty, and little more until one of them is nearly full (docs/solver.md). Where another change would not
fit, it has risen beyond all bounds: what is left goes to the changes that are worth most, not to those that come first.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from iwm_power_manager.jit import kernel

#: A change of the share by this much, or more, counts as one.
WHOLE_CHANGE = 0.25
#: Prices of a change at which the solver tabulates the cost-to-go beside its own, as multiples of it.
DEARER = (3.0, 9.0)

#: A change and the way back to the middle, in changes: with less room a share that is left for another is not offered.
THERE_AND_BACK = 2.0
#: The first bucket holds this many minutes' budget; both hold at least one change and the way back.
LASTING_MIN = 5.5
#: The second one holds this many, and leaks at this many times the budget.
MINUTE_MIN, MINUTE_LEAK = 2.5, 2.0

#: What a price that is higher by one in the logarithm takes from the changes, as a part of the budget, where no solver
#: has tried prices (docs/solver.md).
ELASTICITY = 0.3
#: Level at which a bucket counts as full, so that the price stays a number.
_FULL = 0.9999
_ROUNDING = 1e-9


@kernel
def changes_counted(move: float) -> float:
    """What a move of the share takes from the budget, 0..1."""
    return min(abs(move) / WHOLE_CHANGE, 1.0)


@kernel
def price_units(move: float) -> float:
    """What a move of the share costs, in prices of a change, 0..1."""
    if move == 0.0:
        return 0.0
    return (1.0 + changes_counted(move) + abs(move)) / 3.0


class Used(NamedTuple):
    """Changes that still count as used, in each bucket."""

    lasting: float
    minute: float


@kernel
def buckets(changes_per_min: float) -> Used:
    """Changes the buckets hold."""
    return Used(max(LASTING_MIN * changes_per_min, THERE_AND_BACK), max(MINUTE_MIN * changes_per_min, THERE_AND_BACK))


@kernel
def burst(changes_per_min: float) -> float:
    """Changes that any minute may have beyond the budget."""
    size = buckets(changes_per_min)
    return min(size.lasting, size.minute + (MINUTE_LEAK - 1.0) * changes_per_min)


@kernel
def leaked(used: Used, seconds: float, changes_per_min: float) -> Used:
    """What still counts as used after a time."""
    leak = changes_per_min / 60.0 * seconds
    return Used(max(used.lasting - leak, 0.0), max(used.minute - MINUTE_LEAK * leak, 0.0))


@kernel
def spent(used: Used, move: float) -> Used:
    """What counts as used after a move of the share."""
    count = changes_counted(move)
    return Used(used.lasting + count, used.minute + count)


@kernel
def affordable(share: float, previous: float, used: Used, changes_per_min: float) -> bool:
    """Whether there is room for a new share, and for the way back to the middle. Without a budget there is."""
    if changes_per_min <= 0.0 or share == previous:
        return True
    size = buckets(changes_per_min)
    there_and_back = changes_counted(share - previous) + changes_counted(0.5 - share) - _ROUNDING
    return used.lasting + there_and_back <= size.lasting and used.minute + there_and_back <= size.minute


@kernel
def _rising(used: float, size: float, elasticity: float) -> tuple[float, float]:
    """Level of a bucket, 0..1, and how many times dearer a change is for it: beyond all bounds where none fits in."""
    holds = max(size - THERE_AND_BACK, 1.0)
    level = min(max(used, 0.0) / holds, _FULL)
    return level, 1.0 + 0.5 * math.pi / (elasticity * holds) * math.tan(0.5 * math.pi * level)


@kernel
def price_factor(used: Used, previous: float, changes_per_min: float, elasticity: float) -> float:
    """How many times the solver's price a change costs, away from the share that is held.

    Whoever is away from the middle has the way back set aside: it costs what the way there did. `elasticity` is what a
    price that is higher by one in the logarithm takes from the changes, as a part of the budget.
    """
    if changes_per_min <= 0.0:
        return 1.0
    size = buckets(changes_per_min)
    away = changes_counted(0.5 - previous)
    level, lasting = _rising(used.lasting - away, size.lasting, elasticity)
    _, minute = _rising(used.minute - away, size.minute, elasticity)
    return math.exp2(level) * lasting * minute


@kernel
def price_level(factor: float) -> float:
    """Where a price stands between the tabulated ones: 0 the solver's, 1 and 2 those of `DEARER`; in the logarithm."""
    return min(math.log(factor) / math.log(DEARER[-1]), 1.0) * len(DEARER)
