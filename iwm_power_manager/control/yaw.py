# SPDX-License-Identifier: Apache-2.0
"""What a yaw rate adds to the yaw budget of wheels that brake unequally.

Without one, the budget grows at a rate that any driver can steer against. A gyroscope shows how well he does: as long
as the car hardly turns, more of the grip of the better side can be used; where it turns towards that side, less, at
once. The rate counts relative to what it was before, so that neither a bend nor a bias of the sensor does. It is
believed where, by it, the car has first turned as unequal brakes turn a car: a sensor that stands still, or has its
sign wrong, does not show that. One that later shows the car turning off to the other side is not believed any more.

No gyroscope is trusted alone: it takes an accelerometer that feels what the car does to the side, which is the change
of its lateral speed and speed times yaw rate. The yaw rate counts within what is felt; and where what they differ by
adds up to a lateral speed that no car has which still follows its wheels, neither is believed. Without a rate that is
believed, what it had left of that fades, and only a turn that both show is damped: the wrong one would turn the car.
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
#: Lateral speed that yaw rate and accelerometer add up to, m/s, or part of the car's, beyond which they contradict each
#: other; what is older than this, s, is forgotten: the car slips aside slowly, too.
ASIDE_MPS = 0.7
ASIDE_RAD = 0.03
ASIDE_S = 1.0
#: What is felt towards the side with more grip may be camber, roll and noise up to this, m/s2; and up to this much less
#: is felt than a car that begins to turn shows.
FELT_MPS2 = 0.2
NOT_YET_FELT_MPS2 = 1.0
#: Yaw rate and lateral acceleration become each other by this speed, m/s, at least: brakes of steered wheels are felt
#: to the side, too.
LEAST_MPS = 10.0
#: The rate of a car that brakes unequally is no longer the same than this, s.
SAME_S = 0.1
#: Lateral acceleration of a turn towards the side with more grip beyond which less is added than before, m/s2; and of
#: one to the other side, beyond which no more is, as a multiple: the driver catches the car.
CALM_MPS2 = 0.5
CAUGHT = 4.0
#: The budget is less by this for each rad/s, N m s: some eight times what the tyres do against it at 25 m/s.
DAMPING_NMS = 20000.0
#: The same where the rate is believed no more.
LOST_DAMPING_NMS = 10000.0
#: Friction of the better side on which the growth is what it says: it goes with what tyres hold a car straight by.
GROWTH_FRICTION = 0.48
#: Most that is added in front; the rear wheels get this part of it, which leaves them what keeps the car straight.
MOST_NM = 1500.0
REAR_PART = 0.3


class YawState(NamedTuple):
    """What is remembered of the yaw rate from step to step.

    Attributes
    ----------
    straight_radps, known_s : yaw rate before the wheels braked unequally, averaged, and for how long it was heard
    shown_radps, same_s : the sensor's last number, and for how long it has shown it
    level_mps2 : what was felt to the side beyond speed times yaw rate before, averaged
    aside_mps : lateral speed of late, by accelerometer and yaw rate
    turned_rad : angle the car has turned since, towards the side with more grip
    believed : it has turned as unequal brakes turn it, and an accelerometer agrees
    towards_radps : yaw rate towards the side with more grip, within what is felt; where it is lost, what both show
    extra_nm : what is added to the yaw budget
    lost : it was believed, and is no more
    """

    straight_radps: float
    known_s: float
    shown_radps: float
    same_s: float
    level_mps2: float
    aside_mps: float
    turned_rad: float
    believed: bool
    towards_radps: float
    extra_nm: float
    lost: bool


@kernel
def no_yaw(extra_nm: float = 0.0) -> YawState:
    """Nothing is known of the yaw rate."""
    return YawState(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, False, 0.0, extra_nm, False)


@kernel
def yaw_step(
    before: YawState,
    yaw_rate_radps: float,
    lateral_mps2: float,
    speed_mps: float,
    unequal_s: float,
    growth_nmps: float,
    braking: bool,
    dt_s: float,
) -> YawState:
    """What is known of the yaw rate, and what it adds to the budget.

    Parameters
    ----------
    yaw_rate_radps : in the direction of travel, positive to the left (NaN: there is none)
    lateral_mps2 : of an accelerometer, positive to the left (NaN: there is none)
    speed_mps : in the direction of travel, >= 0
    unequal_s : how long the front axle has braked unequally, > 0 more left; 0 if too short to count
    growth_nmps : of what is added; 0: the rate is not used
    """
    b, rate = before, yaw_rate_radps
    damped = DAMPING_NMS * max(b.towards_radps, 0.0) if b.believed else 0.0
    faded = max(b.extra_nm - damped - growth_nmps * dt_s, 0.0) if unequal_s != 0.0 else 0.0
    change = lateral_mps2 - speed_mps * rate
    if math.isnan(change) or growth_nmps == 0.0:
        return no_yaw(faded)
    if unequal_s == 0.0:
        part = dt_s / (min(b.known_s, STRAIGHT_S) + dt_s)
        straight = b.straight_radps + part * (rate - b.straight_radps)
        level = b.level_mps2 + part * (change - b.level_mps2)
        return YawState(straight, b.known_s + dt_s, rate, 0.0, level, 0.0, 0.0, False, 0.0, 0.0, False)
    same = b.same_s + dt_s if rate == b.shown_radps else 0.0
    change -= b.level_mps2
    aside = (b.aside_mps + change * dt_s) / (1.0 + dt_s / ASIDE_S)
    side = math.copysign(1.0, unequal_s)
    shown = side * (rate - b.straight_radps)
    turned = b.turned_rad + shown * dt_s
    apart = max(side * change - FELT_MPS2, 0.0) + min(side * change + NOT_YET_FELT_MPS2, 0.0)
    by_mps = max(speed_mps, LEAST_MPS)
    towards = shown + apart / by_mps
    agreed = same <= SAME_S and turned >= ASTRAY_RAD and abs(aside) <= max(ASIDE_MPS, ASIDE_RAD * speed_mps)
    known = b.known_s if agreed else 0.0
    found = abs(unequal_s) <= TURNED_WITHIN_S and turned > TURNED_RAD
    believed = known >= KNOWN_S and (b.believed or found)
    lost = (b.believed or b.lost) and not believed
    if lost:
        towards = shown + min(side * change, 0.0) / by_mps
    extra = faded
    if believed and braking:
        calm = towards * by_mps / CALM_MPS2
        pace = 1.0 - calm if calm > 0.0 else max(1.0 + calm / CAUGHT, 0.0)
        extra = min(max(b.extra_nm + pace * growth_nmps * dt_s, 0.0), MOST_NM)
    return YawState(b.straight_radps, known, rate, same, b.level_mps2, aside, turned, believed, towards, extra, lost)


@kernel
def with_yaw(
    front_nm: tuple[float, float], rear_nm: tuple[float, float], unequal_s: float, yaw: YawState
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Yaw moments that more torque left, and more torque right, may have, with what the yaw rate adds or takes."""
    damping = DAMPING_NMS if yaw.believed else LOST_DAMPING_NMS if yaw.lost else 0.0
    damped = damping * max(yaw.towards_radps, 0.0)
    rear = REAR_PART * max(yaw.extra_nm - damped, 0.0)
    front = yaw.extra_nm - damped
    if unequal_s > 0.0:
        return (max(front_nm[0] + front, 0.0), front_nm[1]), (rear_nm[0] + rear, rear_nm[1])
    if unequal_s < 0.0:
        return (front_nm[0], max(front_nm[1] + front, 0.0)), (rear_nm[0], rear_nm[1] + rear)
    return front_nm, rear_nm
