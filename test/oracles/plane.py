# SPDX-License-Identifier: Apache-2.0
"""Motion in the plane written down from its equations, integrated by SciPy: no wheel stands, nothing holds."""

from __future__ import annotations

import math

import numpy as np
from scipy.integrate import solve_ivp

from oracles.physics import road_load
from oracles.step import G, friction_coefficient


def tyre_force(rim, along, across, load, friction, tyre):
    """Force along and across a wheel: against the sliding of its contact point, by the slip of that sliding."""
    sliding = np.array([rim - along, -across])
    size = float(np.hypot(*sliding))
    if size == 0.0:
        return np.zeros(2)
    slip = size / max(abs(rim), math.hypot(along, across), tyre.slip_speed_floor_mps)
    return load * friction_coefficient(slip, friction, tyre) * sliding / size


def loads(along, across, speed, vehicle):
    """Loads of four wheels on a level road, all on the ground."""
    car = vehicle.chassis
    air = 0.5 * car.air_density_kgpm3 * car.frontal_area_m2 * car.drag_coefficient * speed**2
    length = car.front_axle_to_cg_m + car.rear_axle_to_cg_m
    pitch = (car.mass_kg * along + air) * car.cg_height_m / length
    front = car.mass_kg * G * car.rear_axle_to_cg_m / length - pitch
    rear = car.mass_kg * G * car.front_axle_to_cg_m / length + pitch
    roll = car.mass_kg * across * car.cg_height_m
    d_front = roll * car.front_roll_share / vehicle.front.track_width_m
    d_rear = roll * (1.0 - car.front_roll_share) / vehicle.rear.track_width_m
    return [0.5 * front - d_front, 0.5 * front + d_front, 0.5 * rear - d_rear, 0.5 * rear + d_rear]


def places(vehicle):
    car = vehicle.chassis
    front, rear = 0.5 * vehicle.front.track_width_m, 0.5 * vehicle.rear.track_width_m
    a, b = car.front_axle_to_cg_m, car.rear_axle_to_cg_m
    return [(a, front), (a, -front), (-b, rear), (-b, -rear)]


def rates(state, torques, steer, friction, vehicle):
    """Time derivatives of (u, v, yaw rate, four wheels, x, y, heading) under these torques at the wheels."""
    u, v, yaw = state[:3]
    wheels = state[3:7]
    heading = state[9]
    car = vehicle.chassis
    along = across = 0.0
    forces = np.zeros((4, 2))
    yawing = 0.0
    for _ in range(60):
        load = loads(along, across, u, vehicle)
        total, moment = np.zeros(2), 0.0
        for i, (x, y) in enumerate(places(vehicle)):
            axle = vehicle.front if i < 2 else vehicle.rear
            angle = steer if i < 2 else 0.0
            turn = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
            ground = turn @ np.array([u - yaw * y, v + yaw * x])
            rim = axle.wheel.radius_m * wheels[i]
            forces[i] = tyre_force(rim, ground[0], ground[1], load[i], friction[i], axle.tyre)
            body = turn.T @ forces[i]
            total += body
            moment += x * body[1] - y * body[0]
        along = (total[0] - road_load(u, 0.0, car)) / car.mass_kg
        across = total[1] / car.mass_kg
        yawing = moment / car.yaw_inertia_kgm2
    turning = []
    for i in range(4):
        wheel = (vehicle.front if i < 2 else vehicle.rear).wheel
        turning.append((torques[i] - wheel.radius_m * forces[i, 0]) / wheel.inertia_kgm2)
    moving = [u * math.cos(heading) - v * math.sin(heading), u * math.sin(heading) + v * math.cos(heading), yaw]
    return [along + yaw * v, across - yaw * u, yawing, *turning, *moving]


def after(speed, torques, steer, friction, seconds, vehicle):
    """(u, v, yaw rate, four wheels, x, y, heading) of a car that rolled straight, after a time."""
    rolling = [speed / axle.wheel.radius_m for axle in (vehicle.front, vehicle.front, vehicle.rear, vehicle.rear)]
    start = [speed, 0.0, 0.0, *rolling, 0.0, 0.0, 0.0]
    solution = solve_ivp(
        lambda _, x: rates(x, torques, steer, friction, vehicle),
        (0.0, seconds),
        start,
        method="LSODA",
        rtol=1e-8,
        atol=1e-9,
    )
    return solution.y[:, -1]
