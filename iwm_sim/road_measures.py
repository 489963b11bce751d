# SPDX-License-Identifier: Apache-2.0
"""What a drive on a real road amounts to: how it stops, stays in its lane, holds, and what its wheels do meanwhile.

Every measure is a function of a finished run; `NAMES` are what a scenario's `require` may bound. Those of a braking
begin when the driver first asks for braking and end at standstill or at the end. Several are those of UN Regulation No.
13-H, Annex 6 (tests of vehicles with anti-lock systems; Appendix 2, utilisation of adhesion; Appendix 3, performance on
differing adhesion surfaces), in EUR-Lex 2026/502. Which paragraph asks for what, and what of it was read, is in
`docs/safety.md`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from iwm_power_manager.model.chassis import GRAVITY_MPS2
from iwm_power_manager.model.parameters import VehicleParams
from iwm_sim.closed_loop import ROAD_COLUMNS, SHORT_WHEEL_NAMES, Run
from iwm_sim.metrics import longest_s

FloatArray = npt.NDArray[np.float64]

#: A wheel is locked at this slip, and beyond the critical one at this; the car moves above this speed, m/s.
LOCKED_SLIP = -0.9
CRITICAL_SLIP = -0.2
MOVING_MPS = 1.0
#: Speeds of UN R13-H: rate of braking from 45 to 15 km/h; wheels may lock below 15 km/h.
RATE_FROM_MPS = 45.0 / 3.6
RATE_TO_MPS = 15.0 / 3.6
#: Part of the deceleration asked for, as far as the road can give it, below which braking counts as lost.
GIVEN = 0.85
#: How long a braking may take to build up, s.
BUILDS_UP_S = 0.3
#: Width of a tyre, m: what of it touches the line is out of the lane.
TYRE_WIDTH_M = 0.2


@dataclass(frozen=True, eq=False)
class Driven:
    """A run with what measures take from it.

    Attributes
    ----------
    vehicle : the car as it is
    braking : index of the first step in which braking was asked for (the number of steps if it never was)
    """

    run: Run
    road: FloatArray
    vehicle: VehicleParams
    braking: int

    def __getitem__(self, column: str) -> FloatArray:
        return self.road[:, ROAD_COLUMNS.index(column)] if column in ROAD_COLUMNS else self.run[column]

    def wheels(self, column: str) -> FloatArray:
        """Four columns, (steps, 4): `column` has a `{}` in the place of the wheel."""
        return np.stack([self[column.format(wheel)] for wheel in SHORT_WHEEL_NAMES], axis=1)


def driven(run: Run, vehicle: VehicleParams) -> Driven:
    """A run made ready for measuring; it comes from a `drive.Drive`."""
    assert run.road is not None
    asked = np.flatnonzero(run["power_demand_w"] < 0.0)
    return Driven(run, run.road, vehicle, int(asked[0]) if asked.size else len(run.series))


def _stopped(d: Driven) -> int:
    """Index of the first step at rest after the braking began; the number of steps if there is none."""
    still = np.flatnonzero(np.abs(d["speed_mps"][d.braking :]) < 0.05)
    if still.size:
        return d.braking + int(still[0])
    return len(d.run.series)


def _has_stopped(d: Driven) -> bool:
    return _stopped(d) < len(d.run.series) or (d.braking < len(d.run.series) and abs(d.run.final.speed_mps) < 0.05)


def stopping_distance_m(d: Driven) -> float:
    """Way along the road from the first braking demand to standstill; infinite if the car does not stop."""
    if not _has_stopped(d):
        return math.inf
    end = _stopped(d)
    after = d.run.final.x_m if end == len(d.run.series) else d["x_m"][end]
    return float(abs(after - d["x_m"][d.braking]))


def stopping_time_s(d: Driven) -> float:
    """Time from the first braking demand to standstill."""
    return (_stopped(d) - d.braking) * d.run.dt_s if _has_stopped(d) else math.inf


def braking_rate(d: Driven) -> float:
    """Braking rate z = 0.849 / t with the time from 45 to 15 km/h (Appendix 2); 0 if that is not reached."""
    speed = np.abs(d["speed_mps"])
    fast = np.flatnonzero(speed >= RATE_FROM_MPS)
    slow = np.flatnonzero(speed <= RATE_TO_MPS)
    if not fast.size or not slow.size or slow[-1] < fast[-1]:
        return 0.0
    end = slow[slow > fast[-1]][0]
    time_s = (end - fast[-1]) * d.run.dt_s
    return (RATE_FROM_MPS - RATE_TO_MPS) / GRAVITY_MPS2 / time_s


def adhesion_used(d: Driven) -> float:
    """Braking rate over the road's peak friction, where it is lowest (Annex 6 asks for 0.75)."""
    return braking_rate(d) / float(np.min(d.wheels("road_{}")))


def split_rate(d: Driven) -> float:
    """Braking rate over what a split road asks for, 0.75 (4 k2 + k1) / 5 and k2, the larger (Annex 6)."""
    road = d.wheels("road_{}")[d.braking :]
    high, low = float(road.max()), float(road.min())
    return braking_rate(d) / max(0.75 * (4.0 * low + high) / 5.0, low)


def _beyond(d: Driven, slip: float, above_mps: float, column: int | None = None) -> float:
    slips = d.wheels("slip_{}")
    moving = np.abs(d["speed_mps"]) > above_mps
    which = range(4) if column is None else (column,)
    return max(longest_s(moving & (slips[:, i] < slip), d.run.dt_s) for i in which)


def longest_locked_s(d: Driven) -> float:
    """Longest time that one wheel is locked while the car is faster than 15 km/h."""
    return _beyond(d, LOCKED_SLIP, RATE_TO_MPS)


def longest_beyond_critical_s(d: Driven) -> float:
    """Longest time that one wheel's braking slip is beyond 0.2 while the car moves."""
    return _beyond(d, CRITICAL_SLIP, MOVING_MPS)


def longest_spinning_s(d: Driven) -> float:
    """Longest time that one wheel's driving slip is beyond 0.2 with a rim faster than 1 m/s over ground."""
    front, rear = d.vehicle.front.wheel.radius_m, d.vehicle.rear.wheel.radius_m
    rims = d.wheels("wheel_{}_radps") * np.array([front, front, rear, rear])
    over = rims - d["speed_mps"][:, None]
    spinning = (d.wheels("slip_{}") > -CRITICAL_SLIP) & (over > MOVING_MPS)
    return max(longest_s(spinning[:, i], d.run.dt_s) for i in range(4))


def _asked_mps2(d: Driven) -> FloatArray:
    """Deceleration the driver asks for, as far as the road under the wheels can give it, in the direction of travel."""
    speed = np.maximum(np.abs(d["speed_mps"]), d.vehicle.driver.power_speed_floor_mps)
    asked = np.maximum(-d["power_demand_w"], 0.0) / (d.vehicle.chassis.mass_kg * speed)
    most = GRAVITY_MPS2 * np.mean(d.wheels("road_{}"), axis=1)
    return np.minimum(asked, most)


def _given_mps2(d: Driven) -> FloatArray:
    """Deceleration by the tyres alone: slope, air and rolling resistance taken off."""
    chassis = d.vehicle.chassis
    speed = d["speed_mps"]
    ways = np.where(speed < 0.0, -1.0, 1.0)
    grade = d["grade"]
    load = GRAVITY_MPS2 * grade / np.sqrt(1.0 + grade * grade)
    air = 0.5 * chassis.air_density_kgpm3 * chassis.frontal_area_m2 * chassis.drag_coefficient / chassis.mass_kg
    rest = ways * load + air * speed * speed + chassis.rolling_resistance * GRAVITY_MPS2
    return np.asarray(-ways * d["acceleration_mps2"] - rest, dtype=np.float64)


def least_braking(d: Driven) -> float:
    """Braking force over the one asked for (as far as the road gives it), the mean from 0.3 s to standstill."""
    part = slice(d.braking + round(BUILDS_UP_S / d.run.dt_s), _stopped(d))
    moving = np.abs(d["speed_mps"][part]) > MOVING_MPS
    asked = _asked_mps2(d)[part][moving]
    if not asked.size or not asked.sum():
        return 0.0
    return float(_given_mps2(d)[part][moving].sum() / asked.sum())


def longest_under_braked_s(d: Driven) -> float:
    """Longest time that less than 85 % of the braking asked for, as far as the road gives it, is there."""
    moving = np.abs(d["speed_mps"]) > MOVING_MPS
    asked = _asked_mps2(d)
    return longest_s(moving & (asked > 0.0) & (_given_mps2(d) < GIVEN * asked), d.run.dt_s)


def _jump(d: Driven) -> int:
    """Index of the step in which the front axle comes onto another road while braking."""
    front = d.wheels("road_{}")[:, :2].mean(axis=1)
    changed = np.flatnonzero(np.diff(front[d.braking :]) != 0.0)
    return d.braking + int(changed[0]) + 1 if changed.size else len(d.run.series)


def rise_after_jump_s(d: Driven) -> float:
    """Time from the front axle's arrival on another road until 90 % of that road's deceleration is there to stay.

    To stay until the car is slower than 15 km/h; infinite if that is never so, or there is no other road.
    """
    start = _jump(d)
    if start >= len(d.run.series):
        return math.inf
    speed = np.maximum(np.abs(d["speed_mps"][start:]), d.vehicle.driver.power_speed_floor_mps)
    asked = np.maximum(-d["power_demand_w"][start:], 0.0) / (d.vehicle.chassis.mass_kg * speed)
    wanted = 0.9 * np.minimum(asked, GRAVITY_MPS2 * d["road_fl"][-1])
    fast = speed > RATE_TO_MPS
    short = np.flatnonzero(fast & (_given_mps2(d)[start:] < wanted))
    if not fast.any() or (short.size and not fast[short[-1] + 1 :].any()):
        return math.inf
    return float((short[-1] + 1) * d.run.dt_s) if short.size else 0.0


def _steering_deg(d: Driven) -> FloatArray:
    return np.degrees(np.abs(d["steering_wheel_rad"]))


def steering_2s_deg(d: Driven) -> float:
    """Largest angle of the steering wheel in the first 2 s of a braking (Annex 6: at most 120 degrees)."""
    part = _steering_deg(d)[d.braking : d.braking + round(2.0 / d.run.dt_s)]
    return float(part.max()) if part.size else 0.0


def steering_deg(d: Driven) -> float:
    """Largest angle of the steering wheel (Annex 6: at most 240 degrees)."""
    return float(_steering_deg(d).max())


def lane_m(d: Driven) -> float:
    """Width of the lane, about its middle, that no part of a tyre leaves."""
    cosine, sine = np.cos(d["heading_rad"]), np.sin(d["heading_rad"])
    chassis = d.vehicle.chassis
    furthest = 0.0
    for x, axle in ((chassis.front_axle_to_cg_m, d.vehicle.front), (-chassis.rear_axle_to_cg_m, d.vehicle.rear)):
        for side in (-0.5, 0.5):
            outer = side * (axle.track_width_m + TYRE_WIDTH_M)
            furthest = max(furthest, float(np.max(np.abs(d["y_m"] + sine * x + cosine * outer))))
    return 2.0 * furthest


def largest_yaw_moment_nm(d: Driven) -> float:
    """Largest yaw moment of the torques at the wheels (motors and brakes), right against left."""
    total = d.wheels("motor_{}_nm") + d.wheels("friction_{}_nm")
    moment = np.zeros(len(total))
    for left, axle in ((0, d.vehicle.front), (2, d.vehicle.rear)):
        arm = 0.5 * axle.track_width_m / axle.wheel.radius_m
        moment += arm * (total[:, left + 1] - total[:, left])
    return float(np.max(np.abs(moment)))


def largest_yaw_rate_dps(d: Driven) -> float:
    """Largest yaw rate, degrees a second."""
    return float(np.degrees(np.max(np.abs(d["yaw_rate_radps"]))))


def rolled_back_m(d: Driven) -> float:
    """Way against the direction asked for (forward), from the start."""
    return max(-float(np.min(d["distance_m"])), -d.run.final.distance_m, 0.0)


def moved_m(d: Driven) -> float:
    """Largest distance from the start, either way."""
    return max(float(np.max(np.abs(d["distance_m"]))), abs(d.run.final.distance_m))


def distance_m(d: Driven) -> float:
    """Distance at the end, forward positive."""
    return d.run.final.distance_m


def final_speed_mps(d: Driven) -> float:
    """Speed at the end."""
    return d.run.final.speed_mps


def wheels_lost_s(d: Driven) -> float:
    """Time that some wheel is not believed."""
    return float(np.count_nonzero(d["wheels_lost"] > 0.0) * d.run.dt_s)


def doubted_s(d: Driven) -> float:
    """Time that the law does not believe some sensor."""
    return float(np.count_nonzero(d["doubted"] > 0.0) * d.run.dt_s)


def degraded_s(d: Driven) -> float:
    """Time that the power manager is not in its normal mode."""
    known = d["mode"][np.isfinite(d["mode"])]
    return float(np.count_nonzero(known != 1.0) * d.run.dt_s)


MEASURES: dict[str, Callable[[Driven], float]] = {
    measure.__name__: measure
    for measure in (
        stopping_distance_m,
        stopping_time_s,
        braking_rate,
        adhesion_used,
        split_rate,
        least_braking,
        longest_under_braked_s,
        longest_locked_s,
        longest_beyond_critical_s,
        longest_spinning_s,
        rise_after_jump_s,
        steering_2s_deg,
        steering_deg,
        lane_m,
        largest_yaw_moment_nm,
        largest_yaw_rate_dps,
        rolled_back_m,
        moved_m,
        distance_m,
        final_speed_mps,
        wheels_lost_s,
        doubted_s,
        degraded_s,
    )
}

#: Measures relative to the same scenario with everything whole.
OF_HEALTHY = {"stopping_distance_of_healthy": stopping_distance_m, "final_speed_of_healthy": final_speed_mps}

NAMES = (*MEASURES, *OF_HEALTHY)


def measured(names: Sequence[str], run: Driven, healthy: Driven | None = None) -> dict[str, float]:
    """The measures by name; those relative to the healthy car need its run."""
    values = {}
    for name in names:
        if name in MEASURES:
            values[name] = MEASURES[name](run)
        else:
            assert healthy is not None
            values[name] = OF_HEALTHY[name](run) / OF_HEALTHY[name](healthy)
    return values
