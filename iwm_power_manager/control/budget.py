# SPDX-License-Identifier: Apache-2.0
"""The budget of changes: what a change of the share counts as, what it costs, and what it costs when little is left.

A change is counted in three ways, so that no strategy can win one count at the cost of another: any change counts as
one; one by a quarter of the power or more counts as one, a smaller one in proportion; and a move counts as its length.
The price of a change goes by the mean of the three. What is budgeted is the second: it is never less than the number of
changes by more than a quarter, and swinging just around that is no way out.

Every change fills a bucket that leaks at the rate of the budget. A share whose change does not fit, or from which the
way back to the middle would not fit, is not offered: so no minute sees more than the budget and one bucket, no hour
more than sixty budgets and one bucket, whatever is driven, and nothing can hold the split at a share that has become
wrong.

The price of a change is the multiplier of the constrained problem. A constant one is optimal: it is the solver's, while
the bucket is empty. It rises with what is used, as an integral controller of the multiplier: in proportion to the level
in the logarithm, to `DEAREST` times at a full bucket, where no change pays (docs/solver.md derives the rate and what it
costs).
"""

from __future__ import annotations

import math

from iwm_power_manager.jit import kernel

#: A change of the share by this much, or more, counts as one.
WHOLE_CHANGE = 0.25
#: Prices of a change at which the solver tabulates the cost-to-go beside its own, as multiples of it.
DEARER = (3.0, 9.0)
#: At a full bucket a change costs this many times the solver's price.
DEAREST = 20.0

#: The bucket holds this many minutes' budget; at least one change and the way back.
BUCKET_MIN = 2.0
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


@kernel
def bucket(changes_per_min: float) -> float:
    """Changes the bucket holds."""
    return max(BUCKET_MIN * changes_per_min, 2.0)


@kernel
def leaked(used: float, seconds: float, changes_per_min: float) -> float:
    """Changes still counted as used after a time."""
    return max(used - changes_per_min / 60.0 * seconds, 0.0)


@kernel
def affordable(share: float, previous: float, used: float, changes_per_min: float) -> bool:
    """Whether the bucket has room for a new share, and for the way back to the middle. Without a budget it has."""
    if changes_per_min <= 0.0 or share == previous:
        return True
    level = used + changes_counted(share - previous) + changes_counted(0.5 - share)
    return level <= bucket(changes_per_min) + _ROUNDING


@kernel
def price_factor(used: float, changes_per_min: float) -> float:
    """How many times the solver's price a change costs."""
    if changes_per_min <= 0.0:
        return 1.0
    return DEAREST ** min(used / bucket(changes_per_min), 1.0)


@kernel
def price_level(factor: float) -> float:
    """Where a price stands between the tabulated ones: 0 the solver's, 1 and 2 those of `DEARER`; in the logarithm."""
    return min(math.log(factor) / math.log(DEARER[-1]), 1.0) * len(DEARER)
