"""Motor maps: a CSV of efficiencies over speed and torque -> losses on a grid."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from iwm_power_manager import files
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.model.parameters import FloatArray


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
