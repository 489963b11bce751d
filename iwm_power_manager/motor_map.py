# SPDX-License-Identifier: Apache-2.0
"""Motor maps: a CSV of efficiencies over speed and torque -> losses on a grid, which reach as far as the motor does.

What a map does not say is not made up in silence: a grid point inside the motor's limits that is missing, a torque or a
speed that the car reaches and the map does not, is refused with its name, or, where the vehicle file asks for it, taken
from a loss polynomial fitted to the map.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iwm_power_manager import files
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.model.parameters import FloatArray
from iwm_power_manager.tables import read_table

COLUMNS = ("speed_rad_s", "torque_nm", "efficiency")
RANGES = {"speed_rad_s": (0.0, 20_000.0), "torque_nm": (-20e3, 20e3), "efficiency": (0.0, 1.0)}
#: Speeds and torques of a grid.
MAX_AXIS_POINTS = 1000
MAX_POINTS = 200_000
#: A map that ends this little before the motor's limit reaches it: its edge holds there.
REACH_TOLERANCE = 0.02
#: No car's motor loses more, W: such an efficiency is an error of its table.
_MOST_LOSS_W = 1e9


class MotorMap(NamedTuple):
    """Losses over a grid.

    Attributes
    ----------
    speed_radps : float64[n], rising, >= 0
    torque_nm : float64[m], rising, driving positive
    loss_w : float64[n, m], NaN where nothing is known
    """

    speed_radps: FloatArray
    torque_nm: FloatArray
    loss_w: FloatArray


class Reach(NamedTuple):
    """Where a motor can be: what its map has to cover. All at the motor's own shaft."""

    peak_torque_nm: float
    regeneration_torque_nm: float
    max_power_w: float
    top_speed_radps: float

    def limit_nm(self, speed_radps: FloatArray, driving: bool) -> FloatArray:
        """Largest torque at each speed, N m, >= 0."""
        torque = self.peak_torque_nm if driving else min(self.regeneration_torque_nm, self.peak_torque_nm)
        return np.minimum(torque, self.max_power_w / np.maximum(speed_radps, 1e-9))


class LossFit(NamedTuple):
    """The loss polynomial that fits a map best.

    Attributes
    ----------
    coefficients : constant (W), times speed, speed squared, torque, torque squared; none negative
    rms_error, worst_error : of the efficiency over the map's points, 0..1
    """

    coefficients: tuple[float, float, float, float, float]
    rms_error: float
    worst_error: float

    def loss_w(self, speed_radps: FloatArray, torque_nm: FloatArray) -> FloatArray:
        """Loss at speeds and torques of one shape, W."""
        return np.tensordot(np.array(self.coefficients), _terms(speed_radps, torque_nm), axes=1)

    def __str__(self) -> str:
        a, b, c, d, e = self.coefficients
        return f"{a:.4g} + {b:.4g} w + {c:.4g} w^2 + {d:.4g} |T| + {e:.4g} T^2 W"


def read_map(path: Path | str) -> MotorMap:
    """The points of a map's CSV on their grid; `ConfigError` names the line of a mistake.

    The CSV has the columns `speed_rad_s,torque_nm,efficiency`. Efficiency is mechanical over electrical power when
    driving and electrical over mechanical when regenerating (eq. 14, 15). At zero speed or zero torque it says nothing:
    whatever stands there is ignored. Points that are missing, empty, NaN or 0 are taken to lie outside the motor's
    limits (`missing` checks that), but for a regeneration that brings nothing.
    """
    points: dict[tuple[float, float], float] = {}
    (first, header), *rows = read_table(path, "comma", "point").rows
    if tuple(header) != COLUMNS:
        hint = ": separated by ';'? import_motor reads that" if ";" in header[0] else ""
        raise ConfigError(path, f"line {first}", f"{','.join(header)!r} is no header{hint}", ",".join(COLUMNS))
    for line, cells in rows:
        speed, torque, efficiency = _point(path, line, cells)
        if (speed, torque) in points:
            raise ConfigError(path, f"line {line}", f"repeats speed {speed:g}, torque {torque:g}")
        points[speed, torque] = efficiency
        if len(points) > MAX_POINTS:
            raise ConfigError(path, f"line {line}", "is one point too many", f"{MAX_POINTS}")
    return map_of(path, points)


def _point(path: Path | str, line: int, cells: list[str]) -> tuple[float, float, float]:
    """Speed, torque and efficiency of a row; NaN where the efficiency is not known or says nothing."""
    if len(cells) != 3:
        hint = ": decimal commas? import_motor reads them" if len(cells) > 3 else ""
        raise ConfigError(path, f"line {line}", f"has {len(cells)} values{hint}", "3")
    speed, torque = (_cell(path, line, column, cell) for column, cell in zip(COLUMNS, cells[:2], strict=False))
    text = cells[2].strip().lower()
    if speed * torque == 0.0 or text in ("", "nan"):
        return speed, torque, math.nan
    return speed, torque, _cell(path, line, "efficiency", cells[2])


def _cell(path: Path | str, line: int, column: str, text: str) -> float:
    low, high = RANGES[column]
    where = f"line {line}, {column}"
    try:
        value = files.to_number(text)
    except ValueError as error:
        raise ConfigError(path, where, str(error), f"{low:g} to {high:g}") from None
    if column == "efficiency" and 1.0 < value < math.inf:
        meant = "in percent? import_motor reads that" if value <= 100.0 else "a loss in W? import_motor --quantity loss"
        raise ConfigError(path, where, f"{value:g} is out of range: {meant}", "0 to 1")
    return files.check_number(path, where, value, low, high)


def map_of(path: Path | str, efficiency: dict[tuple[float, float], float]) -> MotorMap:
    """Efficiencies by (speed, torque) on their grid, as losses; an efficiency of NaN or 0 is none."""
    speeds = np.array(sorted({s for s, _ in efficiency}))
    torques = np.array(sorted({t for _, t in efficiency}))
    if len(speeds) < 2 or len(torques) < 2:
        raise ConfigError(path, "", f"has {len(speeds)} speeds and {len(torques)} torques", "2 or more of each")
    if max(len(speeds), len(torques)) > MAX_AXIS_POINTS or len(speeds) * len(torques) > MAX_POINTS:
        problem = f"has {len(speeds)} speeds and {len(torques)} torques: its points lie on no grid"
        raise ConfigError(path, "", problem, f"{MAX_AXIS_POINTS} of each, {MAX_POINTS} in all")
    given = np.full((len(speeds), len(torques)), np.nan)
    row, column = ({value: i for i, value in enumerate(axis.tolist())} for axis in (speeds, torques))
    for (s, t), eta in efficiency.items():
        given[row[s], column[t]] = eta
    power = speeds[:, None] * torques
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        loss = np.where(power > 0.0, power / given - power, -power * (1.0 - given))
    loss[~(given > 0.0) & ~((given == 0.0) & _brings_nothing(power, given)) | (power == 0.0)] = np.nan
    for i, j in np.argwhere(loss > _MOST_LOSS_W)[:1]:
        where = f"speed {speeds[i]:g} rad/s, torque {torques[j]:g} N m"
        problem = f"efficiency {given[i, j]:g} means a loss of {loss[i, j]:g} W"
        raise ConfigError(path, where, problem, f"up to {_MOST_LOSS_W:g} W; nothing, or 0, where it is not known")
    if np.all(np.isnan(loss)):
        raise ConfigError(path, "", "has no efficiency above 0 where speed and torque are not 0")
    return MotorMap(speeds, torques, loss)


def _brings_nothing(power_w: FloatArray, efficiency: FloatArray) -> NDArray[np.bool_]:
    """Where an efficiency of 0 is a regeneration that brings nothing, as in slow driving, and no end of the map.

    There the motor gets as much at the same speed, or at a higher one, from as hard a braking, or a harder one.
    """
    brings = ((power_w < 0.0) & (efficiency > 0.0))[::-1]
    return (power_w < 0.0) & np.logical_or.accumulate(np.logical_or.accumulate(brings, axis=0)[::-1], axis=1)


def mirrored(path: Path | str, given: MotorMap, mirror: bool | None) -> MotorMap:
    """The map with both signs of torque.

    Parameters
    ----------
    mirror : True gives a map of one sign the other one: regeneration loses what driving loses at the same torque.
        None does so for a map of driving torques (vehicle files of format 1); one of braking torques is refused.
    """
    known = given.torque_nm[~np.all(np.isnan(given.loss_w), axis=0)]
    driving, braking = bool(np.any(known > 0.0)), bool(np.any(known < 0.0))
    if driving and braking:
        if mirror:
            raise ConfigError(path, "", "has torques of both signs: nothing to mirror", "mirror: false")
        return given
    if mirror is False or (mirror is None and braking):
        have, lack = ("driving", "regeneration") if driving else ("braking", "driving")
        problem = f"holds {have} torques only: the losses of {lack} are missing"
        raise ConfigError(path, "", problem, "torques of both signs, or mirror: true")
    if braking:
        given = MotorMap(given.speed_radps, -given.torque_nm[::-1], given.loss_w[:, ::-1])
    torque, loss = given.torque_nm, given.loss_w
    positive = torque > 0.0
    middle = torque == 0.0
    return MotorMap(
        given.speed_radps,
        np.concatenate((-torque[positive][::-1], torque[middle], torque[positive])),
        np.concatenate((loss[:, positive][:, ::-1], loss[:, middle], loss[:, positive]), axis=1),
    )


def filled(given: MotorMap) -> MotorMap:
    """The map with a loss at every point of its grid: between known torques, beyond them, then along speed."""
    speeds, torques, loss = given.speed_radps, given.torque_nm, given.loss_w.copy()
    for i in range(len(speeds)):
        known = np.flatnonzero(~np.isnan(loss[i]))
        if known.size:
            original = loss[i].copy()
            loss[i] = np.interp(torques, torques[known], original[known])
            for edge, inner, outside in (
                (known[-1], known[-2:][0], torques > torques[known[-1]]),
                (known[0], known[:2][-1], torques < torques[known[0]]),
            ):
                # A line from the last two of one sign; it may rise only, as losses do.
                if torques[edge] * torques[inner] > 0.0 and edge != inner:
                    slope = (original[edge] - original[inner]) / (torques[edge] - torques[inner])
                    beyond = original[edge] + slope * (torques[outside] - torques[edge])
                    loss[i, outside] = np.maximum(beyond, original[edge])
    rows = ~np.isnan(loss).any(axis=1)
    columns = [np.interp(speeds, speeds[rows], loss[rows, j]) for j in range(len(torques))]
    return MotorMap(speeds, torques, np.ascontiguousarray(np.array(columns).T))


def missing(given: MotorMap, reach: Reach) -> list[str]:
    """What a map of both signs lacks of what the motor can do, one text each; NaN is where nothing is known."""
    known = ~np.isnan(given.loss_w)
    found = []
    near = 1.0 - REACH_TOLERANCE
    speeds = given.speed_radps[known.any(axis=1)]
    if speeds[-1] < near * reach.top_speed_radps:
        found.append(f"speeds from {speeds[-1]:g} to the {reach.top_speed_radps:.4g} rad/s of the car's top speed")
    for driving, sign, name in ((True, 1.0, "peak"), (False, -1.0, "regeneration")):
        torques = sign * given.torque_nm[known.any(axis=0)]
        needed = float(reach.limit_nm(np.zeros(1), driving)[0])
        if max(float(torques.max()), 0.0) < near * needed:
            found.append(f"torques from {max(float(torques.max()), 0.0):g} to the {name} torque, {needed:.4g} N m")
        inside = (sign * given.torque_nm > 0.0) & (
            sign * given.torque_nm[None, :] <= reach.limit_nm(given.speed_radps, driving)[:, None]
        )
        inside &= (given.speed_radps > 0.0)[:, None] & (given.speed_radps <= reach.top_speed_radps)[:, None]
        holes = np.argwhere(inside & ~known)
        if holes.size:
            i, j = holes[0]
            point = f"speed {given.speed_radps[i]:g}, torque {given.torque_nm[j]:g}"
            found.append(f"{len(holes)} point{'s' * (len(holes) > 1)} inside the motor's limits, as {point}")
    return found


def _terms(speed_radps: FloatArray, torque_nm: FloatArray) -> FloatArray:
    size = np.abs(torque_nm)
    return np.array([np.ones_like(speed_radps), speed_radps, speed_radps**2, size, size**2])


def fit_loss(given: MotorMap) -> LossFit:
    """The loss polynomial of vehicle files, fitted to the points of a map: least squares of the relative error."""
    from scipy.optimize import nnls  # SciPy takes long to load, and few maps need it

    speed, torque = (x.ravel() for x in np.meshgrid(given.speed_radps, given.torque_nm, indexing="ij"))
    known = ~np.isnan(given.loss_w.ravel()) & (speed * torque != 0.0)
    speed, torque, loss = speed[known], torque[known], np.maximum(given.loss_w.ravel()[known], 1e-9)
    terms = _terms(speed, torque)
    coefficients, _ = nnls((terms / loss).T, np.ones(loss.size))
    fitted = np.tensordot(coefficients, terms, axes=1)
    power = np.abs(speed * torque)
    eta = [np.where(torque > 0.0, power / (power + x), np.maximum(1.0 - x / power, 0.0)) for x in (loss, fitted)]
    error = np.abs(eta[0] - eta[1])
    a, b, c, d, e = (float(x) for x in coefficients)
    return LossFit((a, b, c, d, e), float(np.sqrt(np.mean(error**2))), float(error.max()))


def extended(given: MotorMap, reach: Reach, fit: LossFit) -> MotorMap:
    """The map continued by its loss polynomial to all that the motor can do, at the spacing of its own edges."""
    speed = _continued(given.speed_radps, reach.top_speed_radps)
    torque = _continued(given.torque_nm, reach.peak_torque_nm)
    torque = -_continued(-torque[::-1], min(reach.regeneration_torque_nm, reach.peak_torque_nm))[::-1]
    loss = fit.loss_w(*np.meshgrid(speed, torque, indexing="ij"))
    rows, columns = np.searchsorted(speed, given.speed_radps), np.searchsorted(torque, given.torque_nm)
    block = loss[np.ix_(rows, columns)]
    loss[np.ix_(rows, columns)] = np.where(np.isnan(given.loss_w), block, given.loss_w)
    return MotorMap(speed, torque, np.ascontiguousarray(loss))


def _continued(axis: FloatArray, end: float) -> FloatArray:
    if axis[-1] >= end:
        return axis
    points = min(max(math.ceil((end - axis[-1]) / (axis[-1] - axis[-2])), 4), 40)
    return np.concatenate((axis, np.linspace(axis[-1], end, points + 1)[1:]))
