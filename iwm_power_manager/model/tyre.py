"""Tyre: slip (eq. 10) and the Magic Formula (eq. 9), its slope and its inverse.

Eq. 10 gives the slip for driving and for braking with different denominators. The case is chosen by the sign of
r*w - v, not by the pedal, so that both branches meet at zero; the denominator never falls below a floor speed, so
that slip stays finite at rest and the tyre acts as a stiff damper there.
"""

from __future__ import annotations

import math

from iwm_power_manager.jit import kernel
from iwm_power_manager.model.parameters import Tyre


@kernel
def slip_ratio(wheel_speed_radps: float, speed_mps: float, radius_m: float, floor_mps: float) -> float:
    """Slip of a wheel (eq. 10): driving positive, braking negative, -1 locked.

    (r*w - v) / max(r*w, v, floor), for w, v >= 0.
    """
    rim = radius_m * wheel_speed_radps
    return (rim - speed_mps) / max(rim, speed_mps, floor_mps)


@kernel
def wheel_speed_at_slip(slip: float, speed_mps: float, radius_m: float) -> float:
    """Wheel speed in rad/s that has this slip (inverse of eq. 10, without the floor); slip < 1."""
    if slip > 0.0:
        return speed_mps / (radius_m * (1.0 - slip))
    return speed_mps * (1.0 + slip) / radius_m


@kernel
def friction_coefficient(slip: float, peak_friction: float, tyre: Tyre) -> float:
    """Friction coefficient in use at a slip (eq. 9)."""
    x = tyre.stiffness_factor * slip
    y = x - tyre.curvature_factor * (x - math.atan(x))
    return peak_friction * tyre.peak_factor * math.sin(tyre.shape_factor * math.atan(y))


@kernel
def friction_and_slope(slip: float, peak_friction: float, tyre: Tyre) -> tuple[float, float]:
    """Friction coefficient at a slip (eq. 9) and its derivative with respect to slip."""
    x = tyre.stiffness_factor * slip
    y = x - tyre.curvature_factor * (x - math.atan(x))
    angle = tyre.shape_factor * math.atan(y)
    peak = peak_friction * tyre.peak_factor
    dy = tyre.stiffness_factor * (1.0 - tyre.curvature_factor * (x * x) / (1.0 + x * x))
    return peak * math.sin(angle), peak * math.cos(angle) * tyre.shape_factor / (1.0 + y * y) * dy


@kernel
def slip_at_friction(friction: float, peak_friction: float, tyre: Tyre) -> float:
    """Slip on the rising branch at which the tyre gives this friction coefficient (inverse of eq. 9).

    A demand beyond the peak returns the slip of the peak, with the sign of the demand.
    """
    peak = peak_friction * tyre.peak_factor
    if peak <= 0.0 or friction == 0.0:
        return 0.0
    ratio = min(abs(friction) / peak, 1.0)
    # sin(C atan(y)) = ratio  ->  y; then (1 - E) x + E atan(x) = y by Newton: the left side rises and bends down.
    y = math.tan(math.asin(ratio) / tyre.shape_factor)
    e = tyre.curvature_factor
    x = y
    for _ in range(50):
        step = ((1.0 - e) * x + e * math.atan(x) - y) / (1.0 - e * x * x / (1.0 + x * x))
        x -= step
        if abs(step) <= 1e-13 * (1.0 + abs(x)):
            break
    slip = x / tyre.stiffness_factor
    return slip if friction > 0.0 else -slip


@kernel
def peak_slip(tyre: Tyre) -> float:
    """Slip at which eq. 9 has its peak (0.18 for the paper's tyre)."""
    return slip_at_friction(1.0, 1.0 / tyre.peak_factor, tyre)
