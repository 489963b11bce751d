# SPDX-License-Identifier: Apache-2.0
"""Tyre, chassis, motor limits and battery in plain Python, each from its definition rather than from the kernel."""

from __future__ import annotations

import math

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, minimize_scalar

from oracles.step import G, electrical_w, friction_coefficient


def slip(wheel, speed, radius, floor):
    """Eq. 10 by cases: driving over the rim's speed, braking over the car's, neither below the floor."""
    rim = radius * wheel
    if rim > speed:
        return (rim - speed) / (rim if rim > floor else floor)
    return (rim - speed) / (speed if speed > floor else floor)


def peak_slip(tyre):
    """Slip of the largest friction coefficient, by search."""
    found = minimize_scalar(
        lambda s: -friction_coefficient(s, 1.0, tyre), bounds=(0.0, 1.0), method="bounded", options={"xatol": 1e-12}
    )
    return found.x


def slip_for(friction, peak, tyre):
    """Slip below the peak at which the tyre gives `friction`, by root finding; 0 where there is no grip."""
    if friction == 0.0 or peak == 0.0:
        return 0.0
    top = peak_slip(tyre)
    wanted = abs(friction)
    if wanted >= friction_coefficient(top, peak, tyre):
        return math.copysign(top, friction)
    return math.copysign(brentq(lambda s: friction_coefficient(s, peak, tyre) - wanted, 0.0, top, xtol=1e-14), friction)


def normal_forces(acceleration, speed, grade, car):
    """Normal force of a front and a rear wheel: balance of force and of moments about the centre of gravity.

    Aerodynamic drag acts at the height of the centre of gravity, so the tyres' forces carry m a, drag and slope.
    """
    angle = math.atan(grade)
    aero = 0.5 * car.air_density_kgpm3 * car.frontal_area_m2 * car.drag_coefficient * speed**2
    along = car.mass_kg * acceleration + aero + car.mass_kg * G * math.sin(angle)
    front, rear = np.linalg.solve(
        [[2.0, 2.0], [2.0 * car.front_axle_to_cg_m, -2.0 * car.rear_axle_to_cg_m]],
        [car.mass_kg * G * math.cos(angle), -along * car.cg_height_m],
    )
    if front < 0.0:
        return 0.0, front + rear
    if rear < 0.0:
        return front + rear, 0.0
    return front, rear


def road_load(speed, grade, car):
    """Eq. 3-5."""
    angle = math.atan(grade)
    aero = 0.5 * car.air_density_kgpm3 * car.frontal_area_m2 * car.drag_coefficient * speed**2
    return aero + car.mass_kg * G * (car.rolling_resistance * math.cos(angle) + math.sin(angle))


def torque_limit(wheel, heat, motor):
    """Eq. 19: the smaller of what heat and what power allow."""
    heat = min(max(heat, 0.0), 1.0)
    thermal = (1.0 - heat) * motor.peak_torque_nm + heat * motor.continuous_torque_nm
    return min(thermal, motor.max_power_w / wheel) if wheel > 0.0 else thermal


def regeneration_limit(wheel, speed, heat, motor):
    """Eq. 42 with its fade."""
    faded = np.interp(speed, [motor.regeneration_zero_below_mps, motor.regeneration_full_above_mps], [0.0, 1.0])
    return float(faded) * min(motor.regeneration_torque_nm, torque_limit(wheel, heat, motor))


def axle_w(force, speed, normal, friction, slip_aware, axle):
    """Electrical power of an axle's motors for its road force, slip settled."""
    radius = axle.wheel.radius_m
    s = slip_for(0.5 * force / normal, friction, axle.tyre) if slip_aware and normal > 0.0 else 0.0
    wheel = (speed / (1.0 - s) if s > 0.0 else speed * (1.0 + s)) / radius
    torque = 0.5 * force * radius
    if torque < 0.0:
        torque = max(torque, -regeneration_limit(wheel, speed, 0.0, axle.motor))
    return 2.0 * electrical_w(torque, wheel, axle.motor)


def battery_w(power, battery):
    """Chemical power (eq. 21) by root finding on P = I (V - R I); the largest current where there is no root."""
    v = battery.cells_in_series * battery.nominal_cell_voltage_v
    r = battery.resistance_ohm
    peak = v / (2.0 * r)
    if power >= v * v / (4.0 * r):
        return v * peak
    return v * brentq(lambda i: i * (v - r * i) - power, -10.0 * peak, peak, xtol=1e-13, rtol=1e-15)


def dynamics(speed, wheels, motors, resisting, grade, friction, seconds, vehicle):
    """Car and four wheels after a time, integrated by SciPy from eq. 1-11; all wheels keep turning.

    The load transfer of the present acceleration is found by iteration.
    """
    car, wheel, tyre = vehicle.chassis, vehicle.front.wheel, vehicle.front.tyre

    def rates(_, x):
        v, w = x[0], x[1:]
        mu = [
            friction_coefficient(slip(w[i], v, wheel.radius_m, tyre.slip_speed_floor_mps), friction[i], tyre)
            for i in range(4)
        ]
        acceleration = 0.0
        for _ in range(60):
            front, rear = normal_forces(acceleration, v, grade, car)
            forces = [front * mu[0], front * mu[1], rear * mu[2], rear * mu[3]]
            acceleration = (sum(forces) - road_load(v, grade, car)) / car.mass_kg
        turning = [(motors[i] - resisting[i] - wheel.radius_m * forces[i]) / wheel.inertia_kgm2 for i in range(4)]
        return [acceleration, *turning]

    solution = solve_ivp(rates, (0.0, seconds), [speed, *wheels], method="LSODA", rtol=1e-9, atol=1e-9)
    return solution.y[0, -1], solution.y[1:, -1]
