# SPDX-License-Identifier: Apache-2.0
"""Every number of a vehicle file: unit, range, meaning, who reads it, and what holds where the file does not give it.

The one table that `vehicle` checks files by and `docs/vehicle.md` prints. A tyre's own numbers stand with its model
(`model.tyre`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

from iwm_power_manager.model.tyre import MODELS

#: Static stability factor, half the track over the height of the centre of gravity, that is assumed at least where the
#: track is not given: passenger cars have 1.2 to 1.5 (NHTSA).
STATIC_STABILITY_FACTOR = 1.2
#: Track over wheelbase of passenger cars where neither is known better (1.54 / 2.62 m to 1.58 / 2.88 m).
TRACK_PER_WHEELBASE = 0.56


class Quantity(NamedTuple):
    """One number of a vehicle file.

    Attributes
    ----------
    low, high, unit : what is allowed
    meaning : for the reader, with the equation it stands in
    above : `low` itself is excluded
    decides : the decision model reads it (`model.decision` and what it calls), so that a policy depends on it
    default : what holds where it is not given, in words; "" if it has to be given
    derive : computes the default from the numbers of the chassis
    """

    low: float
    high: float
    unit: str
    meaning: str
    above: bool = False
    decides: bool = True
    default: str = ""
    derive: Callable[[Mapping[str, float]], float] | None = None


def _constant(value: float) -> Callable[[Mapping[str, float]], float]:
    return lambda _: value


def _yaw_inertia_kgm2(chassis: Mapping[str, float]) -> float:
    return chassis["mass_kg"] * chassis["front_axle_to_cg_m"] * chassis["rear_axle_to_cg_m"]


def _track_width_m(chassis: Mapping[str, float]) -> float:
    wheelbase = chassis["front_axle_to_cg_m"] + chassis["rear_axle_to_cg_m"]
    return max(TRACK_PER_WHEELBASE * wheelbase, 2.0 * STATIC_STABILITY_FACTOR * chassis["cg_height_m"])


def _plant(low: float, high: float, unit: str, meaning: str, above: bool = False) -> Quantity:
    """A number that only the plant, the driver or the law's derating reads: no policy depends on it."""
    return Quantity(low, high, unit, meaning, above, decides=False)


Q = Quantity

# Ranges wide enough for anything from a pedal car to a truck, narrow enough to catch a wrong unit. A test turns each
# number and compares what the solver tabulates: so `decides` is right.
TABLE: dict[str, dict[str, Quantity]] = {
    "chassis": {
        "mass_kg": Q(50, 50e3, "kg", "mass with driver and load (eq. 1)"),
        "frontal_area_m2": Q(0, 20, "m2", "frontal area (eq. 3)"),
        "drag_coefficient": Q(0, 2, "", "of the air (eq. 3)"),
        "rolling_resistance": Q(0, 0.2, "", "rolling force over weight (eq. 4)"),
        "air_density_kgpm3": Q(0, 2, "kg/m3", "density of the air (eq. 3)"),
        "front_axle_to_cg_m": Q(0.1, 10, "m", "front axle to centre of gravity (eq. 7, 8)"),
        "rear_axle_to_cg_m": Q(0.1, 10, "m", "rear axle to centre of gravity; the wheelbase is the sum"),
        "cg_height_m": Q(0, 3, "m", "height of the centre of gravity"),
        "yaw_inertia_kgm2": Q(
            0, 1e6, "kg m2", "about the vertical axis", True, False, "mass * front * rear distance", _yaw_inertia_kgm2
        ),
        "front_roll_share": Q(
            0, 1, "", "the front axle's part of the roll stiffness", False, False, "0.5", _constant(0.5)
        ),
        "steering_ratio": Q(
            1, 100, "", "angle of the steering wheel over that of the road wheels", False, False, "15", _constant(15.0)
        ),
    },
    "axle": {
        "track_width_m": Q(
            0.3,
            5,
            "m",
            "distance of the two wheels",
            False,
            False,
            f"{TRACK_PER_WHEELBASE:g} * wheelbase, at least {2 * STATIC_STABILITY_FACTOR:g} * cg_height_m",
            _track_width_m,
        ),
    },
    "wheel": {
        "radius_m": Q(0.05, 2, "m", "effective rolling radius"),
        "inertia_kgm2": Q(
            1e-3, 200, "kg m2", "of one wheel and what turns with it (eq. 11); a gear's rotor comes on top"
        ),
    },
    "tyre": {"slip_speed_floor_mps": Q(1e-3, 5, "m/s", "slip is (r w - v) / max(r w, v, this): eq. 10 at rest")},
    "motor": {
        "max_power_w": Q(1, 1e6, "W", "mechanical power of one motor (eq. 19)"),
        "peak_torque_nm": Q(1, 20e3, "N m", "cold"),
        "continuous_torque_nm": _plant(1, 20e3, "N m", "hot"),
        "thermal_time_constant_s": _plant(0.1, 1e5, "s", "of the first-order heat index between the two"),
        "regeneration_torque_nm": Q(0, 20e3, "N m", "largest regenerative torque (eq. 42)"),
        "regeneration_full_above_mps": Q(0, 50, "m/s", "regeneration fades linearly from here ..."),
        "regeneration_zero_below_mps": Q(0, 50, "m/s", "... to zero here"),
        "idle_standby_w": Q(0, 1e4, "W", "idle_drive drag: one inverter with blocked gates"),
        "idle_drag_constant_nm": Q(0, 100, "N m", "idle_drive drag: torque left on the shaft at rest ..."),
        "idle_drag_linear_nm_per_radps": Q(0, 10, "N m s/rad", "... and its growth with speed"),
    },
    "gear": {
        "ratio": Q(0.05, 50, "", "turns of the motor for one of the wheel"),
        "efficiency": Q(0.5, 1, "", "power behind over power before the gear", False, True, "1", _constant(1.0)),
        "rotor_inertia_kgm2": Q(0, 10, "kg m2", "of the rotor, at the motor's shaft", False, True, "0", _constant(0.0)),
    },
    "loss": {
        "constant_w": Q(0, 1e5, "W", "loss of motor and inverter with the drive enabled: constant"),
        "linear_speed_w_per_radps": Q(0, 1e4, "W s/rad", "times speed"),
        "quadratic_speed_w_per_radps2": Q(0, 1e3, "W s2/rad2", "times speed squared"),
        "linear_torque_w_per_nm": Q(0, 1e4, "W/(N m)", "times torque, without sign"),
        "quadratic_torque_w_per_nm2": Q(0, 1e3, "W/(N m)2", "times torque squared"),
    },
    "friction_brake": {"max_torque_nm": Q(0, 1e5, "N m", "of one wheel (eq. 20)")},
    "battery": {
        "cells_in_series": Q(1, 1000, "", "cells in series"),
        "capacity_ah": _plant(0, 1e4, "Ah", "capacity (eq. 22)", True),
        "nominal_cell_voltage_v": Q(0.5, 6, "V", "of the control model's cell (eq. 21)"),
        "resistance_ohm": Q(0, 10, "ohm", "of the control model's whole pack (eq. 21)", True),
        "discharge_limit_w": Q(0, 5e6, "W", "electrical power it may give (eq. 24)"),
        "charge_limit_w": Q(0, 5e6, "W", "electrical power it may take (eq. 43)"),
        "charge_full_below_soc": _plant(0, 1, "", "the charge limit fades linearly from here ..."),
        "charge_zero_above_soc": _plant(0, 1, "", "... to zero here"),
        "discharge_full_above_soc": _plant(0, 1, "", "the discharge limit fades linearly from here ..."),
        "discharge_zero_below_soc": _plant(0, 1, "", "... to zero here"),
        "charge_full_above_degc": _plant(-50, 100, "degC", "the charge limit fades linearly from here ..."),
        "charge_zero_below_degc": _plant(-50, 100, "degC", "... to zero here"),
        "power_full_below_degc": _plant(-50, 150, "degC", "both limits fade linearly from here ..."),
        "power_zero_above_degc": _plant(-50, 150, "degC", "... to zero here"),
        "ohmic_resistance_ohm": _plant(0, 10, "ohm", "the plant's pack: resistance R0", True),
        "ohmic_factor_at_10_percent": _plant(1, 10, "", "factor on R0 at 10 % charge, rising linearly below 30 %"),
        "polarisation_resistance_ohm": _plant(0, 10, "ohm", "the plant's pack: resistance R1"),
        "polarisation_time_constant_s": _plant(1e-3, 1e5, "s", "the plant's pack: R1 * C1"),
    },
    "driver": {
        "preview_s": _plant(0, 5, "s", "the simulated driver looks this far ahead"),
        "proportional_n_per_mps": _plant(0, 1e6, "N s/m", "its proportional gain"),
        "integral_n_per_m": _plant(0, 1e6, "N/m", "its integral gain"),
        "full_brake_g": _plant(0.05, 2, "g", "deceleration a fully pressed brake pedal asks for"),
        "power_speed_floor_mps": Q(
            0.05, 5, "m/s", "a power is turned into a force at no less than this (eq. 16 at rest)"
        ),
    },
}

#: Pairs that must be ordered (a fade between two equal points would divide by zero), and whether they may be equal.
ORDERED: dict[str, tuple[tuple[str, str, bool], ...]] = {
    "motor": (
        ("regeneration_zero_below_mps", "regeneration_full_above_mps", False),
        ("continuous_torque_nm", "peak_torque_nm", True),
    ),
    "battery": (
        ("charge_full_below_soc", "charge_zero_above_soc", False),
        ("discharge_zero_below_soc", "discharge_full_above_soc", False),
        ("charge_zero_below_degc", "charge_full_above_degc", False),
        ("power_full_below_degc", "power_zero_above_degc", False),
    ),
}


def markdown() -> str:
    """The table as docs/vehicle.md has it."""
    lines = [
        "| key | unit | allowed | meaning | if it is missing | a policy depends on it |",
        "|---|---|---|---|---|---|",
    ]
    for section, table in TABLE.items():
        for key, q in table.items():
            where = {"axle": key, "loss": f"motor.loss.{key}"}.get(section, f"{section}.{key}")
            low = f"above {q.low:g}" if q.above else f"{q.low:g}"
            policy = "yes" if q.decides else ""
            lines.append(f"| `{where}` | {q.unit} | {low} to {q.high:g} | {q.meaning} | {q.default} | {policy} |")
        if section == "tyre":
            lines += [
                f"| `tyre.{key}` |  | {low:g} to {high:g} | `model: {name}`: {model.meanings[key]} |  | yes |"
                for name, model in MODELS.items()
                for key, (low, high) in model.ranges.items()
            ]
    return "\n".join(lines) + "\n"
