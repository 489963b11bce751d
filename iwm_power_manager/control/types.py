"""The numbers that go into one control step and come out of it.

NamedTuples of plain floats and integers: numba takes them as they are, Python code reads them by name, and nothing in
them can be changed behind a caller's back. Every float must be a Python float (not an int), else numba compiles a
second version of the law.
"""

from __future__ import annotations

from typing import NamedTuple

from iwm_power_manager.control.persistence import Jitter, no_jitter

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
    speed_mps : vehicle speed over ground, >= 0
    wheel_speed_radps : four wheel speeds, rad/s
    power_demand_w : power the driver asks for at the wheels, braking negative
    dt_s : time since the previous step, > 0
    friction : peak friction coefficient of the road the strategy is to assume
    discharge_limit_w : electrical power the battery may give, >= 0
    charge_limit_w : electrical power the battery may take, >= 0
    soc : state of charge, 0..1
    motor_gain : part of a commanded torque that each motor delivers, 0..1; 0 switches it off
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


class Command(NamedTuple):
    """What the law commands, and why.

    Attributes
    ----------
    motor_torque_nm : torque of each motor at its wheel
    friction_torque_nm : torque of each friction brake, <= 0
    front_share : P_front / P_demand as applied in this step (after its rate limit), 0..1
    decided_share : the front share the strategy decided on, 0..1
    gate : GATE_NONE, GATE_FRONT, GATE_REAR or GATE_BOTH: axles whose wheels are both gated
    limits : LIMIT_* bits
    front_power_w, rear_power_w : sum over the axle's wheels of (motor + friction torque) * conversion speed
    front_slip, rear_slip : filtered slip of the axle's worse wheel
    gated_wheels : bits 1, 2, 4, 8 of the wheels held at zero torque, in the order of the wheels
    """

    motor_torque_nm: Wheels
    friction_torque_nm: Wheels
    front_share: float
    decided_share: float
    gate: int
    limits: int
    front_power_w: float
    rear_power_w: float
    front_slip: float
    rear_slip: float
    gated_wheels: int


class WheelState(NamedTuple):
    """What the law remembers of one wheel.

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
    changes_used: float
    jitter: Jitter


class ControllerState(NamedTuple):
    """What the law remembers from one step to the next; `initial_state` makes the first one.

    Attributes
    ----------
    steps : steps taken
    split : of the power split
    wheels : of each wheel
    front_unequal_s, rear_unequal_s : how long the wheels of the axle have been kept at unequal torques; it lets their
        yaw budget grow
    """

    steps: int
    split: SplitMemory
    wheels: tuple[WheelState, WheelState, WheelState, WheelState]
    front_unequal_s: float
    rear_unequal_s: float


def initial_state() -> ControllerState:
    """The law's memory before its first step: at rest, cold, power split equally."""
    wheel = WheelState(motor_nm=0.0, total_nm=0.0, speed_radps=0.0, road_nm=0.0, slip=0.0, gated=False, heat=0.0)
    split = SplitMemory(
        decisions=0, age_s=0.0, decided_share=0.5, applied_share=0.5, changes_used=0.0, jitter=no_jitter()
    )
    return ControllerState(
        steps=0, split=split, wheels=(wheel, wheel, wheel, wheel), front_unequal_s=0.0, rear_unequal_s=0.0
    )
