# SPDX-License-Identifier: Apache-2.0
"""A motor map out of a table of another program: rpm, percent, decimal commas, matrix layout, a gear."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import NamedTuple

from iwm_power_manager.errors import ConfigError
from iwm_power_manager.motor_map import COLUMNS, RANGES
from iwm_power_manager.tables import Table, read_table

RAD_S_PER_RPM = 2.0 * math.pi / 60.0
_SPEED_NAMES = {"rpm": r"rpm|1/min|min-1|min\^-1|u/min", "rad/s": r"rad_?/?s\b|rad_?per_?s|radps"}
_NOTHING = ("", "nan", "-", "n/a", "na", "null", "none", "inf")


class Points(NamedTuple):
    """Efficiencies (NaN where there is none) by speed (rad/s) and torque (N m), what was guessed, what is doubtful."""

    efficiency: dict[tuple[float, float], float]
    said: list[str]
    doubts: list[str]


def read_points(
    path: Path | str,
    *,
    layout: str = "auto",
    down: str = "speed",
    separator: str = "auto",
    decimal: str = "auto",
    speed_unit: str = "auto",
    percent: bool | None = None,
    quantity: str = "efficiency",
    gear: float = 1.0,
) -> Points:
    """Read a table of efficiencies or losses.

    Parameters
    ----------
    layout : list (speed, torque, value in each row), matrix (speeds down, torques across, or `down` = "torque" the
        other way round), or auto: three columns are a list
    speed_unit : rad/s, rpm, or auto: as the header says, else rad/s
    percent : whether efficiencies are in percent; None: if one is above 1.5
    quantity : efficiency, or loss in W
    gear : turns of the motor for one of the wheel: the result is the wheel's

    Raises
    ------
    ConfigError
        What is no number, stands twice, or is out of range, with its line.
    """
    table = read_table(path, separator, decimal)
    said = ["decimal commas"] if table.decimal == "," else []
    guessed = layout == "auto"
    if guessed:
        layout = "list" if len(table.rows[-1][1]) == 3 else "matrix"
        said.append(f"layout {layout}: it has {len(table.rows[-1][1])} columns")
    if layout == "list" and down != "speed":
        raise ConfigError("arguments", "--down", f"has no effect: {path} is read as a list", "--layout matrix with it")
    header = " ".join(table.rows[0][1])
    named = next((unit for unit, names in _SPEED_NAMES.items() if re.search(names, header, re.IGNORECASE)), "")
    doubts = []
    if speed_unit == "auto":
        speed_unit = named or "rad/s"
        said.append(f"speeds in {speed_unit}" + (", as the header says" if named else ": guessed"))
    elif named not in ("", speed_unit):
        doubts.append(f"speeds in {speed_unit}, as --speed-unit says, although the header says {named}")
    try:
        cells = _list(table) if layout == "list" else _matrix(table, down)
    except ConfigError as error:
        if not guessed or layout == "list":
            raise
        problem = f"{error.problem} (taken for a matrix, as it has {len(table.rows[-1][1])} columns)"
        raise ConfigError(path, error.key, problem, "for a list three columns: speed, torque, value") from None
    if percent is None and quantity == "efficiency":
        percent = any(value > 1.5 for _, _, _, value in cells)
        said += ["efficiencies in percent: one is above 1.5"] if percent else []
    points: dict[tuple[float, float], float] = {}
    scale = RAD_S_PER_RPM if speed_unit == "rpm" else 1.0
    for line, speed, torque, value in cells:
        key = (speed * scale / gear, torque * gear)
        if key in points:
            raise ConfigError(path, f"line {line}", f"repeats speed {speed:g}, torque {torque:g}")
        points[key] = _efficiency(path, line, key, value / 100.0 if percent else value, quantity)
    return Points(points, said, doubts)


def _value(table: Table, line: int, text: str, column: str) -> float:
    return math.nan if text.lower() in _NOTHING else table.number(line, text, column)


def _list(table: Table) -> list[tuple[int, float, float, float]]:
    rows = []
    for line, cells in table.rows[1:]:
        if len(cells) != 3:
            raise ConfigError(table.path, f"line {line}", f"has {len(cells)} values", "3: speed, torque, value")
        speed, torque = (table.number(line, cells[i], COLUMNS[i]) for i in (0, 1))
        rows.append((line, speed, torque, _value(table, line, cells[2], "value")))
    return rows


def _matrix(table: Table, down: str) -> list[tuple[int, float, float, float]]:
    first, head = table.rows[0]
    across = [table.number(first, text, f"column {i}") for i, text in enumerate(head[1:], 2) if text]
    rows = []
    for line, cells in table.rows[1:]:
        if len(cells) > len(across) + 1 and any(cells[len(across) + 1 :]):
            raise ConfigError(
                table.path, f"line {line}", f"has {len(cells) - 1} values", f"{len(across)}, as in line {first}"
            )
        side = table.number(line, cells[0], "column 1")
        for i, top in enumerate(across, 1):
            value = _value(table, line, cells[i] if i < len(cells) else "", f"column {i + 1}")
            rows.append((line, side, top, value) if down == "speed" else (line, top, side, value))
    return rows


def _efficiency(path: Path | str, line: int, key: tuple[float, float], value: float, quantity: str) -> float:
    speed, torque = key
    for name, number in zip(COLUMNS, key, strict=False):
        low, high = RANGES[name]
        if not low <= number <= high:
            raise ConfigError(path, f"line {line}", f"{name} {number:g} is out of range", f"{low:g} to {high:g}")
    power = speed * torque
    if power == 0.0 or math.isnan(value):
        return math.nan
    if quantity == "loss":
        if value < 0.0:
            raise ConfigError(path, f"line {line}", f"loss {value:g} W is out of range", ">= 0")
        return power / (power + value) if power > 0.0 else max(1.0 + value / power, 0.0)
    if not 0.0 <= value <= 1.0:
        raise ConfigError(path, f"line {line}", f"efficiency {value:g} is out of range", "0 to 1, or --percent")
    return value


def map_text(points: Points) -> str:
    """The points as a map's CSV; where nothing is known, nothing stands."""
    rows = sorted(points.efficiency.items())
    lines = [f"{s:.10g},{t:.10g},{'' if math.isnan(eta) else f'{eta:.8g}'}" for (s, t), eta in rows]
    return "\n".join([",".join(COLUMNS), *lines]) + "\n"
