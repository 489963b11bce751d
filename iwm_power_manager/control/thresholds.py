# SPDX-License-Identifier: Apache-2.0
"""What inputs are believed and how the degraded state goes: one table of thresholds, each with unit, range and reason.

The node has a parameter for each; a replay judges recorded inputs by `RECORDED`. Both build what the checks take from
here, so that no threshold stands twice.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from iwm_power_manager.control.actuators import ActuatorLimits
from iwm_power_manager.control.inputs import StampLimits, ValueLimits, WheelLimits
from iwm_power_manager.control.monitor import InputLimits
from iwm_power_manager.control.settings import Change, Setting
from iwm_power_manager.control.supervision import SupervisionLimits
from iwm_power_manager.interpreted import interpreted
from iwm_power_manager.model.parameters import Axle, VehicleParams
from iwm_power_manager.model.pedals import PEDAL_TRAVEL, demand_power_w
from iwm_power_manager.model.top_speed import motor_power_w, top_speed_mps

#: More than this many times what the car's own pedals ask for is no demand.
_BEYOND_PEDALS = 1.5
#: So many times its top speed no car does downhill, so many times rolling no wheel without grip, and so many times what
#: its torques make of a wheel nothing.
_BEYOND_TOP_SPEED, _BEYOND_ROLLING, _BEYOND_TORQUE = 1.2, 1.5, 2.0
_INF = math.inf


def _threshold(default: float, unit: str, low: float, high: float, meaning: str) -> Any:
    known = Setting(meaning, unit, low, high, change=Change.UNCONFIGURED)
    return dataclasses.field(default=default, metadata={"known": known})


@dataclasses.dataclass(frozen=True)
class Thresholds:
    """Each with its type, its default with the reason for it, and what is known of it."""

    stamp_oldest_s: float = _threshold(0.1, "s", 0.001, 60.0, "a message stamped longer ago than this is dropped")
    # Clocks of two computers are never quite equal.
    stamp_future_s: float = _threshold(0.02, "s", 0.0, 60.0, "a message stamped further ahead than this is dropped")
    speed_max_mps: float = _threshold(
        60.0, "m/s", 1.0, 150.0, "largest believed vehicle speed; a fifth above the car's own top speed is, too"
    )
    # No road car brakes or drives off at more than 1.5 g; a crash is none of our business.
    speed_rate_mps2: float = _threshold(25.0, "m/s2", 1.0, 1000.0, "largest believed change of vehicle speed")
    speed_noise_mps: float = _threshold(0.6, "m/s", 0.0, 5.0, "change of vehicle speed that is always believed")
    # A car that rolls back unbraked; faster it does not drive backwards.
    speed_min_mps: float = _threshold(-30.0, "m/s", -150.0, 0.0, "smallest believed vehicle speed")
    wheel_speed_max_radps: float = _threshold(
        300.0, "rad/s", 1.0, 2000.0, "largest believed wheel speed, either way; half as much again as rolling is, too"
    )
    # Full braking torque on a wheel without grip: 900 N m on 1.1 kg m2 is 820 rad/s2; twice that.
    wheel_rate_radps2: float = _threshold(
        2000.0, "rad/s2", 1.0, 1e5, "largest believed change of a wheel speed; what its own torques can do is, too"
    )
    wheel_noise_radps: float = _threshold(3.0, "rad/s", 0.0, 50.0, "change of a wheel speed that is always believed")
    wheel_opposite_radps: float = _threshold(
        3.0, "rad/s", 0.0, 50.0, "backward wheel speed that is believed while the car drives forwards"
    )
    wheel_moving_mps: float = _threshold(1.0, "m/s", 0.1, 10.0, "above this speed the car counts as driving forwards")
    # Longer than the gate needs to free a wheel that really is locked: that one turns again when its torque is gone.
    wheel_stuck_s: float = _threshold(
        1.0,
        "s",
        0.05,
        60.0,
        "a wheel speed that stays the same for longer while the car and the axle's other wheel change is stuck",
    )
    wheel_stuck_change_radps: float = _threshold(
        1.0, "rad/s", 0.1, 50.0, "change of the car and the other wheel that tells a stuck one"
    )
    wheel_stray_s: float = _threshold(
        1.0, "s", 0.05, 60.0, "a wheel speed far from both the axle's other wheel and the car for longer is lost"
    )
    wheel_stray_radps: float = _threshold(20.0, "rad/s", 1.0, 500.0, "how far is far")
    wheel_distrust_s: float = _threshold(
        0.5, "s", 0.0, 60.0, "a lost wheel has to be good for this long before it is used again"
    )
    # Longer than any burst of bad values, shorter than what a driver notices.
    rival_s: float = _threshold(
        0.3,
        "s",
        0.05,
        60.0,
        "two sources of an input: the refused one is believed after this (battery: ten times), a speed only "
        "if it is nearer to the wheels",
    )
    # A torque is reckoned from currents: to a tenth or so at best.
    motor_tolerance_nm: float = _threshold(
        8.0, "N m", 0.1, 1e3, "difference of reported and commanded motor torque that is always believed"
    )
    motor_tolerance_ratio: float = _threshold(0.15, "", 0.0, 1.0, "the same as a part of the commanded torque, on top")
    # Three periods of a slow bus, the motor's own lag, and a message each way.
    motor_lag_s: float = _threshold(
        0.06, "s", 0.0, 1.0, "a reported motor torque may belong to any command of this time"
    )
    # Where it begins: what it is off by is found as soon as torques change a lot (`found_delay`).
    actuator_delay_s: float = _threshold(
        0.002, "s", 0.0, 0.2, "time after which a command is a torque at the wheel, of motors and brakes"
    )
    motor_confirm_s: float = _threshold(
        0.1, "s", 0.01, 60.0, "a motor whose reports differ for longer is weak, dead, stuck or reversed"
    )
    motor_recover_s: float = _threshold(
        2.0, "s", 0.0, 600.0, "a weak motor has to follow for this long to count as good again"
    )
    demand_max_w: float = _threshold(
        150e3, "W", 100.0, 5e6, "largest believed driving demand; what the car's own pedal asks for is, too"
    )
    demand_min_w: float = _threshold(
        -600e3, "W", -2e7, -100.0, "largest believed braking demand, < 0; what the car's own pedal asks for is, too"
    )
    demand_rise_wps: float = _threshold(
        5e6, "W/s", 1e3, 1e9, "largest believed rise of the demand; braking may come as fast as it likes"
    )
    demand_noise_w: float = _threshold(5e3, "W", 0.0, 1e6, "rise of the demand that is always believed")
    # A full charge takes minutes.
    soc_rate_per_s: float = _threshold(0.01, "1/s", 1e-4, 1e3, "largest believed change of the state of charge")
    soc_noise: float = _threshold(0.02, "", 0.0, 1.0, "change of the state of charge that is always believed")
    temperature_min_c: float = _threshold(-60.0, "degC", -100.0, 0.0, "lowest believed temperature of the battery")
    temperature_max_c: float = _threshold(150.0, "degC", 50.0, 500.0, "highest believed temperature of the battery")
    temperature_rate_cps: float = _threshold(
        2.0, "K/s", 0.01, 1e3, "largest believed change of the battery's temperature"
    )
    temperature_noise_c: float = _threshold(
        3.0, "K", 0.0, 100.0, "change of the battery's temperature that is always believed"
    )
    friction_min: float = _threshold(0.05, "", 0.01, 0.5, "smallest believed friction coefficient")
    friction_max: float = _threshold(1.5, "", 0.5, 3.0, "largest believed friction coefficient")
    fade_s: float = _threshold(0.3, "s", 0.01, 10.0, "an input is missing: motor torque fades to zero in this time")
    brake_release_s: float = _threshold(
        2.0, "s", 0.01, 30.0, "power_demand is missing while braking: the braking force is released in this time"
    )
    recover_s: float = _threshold(0.5, "s", 0.0, 60.0, "inputs have to be good for this long before torque comes back")
    resume_s: float = _threshold(0.5, "s", 0.01, 60.0, "torque comes back from zero to full in this time")
    # A step is short of its period when the one before came late, and longer when it is late itself. Much shorter ones
    # would turn the noise of wheel speeds into road torque; longer ones would let a torque jump.
    shortest_step_periods: float = _threshold(
        0.2, "periods", 0.01, 1.0, "a step counts as at least this part of the control period"
    )
    longest_step_periods: float = _threshold(
        3.0, "periods", 1.0, 100.0, "a step counts as at most this many control periods"
    )
    # Ten periods of the control loop and the age at which inputs are missing: what was remembered is no longer true.
    own_gap_s: float = _threshold(
        0.1,
        "s",
        0.02,
        60.0,
        "the node itself was held up for longer, and for longer than longest_step_periods: it starts over as after "
        "activation",
    )
    # At 20 m/s the car has moved a metre.
    command_oldest_s: float = _threshold(
        0.05, "s", 0.001, 1.0, "age no command may have when DDS sends it, half of it for DDS: an older one is not sent"
    )


#: What is known of each threshold, by name.
TABLE: dict[str, Setting] = {field.name: field.metadata["known"] for field in dataclasses.fields(Thresholds)}

#: What recorded inputs are judged by: finite, and possible for any car. What a node would have missed by its clock and
#: its car's limits is part of the record.
RECORDED = Thresholds(
    speed_max_mps=150.0,
    speed_rate_mps2=100.0,
    speed_noise_mps=1.0,
    demand_min_w=-2e7,
    demand_max_w=5e6,
    demand_rise_wps=_INF,
    demand_noise_w=0.0,
    soc_rate_per_s=_INF,
    soc_noise=0.0,
    temperature_rate_cps=_INF,
    temperature_noise_c=0.0,
    wheel_speed_max_radps=2000.0,
    wheel_rate_radps2=1e4,
    wheel_stuck_s=_INF,
    wheel_stray_s=_INF,
    wheel_stray_radps=500.0,
    motor_confirm_s=_INF,
)


def actuator_limits(thresholds: Thresholds) -> ActuatorLimits:
    """What is believed of reported motor torques."""
    t = thresholds
    return ActuatorLimits(
        tolerance_nm=t.motor_tolerance_nm,
        tolerance_ratio=t.motor_tolerance_ratio,
        lag_s=t.motor_lag_s,
        confirm_s=t.motor_confirm_s,
        recover_s=t.motor_recover_s,
        delay_s=t.actuator_delay_s,
    )


def supervision_limits(thresholds: Thresholds) -> SupervisionLimits:
    """Times of the degraded state."""
    t = thresholds
    return SupervisionLimits(
        fade_s=t.fade_s, brake_release_s=t.brake_release_s, recover_s=t.recover_s, resume_s=t.resume_s
    )


def _jerked_radps2(axle: Axle) -> float:
    return (axle.friction_brake.max_torque_nm + axle.motor.peak_torque_nm) / axle.wheel.inertia_kgm2


def for_car(thresholds: Thresholds, vehicle: VehicleParams) -> Thresholds:
    """Thresholds that believe a car's own speeds, and what its own pedals ask for at any speed that is believed.

    A fast, heavy or strong car goes beyond the defaults: the brake pedal of 2.8 t at 0.8 g and 30 m/s asks for 660 kW.
    """
    top_mps = top_speed_mps(vehicle.chassis, motor_power_w(vehicle))
    speed_max_mps = max(thresholds.speed_max_mps, _BEYOND_TOP_SPEED * top_mps)
    accelerator, brake = (
        _BEYOND_PEDALS * float(interpreted(demand_power_w)(PEDAL_TRAVEL, *travel, speed_max_mps, vehicle))
        for travel in ((1.0, 0.0), (0.0, 1.0))
    )
    turning_radps = _BEYOND_ROLLING * speed_max_mps / min(vehicle.front.wheel.radius_m, vehicle.rear.wheel.radius_m)
    jerked_radps2 = _BEYOND_TORQUE * max(_jerked_radps2(vehicle.front), _jerked_radps2(vehicle.rear))
    return dataclasses.replace(
        thresholds,
        speed_max_mps=speed_max_mps,
        wheel_speed_max_radps=max(thresholds.wheel_speed_max_radps, turning_radps),
        wheel_rate_radps2=max(thresholds.wheel_rate_radps2, jerked_radps2),
        demand_max_w=max(thresholds.demand_max_w, accelerator),
        demand_min_w=min(thresholds.demand_min_w, brake),
    )


def input_limits(thresholds: Thresholds, radius_m: float, by_clock: bool) -> InputLimits:
    """What inputs are judged by; `by_clock` where stamps have a clock to be compared with (not in lock-step)."""
    t = thresholds
    return InputLimits(
        stamp=StampLimits(t.stamp_oldest_s, t.stamp_future_s) if by_clock else None,
        demand_delay_s=t.stamp_oldest_s if by_clock else _INF,
        speed=ValueLimits(t.speed_min_mps, t.speed_max_mps, t.speed_rate_mps2, t.speed_rate_mps2, t.speed_noise_mps),
        demand=ValueLimits(t.demand_min_w, t.demand_max_w, t.demand_rise_wps, _INF, t.demand_noise_w),
        soc=ValueLimits(0.0, 1.0, t.soc_rate_per_s, t.soc_rate_per_s, t.soc_noise),
        temperature=ValueLimits(
            t.temperature_min_c,
            t.temperature_max_c,
            t.temperature_rate_cps,
            t.temperature_rate_cps,
            t.temperature_noise_c,
        ),
        friction=ValueLimits(t.friction_min, t.friction_max, _INF, _INF, 0.0),
        wheels=WheelLimits(
            value=ValueLimits(
                -t.wheel_speed_max_radps,
                t.wheel_speed_max_radps,
                t.wheel_rate_radps2,
                t.wheel_rate_radps2,
                t.wheel_noise_radps,
            ),
            opposite_radps=t.wheel_opposite_radps,
            moving_mps=t.wheel_moving_mps,
            stuck_s=t.wheel_stuck_s,
            stuck_change_radps=t.wheel_stuck_change_radps,
            stray_s=t.wheel_stray_s,
            stray_radps=t.wheel_stray_radps,
            distrust_s=t.wheel_distrust_s,
        ),
        rival_s=t.rival_s,
        radius_m=radius_m,
    )
