# SPDX-License-Identifier: Apache-2.0
"""What inputs are believed and how the degraded state goes: one table of thresholds, each with unit, range and reason.

The node has a parameter for each; a replay judges recorded inputs by `RECORDED`. Both build what the checks take from
here, so that no threshold stands twice.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

from iwm_power_manager.control.actuators import ActuatorLimits
from iwm_power_manager.control.inputs import StampLimits, ValueLimits, WheelLimits
from iwm_power_manager.control.monitor import InputLimits
from iwm_power_manager.control.settings import Change, Setting, table_of
from iwm_power_manager.control.supervision import SupervisionLimits

_INF = math.inf


def _threshold(meaning: str, unit: str, low: float, high: float) -> Setting:
    return Setting(meaning, unit, low, high, change=Change.UNCONFIGURED)


class Thresholds(NamedTuple):
    """Each with its type, what is known of it, and its default with the reason for it."""

    stamp_oldest_s: Annotated[
        float, _threshold("a message stamped longer ago than this is dropped", "s", 0.001, 60.0)
    ] = 0.1
    # Clocks of two computers are never quite equal.
    stamp_future_s: Annotated[
        float, _threshold("a message stamped further ahead than this is dropped", "s", 0.0, 60.0)
    ] = 0.02
    speed_max_mps: Annotated[float, _threshold("largest believed vehicle speed, either way", "m/s", 1.0, 150.0)] = 60.0
    # No road car brakes or drives off at more than 1.5 g; a crash is none of our business.
    speed_rate_mps2: Annotated[float, _threshold("largest believed change of vehicle speed", "m/s2", 1.0, 1000.0)] = (
        25.0
    )
    speed_noise_mps: Annotated[
        float, _threshold("change of vehicle speed that is always believed", "m/s", 0.0, 5.0)
    ] = 0.6
    # A car that rolls back unbraked; faster it does not drive backwards.
    speed_min_mps: Annotated[float, _threshold("smallest believed vehicle speed", "m/s", -150.0, 0.0)] = -30.0
    wheel_speed_max_radps: Annotated[
        float, _threshold("largest believed wheel speed, either way", "rad/s", 1.0, 2000.0)
    ] = 300.0
    # Full braking torque on a wheel without grip: 900 N m on 1.1 kg m2 is 820 rad/s2; twice that.
    wheel_rate_radps2: Annotated[float, _threshold("largest believed change of a wheel speed", "rad/s2", 1.0, 1e5)] = (
        2000.0
    )
    wheel_noise_radps: Annotated[
        float, _threshold("change of a wheel speed that is always believed", "rad/s", 0.0, 50.0)
    ] = 3.0
    wheel_opposite_radps: Annotated[
        float,
        _threshold("backward wheel speed that is believed while the car drives forwards", "rad/s", 0.0, 50.0),
    ] = 3.0
    wheel_moving_mps: Annotated[
        float, _threshold("above this speed the car counts as driving forwards", "m/s", 0.1, 10.0)
    ] = 1.0
    # Longer than the gate needs to free a wheel that really is locked: that one turns again when its torque is gone.
    wheel_stuck_s: Annotated[
        float,
        _threshold(
            "a wheel speed that stays the same for longer while the car and the axle's other wheel change is stuck",
            "s",
            0.05,
            60.0,
        ),
    ] = 1.0
    wheel_stuck_change_radps: Annotated[
        float,
        _threshold("change of the car and the other wheel that tells a stuck one", "rad/s", 0.1, 50.0),
    ] = 1.0
    wheel_stray_s: Annotated[
        float,
        _threshold(
            "a wheel speed far from both the axle's other wheel and the car for longer is lost",
            "s",
            0.05,
            60.0,
        ),
    ] = 1.0
    wheel_stray_radps: Annotated[float, _threshold("how far is far", "rad/s", 1.0, 500.0)] = 20.0
    wheel_distrust_s: Annotated[
        float,
        _threshold("a lost wheel has to be good for this long before it is used again", "s", 0.0, 60.0),
    ] = 0.5
    # Longer than any burst of bad values, shorter than what a driver notices.
    rival_s: Annotated[
        float,
        _threshold(
            "two sources of an input: the refused one is believed after this (battery: ten times), a speed only "
            "if it is nearer to the wheels",
            "s",
            0.05,
            60.0,
        ),
    ] = 0.3
    # A torque is reckoned from currents: to a tenth or so at best.
    motor_tolerance_nm: Annotated[
        float, _threshold("difference of reported and commanded motor torque that is always believed", "N m", 0.1, 1e3)
    ] = 8.0
    motor_tolerance_ratio: Annotated[
        float, _threshold("the same as a part of the commanded torque, on top", "", 0.0, 1.0)
    ] = 0.15
    # Three periods of a slow bus, the motor's own lag, and a message each way.
    motor_lag_s: Annotated[
        float, _threshold("a reported motor torque may belong to any command of this time", "s", 0.0, 1.0)
    ] = 0.06
    motor_confirm_s: Annotated[
        float, _threshold("a motor whose reports differ for longer is weak, dead, stuck or reversed", "s", 0.01, 60.0)
    ] = 0.1
    motor_recover_s: Annotated[
        float,
        _threshold("a weak motor has to follow for this long to count as good again", "s", 0.0, 600.0),
    ] = 2.0
    demand_max_w: Annotated[float, _threshold("largest believed driving demand", "W", 100.0, 5e6)] = 150e3
    demand_min_w: Annotated[float, _threshold("largest believed braking demand, negative", "W", -2e7, -100.0)] = -600e3
    demand_rise_wps: Annotated[
        float,
        _threshold(
            "largest believed rise of the demand; braking may come as fast as it likes",
            "W/s",
            1e3,
            1e9,
        ),
    ] = 5e6
    demand_noise_w: Annotated[float, _threshold("rise of the demand that is always believed", "W", 0.0, 1e6)] = 5e3
    # A full charge takes minutes.
    soc_rate_per_s: Annotated[float, _threshold("largest believed change of the state of charge", "1/s", 1e-4, 1e3)] = (
        0.01
    )
    soc_noise: Annotated[float, _threshold("change of the state of charge that is always believed", "", 0.0, 1.0)] = (
        0.02
    )
    temperature_min_c: Annotated[
        float, _threshold("lowest believed temperature of the battery", "degC", -100.0, 0.0)
    ] = -60.0
    temperature_max_c: Annotated[
        float, _threshold("highest believed temperature of the battery", "degC", 50.0, 500.0)
    ] = 150.0
    temperature_rate_cps: Annotated[
        float, _threshold("largest believed change of the battery's temperature", "K/s", 0.01, 1e3)
    ] = 2.0
    temperature_noise_c: Annotated[
        float, _threshold("change of the battery's temperature that is always believed", "K", 0.0, 100.0)
    ] = 3.0
    friction_min: Annotated[float, _threshold("smallest believed friction coefficient", "", 0.01, 0.5)] = 0.05
    friction_max: Annotated[float, _threshold("largest believed friction coefficient", "", 0.5, 3.0)] = 1.5
    fade_s: Annotated[
        float, _threshold("an input is missing: motor torque fades to zero in this time", "s", 0.01, 10.0)
    ] = 0.3
    brake_release_s: Annotated[
        float,
        _threshold(
            "power_demand is missing while braking: the braking force is released in this time",
            "s",
            0.01,
            30.0,
        ),
    ] = 2.0
    recover_s: Annotated[
        float, _threshold("inputs have to be good for this long before torque comes back", "s", 0.0, 60.0)
    ] = 0.5
    resume_s: Annotated[float, _threshold("torque comes back from zero to full in this time", "s", 0.01, 60.0)] = 0.5
    # A step is short of its period when the one before came late, and longer when it is late itself. Much shorter ones
    # would turn the noise of wheel speeds into road torque; longer ones would let a torque jump.
    shortest_step_periods: Annotated[
        float,
        _threshold("a step counts as at least this part of the control period", "periods", 0.01, 1.0),
    ] = 0.2
    longest_step_periods: Annotated[
        float, _threshold("a step counts as at most this many control periods", "periods", 1.0, 100.0)
    ] = 3.0
    # Ten periods of the control loop and the age at which inputs are missing: what was remembered is no longer true.
    own_gap_s: Annotated[
        float,
        _threshold(
            "the node itself was held up for longer: it starts over as after activation",
            "s",
            0.02,
            60.0,
        ),
    ] = 0.1
    # At 20 m/s the car has moved a metre.
    command_oldest_s: Annotated[
        float,
        _threshold("a command that took longer from its inputs to its sending is not sent", "s", 0.001, 1.0),
    ] = 0.05


#: What is known of each threshold, by name.
TABLE = table_of(Thresholds)

#: What recorded inputs are judged by: finite, and possible for any car. What a node would have missed by its clock and
#: its car's limits is part of the record.
RECORDED = Thresholds()._replace(
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
    )


def supervision_limits(thresholds: Thresholds) -> SupervisionLimits:
    """Times of the degraded state."""
    t = thresholds
    return SupervisionLimits(
        fade_s=t.fade_s, brake_release_s=t.brake_release_s, recover_s=t.recover_s, resume_s=t.resume_s
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
