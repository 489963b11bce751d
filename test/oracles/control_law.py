# SPDX-License-Identifier: Apache-2.0
"""The control law in plain Python, wheel by wheel, as the rules are stated and not as the kernel computes them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from iwm_power_manager.control import types as t
from iwm_power_manager.control.settings import GATE_MODE_LIMITER, GATE_MODE_OFF, GATE_MODE_TABLE2
from oracles.physics import regeneration_limit, slip, torque_limit
from oracles.step import electrical_w, friction_coefficient

LEAST_SLIP_SPEED = 0.3
NOTHING = 1e-6


def low_pass(before, value, dt, constant):
    """Implicit first-order lag: (y - before) / dt = (value - y) / constant."""
    return value if constant == 0.0 else (before / dt + value / constant) / (1.0 / dt + 1.0 / constant)


def slewed(before, target, dt, up, down, regeneration):
    """Walk from `before` to `target`, by way of zero where they differ in sign, until the time is up."""
    value, left = before, dt
    for goal in (0.0, target) if before * target < 0.0 else (target,):
        outwards = abs(goal) > abs(value)
        rate = (up if goal > 0.0 else regeneration) if outwards else down
        reach = rate * left
        if abs(goal - value) > reach:
            return value + math.copysign(reach, goal - value)
        left -= abs(goal - value) / rate
        value = goal
    return value


def grip(braking, road, wheel, speed, target, settings, axle):
    """Torque that brings a wheel to the target slip within the limiter's time, against what the road takes."""
    if braking and speed < settings.slip_speed_floor_mps:
        return math.inf
    if braking:
        rim = max(min(speed * (1.0 - target), speed - LEAST_SLIP_SPEED), 0.0)
    else:
        rim = max(speed / (1.0 - target), speed + LEAST_SLIP_SPEED)
    change = (rim / axle.wheel.radius_m - wheel) / settings.slip_limiter_s
    torque = road + axle.wheel.inertia_kgm2 * change
    return max(-torque if braking else torque, 0.0)


def at_least(i, before, vehicle, near):
    """Torque that the road takes at least from a wheel if it is the one that the others run over; `near` an edge."""
    chassis = vehicle.chassis
    axles = (vehicle.front, vehicle.front, vehicle.rear, vehicle.rear)
    length = chassis.front_axle_to_cg_m + chassis.rear_axle_to_cg_m
    pushed = sum(wheel.road_nm / axle.wheel.radius_m for wheel, axle in zip(before, axles, strict=True))
    shares = (chassis.rear_axle_to_cg_m, chassis.front_axle_to_cg_m)
    forces = [share * chassis.mass_kg * 9.81 for share in shares]
    forces = [forces[0] - chassis.cg_height_m * pushed, forces[1] + chassis.cg_height_m * pushed]
    loads = [max(force / 2.0 / length, 0.05 * chassis.mass_kg * 9.81) for force in forces for _ in range(2)]
    slips = [abs(wheel.slip) for wheel in before]
    used = [
        min(
            abs(before[k].road_nm) / loads[k] / axles[k].wheel.radius_m,
            friction_coefficient(slips[k], 1.2, axles[k].tyre),
        )
        for k in range(4)
    ]
    beside, along, across = i ^ 1, i ^ 2, i ^ 3
    whole = before[i].gated

    def part(one, two):
        """Of the grip of `two`, what `one` has at least: on the way to the peak by its slip, beyond by its tyre."""
        if slips[one] < slips[two]:
            return slips[one] / slips[two]
        own, other = (friction_coefficient(slips[k], 1.0, axles[k].tyre) for k in (one, two))
        return 1.0 if own >= other else own / other

    found = used[along] * part(i, along) * (1.0 if whole else 0.8)
    edges = (
        (used[along], 0.5 * used[i]),
        (used[along], 0.8 * used[across]),
        (slips[across], 0.8 * slips[along]),
    )
    near |= {abs(x - y) <= 1e-9 * max(x, y) for x, y in edges}
    if used[along] > 0.5 * used[i] and all(x >= y for x, y in edges):
        told = used[across] and used[across] / part(across, beside) / 0.8
        found = max(found, min(used[beside], told) * (1.0 if whole else 0.8))
    return found * loads[i] * axles[i].wheel.radius_m


def keeps_slip(braking, wheels, i, m, before, settings, vehicle):
    """Whether a wheel slips with next to no torque: with less than a twentieth of its share of the weight, or, alone of
    its axle, with less than the road gives the others.
    """
    if not (braking or (settings.gate_driving and m.power_demand_w > 0.0)):
        return False
    wheel, other = wheels[i], wheels[i ^ 1]
    radius = wheel.axle.wheel.radius_m
    slipped = abs(m.speed_mps - radius * wheel.speed)
    slower = m.speed_mps > radius * wheel.speed
    more = radius * (other.speed - wheel.speed) * (1.0 if braking else -1.0)
    held = 0.02 * m.speed_mps + 0.1
    little = 0.05 * vehicle.chassis.mass_kg * 9.81 / 4.0 * radius
    near = set()
    if more > held:
        little = max(little, at_least(i, before, vehicle, near))
    largest = max(wheel.grip, abs(wheel.road))
    edges = ((largest, little), (slipped, held), (more, held))
    wheel.doubtful |= any(near) or any(abs(x - y) <= 1e-9 * max(abs(x), abs(y)) for x, y in edges)
    return largest < little and slower == braking and slipped > held


def yaw_speed_factor(speed, settings):
    """What the speed makes of a yaw budget."""
    return min(settings.yaw_speed_mps / max(speed, 0.06), 2.0) ** 2


def known_yaw(m, state, settings):
    """What is remembered of the yaw rate: what it was before, whether it is believed, and what it adds."""
    was, unequal, rate, dt = state.yaw, state.front_unequal_s, m.yaw_rate_radps, m.dt_s
    slipping = m.lateral_mps2 - max(m.speed_mps, 0.0) * rate
    firm = max(side.friction for side in (state.friction.left, state.friction.right))
    growth = settings.yaw_rate_growth_nmps * min(1.0, yaw_speed_factor(m.speed_mps, settings)) * firm / 0.48
    alike = -0.03 <= unequal <= 0.03
    unknown = was._replace(
        straight_radps=0.0,
        known_s=0.0,
        shown_radps=0.0,
        same_s=0.0,
        level_mps2=0.0,
        aside_mps=0.0,
        turned_rad=0.0,
        believed=False,
        towards_radps=0.0,
    )
    left = was.extra_nm - (20000.0 * max(0.0, was.towards_radps) if was.believed else 0.0)
    faded = 0.0 if alike else max(0.0, left - dt * growth)
    unknown = unknown._replace(lost=False)
    if slipping != slipping or growth == 0.0:
        return unknown._replace(extra_nm=faded)
    if alike:
        heard = min(was.known_s, 0.5)
        mean, level = (
            (heard * old + dt * new) / (heard + dt)
            for old, new in ((was.straight_radps, rate), (was.level_mps2, slipping))
        )
        known = was.known_s + dt
        return unknown._replace(straight_radps=mean, known_s=known, shown_radps=rate, level_mps2=level, extra_nm=0.0)
    slipping -= was.level_mps2
    to_left = rate - was.straight_radps
    turning = to_left if unequal > 0.0 else -to_left
    felt = slipping if unequal > 0.0 else -slipping
    by_speed = max(m.speed_mps, 10.0)
    towards = turning + (felt - min(max(felt, -1.0), 0.2)) / by_speed
    now = was._replace(
        shown_radps=rate,
        same_s=was.same_s + dt if rate == was.shown_radps else 0.0,
        aside_mps=low_pass(was.aside_mps, slipping, dt, 1.0),
        turned_rad=was.turned_rad + dt * turning,
        towards_radps=towards,
        extra_nm=faded,
    )
    if now.same_s > 0.1 or now.turned_rad < -0.15 or abs(now.aside_mps) > max(0.7, 0.03 * m.speed_mps):
        now = now._replace(known_s=0.0)
    turned_at_first = -1.0 <= unequal <= 1.0 and now.turned_rad > 0.004
    now = now._replace(believed=now.known_s >= 0.25 and (was.believed or turned_at_first))
    now = now._replace(lost=not now.believed and (was.lost or was.believed))
    if now.lost:
        now = now._replace(towards_radps=turning + min(0.0, felt / by_speed))
    if now.believed and m.power_demand_w < 0.0:
        pace = 1.0 - 2.0 * towards * by_speed if towards > 0.0 else max(0.0, 1.0 + 0.5 * towards * by_speed)
        now = now._replace(extra_nm=min(1500.0, max(0.0, was.extra_nm + dt * growth * pace)))
    return now


def driven_slip_targets(slips, speed, gains, settings):
    """The same while driving.

    A front wheel beside one with a weaker motor follows that one's slip, the rear ones, if both slip and any motor is
    weak, those of both front ones; down to what goes with the speed.
    """
    ratio = settings.yaw_speed_mps / max(speed, 0.06)
    targets = [settings.slip_target] * 4
    for wheel, other in ((0, 1), (1, 0)):
        if gains[other] < gains[wheel]:
            targets[wheel] = max(0.01 * ratio**2, slips[other])
    if any(gain < 1.0 for gain in gains) and all(slip * speed > 0.3 for slip in slips[2:]):
        least = settings.unequal_rear_slip_target * (ratio if ratio > 1.0 else ratio**2)
        targets[2:] = [max(least, min(slips[:2]))] * 2
    return [min(target, settings.slip_target) for target in targets]


def slip_targets(state, slips, speed, demand, gains, believed, settings, vehicle):
    """Slip the limiter steers each wheel to: less while left and right are braked unequally, or a motor is weak.

    Less of that where a yaw rate is believed. Else, faster than 10 m/s, rear wheels that slip follow the front ones,
    if those have brakes and no more than 4 m/s2 are asked for.
    """
    if demand >= 0.0:
        return driven_slip_targets(slips, speed, gains, settings)
    unequal = state.front_unequal_s
    if -0.03 <= unequal <= 0.03:
        front = rear = settings.slip_target
        whole = vehicle.front.friction_brake.max_torque_nm > 0.0 and not any(
            gain < 1.0 for gain in state.motion.brake_gain[:2]
        )
        both_slip = all(-slip * speed > 0.3 for slip in slips[2:])
        gentle = demand >= -4.0 * vehicle.chassis.mass_kg * speed
        if gentle and not unequal and whole and both_slip and 2.0 * speed > settings.yaw_speed_mps:
            allowed = settings.unequal_rear_slip_target * max(settings.yaw_speed_mps / speed, 1.0)
            rear = min(rear, max(allowed, min(-slip for slip in slips[:2])))
        return [front, front, rear, rear]
    high, rear = settings.unequal_slip_target, settings.unequal_rear_slip_target
    if believed:
        high, rear = max(high, 0.1), max(rear, 0.06)
    front = [high, settings.unequal_low_slip_target]
    front = front if unequal > 0.0 else front[::-1]
    return [min(target, settings.slip_target) for target in (*front, rear, rear)]


def yaw_budget(name, state, settings, speed, braking, yaw):
    """Yaw moment that more torque left may have, and more torque right; `yaw` is what is known of the yaw rate."""
    now, growth, most = (getattr(settings, f"{name}_yaw_{part}") for part in ("nm", "growth_nmps", "most_nm"))
    if not braking:
        return [most, most]
    factor = yaw_speed_factor(speed, settings)
    unequal, lasting = getattr(state, f"{name}_unequal_s"), state.front_unequal_s
    damping = 20000.0 if yaw.believed else 10000.0 if yaw.lost else 0.0
    added = yaw.extra_nm - damping * max(yaw.towards_radps, 0.0)
    if name == "rear":
        added = 0.3 * max(added, 0.0)
    return [
        max(
            min(factor * (now + growth * max(side * unequal, 0.0)), most) + (added if side * lasting > 0.03 else 0.0),
            0.0,
        )
        for side in (1.0, -1.0)
    ]


def battery_factor(torques, speeds, discharge, charge, motors):
    """Largest part of the torques inside the battery's limits, from the roots of the parabola the power is in it."""
    wheels = list(zip(torques, speeds, motors, strict=True))
    if -charge <= sum(electrical_w(x, w, motor) for x, w, motor in wheels) <= discharge:
        return 1.0, ""
    square = linear = constant = 0.0
    for x, w, motor in wheels:
        if x == 0.0:
            constant += electrical_w(0.0, w, motor)
            continue
        square += motor.loss_quadratic_torque * x * x
        linear += x * w + motor.loss_linear_torque * abs(x)
        constant += motor.loss_constant_w + motor.loss_linear_speed * w + motor.loss_quadratic_speed * w * w
    charging = square + linear + constant < -charge
    level = -charge if charging else discharge
    if charge == discharge == 0.0:
        return 0.0, "charge" if charging else "discharge"
    if not charging and constant > discharge:
        # A motor turned against its torque may feed the losses of another torque than the one asked for: any factor
        # inside the limits is right then, and so is none.
        dips = square > 0.0 and constant - linear * linear / (4.0 * square) <= discharge and linear < 0.0
        return (math.nan if dips else 0.0), "discharge"
    if square == 0.0:
        return (level - constant) / linear, "charge" if charging else "discharge"
    half, rest = linear / (2.0 * square), (constant - level) / square
    root = math.sqrt(max(half * half - rest, 0.0))
    # Charging leaves its limit at the first crossing on the way from zero torque, discharging at the last.
    return (-half - root if charging else -half + root), "charge" if charging else "discharge"


@dataclass
class Wheel:
    """One wheel in one step."""

    speed: float
    axle: object
    before: t.WheelState
    target: float
    gain: float
    stuck: float
    gated: bool = False
    held: bool = False
    doubtful: bool = False  # so near to its edge that rounding decides
    slip: float = 0.0
    road: float = 0.0
    room: float = 0.0
    own: float = 0.0  # room without the axle's budget
    most: float = 0.0
    grip: float = math.inf
    conversion: float = 0.0
    total: float = 0.0
    motor: float = 0.0
    friction: float = 0.0

    @property
    def fast(self):
        return max(self.speed, self.conversion)


@dataclass
class Pair:
    """The wheels of one axle, and what they have together."""

    wheels: list
    unequal_s: float
    budget: list
    unequal: bool = False
    short: bool = False
    asked: float = 0.0
    given: float = 0.0

    @property
    def slip(self):
        left, right = (wheel.slip for wheel in self.wheels)
        return left if abs(left) > abs(right) else right

    @property
    def gated(self):
        return all(wheel.gated for wheel in self.wheels)

    @property
    def capacity(self):
        return sum(wheel.conversion * wheel.most for wheel in self.wheels)


def step(m, state, settings, vehicle, decide):
    """Both axles, applied and decided share, limit bits; `decide` is the strategy, called with the two slips."""
    first = state.steps == 0
    braking = m.power_demand_w < 0.0
    bits = set()
    yaw = known_yaw(m, state, settings)
    slips = []
    for i, (speed, before) in enumerate(zip(m.wheel_speed_radps, state.wheels, strict=True)):
        radius = (vehicle.front if i < 2 else vehicle.rear).wheel.radius_m
        now = slip(speed, m.speed_mps, radius, settings.slip_speed_floor_mps)
        slips.append(now if first else low_pass(before.slip, now, m.dt_s, settings.slip_filter_s))
    targets = slip_targets(state, slips, m.speed_mps, m.power_demand_w, m.motor_gain, yaw.believed, settings, vehicle)
    standing = braking and m.speed_mps < settings.slip_speed_floor_mps
    wheels = [
        Wheel(speed, vehicle.front if i < 2 else vehicle.rear, state.wheels[i], targets[i], *gains, slip=slips[i])
        for i, (speed, *gains) in enumerate(zip(m.wheel_speed_radps, m.motor_gain, m.motor_stuck_nm, strict=True))
    ]
    front, rear = axles = [
        Pair(
            wheels[k : k + 2],
            getattr(state, f"{name}_unequal_s"),
            yaw_budget(name, state, settings, m.speed_mps, braking, yaw),
        )
        for k, name in ((0, "front"), (2, "rear"))
    ]

    for k, wheel in enumerate(wheels):
        if not first:
            other = wheels[k ^ 1]
            alike = abs(wheel.speed - other.speed) * wheel.axle.wheel.radius_m < 0.3
            change = (wheel.speed - wheel.before.speed_radps) / m.dt_s
            if alike:  # the mean of both says it better
                change = 0.5 * (change + (other.speed - other.before.speed_radps) / m.dt_s)
            # Wheels of one speed to the last bit: one stands in for the other, and the road is the mean of both.
            both = [wheel, other] if wheel.speed == other.speed else [wheel]
            taken = [one.before.total_nm - wheel.axle.wheel.inertia_kgm2 * change for one in both]
            roads = [
                low_pass(one.before.road_nm, t, m.dt_s, settings.slip_filter_s)
                for one, t in zip(both, taken, strict=True)
            ]
            wheel.road = sum(roads) / len(roads)

    memory = state.split
    decided = memory.decided_share
    if first or memory.age_s + 1.5 * m.dt_s >= settings.decision_period_s:
        decided = decide(front.slip, rear.slip)
    share = decided
    if not first:
        most = settings.share_rate_per_s * m.dt_s
        share = memory.applied_share + min(max(decided - memory.applied_share, -most), most)

    floor = vehicle.driver.power_speed_floor_mps
    for k, axle in enumerate(axles):
        for i, wheel in enumerate(axle.wheels, start=2 * k):
            own = axle.slip if settings.gate_mode == GATE_MODE_TABLE2 else wheel.slip
            edge = settings.critical_slip - (settings.gate_hysteresis if wheel.before.gated else 0.0)
            if settings.gate_mode == GATE_MODE_LIMITER and not braking:
                rim = max(wheel.speed * wheel.axle.wheel.radius_m, m.speed_mps, settings.slip_speed_floor_mps)
                edge *= max(0.375 / settings.critical_slip / rim, 1.0)
            wheel.doubtful = abs(abs(own) - edge) < 1e-12
            if settings.gate_mode != GATE_MODE_OFF and m.power_demand_w != 0.0 and not standing:
                spinning = settings.gate_driving and not braking and own > edge
                wheel.gated = spinning or (braking and -own > edge)
            held = max(m.speed_mps * (1.0 - settings.critical_slip), floor) / wheel.axle.wheel.radius_m
            turning = min(wheel.speed, 1.12 * m.speed_mps / wheel.axle.wheel.radius_m) if braking else wheel.speed
            wheel.conversion = max(turning, held)
            weakest = wheel.gain * regeneration_limit(wheel.fast, m.speed_mps, wheel.before.heat, wheel.axle.motor)
            brake = wheel.axle.friction_brake.max_torque_nm or weakest
            strongest = wheel.gain * torque_limit(wheel.fast, wheel.before.heat, wheel.axle.motor)
            # A motor that is stuck driving drives, and its brake sees to how much, unless the wheel lags by it.
            wheel.held = not braking and wheel.stuck > 0.0 and -wheel.slip * m.speed_mps < 0.3
            if wheel.held:
                strongest = max(strongest, wheel.stuck)
            wheel.room = brake if braking else strongest
            if settings.gate_mode == GATE_MODE_LIMITER:
                wheel.grip = grip(braking, wheel.road, wheel.speed, m.speed_mps, wheel.target, settings, wheel.axle)
                wheel.gated |= keeps_slip(braking, wheels, i, m, state.wheels, settings, vehicle)
            wheel.gated &= not wheel.held
            wheel.own = wheel.most = 0.0 if wheel.gated else min(wheel.room, wheel.grip)
        geometry = axle.wheels[0].axle
        mosts = [wheel.most for wheel in axle.wheels]
        for wheel, other, moment in zip(axle.wheels, mosts[::-1], axle.budget, strict=True):
            wheel.most = min(wheel.most, other + 2.0 * moment * geometry.wheel.radius_m / geometry.track_width_m)

    parts = {(False, False): (share, 1.0 - share), (True, False): (0.0, 1.0), (False, True): (1.0, 0.0)}
    parts = parts.get((front.gated, rear.gated), (0.0, 0.0))
    front.asked, rear.asked = (part * abs(m.power_demand_w) for part in parts)
    for axle in axles:
        axle.given = min(axle.asked, axle.capacity)
    for axle in reversed(axles):
        axle.given += max(min(front.asked + rear.asked - front.given - rear.given, axle.capacity - axle.given), 0.0)

    missing = front.asked + rear.asked - front.given - rear.given
    for axle in axles:
        weak, strong = sorted(axle.wheels, key=lambda wheel: wheel.most)
        equal = axle.given / (weak.conversion + strong.conversion)
        low = min(equal, weak.most)
        high = (axle.given - low * weak.conversion) / strong.conversion if low < equal else equal
        weak.total, strong.total = (-low, -high) if braking else (low, high)
        all_short = max(missing, axle.asked - axle.given) > 1e-12 * abs(m.power_demand_w)
        axle.short, axle.unequal = all_short, low != high
        weak.doubtful |= abs(equal - weak.most) <= 1e-9 * max(equal, 1.0)
        for wheel in axle.wheels:
            _torque(wheel, all_short or (wheel is weak and low < high), braking, m, settings, bits)

    factor, side = battery_factor(
        [wheel.motor for wheel in wheels],
        [wheel.speed for wheel in wheels],
        m.discharge_limit_w,
        m.charge_limit_w,
        [wheel.axle.motor for wheel in wheels],
    )
    if side:
        bits.add(t.LIMIT_BATTERY_CHARGE if side == "charge" else t.LIMIT_BATTERY_DISCHARGE)
    for wheel in wheels:
        wheel.motor *= factor
        if wheel.held or (braking and not wheel.gated):
            # Whatever the motor does, wheel and brake together brake as asked.
            delivered = wheel.gain * wheel.motor + wheel.stuck
            wheel.friction = -min(max(delivered - wheel.total, 0.0), wheel.axle.friction_brake.max_torque_nm)
    return axles, share, decided, bits


def _torque(wheel, short, braking, m, settings, bits):
    """Motor torque of one wheel before the battery's limits."""
    motor, heat = wheel.axle.motor, wheel.before.heat
    if not wheel.gated and short:
        if wheel.grip < wheel.room:
            bits.add(t.LIMIT_SLIP)
        elif braking:
            bits.add(t.LIMIT_FRICTION_BRAKE if wheel.axle.friction_brake.max_torque_nm else t.LIMIT_REGENERATION)
        else:
            bits.add(t.LIMIT_MOTOR)
            if wheel.room < torque_limit(wheel.fast, 0.0, motor):
                bits.add(t.LIMIT_THERMAL)
    weakest = regeneration_limit(wheel.fast, m.speed_mps, heat, motor)
    wanted = max(wheel.total, -wheel.gain * weakest) if braking else wheel.total
    if wanted > wheel.total:
        bits.add(t.LIMIT_REGENERATION)
    strongest = torque_limit(wheel.fast, heat, motor)
    # A motor that gives a part is commanded the more, and one that gives nothing nothing.
    wanted, grip = (x / wheel.gain if wheel.gain else 0.0 for x in (wanted, wheel.grip))
    if braking:
        weakest = min(weakest, grip)
    else:
        strongest = min(strongest, grip)
    way = slewed(
        wheel.before.motor_nm,
        wanted,
        m.dt_s,
        settings.slew_up_nmps,
        settings.slew_down_nmps,
        settings.slew_regeneration_nmps,
    )
    wheel.motor = 0.0 if wheel.gated or not wheel.gain else min(max(way, -weakest), strongest)
    if abs(wheel.motor) <= NOTHING:
        wheel.motor = 0.0
    if abs(wheel.motor - wanted) > NOTHING:
        bits.add(t.LIMIT_SLEW)
