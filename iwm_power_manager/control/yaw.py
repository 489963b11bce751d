# SPDX-License-Identifier: Apache-2.0
"""What a yaw rate adds to the yaw budget of wheels that brake unequally.

Without one, the budget grows at a rate that any driver can steer against. A gyroscope shows how well he does: as long
as the car hardly turns towards the side with more grip, more of that grip can be used; where it does turn, less, at
once. The rate counts relative to what it was before, so that neither a bend nor a bias of the sensor does. It is
believed where, by it, the car has first turned as unequal brakes turn a car: a sensor that stands still, or has its
sign wrong, does not show that. One that later shows the car turning off to the other side is not believed any more.
Without a rate that is believed, what was added fades.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from iwm_power_manager.jit import kernel

#: The rate before is averaged over this time, and is known after this one, s.
STRAIGHT_S = 0.5
KNOWN_S = 0.25
#: Unequal brakes turn a car by more than this, rad, within this time, s; and nobody steers it so far to the other side.
TURNED_RAD = 0.004
TURNED_WITHIN_S = 1.0
ASTRAY_RAD = -0.15
#: The rate of a car that brakes unequally is no longer the same than this, s.
SAME_S = 0.1
#: Rate towards the side with more grip beyond which less is added than before, rad/s.
CALM_RADPS = 0.03
#: The budget is less by this for each rad/s, N m s: some six times what the tyres do against it at 25 m/s.
DAMPING_NMS = 16000.0
#: Most that is added in front; the rear wheels get this part of it, which leaves them what keeps the car straight.
MOST_NM = 1500.0
REAR_PART = 0.3


class YawState(NamedTuple):
    """What is remembered of the yaw rate from step to step.

    Attributes
    ----------
    straight_radps, known_s : yaw rate before the wheels braked unequally, averaged, and for how long it was heard
    shown_radps, same_s : the sensor's last number, and for how long it has shown it
    turned_rad : angle the car has turned since, towards the side with more grip
    believed : it has turned as unequal brakes turn it
    towards_radps : yaw rate towards the side with more grip
    extra_nm : what is added to the yaw budget
    """

    straight_radps: float
    known_s: float
    shown_radps: float
    same_s: float
    turned_rad: float
    believed: bool
    towards_radps: float
    extra_nm: float


@kernel
def no_yaw(extra_nm: float = 0.0) -> YawState:
    """Nothing is known of the yaw rate."""
    return YawState(0.0, 0.0, 0.0, 0.0, 0.0, False, 0.0, extra_nm)


@kernel
def yaw_step(
    before: YawState,
    yaw_rate_radps: float,
    unequal_s: float,
    growth_nmps: float,
    braking: bool,
    dt_s: float,
) -> YawState:
    """What is known of the yaw rate, and what it adds to the budget.

    Parameters
    ----------
    yaw_rate_radps : in the direction of travel, positive to the left (NaN: there is none)
    unequal_s : how long the front axle has braked unequally, > 0 more left; 0 if too short to count
    growth_nmps : of what is added; 0: the rate is not used
    """
    b, rate = before, yaw_rate_radps
    faded = max(b.extra_nm - growth_nmps * dt_s, 0.0) if unequal_s != 0.0 else 0.0
    if math.isnan(rate) or growth_nmps == 0.0:
        return no_yaw(faded)
    if unequal_s == 0.0:
        part = dt_s / (min(b.known_s, STRAIGHT_S) + dt_s)
        return YawState(
            b.straight_radps + part * (rate - b.straight_radps), b.known_s + dt_s, rate, 0.0, 0.0, False, 0.0, 0.0
        )
    same = b.same_s + dt_s if rate == b.shown_radps else 0.0
    towards = math.copysign(1.0, unequal_s) * (rate - b.straight_radps)
    turned = b.turned_rad + towards * dt_s
    known = b.known_s if same <= SAME_S and turned >= ASTRAY_RAD else 0.0
    found = abs(unequal_s) <= TURNED_WITHIN_S and turned > TURNED_RAD
    believed = known >= KNOWN_S and (b.believed or found)
    extra = faded
    if believed and braking:
        pace = 1.0 - max(towards, 0.0) / CALM_RADPS
        extra = min(max(b.extra_nm + pace * growth_nmps * dt_s, 0.0), MOST_NM)
    return YawState(b.straight_radps, known, rate, same, turned, believed, towards, extra)


@kernel
def with_yaw(
    front_nm: tuple[float, float], rear_nm: tuple[float, float], unequal_s: float, yaw: YawState
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Yaw moments that more torque left, and more torque right, may have, with what the yaw rate adds or takes."""
    damped = DAMPING_NMS * max(yaw.towards_radps, 0.0) if yaw.believed else 0.0
    rear = REAR_PART * max(yaw.extra_nm - damped, 0.0)
    front = yaw.extra_nm - damped
    if unequal_s > 0.0:
        return (max(front_nm[0] + front, 0.0), front_nm[1]), (rear_nm[0] + rear, rear_nm[1])
    if unequal_s < 0.0:
        return (front_nm[0], max(front_nm[1] + front, 0.0)), (rear_nm[0], rear_nm[1] + rear)
    return front_nm, rear_nm
