# SPDX-License-Identifier: Apache-2.0
"""A car: its YAML file, checked value by value, and the frozen numbers the kernels take."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from iwm_power_manager import files, plausibility
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.gear import behind_gear
from iwm_power_manager.model import tyre
from iwm_power_manager.model.parameters import (
    IDLE_DRAG,
    IDLE_DRIVES,
    Axle,
    Battery,
    Chassis,
    Driver,
    FrictionBrake,
    Motor,
    Tyre,
    VehicleParams,
    Wheel,
)
from iwm_power_manager.model.top_speed import top_speed_mps
from iwm_power_manager.motor_map import MotorMap, Reach, extended, filled, fit_loss, mirrored, missing, read_map
from iwm_power_manager.vehicle_table import ORDERED, TABLE

#: 1: one section for both axles. 2: sections may stand in `front:` and `rear:`, and motors behind a gear.
FORMATS = (1, 2)
#: What the two wheels of an axle have in common. `gear` may be missing.
AXLE_PARTS = ("wheel", "tyre", "motor", "friction_brake")


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
    notes : what a reader should know of how it was read, one line each; tools print them
    """

    name: str
    path: Path
    idle_drive: str
    params: VehicleParams = dataclasses.field(repr=False)
    hash: str
    notes: tuple[str, ...] = ()


#: A map may reach beyond the car's top speed by this factor; rpm in a rad/s column are 9.5 times as many.
MAX_MAP_SPEED_RATIO = 5.0
_MOTOR_OPTIONS = ("loss", "efficiency_map", "mirror", "extrapolate")
_IDLE_DRAG_KEYS = {"idle_standby_w", "idle_drag_constant_nm", "idle_drag_linear_nm_per_radps"}
_OCV_KEYS = ("ocv_soc", "ocv_cell_v")
_LOSS_FIELDS = dict(
    zip(
        TABLE["loss"],
        ("loss_constant_w", "loss_linear_speed", "loss_quadratic_speed", "loss_linear_torque", "loss_quadratic_torque"),
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
    files.check_keys(
        path,
        content,
        ("format", "name", "idle_drive", "chassis", "battery", "driver"),
        (*AXLE_PARTS, "gear", "front", "rear"),
    )
    if content["format"] not in FORMATS or isinstance(content["format"], bool):
        raise ConfigError(path, "format", f"{content['format']!r} is unknown", " | ".join(map(str, FORMATS)))
    for key in ("gear", "front", "rear"):
        if key in content and content["format"] == 1:
            raise ConfigError(path, key, "is an unknown key in format 1", "format: 2")
    name = files.check_name(path, "name", content["name"])
    drive = files.check_choice(path, "idle_drive", content["idle_drive"], IDLE_DRIVES)
    if idle_drive is not None:
        drive = files.check_choice("idle_drive override", "idle_drive", idle_drive, IDLE_DRIVES)

    chassis = _numbers(path, "chassis", "chassis", content["chassis"])
    front, rear, notes = _axles(path, content, chassis, drive)
    params = VehicleParams(
        chassis=Chassis(**chassis),
        front=front,
        rear=rear,
        battery=_battery(path, content["battery"]),
        driver=Driver(**_numbers(path, "driver", "driver", content["driver"])),
    )
    _check_tips_over(path, params.chassis)
    plausibility.check_car(path, params, lambda axle, part: f"{axle}.{part}" if part in content.get(axle, {}) else part)
    notes += tuple(f"{path}: {line}" for line in plausibility.unusual(params))
    return Vehicle(name, path, drive, params, _hash(params), notes)


def with_params(vehicle: Vehicle, name: str, params: VehicleParams) -> Vehicle:
    """A car with other numbers, for sensitivity studies; it gets its own hash."""
    return dataclasses.replace(vehicle, name=name, params=params, hash=_hash(params))


def _numbers(
    path: Path,
    section: str,
    where: str,
    mapping: Any,
    optional: tuple[str, ...] = (),
    chassis: Mapping[str, float] | None = None,
) -> dict[str, float]:
    """The numbers of a section of the table, which stands at `where` in the file; what is not given is derived."""
    table = TABLE[section]
    derived = tuple(key for key, q in table.items() if q.derive)
    files.check_keys(path, mapping, (key for key in table if key not in derived), (*derived, *optional), where)
    numbers: dict[str, float] = {}
    for key, q in table.items():
        if key in mapping or q.derive is None:
            value = mapping[key]
            numbers[key] = files.check_number(path, f"{where}.{key}", value, q.low, q.high, above=q.above, unit=q.unit)
        else:
            numbers[key] = q.derive(numbers if chassis is None else chassis)
    for small, large, may_equal in ORDERED.get(section, ()):
        low, high = numbers[small], numbers[large]
        if low > high or (low == high and not may_equal):
            relation = "at least" if may_equal else "more than"
            raise ConfigError(path, f"{where}.{large}", f"{high} is out of range", f"{relation} {small} = {low}")
    return numbers


class _Axle(NamedTuple):
    """An axle's part of the file: where each section stands, and its content."""

    sections: dict[str, tuple[str, Any]]
    own: Mapping[str, Any]


def _sections(path: Path, content: Mapping[str, Any], axle: str) -> _Axle:
    """Each part from the axle's own section, or from the one section for both."""
    own = content.get(axle, {})
    files.check_keys(path, own, (), (*AXLE_PARTS, "gear", *TABLE["axle"]), axle)
    sections = {}
    for part in (*AXLE_PARTS, "gear"):
        if part in content and part in own:
            raise ConfigError(path, f"{axle}.{part}", f"stands beside {part}, which is for both axles", "one of them")
        if part in own:
            sections[part] = f"{axle}.{part}", own[part]
        elif part in content:
            sections[part] = part, content[part]
        elif part != "gear":
            raise ConfigError(path, f"{axle}.{part}" if {"front", "rear"} & set(content) else part, "is missing")
    return _Axle(sections, {key: own[key] for key in TABLE["axle"] if key in own})


def _axles(
    path: Path, content: Mapping[str, Any], chassis: Mapping[str, float], drive: str
) -> tuple[Axle, Axle, tuple[str, ...]]:
    """Front and rear axle, and what there is to say about their motor maps."""
    given = {axle: _sections(path, content, axle) for axle in ("front", "rear")}
    motors = {axle: _numbers(path, "motor", *found.sections["motor"], _MOTOR_OPTIONS) for axle, found in given.items()}
    power_w = 2.0 * sum(motor["max_power_w"] for motor in motors.values())
    reach_mps = top_speed_mps(Chassis(**chassis), power_w, plausibility.MAX_TOP_SPEED_MPS)
    axles: list[Axle] = []
    notes: list[str] = []
    for axle, found in given.items():
        if axles and found == given["front"]:  # one section for both: the same numbers, and the same arrays
            axles.append(axles[0])
            break
        wheel = Wheel(**_numbers(path, "wheel", *found.sections["wheel"]))
        gear = _numbers(path, "gear", *found.sections["gear"], (), chassis) if "gear" in found.sections else None
        shaft_radps = reach_mps / wheel.radius_m * (gear["ratio"] if gear else 1.0)
        motor, note = _motor(path, *found.sections["motor"], motors[axle], drive, shaft_radps, content["format"])
        if gear:
            motor, wheel = behind_gear(motor, wheel, **gear)
        axles.append(
            Axle(
                wheel=wheel,
                tyre=_tyre(path, *found.sections["tyre"]),
                motor=motor,
                friction_brake=FrictionBrake(**_numbers(path, "friction_brake", *found.sections["friction_brake"])),
                **_numbers(path, "axle", axle, found.own, (), chassis),
            )
        )
        notes += note
    return axles[0], axles[1], tuple(dict.fromkeys(notes))


def _tyre(path: Path, where: str, mapping: Any) -> Tyre:
    """The tyre section: the keys of the model it names (`tyre.DEFAULT` if it names none), and the slip's floor."""
    name = mapping.get("model", tyre.DEFAULT) if isinstance(mapping, Mapping) else tyre.DEFAULT
    ranges = tyre.MODELS[files.check_choice(path, f"{where}.model", name, tyre.MODELS)].ranges
    files.check_keys(path, mapping, (*ranges, *TABLE["tyre"]), ("model",), where)
    values = {
        key: files.check_number(path, f"{where}.{key}", mapping[key], low, high) for key, (low, high) in ranges.items()
    }
    floor = _numbers(path, "tyre", where, {key: mapping[key] for key in TABLE["tyre"]})
    return tyre.make(name, values, **floor)


def _motor(
    path: Path,
    where: str,
    mapping: Mapping[str, Any],
    numbers: dict[str, float],
    drive: str,
    top_speed_radps: float,
    file_format: int,
) -> tuple[Motor, list[str]]:
    """A motor from its checked numbers and its losses; `top_speed_radps` is what its map has to reach."""
    if ("loss" in mapping) == ("efficiency_map" in mapping):
        raise ConfigError(path, where, "needs exactly one of loss, efficiency_map", "loss | efficiency_map")
    empty = np.zeros(0)
    loss: dict[str, Any] = dict.fromkeys(_LOSS_FIELDS.values(), 0.0)
    table = MotorMap(empty, empty, np.zeros((0, 0)))
    notes: list[str] = []
    if "loss" in mapping:
        for key in ("mirror", "extrapolate"):
            if key in mapping:
                raise ConfigError(path, f"{where}.{key}", "is for an efficiency_map")
        given = _numbers(path, "loss", f"{where}.loss", mapping["loss"])
        loss = {_LOSS_FIELDS[key]: value for key, value in given.items()}
    else:
        reach = Reach(
            peak_torque_nm=numbers["peak_torque_nm"],
            regeneration_torque_nm=numbers["regeneration_torque_nm"],
            max_power_w=numbers["max_power_w"],
            top_speed_radps=top_speed_radps,
        )
        table, notes = _map(path, where, mapping, reach, file_format)
    motor = Motor(
        **numbers,
        **loss,
        idle_drive=IDLE_DRIVES[drive],
        map_speed_radps=table.speed_radps,
        map_torque_nm=table.torque_nm,
        map_loss_w=table.loss_w.reshape(-1),
    )
    return motor, notes


def _map(
    path: Path, where: str, mapping: Mapping[str, Any], reach: Reach, file_format: int
) -> tuple[MotorMap, list[str]]:
    """The motor's map, which covers what the motor can do, and what there is to say about it."""
    name = mapping["efficiency_map"]
    if not isinstance(name, str):
        raise ConfigError(path, f"{where}.efficiency_map", f"{name!r} is no file name", "path of a CSV file")
    mirror = files.check_bool(path, f"{where}.mirror", mapping["mirror"]) if "mirror" in mapping else None
    source = path.parent / name
    # Format 1 mirrors a map of driving torques unasked.
    found = mirrored(source, read_map(source), mirror if file_format == 1 else bool(mirror))
    if found.speed_radps[-1] > MAX_MAP_SPEED_RATIO * reach.top_speed_radps:
        problem = (
            f"reaches {found.speed_radps[-1]:g} rad/s, and the car's top speed is {reach.top_speed_radps:.4g} rad/s"
        )
        likely = "rpm in a rad/s column, or a motor's shaft without gear?"
        allowed = f"up to {MAX_MAP_SPEED_RATIO:g} times the top speed"
        raise ConfigError(source, "speed_rad_s", f"{problem}: {likely}", allowed)
    lacking = missing(found, reach)
    notes = []
    if lacking and "extrapolate" in mapping:
        files.check_choice(path, f"{where}.extrapolate", mapping["extrapolate"], ("loss_model",))
        fit = fit_loss(found)
        found = extended(found, reach, fit)
        notes.append(
            f"{source.name}: {'; '.join(lacking)} taken from the loss model {fit}, which meets the map's efficiencies "
            f"to {fit.rms_error:.3f} rms, {fit.worst_error:.3f} at most"
        )
    elif lacking:
        raise ConfigError(source, "", f"lacks {'; '.join(lacking)}", "all of it, or extrapolate: loss_model")
    return filled(found), notes


def _battery(path: Path, mapping: Any) -> Battery:
    numbers = _numbers(path, "battery", "battery", mapping, _OCV_KEYS)
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


def _hash(params: VehicleParams) -> str:
    """Hash over every number of both axles that the decision model reads, and nothing else."""
    content = {
        "chassis": _decisive("chassis", params.chassis),
        "battery": _decisive("battery", params.battery),
        "driver": _decisive("driver", params.driver),
        "front": {part: _decisive(part, getattr(params.front, part)) for part in AXLE_PARTS},
        "rear": {part: _decisive(part, getattr(params.rear, part)) for part in AXLE_PARTS},
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def _decisive(section: str, values: Any) -> dict[str, Any]:
    """The numbers of a section that a decision depends on, exactly, by name."""
    kept = {key for key, q in TABLE[section].items() if q.decides}
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
