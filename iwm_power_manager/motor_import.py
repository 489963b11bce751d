# SPDX-License-Identifier: Apache-2.0
"""A motor map out of a table of another program: rpm, percent, decimal commas, matrix layout, a gear."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import NamedTuple

from iwm_power_manager.errors import ConfigError, one_line
from iwm_power_manager.motor_map import COLUMNS, RANGES
from iwm_power_manager.tables import Table, is_nothing, read_table

RAD_S_PER_RPM = 2.0 * math.pi / 60.0
_GUESSED = "rad/s, guessed"
_SPEED_NAMES = {"rpm": r"\brpm|1/min|min-1|min\^-1|u/min", "rad/s": r"rad ?/?s\b|rad ?per ?s|radps"}
#: Units that are not read, by what the option that settles it is.
_OTHER_UNITS = {
    "speeds": (
        r"km[/ ]?h\b|\b[km]ph|\bm/s|\bkrpm|\brps|\b1/s|\bs\^?-1|\bhz\b|(deg|°)/s|speed\W*(%|pu\b)",
        "rad/s or rpm: --speed-unit",
    ),
    "torques": (r"\b[km]n[ ·*]?m\b|\blbf?|\bft\b|\boz|torque\W*(%|percent|pu\b)", "N m"),
    "losses": (r"\b[km]w\b", "W"),
}
#: What the head of a column says of it.
_TORQUE, _SPEED = re.compile("torque|moment|n ?m(?![a-z])", re.I), re.compile("speed|drehzahl|rpm|min|rad|omega", re.I)
_LOSS = "loss|verlust"
_VALUE = rf"effic|wirkungsgrad|\beta\b|{_LOSS}"
#: A map with so few of its grid's points is on no grid.
_SPARSE = 0.25
#: Half of a motor's map is never better.
_TOO_GOOD = 0.99
#: More than this part of efficiencies in percent are not below 1 %.
_MIXED = 0.02
#: A loss so many times that between its neighbours, or so little of it, is a wrong number.
_APART = 8.0
_MOST_ALONE = 5
#: Speeds of no unit by which wheels turn faster than this, rad/s, may be in rpm: at 350 km/h they do not.
_MOST_UNNAMED = 300.0
#: No car's motor has more, N m: those are speeds, or N mm.
_MOST_NM = 5000.0


class Points(NamedTuple):
    """Efficiencies (NaN where there is none) by speed (rad/s) and torque (N m), what was guessed, what is doubtful."""

    efficiency: dict[tuple[float, float], float]
    said: list[str]
    doubts: list[str]


def read_points(
    path: Path | str,
    *,
    layout: str = "auto",
    down: str = "auto",
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
    layout : list (speed, torque, value in each row; torque first if the header says so), matrix, or auto: three columns
        are a list
    down : speed or torque goes down in a matrix, the other across; auto: as its corner says, else speed
    speed_unit : rad/s, rpm, or auto: as the header says, else rad/s
    percent : whether efficiencies are in percent; None: if most are above 1.5
    quantity : efficiency, or loss in W
    gear : turns of the motor for one of the wheel: the result is the wheel's

    Raises
    ------
    ConfigError
        What is no number, stands twice, or is out of range, with its line.
    """
    table = _trimmed(read_table(path, separator, decimal))
    said = ["decimal commas"] if table.decimal == "," else []
    guessed = layout == "auto"
    columns = len(table.rows[-1][1])
    header = [cell for _, cells in _header(table) for cell in cells if not _is_number(table, cell)]
    if guessed:
        layout = "list" if columns == 3 else "matrix"
        said.append(f"layout {layout}: it has {columns} columns")
    if layout == "list" and down != "auto":
        raise ConfigError("arguments", "--down", f"has no effect: {path} is read as a list", "--layout matrix with it")
    speed_unit, doubts = _speed_unit(path, header, speed_unit, said)
    if layout == "matrix":
        corner = _header(table)[-1][1][0]
        if down == "auto":
            down = "torque" if _torque_first(corner) else "speed"
            said.append(one_line(f"{down}s down: the corner says '{corner}'" if corner else "speeds down: guessed"))
        elif down == "speed" and _torque_first(corner):
            doubts.append(one_line(f"speeds down, torques across, although the corner says '{corner}'"))
    _check_quantity(path, header, quantity)
    try:
        cells = _list(table, said) if layout == "list" else _matrix(table, down)
    except ConfigError as error:
        if not guessed or layout == "list":
            raise
        problem = f"{error.problem} (taken for a matrix, as it has {columns} columns)"
        listed = "for a list three columns: speed, torque, value (--layout list)"
        allowed = f"{error.allowed}; {listed}" if error.allowed else listed
        raise ConfigError(path, error.key, problem, allowed) from None
    if percent is None and quantity == "efficiency":
        percent = _in_percent(cells, header, said, doubts)
    fractions = sum(0.2 < value <= 1.0 for _, _, _, value in cells)
    if percent and fractions > _MIXED * len(cells):
        doubts.append(f"{fractions} of {len(cells)} efficiencies in percent are at most 1: fractions of 1 among them?")
    points: dict[tuple[float, float], float] = {}
    scale = RAD_S_PER_RPM if speed_unit == "rpm" else 1.0
    for line, speed, torque, value in cells:
        key = (speed * scale / gear, torque * gear)
        if key in points:
            raise ConfigError(path, f"line {line}", f"repeats speed {speed:g}, torque {torque:g}")
        points[key] = _efficiency(path, line, key, value / 100.0 if percent else value, quantity)
    fastest = max((speed for speed, _ in points), default=0.0)
    if speed_unit == _GUESSED and fastest > _MOST_UNNAMED:
        doubts.append(f"speeds up to {gear * fastest:g} of no unit are taken for rad/s: rpm? --speed-unit says it")
    most_nm = max((abs(torque) for _, torque in points), default=0.0) / gear
    if most_nm > _MOST_NM:
        doubts.append(f"torques up to {most_nm:g} N m at the motor: {'--down' if layout == 'matrix' else 'unit'}?")
    return Points(points, said, doubts + _doubtful(points, quantity))


def _doubtful(points: dict[tuple[float, float], float], quantity: str) -> list[str]:
    """What is doubtful about the points themselves."""
    doubts = []
    known = sorted(value for value in points.values() if value > 0.0)
    if known and known[len(known) // 2] > _TOO_GOOD:
        meant = "losses in kW" if quantity == "loss" else "another quantity"
        doubts.append(f"half of its efficiencies are above {_TOO_GOOD:g}: {meant}?")
    doubts += _alone(points)
    grid = len({speed for speed, _ in points}) * len({torque for _, torque in points})
    if len(points) < _SPARSE * grid:
        doubts.append(f"its points hardly lie on a grid: {len(points)} of {grid}")
    return doubts


def _alone(points: dict[tuple[float, float], float]) -> list[str]:
    """Efficiencies whose losses are far from those of the points around them, as a wrong digit makes them."""
    loss = {
        (s, t): abs(s * t) * ((1.0 / eta - 1.0) if t > 0.0 else (1.0 - eta))
        for (s, t), eta in points.items()
        if s * t and eta > 0.0
    }
    speeds, torques = (sorted({point[i] for point in loss}) for i in (0, 1))
    row, column = ({value: k for k, value in enumerate(values)} for values in (speeds, torques))
    doubts = []
    for (s, t), own in loss.items():
        i, j = row[s], column[t]
        beside = [
            [loss.get((speeds[k], t)) for k in (i - 1, i + 1) if 0 <= k < len(speeds)],
            [loss.get((s, torques[k])) for k in (j - 1, j + 1) if 0 <= k < len(torques) and torques[k] * t > 0.0],
        ]
        between = [math.sqrt(pair[0] * pair[1]) for pair in beside if len(pair) == 2 and pair[0] and pair[1]]
        if between and (own > _APART * max(between) or own * _APART < min(between)):
            usual = min(between) if own < min(between) else max(between)
            where = f"{points[s, t]:.4g} at {s:.4g} rad/s, {t:.4g} N m"
            doubts.append(f"{where} is a loss of {own:.3g} W between ones of {usual:.3g} W: a wrong digit?")
    return doubts[:_MOST_ALONE]


def _in_percent(
    cells: list[tuple[int, float, float, float]], header: list[str], said: list[str], doubts: list[str]
) -> bool:
    values = [value for _, _, _, value in cells if value > 0.0]
    percent = 2 * sum(value > 1.5 for value in values) > len(values)
    said += ["efficiencies in percent: most are above 1.5"] if percent else []
    if not percent and any("%" in cell for cell in header):
        doubts.append("efficiencies as fractions of 1, although the header says %: few are above 1.5")
    return percent


def _trimmed(table: Table) -> Table:
    """The table without columns at its end that are empty in every row."""
    width = max((i for _, cells in table.rows for i, cell in enumerate(cells, 1) if cell), default=0)
    return table._replace(rows=[(line, cells[:width]) for line, cells in table.rows])


def _is_number(table: Table, text: str) -> bool:
    try:
        table.number(0, text, "")
    except ConfigError:
        return False
    return True


def _header(table: Table) -> list[tuple[int, list[str]]]:
    """The rows before the first that holds two numbers, and that one: in a matrix its corner may name a unit."""
    first = next((i for i, (_, row) in enumerate(table.rows) if sum(_is_number(table, x) for x in row) > 1), None)
    if first is None:
        raise ConfigError(table.path, "", "holds no numbers", "a text table: speed, torque, value")
    return table.rows[: first + 1]


def _speed_unit(path: Path | str, header: list[str], chosen: str, said: list[str]) -> tuple[str, list[str]]:
    """The unit of the speeds, and what is doubtful about it."""
    plain = [cell.replace("_", " ") for cell in header]  # where a word ends: speed_rpm
    named = next((unit for unit, names in _SPEED_NAMES.items() if re.search(names, " ".join(plain), re.I)), "")
    for what, (names, allowed) in _OTHER_UNITS.items():
        strange = next((cell for cell, words in zip(header, plain, strict=True) if re.search(names, words, re.I)), None)
        if strange is not None and not (what == "speeds" and (named or chosen != "auto")):
            if what == "losses" and not re.search(_LOSS, strange, re.IGNORECASE):
                raise ConfigError(path, "", f"the header says {strange!r}: powers", "torques in N m, or losses in W")
            raise ConfigError(path, "", f"the header says {strange!r}: {what} in another unit", allowed)
    if chosen == "auto":
        said.append(f"speeds in {named or 'rad/s'}" + (", as the header says" if named else ": guessed"))
        return named or _GUESSED, []
    doubt = f"speeds in {chosen}, as --speed-unit says, although the header says {named}"
    return chosen, [] if named in ("", chosen) else [doubt]


def _torque_first(head: str) -> bool:
    """Whether the corner of a matrix names torques, or torques before speeds: what goes down, what across."""
    torque, speed = _TORQUE.search(head), _SPEED.search(head)
    return torque is not None and (speed is None or torque.start() < speed.start())


def _check_quantity(path: Path | str, header: list[str], quantity: str) -> None:
    """Refuse losses that would be taken for efficiencies."""
    lost = next((cell for cell in header if re.search(_LOSS, cell, re.IGNORECASE)), None)
    if lost is not None and quantity == "efficiency":
        raise ConfigError(path, "", f"the header says {lost!r}", "efficiencies, or --quantity loss")


def _value(table: Table, line: int, text: str, column: str) -> float:
    text = text.removesuffix("%").rstrip()
    return math.nan if is_nothing(text) or text.lower() == "inf" else table.number(line, text, column)


def _list(table: Table, said: list[str]) -> list[tuple[int, float, float, float]]:
    *header, _ = _header(table)
    swapped = any(len(row) == 3 and re.search(_TORQUE, row[0]) and re.search(_SPEED, row[1]) for _, row in header)
    said += ["torques in the first column, as the header says"] if swapped else []
    for line, row in header:
        early = next(
            (cell for cell in row[:2] if len(row) == 3 and all(row) and re.search(_VALUE, cell, re.IGNORECASE)), None
        )
        if early is not None:
            raise ConfigError(table.path, f"line {line}", f"{early!r} is not the last column", "speed, torque, value")
    rows = []
    for line, cells in table.rows[len(header) :]:
        if len(cells) != 3:
            raise ConfigError(table.path, f"line {line}", f"has {len(cells)} values", "3: speed, torque, value")
        if swapped:
            cells = [cells[1], cells[0], cells[2]]
        speed, torque = (table.number(line, cells[i], COLUMNS[i]) for i in (0, 1))
        rows.append((line, speed, torque, _value(table, line, cells[2], "value")))
    return rows


def _matrix(table: Table, down: str) -> list[tuple[int, float, float, float]]:
    *title, (first, head) = _header(table)
    if title and len(title[-1][1]) > 1 and all(title[-1][1]):
        raise ConfigError(table.path, f"line {title[-1][0]}, column 2", f"{title[-1][1][1]!r} is no number")
    across = [table.number(first, text, f"column {i}") for i, text in enumerate(head[1:], 2) if text]
    if down == "torque" and min(across, default=0.0) < 0.0:
        raise ConfigError(table.path, f"line {first}", f"speed {min(across):g} is out of range", ">= 0")
    rows = []
    for line, cells in table.rows[len(title) + 1 :]:
        if len(cells) > len(across) + 1 and any(cells[len(across) + 1 :]):
            raise ConfigError(
                table.path, f"line {line}", f"has {len(cells) - 1} values", f"{len(across)}, as in line {first}"
            )
        side = table.number(line, cells[0], "column 1")
        if down == "speed" and side < 0.0:
            raise ConfigError(table.path, f"line {line}", f"speed {side:g} is out of range", ">= 0, or --down torque")
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
        braking = " (braking: electrical over mechanical power)" if power < 0.0 else ""
        problem = f"efficiency {value:g} is out of range"
        raise ConfigError(path, f"line {line}", problem, f"0 to 1{braking}, or --percent, or --quantity loss")
    return value


def map_text(points: Points) -> str:
    """The points as a map's CSV; where nothing is known, nothing stands."""
    rows = sorted(points.efficiency.items())
    lines = [f"{s:.10g},{t:.10g},{'' if math.isnan(eta) else f'{eta:.8g}'}" for (s, t), eta in rows]
    return "\n".join([",".join(COLUMNS), *lines]) + "\n"
