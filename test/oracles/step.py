# SPDX-License-Identifier: Apache-2.0
"""One decision step in plain Python: the equations of eq. 1-23 in one system, solved by SciPy."""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import root

G = 9.81


def friction_coefficient(slip, peak, tyre):
    b, c, d, e = tyre.coefficients
    return peak * d * math.sin(c * math.atan(b * slip - e * (b * slip - math.atan(b * slip))))


def loss_w(torque, speed, motor):
    return (
        motor.loss_constant_w
        + motor.loss_linear_speed * speed
        + motor.loss_quadratic_speed * speed**2
        + motor.loss_linear_torque * abs(torque)
        + motor.loss_quadratic_torque * torque**2
    )


def electrical_w(torque, speed, motor):
    """Of one motor; an idle one takes what `idle_drive` says: 0 nothing, 1 standby, 2 the full loss."""
    if torque == 0.0:
        return (0.0, motor.idle_standby_w, loss_w(0.0, speed, motor))[motor.idle_drive]
    return torque * speed + loss_w(torque, speed, motor)


def chemical_w(power, battery):
    v = battery.cells_in_series * battery.nominal_cell_voltage_v
    r = battery.resistance_ohm
    return v * (v - math.sqrt(v * v - 4.0 * r * power)) / (2.0 * r)


def dynamic_step(power, speed, slips, share, vehicle, problem):
    """Battery energy (J), next speed, next slips, delivered power at wheel and road, for a moving car without limits.

    `slips` are those of front and rear. All four wheels turn, and nothing is gated or beyond a limit of the battery.
    """
    car, wheel, tyre, motor = vehicle.chassis, vehicle.front.wheel, vehicle.front.tyre, vehicle.front.motor
    dt, radius = problem.dt_s, wheel.radius_m
    rim = [speed / (1.0 - s) if s > 0.0 else speed * (1.0 + s) for s in slips]
    before = [x / radius for x in rim]
    held = max(speed * (1.0 - problem.critical_slip), vehicle.driver.power_speed_floor_mps) / radius
    torques, motors = [], []
    for part, w in zip((share, 1.0 - share), before, strict=True):
        torque = part * power / 2.0 / max(w, held)
        regeneration = min(motor.regeneration_torque_nm, motor.max_power_w / max(w, 1e-9), motor.peak_torque_nm)
        low, high = motor.regeneration_zero_below_mps, motor.regeneration_full_above_mps
        regeneration *= min(max((speed - low) / (high - low), 0.0), 1.0)
        torques.append(torque)
        motors.append(max(torque, -regeneration))
    drags = [
        (motor.idle_drag_constant_nm + motor.idle_drag_linear_nm_per_radps * w) * (m == 0.0 and motor.idle_drive == 1)
        for m, w in zip(motors, before, strict=True)
    ]

    def forces(v, w):
        acceleration = (v - speed) / dt
        aero = 0.5 * car.air_density_kgpm3 * car.frontal_area_m2 * car.drag_coefficient * v * v
        base = car.front_axle_to_cg_m + car.rear_axle_to_cg_m
        pitch = car.cg_height_m * (car.mass_kg * acceleration + aero)
        normal = (
            (car.mass_kg * G * car.rear_axle_to_cg_m - pitch) / (2.0 * base),
            (car.mass_kg * G * car.front_axle_to_cg_m + pitch) / (2.0 * base),
        )
        slip = [(radius * x - v) / max(radius * x, v, tyre.slip_speed_floor_mps) for x in w]
        tyres = [n * friction_coefficient(s, problem.friction, tyre) for n, s in zip(normal, slip, strict=True)]
        return tyres, aero + car.rolling_resistance * car.mass_kg * G, slip

    def residual(x):
        v, w = x[0], x[1:]
        tyres, resistance, _ = forces(v, w)
        lines = [(car.mass_kg * (v - speed) / dt - 2.0 * sum(tyres) + resistance) / car.mass_kg]
        for i in range(2):
            inertia = wheel.inertia_kgm2 * (w[i] - before[i]) / dt
            lines.append((inertia - torques[i] + drags[i] + radius * tyres[i]) / wheel.inertia_kgm2)
        return lines

    # Near the end state, slip is small: start there.
    solution = root(residual, [speed, speed / radius, speed / radius], method="hybr", tol=1e-13)
    assert np.max(np.abs(solution.fun)) < 1e-6, solution.message
    v, *after = solution.x
    tyres, _, slip = forces(v, after)
    mean = [(a + b) / 2.0 for a, b in zip(before, after, strict=True)]
    electrical = sum(2.0 * electrical_w(m, w, motor) for m, w in zip(motors, mean, strict=True))
    at_wheel = sum(2.0 * t * w for t, w in zip(torques, mean, strict=True))
    rolling = 4.0 * wheel.inertia_kgm2 / radius**2 * (v - speed) / dt
    at_road = (2.0 * sum(tyres) + rolling) * (v + speed) / 2.0
    return chemical_w(electrical, vehicle.battery) * dt, v, slip, at_wheel, at_road
