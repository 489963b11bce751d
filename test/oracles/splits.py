# SPDX-License-Identifier: Apache-2.0
"""Strategies in plain Python: every share tried, the cheapest taken."""

from __future__ import annotations

import math

import numpy as np
from scipy.integrate import quad
from scipy.interpolate import RegularGridInterpolator

from oracles.physics import axle_w, battery_w, normal_forces, road_load, slip_for, torque_limit
from oracles.step import G, electrical_w

MISSING_PRICE = 20.0
TELLS_APART_W = 1e-3


def split_w(force, speed, share, friction, slip_aware, vehicle):
    """Battery power for a road force at a share, and the force nobody can give."""
    car, axles = vehicle.chassis, (vehicle.front, vehicle.rear)
    rolling = [speed / axle.wheel.radius_m for axle in axles]
    if force == 0.0:
        idle = sum(electrical_w(0.0, w, axle.motor) for w, axle in zip(rolling, axles, strict=True))
        return battery_w(2.0 * idle, vehicle.battery), 0.0
    mass = car.mass_kg + sum(2.0 * axle.wheel.inertia_kgm2 / axle.wheel.radius_m**2 for axle in axles)
    normal = normal_forces((force - road_load(speed, 0.0, car)) / mass, speed, 0.0, car)
    direction = 1.0 if force > 0.0 else -1.0
    asked = [share * force, force - share * force]
    room = [1e12, 1e12]
    for i, axle in enumerate(axles):
        if slip_aware:
            room[i] = 0.99 * 2.0 * friction * axle.tyre.coefficients[2] * normal[i]
        if direction > 0.0:
            room[i] = min(room[i], 2.0 * torque_limit(rolling[i], 0.0, axle.motor) / axle.wheel.radius_m)
    if 0.0 in asked:
        idle = asked.index(0.0)
        motor = axles[idle].motor
        if motor.idle_drive == 1 and direction * asked[1 - idle] <= room[1 - idle]:
            drag = motor.idle_drag_constant_nm + motor.idle_drag_linear_nm_per_radps * rolling[idle]
            asked[1 - idle] += 2.0 * drag / axles[idle].wheel.radius_m
    asked = [direction * x for x in asked]
    given = [min(a, r) for a, r in zip(asked, room, strict=True)]
    for axle in (1, 0):
        short = sum(asked) - sum(given)
        given[axle] += min(max(short, 0.0), room[axle] - given[axle])
    power = sum(
        axle_w(direction * f, speed, n, friction, slip_aware, axle)
        for f, n, axle in zip(given, normal, axles, strict=True)
    )
    return battery_w(power, vehicle.battery), sum(asked) - sum(given)


def mean_slip(force, friction, vehicle):
    """Magnitude of the slip that carries a road force, both axles alike."""
    used = min(abs(force) / (vehicle.chassis.mass_kg * G), 0.99 * friction * vehicle.front.tyre.coefficients[2])
    return slip_for(used, friction, vehicle.front.tyre)


def lagging(demands, weights, speed, settled_j, problem, vehicle):
    """Cost (demand, share), J, of a step while the demand jitters, from that with settled slip, `settled_j`.

    Each of the demands is held for 0.1 s. Wheels are turned faster by the force itself: what their slip lacks of the
    settled one on average over that time is left at that of the mean demand.
    """
    axles = (vehicle.front, vehicle.rear)
    inertia = sum(2.0 * axle.wheel.inertia_kgm2 / axle.wheel.radius_m**2 for axle in axles)
    mean = float(np.average(demands, weights=weights))

    def reached(demand):
        rolling = max(speed, vehicle.driver.power_speed_floor_mps)
        slip = mean_slip(demand / rolling, problem.friction, vehicle)
        rim = speed / (1.0 - slip) if demand > 0.0 else speed * (1.0 - slip)
        force = abs(demand) / max(rim, vehicle.driver.power_speed_floor_mps)
        lag = inertia * speed * mean_slip(force, problem.friction, vehicle) / force
        found, _ = quad(lambda time: 1.0 - math.exp(-time / lag), 0.0, 0.1, points=[min(5.0 * lag, 0.1)], epsrel=1e-12)
        return found / 0.1

    def slip_j(demand, share):
        power, _ = split_w(demand / speed, speed, share, problem.friction, False, vehicle)
        return settled_j(demand, share) - power * problem.dt_s

    def cost(demand, share):
        part = reached(demand)
        own = slip_j(demand, share)
        return settled_j(demand, share) - own + part * own + (1.0 - part) * slip_j(mean, share)

    return cost


def cheapest(demand, speed, previous, friction, slip_aware, switching, vehicle, shares):
    """Least battery power, what is missing priced, a change of share worth it only beyond `switching`."""
    rolling = max(speed, vehicle.driver.power_speed_floor_mps)
    force = demand / rolling
    if slip_aware:
        slip = mean_slip(force, friction, vehicle)
        rim = speed / (1.0 - slip) if demand > 0.0 else speed * (1.0 - slip)
        force = demand / max(rim, vehicle.driver.power_speed_floor_mps)

    def price(share):
        power, missing = split_w(force, rolling, share, friction, slip_aware, vehicle)
        return power + MISSING_PRICE * missing * rolling

    costs = {previous: price(previous) - TELLS_APART_W}
    for share in shares:
        costs.setdefault(share, price(share) + switching)
    return min(costs, key=costs.__getitem__), costs


def rule(demand, coefficients):
    """Straight lines P_f(P_dem)."""
    a, b = coefficients[:2] if demand > 0.0 else coefficients[2:]
    return float(np.clip((a + b * demand) / demand, 0.0, 1.0))


def interpolated(axes, table, point):
    """Multilinear, the edge's value outside; axes of a single point do not count."""
    kept = [i for i, axis in enumerate(axes) if len(axis) > 1]
    values = table.reshape([len(axes[i]) for i in kept])
    inside = [float(np.clip(point[i], axes[i][0], axes[i][-1])) for i in kept]
    return float(RegularGridInterpolator([axes[i] for i in kept], values)(inside)[0]) if kept else float(values)


def price_units(move):
    """What a move costs, in prices of a change: the mean of three ways of counting it."""
    return 0.0 if move == 0.0 else (1.0 + min(abs(move) / 0.25, 1.0) + abs(move)) / 3.0


def bellman(point, previous, table, outcome, used=(0.0, 0.0), steps=1.0, motors_w=math.inf, earlier_w=None):
    """Cost of each share: step, change, and what follows (eq. 31). `outcome(share)` is the step's (cost, v, f, r).

    `used` is what is used of the two buckets of changes: the tables at dearer prices count for more, the more that is.
    `steps` is how many times the step counts. With a budget half of eq. 31 is believed, but for braking with more than
    the motors have; for the other half the step's cost goes on for 0.8 s, and what follows is the mean of what follows
    on this demand and on the earlier one. What is better now and by the whole of eq. 31, on both demands, is believed.
    """
    axes = (table.power_w, table.speed_mps, table.slip_front, table.slip_rear, table.previous_share)
    budget = table.changes_per_min
    tables, level, factor, trust = [table.expected_cost_j, *table.dearer_cost_j], 0.0, 1.0, 1.0
    powers = [point[0]]
    if budget > 0.0:
        if point[0] > -motors_w:
            trust = 0.5
            powers += [] if earlier_w is None else [earlier_w]
            steps += 0.5 * (0.8 / table.problem.dt_s - 1.0)
        full = (max(5.5 * budget, 2.0), max(2.5 * budget, 2.0))
        # Both are full where a change and the way back have no room.
        holds = [max(size - 2.0, 1.0) for size in full]
        # The way back is set aside, and costs what the way there did.
        away = min(abs(0.5 - previous) / 0.25, 1.0)
        levels = [min(max(of - away, 0.0) / size, 0.9999) for of, size in zip(used, holds, strict=True)]
        factor = 2.0 ** levels[0]
        for level, size in zip(levels, holds, strict=True):
            factor *= 1.0 + math.pi / (2.0 * table.elasticity * size) * math.tan(math.pi / 2.0 * level)
        level = min(math.log(factor, 3.0), 2.0)
    costs, wholes = {}, {}
    for share in (previous, *table.share):
        cost, speed, front, rear = outcome(share)
        places = [(power, speed, front, rear, share) for power in powers]
        follows = [[interpolated(axes, each, at) for each in tables] for at in places]
        follows = [float(np.interp(level, range(len(tables)), each)) for each in follows]
        follow_up = np.mean(follows)
        move = share - previous
        needed = min(abs(move) / 0.25, 1.0) + min(abs(0.5 - share) / 0.25, 1.0) - 1e-9
        if budget > 0.0 and move != 0.0 and any(of + needed > size for of, size in zip(used, full, strict=True)):
            continue
        units = price_units(move) if budget > 0.0 else abs(move)
        changed = factor * table.switching_cost_j * units + table.switching_fixed_cost_j * (move != 0.0)
        costs.setdefault(share, steps * cost + changed + trust * table.discount * follow_up)
        wholes.setdefault(share, (cost, changed, [table.discount * each for each in follows]))
    if len(powers) > 1:
        cost, _, follows = wholes[previous]
        for share, (other, changed, others) in wholes.items():
            worth = cost - other - changed + min(a - b for a, b in zip(follows, others, strict=True))
            if other < cost:
                costs[share] = min(costs[share], costs[previous] - worth)
    costs[previous] -= TELLS_APART_W * table.problem.dt_s
    return costs
