# SPDX-License-Identifier: Apache-2.0
"""Slip of a wheel (eq. 10).

Eq. 10 gives the slip for driving and for braking with different denominators. The case is chosen by the sign of
r*w - v, not by the pedal, so that both branches meet at zero; the denominator never falls below a floor speed, so
that slip stays finite at rest and the tyre acts as a stiff damper there.
"""

from __future__ import annotations

from iwm_power_manager.jit import kernel


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
