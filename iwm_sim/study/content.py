# SPDX-License-Identifier: Apache-2.0
"""A study's numbers, typed: what `study.json` holds, and all that its tables need."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from iwm_power_manager.files import read_text
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
        stripped = dataclasses.replace(self, cells=_bare(self.cells), gates=_bare(self.gates))
        return (json.dumps(rounded(stripped), indent=1, allow_nan=False) + "\n").encode()

    @classmethod
    def from_json(cls, text: str | bytes) -> Study:
        """A study as `to_json` gave it."""
        values = json.loads(text)
        return cls(
            **values
            | {
                "policies": {
                    used: [PolicyIdentity(**policy) for policy in policies]
                    for used, policies in values["policies"].items()
                },
                "cells": [Row.from_json(row) for row in values["cells"]],
                "gates": [Row.from_json(row) for row in values["gates"]],
                "stops": [Stopped(**stop) for stop in values["stops"]],
                "frontier": Frontier.from_json(values["frontier"]),
                "robustness": [Robustness(**row) for row in values["robustness"]],
                "battery_fit": {name: Estimate(**made) for name, made in values["battery_fit"].items()},
                "paper": Consequences(**values["paper"]),
                "ablation": [Ablated(**row) for row in values["ablation"]],
                "criteria": [Criterion(**row) for row in values["criteria"]],
            }
        )

    @classmethod
    def load(cls, path: Path | str) -> Study:
        """A stored study; `ConfigError` if the file cannot be read."""
        return cls.from_json(read_text(path))


def _bare(rows: Sequence[Row]) -> list[Row]:
    return [dataclasses.replace(row, made_with={}) for row in rows]


def rounded(value: Any) -> Any:
    """Plain values with six significant digits: enough for any table, and stable under the last bits; NaN is null."""
    if isinstance(value, Row):
        return rounded(value.to_json())
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: rounded(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): rounded(entry) for key, entry in value.items()}
    if hasattr(value, "_asdict"):
        return rounded(value._asdict())
    if isinstance(value, list | tuple):
        return [rounded(entry) for entry in value]
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, float | np.floating):
        return float(f"{value:.6g}") if np.isfinite(value) else None
    return value
