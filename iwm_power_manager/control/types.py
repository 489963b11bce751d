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


class Settings(NamedTuple):
    """Tuning of the law. `default_settings` has the values and their reasons.

    Attributes
    ----------
    strategy : EQUAL ... PREVIEW
    decision_period_s : the split is decided this often
    share_rate_per_s : fastest change of the applied front share
    gate_mode : GATE_MODE_*
    critical_slip : Table 2's slip, > 0
    gate_hysteresis : a gated axle is freed when its slip is this far inside again
    gate_driving : also gate driving slip
    slip_target : slip the limiter holds, > 0, below `critical_slip`
    slip_limiter_s : time constant with which the limiter steers a wheel to its target
    slip_filter_s : low-pass filter of the slip and of the road torque estimate; 0 is none
    slip_speed_floor_mps : denominator of slip is at least this: measured slip says nothing at rest
    slew_up_nmps : fastest growth of a driving torque, N m/s
    slew_down_nmps : fastest way of a torque to zero, N m/s (gates and limits may be faster)
    slew_regeneration_nmps : fastest growth of a regenerative torque, N m/s (friction fills in meanwhile)
    switching_power_w : `instantaneous*`: a change of the share has to save this much power
    reversal_price : `sdp_lookahead`: how much dearer it is to take a change back that was made just now, as a multiple
        of the policy's own price for each unit of share taken back; 0 is no dearer
    reversal_s : time constant with which this is forgotten, > 0
    """

    strategy: int
    decision_period_s: float
    share_rate_per_s: float
    gate_mode: int
    critical_slip: float
    gate_hysteresis: float
    gate_driving: bool
    slip_target: float
    slip_limiter_s: float
    slip_filter_s: float
    slip_speed_floor_mps: float
    slew_up_nmps: float
    slew_down_nmps: float
    slew_regeneration_nmps: float
    switching_power_w: float
    reversal_price: float
    reversal_s: float


def default_settings(strategy: str = "equal") -> Settings:
    """Settings every tool and node starts from."""
    return Settings(
        strategy=STRATEGIES[strategy],
        decision_period_s=0.02,  # a change of demand met 0.1 s late costs more than a tenth of the possible saving
        share_rate_per_s=20.0,  # all the power changes axle in 0.05 s; the sum of the torques stays, so nothing is felt
        gate_mode=GATE_MODE_LIMITER,
        critical_slip=0.2,  # paper
        gate_hysteresis=0.05,
        gate_driving=True,
        slip_target=0.16,  # 99.8 % of the peak friction of the paper's tyre, and a margin to the critical slip
        slip_limiter_s=0.025,  # stops within 5 % of the shortest way at every friction; faster shakes the car more
        slip_filter_s=0.0,
        slip_speed_floor_mps=1.0,
        slew_up_nmps=1600.0,  # from rest to the peak torque in 0.125 s
        slew_down_nmps=20000.0,  # from the peak torque to zero in one step of 10 ms
        slew_regeneration_nmps=4000.0,  # to full regeneration in 0.02 s
        switching_power_w=100.0,
        # The demand's Markov chain does not know how long a demand has lasted, so that the policy takes a passing one
        # for one that stays. Half of the power, sent back at once, is nine times as dear.
        reversal_price=16.0,
        reversal_s=0.5,
    )


class ControllerState(NamedTuple):
    """What the law remembers from one step to the next; `initial_state` makes the first one.

    Attributes
    ----------
    steps : steps taken
    decisions : decisions taken
    decision_age_s : time since the last one
    decided_share, applied_share : front share, 0..1
    recent_change : sum of the changes of the decided share, each fading out with `reversal_s`
    front_motor_nm, rear_motor_nm : motor torque of each wheel of the axle in the last command
    front_total_nm, rear_total_nm : the same with the friction brake
    front_speed_radps, rear_speed_radps : mean wheel speed of the axle in the last step
    front_road_nm, rear_road_nm : filtered estimate of the torque the road takes from a wheel
    front_slip, rear_slip : filtered slip
    front_gated, rear_gated : Table 2
    front_heat, rear_heat : heat index of the motors, 0 cold to 1 hot
    """

    steps: int
    decisions: int
    decision_age_s: float
    decided_share: float
    applied_share: float
    recent_change: float
    front_motor_nm: float
    rear_motor_nm: float
    front_total_nm: float
    rear_total_nm: float
    front_speed_radps: float
    rear_speed_radps: float
    front_road_nm: float
    rear_road_nm: float
    front_slip: float
    rear_slip: float
    front_gated: bool
    rear_gated: bool
    front_heat: float
    rear_heat: float


def initial_state() -> ControllerState:
    """The law's memory before its first step: at rest, cold, power split equally."""
    return ControllerState(
        0, 0, 0.0, 0.5, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, False, False, 0.0, 0.0
    )
