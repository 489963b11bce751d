# SPDX-License-Identifier: Apache-2.0
"""What a fleet study is made of: one YAML file, or options in its place, to a list of tasks.

    format: 1
    about: one sentence                       # what it is for; optional
    cars:                                     # of each entry, all combinations
      - vehicle: jalalmaab_2015               # files or names; generated:1000..1009 draws ten cars nobody chose
        idle_drive: [none, drag]              # default: as the file says
        change:                               # numbers that are not as the file says
          chassis.mass_kg: [700, 800, 900]
          motor.max_power_w: [7500, 9000]     # of all four motors
    cycles: [nycc, generated:1000..1004]      # driven with every car on every road
    scenarios: [split_stop]                   # of config/scenarios; they bring their own road
    friction: [0.9, 0.5, 0.2]                 # default: 0.9
    strategies: [sdp_lookahead]               # beside equal split, which is always driven
    budgets: [4, 8]                           # changes of the split a minute, for strategies with a policy; default:
    grid: coupled                             # ... the grid's own
    dt_s: 0.01                                # control step

A value may stand where a list may. A policy is solved for every car, road and budget that a strategy needs one for.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from iwm_power_manager import files, plausibility
from iwm_power_manager.control.strategies import drivable
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.model.parameters import IDLE_DRIVES
from iwm_power_manager.policy import FRICTION_RANGE
from iwm_power_manager.share import resolve, roots
from iwm_power_manager.solve import grid_path
from iwm_power_manager.vehicle_table import ORDERED, TABLE
from iwm_sim.fleet.task import Car, Drive, Road, Solve
from iwm_sim.scenario import load_scenario
from iwm_sim.study import cases
from iwm_sim.study.cases import POLICY_STRATEGIES, Case, Change
from iwm_sim.study.names import DEFAULT_GRID, MAX_DT_S, REFERENCE

FORMAT = 1
FOLDER = "config/fleets"
#: More would be a mistake in the file: a million places take days on any cluster.
MAX_TASKS = 1_000_000
_OPTIONAL = ("about", "cycles", "scenarios", "friction", "strategies", "budgets", "grid", "dt_s")
#: Sections of the vehicle table whose numbers can be changed as they stand.
CHANGEABLE = ("chassis", "wheel", "motor", "friction_brake", "battery", "driver")
_DRAWN = re.compile(r"generated:(\d{1,9})(?:\.\.(\d{1,9}))?")


@dataclass(frozen=True)
class Plan:
    """What to do, and the files it names."""

    solves: tuple[Solve, ...]
    drives: tuple[Drive, ...]
    roads: tuple[Road, ...]
    files: tuple[str, ...]


def load_plan(file: Path | str | None, given: Mapping[str, Any]) -> Plan:
    """Read a fleet file, put what was given in place of its keys, and check all of it.

    Parameters
    ----------
    file : YAML, or the name of one of the package's; None if all is given
    given : keys and values as in the file

    Raises
    ------
    ConfigError
        The message names file (or `arguments`), key, value and what is allowed.
    """
    content = dict(files.read_yaml(resolve(file))) if file else {"format": FORMAT}
    return plan_of(str(file or "arguments"), content | dict(given))


def plan_of(file: str, content: Mapping[str, Any]) -> Plan:
    """The tasks of a checked mapping."""
    files.check_keys(file, content, ("format", "cars"), _OPTIONAL)
    if content["format"] != FORMAT:
        raise ConfigError(file, "format", f"{content['format']!r} is unknown", str(FORMAT))
    cars = list(_cars(file, content["cars"]))
    frictions = _numbers(file, "friction", content.get("friction", 0.9), *FRICTION_RANGE)
    budgets = _numbers(file, "budgets", content["budgets"], 0.1, 1e4, "1/min") if "budgets" in content else [None]
    grid = str(_file(file, "grid", content.get("grid", DEFAULT_GRID), grid_path))
    dt_s = files.check_number(file, "dt_s", content.get("dt_s", 0.01), 1e-3, MAX_DT_S, unit="s")
    strategies = [REFERENCE] + [
        files.check_choice(file, "strategies", name, drivable()) for name in _list(content.get("strategies", []))
    ]
    cycles = [name for entry in _list(content.get("cycles", [])) for name in _drawn(file, "cycles", entry)]
    roads = [_file(file, "scenarios", name) for name in _list(content.get("scenarios", []))]
    places = len(cars) * (len(cycles) * len(frictions) + len(roads) * len(strategies))
    if max(places, len(cars) * len(frictions) * len(budgets)) > MAX_TASKS:
        raise ConfigError(file, "", f"makes {places} places", f"up to {MAX_TASKS}")
    for name in cycles:
        if cases.drawn_seed(name) is None:
            cases.cycle_of(name)

    def drive(car: Car, cycle: str, friction: float) -> Drive:
        base = Case(cycle, car.vehicle, car.idle_drive, friction, REFERENCE, dt_s=dt_s, car=car.changes)
        made = [replace(base, strategy=name) for name in dict.fromkeys(strategies) if name not in POLICY_STRATEGIES]
        for name, budget in itertools.product(dict.fromkeys(strategies), budgets):
            if name in POLICY_STRATEGIES:
                label = "" if budget is None else f"{name}, {budget:g}/min"
                policy = Solve(car, friction, grid, budget).file
                made.append(replace(base, strategy=name, label=label, policy=policy))
        return Drive(tuple(made))

    def road(car: Car, scenario: str, strategy: str) -> tuple[Road, Solve | None]:
        told = load_scenario(scenario, vehicle=car.load()).assumed_friction
        solve = Solve(car, told, grid) if strategy in POLICY_STRATEGIES else None
        return Road(scenario, car, strategy, solve.file if solve else ""), solve

    driven = [road(*places) for places in itertools.product(cars, roads, dict.fromkeys(strategies))]
    solves = [Solve(*made[:2], grid, made[2]) for made in itertools.product(cars, frictions, budgets)]
    named = [car.vehicle for car in cars] + cycles + roads + [grid]
    return Plan(
        solves=tuple(dict.fromkeys([*solves, *(solve for _, solve in driven if solve)])),
        drives=tuple(drive(*place) for place in itertools.product(cars, cycles, frictions)),
        roads=tuple(road for road, _ in driven),
        files=tuple(dict.fromkeys(name for name in named if cases.drawn_seed(name) is None)),
    )


def needed(plan: Plan) -> list[Solve]:
    """Those policies that a drive or a scenario needs."""
    wanted = {case.policy for task in plan.drives for case in task.cases} | {task.policy for task in plan.roads}
    return [solve for solve in plan.solves if solve.file in wanted]


def _cars(file: str, entries: Any) -> Iterator[Car]:
    for index, entry in enumerate(_list(entries)):
        where = f"cars[{index}]"
        files.check_keys(file, entry, ("vehicle",), ("idle_drive", "change"), where)
        drives = [
            files.check_choice(file, f"{where}.idle_drive", drive, IDLE_DRIVES)
            for drive in _list(entry.get("idle_drive", []))
        ]
        change = files.check_keys(file, entry.get("change", {}), (), _changeable(), f"{where}.change")
        axes = [_changes(file, f"{where}.change.{key}", key, values) for key, values in change.items()]
        for vehicle in (name for one in _list(entry["vehicle"]) for name in _drawn(file, f"{where}.vehicle", one)):
            drawn = cases.drawn_seed(vehicle) is not None
            for drive in drives or [cases.vehicle_of(cases.BASE_CAR if drawn else vehicle, "").idle_drive]:
                for changes in itertools.product(*axes):
                    car = Car(vehicle, drive, tuple(changes))
                    yield car if drawn and not changes else _checked(file, where, car)


def _checked(file: str, where: str, car: Car) -> Car:
    """A car, if its file can be read and its numbers still fit each other."""
    params = car.load().params
    for axle, (section, pairs) in itertools.product((params.front, params.rear), ORDERED.items()):
        numbers = getattr(axle, section, None) or getattr(params, section)
        for small, large, _ in pairs if car.changes else ():
            if getattr(numbers, small) > getattr(numbers, large):
                problem = f"{car.label}: {large} is below {small}"
                raise ConfigError(file, f"{where}.change", problem, f"{large} >= {small} = {getattr(numbers, small):g}")
    if car.changes:
        plausibility.check_car(Path(file), params, lambda _, part: f"{where}.change.{part}")
    return car


def _changeable() -> list[str]:
    return [f"{section}.{name}" for section in CHANGEABLE for name in TABLE[section]]


def _changes(file: str, where: str, key: str, values: Any) -> list[Change]:
    section, name = key.split(".")
    known = TABLE[section][name]
    return [Change(section, name, value) for value in _numbers(file, where, values, known.low, known.high, known.unit)]


def _list(value: Any) -> list[Any]:
    return list(value) if isinstance(value, list | tuple) else [value]


def _numbers(file: str, key: str, values: Any, low: float, high: float, unit: str = "") -> list[float]:
    found = [files.check_number(file, key, value, low, high, unit=unit) for value in _list(values)]
    if not found:
        raise ConfigError(file, key, "is an empty list", "one number or more")
    return list(dict.fromkeys(found))


def _drawn(file: str, key: str, name: Any) -> list[str]:
    """The file, or the drawn ones, that a name stands for."""
    match = _DRAWN.fullmatch(name) if isinstance(name, str) else None
    if match is None:
        return [_file(file, key, name)]
    first, last = int(match[1]), int(match[2] or match[1])
    if not 0 <= last - first < MAX_TASKS:
        raise ConfigError(file, key, f"{name} names no seeds", f"FIRST..LAST, up to {MAX_TASKS} of them")
    return [f"generated:{seed}" for seed in range(first, last + 1)]


def _file(file: str, key: str, name: Any, find: Callable[[str], Path] = resolve) -> str:
    """A file by the name it has on every machine: one of the package by its own name, another one by its full path."""
    if not isinstance(name, str):
        raise ConfigError(file, key, f"{name!r} is no file name", "a file, or the name of one of the package")
    path = find(name).absolute()
    inside = [root for root in roots() if path.is_relative_to(root)]
    return str(path.relative_to(inside[0]) if inside else path)
