# SPDX-License-Identifier: Apache-2.0
"""Rate limits: of a motor torque (asymmetric) and of the front share."""

from __future__ import annotations

from iwm_power_manager.jit import kernel


@kernel
def slewed(
    previous_nm: float, target_nm: float, dt_s: float, up_nmps: float, down_nmps: float, regeneration_nmps: float
) -> float:
    """Torque after one step towards a target.

    A torque goes to zero at `down`; a driving torque grows at `up`, a regenerative one at `regeneration`. A change of
    sign spends the first part of the step on the way to zero and the rest on the way out.
    """
    if target_nm > previous_nm:
        to_zero = max(-previous_nm, 0.0)
        if to_zero >= down_nmps * dt_s:
            return min(previous_nm + down_nmps * dt_s, target_nm)
        left = dt_s - to_zero / down_nmps
        return min(max(previous_nm, 0.0) + up_nmps * left, target_nm)
    to_zero = max(previous_nm, 0.0)
    if to_zero >= down_nmps * dt_s:
        return max(previous_nm - down_nmps * dt_s, target_nm)
    left = dt_s - to_zero / down_nmps
    return max(min(previous_nm, 0.0) - regeneration_nmps * left, target_nm)


@kernel
def approached(previous: float, target: float, largest_change: float) -> float:
    """`target`, or as near to it as one step may go."""
    return min(max(target, previous - largest_change), previous + largest_change)
