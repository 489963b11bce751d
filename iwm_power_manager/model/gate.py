# SPDX-License-Identifier: Apache-2.0
"""Skid gate (Table 2): which axles get no torque because a wheel is beyond the critical slip."""

from __future__ import annotations

from iwm_power_manager.jit import kernel


@kernel
def axle_gated(slip: float, power_w: float, was_gated: bool, critical: float, hysteresis: float, driving: bool) -> bool:
    """Whether an axle is to be held at zero torque.

    Parameters
    ----------
    slip : of the axle
    power_w : demand; only a braking demand locks a wheel, only a driving one spins it
    was_gated : in the step before
    critical : slip beyond which the axle is gated, > 0 (the paper's 0.2)
    hysteresis : a gated axle is freed when its slip is this far inside again; 0 is Table 2 as printed
    driving : also gate driving slip; False is Table 2 as printed
    """
    edge = critical - hysteresis if was_gated else critical
    if power_w < 0.0:
        return slip < -edge
    if driving and power_w > 0.0:
        return slip > edge
    return False


@kernel
def gated_split(power_w: float, front_share: float, gated: tuple[bool, bool]) -> tuple[float, float]:
    """Power of the front and the rear axle, W, under Table 2: a gated axle's part goes to the other one."""
    front_gated, rear_gated = gated
    if front_gated and rear_gated:
        return 0.0, 0.0
    if front_gated:
        return 0.0, power_w
    if rear_gated:
        return power_w, 0.0
    front = front_share * power_w
    return front, power_w - front
