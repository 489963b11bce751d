# SPDX-License-Identifier: Apache-2.0
"""Magic Formula (eq. 9): a sine that rises, peaks and falls a little. Its keys in a vehicle file stand here only."""

from __future__ import annotations

import math

from iwm_power_manager.jit import kernel
from iwm_power_manager.model.parameters import TyreCoefficients

#: Keys of a vehicle file with their ranges, in the order of the coefficients: B, C, D, E.
RANGES = {
    "stiffness_factor": (1.0, 100.0),
    "shape_factor": (1.0, 3.0),
    "peak_factor": (0.1, 2.0),
    "curvature_factor": (-10.0, 1.0),
}
MEANINGS = {
    "stiffness_factor": "Magic Formula's B: slope at no slip over friction is B C D (eq. 9)",
    "shape_factor": "its C: how far friction falls beyond the peak; 1: not at all",
    "peak_factor": "its D: largest friction coefficient over that of the road",
    "curvature_factor": "its E: where the peak lies; lower: at less slip and sharper",
}


@kernel
def friction_coefficient(slip: float, peak_friction: float, coefficients: TyreCoefficients) -> float:
    """Friction coefficient in use at a slip (eq. 9)."""
    b, c, d, e = coefficients
    x = b * slip
    y = x - e * (x - math.atan(x))
    return peak_friction * d * math.sin(c * math.atan(y))


@kernel
def friction_and_slope(slip: float, peak_friction: float, coefficients: TyreCoefficients) -> tuple[float, float]:
    """Friction coefficient at a slip (eq. 9) and its derivative with respect to slip."""
    b, c, d, e = coefficients
    x = b * slip
    y = x - e * (x - math.atan(x))
    angle = c * math.atan(y)
    peak = peak_friction * d
    dy = b * (1.0 - e * (x * x) / (1.0 + x * x))
    return peak * math.sin(angle), peak * math.cos(angle) * c / (1.0 + y * y) * dy


@kernel
def slip_at_friction(friction: float, peak_friction: float, coefficients: TyreCoefficients) -> float:
    """Slip on the rising branch at which the tyre gives this friction coefficient (inverse of eq. 9)."""
    b, c, d, e = coefficients
    peak = peak_friction * d
    if peak <= 0.0 or friction == 0.0:
        return 0.0
    ratio = min(abs(friction) / peak, 1.0)
    # sin(C atan(y)) = ratio  ->  y; then (1 - E) x + E atan(x) = y by Newton: the left side rises and bends down.
    y = math.tan(math.asin(ratio) / c)
    x = y
    for _ in range(50):
        step = ((1.0 - e) * x + e * math.atan(x) - y) / (1.0 - e * x * x / (1.0 + x * x))
        x -= step
        if abs(step) <= 1e-13 * (1.0 + abs(x)):
            break
    slip = x / b
    return slip if friction > 0.0 else -slip


@kernel
def least_slip_at_friction(friction: float, peak_friction: float, coefficients: TyreCoefficients) -> float:
    """A bound of `slip_at_friction`, never larger: with E >= 0 the curve lies below its tangent at the origin."""
    b, c, d, e = coefficients
    peak = peak_friction * d
    if peak <= 0.0 or e < 0.0:
        return 0.0
    slip = min(abs(friction) / peak, 1.0) / (b * c)
    return slip if friction > 0.0 else -slip


@kernel
def peak_ratio(coefficients: TyreCoefficients) -> float:
    """Largest friction coefficient as a multiple of the road's peak friction: D."""
    return coefficients[2]
