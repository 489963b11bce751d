# SPDX-License-Identifier: Apache-2.0
"""Axes, cell search and multilinear interpolation: one piece of code for the solver, the policy and the run time.

An axis is a float64 array of strictly increasing points; it may have a single point, and then nothing depends on that
coordinate. Outside an axis the value at its edge holds (the coordinate is clamped). A coordinate that is NaN gives NaN,
so that it cannot pass for a point of the grid.
"""

from __future__ import annotations

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
def _blend(low, high, fraction):
    # At a grid point the other end must not count at all: 0 * inf would be NaN.
    if fraction == 0.0:
        return low
    if fraction == 1.0:
        return high
    return low + fraction * (high - low)


@kernel
def interpolate1(table, a, fa):
    """Value of a table[A] at cell (a, fa) as `locate` gives it."""
    return _blend(table[a], table[min(a + 1, table.shape[0] - 1)], fa)


@kernel
def interpolate2(table, a, fa, b, fb):
    """Bilinear value of table[A, B] at the cells (a, fa), (b, fb)."""
    a1 = min(a + 1, table.shape[0] - 1)
    return _blend(interpolate1(table[a], b, fb), interpolate1(table[a1], b, fb), fa)


@kernel
def interpolate3(table, a, fa, b, fb, c, fc):
    """Trilinear value of table[A, B, C] at three cells."""
    a1 = min(a + 1, table.shape[0] - 1)
    return _blend(interpolate2(table[a], b, fb, c, fc), interpolate2(table[a1], b, fb, c, fc), fa)


@kernel
def interpolate4(table, a, fa, b, fb, c, fc, d, fd):
    """Multilinear value of table[A, B, C, D] at four cells."""
    a1 = min(a + 1, table.shape[0] - 1)
    return _blend(interpolate3(table[a], b, fb, c, fc, d, fd), interpolate3(table[a1], b, fb, c, fc, d, fd), fa)


@kernel
def interpolate5(table, a, fa, b, fb, c, fc, d, fd, e, fe):
    """Multilinear value of table[A, B, C, D, E] at five cells."""
    a1 = min(a + 1, table.shape[0] - 1)
    return _blend(
        interpolate4(table[a], b, fb, c, fc, d, fd, e, fe), interpolate4(table[a1], b, fb, c, fc, d, fd, e, fe), fa
    )
