# SPDX-License-Identifier: Apache-2.0
"""Emergency stops: how far the car slides under each kind of skid avoidance, beside the best that friction allows."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from iwm_power_manager.control.repeat import advance
from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.control.table import empty_table
from iwm_power_manager.control.types import initial_state
from iwm_power_manager.held import Held
from iwm_power_manager.model.chassis import GRAVITY_MPS2
from iwm_power_manager.model.parameters import VehicleParams
from iwm_power_manager.model.tyre import friction_coefficient, slip_ratio
from iwm_sim import closed_loop, plant
from iwm_sim.metrics import CRITICAL_SLIP, MOVING_MPS, longest_s
from iwm_sim.study import cases
from iwm_sim.study.variants import with_gate

STOP_FROM_MPS = 25.0

#: What the driver asks for, g: more than any road gives.
DEMAND_G = 1.5

#: The car counts as stopped below this, m/s; and gives up after that, s.
_STOPPED_MPS = 0.05
_LONGEST_S = 60.0


class Stop(NamedTuple):
    """An emergency stop to be made; fields as in `cases.Case`."""

    vehicle: str
    idle_drive: str
    friction: float
    gate_mode: str
    strategy: str
    policy: str = ""
    dt_s: float = 0.01
    from_mps: float = STOP_FROM_MPS


@dataclass(frozen=True)
class Stopped:
    """What came of an emergency stop.

    Attributes
    ----------
    distance_m, best_m : how far it slid, and the shortest stop with all wheels at one slip, `best_slip`
    longer_percent : than the best
    locked_s, longest_locked_s : an axle beyond the critical slip, in all and at a stretch
    """

    idle_drive: str
    friction: float
    gate_mode: str
    strategy: str
    distance_m: float
    best_m: float
    best_slip: float
    longer_percent: float
    stopped: bool
    min_slip: float
    locked_s: float
    longest_locked_s: float
    rms_jerk_mps3: float


def best_stop_m(friction: float, from_mps: float, vehicle: VehicleParams) -> tuple[float, float]:
    """Shortest stop with all wheels held at one slip, and that slip.

    Written down anew from eq. 1, 3, 4 and 6, without the kernels of the motion: at a constant slip s every wheel
    gives mu(s) of its load, the loads sum up to the weight, so the deceleration is g (mu(s) + c_rr) + k v^2 and the
    distance its closed integral.
    """
    chassis = vehicle.chassis
    slip = np.linspace(1e-3, 1.0, 5000)
    used = np.array([friction_coefficient(s, friction, vehicle.front.tyre) for s in slip])
    steady = GRAVITY_MPS2 * (used + chassis.rolling_resistance)
    air = 0.5 * chassis.air_density_kgpm3 * chassis.frontal_area_m2 * chassis.drag_coefficient / chassis.mass_kg
    distance = np.log1p(air * from_mps**2 / steady) / (2.0 * air)
    best = int(np.argmin(distance))
    return float(distance[best]), float(slip[best])


def emergency_stop(stop: Stop) -> Stopped:
    """Make the stop and say what came of it."""
    vehicle = cases.vehicle_of(stop.vehicle, stop.idle_drive)
    params = vehicle.params
    settings = with_gate(default_settings(stop.strategy), stop.gate_mode)
    table = cases.policy_of(stop.policy).table() if stop.policy else empty_table()
    road = plant.Surroundings((stop.friction,) * 4)
    car = plant.initial_plant(params, 0.8, stop.from_mps)
    before, after, held = Held(initial_state()), Held(initial_state()), Held(params)
    slips: list[list[float]] = []
    speeds: list[float] = []
    accelerations: list[float] = []
    while car.speed_mps > _STOPPED_MPS and len(speeds) * stop.dt_s < _LONGEST_S:
        floor = params.driver.power_speed_floor_mps
        demand = -DEMAND_G * params.chassis.mass_kg * GRAVITY_MPS2 * max(car.speed_mps, floor)
        measurement = closed_loop.measure(
            car, float(demand), stop.dt_s, stop.friction, 0.0, (0.0, 0.0, 0.0, 0.0), params
        )
        command, *_ = advance(measurement, before, after, settings, held, table)
        before, after = after, before
        slips.append(_axle_slips(car, params))
        speeds.append(car.speed_mps)
        car = plant.advance(car, command.motor_torque_nm, command.friction_torque_nm, 0.0, road, stop.dt_s, 1, params)
        accelerations.append(car.acceleration_mps2)
    best_m, best_slip = best_stop_m(stop.friction, stop.from_mps, params)
    lowest = np.min(np.array(slips), axis=1)
    moving = np.array(speeds) > MOVING_MPS
    beyond = (lowest < -CRITICAL_SLIP) & moving
    jerk = np.diff(np.array(accelerations)) / stop.dt_s
    return Stopped(
        idle_drive=vehicle.idle_drive,
        friction=stop.friction,
        gate_mode=stop.gate_mode,
        strategy=stop.strategy,
        distance_m=float(car.distance_m),
        best_m=best_m,
        best_slip=-best_slip,
        longer_percent=100.0 * (float(car.distance_m) / best_m - 1.0),
        stopped=bool(car.speed_mps <= _STOPPED_MPS),
        min_slip=float(np.min(lowest[moving])) if moving.any() else 0.0,
        locked_s=float(np.count_nonzero(beyond) * stop.dt_s),
        longest_locked_s=longest_s(beyond, stop.dt_s),
        rms_jerk_mps3=float(math.sqrt(np.mean(jerk**2))) if jerk.size else 0.0,
    )


def _axle_slips(car: plant.PlantState, params: VehicleParams) -> list[float]:
    """Slip of the left wheel of each axle; in a straight stop, the right one's is the same."""
    return [
        slip_ratio(car.wheel_speed_radps[wheel], car.speed_mps, axle.wheel.radius_m, axle.tyre.slip_speed_floor_mps)
        for wheel, axle in ((0, params.front), (2, params.rear))
    ]
