# SPDX-License-Identifier: Apache-2.0
"""Chassis: road load (eq. 3-5) and normal forces under load transfer (eq. 7, 8)."""

from __future__ import annotations

import math

from iwm_power_manager.jit import kernel
from iwm_power_manager.model.parameters import Chassis, VehicleParams

GRAVITY_MPS2 = 9.81  # the standard rounded value; not a property of a car


@kernel
def aerodynamic_force_n(speed_mps: float, chassis: Chassis) -> float:
    """Aerodynamic drag, N (eq. 3)."""
    return 0.5 * chassis.air_density_kgpm3 * chassis.frontal_area_m2 * chassis.drag_coefficient * speed_mps * speed_mps


@kernel
def rolling_force_n(grade: float, chassis: Chassis) -> float:
    """Rolling resistance of a moving car, N (eq. 4); `grade` is rise over run."""
    return chassis.rolling_resistance * chassis.mass_kg * GRAVITY_MPS2 / math.sqrt(1.0 + grade * grade)


@kernel
def grade_force_n(grade: float, chassis: Chassis) -> float:
    """Slope force, N (eq. 5), positive uphill; `grade` is rise over run."""
    return chassis.mass_kg * GRAVITY_MPS2 * grade / math.sqrt(1.0 + grade * grade)


@kernel
def road_load_n(speed_mps: float, grade: float, chassis: Chassis) -> float:
    """Sum of eq. 3-5 for a moving car, N."""
    return aerodynamic_force_n(speed_mps, chassis) + rolling_force_n(grade, chassis) + grade_force_n(grade, chassis)


@kernel
def normal_forces_n(acceleration_mps2: float, speed_mps: float, grade: float, chassis: Chassis) -> tuple[float, float]:
    """Normal force of one front and one rear wheel, N (eq. 7, 8), never negative."""
    cosine = 1.0 / math.sqrt(1.0 + grade * grade)
    sine = grade * cosine
    wheelbase = chassis.front_axle_to_cg_m + chassis.rear_axle_to_cg_m
    weight = chassis.mass_kg * GRAVITY_MPS2
    pitch = chassis.cg_height_m * (chassis.mass_kg * acceleration_mps2 + aerodynamic_force_n(speed_mps, chassis))
    front = (weight * (chassis.rear_axle_to_cg_m * cosine - chassis.cg_height_m * sine) - pitch) / (2.0 * wheelbase)
    rear = (weight * (chassis.front_axle_to_cg_m * cosine + chassis.cg_height_m * sine) + pitch) / (2.0 * wheelbase)
    both = front + rear
    return min(max(front, 0.0), both), min(max(rear, 0.0), both)


@kernel
def equivalent_mass_kg(vehicle: VehicleParams) -> float:
    """Mass that accelerates, wheels' rotation included: m + the sum of I / r^2."""
    front = vehicle.front.wheel
    rear = vehicle.rear.wheel
    turning = 2.0 * front.inertia_kgm2 / (front.radius_m * front.radius_m)
    return vehicle.chassis.mass_kg + (turning + 2.0 * rear.inertia_kgm2 / (rear.radius_m * rear.radius_m))
