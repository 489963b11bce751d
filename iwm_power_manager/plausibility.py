# SPDX-License-Identifier: Apache-2.0
"""A car whose numbers do not fit each other: each check says which unit was probably meant.

Ranges of single numbers stand in `vehicle_table`; here numbers are compared with each other. The bounds are far from
any car, from a solar racer to a lorry, and nearer than the thousandfold of a wrong prefix.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from iwm_power_manager.errors import ConfigError
from iwm_power_manager.model.parameters import Axle, Motor, VehicleParams

#: No car of this package is faster.
MAX_TOP_SPEED_MPS = 70.0
_GRAVITY_MPS2 = 9.81


class _Bound(NamedTuple):
    """What a number is turned into, in which unit, its bounds, and the likely mistake below and above them."""

    key: str
    what: str
    low: float
    high: float
    if_low: str
    if_high: str


_KILOWATTS = "kW in a W field?"
_SHAFT = "a torque at the motor's shaft without gear?"
_ONE_MOTOR = "of one motor is meant"
_LIMIT = "of the power of all motors"
_VOLTAGE = "of what the discharge limit allows at most (Voc^2 / 4 P)"
_PLANT = "of resistance_ohm, together with polarisation_resistance_ohm"
#: Rolling resistance of tyres on firm roads, from a solar racer's to gravel; 0 may be meant.
_ROLLING = (0.002, 0.04)
#: In the order of `_motor_values` and `_battery_values`.
_MOTOR = (
    _Bound("max_power_w", "W per kg of car and motor", 0.5, 1000.0, _KILOWATTS, f"the power {_ONE_MOTOR}"),
    _Bound(
        "peak_torque_nm",
        "m/s at which peak torque takes all of max_power_w",
        0.5,
        80.0,
        "kW in a W field, or the torque of the whole car?",
        _SHAFT,
    ),
    _Bound("peak_torque_nm", "g of this axle alone", 0.01, 5.0, _SHAFT, f"the torque {_ONE_MOTOR}"),
    _Bound("regeneration_torque_nm", "of peak_torque_nm", 0.0, 1.5, "", f"the torque {_ONE_MOTOR}"),
    _Bound("idle_drag_constant_nm", "of peak_torque_nm", 0.0, 0.2, "", "N cm, or the drag of the whole car?"),
    _Bound(
        "loss",
        "efficiency at half of peak torque and full power",
        0.2,
        0.9995,
        "losses of all motors, or rpm in a rad/s column?",
        _KILOWATTS,
    ),
)
_BRAKE = _Bound(
    "max_torque_nm",
    "m/s2 of this axle's friction brakes alone",
    0.1,
    500.0,
    "kN m in an N m field?",
    "N mm or a force in N?",
)
_INERTIA = _Bound(
    "inertia_kgm2",
    "of the car's mass in what this axle turns",
    3e-4,
    1.0,
    "g m2, or kg cm2 in a kg m2 field?",
    "kg cm2 in a kg m2 field, or a wheel radius in cm?",
)
_AIR = _Bound("air_density_kgpm3", "kg/m3", 0.3, 2.0, "g/cm3 in a kg/m3 field?", "")
_BATTERY = (
    _Bound("discharge_limit_w", _LIMIT, 0.05, 100.0, _KILOWATTS, _KILOWATTS),
    _Bound("charge_limit_w", _LIMIT, 0.005, 100.0, _KILOWATTS, _KILOWATTS),
    _Bound(
        "nominal_cell_voltage_v",
        "of the open-circuit voltage at half charge",
        0.6,
        1.5,
        "another cell's?",
        "another cell's?",
    ),
    _Bound("cells_in_series", "V of the pack", 5.0, 2000.0, "cells in parallel counted?", "cells in parallel counted?"),
    _Bound("resistance_ohm", _VOLTAGE, 0.0, 1.0, "", "milliohm in an ohm field, or a cell for the pack?"),
    _Bound("ohmic_resistance_ohm", _PLANT, 0.05, 20.0, "a cell for the pack?", "milliohm in an ohm field?"),
    _Bound(
        "capacity_ah",
        "Wh of pack per kg of car",
        0.2,
        600.0,
        "the capacity of the whole pack is meant",
        "Wh or mAh in an Ah field?",
    ),
)


def check_car(path: Path, params: VehicleParams, key_of: Callable[[str, str], str]) -> None:
    """Refuse a car whose numbers do not fit each other.

    Parameters
    ----------
    key_of : where a section of an axle stands in the file: ("front", "motor") -> "front.motor" or "motor"

    Raises
    ------
    ConfigError
        It names the number, what it would mean, and the likely mistake.
    """
    for name, axle in (("front", params.front), ("rear", params.rear)):
        losses = "efficiency_map" if axle.motor.map_loss_w.size else "loss"
        for bound, value in zip(_MOTOR, _motor_values(axle, params.chassis.mass_kg), strict=True):
            _check(path, f"{key_of(name, 'motor')}.{losses if bound.key == 'loss' else bound.key}", bound, value)
        turning_kg = 2.0 * axle.wheel.inertia_kgm2 / axle.wheel.radius_m**2
        _check(path, f"{key_of(name, 'wheel')}.{_INERTIA.key}", _INERTIA, turning_kg / params.chassis.mass_kg)
        # A car may have no friction brakes on an axle.
        brake_mps2 = 2.0 * axle.friction_brake.max_torque_nm / axle.wheel.radius_m / params.chassis.mass_kg
        _check(path, f"{key_of(name, 'friction_brake')}.{_BRAKE.key}", _BRAKE, brake_mps2 or 1.0)
    _check(path, f"chassis.{_AIR.key}", _AIR, params.chassis.air_density_kgpm3 or _AIR.high)  # a vacuum may be meant
    for bound, value in zip(_BATTERY, _battery_values(params), strict=True):
        _check(path, f"battery.{bound.key}", bound, value)


def unusual(params: VehicleParams) -> list[str]:
    """What a car may have, but seldom has: lines for the reader."""
    rolling, (low, high) = params.chassis.rolling_resistance, _ROLLING
    if rolling == 0.0 or low <= rolling <= high:
        return []
    usual = f"tyres on firm roads have {low:g} to {high:g}; is it a fraction of the weight, not percent or kg/t?"
    return [f"chassis.rolling_resistance: {rolling:g} is unusual: {usual}"]


def _check(path: Path, key: str, bound: _Bound, value: float) -> None:
    if not bound.low <= value <= bound.high:
        likely = bound.if_low if value < bound.low else bound.if_high
        allowed = f"{bound.low:g} to {bound.high:g}"
        raise ConfigError(path, key, f"means {value:.3g} {bound.what}: {likely}", allowed)


def _motor_values(axle: Axle, mass_kg: float) -> tuple[float, ...]:
    motor, radius = axle.motor, axle.wheel.radius_m
    return (
        motor.max_power_w / mass_kg,
        radius * motor.max_power_w / motor.peak_torque_nm,
        2.0 * motor.peak_torque_nm / radius / (mass_kg * _GRAVITY_MPS2),
        motor.regeneration_torque_nm / motor.peak_torque_nm,
        motor.idle_drag_constant_nm / motor.peak_torque_nm,
        _efficiency(motor),
    )


def _battery_values(params: VehicleParams) -> tuple[float, ...]:
    battery = params.battery
    power = 2.0 * (params.front.motor.max_power_w + params.rear.motor.max_power_w)
    volt = battery.cells_in_series * battery.nominal_cell_voltage_v
    return (
        battery.discharge_limit_w / power,
        battery.charge_limit_w / power or 1.0,
        battery.nominal_cell_voltage_v / float(np.interp(0.5, battery.ocv_soc, battery.ocv_cell_v)),
        volt,
        battery.resistance_ohm * 4.0 * battery.discharge_limit_w / volt**2,
        (battery.ohmic_resistance_ohm + battery.polarisation_resistance_ohm) / battery.resistance_ohm,
        volt * battery.capacity_ah / params.chassis.mass_kg,
    )


def _efficiency(motor: Motor) -> float:
    """Efficiency where half of the peak torque takes the full power; plain Python: loading compiles nothing."""
    torque = 0.5 * motor.peak_torque_nm
    speed = motor.max_power_w / torque
    if motor.map_loss_w.size:
        i = int(np.argmin(np.abs(motor.map_speed_radps - speed)))
        j = int(np.argmin(np.abs(motor.map_torque_nm - torque)))
        speed, torque = float(motor.map_speed_radps[i]), float(motor.map_torque_nm[j])
        loss = float(motor.map_loss_w[i * motor.map_torque_nm.size + j])
    else:
        loss = (
            motor.loss_constant_w
            + (motor.loss_linear_speed + motor.loss_quadratic_speed * speed) * speed
            + (motor.loss_linear_torque + motor.loss_quadratic_torque * torque) * torque
        )
    power = abs(speed * torque)
    return power / (power + loss) if power > 0.0 else 1.0
