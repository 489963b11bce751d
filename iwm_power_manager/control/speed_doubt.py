# SPDX-License-Identifier: Apache-2.0
"""Whether the speed sensor is believed: against the reference, and against four wheels that roll freely."""

from __future__ import annotations

import math
from typing import NamedTuple

from iwm_power_manager.control.types import Compared, MotionState, Wheels
from iwm_power_manager.control.wheel_doubt import (
    DISTRUST_S,
    ICE_FRICTION,
    SLOW_MPS,
    SPEED_MPS,
    SPEED_PART,
    WORN_PART,
    Turning,
    clamped,
    combined_factor,
    mean_of,
)
from iwm_power_manager.jit import kernel

#: Wheels that are this near to what the sensor shows confirm it.
CONFIRMED_PART, CONFIRMED_MPS = 0.02, 0.15
#: A sensor that shows the same number for this long while the reference moved by this is stuck.
STUCK_S, STUCK_MPS = 0.05, 0.3
#: Wheels that agree this well and take less than this part of their load from the road are rolling; a speed sensor that
#: is this far from them for this long is not believed.
AGREE_PART, AGREE_MPS = 0.04, 0.3
ROLLING_FRICTION = 0.08
#: Below the second torque or this speed, m/s, what they slip makes no wrong speed of them.
NEARLY_FRICTION, NEARLY_MPS = 0.15, 4.0
APART_PART, APART_MPS, APART_S = 0.05, 0.5, 0.1
#: A sensor and wheels that differ by no more than this may both be right: tyres, or a wrong radius.
LEAST_PART = 0.72
#: Sensor and wheels are compared when these first roll freely, or differ from it against their torques, for this long
#: and faster than this: slower, a sensor that is off by a few tenths of a m/s would look like one that is wrong by a
#: factor, and beyond the last speed one that is off by 5 m/s, where the wheels are believed.
COMPARED_S, COMPARED_MPS, COMPARED_MOST_MPS = 0.2, 2.0, 12.5
#: From then on what the wheels show more or less than the sensor is taken off them at the last rate, 1/s, between the
#: first two and a part of the speed, above a speed: be it tyres or the sensor, so slip is slip.
WORN_LEAST_PART, WORN_LEAST_MPS, WORN_MOST_PART, WORN_FROM_MPS, WORN_RATE_PER_S = 0.015, 0.05, 0.1, 4.0, 0.05


class Rolling(NamedTuple):
    """What the wheels that are believed say: how many, their rim speeds' extremes and mean, and whether they roll.

    `freely` is without slip that would show; `nearly` is with less than makes a wrong speed of it. `pushed` is 1 or -1
    where all four have the torque that makes them slip together, faster or slower than the car, on the smoothest ice.
    """

    believed: int
    low_mps: float
    high_mps: float
    mean_mps: float
    freely: bool
    nearly: bool
    pushed: float


@kernel
def _pushed(t: Turning) -> float:
    nm, front_nm, rear_nm = t.torque_nm, ICE_FRICTION * t.front_nm, ICE_FRICTION * t.rear_nm
    if min(nm[0], nm[1]) >= front_nm and min(nm[2], nm[3]) >= rear_nm:
        return 1.0
    return -1.0 if max(nm[0], nm[1]) <= -front_nm and max(nm[2], nm[3]) <= -rear_nm else 0.0


@kernel
def used_friction_of(torque_nm: Wheels, t: Turning) -> float:
    """The largest of four torques at the wheels, as part of the wheel's load."""
    front_nm, rear_nm = max(abs(torque_nm[0]), abs(torque_nm[1])), max(abs(torque_nm[2]), abs(torque_nm[3]))
    return max(front_nm / t.front_nm, rear_nm / t.rear_nm)


@kernel
def rolling_of(rims: Wheels, doubt_s: Wheels, turning: Turning) -> Rolling:
    """What the wheels that are believed show as they roll."""
    count = 0
    low = math.inf
    high = -math.inf
    total = 0.0
    for i in range(4):
        if doubt_s[i] == 0.0:
            count += 1
            low = min(low, rims[i])
            high = max(high, rims[i])
            total += rims[i]
    used = used_friction_of(turning.road_nm, turning)
    agree = count >= 3 and high - low <= AGREE_PART * abs(high) + AGREE_MPS
    mean = total / max(count, 1)
    nearly = agree and (used < NEARLY_FRICTION or abs(high) < NEARLY_MPS)
    return Rolling(count, low, high, mean, agree and used < ROLLING_FRICTION, nearly, _pushed(turning))


@kernel
def _same(shown: float, mean_mps: float) -> bool:
    return abs(shown - mean_mps) <= CONFIRMED_PART * abs(shown) + CONFIRMED_MPS


@kernel
def is_confirmed(shown: float, rolling: Rolling) -> bool:
    """Whether the wheels confirm a speed."""
    return rolling.believed >= 3 and _same(shown, rolling.mean_mps)


class _Sensor(NamedTuple):
    """The speed sensor after judgement: as in `MotionState`, with the speed that is predicted now."""

    predicted_mps: float
    shown_s: float
    moved_mps: float
    apart_s: float
    doubt_s: float


@kernel
def judged_speed(
    shown: float, predicted: float, acceleration: float, dt: float, before: MotionState, rolling: Rolling
) -> _Sensor:
    """Whether the speed sensor is believed."""
    if math.isnan(shown):
        return _Sensor(predicted, 0.0, 0.0, 0.0, before.doubt_s)
    same = shown == before.shown_mps
    shown_s = before.shown_s + dt if same else 0.0
    moved = before.moved_mps + acceleration * dt if same else 0.0
    apart = 0.0
    over = rolling.mean_mps - shown
    if rolling.freely and rolling.pushed * over <= 0.0 and abs(over) > APART_PART * abs(rolling.mean_mps) + APART_MPS:
        apart = before.apart_s + dt
        if apart > APART_S and before.doubt_s == 0.0:
            predicted = rolling.mean_mps  # four against one, and nothing that could make them slip
    tolerance = SPEED_PART * abs(predicted) + SPEED_MPS
    error = abs(shown - predicted)
    far = error > tolerance and abs(predicted) > SLOW_MPS
    doubt = before.doubt_s
    # Where the wheels show the same it is the car that keeps its speed.
    stuck = shown_s > STUCK_S and abs(moved) > STUCK_MPS and not is_confirmed(shown, rolling)
    if far or apart > APART_S or stuck:
        doubt = DISTRUST_S
    elif error <= 0.5 * tolerance:
        doubt = max(doubt - dt, 0.0)
    return _Sensor(predicted, shown_s, moved, apart, doubt)


@kernel
def compared_speeds(
    shown: float,
    rims: Wheels,
    t: Turning,
    apart_s: float,
    factor: float,
    before: Compared,
    all_believed: bool,
    dt: float,
) -> tuple[Compared, float, bool]:
    """What sensor and wheels have said of each other by now, the wheels' factor, and whether all begins anew by it."""
    mean = mean_of(rims)
    slow = math.isnan(shown) or min(abs(shown), abs(mean)) <= COMPARED_MPS or shown * mean < 0.0
    agree = max(rims) - min(rims) <= AGREE_PART * abs(mean) + AGREE_MPS
    freely = used_friction_of(t.road_nm, t) < ROLLING_FRICTION and _pushed(t) * (mean - shown) <= 0.0
    if slow or not agree or not (freely or mean_of(t.torque_nm) * (mean - shown) < 0.0):
        return before, factor, False
    if before.lasted_s >= COMPARED_S:
        # Wheels that show by themselves what the sensor does are right again; a wrong sensor is not wrong by a factor.
        # While a torque turns, the road takes next to nothing for a moment.
        still = freely and used_friction_of(t.torque_nm, t) < ROLLING_FRICTION
        over = still and _unsure(before) and (_same(shown, mean / factor) or apart_s > APART_S)
        if over:
            return Compared(1.0, before.lasted_s), 1.0, True
        # By the sign of the road's force, which is that of the slip: a torque may have turned just now.
        no_slip = mean_of(t.road_nm) * (mean - shown) < 0.0 or used_friction_of(t.road_nm, t) < ICE_FRICTION
        return before, _worn(shown - mean, mean, factor, dt) if all_believed and no_slip else factor, False
    lasted_s = before.lasted_s + dt
    ratio = before.ratio + dt / lasted_s * (shown / mean - before.ratio)
    if lasted_s < COMPARED_S:
        return Compared(ratio, lasted_s), factor, False
    same = abs(ratio - 1.0) <= WORN_PART
    if same or not LEAST_PART < ratio < 1.0 / LEAST_PART or abs(mean) > COMPARED_MOST_MPS:
        ratio = 1.0
    return Compared(ratio, lasted_s), combined_factor(factor, ratio), not same


@kernel
def _worn(over: float, mean: float, factor: float, dt: float) -> float:
    """The wheels' factor, with a little of a small difference to the sensor taken off."""
    size, off = abs(mean), abs(over)
    if size <= WORN_FROM_MPS or not WORN_LEAST_PART * size + WORN_LEAST_MPS < off < WORN_MOST_PART * size:
        return factor
    after = factor * (1.0 + clamped(over / mean, WORN_RATE_PER_S * dt))
    return after if abs(after - 1.0) <= WORN_MOST_PART else factor


@kernel
def _unsure(compared: Compared) -> bool:
    """Whether sensor and wheels have differed by a factor from the start on."""
    return compared.lasted_s >= COMPARED_S and compared.ratio != 1.0


@kernel
def lower_part_of(shown: float, reference: float, trusted: bool, compared: Compared) -> float:
    """The lower of two speeds, as part of the one used, where nothing tells which of them is wrong; else 1."""
    part = 1.0
    if _unsure(compared):
        part = min(1.0 / compared.ratio, 1.0)
    if not (trusted or math.isnan(shown)) and abs(reference) > SLOW_MPS:
        ratio = shown / reference
        if LEAST_PART < ratio < 1.0:
            part = min(part, ratio)
    return part
