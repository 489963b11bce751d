# SPDX-License-Identifier: Apache-2.0
"""A car whose numbers do not fit each other: each check says which unit was probably meant.

Ranges of single numbers stand in `vehicle_table`; here numbers are compared with each other. The bounds are far from
any car, from a solar racer to a lorry, and nearer than the thousandfold of a wrong prefix.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from iwm_power_manager.errors import ConfigError
from iwm_power_manager.model.parameters import Axle, Motor, VehicleParams

#: No car of this package is faster.
MAX_TOP_SPEED_MPS = 70.0
_GRAVITY_MPS2 = 9.81


class _Check(NamedTuple):
    key: str
    what: str
    unit: str
    value: float
    low: float
    high: float
    if_low: str
    if_high: str


def top_speed_mps(chassis: Mapping[str, float], power_w: float) -> float:
    """Speed at which this mechanical power meets the road load on the level, m/s, at most `MAX_TOP_SPEED_MPS`."""
    drag = 0.5 * chassis["air_density_kgpm3"] * chassis["frontal_area_m2"] * chassis["drag_coefficient"]
    rolling = chassis["rolling_resistance"] * chassis["mass_kg"] * _GRAVITY_MPS2
    low, high = 0.0, MAX_TOP_SPEED_MPS
    for _ in range(60):
        middle = 0.5 * (low + high)
        if (drag * middle * middle + rolling) * middle < power_w:
            low = middle
        else:
            high = middle
    return high


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
    chassis, battery = params.chassis, params.battery
    power = 2.0 * (params.front.motor.max_power_w + params.rear.motor.max_power_w)
    checks = []
    for axle in ("front", "rear"):
        checks += _axle_checks(key_of(axle, "motor"), getattr(params, axle), chassis.mass_kg)
    volt = battery.cells_in_series * battery.nominal_cell_voltage_v
    energy_wh = volt * battery.capacity_ah
    kilowatts = "kW in a W field?"
    checks += [
        _Check(
            "battery.discharge_limit_w",
            "of the power of all motors",
            "",
            battery.discharge_limit_w / power,
            0.05,
            100.0,
            kilowatts,
            kilowatts,
        ),
        _Check(
            "battery.charge_limit_w",
            "of the power of all motors",
            "",
            battery.charge_limit_w / power or 1.0,
            0.005,
            100.0,
            kilowatts,
            kilowatts,
        ),
        _Check(
            "battery.resistance_ohm",
            "of what the discharge limit allows at most (Voc^2 / 4 P)",
            "",
            battery.resistance_ohm * 4.0 * battery.discharge_limit_w / volt**2,
            0.0,
            1.0,
            "",
            "milliohm in an ohm field, or a cell for the pack?",
        ),
        _Check(
            "battery.ohmic_resistance_ohm",
            "of resistance_ohm, together with polarisation_resistance_ohm",
            "",
            (battery.ohmic_resistance_ohm + battery.polarisation_resistance_ohm) / battery.resistance_ohm,
            0.05,
            20.0,
            "a cell for the pack?",
            "milliohm in an ohm field?",
        ),
        _Check(
            "battery.capacity_ah",
            "of pack per kg of car",
            "Wh",
            energy_wh / chassis.mass_kg,
            0.2,
            600.0,
            "the capacity of the whole pack is meant",
            "Wh or mAh in an Ah field?",
        ),
    ]
    for check in checks:
        if not check.low <= check.value <= check.high:
            meaning = f"means {check.value:.3g} {check.unit}".rstrip() + f" {check.what}"
            likely = check.if_low if check.value < check.low else check.if_high
            raise ConfigError(path, check.key, f"{meaning}: {likely}", f"{check.low:g} to {check.high:g}")


def _axle_checks(key: str, axle: Axle, mass_kg: float) -> list[_Check]:
    motor, radius = axle.motor, axle.wheel.radius_m
    shaft = "a torque at the motor's shaft without gear?"
    return [
        _Check(
            f"{key}.max_power_w",
            "per kg of car and motor",
            "W",
            motor.max_power_w / mass_kg,
            0.5,
            1000.0,
            "kW in a W field?",
            "the power of one motor is meant",
        ),
        _Check(
            f"{key}.peak_torque_nm",
            "at which peak torque takes all of max_power_w",
            "m/s",
            radius * motor.max_power_w / motor.peak_torque_nm,
            0.5,
            80.0,
            "kW in a W field, or the torque of the whole car?",
            shaft,
        ),
        _Check(
            f"{key}.peak_torque_nm",
            "g of this axle alone",
            "",
            2.0 * motor.peak_torque_nm / radius / (mass_kg * _GRAVITY_MPS2),
            0.01,
            5.0,
            shaft,
            "the torque of one motor is meant",
        ),
        _Check(
            f"{key}.{'efficiency_map' if motor.map_loss_w.size else 'loss'}",
            "efficiency at half of peak torque and full power",
            "",
            _efficiency(motor),
            0.2,
            0.9995,
            "losses of all motors, or rpm in a rad/s column?",
            "kW in a W field?",
        ),
    ]


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
