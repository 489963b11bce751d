# SPDX-License-Identifier: Apache-2.0
"""The control law: what no input may make it do, what it owes to every demand, and every step against plain Python."""

from __future__ import annotations

import math
import operator
from typing import Any, NamedTuple

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from iwm_power_manager.control import allocation, law
from iwm_power_manager.control import types as t
from iwm_power_manager.control.axle import UNEQUAL_S
from iwm_power_manager.control.budget import Used, buckets, burst
from iwm_power_manager.control.guard import violated_bound
from iwm_power_manager.control.persistence import no_jitter
from iwm_power_manager.control.settings import (
    GATE_MODE_LIMITER,
    GATE_MODE_OFF,
    GATE_MODE_TABLE2,
    Settings,
    default_settings,
)
from iwm_power_manager.control.strategies import STRATEGIES
from iwm_power_manager.control.table import empty_table
from iwm_power_manager.control.types import (
    Command,
    ControllerState,
    FrictionState,
    Measurement,
    SideGrip,
    SplitMemory,
    WheelState,
    initial_state,
)
from iwm_power_manager.control.yaw import MOST_NM, YawState, no_yaw
from iwm_power_manager.policy import load_policy
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle
from oracles import control_law as oracle
from oracles.physics import regeneration_limit, torque_limit
from oracles.splits import rule
from oracles.step import G, electrical_w, friction_coefficient

#: At least 500 in every run, 20,000 in the nightly profile; a mutation run keeps to its own number.
EXAMPLES = max(500, settings().max_examples) if Phase.shrink in settings().phases else settings().max_examples

CARS = {
    name: load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml"), name).params
    for name in ("none", "drag", "enabled")
}
CAR = CARS["drag"]
#: Weaker and smaller behind.
CARS["unequal"] = CAR._replace(
    rear=CAR.rear._replace(
        motor=CAR.rear.motor._replace(max_power_w=4000.0, peak_torque_nm=120.0, loss_linear_torque=3.0),
        wheel=CAR.rear.wheel._replace(radius_m=0.3, inertia_kgm2=0.8),
        friction_brake=CAR.rear.friction_brake._replace(max_torque_nm=400.0),
        track_width_m=1.2,
    )
)
#: The brakes are another system's.
CARS["without brakes"] = CAR.with_axles(friction_brake=CAR.front.friction_brake._replace(max_torque_nm=0.0))
#: Its loads stay as they are.
LOW = CAR._replace(chassis=CAR.chassis._replace(cg_height_m=0.0))
RADIUS = CAR.front.wheel.radius_m
TABLE = empty_table(rule=(300.0, 0.4, -200.0, 0.7), schedule=(0.5, 0.0, 1.0, 0.3, 0.85, 1.0))
DEFAULT = default_settings("equal")
NO_LIMIT = 47500.0
EQUAL, RULE, PREVIEW, SDP_LOOKAHEAD = (STRATEGIES[n].code for n in ("equal", "rule", "preview", "sdp_lookahead"))

#: A power below this is the rounding of torques to zero (1e-6 N m at 200 rad/s, four wheels), W.
POWER_SLACK_W = 1e-3
TORQUE_SLACK_NM = 1e-9


class Case(NamedTuple):
    """One step with everything that went into it and came out."""

    m: Measurement
    before: ControllerState
    settings: Settings
    car: Any
    command: Command
    after: ControllerState

    @property
    def braking(self):
        return self.m.power_demand_w < 0.0

    def axle(self, i):
        return self.car.front if i < 2 else self.car.rear

    def wheels(self):
        """Each wheel: speed, motor and friction torque, torque and heat before, whether it is gated."""
        c, b, w = self.command, self.before, self.m.wheel_speed_radps
        return [
            (w[i], c.motor_torque_nm[i], c.friction_torque_nm[i], b.wheels[i].motor_nm, b.wheels[i].heat,
             bool(c.gated_wheels >> i & 1))
            for i in range(4)
        ]  # fmt: skip

    def conversion(self, i):
        radius, wheel = self.axle(i).wheel.radius_m, self.m.wheel_speed_radps[i]
        if self.braking:
            wheel = min(wheel, 1.12 * self.m.speed_mps / radius)
        held = self.m.speed_mps * (1.0 - self.settings.critical_slip) / radius
        return max(wheel, held, self.car.driver.power_speed_floor_mps / radius)

    @property
    def slip_targets(self):
        slips, believed = [wheel.slip for wheel in self.after.wheels], self.after.yaw.believed
        speed, demand, gains = self.m.speed_mps, self.m.power_demand_w, self.m.motor_gain
        return oracle.slip_targets(self.before, slips, speed, demand, gains, believed, self.settings, self.car)

    def fast(self, i):
        return max(self.m.wheel_speed_radps[i], self.conversion(i))

    def delivered_w(self):
        """Power of motors and brakes at the speeds that turn power into torque."""
        return sum(self.conversion(i) * (motor + brake) for i, (_, motor, brake, *_) in enumerate(self.wheels()))

    def grip_nm(self, i):
        """What the slip limiter leaves a wheel."""
        if self.settings.gate_mode != GATE_MODE_LIMITER:
            return math.inf
        wheel = self.m.wheel_speed_radps[i]
        road = self.after.wheels[i].road_nm
        target = self.slip_targets[i]
        return oracle.grip(self.braking, road, wheel, self.m.speed_mps, target, self.settings, self.axle(i))

    def battery_w(self, factor=1.0):
        return sum(
            electrical_w(factor * motor, wheel, self.axle(i).motor)
            for i, (wheel, motor, *_) in enumerate(self.wheels())
        )


def drive(m, before, s, car, table):
    """The law in the direction of travel, all sensors believed."""
    return allocation.drive(m, before, False, 1.0, s, car, table)


def take(m, before=None, s=DEFAULT, car=CAR):
    before = initial_state() if before is None else before
    return Case(m, before, s, car, *drive(m, before, s, car, TABLE))


def measurement(speed=15.0, slips=(0.0, 0.0), demand=5000.0, dt=0.01, discharge=NO_LIMIT, charge=NO_LIMIT, **changes):
    wheels = tuple(speed / RADIUS * (1.0 + x if x < 0.0 else 1.0 / (1.0 - x)) for x in slips for _ in range(2))
    return Measurement(speed, wheels, demand, dt, 0.9, discharge, charge, 0.8)._replace(**changes)


def settle(m, s=DEFAULT, car=CAR, steps=200):
    """The same measurement, held until the law has settled."""
    case = take(m, None, s, car)
    for _ in range(steps):
        case = take(m, case.after, s, car)
    return case


# --- Anything that can be measured, remembered or set ----------------------------------------------------------------


def number(low, high, *special):
    return st.one_of(st.sampled_from([float(x) for x in special]), st.floats(float(low), float(high)))


SPEEDS = number(0, 60, 0, 0.5, 1, 2, 3)
SLIPS = number(-1, 0.9, 0, 0.01, -0.01, 0.2, -0.2, -0.201, -0.15, 0.21)
SPREADS = number(-5, 5, 0, 0)
WHEELS = number(-60, 220, 0)
#: At walking pace slip is a matter of its speed, m/s: about what the limiter holds, and where the gate begins.
SLIP_SPEEDS = number(-0.5, 0.5, 0.3, -0.3, 0.25, 0.37)
DEMANDS = st.one_of(number(1e-6, 40e3, 0, 0.5, 1e6, 30e3), number(-40e3, -1e-6, -0.5, -1e6))
POWER_LIMITS = number(1e-3, 47500, 0, 47500)
TORQUES = number(-100, 220, 0, 200, -80)
BRAKES = number(-500, 0, 0)
ROADS = number(-500, 250, 0)
AGES = number(0, 0.2, 0)
HEATS = number(0, 1.2, 0)
SHARES = st.floats(0.0, 1.0)
STEPS = st.sampled_from((0.001, 0.005, 0.01, 0.02, 0.1))


@st.composite
def measurements(draw, dt=STEPS):
    speed, spread = draw(SPEEDS), draw(SPREADS)
    creeping = SLIP_SPEEDS.map(lambda apart: (speed + apart) / RADIUS)
    wheels = []
    for _ in range(2):
        wheel = draw(st.one_of(SLIPS.map(lambda slip: speed / RADIUS * (1.0 + slip)), WHEELS, creeping))
        wheels += [wheel, wheel + spread]
    return Measurement(speed, tuple(wheels), draw(DEMANDS), draw(dt), 0.9, draw(POWER_LIMITS), draw(POWER_LIMITS), 0.8)


TUNINGS = st.builds(
    lambda **changes: DEFAULT._replace(**changes),
    strategy=st.sampled_from((EQUAL, RULE, PREVIEW, PREVIEW)),
    decision_period_s=st.sampled_from((0.02, 0.1)),
    share_rate_per_s=st.sampled_from((2.0, 20.0)),
    gate_mode=st.sampled_from((GATE_MODE_OFF, GATE_MODE_TABLE2, GATE_MODE_LIMITER, GATE_MODE_LIMITER)),
    critical_slip=st.sampled_from((0.2, 0.1)),
    gate_hysteresis=st.sampled_from((0.0, 0.05)),
    gate_driving=st.booleans(),
    slip_target=st.sampled_from((0.15, 0.08)),
    slip_filter_s=st.sampled_from((0.0, 0.02)),
    slip_speed_floor_mps=st.sampled_from((0.5, 1.0)),
    front_yaw_nm=st.sampled_from((0.0, 600.0, 1e5)),
    front_yaw_growth_nmps=st.sampled_from((0.0, 2000.0)),
    rear_yaw_nm=st.sampled_from((0.0, 300.0)),
    rear_yaw_growth_nmps=st.sampled_from((0.0, 500.0)),
    front_yaw_most_nm=st.sampled_from((500.0, 1e5)),
    rear_yaw_most_nm=st.sampled_from((0.0, 400.0)),
    yaw_rate_growth_nmps=st.sampled_from((600.0, 3000.0, 0.0)),
    unequal_slip_target=st.sampled_from((0.06, 0.3)),
    unequal_low_slip_target=st.sampled_from((0.1, 0.05)),
    unequal_rear_slip_target=st.sampled_from((0.03, 0.2)),
    yaw_speed_mps=st.sampled_from((20.0, 5.0)),
    slew_up_nmps=st.sampled_from((1600.0, 300.0)),
    slew_down_nmps=st.sampled_from((20000.0, 900.0)),
    slew_regeneration_nmps=st.sampled_from((4000.0, 500.0)),
)

#: Any state the law may find itself in, whether a drive can lead there or not.
WHEEL_STATES = st.builds(
    lambda brake, **rest: WheelState(total_nm=rest["motor_nm"] + brake, **rest),
    brake=BRAKES,
    motor_nm=TORQUES,
    speed_radps=WHEELS,
    road_nm=ROADS,
    slip=SLIPS,
    gated=st.booleans(),
    heat=HEATS,
)
#: Left and right alike, as on an even road, and all different.
FOUR_STATES = st.one_of(
    st.tuples(WHEEL_STATES, WHEEL_STATES).map(lambda axles: (axles[0], axles[0], axles[1], axles[1])),
    st.tuples(WHEEL_STATES, WHEEL_STATES, WHEEL_STATES, WHEEL_STATES),
)
SIDES = st.builds(SideGrip, friction=st.floats(0.05, 1.2), confidence=SHARES)
MEMORIES = st.builds(
    ControllerState,
    friction=st.builds(
        FrictionState, left=SIDES, right=SIDES, wheels=st.just(initial_state().friction.wheels), assumed=SHARES
    ),
    steps=st.integers(0, 2),
    split=st.builds(
        SplitMemory,
        decisions=st.integers(0, 9),
        age_s=AGES,
        decided_share=SHARES,
        applied_share=SHARES,
        changes_used=st.builds(Used, st.floats(0.0, 40.0), st.floats(0.0, 10.0)),
        jitter=st.just(no_jitter()),
    ),
    wheels=FOUR_STATES,
    front_unequal_s=st.one_of(AGES, AGES.map(operator.neg)),
    rear_unequal_s=st.one_of(AGES, AGES.map(operator.neg)),
    motion=st.just(initial_state().motion),
    travel=st.just(1.0),
    hold_nm=st.just(0.0),
    yaw=st.just(no_yaw()),
)
RATES = st.one_of(st.sampled_from((0.0, 0.02, -0.02)), st.floats(-0.2, 0.2))
#: What an accelerometer feels beyond speed times yaw rate.
SLIPPING = st.one_of(st.sampled_from((0.0, 0.2, -0.2, 0.5, -0.5)), st.floats(-3.0, 3.0))
#: What may be remembered of a gyroscope, much of it on either side of what a rule asks for.
YAWS = st.builds(
    YawState,
    straight_radps=RATES,
    known_s=st.sampled_from((0.3, 0.255, 0.245, 0.7, 0.0)),
    shown_radps=RATES,
    same_s=st.sampled_from((0.0, 0.095, 0.101)),
    level_mps2=st.sampled_from((0.0, 0.1, -0.2)),
    aside_mps=st.sampled_from((0.0, 0.0, 0.69, -0.69, 0.8, -0.8)),
    turned_rad=st.sampled_from((0.01, 0.0041, 0.0039, 0.0, -0.149, -0.151)),
    believed=st.sampled_from((True, True, False)),
    towards_radps=RATES,
    extra_nm=st.sampled_from((400.0, 1.0, MOST_NM, 0.0)),
    lost=st.booleans(),
)
WATCHED = st.builds(
    lambda state, unequal_s, yaw: state._replace(front_unequal_s=unequal_s, yaw=yaw),
    MEMORIES,
    st.sampled_from((0.05, -0.05, 0.995, -0.995, 1.005, -1.005, 0.025, -0.025)),
    YAWS,
)


def memory(front=None, rear=None, **split):
    """The state after one step, with these changes."""
    start = initial_state()
    front_wheel, rear_wheel = (start.wheels[0]._replace(**(changes or {})) for changes in (front, rear))
    wheels = (front_wheel, front_wheel, rear_wheel, rear_wheel)
    return start._replace(steps=1, wheels=wheels, split=start.split._replace(**split))


def numbers_in(value):
    """Every number of nested tuples."""
    return [x for item in value for x in numbers_in(item)] if isinstance(value, tuple) else [value]


CASES = st.builds(take, measurements(), MEMORIES, TUNINGS, st.sampled_from(list(CARS.values())))


# --- What holds in every step ----------------------------------------------------------------------------------------


def every_number_is_finite(case):
    assert all(math.isfinite(x) for x in numbers_in((case.command, case.after)))


def the_motors_stay_within_torque_and_power(case):
    for i, (wheel, motor, _, _, heat, _) in enumerate(case.wheels()):
        fastest = max(wheel, 0.0)
        assert motor <= torque_limit(fastest, heat, case.axle(i).motor) * (1.0 + 1e-12)
        assert abs(motor) * fastest <= case.axle(i).motor.max_power_w * (1.0 + 1e-12)


def regeneration_stays_within_its_limit_and_fades_at_low_speed(case):
    for i, (wheel, motor, _, _, heat, _) in enumerate(case.wheels()):
        limit = regeneration_limit(max(wheel, 0.0), case.m.speed_mps, heat, case.axle(i).motor)
        assert motor >= -limit - TORQUE_SLACK_NM


def friction_brakes_only_brake_and_only_on_demand(case):
    for i, (_, _, brake, *_) in enumerate(case.wheels()):
        assert -case.axle(i).friction_brake.max_torque_nm <= brake <= 0.0
        assert case.braking or brake == 0.0


def the_yaw_budget_of_an_axle_is_kept(case):
    # What the motors' slew and the battery do about it is short; what is asked of motor and brake together is not.
    if not case.braking or case.command.limits & (t.LIMIT_SLEW | t.LIMIT_FRICTION_BRAKE):
        return
    total = [motor + brake for _, motor, brake, *_ in case.wheels()]
    for k, name in ((0, "front"), (2, "rear")):
        axle = case.axle(k)
        left_more = abs(total[k]) - abs(total[k + 1])
        budget = oracle.yaw_budget(name, case.before, case.settings, case.m.speed_mps, case.braking, case.after.yaw)
        moment = abs(left_more) / axle.wheel.radius_m * 0.5 * axle.track_width_m
        assert moment <= budget[0 if left_more > 0.0 else 1] * (1.0 + 1e-9) + 1e-6


def alike_on_both_sides_is_commanded_alike(case):
    w, states = case.m.wheel_speed_radps, case.before.wheels
    if abs(case.before.front_unequal_s) > UNEQUAL_S:
        return  # one side has been seen to take more, and may go on with it
    for k in (0, 2):
        if w[k] == w[k + 1] and states[k] == states[k + 1]:
            assert case.command.motor_torque_nm[k] == case.command.motor_torque_nm[k + 1]
            assert case.command.friction_torque_nm[k] == case.command.friction_torque_nm[k + 1]


def mirrored(case):
    """The same step with left and right exchanged."""
    order = (1, 0, 3, 2)
    yaw = case.before.yaw
    return (
        case.m._replace(
            wheel_speed_radps=tuple(case.m.wheel_speed_radps[i] for i in order),
            yaw_rate_radps=-case.m.yaw_rate_radps,
            lateral_mps2=-case.m.lateral_mps2,
        ),
        case.before._replace(
            yaw=yaw._replace(
                straight_radps=-yaw.straight_radps,
                shown_radps=-yaw.shown_radps,
                level_mps2=-yaw.level_mps2,
                aside_mps=-yaw.aside_mps,
            ),
            wheels=tuple(case.before.wheels[i] for i in order),
            front_unequal_s=-case.before.front_unequal_s,
            rear_unequal_s=-case.before.rear_unequal_s,
        ),
    )


def left_and_right_exchanged_exchange_the_command(case):
    command, after = drive(*mirrored(case), case.settings, case.car, TABLE)
    for ours, other in (
        (case.command.motor_torque_nm, command.motor_torque_nm),
        (case.command.friction_torque_nm, command.friction_torque_nm),
        ([w.heat for w in case.after.wheels], [w.heat for w in after.wheels]),
        ([w.road_nm for w in case.after.wheels], [w.road_nm for w in after.wheels]),
        ([case.after.front_unequal_s] * 4, [-after.front_unequal_s] * 4),
        ([case.after.rear_unequal_s] * 4, [-after.rear_unequal_s] * 4),
    ):
        near = pytest.approx([other[i] for i in (1, 0, 3, 2)], rel=1e-9, abs=1e-6)
        assert list(ours) == near or case.command.limits & (t.LIMIT_BATTERY_CHARGE | t.LIMIT_BATTERY_DISCHARGE)
    assert [w.gated for w in after.wheels] == [case.after.wheels[i].gated for i in (1, 0, 3, 2)] or printed_tie(case)


def printed_tie(case):
    """Table 2 as printed goes by the worse wheel; of two equally bad ones, with opposite signs, the right one."""
    w = case.after.wheels
    return any(abs(w[k].slip) == abs(w[k + 1].slip) for k in (0, 2))


def a_gated_wheel_has_no_torque_at_all(case):
    gated = [wheel.gated for wheel in case.after.wheels]
    assert case.command.gated_wheels == sum(1 << i for i in range(4) if gated[i])
    assert case.command.gate == (gated[0] and gated[1]) + 2 * (gated[2] and gated[3])
    for _, motor, brake, _, _, held in case.wheels():
        assert not held or (motor == 0.0 and brake == 0.0)
    if case.settings.gate_mode == GATE_MODE_OFF:
        assert not any(gated)
    if case.settings.gate_mode == GATE_MODE_TABLE2 and case.before.wheels[0] == case.before.wheels[1]:
        assert gated[0] == gated[1]


def torque_grows_no_faster_than_its_rate(case):
    dt, s = case.m.dt_s, case.settings
    for _, motor, _, before, *_ in case.wheels():
        slack = TORQUE_SLACK_NM + 1e-12 * abs(before)
        assert motor <= max(before, 0.0) + s.slew_up_nmps * dt + slack
        assert motor >= min(before, 0.0) - s.slew_regeneration_nmps * dt - slack


def torque_falls_no_faster_than_its_rate_but_by_a_gate_or_a_limit(case):
    fall = case.settings.slew_down_nmps * case.m.dt_s
    battery = t.LIMIT_BATTERY_CHARGE | t.LIMIT_BATTERY_DISCHARGE
    for i, (_, motor, _, before, heat, gated) in enumerate(case.wheels()):
        if gated or case.command.limits & battery or abs(before) <= fall:
            continue
        towards_zero = math.copysign(abs(before) - fall, before)
        if before > 0.0:
            room = torque_limit(case.fast(i), heat, case.axle(i).motor)
            if not case.braking:
                room = min(room, case.grip_nm(i))
            assert motor >= min(towards_zero, room) - 1e-6
        else:
            room = regeneration_limit(case.fast(i), case.m.speed_mps, heat, case.axle(i).motor)
            if case.braking:
                room = min(room, case.grip_nm(i))
            assert motor <= max(towards_zero, -room) + 1e-6


def without_gate_and_limit_the_torques_sum_to_the_demand(case):
    assert case.delivered_w() == pytest.approx(
        case.command.front_power_w + case.command.rear_power_w, abs=1e-6, rel=1e-9
    )
    if case.command.gated_wheels == 0 and case.command.limits == 0:
        assert case.delivered_w() == pytest.approx(case.m.power_demand_w, rel=1e-9, abs=POWER_SLACK_W)


def braking_always_gets_through(case):
    if not case.braking or case.command.gated_wheels or case.command.limits & t.LIMIT_SLIP:
        return
    wheels = case.wheels()
    most = [case.axle(i).friction_brake.max_torque_nm for i in range(4)]
    if not any(most):
        return  # what the motors cannot give is another system's
    owed = max(case.m.power_demand_w, -sum(case.conversion(i) * most[i] for i in range(4)))
    if any(motor > 0.0 and brake == -most[i] for i, (_, motor, brake, *_) in enumerate(wheels)):
        return  # a full brake has nothing left to hold against a motor on its way down from driving
    slack = POWER_SLACK_W + 1e-9 * abs(owed)
    assert case.delivered_w() <= owed + slack
    # More than asked is only what a regenerating motor still does on its way to zero.
    if not any(brake == 0.0 and before < motor < 0.0 for _, motor, brake, before, *_ in wheels):
        assert case.delivered_w() >= owed - slack


def the_battery_s_limits_hold_wherever_torque_can_help(case):
    m, power = case.m, case.battery_w()
    if power < -m.charge_limit_w - POWER_SLACK_W:
        pytest.fail(f"charges with {-power} W, allowed {m.charge_limit_w} W")
    if power > m.discharge_limit_w + POWER_SLACK_W:
        # Not even zero torque is within the limit.
        assert all(motor == 0.0 for _, motor, *_ in case.wheels())
        assert power == pytest.approx(case.battery_w(0.0))


def shares_stay_between_nothing_and_everything(case):
    assert 0.0 <= case.command.front_share <= 1.0
    assert 0.0 <= case.command.decided_share <= 1.0
    if case.before.steps > 0:
        change = abs(case.command.front_share - case.before.split.applied_share)
        assert change <= case.settings.share_rate_per_s * case.m.dt_s + 1e-12


def the_limiter_s_room_is_kept(case):
    for i, (_, motor, brake, *_) in enumerate(case.wheels()):
        if case.braking:
            assert -motor - brake <= case.grip_nm(i) + 1e-6
        else:
            assert motor <= case.grip_nm(i) + 1e-6


def nothing_pushes_against_the_demand_but_what_is_on_its_way_to_zero(case):
    for _, motor, _, before, *_ in case.wheels():
        assert motor <= 0.0 if case.braking and before <= 0.0 else True
        assert motor >= 0.0 if not case.braking and before >= 0.0 else True


def the_reasons_are_among_the_named_ones(case):
    assert case.command.limits & ~sum(t.LIMIT_NAMES) == 0
    bits = case.command.limits
    assert not bits & t.LIMIT_THERMAL or bits & t.LIMIT_MOTOR
    assert case.braking or not bits & (t.LIMIT_REGENERATION | t.LIMIT_FRICTION_BRAKE)


def the_same_step_gives_the_same_bits(case):
    again = drive(case.m, case.before, case.settings, case.car, TABLE)
    assert again == (case.command, case.after)


def a_yaw_rate_is_believed_and_counts_as_in_the_plain_law(case):
    expected = oracle.known_yaw(case.m, case.before, case.settings)
    assert (case.after.yaw.believed, case.after.yaw.shown_radps) == (expected.believed, expected.shown_radps)
    assert tuple(case.after.yaw) == pytest.approx(tuple(expected), rel=1e-9, abs=1e-9)


def it_does_what_the_plain_law_does(case):
    def decide(front_slip, rear_slip):
        if case.settings.strategy == EQUAL:
            return 0.5
        if case.settings.strategy == PREVIEW:
            return TABLE.schedule[min(case.before.split.decisions, len(TABLE.schedule) - 1)]
        small = abs(case.m.power_demand_w) < 1.0
        return case.before.split.decided_share if small else rule(case.m.power_demand_w, TABLE.rule)

    axles, share, decided, bits = oracle.step(case.m, case.before, case.settings, case.car, decide)
    command, after = case.command, case.after
    wheels = [wheel for axle in axles for wheel in axle.wheels]
    if math.isnan(sum(wheel.motor for wheel in wheels)) or any(wheel.doubtful for wheel in wheels):
        return  # several answers are right: battery and gate have checks of their own

    def near(value):
        return pytest.approx(value, rel=1e-8, abs=1e-7)

    for k, name in ((0, "front"), (2, "rear")):
        was, now = (getattr(state, f"{name}_unequal_s") for state in (case.before, after))
        same = case.m.wheel_speed_radps[k] == case.m.wheel_speed_radps[k + 1]
        back = 0.0 if same else math.copysign(max(abs(was) - case.m.dt_s, 0.0), was)
        assert now == near(back) or (case.braking and now in (near(was + case.m.dt_s), near(was - case.m.dt_s)))
    ours = [(motor, brake) for _, motor, brake, *_ in case.wheels()]
    assert ours == [(near(a.motor), near(a.friction)) for a in wheels]
    assert [state.gated for state in after.wheels] == [a.gated for a in wheels]
    for slip, axle in ((command.front_slip, axles[0]), (command.rear_slip, axles[1])):
        # Of two slips that are alike but for their sign and rounding, either is the worse one.
        assert any(slip == near(wheel.slip) for wheel in axle.wheels)
        assert abs(slip) == near(abs(axle.slip))
    assert (command.front_share, command.decided_share) == (near(share), near(decided))
    assert {name for bit, name in t.LIMIT_NAMES.items() if command.limits & bit} == {t.LIMIT_NAMES[x] for x in bits}
    for i, state in enumerate(after.wheels):
        assert state.motor_nm == ours[i][0]
        assert state.total_nm == near(case.m.motor_gain[i] * ours[i][0] + case.m.motor_stuck_nm[i] + ours[i][1])
        assert state.speed_radps == case.m.wheel_speed_radps[i]
        assert state.road_nm == near(wheels[i].road)
        assert state.slip == near(wheels[i].slip)
        motor = case.axle(i).motor
        target = (ours[i][0] / motor.continuous_torque_nm) ** 2
        heat = oracle.low_pass(case.before.wheels[i].heat, target, case.m.dt_s, motor.thermal_time_constant_s)
        assert state.heat == near(heat)
    assert (after.split.decided_share, after.split.applied_share) == (command.decided_share, command.front_share)
    assert after.steps == case.before.steps + 1
    before = case.before.split
    taken = case.before.steps == 0 or before.age_s + 1.5 * case.m.dt_s >= case.settings.decision_period_s
    assert after.split.decisions == before.decisions + taken
    age = before.age_s + case.m.dt_s
    assert after.split.age_s == near(0.0 if taken else age)
    # No budget in these tables: nothing is counted, and nothing leaks.
    assert after.split.changes_used == before.changes_used
    assert after.split.jitter.taken >= before.jitter.taken


CHECKS = (
    every_number_is_finite,
    the_motors_stay_within_torque_and_power,
    regeneration_stays_within_its_limit_and_fades_at_low_speed,
    friction_brakes_only_brake_and_only_on_demand,
    alike_on_both_sides_is_commanded_alike,
    left_and_right_exchanged_exchange_the_command,
    the_yaw_budget_of_an_axle_is_kept,
    a_gated_wheel_has_no_torque_at_all,
    torque_grows_no_faster_than_its_rate,
    torque_falls_no_faster_than_its_rate_but_by_a_gate_or_a_limit,
    without_gate_and_limit_the_torques_sum_to_the_demand,
    braking_always_gets_through,
    the_battery_s_limits_hold_wherever_torque_can_help,
    shares_stay_between_nothing_and_everything,
    the_limiter_s_room_is_kept,
    nothing_pushes_against_the_demand_but_what_is_on_its_way_to_zero,
    the_reasons_are_among_the_named_ones,
    the_same_step_gives_the_same_bits,
    a_yaw_rate_is_believed_and_counts_as_in_the_plain_law,
    it_does_what_the_plain_law_does,
)


@settings(max_examples=EXAMPLES)
@given(case=CASES)
def test_all_of_it_holds_in_any_step(case):
    for check in CHECKS:
        check(case)


@settings(max_examples=EXAMPLES)
@given(
    measurement=measurements(),
    rate=RATES,
    slipping=SLIPPING,
    state=WATCHED,
    tuning=TUNINGS,
    car=st.sampled_from(list(CARS.values())),
)
def test_all_of_it_holds_with_a_gyroscope_and_an_accelerometer(measurement, rate, slipping, state, tuning, car):
    felt = measurement.speed_mps * rate + slipping
    case = take(measurement._replace(yaw_rate_radps=rate, lateral_mps2=felt), state, tuning, car)
    for check in CHECKS:
        check(case)


@settings(max_examples=EXAMPLES)
@given(
    measurement=measurements(),
    gains=st.tuples(*[st.sampled_from((1.0, 1.0, 0.0, 0.25))] * 4),
    stuck=st.tuples(*[st.sampled_from((0.0, 40.0, -40.0))] * 4),
    state=MEMORIES,
    tuning=TUNINGS,
    car=st.sampled_from(list(CARS.values())),
)
def test_motors_that_are_lost_are_done_without_as_in_the_plain_law(measurement, gains, stuck, state, tuning, car):
    stuck = tuple(nm if gain == 0.0 else 0.0 for nm, gain in zip(stuck, gains, strict=True))
    it_does_what_the_plain_law_does(
        take(measurement._replace(motor_gain=gains, motor_stuck_nm=stuck), state, tuning, car)
    )


@settings(max_examples=EXAMPLES)
@given(
    steps=st.sampled_from((0.005, 0.01, 0.1)).flatmap(
        lambda dt: st.lists(measurements(st.just(dt)), min_size=2, max_size=8)
    ),
    s=TUNINGS,
    car=st.sampled_from(list(CARS.values())),
)
def test_all_of_it_holds_from_the_first_step_on_for_any_sequence_of_measurements(steps, s, car):
    state = initial_state()
    for m in steps:
        case = take(m, state, s, car)
        for check in CHECKS:
            check(case)
        state = case.after


# --- Table 2 as printed ----------------------------------------------------------------------------------------------

TABLE2 = DEFAULT._replace(gate_mode=GATE_MODE_TABLE2, gate_hysteresis=0.0, gate_driving=False)


@pytest.mark.parametrize(
    ("slips", "gate", "parts"),
    [
        ((-0.1, -0.1), t.GATE_NONE, (0.3, 0.7)),
        ((-0.3, -0.1), t.GATE_FRONT, (0.0, 1.0)),
        ((-0.1, -0.3), t.GATE_REAR, (1.0, 0.0)),
        ((-0.3, -0.3), t.GATE_BOTH, (0.0, 0.0)),
    ],
)
def test_table_2_as_printed(slips, gate, parts):
    s = TABLE2._replace(strategy=RULE)
    table = TABLE._replace(rule=TABLE.rule * 0.0 + [0.0, 0.3, 0.0, 0.3])
    m = measurement(slips=slips, demand=-4000.0)
    command, _ = drive(m, initial_state(), s, CAR, table)
    assert command.gate == gate
    assert (command.front_power_w, command.rear_power_w) == pytest.approx(tuple(-4000.0 * x for x in parts))


@pytest.mark.parametrize("slip", [0.3, 0.9, -0.3])
def test_table_2_as_printed_gates_no_driving_axle(slip):
    assert take(measurement(slips=(slip, slip)), None, TABLE2).command.gate == t.GATE_NONE


def test_driving_slip_is_gated_too_where_that_is_asked_for():
    s = TABLE2._replace(gate_driving=True)
    assert take(measurement(slips=(0.3, 0.1)), None, s).command.gate == t.GATE_FRONT
    assert take(measurement(slips=(0.1, 0.3)), None, s).command.gate == t.GATE_REAR
    assert take(measurement(slips=(-0.3, -0.3)), None, s).command.gate == t.GATE_NONE


def test_the_gate_looks_at_the_worse_wheel_of_an_axle():
    rolling = 15.0 / RADIUS
    m = measurement(demand=-4000.0, wheel_speed_radps=(rolling, 0.7 * rolling, rolling, rolling))
    assert take(m, None, TABLE2).command.gate == t.GATE_FRONT


def test_an_axle_is_freed_only_when_its_slip_is_back_inside_by_the_hysteresis():
    s = TABLE2._replace(gate_hysteresis=0.05)
    gates, state = [], initial_state()
    for slip in (-0.1, -0.19, -0.21, -0.19, -0.16, -0.14, -0.19):
        case = take(measurement(slips=(slip, 0.0), demand=-4000.0), state, s)
        gates.append(case.command.gate)
        state = case.after
    assert gates == [0, 0, t.GATE_FRONT, t.GATE_FRONT, t.GATE_FRONT, 0, 0]


def test_a_gate_cuts_at_once_and_the_way_back_is_slew_limited():
    before = settle(measurement(demand=-6000.0), TABLE2).after
    assert before.wheels[0].motor_nm < -20.0
    slow = TABLE2._replace(slew_regeneration_nmps=1000.0)
    gated = take(measurement(demand=-6000.0, slips=(-0.3, 0.0)), before, slow)
    assert gated.command.motor_torque_nm[0] == 0.0
    freed = take(measurement(demand=-6000.0), gated.after, slow)
    assert freed.command.motor_torque_nm[0] == pytest.approx(-10.0)


# --- Limits, one by one ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("dt", "period", "taken"),
    [(0.01, 0.02, [0, 2, 4, 6, 8]), (0.01, 0.05, [0, 5]), (0.1, 0.02, range(10)), (0.03, 0.107, [0, 4, 8])],
)
def test_the_split_is_decided_once_a_period(dt, period, taken):
    s, state, steps = DEFAULT._replace(strategy=PREVIEW, decision_period_s=period), initial_state(), []
    for k in range(10):
        before, state = state, take(measurement(dt=dt), state, s).after
        if state.split.decisions > before.split.decisions:
            steps.append(k)
    assert steps == list(taken)


def test_no_minute_sees_more_changes_than_the_budget_and_the_burst_whatever_is_demanded():
    table = load_policy(share_path("policies/jalalmaab_2015_none_coupled_mu090.npz")).table()
    s, car = DEFAULT._replace(strategy=SDP_LOOKAHEAD), CARS["none"]
    state, share, changes = initial_state(), 0.5, []
    # The demand leaps between what one axle and what both are best for, slowly enough to be no noise.
    for k in range(18_000):
        demand = 1000.0 if k // 60 % 2 else 14000.0
        command, state = drive(measurement(speed=10.0, demand=demand), state, s, car, table)
        if abs(command.decided_share - share) > 0.25:
            changes.append(k * 0.01)
            share = command.decided_share
    busiest = max(sum(start <= at < start + 60.0 for at in changes) for start in changes)
    assert 8 < busiest <= 8.0 + burst(8.0)
    assert len(changes) <= 3 * 8.0 + buckets(8.0).lasting


def test_equal_split_at_ease_gives_each_motor_a_quarter():
    case = settle(measurement(demand=6000.0))
    assert case.command.motor_torque_nm == pytest.approx((6000.0 / 4.0 / (15.0 / RADIUS),) * 4)
    assert case.command.limits == 0
    assert case.command.front_share == 0.5


def test_what_one_axle_s_motors_cannot_give_the_other_s_do():
    s = DEFAULT._replace(strategy=RULE)
    table = TABLE._replace(rule=TABLE.rule * 0.0 + [0.0, 1.0, 0.0, 1.0])
    state = initial_state()
    for _ in range(100):
        command, state = drive(measurement(demand=22e3), state, s, CAR, table)
    assert command.front_power_w == pytest.approx(15e3)
    assert command.rear_power_w == pytest.approx(7e3)
    assert command.limits == t.LIMIT_MOTOR


def test_a_hot_motor_gives_its_continuous_torque_and_says_so():
    hot = memory(front={"heat": 1.0}, rear={"heat": 1.0})
    m = measurement(speed=5.0, demand=10e3)
    case = take(m, hot)
    for _ in range(100):
        wheels = tuple(wheel._replace(heat=1.0) for wheel in case.after.wheels)
        case = take(m, case.after._replace(wheels=wheels))
    assert case.command.motor_torque_nm == pytest.approx((80.0,) * 4)
    assert case.command.limits == t.LIMIT_MOTOR | t.LIMIT_THERMAL


def test_an_axle_that_helps_out_up_to_its_limit_is_at_its_limit():
    # The front axle is asked for little and hot; it gives all it can of what the rear one cannot.
    preview = default_settings("preview")._replace(gate_mode=GATE_MODE_OFF)
    table = TABLE._replace(schedule=TABLE.schedule[:1] * 0.0 + 0.2)
    hot = memory(front={"heat": 1.0}, applied_share=0.2, decided_share=0.2)
    command, _ = drive(measurement(speed=5.0, demand=12e3), hot, preview, CAR, table)
    assert command.limits & ~t.LIMIT_SLEW == t.LIMIT_MOTOR | t.LIMIT_THERMAL


def test_no_demand_is_no_braking_demand():
    slow = DEFAULT._replace(slew_down_nmps=500.0)
    driving = settle(measurement(demand=8e3), slow)
    coasting = take(measurement(demand=0.0), driving.after, slow)
    assert min(coasting.command.motor_torque_nm) > 0.0, "torque goes to zero at its rate"
    assert coasting.command.friction_torque_nm == (0.0,) * 4
    braking = take(measurement(demand=-1.0), driving.after, slow)
    assert max(braking.command.friction_torque_nm) < 0.0


@pytest.mark.parametrize("demand", [8e3, -8e3])
def test_where_grip_is_lost_torque_is_cut_at_once_however_slow_its_slew(demand):
    slow = DEFAULT._replace(slew_down_nmps=100.0)
    gripping = settle(measurement(demand=demand), slow)
    slip = math.copysign(0.14, demand)
    # The wheels run away within one step: the road takes nothing any more.
    slipping = take(measurement(slips=(slip, slip), demand=demand), gripping.after, slow)
    for i, (_, motor, _, before, _, gated) in enumerate(slipping.wheels()):
        assert not gated
        assert abs(before) > 20.0
        assert abs(motor) <= slipping.grip_nm(i) + TORQUE_SLACK_NM
        assert abs(motor) < 1.0


def test_regeneration_on_its_way_down_is_not_driven_against():
    slow = DEFAULT._replace(slew_down_nmps=100.0)
    hard = settle(measurement(demand=-8e3), slow)
    soft = take(measurement(demand=-1e3), hard.after, slow)
    assert soft.command.motor_torque_nm == pytest.approx([nm + 1.0 for nm in hard.command.motor_torque_nm])
    assert soft.command.friction_torque_nm == (0.0,) * 4


@pytest.mark.parametrize("front_share", [0.0, 1.0])
def test_a_little_friction_is_told_like_much(front_share):
    preview = default_settings("preview")._replace(gate_mode=GATE_MODE_OFF)
    table = TABLE._replace(schedule=TABLE.schedule[:1] * 0.0 + front_share)
    before = memory(applied_share=front_share, decided_share=front_share)
    demand = -2.0 * (80.0 + 0.5) * 15.0 / RADIUS
    command, _ = drive(measurement(demand=demand), before, preview, CAR, table)
    assert command.limits & ~t.LIMIT_SLEW == t.LIMIT_REGENERATION
    command, _ = drive(measurement(demand=demand + 100.0), before, preview, CAR, table)
    assert command.limits & ~t.LIMIT_SLEW == 0


def test_rounding_is_no_limit():
    preview = default_settings("preview")
    table = TABLE._replace(schedule=TABLE.schedule[:1] * 0.0 + 0.3)
    rolling = {"speed_radps": 15.0 / RADIUS}
    before = memory(rolling, rolling, applied_share=0.3, decided_share=0.3)
    for demand in range(1000, 8000, 37):
        command, _ = drive(measurement(demand=float(demand)), before, preview, CAR, table)
        assert command.limits & ~t.LIMIT_SLEW == 0


def test_a_speed_below_zero_is_standstill():
    m = measurement(speed=0.0, demand=2e3)
    below, at = (drive(m._replace(speed_mps=v), initial_state(), DEFAULT, CAR, TABLE) for v in (-0.5, 0.0))
    assert below[0]._replace(speed_mps=0.0) == at[0]
    assert below[1] == at[1]


@pytest.mark.parametrize("stuck_nm", [-40.0, 40.0])
def test_a_stuck_motor_of_a_gated_wheel_is_not_held_against_by_its_brake(stuck_nm):
    m = measurement(slips=(0.0, -0.4), demand=-20e3, motor_gain=(1.0, 1.0, 0.0, 1.0))
    command = take(m._replace(motor_stuck_nm=(0.0, 0.0, stuck_nm, 0.0))).command
    assert command.gated_wheels & 4
    assert command.friction_torque_nm[2] == 0.0
    assert violated_bound(command, CAR) == ""


def test_hard_braking_is_shared_by_motors_and_friction_brakes():
    case = settle(measurement(demand=-16e3), DEFAULT._replace(gate_mode=GATE_MODE_OFF))
    assert case.command.motor_torque_nm == pytest.approx((-80.0,) * 4)
    assert sum(case.command.friction_torque_nm) == pytest.approx(-16e3 / (15.0 / RADIUS) + 320.0)
    assert case.command.limits == t.LIMIT_REGENERATION


def test_regeneration_fades_out_between_its_two_speeds_and_friction_takes_over():
    off = DEFAULT._replace(gate_mode=GATE_MODE_OFF)
    motors = {v: settle(measurement(speed=v, demand=-9000.0), off).command.motor_torque_nm[0] for v in (3.0, 2.0, 1.0)}
    assert motors[3.0] == pytest.approx(-80.0)
    assert motors[2.0] == pytest.approx(-40.0)
    assert motors[1.0] == 0.0


def test_a_full_battery_takes_nothing_and_the_friction_brakes_brake_alone():
    case = settle(measurement(demand=-6000.0, charge=0.0))
    assert case.battery_w() >= 0.0
    assert case.delivered_w() == pytest.approx(-6000.0)
    assert case.command.limits & t.LIMIT_BATTERY_CHARGE


def test_an_empty_battery_drives_no_motor():
    case = settle(measurement(demand=6000.0, discharge=0.0))
    assert case.command.motor_torque_nm == (0.0,) * 4
    assert case.command.limits & t.LIMIT_BATTERY_DISCHARGE


def test_an_empty_battery_is_still_charged_by_braking():
    case = settle(measurement(demand=-6000.0, discharge=0.0))
    assert case.battery_w() < -3000.0
    assert case.command.limits == 0


@pytest.mark.parametrize(("demand", "limits"), [(6000.0, {"discharge": 2000.0}), (-6000.0, {"charge": 2000.0})])
def test_a_small_battery_gives_and_takes_exactly_its_limit(demand, limits):
    case = settle(measurement(demand=demand, **limits))
    assert case.battery_w() == pytest.approx(math.copysign(2000.0, demand), rel=1e-6)


def test_two_closed_limits_switch_the_motors_off():
    for demand in (6000.0, -6000.0):
        case = settle(measurement(demand=demand, charge=0.0, discharge=0.0))
        assert case.command.motor_torque_nm == (0.0,) * 4


def test_braking_gets_through_while_the_motors_still_come_down_from_driving():
    slow = DEFAULT._replace(slew_down_nmps=500.0)
    driving = settle(measurement(demand=8000.0), slow).after
    case = take(measurement(demand=-3000.0), driving, slow)
    assert case.command.motor_torque_nm[0] > 30.0
    assert case.delivered_w() == pytest.approx(-3000.0)
    assert case.command.limits & t.LIMIT_SLEW


def test_friction_fills_in_while_regeneration_grows():
    slow = DEFAULT._replace(slew_regeneration_nmps=100.0)
    case = take(measurement(demand=-3000.0), settle(measurement(demand=0.0), slow).after, slow)
    assert case.command.motor_torque_nm[0] == pytest.approx(-1.0)
    assert case.delivered_w() == pytest.approx(-3000.0)


def test_a_brake_pedal_at_rest_holds_the_car_by_friction_alone():
    case = settle(measurement(speed=0.0, demand=-600.0))
    assert case.command.motor_torque_nm == (0.0,) * 4
    assert case.command.friction_torque_nm == pytest.approx((-600.0 * RADIUS / 4.0,) * 4)


def test_the_friction_brakes_own_limit_is_kept_and_said():
    off = DEFAULT._replace(gate_mode=GATE_MODE_OFF)
    case = settle(measurement(demand=-1e6), off)
    assert [a + b for a, b in zip(*case.command[:2], strict=True)] == pytest.approx([-900.0] * 4)
    assert case.command.limits & t.LIMIT_FRICTION_BRAKE


@pytest.mark.parametrize("strategy", ["equal", "rule"])
def test_without_friction_brakes_all_four_motors_regenerate_as_much_as_they_can(strategy):
    """Whatever the split asks of an axle: nobody else gives what one of them could."""
    car = CARS["without brakes"]
    case = settle(measurement(speed=10.0, demand=-20e3), default_settings(strategy), car=car)
    assert case.command.friction_torque_nm == (0.0,) * 4
    assert case.command.motor_torque_nm == pytest.approx((-80.0,) * 4)
    assert case.command.limits & t.LIMIT_REGENERATION
    assert not case.command.limits & t.LIMIT_FRICTION_BRAKE
    slow = settle(measurement(speed=0.5, demand=-600.0), default_settings(strategy), car=car)
    assert slow.command.motor_torque_nm == slow.command.friction_torque_nm == (0.0,) * 4


# --- The slip limiter, with the wheel and the tyre it steers ---------------------------------------------------------


@pytest.mark.parametrize(("demand", "friction"), [(-60e3, 0.5), (-60e3, 0.2), (30e3, 0.2), (30e3, 0.1)])
def test_the_limiter_holds_the_wheel_at_its_target_slip(demand, friction):
    """Each wheel at a constant 15 m/s on a tyre that gives far less than is asked for."""
    speed, dt = 15.0, 0.01
    load = CAR.chassis.mass_kg * G / 4.0
    wheels, slips, gates, state = [speed / RADIUS] * 4, [], [], initial_state()
    for _ in range(150):
        case = take(measurement(demand=demand, wheel_speed_radps=tuple(wheels)), state)
        state = case.after
        torques = zip(case.command.motor_torque_nm, case.command.friction_torque_nm, strict=True)
        for k, torque in enumerate(map(sum, torques)):
            for _ in range(20):
                x = oracle.slip(wheels[k], speed, RADIUS, 0.5)
                road = RADIUS * load * friction_coefficient(x, friction, CAR.front.tyre)
                wheels[k] = max(wheels[k] + dt / 20 * (torque - road) / CAR.front.wheel.inertia_kgm2, 0.0)
        slips.append([oracle.slip(wheel, speed, RADIUS, 0.5) for wheel in wheels])
        gates.append(case.command.gate)
    assert slips[-1] == pytest.approx([math.copysign(DEFAULT.slip_target, demand)] * 4, abs=0.01)
    assert max(abs(slip) for wheels in slips for slip in wheels) < 0.2
    assert set(gates) == {t.GATE_NONE}
    assert case.command.limits & t.LIMIT_SLIP


@pytest.mark.parametrize("demand", [-30e3, 30e3])
def test_a_wheel_that_keeps_its_slip_with_next_to_no_torque_gets_none(demand):
    """So it shows whether it slips at all: with a torque that the smoothest ice takes nobody can tell."""
    slip = math.copysign(0.17, demand)
    gates, state = [], initial_state()
    for _ in range(60):
        case = take(measurement(demand=demand, slips=(slip, slip)), state)
        state = case.after
        gates.append(case.command.gate)
    assert set(gates[-20:]) == {t.GATE_BOTH}
    assert case.command.motor_torque_nm == (0.0,) * 4


@st.composite
def braked_wheels(draw):
    """Four wheels of one step, braked near what roads give: their slips and torques, and which are gated."""
    slips = draw(st.tuples(*[st.floats(0.0, 0.25)] * 4))
    torques = draw(st.tuples(*[st.floats(0.0, 450.0)] * 4))
    gated = draw(st.tuples(*[st.sampled_from((False, False, True))] * 4))
    demand, dt = draw(st.sampled_from((-30e3, -90e3))), draw(st.sampled_from((0.005, 0.01)))
    m = measurement(demand=demand, dt=dt)
    m = m._replace(wheel_speed_radps=tuple(15.0 / RADIUS * (1.0 - slip) for slip in slips))
    wheel = initial_state().wheels[0]
    wheels = tuple(
        wheel._replace(total_nm=-nm, road_nm=-nm, slip=-slip, gated=gate, speed_radps=w)
        for nm, slip, gate, w in zip(torques, slips, gated, m.wheel_speed_radps, strict=True)
    )
    return m, initial_state()._replace(steps=5, wheels=wheels)


@settings(max_examples=EXAMPLES)
@given(braked_wheels())
def test_wheels_braked_near_what_roads_give_are_gated_as_in_the_plain_law(drawn):
    it_does_what_the_plain_law_does(take(*drawn))


@pytest.mark.parametrize("wheel", range(4))
@pytest.mark.parametrize("friction", [0.2, 0.5])
@pytest.mark.parametrize("other_axle_alike", [False, True])
def test_a_wheel_that_alone_of_its_axle_slips_by_less_than_the_road_gives_the_others_gets_no_torque(
    wheel, friction, other_axle_alike
):
    """Both of an axle may be on another road than the other two; and with as much as the others it is on theirs."""
    alone, both, rolling = {wheel}, {wheel, wheel ^ 1}, 0.05
    for slipping, part, gated in ((alone, 0.4, 1 << wheel), (alone, 0.8, 0), (both, 0.4, 0)):
        others = {wheel ^ 2, wheel ^ 3} if other_axle_alike else {wheel ^ 2}
        slips = [0.155 if i in slipping | others else rolling for i in range(4)]
        torques = [
            friction * (part if i in slipping else 1.0) * CAR.chassis.mass_kg / 4.0 * G * RADIUS for i in range(4)
        ]
        m = measurement(demand=-90e3)
        m = m._replace(wheel_speed_radps=tuple(15.0 / RADIUS * (1.0 - slip) for slip in slips))
        states = tuple(
            initial_state().wheels[0]._replace(total_nm=-nm, road_nm=-nm, slip=-slip, speed_radps=w)
            for nm, slip, w in zip(torques, slips, m.wheel_speed_radps, strict=True)
        )
        assert take(m, initial_state()._replace(steps=5, wheels=states), car=LOW).command.gated_wheels == gated


# --- Direction: what the whole law makes of a car that moves the wrong way, or both ways ------------------------------


def whole(m, state=None, s=DEFAULT):
    return law.step(m, initial_state() if state is None else state, s, CAR, TABLE)


def moving(speed, demand, direction=1.0):
    return measurement(speed=0.0, demand=demand)._replace(
        speed_mps=speed, wheel_speed_radps=(speed / RADIUS,) * 4, direction=direction
    )


def settled(m, steps=60, s=DEFAULT):
    state = initial_state()
    for _ in range(steps):
        command, state = whole(m, state, s)
    return command, state


@pytest.mark.parametrize("speed", [-0.1, -0.5, -2.0, -8.0])
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_brakes_brake_backwards_as_forwards(speed, direction):
    off = DEFAULT._replace(gate_mode=GATE_MODE_OFF)
    back, _ = settled(moving(speed, -3000.0, direction), s=off)
    ahead, _ = settled(moving(-speed, -3000.0), s=off)
    assert back.friction_torque_nm == pytest.approx(ahead.friction_torque_nm)
    assert back.motor_torque_nm == pytest.approx([-nm for nm in ahead.motor_torque_nm])
    assert sum(back.friction_torque_nm) < -50.0 or sum(back.motor_torque_nm) > 50.0


def test_a_car_that_rolls_back_is_braked_whatever_its_wheels_do():
    rolling, state = settled(moving(-3.0, -9000.0))
    locked = moving(-3.0, -9000.0)._replace(wheel_speed_radps=(-2.0,) * 4)
    for _ in range(5):
        command, state = whole(locked, state)
        assert command.gated_wheels == 0
        assert sum(command.friction_torque_nm) <= 0.8 * sum(rolling.friction_torque_nm)


@given(SHARES, st.floats(0.5, 8.0), st.floats(-8e3, -500.0), st.sampled_from([1.0, -1.0]))
def test_a_car_that_rolls_back_is_braked_by_both_axles_alike_whatever_the_split(share, speed, demand, direction):
    one_sided = default_settings("preview")
    table = TABLE._replace(schedule=TABLE.schedule[:1] * 0.0 + share)

    def after_a_second(sign):
        state = initial_state()
        for _ in range(100):
            command, state = law.step(moving(sign * speed, demand, direction), state, one_sided, CAR, table)
        return command

    def by_wheel(command, sign):
        both = zip(command.motor_torque_nm, command.friction_torque_nm, strict=True)
        return [sign * motor + friction for motor, friction in both]

    back = after_a_second(-direction)
    torques = by_wheel(back, -direction)
    assert back.front_share == 0.5
    assert torques == pytest.approx([torques[0]] * 4, rel=1e-6)
    assert torques[0] < 0.0
    ahead = after_a_second(direction)
    assert ahead.front_share == pytest.approx(share), "in the direction asked for the split is the strategy's"


def test_reverse_drives_backwards_and_no_faster_than_it_may():
    command, _ = settled(moving(0.0, 1500.0, -1.0))
    assert max(command.motor_torque_nm) < -30.0
    slow, fast, faster = (settled(moving(v, 1500.0, -1.0))[0] for v in (-2.0, -4.5, -5.0))
    assert max(slow.motor_torque_nm) < 0.0
    assert sum(fast.motor_torque_nm) == pytest.approx(-0.5 * 1500.0 / (4.5 / RADIUS), rel=1e-6)
    assert faster.motor_torque_nm == (0.0,) * 4


@given(
    st.lists(
        st.tuples(st.floats(-6.0, 6.0), st.floats(-20e3, 20e3), st.sampled_from([1.0, -1.0])), min_size=1, max_size=12
    )
)
def test_no_motor_ever_grows_against_the_direction_asked_for(moves):
    state = initial_state()
    for speed, demand, direction in moves:
        before = [state.travel * wheel.motor_nm for wheel in state.wheels]
        command, state = whole(moving(speed, demand, direction), state)
        for nm, was in zip(command.motor_torque_nm, before, strict=True):
            if demand >= 0.0:
                assert direction * nm >= min(direction * was, 0.0) - 1e-6
        assert max(command.friction_torque_nm) <= 0.0


def test_a_car_that_begins_to_roll_back_is_held_until_it_drives_off():
    _, state = settled(moving(0.0, 0.0))
    command, state = whole(moving(-0.05, 0.0), state)
    assert command.hold_nm == 0.0
    command, state = whole(moving(-0.07, 0.0), state)
    hold = 0.25 * CAR.chassis.mass_kg * G * 0.25 * RADIUS
    assert command.friction_torque_nm == pytest.approx((-hold,) * 4)
    for _ in range(500):
        command, state = whole(moving(0.0, 0.0), state)
    assert command.friction_torque_nm == pytest.approx((-hold,) * 4), "as long as nobody drives"
    faded = []
    for _ in range(60):
        command, state = whole(moving(0.0, 1500.0), state)
        faded.append(command.hold_nm)
    assert faded[0] == pytest.approx(hold)
    assert faded[-1] == 0.0
    assert faded == sorted(faded, reverse=True)


@pytest.mark.parametrize(
    ("speed", "demand", "direction", "held"),
    [
        (-0.07, 0.0, 1.0, True),
        (-0.07, 0.0, -1.0, False),  # reverse is what is asked for
        (0.07, 0.0, -1.0, True),
        (0.07, 0.0, 1.0, False),
        (-1.6, 0.0, 1.0, False),  # too fast to be a matter of holding
        (-0.07, 1500.0, 1.0, True),
    ],
)
def test_only_rolling_against_the_direction_asked_for_is_held(speed, demand, direction, held):
    _, state = settled(moving(0.0, 0.0, direction), 3)
    assert (whole(moving(speed, demand, direction), state)[0].hold_nm > 0.0) is held


def test_a_held_car_that_moves_off_is_let_go():
    _, state = settled(moving(0.0, 0.0), 3)
    _, state = whole(moving(-0.07, 1500.0), state)
    command, _ = whole(moving(0.07, 1500.0), state)
    assert command.friction_torque_nm == (0.0,) * 4


def braked_unequally(slow, steps, state=None):
    """Braking at 15 m/s with one front wheel slower than the others; what the left one has more, step by step."""
    rolling = 15.0 / RADIUS
    wheels = tuple(0.83 * rolling if i == slow else rolling for i in range(4))
    state = state or settle(measurement(demand=-40e3)).after
    more = []
    for _ in range(steps):
        case = take(measurement(demand=-40e3, wheel_speed_radps=wheels), state)
        state = case.after
        total = [motor + brake for _, motor, brake, *_ in case.wheels()]
        more.append(total[1] - total[0])
    return more, state


@pytest.mark.parametrize(("slow", "side"), [(0, -1.0), (1, 1.0)])
def test_the_yaw_budget_grows_while_it_is_used_and_goes_back_after(slow, side):
    more, state = braked_unequally(slow, 20)
    assert state.front_unequal_s == pytest.approx(side * 0.2)
    assert state.rear_unequal_s == 0.0
    per_nm = (DEFAULT.yaw_speed_mps / 15.0) ** 2 * 2.0 * RADIUS / CAR.front.track_width_m
    assert more[0] == pytest.approx(side * DEFAULT.front_yaw_nm * per_nm)
    assert more[15] - more[10] == pytest.approx(side * 0.05 * DEFAULT.front_yaw_growth_nmps * per_nm)
    wheels = tuple((1.0 if i % 2 else 0.9999) * 15.0 / RADIUS for i in range(4))
    for left_s in (0.1, 0.0):
        for _ in range(10):
            state = take(measurement(demand=-1000.0, wheel_speed_radps=wheels), state).after
        assert state.front_unequal_s == pytest.approx(side * left_s, abs=1e-9)


def test_what_one_side_has_grown_to_is_no_budget_of_the_other():
    more, state = braked_unequally(0, 40)
    assert more[-1] < 1.5 * more[0] < 0.0
    other, state = braked_unequally(1, 10, state)
    assert max(other) <= -more[0] * (1.0 + 1e-9)
    assert state.front_unequal_s == pytest.approx(-0.3)


def test_the_yaw_budget_is_smaller_the_faster_the_car():
    slow, fast = (settle(measurement(demand=-40e3, speed=speed)).after for speed in (15.0, 30.0))
    differences = []
    for speed, state in ((15.0, slow), (30.0, fast)):
        rolling = speed / RADIUS
        wheels = (0.83 * rolling, rolling, rolling, rolling)
        case = take(measurement(demand=-80e3, speed=speed, wheel_speed_radps=wheels), state)
        total = [motor + brake for _, motor, brake, *_ in case.wheels()]
        differences.append(total[0] - total[1])
    assert differences[0] == pytest.approx(4.0 * differences[1])


def test_driving_unequally_gives_the_brakes_no_budget():
    rolling = 15.0 / RADIUS
    state = settle(measurement(demand=8e3)).after
    for _ in range(10):
        split = measurement(demand=8e3, wheel_speed_radps=(1.3 * rolling, rolling, rolling, rolling))
        state = take(split, state).after
    assert state.front_unequal_s == 0.0


def test_below_walking_pace_no_brake_is_gated():
    m = measurement(speed=0.9, demand=-3000.0, wheel_speed_radps=(0.0,) * 4)
    assert take(m).command.gated_wheels == 0
    assert take(m._replace(speed_mps=1.1)).command.gated_wheels == 15


@pytest.mark.parametrize("travel", [1.0, -1.0])
def test_a_shift_of_torque_counts_as_torque_that_was_applied(travel):
    """Of inputs that are late: forwards positive, whichever way the car travels."""
    before = initial_state()._replace(steps=5, travel=travel)
    shift = (10.0, -20.0, 30.0, -40.0)
    wheels = [wheel._replace(total_nm=-50.0, speed_radps=30.0) for wheel in before.wheels]
    shifted = [wheel._replace(total_nm=-50.0 + travel * nm) for wheel, nm in zip(wheels, shift, strict=True)]
    m = moving(travel * 10.0, -20e3, travel)
    found = whole(m._replace(torque_shift_nm=shift), before._replace(wheels=tuple(wheels)))
    assert found == whole(m, before._replace(wheels=tuple(shifted)))
    assert found != whole(m, before._replace(wheels=tuple(wheels)))
