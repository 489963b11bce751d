# SPDX-License-Identifier: Apache-2.0
"""Drives and cars that nobody chose: drawn from a seed, to judge a strategy on what it was not made for.

Everything here is a pure function of its seed (NumPy's PCG64, whose streams do not change). Seeds below
`FIRST_JUDGING_SEED` are for development; what is published as a judgement uses seeds from there on.

Cycles
------
A Markov chain of (speed, acceleration, target speed) with a step of 1 s. The target is held for a random time and then
drawn anew, 0 (a stop) among its values; the acceleration follows the distance to the target with a random part and
inside what traffic uses; the speed integrates it. A cycle's character, from town to motorway, is drawn once: it sets
the targets' levels, how long they last and how often they are a stop. The grade is an Ornstein-Uhlenbeck process over
the distance, between flat country and hills by cycle.

Cars
----
Mass is drawn between 350 and 2800 kg, evenly in its logarithm; power, torque and frontal area follow with a spread.
Losses have the shape of the package's motor, scaled to the motor's size, each term with its own factor; some cars have
a map instead. Half of the cars have different motors in front and at the rear.

Logged noise
------------
`logged` turns a cycle into what a logger at 10 Hz gives of it: white noise of the speed signal, rounded to 0.1 km/h.
`pedal_noise` is what a foot adds to the demand.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from iwm_power_manager.cycle import Cycle, make_cycle
from iwm_power_manager.model.parameters import Axle, Battery, Chassis, Motor, VehicleParams
from iwm_power_manager.vehicle import Vehicle, with_params

FloatArray = npt.NDArray[np.float64]

#: Seeds from here on are only for judging; development uses the ones below.
FIRST_JUDGING_SEED = 1000

KMH = 1.0 / 3.6
LOG_PERIOD_S = 0.1
LOG_RESOLUTION_MPS = 0.1 * KMH

_TOP_SPEED_MPS = 36.0
_CORRELATION_LENGTH_M = 400.0


class _Character(NamedTuple):
    """What a cycle's chain is made of: target speeds, how long they and stops last, how likely the next is a stop."""

    mean_mps: float
    spread_mps: float
    hold_s: float
    stop: float
    standstill_s: float


_TOWN = _Character(9.0, 4.0, 12.0, 0.45, 18.0)
_MOTORWAY = _Character(29.0, 4.0, 45.0, 0.03, 10.0)


def cycle(seed: int, duration_s: int = 300) -> Cycle:
    """A drive from rest to rest.

    Parameters
    ----------
    seed : of all that is random in it
    duration_s : length; the last seconds brake to a stop
    """
    random = np.random.default_rng([1, seed])
    part = random.uniform()
    between = ((1.0 - part) * town + part * motorway for town, motorway in zip(_TOWN, _MOTORWAY, strict=True))
    character = _Character(*between)
    eagerness = random.uniform(0.6, 1.3)  # of the driver: factor on all accelerations
    jitter = random.uniform(0.05, 0.25)
    speed = np.zeros(duration_s + 1)
    acceleration, target, left = 0.0, 0.0, random.exponential(5.0)
    for k in range(duration_s):
        v = speed[k]
        left -= 1.0
        if left <= 0.0 and (target > 0.0 or v < 0.1):
            target, left = _next_target(random, character, target)
        if v * 1.6 / eagerness + 2.0 >= duration_s - k:  # time to come to rest
            target, left = 0.0, np.inf
        most = eagerness * 1.6 / (1.0 + (v / 15.0) ** 2) + 0.15
        wish = (target - v) / (3.0 if target > v else 4.0) + jitter * random.standard_normal()
        acceleration += 0.6 * (min(max(wish, -2.0 * eagerness), most) - acceleration)
        speed[k + 1] = min(max(v + acceleration, 0.0), _TOP_SPEED_MPS)
        if target == 0.0 and speed[k + 1] < 0.5:
            speed[k + 1] = 0.0
            acceleration = 0.0
    speed[-2:] = 0.0
    return make_cycle(f"generated_{seed}", np.arange(duration_s + 1.0), speed, _grade(random, speed))


def _next_target(random: np.random.Generator, character: _Character, target_mps: float) -> tuple[float, float]:
    """Target speed after this one, and how long it is to hold."""
    if target_mps > 0.0 and random.uniform() < character.stop:
        return 0.0, random.exponential(character.standstill_s) + 2.0
    drawn = character.mean_mps + character.spread_mps * random.standard_normal()
    return min(max(drawn, 3.0), _TOP_SPEED_MPS), random.exponential(character.hold_s) + 4.0


def _grade(random: np.random.Generator, speed_mps: FloatArray) -> FloatArray:
    """Rise over run along a drive: an Ornstein-Uhlenbeck process over the distance, no steeper than 8 %."""
    hilliness = random.uniform(0.0, 0.03)
    grade = np.zeros(speed_mps.size)
    for k in range(1, grade.size):
        kept = np.exp(-speed_mps[k] / _CORRELATION_LENGTH_M)
        grade[k] = kept * grade[k - 1] + hilliness * np.sqrt(1.0 - kept * kept) * random.standard_normal()
    return np.clip(grade, -0.08, 0.08)


def logged(cycle: Cycle, rms_kmh: float, seed: int) -> Cycle:
    """A cycle as a logger at 10 Hz gives it: white noise on the speed, rounded to 0.1 km/h, never below rest.

    Parameters
    ----------
    rms_kmh : of the noise before rounding; 0 rounds only
    """
    even = cycle.resample(LOG_PERIOD_S)
    random = np.random.default_rng([2, seed])
    speed = even.speed_mps + rms_kmh * KMH * random.standard_normal(even.speed_mps.size) * (even.speed_mps > 0.0)
    speed = np.maximum(np.round(speed / LOG_RESOLUTION_MPS) * LOG_RESOLUTION_MPS, 0.0)
    return make_cycle(f"{cycle.name}_logged", even.time_s, speed, even.grade)


def pedal_noise(steps: int, dt_s: float, seed: int, rms: float = 0.01) -> FloatArray:
    """What a foot adds to the pedal in each control step, as a part of its travel: white at 10 Hz, held between.

    Returns
    -------
    float64[steps]
    """
    random = np.random.default_rng([3, seed])
    hold = max(round(LOG_PERIOD_S / dt_s), 1)
    return np.repeat(rms * random.standard_normal(-(-steps // hold)), hold)[:steps]


def car(seed: int, base: Vehicle, other_map: Motor | None = None) -> Vehicle:
    """A car drawn around a complete one, whose tyres, driver and cell chemistry it has.

    Parameters
    ----------
    seed : of all that is random in it
    base : where everything comes from that is not drawn
    other_map : a motor with a measured map; a third of the cars has it, scaled
    """
    random = np.random.default_rng([4, seed])
    mass = 350.0 * 8.0 ** random.uniform()
    size = mass / base.params.chassis.mass_kg
    power = mass * random.uniform(28.0, 60.0)  # W, all four motors
    force = mass * random.uniform(2.8, 4.2)  # N, all four, cold
    radius = 0.26 + 0.09 * min(mass / 2000.0, 1.0)
    uneven = random.uniform() < 0.5
    part = random.uniform(0.25, 0.75) if uneven else 0.5
    mapped = other_map if random.uniform() < 1.0 / 3.0 else None
    shape = random.uniform(0.6, 1.6, 5)
    details = random.uniform(size=4)
    axles = []
    for share in (part, 1.0 - part):
        source = mapped or base.params.front.motor
        motor = _motor(source, 0.5 * share * power, 0.5 * share * force * radius, details, shape)
        if uneven:
            shape = random.uniform(0.6, 1.6, 5)
        axles.append(_axle(base.params.front, motor, radius, size))
    chassis = _chassis(base.params.chassis, mass, random)
    params = VehicleParams(
        chassis=chassis,
        front=axles[0],
        rear=axles[1],
        battery=_battery(base.params.battery, power * random.uniform(0.8, 2.0)),
        driver=base.params.driver._replace(
            proportional_n_per_mps=base.params.driver.proportional_n_per_mps * size,
            integral_n_per_m=base.params.driver.integral_n_per_m * size,
        ),
    )
    return with_params(base, f"generated_{seed}", params)


def _chassis(base: Chassis, mass_kg: float, random: np.random.Generator) -> Chassis:
    size = mass_kg / base.mass_kg
    wheelbase = 1.7 + 1.2 * min(mass_kg / 2400.0, 1.0)
    front_weight = random.uniform(0.35, 0.65)
    front, rear = wheelbase * (1.0 - front_weight), wheelbase * front_weight
    return base._replace(
        mass_kg=mass_kg,
        frontal_area_m2=base.frontal_area_m2 * size ** (1.0 / 3.0),
        drag_coefficient=random.uniform(0.24, 0.42),
        rolling_resistance=random.uniform(0.007, 0.013),
        front_axle_to_cg_m=front,
        rear_axle_to_cg_m=rear,
        cg_height_m=wheelbase * random.uniform(0.18, 0.3),
        yaw_inertia_kgm2=mass_kg * front * rear,
    )


def _motor(base: Motor, power_w: float, torque_nm: float, details: FloatArray, shape: FloatArray) -> Motor:
    """A motor of another size: losses grow with the power at the same speed, copper losses fall with the torque."""
    times = power_w / base.max_power_w
    pull = torque_nm / base.peak_torque_nm
    drag = times * shape[0]
    motor = base._replace(
        max_power_w=power_w,
        peak_torque_nm=torque_nm,
        continuous_torque_nm=torque_nm * (0.4 + 0.2 * details[0]),
        regeneration_torque_nm=torque_nm * (0.35 + 0.45 * details[1]),
        idle_standby_w=base.idle_standby_w * times**0.5,
        idle_drag_constant_nm=base.idle_drag_constant_nm * drag,
        idle_drag_linear_nm_per_radps=base.idle_drag_linear_nm_per_radps * drag,
        loss_constant_w=base.loss_constant_w * times * shape[1],
        loss_linear_speed=base.loss_linear_speed * times * shape[2],
        loss_quadratic_speed=base.loss_quadratic_speed * times * shape[2],
        loss_linear_torque=base.loss_linear_torque * times / pull * shape[3],
        loss_quadratic_torque=base.loss_quadratic_torque * times / pull**2 * shape[4],
    )
    if base.map_torque_nm.size:
        speeds = times / pull
        motor = motor._replace(
            map_speed_radps=base.map_speed_radps * speeds,
            map_torque_nm=base.map_torque_nm * pull,
            map_loss_w=base.map_loss_w * times * shape[1],
        )
    return motor


def _axle(base: Axle, motor: Motor, radius_m: float, size: float) -> Axle:
    return base._replace(
        wheel=base.wheel._replace(radius_m=radius_m, inertia_kgm2=base.wheel.inertia_kgm2 * size),
        motor=motor,
        friction_brake=base.friction_brake._replace(max_torque_nm=base.friction_brake.max_torque_nm * max(size, 0.5)),
    )


def _battery(base: Battery, limit_w: float) -> Battery:
    """A pack of this power: cells in parallel in proportion, the same number in series."""
    size = limit_w / base.discharge_limit_w
    return base._replace(
        capacity_ah=base.capacity_ah * size,
        resistance_ohm=base.resistance_ohm / size,
        ohmic_resistance_ohm=base.ohmic_resistance_ohm / size,
        polarisation_resistance_ohm=base.polarisation_resistance_ohm / size,
        discharge_limit_w=limit_w,
        charge_limit_w=limit_w,
    )
