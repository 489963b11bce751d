# SPDX-License-Identifier: Apache-2.0
"""Axes, cell search and multilinear interpolation: one piece of code for the solver, the policy and the run time.

An axis is a float64 array of strictly increasing points; it may have a single point, and then nothing depends on that
coordinate. Outside an axis the value at its edge holds (the coordinate is clamped). A coordinate that is NaN gives NaN,
so that it cannot pass for a point of the grid.
"""

from __future__ import annotations

from typing import NamedTuple

from iwm_power_manager.jit import kernel


@kernel
def locate(axis, x):
    """Cell of `x` on an axis and the place inside it.

    Parameters
    ----------
    axis : float64[:], strictly increasing, at least one point
    x : coordinate, in the axis's unit

    Returns
    -------
    (int, float)
        Index i of the point to the left, 0 <= i <= max(len(axis) - 2, 0), and the fraction of the way to point i + 1,
        0..1. A single-point axis gives (0, 0.0).
    """
    last = axis.size - 1
    if x != x:
        return 0, x
    if last == 0 or x <= axis[0]:
        return 0, 0.0
    if x >= axis[last]:
        return last - 1, 1.0
    low = 0
    high = last
    while high - low > 1:
        middle = (low + high) // 2
        if x >= axis[middle]:
            low = middle
        else:
            high = middle
    return low, (x - axis[low]) / (axis[low + 1] - axis[low])


@kernel
def nearest(axis, x):
    """Index of the point nearest to `x`; halfway between two points, the left one."""
    i, fraction = locate(axis, x)
    return i + 1 if fraction > 0.5 else i


@kernel
def _at_end(fraction):
    """Whether a place is a grid point: there the other end must not count at all, 0 * inf would be NaN."""
    return fraction == 0.0 or fraction == 1.0


@kernel
def _point(table, a, fa):
    """Index of the point that a place is at, or that it lies beyond."""
    return min(a + 1, table.shape[0] - 1) if fa == 1.0 else a


@kernel
def interpolate1(table, a, fa):
    """Value of a table[A] at cell (a, fa) as `locate` gives it."""
    low = table[_point(table, a, fa)]
    return low if _at_end(fa) else low + fa * (table[min(a + 1, table.shape[0] - 1)] - low)


@kernel
def interpolate2(table, a, fa, b, fb):
    """Bilinear value of table[A, B] at the cells (a, fa), (b, fb)."""
    low = interpolate1(table[_point(table, a, fa)], b, fb)
    if _at_end(fa):
        return low
    return low + fa * (interpolate1(table[min(a + 1, table.shape[0] - 1)], b, fb) - low)


@kernel
def interpolate3(table, a, fa, b, fb, c, fc):
    """Trilinear value of table[A, B, C] at the cells (a, fa), (b, fb), (c, fc)."""
    low = interpolate2(table[_point(table, a, fa)], b, fb, c, fc)
    if _at_end(fa):
        return low
    return low + fa * (interpolate2(table[min(a + 1, table.shape[0] - 1)], b, fb, c, fc) - low)


@kernel
def interpolate4(table, a, fa, b, fb, c, fc, d, fd):
    """Multilinear value of table[A, B, C, D] at the cells (a, fa), (b, fb), (c, fc), (d, fd)."""
    low = interpolate3(table[_point(table, a, fa)], b, fb, c, fc, d, fd)
    if _at_end(fa):
        return low
    return low + fa * (interpolate3(table[min(a + 1, table.shape[0] - 1)], b, fb, c, fc, d, fd) - low)


@kernel
def interpolate5(table, a, fa, b, fb, c, fc, d, fd, e, fe):
    """Multilinear value of table[A, B, C, D, E] at the cells (a, fa), (b, fb), (c, fc), (d, fd), (e, fe)."""
    low = interpolate4(table[_point(table, a, fa)], b, fb, c, fc, d, fd, e, fe)
    if _at_end(fa):
        return low
    return low + fa * (interpolate4(table[min(a + 1, table.shape[0] - 1)], b, fb, c, fc, d, fd, e, fe) - low)


class Ends(NamedTuple):
    """A cell of `locate` by the indices of its ends: `low`, where the fraction of the way to `high` is 0, or below."""

    low: int
    high: int
    fraction: float


@kernel
def ends(axis, x):
    """Cell of `x` on an axis, as `interpolate3_of_5` needs it; the fraction is below 1, or NaN."""
    i, fraction = locate(axis, x)
    high = min(i + 1, axis.size - 1)
    return Ends(high, high, 0.0) if fraction == 1.0 else Ends(i, high, fraction)


@kernel
def interpolate3_of_5(table, a, b, c, d, e):
    """Trilinear value of table[A, B, c, d, E] at the ends a, b, e; c and d are indices.

    `interpolate5` at the points c and d, to the bit, without its slices: they take longer than the arithmetic.
    """
    low = _of_two(table, a.low, b, c, d, e)
    return low if a.fraction == 0.0 else low + a.fraction * (_of_two(table, a.high, b, c, d, e) - low)


@kernel
def _of_two(table, a, b, c, d, e):
    low = _of_one(table, a, b.low, c, d, e)
    return low if b.fraction == 0.0 else low + b.fraction * (_of_one(table, a, b.high, c, d, e) - low)


@kernel
def _of_one(table, a, b, c, d, e):
    low = table[a, b, c, d, e.low]
    return low if e.fraction == 0.0 else low + e.fraction * (table[a, b, c, d, e.high] - low)
