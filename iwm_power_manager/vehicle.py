"""A car: its YAML file, checked value by value, and the frozen numbers the kernels take."""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from iwm_power_manager import files
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.model import tyre
from iwm_power_manager.model.parameters import (
    IDLE_DRAG,
    IDLE_DRIVES,
    Axle,
    Battery,
    Chassis,
    Driver,
    FloatArray,
    FrictionBrake,
    Motor,
    Tyre,
    VehicleParams,
    Wheel,
)

FORMAT = 1


@dataclass(frozen=True)
class Vehicle:
    """A checked car.

    Attributes
    ----------
    name : the file's `name`
    path : the file it came from
    idle_drive : "none", "drag" or "enabled"
    params : the numbers for the kernels
    hash : 16 hex digits over every number the decision model reads: what a policy belongs to
    """

    name: str
    path: Path
    idle_drive: str
    params: VehicleParams
    hash: str


class _Range(NamedTuple):
    low: float
    high: float
    unit: str = ""
    above: bool = False  # low itself is excluded
    decides: bool = True  # the decision model reads it (`model.decision` and what it calls): a policy depends on it


# Ranges wide enough for anything from a pedal car to a truck, narrow enough to catch a wrong unit. What only the plant,
# the driver or the law's derating reads is marked `decides=False`: a policy does not depend on it. A test turns each
# number and compares what the solver tabulates.
_RANGES: dict[str, dict[str, _Range]] = {
    "chassis": {
        "mass_kg": _Range(50, 50e3, "kg"),
        "frontal_area_m2": _Range(0, 20, "m2"),
        "drag_coefficient": _Range(0, 2),
        "rolling_resistance": _Range(0, 0.2),
        "air_density_kgpm3": _Range(0, 2, "kg/m3"),
        "front_axle_to_cg_m": _Range(0.1, 10, "m"),
        "rear_axle_to_cg_m": _Range(0.1, 10, "m"),
        "cg_height_m": _Range(0, 3, "m"),
    },
    "wheel": {
        "radius_m": _Range(0.05, 2, "m"),
        "inertia_kgm2": _Range(1e-3, 200, "kg m2"),
    },
    "tyre": {"slip_speed_floor_mps": _Range(1e-3, 5, "m/s")},
    "motor": {
        "max_power_w": _Range(1, 1e6, "W"),
        "peak_torque_nm": _Range(1, 20e3, "N m"),
        "continuous_torque_nm": _Range(1, 20e3, "N m", decides=False),
        "thermal_time_constant_s": _Range(0.1, 1e5, "s", decides=False),
        "regeneration_torque_nm": _Range(0, 20e3, "N m"),
        "regeneration_full_above_mps": _Range(0, 50, "m/s"),
        "regeneration_zero_below_mps": _Range(0, 50, "m/s"),
        "idle_standby_w": _Range(0, 1e4, "W"),
        "idle_drag_constant_nm": _Range(0, 100, "N m"),
        "idle_drag_linear_nm_per_radps": _Range(0, 10, "N m s/rad"),
    },
    "loss": {
        "constant_w": _Range(0, 1e5, "W"),
        "linear_speed_w_per_radps": _Range(0, 1e4, "W s/rad"),
        "quadratic_speed_w_per_radps2": _Range(0, 1e3, "W s2/rad2"),
        "linear_torque_w_per_nm": _Range(0, 1e4, "W/(N m)"),
        "quadratic_torque_w_per_nm2": _Range(0, 1e3, "W/(N m)2"),
    },
    "friction_brake": {"max_torque_nm": _Range(0, 1e5, "N m")},
    "battery": {
        "cells_in_series": _Range(1, 1000),
        "capacity_ah": _Range(0, 1e4, "Ah", True, decides=False),
        "nominal_cell_voltage_v": _Range(0.5, 6, "V"),
        "resistance_ohm": _Range(0, 10, "ohm", True),
        "discharge_limit_w": _Range(0, 5e6, "W"),
        "charge_limit_w": _Range(0, 5e6, "W"),
        "charge_full_below_soc": _Range(0, 1, decides=False),
        "charge_zero_above_soc": _Range(0, 1, decides=False),
        "discharge_full_above_soc": _Range(0, 1, decides=False),
        "discharge_zero_below_soc": _Range(0, 1, decides=False),
        "charge_full_above_degc": _Range(-50, 100, "degC", decides=False),
        "charge_zero_below_degc": _Range(-50, 100, "degC", decides=False),
        "power_full_below_degc": _Range(-50, 150, "degC", decides=False),
        "power_zero_above_degc": _Range(-50, 150, "degC", decides=False),
        "ohmic_resistance_ohm": _Range(0, 10, "ohm", True, decides=False),
        "ohmic_factor_at_10_percent": _Range(1, 10, decides=False),
        "polarisation_resistance_ohm": _Range(0, 10, "ohm", decides=False),
        "polarisation_time_constant_s": _Range(1e-3, 1e5, "s", decides=False),
    },
    "driver": {
        "preview_s": _Range(0, 5, "s", decides=False),
        "proportional_n_per_mps": _Range(0, 1e6, "N s/m", decides=False),
        "integral_n_per_m": _Range(0, 1e6, "N/m", decides=False),
        "full_brake_g": _Range(0.05, 2, "g", decides=False),
        "power_speed_floor_mps": _Range(0.05, 5, "m/s"),
    },
}

# Pairs that must be ordered: a fade between two equal points would divide by zero.
_ORDERED = (
    ("motor", "regeneration_zero_below_mps", "regeneration_full_above_mps", False),
    ("motor", "continuous_torque_nm", "peak_torque_nm", True),
    ("battery", "charge_full_below_soc", "charge_zero_above_soc", False),
    ("battery", "discharge_zero_below_soc", "discharge_full_above_soc", False),
    ("battery", "charge_zero_below_degc", "charge_full_above_degc", False),
    ("battery", "power_full_below_degc", "power_zero_above_degc", False),
)

_IDLE_DRAG_KEYS = {"idle_standby_w", "idle_drag_constant_nm", "idle_drag_linear_nm_per_radps"}
_OCV_KEYS = ("ocv_soc", "ocv_cell_v")
_LOSS_FIELDS = dict(
    zip(
        _RANGES["loss"],
        (
            "loss_constant_w",
            "loss_linear_speed",
            "loss_quadratic_speed",
            "loss_linear_torque",
            "loss_quadratic_torque",
        ),
        strict=True,
    )
)


def load_vehicle(path: Path | str, idle_drive: str | None = None) -> Vehicle:
    """Read and check a vehicle file.

    Parameters
    ----------
    path : YAML file, as config/vehicles/jalalmaab_2015.yaml
    idle_drive : replaces the file's `idle_drive`

    Raises
    ------
    ConfigError
        Unknown or missing key, wrong type, out of range, NaN; the message names file, key, value, allowed range.
    """
    path = Path(path)
    content = files.read_yaml(path)
    sections = ("chassis", "wheel", "tyre", "motor", "friction_brake", "battery", "driver")
    files.check_keys(path, content, ("format", "name", "idle_drive", *sections))
    if content["format"] != FORMAT:
        raise ConfigError(path, "format", f"{content['format']!r} is unknown", str(FORMAT))
    if not isinstance(content["name"], str) or not content["name"].strip():
        raise ConfigError(path, "name", f"{content['name']!r} is no name", "text that is not empty")
    drive = files.check_choice(path, "idle_drive", content["idle_drive"], IDLE_DRIVES)
    if idle_drive is not None:
        drive = files.check_choice("idle_drive override", "idle_drive", idle_drive, IDLE_DRIVES)

    motor = _motor(path, content["motor"], drive)
    numbers = {
        name: _numbers(path, name, content[name]) for name in sections if name not in ("tyre", "motor", "battery")
    }
    battery = _battery(path, content["battery"])
    for section, small, large, may_equal in _ORDERED:
        low, high = content[section][small], content[section][large]
        if low > high or (low == high and not may_equal):
            relation = "at least" if may_equal else "more than"
            raise ConfigError(path, f"{section}.{large}", f"{high} is out of range", f"{relation} {small} = {low}")
    axle = Axle(
        wheel=Wheel(**numbers["wheel"]),
        tyre=_tyre(path, content["tyre"]),
        motor=motor,
        friction_brake=FrictionBrake(**numbers["friction_brake"]),
    )
    params = VehicleParams(
        chassis=Chassis(**numbers["chassis"]),
        front=axle,
        rear=axle,
        battery=battery,
        driver=Driver(**numbers["driver"]),
    )
    _check_tips_over(path, params.chassis)
    return Vehicle(content["name"].strip(), path, drive, params, _hash(params))


def with_idle_drive(vehicle: Vehicle, idle_drive: str) -> Vehicle:
    """The same car with another `idle_drive`."""
    code = IDLE_DRIVES[files.check_choice("idle_drive", "idle_drive", idle_drive, IDLE_DRIVES)]
    params = vehicle.params
    params = params._replace(
        front=params.front._replace(motor=params.front.motor._replace(idle_drive=code)),
        rear=params.rear._replace(motor=params.rear.motor._replace(idle_drive=code)),
    )
    return dataclasses.replace(vehicle, idle_drive=idle_drive, params=params, hash=_hash(params))


def with_params(vehicle: Vehicle, name: str, params: VehicleParams) -> Vehicle:
    """A car with other numbers, for sensitivity studies; it gets its own hash."""
    return dataclasses.replace(vehicle, name=name, params=params, hash=_hash(params))


def _numbers(path: Path, section: str, mapping: Any, optional: tuple[str, ...] = ()) -> dict[str, float]:
    ranges = _RANGES[section]
    files.check_keys(path, mapping, ranges, optional, section)
    return {
        key: files.check_number(path, f"{section}.{key}", mapping[key], r.low, r.high, above=r.above, unit=r.unit)
        for key, r in ranges.items()
    }


def _tyre(path: Path, mapping: Any) -> Tyre:
    """The tyre section: the keys of the model it names (`tyre.DEFAULT` if it names none), and the slip's floor."""
    name = mapping.get("model", tyre.DEFAULT) if isinstance(mapping, dict) else tyre.DEFAULT
    ranges = tyre.MODELS[files.check_choice(path, "tyre.model", name, tyre.MODELS)].ranges
    floor = _RANGES["tyre"]["slip_speed_floor_mps"]
    files.check_keys(path, mapping, (*ranges, "slip_speed_floor_mps"), ("model",), "tyre")
    values = {
        key: files.check_number(path, f"tyre.{key}", mapping[key], low, high) for key, (low, high) in ranges.items()
    }
    speed = files.check_number(
        path, "tyre.slip_speed_floor_mps", mapping["slip_speed_floor_mps"], floor.low, floor.high, unit=floor.unit
    )
    return tyre.make(name, values, speed)


def _motor(path: Path, mapping: Any, drive: str) -> Motor:
    numbers = _numbers(path, "motor", mapping, ("loss", "efficiency_map"))
    empty = np.zeros(0)
    loss: dict[str, Any] = dict.fromkeys(_LOSS_FIELDS.values(), 0.0)
    speed, torque, table = empty, empty, np.zeros((0, 0))
    if ("loss" in mapping) == ("efficiency_map" in mapping):
        raise ConfigError(path, "motor", "needs exactly one of loss, efficiency_map", "loss | efficiency_map")
    if "loss" in mapping:
        section = mapping["loss"]
        files.check_keys(path, section, _LOSS_FIELDS, (), "motor.loss")
        for key, field in _LOSS_FIELDS.items():
            r = _RANGES["loss"][key]
            loss[field] = files.check_number(path, f"motor.loss.{key}", section[key], r.low, r.high, unit=r.unit)
    else:
        name = mapping["efficiency_map"]
        if not isinstance(name, str):
            raise ConfigError(path, "motor.efficiency_map", f"{name!r} is no file name", "path of a CSV file")
        speed, torque, table = load_efficiency_map(path.parent / name)
    return Motor(
        **numbers,
        **loss,
        idle_drive=IDLE_DRIVES[drive],
        map_speed_radps=speed,
        map_torque_nm=torque,
        map_loss_w=table.reshape(-1),
    )


def _battery(path: Path, mapping: Any) -> Battery:
    numbers = _numbers(path, "battery", mapping, _OCV_KEYS)
    curve = {}
    for key, low, high in (("ocv_soc", 0.0, 1.0), ("ocv_cell_v", 0.5, 6.0)):
        where = f"battery.{key}"
        values = mapping.get(key)
        if not isinstance(values, list) or len(values) < 2:
            problem = "is missing" if key not in mapping else f"{values!r} is no list of two or more numbers"
            raise ConfigError(path, where, problem)
        curve[key] = np.array([files.check_number(path, f"{where}[{i}]", x, low, high) for i, x in enumerate(values)])
    soc, volt = curve["ocv_soc"], curve["ocv_cell_v"]
    if len(soc) != len(volt):
        raise ConfigError(path, "battery.ocv_cell_v", f"has {len(volt)} values", f"{len(soc)}, as many as ocv_soc")
    if soc[0] != 0.0 or soc[-1] != 1.0 or np.any(np.diff(soc) <= 0):
        raise ConfigError(path, "battery.ocv_soc", f"{soc.tolist()} is out of order", "rising from 0 to 1")
    if np.any(np.diff(volt) < 0):
        raise ConfigError(path, "battery.ocv_cell_v", f"{volt.tolist()} falls", "voltages that never fall with SoC")
    return Battery(**numbers, ocv_soc=soc, ocv_cell_v=volt)


def _check_tips_over(path: Path, chassis: Chassis) -> None:
    """Refuse a car whose rear axle lifts before full braking on dry road is reached."""
    highest = min(chassis.front_axle_to_cg_m, chassis.rear_axle_to_cg_m) / 1.0
    if chassis.cg_height_m >= highest:
        raise ConfigError(
            path, "chassis.cg_height_m", f"{chassis.cg_height_m} m lifts an axle at 1 g", f"below {highest:g} m"
        )


def load_efficiency_map(path: Path | str) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Read a motor map and turn it into losses.

    The CSV has the columns `speed_rad_s,torque_nm,efficiency`, one row for every point of a full grid. Efficiency is
    mechanical over electrical power when driving and electrical over mechanical when regenerating (eq. 14, 15). A map
    without negative torque is mirrored: regeneration then has the loss of the same driving torque. At zero speed or
    zero torque the efficiency says nothing; there the loss is continued from the neighbours on the grid, as is what
    lies outside it.

    Returns
    -------
    speed_radps : (n,), torque_nm : (m,), loss_w : (n, m)

    Raises
    ------
    ConfigError
    """
    path = Path(path)
    rows: dict[tuple[float, float], float] = {}
    reader = csv.reader(files.read_text(path).splitlines())
    columns = ("speed_rad_s", "torque_nm", "efficiency")
    header = [cell.strip() for cell in next(reader, [])]
    if tuple(header) != columns:
        raise ConfigError(path, "line 1", f"{','.join(header)!r} is no header", ",".join(columns))
    for line, cells in enumerate(reader, start=2):
        if not cells:
            continue
        if len(cells) != 3:
            raise ConfigError(path, f"line {line}", f"has {len(cells)} values", "3")
        speed, torque, efficiency = (
            _cell(path, line, column, cell, low, high)
            for column, cell, (low, high) in zip(columns, cells, ((0, 2000), (-20e3, 20e3), (0, 1)), strict=True)
        )
        if (speed, torque) in rows:
            raise ConfigError(path, f"line {line}", f"repeats speed {speed:g}, torque {torque:g}")
        if efficiency == 0.0 and speed * torque != 0.0:
            raise ConfigError(path, f"line {line}", "efficiency 0 means an infinite loss", "above 0, up to 1")
        rows[speed, torque] = efficiency
    speeds = np.array(sorted({s for s, _ in rows}))
    torques = np.array(sorted({t for _, t in rows}))
    if len(speeds) < 2 or len(torques) < 2:
        raise ConfigError(path, "", f"has {len(speeds)} speeds and {len(torques)} torques", "2 or more of each")
    for s in speeds:
        for t in torques:
            if (s, t) not in rows:
                raise ConfigError(path, "", f"lacks the point speed {s:g}, torque {t:g}", "a full grid")
    loss = np.full((len(speeds), len(torques)), np.nan)
    for i, s in enumerate(speeds):
        for j, t in enumerate(torques):
            power = s * t
            if power > 0:
                loss[i, j] = power / rows[s, t] - power
            elif power < 0:
                loss[i, j] = -power * (1.0 - rows[s, t])
    loss = _continue_losses(path, speeds, torques, loss)
    if torques[0] >= 0:
        driving = torques > 0
        torques = np.concatenate((-torques[driving][::-1], torques))
        loss = np.ascontiguousarray(np.concatenate((loss[:, driving][:, ::-1], loss), axis=1))
    return speeds, torques, loss


def _cell(path: Path, line: int, column: str, text: str, low: float, high: float) -> float:
    try:
        value = float(text)
    except ValueError:
        raise ConfigError(path, f"line {line}, {column}", f"{text!r} is no number", f"{low:g} to {high:g}") from None
    return files.check_number(path, f"line {line}, {column}", value, low, high)


def _continue_losses(path: Path, speeds: FloatArray, torques: FloatArray, loss: FloatArray) -> FloatArray:
    """Fill the points without power (speed or torque zero): along torque between both signs, then along speed."""
    for i in range(len(speeds)):
        known = ~np.isnan(loss[i])
        if known.any():
            loss[i] = np.interp(torques, torques[known], loss[i, known])
    rows = ~np.isnan(loss).any(axis=1)
    if not rows.any():
        raise ConfigError(path, "", "has no point with speed and torque above zero")
    filled = np.array([np.interp(speeds, speeds[rows], loss[rows, j]) for j in range(len(torques))]).T
    return np.ascontiguousarray(filled)


def _hash(params: VehicleParams) -> str:
    """Hash over every number of both axles that the decision model reads, and nothing else."""
    content = {
        "chassis": _decisive("chassis", params.chassis),
        "battery": _decisive("battery", params.battery),
        "driver": _decisive("driver", params.driver),
        "front": {part: _decisive(part, values) for part, values in params.front._asdict().items()},
        "rear": {part: _decisive(part, values) for part, values in params.rear._asdict().items()},
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def _decisive(section: str, values: Any) -> dict[str, Any]:
    """The numbers of a section that a decision depends on, exactly, by name."""
    kept = {key for key, r in _RANGES[section].items() if r.decides}
    if section == "motor":
        # Where an idle motor does not drag, nobody asks what its drag would be.
        kept -= set() if values.idle_drive == IDLE_DRAG else _IDLE_DRAG_KEYS
        kept |= {"idle_drive", *_LOSS_FIELDS.values(), *(name for name in values._fields if name.startswith("map_"))}

    def plain(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            return [float(x).hex() for x in value.ravel()]
        return float(value).hex() if isinstance(value, float) else value

    if isinstance(values, Tyre):
        model, coefficients = tyre.numbers(values)
        named = {} if model == tyre.DEFAULT else {"model": model}
        numbers = coefficients | {"slip_speed_floor_mps": values.slip_speed_floor_mps}
        return named | {name: plain(value) for name, value in numbers.items()}
    return {name: plain(value) for name, value in values._asdict().items() if name in kept}


def nominal_voltage_v(battery: Battery) -> float:
    """Open-circuit voltage of the control model's pack, V (Table 1)."""
    return battery.cells_in_series * battery.nominal_cell_voltage_v


def pack_energy_wh(battery: Battery) -> float:
    """Nominal energy of the pack, Wh."""
    return nominal_voltage_v(battery) * battery.capacity_ah
