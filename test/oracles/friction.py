# SPDX-License-Identifier: Apache-2.0
"""The friction estimate in plain Python: from all points of a drive at once, by the definitions, not step by step."""

from __future__ import annotations

import itertools
import math

import numpy as np

from oracles.physics import slip
from oracles.step import G, friction_coefficient


def points(drive, i, settings, car):
    """Of one wheel: applied torque and road force over load, slip, and speed, in each step of a drive but the first.

    `drive` has a row (speed, four wheel speeds, four torques applied in the step before, four road torques) a step.
    """
    axle = car.front if i < 2 else car.rear
    c = car.chassis
    found = []
    for before, (speed, wheels, torques, roads, dt) in itertools.pairwise(drive):
        force = sum(road / (car.front if k < 2 else car.rear).wheel.radius_m for k, road in enumerate(roads))
        base = c.front_axle_to_cg_m + c.rear_axle_to_cg_m
        arm = c.rear_axle_to_cg_m if i < 2 else c.front_axle_to_cg_m
        pitch = force * c.cg_height_m * (-1.0 if i < 2 else 1.0)
        load = (c.mass_kg * G * arm + pitch) / (2.0 * base)
        load = max(min(max(load, 0.0), c.mass_kg * G / 2.0), 1.0)
        radius = axle.wheel.radius_m
        spun = axle.wheel.inertia_kgm2 * (wheels[i] - before[1][i]) / dt
        found.append(
            (
                torques[i] / (radius * load),
                (torques[i] - spun) / (radius * load),
                slip(wheels[i], speed, radius, axle.tyre.slip_speed_floor_mps),
                speed,
            )
        )
    return found


def slope(sides, settings, tyres, dt):
    """Friction and belief of a side whose two wheels have rolled all the time, from their points.

    How large an error is at least goes by the front wheel's tyre.
    """
    keep = 1.0 - dt / (settings.friction_memory_s + dt)
    torque_road = torque_curve = square = curves = weights = 0.0
    for wheel, tyre in zip(sides, tyres, strict=True):
        z, u, s, v = np.array(wheel).T
        f = np.array([friction_coefficient(x, 1.0, tyre) for x in s])
        w = np.minimum(v / 10.0, 1.0) ** 2 * keep ** np.arange(len(z))[::-1]
        dz, du, df = (x - np.average(x, weights=w) for x in (z, u, f))
        torque_road += (w * dz * du).sum()
        torque_curve += (w * dz * df).sum()
        square += (w * dz * dz).sum()
        curves += (w * df * df).sum()
        weights += w.sum()
    if not (torque_road > 0.0 and torque_curve > 0.0 and square > 0.0):
        return 0.0, 0.0
    k = torque_curve / torque_road
    off = max(curves - 2.0 * k * torque_curve + k * k * square, 0.0)
    error = math.sqrt((off / weights + friction_coefficient(0.0005, 1.0, tyres[0]) ** 2) / square) / k
    return min(max(1.0 / k, 0.05), 1.2), 1.0 / (1.0 + (error / 0.1) ** 2)
