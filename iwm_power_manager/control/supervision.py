# SPDX-License-Identifier: Apache-2.0
"""What the car is asked for when inputs go missing: the degraded state, its ramps, and the way back.

The rules, each one line; `docs/safety.md` argues them:

1. Any input missing: drive torque fades to zero within `fade_s`. A stale demand is no reason to keep driving.
2. The brake demand is live but another input is missing: regeneration fades to zero within `fade_s` and the friction
   brakes take over; the demand itself is not reduced. Braking requests always get through.
3. The brake demand itself is stale: the braking *force* last asked for is held and released linearly over
   `brake_release_s`. It never grows (a stale braking power would, as the car slows down) and nothing drives the car
   meanwhile. A stale brake demand is no reason to accelerate.
4. All inputs good again for `recover_s`: drive torque comes back over `resume_s`.

Pure functions over numbers. With all inputs good every factor is exactly 1.0, so that supervision leaves no trace in
the arithmetic of a healthy run.
"""

from __future__ import annotations

from typing import NamedTuple

from iwm_power_manager.control.types import LIMIT_BATTERY_CHARGE, LIMIT_BATTERY_DISCHARGE, LIMIT_NAMES

#: Modes of the power manager, in the order of `MODE_NAMES`.
MODE_WAITING, MODE_NORMAL, MODE_DEGRADED, MODE_RECOVERING = range(4)
MODE_NAMES = ("waiting", "normal", "degraded", "recovering")

#: Bits of the degraded reason.
STALE_SPEED = 1
STALE_WHEELS = 2
STALE_DEMAND = 4
STALE_BATTERY = 8
STALE_NAMES = {
    STALE_SPEED: "vehicle_speed",
    STALE_WHEELS: "wheel_states",
    STALE_DEMAND: "power_demand",
    STALE_BATTERY: "battery_state",
}


class SupervisionLimits(NamedTuple):
    """Times of the degraded state, s, all > 0 except `recover_s` >= 0.

    Attributes
    ----------
    fade_s : motor torque, full to zero
    brake_release_s : held braking force, full to zero
    recover_s : how long all inputs must be good before torque comes back
    resume_s : motor torque, zero to full
    """

    fade_s: float
    brake_release_s: float
    recover_s: float
    resume_s: float


class Supervision(NamedTuple):
    """State of the supervision.

    Attributes
    ----------
    mode : MODE_* code
    stale : STALE_* bits of the inputs that are missing now
    motor_factor : part of the motor torque that is allowed, 0..1
    brake_factor : part of a stale braking force that is still held, 0..1
    healthy_s : how long all inputs have been good
    """

    mode: int = MODE_WAITING
    stale: int = 0
    motor_factor: float = 0.0
    brake_factor: float = 1.0
    healthy_s: float = 0.0


#: State in which everything is allowed from the first step on: lock-step, where inputs cannot go missing.
LOCKSTEP_SUPERVISION = Supervision(mode=MODE_NORMAL, motor_factor=1.0)


def binding_limits(limits: int, motor_factor: float) -> list[str]:
    """Names of the limits that bind.

    Motors are faded by way of what the battery may give and take. Where nothing of it is left, it is not the battery.

    Parameters
    ----------
    limits : bits of `LIMIT_NAMES`
    motor_factor : part of the motor torque that is allowed, 0..1
    """
    faded = LIMIT_BATTERY_DISCHARGE | LIMIT_BATTERY_CHARGE if motor_factor == 0.0 else 0
    names = [name for bit, name in LIMIT_NAMES.items() if limits & ~faded & bit]
    return [*names, "motors faded out"] if limits & faded else names


def stale_inputs(age_s: tuple[float, float, float, float], limit_s: tuple[float, float, float, float]) -> int:
    """STALE_* bits of the inputs older than their limits; order speed, wheels, demand, battery."""
    bits = 0
    for bit, age, limit in zip(STALE_NAMES, age_s, limit_s, strict=True):
        # Written so that an age that is NaN counts as stale.
        if not age <= limit:
            bits |= bit
    return bits


def supervise(state: Supervision, stale: int, dt_s: float, limits: SupervisionLimits) -> Supervision:
    """Advance the degraded state by one control step.

    Parameters
    ----------
    state : previous state
    stale : STALE_* bits now
    dt_s : time since the previous step, > 0
    limits : times
    """
    brake = max(state.brake_factor - dt_s / limits.brake_release_s, 0.0) if stale & STALE_DEMAND else 1.0
    if stale:
        factor = max(state.motor_factor - dt_s / limits.fade_s, 0.0)
        mode = MODE_WAITING if state.mode == MODE_WAITING else MODE_DEGRADED
        return Supervision(mode, stale, factor, brake, 0.0)
    healthy_s = state.healthy_s + dt_s
    if state.mode == MODE_NORMAL:
        return Supervision(MODE_NORMAL, 0, 1.0, brake, healthy_s)
    if healthy_s < limits.recover_s:
        return Supervision(state.mode, 0, state.motor_factor, brake, healthy_s)
    factor = min(state.motor_factor + dt_s / limits.resume_s, 1.0)
    return Supervision(MODE_NORMAL if factor == 1.0 else MODE_RECOVERING, 0, factor, brake, healthy_s)


def shape_demand(demand_w: float, demand_speed_mps: float, speed_mps: float, state: Supervision) -> float:
    """Power demand the law is given, W.

    Parameters
    ----------
    demand_w : last accepted power demand, braking negative
    demand_speed_mps : speed of the car when it was accepted
    speed_mps : speed of the car now
    state : supervision of this step
    """
    if demand_w >= 0.0:
        return demand_w * state.motor_factor
    if not state.stale & STALE_DEMAND:
        return demand_w
    held = demand_w * state.brake_factor
    # Hold the force, not the power: P = F v.
    speed, then = abs(speed_mps), abs(demand_speed_mps)
    return held * speed / then if speed < then else held
