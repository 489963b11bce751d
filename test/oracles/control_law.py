"""The control law in plain Python, axle by axle, as the rules are stated and not as the kernel computes them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from iwm_power_manager.control import types as t
from iwm_power_manager.control.settings import GATE_MODE_LIMITER, GATE_MODE_OFF
from oracles.physics import regeneration_limit, slip, torque_limit
from oracles.step import electrical_w

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


def grip(braking, road, wheel, speed, settings, vehicle):
    """Torque that brings a wheel to the target slip within the limiter's time, against what the road takes."""
    if braking and speed < settings.slip_speed_floor_mps:
        return math.inf
    if braking:
        rim = max(min(speed * (1.0 - settings.slip_target), speed - LEAST_SLIP_SPEED), 0.0)
    else:
        rim = max(speed / (1.0 - settings.slip_target), speed + LEAST_SLIP_SPEED)
    change = (rim / vehicle.front.wheel.radius_m - wheel) / settings.slip_limiter_s
    torque = road + vehicle.front.wheel.inertia_kgm2 * change
    return max(-torque if braking else torque, 0.0)


def battery_factor(torques, speeds, discharge, charge, motor):
    """Largest part of the torques inside the battery's limits, from the roots of the parabola the power is in it."""
    if -charge <= sum(2.0 * electrical_w(x, w, motor) for x, w in zip(torques, speeds, strict=True)) <= discharge:
        return 1.0, ""
    square = linear = constant = 0.0
    for x, w in zip(torques, speeds, strict=True):
        if x == 0.0:
            constant += 2.0 * electrical_w(0.0, w, motor)
            continue
        square += 2.0 * motor.loss_quadratic_torque * x * x
        linear += 2.0 * (x * w + motor.loss_linear_torque * abs(x))
        constant += 2.0 * (motor.loss_constant_w + motor.loss_linear_speed * w + motor.loss_quadratic_speed * w * w)
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
class Axle:
    """One axle in one step."""

    wheels: tuple[float, float]
    motor_before: float
    total_before: float
    speed_before: float
    road_before: float
    slip_before: float
    was_gated: bool
    heat: float
    gated: bool = False
    doubtful: bool = False  # so near to its edge that rounding decides
    slip: float = 0.0
    road: float = 0.0
    asked: float = 0.0
    room: float = 0.0
    most: float = 0.0
    grip: float = math.inf
    given: float = 0.0
    conversion: float = 0.0
    total: float = 0.0
    motor: float = 0.0
    friction: float = 0.0

    @property
    def speed(self):
        return 0.5 * sum(self.wheels)

    @property
    def fast(self):
        return max(*self.wheels, self.conversion)


def step(m, state, settings, vehicle, decide):
    """Both axles, applied and decided share, limit bits; `decide` is the strategy, called with the two slips."""
    motor, brake, radius = vehicle.front.motor, vehicle.front.friction_brake, vehicle.front.wheel.radius_m
    wheels = m.wheel_speed_radps
    first = state.steps == 0
    axles = [
        Axle(
            pair,
            *(
                getattr(state, f"{name}_{what}")
                for what in ("motor_nm", "total_nm", "speed_radps", "road_nm", "slip", "gated", "heat")
            ),
        )
        for name, pair in (("front", wheels[:2]), ("rear", wheels[2:]))
    ]
    braking = m.power_demand_w < 0.0
    bits = set()

    for axle in axles:
        slips = [slip(w, m.speed_mps, radius, settings.slip_speed_floor_mps) for w in axle.wheels]
        worst = slips[0] if abs(slips[0]) > abs(slips[1]) else slips[1]
        axle.slip = worst if first else low_pass(axle.slip_before, worst, m.dt_s, settings.slip_filter_s)
        if not first:
            taken = axle.total_before - vehicle.front.wheel.inertia_kgm2 * (axle.speed - axle.speed_before) / m.dt_s
            axle.road = low_pass(axle.road_before, taken, m.dt_s, settings.slip_filter_s)

    decided = state.decided_share
    if first or state.decision_age_s + 1.5 * m.dt_s >= settings.decision_period_s:
        decided = decide(axles[0].slip, axles[1].slip)
    share = decided
    if not first:
        most = settings.share_rate_per_s * m.dt_s
        share = state.applied_share + min(max(decided - state.applied_share, -most), most)

    for axle in axles:
        edge = settings.critical_slip - (settings.gate_hysteresis if axle.was_gated else 0.0)
        axle.doubtful = abs(abs(axle.slip) - edge) < 1e-12
        if settings.gate_mode != GATE_MODE_OFF and m.power_demand_w != 0.0:
            spinning = settings.gate_driving and not braking and axle.slip > edge
            axle.gated = spinning or (braking and -axle.slip > edge)
    front, rear = axles
    parts = {(False, False): (share, 1.0 - share), (True, False): (0.0, 1.0), (False, True): (1.0, 0.0)}
    parts = parts.get((front.gated, rear.gated), (0.0, 0.0))
    front.asked, rear.asked = (part * abs(m.power_demand_w) for part in parts)

    floor = vehicle.driver.power_speed_floor_mps
    for axle in axles:
        axle.conversion = max(axle.speed, max(m.speed_mps * (1.0 - settings.critical_slip), floor) / radius)
        axle.room = brake.max_torque_nm if braking else torque_limit(axle.fast, axle.heat, motor)
        if settings.gate_mode == GATE_MODE_LIMITER:
            worst = min(axle.wheels) if braking else max(axle.wheels)
            axle.grip = grip(braking, axle.road, worst, m.speed_mps, settings, vehicle)
        axle.most = 0.0 if axle.gated else 2.0 * axle.conversion * min(axle.room, axle.grip)
        axle.given = min(axle.asked, axle.most)
    for axle in reversed(axles):
        axle.given += max(min(front.asked + rear.asked - front.given - rear.given, axle.most - axle.given), 0.0)

    missing = front.asked + rear.asked - front.given - rear.given
    for axle in axles:
        if not axle.gated and max(missing, axle.asked - axle.given) > 1e-12 * abs(m.power_demand_w):
            if axle.grip < axle.room:
                bits.add(t.LIMIT_SLIP)
            elif braking:
                bits.add(t.LIMIT_FRICTION_BRAKE)
            else:
                bits.add(t.LIMIT_MOTOR)
                if axle.room < torque_limit(axle.fast, 0.0, motor):
                    bits.add(t.LIMIT_THERMAL)
        axle.total = (-1.0 if braking else 1.0) * axle.given / (2.0 * axle.conversion)
        weakest = regeneration_limit(axle.fast, m.speed_mps, axle.heat, motor)
        wanted = max(axle.total, -weakest) if braking else axle.total
        if wanted > axle.total:
            bits.add(t.LIMIT_REGENERATION)
        strongest = torque_limit(axle.fast, axle.heat, motor)
        if braking:
            weakest = min(weakest, axle.grip)
        else:
            strongest = min(strongest, axle.grip)
        way = slewed(
            axle.motor_before,
            wanted,
            m.dt_s,
            settings.slew_up_nmps,
            settings.slew_down_nmps,
            settings.slew_regeneration_nmps,
        )
        axle.motor = 0.0 if axle.gated else min(max(way, -weakest), strongest)
        if abs(axle.motor) <= NOTHING:
            axle.motor = 0.0
        if abs(axle.motor - wanted) > NOTHING:
            bits.add(t.LIMIT_SLEW)

    factor, side = battery_factor(
        [a.motor for a in axles], [a.speed for a in axles], m.discharge_limit_w, m.charge_limit_w, motor
    )
    if side:
        bits.add(t.LIMIT_BATTERY_CHARGE if side == "charge" else t.LIMIT_BATTERY_DISCHARGE)
    for axle in axles:
        axle.motor *= factor
        if braking and not axle.gated:
            # Whatever the motor does, wheel and brake together brake as asked.
            axle.friction = -min(max(axle.motor - axle.total, 0.0), brake.max_torque_nm)
    return axles, share, decided, bits
