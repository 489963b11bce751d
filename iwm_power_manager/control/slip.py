# SPDX-License-Identifier: Apache-2.0
"""Slip of an axle, and the slip limiter of a wheel.

The limiter knows, from the last command and the wheel's acceleration, which torque the road is taking from the wheel.
The largest torque it allows is that, plus what turns the wheel towards the target slip within a time constant. Far
from the limit that is more than anybody asks for; at the limit it holds the wheel at the target, where the tyre gives
almost its peak force, instead of letting it swing across the critical slip as Table 2's on/off gate does.
"""

from __future__ import annotations

from iwm_power_manager.control.types import WheelState
from iwm_power_manager.jit import kernel

#: The limiter never steers to less than this slip speed, m/s: at walking pace a slip of 0.15 is within the noise.
LEAST_SLIP_SPEED_MPS = 0.3
#: Nor is a driven wheel gated at less, m/s: the default critical slip is beyond the target by as much.
LEAST_GATED_MPS = 1.25 * LEAST_SLIP_SPEED_MPS

#: Torque where the limiter has no say, N m: more than any wheel can be asked for.
UNLIMITED_NM = 1e9


@kernel
def worse_slip(left: float, right: float) -> float:
    """Slip of an axle: that of its worse wheel."""
    return left if abs(left) > abs(right) else right


@kernel
def driven_slip_for_gate(
    slip: float, wheel_speed_radps: float, speed_mps: float, critical_slip: float, floor_mps: float, radius_m: float
) -> float:
    """Slip of a driven wheel as its gate takes it beside the limiter: at walking pace a matter of slip speed, too.

    With the denominator of slip itself, a launch on ice would swing between its grip and nothing below 1.2 m/s: the
    gate would take all torque away from a wheel that the limiter holds where it should. A braked wheel has to be inside
    the critical slip as long as it can be told.
    """
    denominator = max(radius_m * wheel_speed_radps, speed_mps, floor_mps)
    return slip * denominator / max(denominator, LEAST_GATED_MPS / critical_slip)


@kernel
def filtered(previous: float, value: float, dt_s: float, time_constant_s: float) -> float:
    """First-order low pass, stepped implicitly; a time constant of 0 passes the value through."""
    return previous + dt_s / (time_constant_s + dt_s) * (value - previous)


@kernel
def gained_radps(own: WheelState, own_radps: float, other: WheelState, other_radps: float, radius_m: float) -> float:
    """What a wheel has gained in speed since the last step, with its axle's other wheel to tell noise from slip.

    Two wheels that differ by less than the least slip speed turn alike as far as anybody can tell, so that the mean of
    both says it better than each by itself: noise of a sensor, divided by a short step, is a large torque.
    """
    own_gain = own_radps - own.speed_radps
    if abs(own_radps - other_radps) * radius_m >= LEAST_SLIP_SPEED_MPS:
        return own_gain
    return 0.5 * (own_gain + (other_radps - other.speed_radps))


@kernel
def road_torque_nm(applied_nm: float, gained_radps: float, dt_s: float, inertia: float) -> float:
    """Torque the road took from a wheel that has gained so much speed over the last step (eq. 11 solved for r F)."""
    return applied_nm - inertia * gained_radps / dt_s


@kernel
def limiter_torque_nm(
    braking: bool,
    road_nm: float,
    wheel_speed_radps: float,
    speed_mps: float,
    slip_target: float,
    time_constant_s: float,
    hold_below_mps: float,
    radius_m: float,
    inertia: float,
) -> float:
    """Largest torque, N m >= 0, in the direction of the demand that does not drive a wheel beyond the target slip.

    Braking below `hold_below_mps` is not limited: the brakes have to be able to hold a car at rest.
    """
    if braking:
        if speed_mps < hold_below_mps:
            return UNLIMITED_NM
        slip_speed = max(slip_target * speed_mps, LEAST_SLIP_SPEED_MPS)
        target = max(speed_mps - slip_speed, 0.0) / radius_m
        return max(-(road_nm + inertia * (target - wheel_speed_radps) / time_constant_s), 0.0)
    slip_speed = max(slip_target / (1.0 - slip_target) * speed_mps, LEAST_SLIP_SPEED_MPS)
    target = (speed_mps + slip_speed) / radius_m
    return max(road_nm + inertia * (target - wheel_speed_radps) / time_constant_s, 0.0)
