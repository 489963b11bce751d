# SPDX-License-Identifier: Apache-2.0
"""With what a bag is replayed: car, policies, settings of the law. From the options, else from the bag itself."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import PurePath
from typing import Any, NamedTuple

from iwm_power_manager.control import settings as law_settings
from iwm_power_manager.control.settings import DEFAULTS, Settings
from iwm_power_manager.control.types import WHEEL_NAMES
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.files import content_sha256
from iwm_power_manager.policy import PolicyBank
from iwm_power_manager.share import resolve, roots, share_path
from iwm_power_manager.signals.mapping import DEFAULT_MAPPING, SignalMapping, load_mapping
from iwm_power_manager.vehicle import Vehicle, load_vehicle

DEFAULT_VEHICLE = "config/vehicles/jalalmaab_2015.yaml"
DEFAULT_POLICY = "policies"
DEFAULT_FRICTION = 0.9
DEFAULT_RATE_HZ = 100.0

#: Parameters of the node that name what an option names here.
_FILES = {"vehicle": "vehicle_file", "policy": "policy_file", "mapping": "signals_file"}
#: No honest parameter is larger.
_LARGEST = 1e9

_NODE = "/power_manager"
_PARAMETERS = "parameters "
#: What tells the parameters of a power manager of another name.
_OWN_PARAMETERS = frozenset(("strategy", "policy_file", "vehicle_file", "rate_hz"))


class Choice(NamedTuple):
    """What the user has chosen; None and () leave it to the bag.

    Attributes
    ----------
    vehicle, policy : files, or names among the package's files
    strategy : one of `STRATEGIES`
    friction : peak friction coefficient
    settings : settings of the law, as text: ("critical_slip=0.1", ...)
    mapping : signals file
    """

    vehicle: str | None = None
    policy: str | None = None
    strategy: str | None = None
    friction: float | None = None
    settings: Sequence[str] = ()
    mapping: str | None = None


class Plan(NamedTuple):
    """Everything a replay needs beside the bag.

    Attributes
    ----------
    vehicle : the car
    policies : the tables
    changes : settings that replace the recorded ones, step by step
    settings : settings where the bag has recorded none
    friction : where the bag has recorded none
    keeps_friction : the recorded friction is not replaced
    period_s : length of a step that has none before it
    mapping : signals and commands
    notes : what could not be known of the drive, a line each
    """

    vehicle: Vehicle
    policies: PolicyBank
    changes: dict[str, Any]
    settings: Settings
    friction: float
    keeps_friction: bool
    period_s: float
    mapping: SignalMapping
    notes: tuple[str, ...]


def make_plan(choice: Choice, custom_data: Mapping[str, str]) -> Plan:
    """Plan from the user's choice; what that leaves open comes from the parameters recorded in the bag, else defaults.

    Raises
    ------
    ConfigError, PolicyError
        An option is wrong, or a file cannot be used.
    """
    recorded = recorded_parameters(custom_data)
    idle_drive = recorded.get("idle_drive") or None if choice.vehicle is None else None
    missing = {
        f"--{kind}": name
        for kind, given in (("vehicle", choice.vehicle), ("policy", choice.policy), ("mapping", choice.mapping))
        if given is None and (name := str(recorded.get(_FILES[kind], ""))) and not _packaged(name)
    }
    files = ", ".join(f"{option} {name[:200]!r}{_sha256(option, custom_data)}" for option, name in missing.items())
    ask = (
        f"give the files that the drive was recorded with, or others: {files} (a file that a bag names is opened by "
        "itself only where it came with this package)"
    )
    if "--vehicle" in missing:
        raise ConfigError("arguments", "", ask)
    vehicle_file = choice.vehicle or _packaged(recorded.get("vehicle_file")) or DEFAULT_VEHICLE
    vehicle = load_vehicle(resolve(vehicle_file), idle_drive)
    mapping = recorded_mapping(choice.mapping, custom_data)
    vehicle = dataclasses.replace(vehicle, params=mapping.car(vehicle.params))
    changes = {}
    for text in choice.settings:
        name, _, value = text.partition("=")
        changes[name] = law_settings.parse("--set", name, value)
    if choice.strategy is not None:
        changes["strategy"] = law_settings.parse("--strategy", "strategy", choice.strategy)
    settings = DEFAULTS._replace(**_recorded_settings(recorded))._replace(**changes)
    problem = law_settings.check_together(settings._asdict()) if changes else ""
    if problem:
        raise ConfigError("--set", *problem.split(": ", 1))
    policy = choice.policy if choice.policy is not None else _packaged(recorded.get("policy_file", DEFAULT_POLICY))
    notes = [f"commands and brakes are taken as in {DEFAULT_MAPPING}; {ask}"] if "--mapping" in missing else []
    inside = _recorded_in(choice, recorded, custom_data)
    if inside:
        notes.append(f"of {policy}, {inside} is taken, as recorded; with --friction all of them count")
        policy = str(resolve(policy) / inside)
    return Plan(
        vehicle,
        PolicyBank(policy, _numbers(recorded.get("rule")), vehicle, ask if "--policy" in missing else ""),
        changes,
        settings,
        choice.friction if choice.friction is not None else _number(recorded, "friction", DEFAULT_FRICTION),
        choice.friction is None,
        1.0 / _number(recorded, "rate_hz", DEFAULT_RATE_HZ),
        mapping,
        tuple(notes),
    )


def _sha256(option: str, custom_data: Mapping[str, str]) -> str:
    """The beginning of the recorded SHA-256 of an option's file, in brackets, if there is one."""
    recorded = custom_data.get(f"{option.removeprefix('--')}_sha256", "")
    return f" (SHA-256 {recorded[:12]})" if recorded else ""


def _recorded_in(choice: Choice, recorded: Mapping[str, Any], custom_data: Mapping[str, str]) -> str:
    """Name of the policy file of the drive in the folder that the user gives, "" if it is not there.

    By its hash where that is recorded, else by its name. Not for another friction, which another policy is for.
    """
    name = PurePath(str(recorded.get("policy_file", ""))).name
    if choice.policy is None or choice.friction is not None or not name.endswith(".npz"):
        return ""
    folder = resolve(choice.policy)
    files = sorted(folder.glob("*.npz")) if os.path.isdir(folder) else []
    wanted = custom_data.get("policy_sha256", "")
    same = [file.name for file in files if (content_sha256(file) == wanted if wanted else file.name == name)]
    return name if name in same else "".join(same[:1])


def recorded_mapping(chosen: str | None, custom_data: Mapping[str, str]) -> SignalMapping:
    """The signals file that was chosen, else that of the package the drive was recorded with, else the standard one."""
    recorded = recorded_parameters(custom_data)
    file = resolve(chosen) if chosen else _packaged(recorded.get("signals_file")) or share_path(DEFAULT_MAPPING)
    mapping = load_mapping(file)
    standard = mapping.path.resolve() == share_path(DEFAULT_MAPPING).resolve()
    return mapping.with_wheel_names(_wheel_names(recorded.get("wheel_names"))) if standard else mapping


def unknown_mapping(custom_data: Mapping[str, str]) -> str:
    """The signals file the drive was recorded with, where it is none of the package's; else ""."""
    name = str(recorded_parameters(custom_data).get("signals_file", ""))
    return "" if _packaged(name) else name


def recorded_parameters(custom_data: Mapping[str, str]) -> dict[str, Any]:
    """Parameters the bag's power manager ran with, whatever its name was; empty if the bag does not say."""
    nodes = sorted(custom_data.items(), key=lambda item: (not item[0].endswith(_NODE), item))
    for key, text in nodes:
        if key.startswith(_PARAMETERS):
            try:
                found = json.loads(text)
            except (ValueError, RecursionError):
                continue
            if isinstance(found, dict) and (key.endswith(_NODE) or set(found) >= _OWN_PARAMETERS):
                return found
    return {}


def _packaged(name: object) -> str:
    """A file of the package that the bag names, else ""; it may name no other, because a bag may come from anybody."""
    if not name:
        return ""
    try:
        path = resolve(str(name)).resolve()
        folders = [root.resolve() / folder for root in roots() for folder in ("config", "policies")]
        return str(path) if path.exists() and any(path.is_relative_to(folder) for folder in folders) else ""
    except (OSError, ValueError, RuntimeError):
        return ""  # no file can have such a name


def _recorded_settings(recorded: Mapping[str, Any]) -> dict[str, Any]:
    """Settings among the recorded parameters, checked like anybody's."""
    known = {name: recorded[name] for name in Settings._fields if name in recorded}
    texts = {name: str(value).lower() if isinstance(value, bool) else str(value) for name, value in known.items()}
    return {name: law_settings.parse("parameters in the bag", name, text) for name, text in texts.items()}


def _number(recorded: Mapping[str, Any], name: str, default: float) -> float:
    value = recorded.get(name, default)
    usable = isinstance(value, int | float) and not isinstance(value, bool) and 0.0 < value < _LARGEST
    return float(value) if usable else default


def _numbers(values: object) -> tuple[float, ...]:
    numbers = values if isinstance(values, list) else []
    usable = all(isinstance(value, int | float) and abs(value) < _LARGEST for value in numbers)
    return tuple(map(float, numbers)) if usable else ()


def _wheel_names(names: object) -> tuple[str, ...]:
    """The wheels' names; this project's own, if they are none."""
    usable = isinstance(names, list) and len(names) == len(WHEEL_NAMES) and all(isinstance(name, str) for name in names)
    return tuple(names) if usable and isinstance(names, list) else WHEEL_NAMES
