"""The numbers that go into one control step and come out of it.

NamedTuples of plain floats and integers: numba takes them as they are, Python code reads them by name, and nothing in
them can be changed behind a caller's back. Every float must be a Python float (not an int), else numba compiles a
second version of the law.
"""

from __future__ import annotations

from typing import NamedTuple

Wheels = tuple[float, float, float, float]  # front_left, front_right, rear_left, rear_right

#: Strategies, by the name used on every command line and in every parameter file.
EQUAL, RULE, INSTANTANEOUS, INSTANTANEOUS_SLIP, SDP, SDP_LOOKAHEAD, PREVIEW = range(7)
STRATEGIES: dict[str, int] = {
    "equal": EQUAL,
    "rule": RULE,
    "instantaneous": INSTANTANEOUS,
    "instantaneous_slip": INSTANTANEOUS_SLIP,
    "sdp": SDP,
    "sdp_lookahead": SDP_LOOKAHEAD,
    "preview": PREVIEW,
}

#: Gate modes: no skid avoidance; Table 2 as printed (on/off, braking only unless `gate_driving`); a slip limiter in
#: front of Table 2, which holds the wheel short of the critical slip so that the on/off gate is the last resort.
GATE_MODE_OFF, GATE_MODE_TABLE2, GATE_MODE_LIMITER = range(3)
GATE_MODES: dict[str, int] = {"off": GATE_MODE_OFF, "table2": GATE_MODE_TABLE2, "limiter": GATE_MODE_LIMITER}

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
    """

    speed_mps: float
    wheel_speed_radps: Wheels
    power_demand_w: float
    dt_s: float
    friction: float
    discharge_limit_w: float
    charge_limit_w: float
    soc: float


class Command(NamedTuple):
    """What the law commands, and why.

    Attributes
    ----------
    motor_torque_nm : torque of each motor at its wheel
    friction_torque_nm : torque of each friction brake, <= 0
    front_share : P_front / P_demand as applied in this step (after its rate limit), 0..1
    decided_share : the front share the strategy decided on, 0..1
    gate : GATE_NONE, GATE_FRONT, GATE_REAR or GATE_BOTH
    limits : LIMIT_* bits
    front_power_w, rear_power_w : sum of (motor + friction torque) * conversion speed of the axle
    front_slip, rear_slip : filtered slip the gate acted on
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
