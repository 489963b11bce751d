# SPDX-License-Identifier: Apache-2.0
"""Scenarios: what is driven, where, by whom, and what fails; one YAML file for `evaluate`, simulator, demo and `roads`.

    format: 1
    about: one sentence                       # what it shows
    vehicle: jalalmaab_2015                   # file or name; optional
    load_kg: 0.0                              # what the car carries and the power manager does not know; optional
    start: {speed_mps: 25.0, soc: 0.8}        # optional; a cycle has its own speed
    cycle: nycc                               # either a speed trace ...
    demand:                                   # ... or what the driver does, each until the next: one of accelerator,
      - {from_s: 1.0, brake: 1.0}             #     brake (0..1), power_w (W at the wheels), braking_mps2
    steering: lane                            # lane: a driver keeps the lane; or a list of from_s, wheel_deg; optional
    direction: forward                        # or reverse: the direction asked for; optional
    road:
      friction: 0.9                           # a number, or a list of from_m, left, right (or friction), from 0
      grade: 0.0                              # a number, or a list of from_m, grade
      headwind_mps: 0.0
    assumed_friction: 0.9                     # what the power manager is told; optional: the road's at its start
    until: {time_s: 30.0, standstill: true}   # the end; standstill needs a time as well
    foreign_brakes:                           # of another system; the power manager has no friction brakes then
      - {from_s: 2.0, braking_mps2: 6.0}
    imu: false                                # whether the power manager hears the IMU
    faults:
      - {sensor: vehicle_speed, factor: 1.2, from_s: 2.0, until_s: 4.0}
      - {actuator: motor_front_left, dead: true, from_s: 2.0}
      - {message: power_demand, lost: true, from_s: 2.0}
      - {message: wheel_states, delay_s: 0.02, jitter_s: 0.01}
    require:                                  # what must come out, by the names of `iwm_sim.road_measures`
      split_rate: {at_least: 1.0}
    aim:                                      # what is aimed at beyond that; said, and no failure
      stopping_distance_m: {at_most: 88.0}

Between two places of a list friction jumps and grade is constant.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from iwm_power_manager import files
from iwm_power_manager.cycle import MAX_GRADE, Cycle, load_cycle
from iwm_power_manager.errors import ConfigError, one_line
from iwm_power_manager.model.parameters import VehicleParams
from iwm_power_manager.share import did_you_mean, resolve
from iwm_power_manager.vehicle import Vehicle, load_vehicle
from iwm_sim import faults
from iwm_sim.faults import Fault
from iwm_sim.road_measures import NAMES

FORMAT = 1
DEFAULT_VEHICLE = "config/vehicles/jalalmaab_2015.yaml"
FOLDER = "config/scenarios"

_LONGEST_S = 86400.0
_FILES = "a file, or the name of one of the package"
_KEYS = (
    "vehicle",
    "load_kg",
    "start",
    "cycle",
    "demand",
    "steering",
    "direction",
    "assumed_friction",
    "until",
    "foreign_brakes",
    "imu",
    "faults",
    "require",
    "aim",
)
_DEMANDS = {
    "accelerator": (0.0, 1.0, ""),
    "brake": (0.0, 1.0, ""),
    "power_w": (-1e6, 1e6, "W"),
    "braking_mps2": (0.0, 20.0, "m/s2"),
}
_FAULT_TARGETS = {
    "sensor": (faults.SENSORS, faults.SENSOR_KINDS),
    "actuator": (faults.ACTUATORS, faults.ACTUATOR_KINDS),
    "message": (faults.MESSAGES, faults.MESSAGE_KINDS),
}
DIRECTIONS = {"forward": 1, "reverse": -1}


class Demand(NamedTuple):
    """What the driver asks for from a time on: `kind` is accelerator, brake, power_w or braking_mps2."""

    from_s: float
    kind: str
    value: float


class Friction(NamedTuple):
    """Peak friction coefficients from a place on, left and right of the lane's middle."""

    from_m: float
    left: float
    right: float


class Bound(NamedTuple):
    """What a measure has to be, or, as an aim, should be."""

    measure: str
    at_least: float
    at_most: float
    aim: bool = False


@dataclass(frozen=True)
class Scenario:
    """A checked scenario; the module's docstring says what each part means.

    Attributes
    ----------
    truth : the car as it is, load included; `vehicle` is what power manager and driver believe in
    steering : (from_s, angle of the steering wheel in rad); None for the driver who keeps the lane
    foreign_brakes : (from_s, deceleration in m/s2) of another system, which has the friction brakes
    imu : the power manager hears accelerometer and gyroscope
    """

    name: str
    vehicle: Vehicle
    truth: VehicleParams
    duration_s: float
    cycle: Cycle | None = None
    demand: tuple[Demand, ...] = ()
    steering: tuple[tuple[float, float], ...] | None = ()
    direction: int = 1
    friction: tuple[Friction, ...] = (Friction(0.0, 0.9, 0.9),)
    grade: tuple[tuple[float, float], ...] = ((0.0, 0.0),)
    headwind_mps: float = 0.0
    assumed_friction: float = 0.9
    speed_mps: float = 0.0
    soc: float = 0.8
    to_standstill: bool = False
    foreign_brakes: tuple[tuple[float, float], ...] = ()
    imu: bool = False
    faults: tuple[Fault, ...] = ()
    require: tuple[Bound, ...] = ()
    about: str = ""
    path: str = ""
    described: str = field(default="", compare=False)


def on_cycle(vehicle: Vehicle, cycle: Cycle, friction: float, soc: float = 0.8, until_s: float = math.inf) -> Scenario:
    """A cycle on a straight, uniform road, as without a scenario file."""
    return Scenario(
        name=cycle.name,
        vehicle=vehicle,
        truth=vehicle.params,
        duration_s=min(cycle.duration_s, until_s),
        cycle=cycle,
        friction=(Friction(0.0, friction, friction),),
        assumed_friction=friction,
        speed_mps=float(cycle.speed_mps[0]),
        soc=soc,
        described=f"{vehicle.name} on {cycle.name}, friction {friction:g}, idle drive {vehicle.idle_drive}",
    )


def load_scenario(name: Path | str, idle_drive: str | None = None, vehicle: Vehicle | None = None) -> Scenario:
    """Read and check a scenario.

    Parameters
    ----------
    name : file, or name of one of the package's scenarios
    idle_drive : replaces the vehicle's
    vehicle : drives it instead of the scenario's own

    Raises
    ------
    ConfigError
        The message names file, key, value and what is allowed.
    """
    path = resolve(name)
    content = files.read_yaml(path)
    files.check_keys(path, content, ("format", "about", "road"), _KEYS)
    if content["format"] != FORMAT:
        raise ConfigError(path, "format", f"{content['format']!r} is unknown", str(FORMAT))
    named = content.get("vehicle", DEFAULT_VEHICLE)
    vehicle = vehicle or load_vehicle(_file(path, "vehicle", named), idle_drive)
    if ("cycle" in content) == ("demand" in content):
        raise ConfigError(path, "", "needs exactly one of cycle, demand", "cycle | demand")
    cycle = load_cycle(_file(path, "cycle", content["cycle"])) if "cycle" in content else None
    start = files.check_keys(path, content.get("start", {}), (), ("speed_mps", "soc"), "start")
    if cycle and "speed_mps" in start:
        raise ConfigError(path, "start.speed_mps", "stands beside a cycle, which begins at its own", "cycle without it")
    first = float(cycle.speed_mps[0]) if cycle else 0.0
    road = files.check_keys(path, content["road"], ("friction",), ("grade", "headwind_mps"), "road")
    friction = _friction(path, road["friction"])
    duration_s, to_standstill = _until(path, content.get("until"), cycle)
    _check_reached(path, content, duration_s)
    about = content["about"]
    if not isinstance(about, str) or not about.strip():
        raise ConfigError(path, "about", f"{about!r} is no sentence", "text that is not empty")
    direction = files.check_choice(path, "direction", content.get("direction", "forward"), DIRECTIONS)
    told = content.get("assumed_friction", min(friction[0].left, friction[0].right))
    return Scenario(
        name=path.stem,
        vehicle=vehicle,
        truth=_loaded(vehicle.params, files.check_number(path, "load_kg", content.get("load_kg", 0.0), 0.0, 50e3)),
        duration_s=duration_s,
        cycle=cycle,
        demand=_demand(path, content["demand"]) if "demand" in content else (),
        steering=_steering(path, content.get("steering", []), vehicle.params.chassis.steering_ratio),
        direction=DIRECTIONS[direction],
        friction=friction,
        grade=_grade(path, road.get("grade", 0.0)),
        headwind_mps=files.check_number(path, "road.headwind_mps", road.get("headwind_mps", 0.0), -60.0, 60.0),
        assumed_friction=files.check_number(path, "assumed_friction", told, 0.05, 1.5),
        speed_mps=files.check_number(path, "start.speed_mps", start.get("speed_mps", first), -20.0, 70.0, unit="m/s"),
        soc=files.check_number(path, "start.soc", start.get("soc", 0.8), 0.0, 1.0),
        to_standstill=to_standstill,
        foreign_brakes=_foreign(path, content.get("foreign_brakes", [])),
        imu=files.check_bool(path, "imu", content.get("imu", False)),
        faults=_faults(path, content.get("faults", [])),
        require=(*_bounds(path, content, "require"), *_bounds(path, content, "aim")),
        about=one_line(" ".join(about.split())),
        path=str(path),
        described=f"{vehicle.name} in {path.stem}, idle drive {vehicle.idle_drive}",
    )


def _file(path: Path, key: str, name: Any) -> Path:
    if not isinstance(name, str):
        raise ConfigError(path, key, f"{name!r} is no file name", _FILES)
    beside = path.parent / name
    if os.path.isfile(beside):
        return beside
    try:
        found = resolve(name)
    except ConfigError as error:
        raise ConfigError(path, key, str(error)) from None
    if not os.path.isfile(found):
        raise ConfigError(path, key, f"{name!r} is no file", f"{_FILES}{did_you_mean(beside)}")
    return found


def _loaded(vehicle: VehicleParams, load_kg: float) -> VehicleParams:
    """The car with a load at its centre of gravity."""
    chassis = vehicle.chassis
    factor = 1.0 + load_kg / chassis.mass_kg
    return vehicle._replace(
        chassis=chassis._replace(mass_kg=chassis.mass_kg * factor, yaw_inertia_kgm2=chassis.yaw_inertia_kgm2 * factor)
    )


def _until(path: Path, content: Any, cycle: Cycle | None) -> tuple[float, bool]:
    if content is None:
        if cycle is None:
            raise ConfigError(path, "until", "is missing", "time_s, and standstill: true if it may end earlier")
        return cycle.duration_s, False
    files.check_keys(path, content, ("time_s",), ("standstill",), "until")
    time_s = files.check_number(path, "until.time_s", content["time_s"], 0.0, _LONGEST_S, above=True, unit="s")
    if cycle is not None:
        time_s = min(time_s, cycle.duration_s)
    return time_s, files.check_bool(path, "until.standstill", content.get("standstill", False))


def _check_reached(path: Path, content: Mapping[str, Any], duration_s: float) -> None:
    """Refuse what would begin after the end: nothing would be tested by it, and what is required would be met."""
    for key in ("demand", "steering", "foreign_brakes", "faults"):
        for i, entry in enumerate(content.get(key) or () if isinstance(content.get(key), list) else ()):
            begins = entry.get("from_s") if isinstance(entry, dict) else None
            if isinstance(begins, int | float) and begins >= duration_s:
                raise ConfigError(path, f"{key}[{i}].from_s", f"{begins:g} is never reached", f"< {duration_s:g} s")


def _listed(path: Path, key: str, content: Any, start: str, least: float) -> list[tuple[str, Mapping[str, Any]]]:
    """Entries of a list that is ordered by its key `start`, each with its dotted name."""
    if not isinstance(content, list) or not content:
        raise ConfigError(path, key, f"{content!r} is no list", f"entries with {start}")
    entries: list[tuple[str, Mapping[str, Any]]] = []
    last = -math.inf
    for i, entry in enumerate(content):
        where = f"{key}[{i}]"
        if not isinstance(entry, dict) or start not in entry:
            raise ConfigError(path, where, f"has no {start}", f"a mapping with {start}")
        at = files.check_number(path, f"{where}.{start}", entry[start], least, 1e6)
        if at <= last:
            raise ConfigError(path, f"{where}.{start}", f"{at:g} does not rise", f"> {last:g}")
        last = at
        entries.append((where, entry))
    return entries


def _demand(path: Path, content: Any) -> tuple[Demand, ...]:
    result = []
    for where, entry in _listed(path, "demand", content, "from_s", 0.0):
        kinds = [key for key in entry if key != "from_s"]
        if len(kinds) != 1 or kinds[0] not in _DEMANDS:
            raise ConfigError(path, where, "asks for something else", f"from_s and one of {', '.join(_DEMANDS)}")
        low, high, unit = _DEMANDS[kinds[0]]
        value = files.check_number(path, f"{where}.{kinds[0]}", entry[kinds[0]], low, high, unit=unit)
        result.append(Demand(float(entry["from_s"]), kinds[0], value))
    return tuple(result)


def _steering(path: Path, content: Any, ratio: float) -> tuple[tuple[float, float], ...] | None:
    if content == "lane":
        return None
    if content == []:
        return ()
    if not isinstance(content, list):
        raise ConfigError(path, "steering", f"{content!r} is unknown", "lane, or a list of from_s, wheel_deg")
    most = 60.0 * ratio
    result = []
    for where, entry in _listed(path, "steering", content, "from_s", 0.0):
        files.check_keys(path, entry, ("from_s", "wheel_deg"), (), where)
        angle = files.check_number(path, f"{where}.wheel_deg", entry["wheel_deg"], -most, most, unit="deg")
        result.append((float(entry["from_s"]), math.radians(angle)))
    return tuple(result)


def _foreign(path: Path, content: Any) -> tuple[tuple[float, float], ...]:
    result = []
    for where, entry in _listed(path, "foreign_brakes", content, "from_s", 0.0) if content != [] else ():
        files.check_keys(path, entry, ("from_s", "braking_mps2"), (), where)
        braking = files.check_number(path, f"{where}.braking_mps2", entry["braking_mps2"], 0.0, 20.0, unit="m/s2")
        result.append((float(entry["from_s"]), braking))
    return tuple(result)


def _friction(path: Path, content: Any) -> tuple[Friction, ...]:
    def coefficient(where: str, value: Any) -> float:
        return files.check_number(path, where, value, 0.05, 1.5)

    if not isinstance(content, list):
        both = coefficient("road.friction", content)
        return (Friction(0.0, both, both),)
    result = []
    entries = _listed(path, "road.friction", content, "from_m", -1e6)
    where, first = entries[0]
    files.check_number(path, f"{where}.from_m", first["from_m"], high=0.0, unit="m: the car starts at 0")
    for where, entry in entries:
        if "friction" in entry:
            files.check_keys(path, entry, ("from_m", "friction"), (), where)
            left = right = coefficient(f"{where}.friction", entry["friction"])
        else:
            files.check_keys(path, entry, ("from_m", "left", "right"), (), where)
            left = coefficient(f"{where}.left", entry["left"])
            right = coefficient(f"{where}.right", entry["right"])
        result.append(Friction(float(entry["from_m"]), left, right))
    return tuple(result)


def _grade(path: Path, content: Any) -> tuple[tuple[float, float], ...]:
    if not isinstance(content, list):
        return ((0.0, files.check_number(path, "road.grade", content, -MAX_GRADE, MAX_GRADE)),)
    result = []
    for where, entry in _listed(path, "road.grade", content, "from_m", -1e6):
        files.check_keys(path, entry, ("from_m", "grade"), (), where)
        grade = files.check_number(path, f"{where}.grade", entry["grade"], -MAX_GRADE, MAX_GRADE)
        result.append((float(entry["from_m"]), grade))
    return tuple(result)


def _faults(path: Path, content: Any) -> tuple[Fault, ...]:
    if not isinstance(content, list):
        raise ConfigError(path, "faults", f"{content!r} is no list", "entries with sensor, actuator or message")
    return tuple(fault for i, entry in enumerate(content) for fault in _fault(path, f"faults[{i}]", entry))


def _fault(path: Path, where: str, entry: Any) -> list[Fault]:
    """What one entry says; of a message it may say several things."""
    what = [key for key in _FAULT_TARGETS if isinstance(entry, dict) and key in entry]
    if len(what) != 1:
        raise ConfigError(path, where, "names nothing that fails", "one of sensor, actuator, message")
    targets, kinds = _FAULT_TARGETS[what[0]]
    target = files.check_choice(path, f"{where}.{what[0]}", entry[what[0]], targets)
    kinds = {kind: allowed for kind, allowed in kinds.items() if target in faults.ONLY.get(kind, targets)}
    files.check_keys(path, entry, (what[0],), (*kinds, "from_s", "until_s"), where)
    named = [kind for kind in kinds if kind in entry]
    message = what[0] == "message"
    if not named or (len(named) > 1 and not message):
        raise ConfigError(path, where, "does not say what is wrong", f"one of {', '.join(kinds)}")
    from_s = files.check_number(path, f"{where}.from_s", entry.get("from_s", 0.0), 0.0, _LONGEST_S, unit="s")
    until_s = math.inf
    if "until_s" in entry:
        until_s = files.check_number(path, f"{where}.until_s", entry["until_s"], from_s, _LONGEST_S, above=True)
    values = [_amount(path, f"{where}.{kind}", entry[kind], kinds[kind]) for kind in named]
    return [Fault(target, kind, value, from_s, until_s, message) for kind, value in zip(named, values, strict=True)]


def _amount(path: Path, key: str, value: Any, allowed: tuple[float, float, str] | None) -> float:
    if allowed:
        low, high, unit = allowed
        return files.check_number(path, key, value, low, high, unit=unit)
    if files.check_bool(path, key, value) is not True:
        raise ConfigError(path, key, "is false", "true")
    return 0.0


def _bounds(path: Path, whole: Mapping[str, Any], section: str) -> list[Bound]:
    content = files.check_keys(path, whole.get(section, {}), (), NAMES, section)
    bounds = []
    for name, bound in content.items():
        where = f"{section}.{name}"
        files.check_keys(path, bound, (), ("at_least", "at_most"), where)
        if not bound:
            raise ConfigError(path, where, "bounds nothing", "at_least, at_most")
        low = files.check_number(path, f"{where}.at_least", bound.get("at_least", -1e9))
        high = files.check_number(path, f"{where}.at_most", bound.get("at_most", 1e9), low)
        least = low if "at_least" in bound else -math.inf
        most = high if "at_most" in bound else math.inf
        bounds.append(Bound(name, least, most, section == "aim"))
    return bounds
