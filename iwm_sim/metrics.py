# SPDX-License-Identifier: Apache-2.0
"""What a run amounts to: energy, trace, slip, share changes. Pure functions of a run's series."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from iwm_power_manager.model.parameters import VehicleParams
from iwm_sim.closed_loop import Run

FloatArray = npt.NDArray[np.float64]

#: EPA tolerance on a driven trace (40 CFR 1066.425): 2 mph around the trace, within 1 s.
TRACE_TOLERANCE_MPS = 2 * 0.44704
TRACE_WINDOW_S = 1.0

#: A change of the front share that counts.
SHARE_CHANGE = 0.25
#: Shares are multiples of a step that rounding must not carry over the line.
ROUNDING = 1e-9

#: An axle counts as locked or skidding while its slip is beyond the paper's critical slip and the car moves.
CRITICAL_SLIP = 0.2
MOVING_MPS = 1.0


class Metrics(NamedTuple):
    """Result of one run.

    `trace_excess_mps` is how far it left the EPA band at worst (0 if held). `share_travel_per_min` sums up all changes
    of the share, those too that are too small to count as one.
    """

    delta_soc_percent: float
    wh_per_km: float
    energy_wh: float
    distance_m: float
    rms_speed_error_mps: float
    max_speed_error_mps: float
    trace_held: bool
    trace_excess_mps: float
    min_slip: float
    max_slip: float
    locked_s: float
    longest_locked_s: float
    share_changes_per_min: float
    share_travel_per_min: float
    rms_jerk_mps3: float
    max_torque_rate_nmps: float
    final_soc: float


def trace_excess_mps(trace_mps: FloatArray, speed_mps: FloatArray, dt_s: float) -> float:
    """How far the speed leaves the band between the lowest and highest trace point within 1 s, less and plus 2 mph."""
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    width = 2 * round(TRACE_WINDOW_S / dt_s) + 1
    low = minimum_filter1d(trace_mps, width, mode="nearest") - TRACE_TOLERANCE_MPS
    high = maximum_filter1d(trace_mps, width, mode="nearest") + TRACE_TOLERANCE_MPS
    return float(max(np.max(low - speed_mps), np.max(speed_mps - high), 0.0))


def share_changes(share: FloatArray, least: float = SHARE_CHANGE) -> int:
    """Number of times the share moves by more than `least` from where it last counted."""
    count = 0
    level = share[0] if share.size else 0.0
    for value in share[np.flatnonzero(np.diff(share, prepend=np.nan))]:
        if abs(value - level) > least + ROUNDING:
            count += 1
            level = value
    return count


def share_swings(share: FloatArray, width: float = SHARE_CHANGE) -> int:
    """Number of times the share leaves a band of this width: the fewest cuts that leave no wider swing between them.

    `share_changes` is blind to a share that swings around where it last counted, by up to twice what counts.
    """
    count = 0
    low = high = share[0] if share.size else 0.0
    for value in share[np.flatnonzero(np.diff(share, prepend=np.nan))]:
        low, high = min(low, value), max(high, value)
        if high - low > width + ROUNDING:
            count += 1
            low = high = value
    return count


def longest_s(mask: npt.NDArray[np.bool_], dt_s: float) -> float:
    """Length of the longest stretch of True, s."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], mask, [False])).astype(np.int8)))
    return float((edges[1::2] - edges[::2]).max() * dt_s) if edges.size else 0.0


def measure(run: Run, vehicle: VehicleParams) -> Metrics:
    """All metrics of a run. Energy is chemical: what the cells gave, proportional to the charge at nominal voltage."""
    dt = run.dt_s
    error = run["speed_mps"] - run["trace_mps"]
    excess = trace_excess_mps(run["trace_mps"], run["speed_mps"], dt)
    moving = run["speed_mps"] > MOVING_MPS
    slips = np.stack((run["front_slip"], run["rear_slip"]))
    worst = np.min(slips, axis=0)
    locked = moving & (worst < -CRITICAL_SLIP)
    distance = run.final.distance_m
    energy_wh = run.final.energies.chemical_j / 3600.0
    depleted = float(run["soc"][0]) - run.final.soc
    minutes = run.series.shape[0] * dt / 60.0
    torques = np.stack((run["front_motor_nm"], run["rear_motor_nm"]))
    jerk = np.diff(run["acceleration_mps2"]) / dt
    return Metrics(
        delta_soc_percent=100.0 * depleted,
        wh_per_km=energy_wh / (distance / 1000.0) if distance > 0.0 else math.nan,
        energy_wh=energy_wh,
        distance_m=distance,
        rms_speed_error_mps=float(np.sqrt(np.mean(error**2))),
        max_speed_error_mps=float(np.max(np.abs(error))),
        trace_held=excess == 0.0,
        trace_excess_mps=excess,
        min_slip=float(slips[:, moving].min()) if moving.any() else 0.0,
        max_slip=float(slips[:, moving].max()) if moving.any() else 0.0,
        locked_s=float(np.count_nonzero(locked) * dt),
        longest_locked_s=longest_s(locked, dt),
        share_changes_per_min=share_changes(run["decided_share"]) / minutes if minutes > 0.0 else 0.0,
        share_travel_per_min=float(np.abs(np.diff(run["decided_share"])).sum()) / minutes if minutes > 0.0 else 0.0,
        rms_jerk_mps3=float(np.sqrt(np.mean(jerk**2))) if jerk.size else 0.0,
        max_torque_rate_nmps=float(np.max(np.abs(np.diff(torques, axis=1))) / dt) if torques.shape[1] > 1 else 0.0,
        final_soc=run.final.soc,
    )
