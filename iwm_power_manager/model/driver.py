# SPDX-License-Identifier: Apache-2.0
"""A driver: follows a speed trace with two pedals, and what the pedals ask for.

The simulation drives with it, and the offline tool learns from it what a driver demands on a cycle. The driver looks a
little ahead, knows the car's mass and road load, and corrects the speed error with a PI controller whose integral stops
while a pedal is fully pressed. What the pedals mean stands in `iwm_power_manager.model.pedals`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iwm_power_manager.cycle import Cycle
from iwm_power_manager.jit import kernel
from iwm_power_manager.model.chassis import equivalent_mass_kg, road_load_n
from iwm_power_manager.model.parameters import VehicleParams
from iwm_power_manager.model.pedals import full_braking_w, full_power_w, pedal_power_w

#: Below these speeds, m/s, trace and car count as standing; the driver then rests a foot on the brake. Schedules
#: recorded on real roads hold speeds of 0.1 to 0.4 mph at stops (NYCC has 35 such seconds): nobody drives those.
STANDING_TRACE_MPS = 0.2
STANDING_CAR_MPS = 0.3
HOLDING_BRAKE = 0.1


class Trace(NamedTuple):
    """A cycle sampled at the control step, as the driver sees it; arrays of equal length.

    Attributes
    ----------
    speed_mps : now
    ahead_mps, ahead_mps2 : speed and slope `preview_s` from now
    grade : rise over run, now
    """

    speed_mps: NDArray[np.float64]
    ahead_mps: NDArray[np.float64]
    ahead_mps2: NDArray[np.float64]
    grade: NDArray[np.float64]


def sample(cycle: Cycle, dt_s: float, preview_s: float) -> Trace:
    """The trace at 0, dt, 2 dt ... up to the cycle's end, linear between its points."""
    start = cycle.time_s[0]
    steps = int(np.floor((cycle.time_s[-1] - start) / dt_s + 1e-9))
    time = start + dt_s * np.arange(steps)

    def speed(at: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.interp(at, cycle.time_s, cycle.speed_mps)

    half = 0.5 * dt_s
    return Trace(
        speed(time),
        speed(time + preview_s),
        (speed(time + preview_s + half) - speed(time + preview_s - half)) / dt_s,
        np.interp(time, cycle.time_s, cycle.grade),
    )


class DriverState(NamedTuple):
    """What the driver remembers: integral of the speed error, m."""

    error_integral_m: float


class Pedals(NamedTuple):
    """What the driver does: pedals 0..1, and the power demand they stand for, W, braking negative."""

    accelerator: float
    brake: float
    power_demand_w: float


@kernel
def drive(
    state: DriverState,
    speed_mps: float,
    trace_mps: float,
    trace_ahead_mps: float,
    acceleration_ahead_mps2: float,
    grade: float,
    dt_s: float,
    vehicle: VehicleParams,
) -> tuple[Pedals, DriverState]:
    """One look at the speedometer.

    Parameters
    ----------
    speed_mps : of the car
    trace_mps : speed the trace has now
    trace_ahead_mps, acceleration_ahead_mps2 : speed and slope of the trace `preview_s` from now
    grade : rise over run, which the driver feels
    dt_s : time until the next look
    """
    if trace_mps < STANDING_TRACE_MPS and trace_ahead_mps < STANDING_TRACE_MPS and speed_mps < STANDING_CAR_MPS:
        power = pedal_power_w(0.0, HOLDING_BRAKE, speed_mps, vehicle)
        return Pedals(0.0, HOLDING_BRAKE, power), DriverState(0.0)
    settings = vehicle.driver
    error = trace_mps - speed_mps
    load = road_load_n(speed_mps, grade, vehicle.chassis)
    force = (
        equivalent_mass_kg(vehicle) * acceleration_ahead_mps2
        + load
        + settings.proportional_n_per_mps * error
        + settings.integral_n_per_m * state.error_integral_m
    )
    wanted = force * max(speed_mps, settings.power_speed_floor_mps)
    accelerator = 0.0
    brake = 0.0
    saturated = False
    if wanted > 0.0:
        accelerator = wanted / full_power_w(speed_mps, vehicle)
        saturated = accelerator > 1.0 and error > 0.0
        accelerator = min(accelerator, 1.0)
    else:
        brake = -wanted / full_braking_w(speed_mps, vehicle)
        saturated = brake > 1.0 and error < 0.0
        brake = min(brake, 1.0)
    integral = state.error_integral_m if saturated else state.error_integral_m + error * dt_s
    return Pedals(accelerator, brake, pedal_power_w(accelerator, brake, speed_mps, vehicle)), DriverState(integral)
