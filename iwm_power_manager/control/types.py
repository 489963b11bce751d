# SPDX-License-Identifier: Apache-2.0
"""The numbers that go into one control step and come out of it.

NamedTuples of plain floats and integers: numba takes them as they are, Python code reads them by name, and nothing in
them can be changed behind a caller's back. Every float must be a Python float (not an int), else numba compiles a
second version of the law.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from iwm_power_manager.control.budget import Used
from iwm_power_manager.control.persistence import Jitter, no_jitter
from iwm_power_manager.control.yaw import YawState, no_yaw
from iwm_power_manager.interpreted import interpreted

Wheels = tuple[float, float, float, float]  # in the order of `WHEEL_NAMES`

#: The wheels, in the order used everywhere.
WHEEL_NAMES = ("front_left", "front_right", "rear_left", "rear_right")

#: Gate of a command: which axles are held at zero torque.
GATE_NONE, GATE_FRONT, GATE_REAR, GATE_BOTH = range(4)
GATE_NAMES = ("none", "front", "rear", "both")

#: Bits of `Command.limits`: what kept the command from being what the split asked for.
LIMIT_MOTOR = 1  # motor torque or power
LIMIT_REGENERATION = 2  # regeneration torque, its low-speed fade, or a full battery: friction took over
LIMIT_BATTERY_DISCHARGE = 4
LIMIT_BATTERY_CHARGE = 8
LIMIT_THERMAL = 16
LIMIT_SLEW = 32
LIMIT_SLIP = 64  # the slip limiter held an axle back
LIMIT_FRICTION_BRAKE = 128
LIMIT_NAMES = {
    LIMIT_MOTOR: "motor",
    LIMIT_REGENERATION: "regeneration",
    LIMIT_BATTERY_DISCHARGE: "battery_discharge",
    LIMIT_BATTERY_CHARGE: "battery_charge",
    LIMIT_THERMAL: "thermal",
    LIMIT_SLEW: "slew",
    LIMIT_SLIP: "slip",
    LIMIT_FRICTION_BRAKE: "friction_brake",
}


class Measurement(NamedTuple):
    """What the law is told in one step.

    Attributes
    ----------
    speed_mps : vehicle speed over ground as its sensor shows it, negative backwards (NaN: not known)
    wheel_speed_radps : four wheel speeds, rad/s, negative backwards
    power_demand_w : power the driver asks for at the wheels, braking negative
    dt_s : time since the previous step, > 0
    friction : peak friction coefficient of the road the strategy is to assume
    discharge_limit_w : electrical power the battery may give, >= 0
    charge_limit_w : electrical power the battery may take, >= 0
    soc : state of charge, 0..1
    motor_gain : part of a commanded torque that each motor delivers, 0..1; 0 switches it off
    direction : the driver asks for, 1 forwards, -1 reverse
    motor_stuck_nm : torque that a motor has whatever it is commanded; friction makes up for it while braking
    acceleration_mps2 : forward, of an accelerometer on the body, the slope's part included (NaN: there is none)
    yaw_rate_radps : of a gyroscope on the body, positive to the left (NaN: there is none)
    lateral_mps2 : of an accelerometer on the body, positive to the left (NaN: there is none)
    torque_shift_nm : added to the torques of the last command, the torques that the wheels had while their speeds
        changed, forwards positive; 0 in lock-step
    """

    speed_mps: float
    wheel_speed_radps: Wheels
    power_demand_w: float
    dt_s: float
    friction: float
    discharge_limit_w: float
    charge_limit_w: float
    soc: float
    motor_gain: Wheels = (1.0, 1.0, 1.0, 1.0)
    direction: float = 1.0
    motor_stuck_nm: Wheels = (0.0, 0.0, 0.0, 0.0)
    acceleration_mps2: float = math.nan
    yaw_rate_radps: float = math.nan
    lateral_mps2: float = math.nan
    torque_shift_nm: Wheels = (0.0, 0.0, 0.0, 0.0)


class Command(NamedTuple):
    """What the law commands, and why.

    Attributes
    ----------
    motor_torque_nm : torque of each motor at its wheel
    friction_torque_nm : torque of each friction brake, <= 0
    brake_gain : part of it that each brake gives, as far as speeds and forces tell, 0..1
    front_share : P_front / P_demand as applied in this step (after its rate limit), 0..1
    decided_share : the front share the strategy decided on, 0..1
    gate : GATE_NONE, GATE_FRONT, GATE_REAR or GATE_BOTH: axles whose wheels are both gated
    limits : LIMIT_* bits
    front_power_w, rear_power_w : sum over the axle's wheels of (motor + friction torque) * conversion speed
    front_slip, rear_slip : filtered slip of the axle's worse wheel
    gated_wheels : bits 1, 2, 4, 8 of the wheels held at zero torque, in the order of the wheels
    speed_mps : speed of the car as estimated, negative backwards
    doubted : bits of the sensors that are not believed: 1, 2, 4, 8 the wheels, 16 the vehicle speed
    hold_nm : friction torque of each wheel that keeps the car from rolling against the direction asked for, >= 0
    left_friction, right_friction : peak friction of the road as estimated under the wheels of either side
    left_confidence, right_confidence : how well it is known, 0 (the prior) to 1
    """

    motor_torque_nm: Wheels
    friction_torque_nm: Wheels
    brake_gain: Wheels
    front_share: float
    decided_share: float
    gate: int
    limits: int
    front_power_w: float
    rear_power_w: float
    front_slip: float
    rear_slip: float
    gated_wheels: int
    speed_mps: float
    doubted: int
    hold_nm: float
    left_friction: float
    right_friction: float
    left_confidence: float
    right_confidence: float


class WheelState(NamedTuple):
    """What the law remembers of one wheel; torques and speeds in the direction of travel.

    Attributes
    ----------
    motor_nm : motor torque of the last command
    total_nm : what of it arrived, with the friction brake
    speed_radps : wheel speed in the last step
    road_nm : filtered estimate of the torque the road takes from the wheel
    slip : filtered slip
    gated : held at zero torque
    heat : heat index of the motor, 0 cold to 1 hot
    """

    motor_nm: float
    total_nm: float
    speed_radps: float
    road_nm: float
    slip: float
    gated: bool
    heat: float


#: The four wheels, in the order of `WHEEL_NAMES`.
FourWheels = tuple[WheelState, WheelState, WheelState, WheelState]


class SplitMemory(NamedTuple):
    """What is remembered of the power split.

    Attributes
    ----------
    decisions : decisions taken
    age_s : time since the last one
    decided_share, applied_share : front share, 0..1
    changes_used : what is used of the budget of changes (`control.budget`)
    jitter : what is remembered of the demand (`control.persistence`)
    """

    decisions: int
    age_s: float
    decided_share: float
    applied_share: float
    changes_used: Used
    jitter: Jitter


class Agreed(NamedTuple):
    """Speeds that agree with each other and not with the reference.

    Attributes
    ----------
    lasted_s : for how long; 0 if they do not
    from_mps : the speed they agreed on at first
    moved_mps, felt_mps : what forces and accelerometer said of its change since (NaN: there is no accelerometer)
    """

    lasted_s: float
    from_mps: float
    moved_mps: float
    felt_mps: float


class Compared(NamedTuple):
    """The speed sensor beside wheels that roll freely for the first time.

    Attributes
    ----------
    ratio : its speed over theirs, on average; 1 for good where they are the same, or too far apart to be one factor
    lasted_s : for how long they have been compared
    """

    ratio: float
    lasted_s: float


class MotionState(NamedTuple):
    """What `control.motion` remembers from step to step.

    Attributes
    ----------
    speed_mps : the reference, negative backwards
    bias_mps2 : acceleration the forces do not explain: slope, load
    shown_mps, shown_s, moved_mps : the sensor's last number, for how long it has shown it, what the reference did since
    apart_s : how long the speed sensor has contradicted wheels that roll freely
    doubt_s : time the speed sensor has yet to be good; 0 is believed
    wheel_stray_s : how long each wheel has stayed away although nothing holds it
    wheel_doubt_s : time each wheel has yet to be good
    least_nm, most_nm : torques that may act on each wheel, however motors and brakes lag, forwards positive
    agreed : speeds that outvote the forces
    brake_gain : part of a friction torque that each brake gives, as found
    wheels_factor : what all four wheel speeds are multiplied by, since they are wrong by its inverse
    calm_s : for how long the wheels have done what torques and road say
    compared : whether sensor and wheels have differed by a factor from the start on
    """

    speed_mps: float
    bias_mps2: float
    shown_mps: float
    shown_s: float
    moved_mps: float
    apart_s: float
    doubt_s: float
    wheel_stray_s: Wheels
    wheel_doubt_s: Wheels
    least_nm: Wheels
    most_nm: Wheels
    agreed: Agreed
    brake_gain: Wheels
    wheels_factor: float
    calm_s: float
    compared: Compared


class WheelGrip(NamedTuple):
    """What `control.friction` remembers of one wheel; torques and forces as parts of the wheel's load.

    Attributes
    ----------
    slip, used : its slip and the road's force, averaged over a few steps
    weight : of the points of its regression
    torque, road, curve : their means: applied torque, force of the road, tyre curve at the slip
    torque_torque, torque_road, torque_curve, curve_curve : sums of products of what they differ from their means
    """

    slip: float
    used: float
    weight: float
    torque: float
    road: float
    curve: float
    torque_torque: float
    torque_road: float
    torque_curve: float
    curve_curve: float


class SideGrip(NamedTuple):
    """Peak friction of the road under the wheels of one side, and how well it is known, 0 (the prior) to 1."""

    friction: float
    confidence: float


class FrictionState(NamedTuple):
    """What `control.friction` remembers from step to step.

    Attributes
    ----------
    left, right : the estimate
    wheels : what each wheel has told
    assumed : friction the strategy is to assume: of the lower side, in steps
    """

    left: SideGrip
    right: SideGrip
    wheels: tuple[WheelGrip, WheelGrip, WheelGrip, WheelGrip]
    assumed: float


class ControllerState(NamedTuple):
    """What the law remembers from one step to the next; `initial_state` makes the first one.

    Attributes
    ----------
    steps : steps taken
    split : of the power split
    wheels : of each wheel
    front_unequal_s, rear_unequal_s : how long the wheels of the axle have been kept at unequal torques; it lets their
        yaw budget grow
    yaw : of the yaw rate
    motion : of the estimate of speed and direction
    travel : direction of travel the torques and speeds of `wheels` are reckoned in: 1 forwards, -1 backwards
    hold_nm : friction torque of each wheel that holds the car on a slope
    friction : of the estimate of the road's friction
    """

    steps: int
    split: SplitMemory
    wheels: FourWheels
    front_unequal_s: float
    rear_unequal_s: float
    yaw: YawState
    motion: MotionState
    travel: float
    hold_nm: float
    friction: FrictionState


def initial_state() -> ControllerState:
    """The law's memory before its first step: at rest, cold, power split equally, all sensors believed."""
    wheel = WheelState(motor_nm=0.0, total_nm=0.0, speed_radps=0.0, road_nm=0.0, slip=0.0, gated=False, heat=0.0)
    none = (0.0, 0.0, 0.0, 0.0)
    grip = WheelGrip(
        slip=0.0,
        used=0.0,
        weight=0.0,
        torque=0.0,
        road=0.0,
        curve=0.0,
        torque_torque=0.0,
        torque_road=0.0,
        torque_curve=0.0,
        curve_curve=0.0,
    )
    side = SideGrip(friction=0.9, confidence=0.0)
    split = SplitMemory(
        decisions=0, age_s=0.0, decided_share=0.5, applied_share=0.5, changes_used=Used(0.0, 0.0), jitter=no_jitter()
    )
    return ControllerState(
        steps=0,
        split=split,
        wheels=(wheel, wheel, wheel, wheel),
        front_unequal_s=0.0,
        rear_unequal_s=0.0,
        yaw=interpreted(no_yaw)(),
        motion=MotionState(
            speed_mps=0.0,
            bias_mps2=0.0,
            shown_mps=0.0,
            shown_s=0.0,
            moved_mps=0.0,
            apart_s=0.0,
            doubt_s=0.0,
            wheel_stray_s=none,
            wheel_doubt_s=none,
            least_nm=none,
            most_nm=none,
            agreed=Agreed(lasted_s=0.0, from_mps=0.0, moved_mps=0.0, felt_mps=0.0),
            brake_gain=(1.0, 1.0, 1.0, 1.0),
            wheels_factor=1.0,
            calm_s=0.0,
            compared=Compared(ratio=1.0, lasted_s=0.0),
        ),
        travel=1.0,
        hold_nm=0.0,
        friction=FrictionState(left=side, right=side, wheels=(grip, grip, grip, grip), assumed=side.friction),
    )
