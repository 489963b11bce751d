# SPDX-License-Identifier: Apache-2.0
"""Fiala's brush tyre: bristles that stick and then slide, with a sliding friction that may be below the peak.

At a slip s, with the stiffness C (friction coefficient per slip of the adhering tyre, its whole contact patch) and the
road's peak friction m, the sliding part of the patch is q = C |s| / (3 m) and

    mu = m (3 q - 3 q^2 + q^3)          while the patch still adheres, q < 1
    mu = m (k + (1 - k) exp(1 - q))     beyond: all of it slides, and friction falls to k times the peak

with the sliding factor k. The curve and its slope are continuous at 0; at q = 1 the curve is continuous and the slope
steps from 0 to its fall. Unlike the Magic Formula's, its stiffness does not depend on the road.
Source: E. Fiala, "Seitenkraefte am rollenden Luftreifen", VDI-Z 96 (1954); the fall beyond the peak is an assumption.
"""

from __future__ import annotations

import math

from iwm_power_manager.jit import kernel
from iwm_power_manager.model.parameters import TyreCoefficients

#: Keys of a vehicle file with their ranges, in the order of the coefficients: C, k.
RANGES = {"slip_stiffness": (1.0, 200.0), "sliding_factor": (0.3, 1.0)}
MEANINGS = {
    "slip_stiffness": "friction coefficient per slip at no slip, on any road",
    "sliding_factor": "friction of the sliding tyre over its peak",
}


@kernel
def friction_coefficient(slip: float, peak_friction: float, coefficients: TyreCoefficients) -> float:
    """Friction coefficient in use at a slip."""
    return friction_and_slope(slip, peak_friction, coefficients)[0]


@kernel
def friction_and_slope(slip: float, peak_friction: float, coefficients: TyreCoefficients) -> tuple[float, float]:
    """Friction coefficient at a slip and its derivative with respect to slip."""
    if peak_friction <= 0.0:
        return 0.0, 0.0
    rate = coefficients[0] / (3.0 * peak_friction)
    q = rate * abs(slip)
    if q < 1.0:
        mu = peak_friction * (3.0 + (q - 3.0) * q) * q
        slope = 3.0 * peak_friction * rate * (1.0 - q) * (1.0 - q)
    else:
        excess = (1.0 - coefficients[1]) * math.exp(1.0 - q)
        mu = peak_friction * (coefficients[1] + excess)
        slope = -peak_friction * rate * excess
    return (mu if slip >= 0.0 else -mu), slope


@kernel
def slip_at_friction(friction: float, peak_friction: float, coefficients: TyreCoefficients) -> float:
    """Slip below the peak at which the tyre gives this friction coefficient: 1 - (1 - q)^3 = ratio."""
    if peak_friction <= 0.0 or friction == 0.0:
        return 0.0
    ratio = min(abs(friction) / peak_friction, 1.0)
    slip = 3.0 * peak_friction / coefficients[0] * (1.0 - (1.0 - ratio) ** (1.0 / 3.0))
    return slip if friction > 0.0 else -slip


@kernel
def least_slip_at_friction(friction: float, peak_friction: float, coefficients: TyreCoefficients) -> float:
    """A bound of `slip_at_friction`, never larger: the curve lies below its tangent at the origin."""
    return min(max(friction, -peak_friction), peak_friction) / coefficients[0]
