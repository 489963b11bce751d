# SPDX-License-Identifier: Apache-2.0
"""A study's numbers, typed: what `study.json` holds, and all that its tables need."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast, get_args, get_origin, get_type_hints

from iwm_power_manager.files import read_text
from iwm_power_manager.tools.command import plain
from iwm_sim.study.ablation import Ablated
from iwm_sim.study.battery_fit import Estimate
from iwm_sim.study.criteria import Criterion
from iwm_sim.study.frontier import Frontier
from iwm_sim.study.paper import Consequences
from iwm_sim.study.rows import Row
from iwm_sim.study.skid import Stopped

FORMAT = 3


@dataclass(frozen=True)
class PolicyIdentity:
    """A policy of the study: for which road it was used, and what it was solved for."""

    idle_drive: str
    friction: float
    solved_for_friction: float
    grid: str
    checksum: str
    switching_cost_j: float
    switching_fixed_cost_j: float


@dataclass(frozen=True)
class Robustness:
    """Our policy in a car, on a road or with sensors that it was not solved for: its saving, %, by cycle."""

    variant: str
    idle_drive: str
    saving_percent: dict[str, float | None]
    trace_held: bool
    share_changes_per_min: float


@dataclass(frozen=True)
class Study:
    """A whole study.

    Attributes
    ----------
    vehicle_hashes : by idle drive
    cycles : sha256 by name
    strategy, settings : of our policy's runs
    policies : by what they were used as
    cells : every strategy under the law's normal settings; gates : with and without skid avoidance
    battery_fit : by what was fitted
    sensitivity : front share of least depletion, by figure and case
    """

    package_version: str
    vehicle: str
    vehicle_hashes: dict[str, str]
    cycles: dict[str, str]
    strategy: str
    settings: dict[str, Any]
    policies: dict[str, list[PolicyIdentity]]
    cells: list[Row]
    gates: list[Row]
    stops: list[Stopped]
    frontier: Frontier
    robustness: list[Robustness]
    battery_fit: dict[str, Estimate]
    sensitivity: dict[str, dict[str, float]]
    paper: Consequences
    criteria: list[Criterion]
    ablation: list[Ablated]
    format: int = FORMAT

    def to_json(self) -> bytes:
        """The study as JSON, numbers with six significant digits; rows without what is the same for all of them."""
        values = vars(self) | {"cells": _bare(self.cells), "gates": _bare(self.gates)}
        return (json.dumps(plain(values, 6), indent=1) + "\n").encode()

    @classmethod
    def from_json(cls, text: str | bytes) -> Study:
        """A study as `to_json` gave it."""
        return read(cls, json.loads(text))

    @classmethod
    def load(cls, path: Path | str) -> Study:
        """A stored study; `ConfigError` if the file cannot be read."""
        return cls.from_json(read_text(path))


def _bare(rows: Sequence[Row]) -> list[Row]:
    return [dataclasses.replace(row, made_with={}) for row in rows]


def read[T](kind: type[T], value: Any) -> T:
    """A value of a type as `plain` wrote it: its parts by the hints of its fields, null as NaN where a number stands.

    Fields that a file of before lacks have their defaults; a tuple whose own fields stand beside the others is found.
    """
    made: Any = value
    outer, of = get_origin(kind), get_args(kind)
    hints = get_type_hints(kind) if dataclasses.is_dataclass(kind) or _is_tuple(kind) else {}
    if hints:
        found = {name: value.get(name, value) for name, hint in hints.items() if name in value or _is_tuple(hint)}
        made = kind(**{name: read(hints[name], part) for name, part in found.items()})
    elif outer is dict:
        made = {key: read(of[1], part) for key, part in value.items()}
    elif outer in (list, tuple):
        made = outer(read(of[0], part) for part in value)
    elif kind is float and value is None:
        made = math.nan
    return cast(T, made)


def _is_tuple(kind: Any) -> bool:
    return hasattr(kind, "_fields")
