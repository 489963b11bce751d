# SPDX-License-Identifier: Apache-2.0
"""One decision: what it costs and where it leads. The physics of the optimisation problem.

`step_cost_and_next` is the one kernel that the solver tabulates and that a one-step lookahead calls at run time. It
holds no physics of its own: gate (Table 2), torque conversion and limits (eq. 16-20, 40-43) and the vehicle's motion
(eq. 1-11) are `model`'s.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from iwm_power_manager.jit import kernel
from iwm_power_manager.model.battery import chemical_power_w
from iwm_power_manager.model.chassis import GRAVITY_MPS2, equivalent_mass_kg, road_load_n
from iwm_power_manager.model.gate import axle_gated, gated_split
from iwm_power_manager.model.limits import wheels_power_w, wheels_scale
from iwm_power_manager.model.longitudinal import Moved, Speeds, Torques
from iwm_power_manager.model.motor import idle_drag_nm, torque_limit_nm
from iwm_power_manager.model.parameters import Axle, VehicleParams
from iwm_power_manager.model.quasi_steady import (
    USABLE_FRICTION,
    Axles,
    axles_of,
    demand_force_n,
    demand_slip,
    split_outcome_w,
)
from iwm_power_manager.model.torque import blend, conversion_speed_radps
from iwm_power_manager.model.two_axles import UNSURE, Curve, step_from
from iwm_power_manager.model.tyre import peak_ratio, slip_ratio

#: Where the delivered power is measured: torque times speed at the wheel (sees no power lost in slip), or at the

#: road, where it moves the car.
POWER_ERROR_WHEEL, POWER_ERROR_ROAD = range(2)
POWER_ERRORS = {"wheel": POWER_ERROR_WHEEL, "road": POWER_ERROR_ROAD}

#: What an error e (W, demanded minus delivered) costs per second, in W:

#: squared alpha * e^2 / 1 kW; absolute alpha * |e|; lagrange alpha * e towards the demand, so that a surplus is

#: credited: the multiplier of "deliver the demand on average".
ERROR_SQUARED, ERROR_ABSOLUTE, ERROR_LAGRANGE = range(3)
ERROR_NORMS = {"squared": ERROR_SQUARED, "absolute": ERROR_ABSOLUTE, "lagrange": ERROR_LAGRANGE}

#: dynamic: slip is a state and obeys wheel rotation (eq. 11). quasi_steady: slip settles within a step at the value

#: that carries the axle's force; slip is no state then.
SLIP_DYNAMIC, SLIP_QUASI_STEADY = range(2)
SLIP_MODELS = {"dynamic": SLIP_DYNAMIC, "quasi_steady": SLIP_QUASI_STEADY}

#: Skid avoidance inside the problem (Table 2): none; an axle beyond the critical slip in braking gets no power;

#: or in driving as well.
SKID_NONE, SKID_BRAKING, SKID_BOTH = range(3)
SKID_AVOIDANCE = {"none": SKID_NONE, "braking": SKID_BRAKING, "both": SKID_BOTH}


class ProblemParams(NamedTuple):
    """What the kernels need to know of the problem; all SI.

    Attributes
    ----------
    dt_s : length of a decision step
    friction : peak friction coefficient of the road
    alpha : price of undelivered energy, J per J (squared: at an error of 1 kW)
    power_error : POWER_ERROR_*
    error_norm : ERROR_*
    slip_model : SLIP_*
    skid_avoidance : SKID_*
    critical_slip : magnitude of slip beyond which an axle is gated
    """

    dt_s: float
    friction: float
    alpha: float
    power_error: int
    error_norm: int
    slip_model: int
    skid_avoidance: int
    critical_slip: float


#: What an axle is asked for beyond its grip goes to the other one, but only once its wheels have begun to slip and the
#: slip limiter has answered: for its time constant, s, that power spins wheels. It is what tells apart the shares that
#: saturate both axles, which are all alike in the settled model.
HANDOVER_S = 0.025

#: A slip of 1 would be an infinite wheel speed; the state "spinning" stands for this one.
SPINNING_SLIP = 0.95


class Step(NamedTuple):
    """Outcome of one decision step.

    Attributes
    ----------
    cost_j : battery energy plus price of the power error, J; without switching cost
    speed_mps, slip_front, slip_rear : at the end of the step
    shortfall_w : part of the demand that limits of motors or battery kept from the wheels; 0 if the control is feasible
    """

    cost_j: float
    speed_mps: float
    slip_front: float
    slip_rear: float
    shortfall_w: float


@kernel
def axles_gated(power_w: float, slip_front: float, slip_rear: float, problem: ProblemParams) -> tuple[bool, bool]:
    """Which axles Table 2 holds at zero power in this state."""
    if problem.skid_avoidance == SKID_NONE:
        return False, False
    driving = problem.skid_avoidance == SKID_BOTH
    return (
        axle_gated(slip_front, power_w, False, problem.critical_slip, 0.0, driving),
        axle_gated(slip_rear, power_w, False, problem.critical_slip, 0.0, driving),
    )


@kernel
def wheel_speed_of_state(slip: float, speed_mps: float, axle: Axle) -> float:
    """Wheel speed, rad/s, at a slip as `tyre.slip_ratio` defines it, its floor at rest included."""
    floor = axle.tyre.slip_speed_floor_mps
    if slip > 0.0:
        bounded = min(slip, SPINNING_SLIP)
        rim = speed_mps / (1.0 - bounded)
        if rim < floor:
            rim = speed_mps + bounded * floor
    else:
        rim = max(speed_mps + slip * max(speed_mps, floor), 0.0)
    return rim / axle.wheel.radius_m


@kernel
def error_cost_j(power_demand_w: float, delivered_w: float, problem: ProblemParams) -> float:
    """Price of the difference between demand and delivered power during a step, J (alpha * M in eq. 28)."""
    error = power_demand_w - delivered_w
    if problem.error_norm == ERROR_SQUARED:
        rate = error * error / 1000.0
    elif problem.error_norm == ERROR_LAGRANGE:
        rate = error if power_demand_w >= 0.0 else -error
    else:
        rate = abs(error)
    return problem.alpha * rate * problem.dt_s


@kernel
def step_cost_and_next(
    power_demand_w: float,
    speed_mps: float,
    slip_front: float,
    slip_rear: float,
    front_share: float,
    vehicle: VehicleParams,
    problem: ProblemParams,
) -> Step:
    """One decision step of `problem.dt_s` at a state under a front share.

    An axle beyond the critical slip is gated first, whatever the share. Limits bind after that: what they cut off is
    `shortfall_w`. Braking is never short: what regeneration cannot take, friction does.
    """
    if problem.slip_model == SLIP_QUASI_STEADY:
        before = settled(power_demand_w, speed_mps, True, vehicle, problem)
        return settled_step(before, power_demand_w, speed_mps, front_share, True, False, vehicle, problem)
    start = given(power_demand_w, speed_mps, slip_front, slip_rear, front_share, vehicle, problem)
    moved = step_from(start.before, start.torques, start.before, problem.friction, UNSURE, problem.dt_s, vehicle)
    return outcome_of(power_demand_w, start, moved, vehicle, problem)


@kernel
def step_near(
    power_demand_w: float,
    speed_mps: float,
    slip_front: float,
    slip_rear: float,
    front_share: float,
    guess: Speeds,
    curves: tuple[Curve, Curve],
    vehicle: VehicleParams,
    problem: ProblemParams,
) -> tuple[Step, Speeds]:
    """`step_cost_and_next` where the speeds at its end are known nearly, and these speeds.

    `guess` and `curves` : see `two_axles.step_from`; not used where slip is settled.
    """
    if problem.slip_model == SLIP_QUASI_STEADY:
        before = settled(power_demand_w, speed_mps, True, vehicle, problem)
        return settled_step(before, power_demand_w, speed_mps, front_share, True, False, vehicle, problem), guess
    start = given(power_demand_w, speed_mps, slip_front, slip_rear, front_share, vehicle, problem)
    moved = step_from(start.before, start.torques, guess, problem.friction, curves, problem.dt_s, vehicle)
    return outcome_of(power_demand_w, start, moved, vehicle, problem), moved.speeds


@kernel
def _axle_torque(
    power_w: float, wheel_speed_radps: float, speed_mps: float, axle: Axle, floor_mps: float, problem: ProblemParams
) -> tuple[float, float, float]:
    """Motor and friction torque of one wheel for its axle's power, and the axle's power beyond the motor's limit."""
    conversion = conversion_speed_radps(
        wheel_speed_radps, speed_mps, problem.critical_slip, axle.wheel.radius_m, floor_mps
    )
    torque = 0.5 * power_w / conversion
    if torque > 0.0:
        limit = torque_limit_nm(wheel_speed_radps, 0.0, axle.motor)
        if torque > limit:
            return limit, 0.0, 2.0 * (torque - limit) * conversion
        return torque, 0.0, 0.0
    motor, friction = blend(torque, wheel_speed_radps, speed_mps, 0.0, 1.0, axle.motor)
    return motor, max(friction, -axle.friction_brake.max_torque_nm), 0.0


class Given(NamedTuple):
    """What a dynamic step starts from, whatever becomes of it: speeds, and what acts on a wheel of each axle, N m.

    `front_drag_nm` and `rear_drag_nm` are the part of the resisting torques that an idle motor drags with.
    """

    before: Speeds
    torques: Torques
    front_drag_nm: float
    rear_drag_nm: float
    shortfall_w: float


@kernel
def given(
    power_demand_w: float,
    speed_mps: float,
    slip_front: float,
    slip_rear: float,
    front_share: float,
    vehicle: VehicleParams,
    problem: ProblemParams,
) -> Given:
    """Torques of a dynamic step at a state under a front share, after gate and limits."""
    battery = vehicle.battery
    floor = vehicle.driver.power_speed_floor_mps
    gated = axles_gated(power_demand_w, slip_front, slip_rear, problem)
    power_front, power_rear = gated_split(power_demand_w, front_share, gated)
    front_speed = wheel_speed_of_state(slip_front, speed_mps, vehicle.front)
    rear_speed = wheel_speed_of_state(slip_rear, speed_mps, vehicle.rear)

    front_motor, front_friction, front_short = _axle_torque(
        power_front, front_speed, speed_mps, vehicle.front, floor, problem
    )
    rear_motor, rear_friction, rear_short = _axle_torque(
        power_rear, rear_speed, speed_mps, vehicle.rear, floor, problem
    )
    shortfall = front_short + rear_short
    scale = wheels_scale(
        (front_motor, front_motor, rear_motor, rear_motor),
        (front_speed, front_speed, rear_speed, rear_speed),
        battery.discharge_limit_w,
        battery.charge_limit_w,
        vehicle,
    )
    if scale < 1.0:
        cut_front = (1.0 - scale) * front_motor
        cut_rear = (1.0 - scale) * rear_motor
        front_motor -= cut_front
        rear_motor -= cut_rear
        if power_demand_w < 0.0:
            front_friction = max(front_friction + cut_front, -vehicle.front.friction_brake.max_torque_nm)
            rear_friction = max(rear_friction + cut_rear, -vehicle.rear.friction_brake.max_torque_nm)
        else:
            shortfall += 2.0 * (cut_front * front_speed + cut_rear * rear_speed)

    drag_front = idle_drag_nm(front_motor, front_speed, vehicle.front.motor)
    drag_rear = idle_drag_nm(rear_motor, rear_speed, vehicle.rear.motor)
    torques = Torques(front_motor, rear_motor, drag_front - front_friction, drag_rear - rear_friction)
    return Given(Speeds(speed_mps, front_speed, rear_speed), torques, drag_front, drag_rear, shortfall)


@kernel
def outcome_of(
    power_demand_w: float, start: Given, moved: Moved, vehicle: VehicleParams, problem: ProblemParams
) -> Step:
    """Cost and next state of a dynamic step from what it started with and how car and wheels moved."""
    dt = problem.dt_s
    before, after = start.before, moved.speeds
    front_motor, rear_motor = start.torques.front_motor_nm, start.torques.rear_motor_nm
    # Constant torques and forces over the step: their work is exact with the mean of the speeds before and after it.
    front_mean = 0.5 * (before.front_radps + after.front_radps)
    rear_mean = 0.5 * (before.rear_radps + after.rear_radps)
    speed_mean = 0.5 * (before.car_mps + after.car_mps)
    electrical = wheels_power_w(
        (front_motor, front_motor, rear_motor, rear_motor),
        (front_mean, front_mean, rear_mean, rear_mean),
        1.0,
        vehicle,
    )
    if problem.power_error == POWER_ERROR_WHEEL:
        front_brake = max(moved.front_resisting_nm - start.front_drag_nm, 0.0)
        rear_brake = max(moved.rear_resisting_nm - start.rear_drag_nm, 0.0)
        delivered = 2.0 * ((front_motor - front_brake) * front_mean + (rear_motor - rear_brake) * rear_mean)
    else:
        # Work of the tyres on the car, plus what the inertia of rolling wheels takes: without slip, this is exactly
        # the power at the wheels.
        turning_kg = equivalent_mass_kg(vehicle) - vehicle.chassis.mass_kg
        inertia_force = turning_kg * (after.car_mps - before.car_mps) / dt
        delivered = (2.0 * (moved.front_force_n + moved.rear_force_n) + inertia_force) * speed_mean
    front, rear = vehicle.front, vehicle.rear
    return Step(
        chemical_power_w(electrical, vehicle.battery) * dt + error_cost_j(power_demand_w, delivered, problem),
        after.car_mps,
        slip_ratio(after.front_radps, after.car_mps, front.wheel.radius_m, front.tyre.slip_speed_floor_mps),
        slip_ratio(after.rear_radps, after.car_mps, rear.wheel.radius_m, rear.tyre.slip_speed_floor_mps),
        start.shortfall_w,
    )


class Settled(NamedTuple):
    """What a step with settled slip comes to, whatever the share.

    Attributes
    ----------
    force_n : road force the demand stands for
    axles : what the car has for it
    speed_mps : at the end of the step
    """

    force_n: float
    axles: Axles
    speed_mps: float


@kernel
def _usable_grip_n(vehicle: VehicleParams, problem: ProblemParams) -> float:
    """Road force that the car's tyres carry, N; those of the better axle count for all."""
    weight = vehicle.chassis.mass_kg * GRAVITY_MPS2
    return (
        USABLE_FRICTION * problem.friction * max(peak_ratio(vehicle.front.tyre), peak_ratio(vehicle.rear.tyre)) * weight
    )


@kernel
def settled(
    power_demand_w: float, speed_mps: float, slip_aware: bool, vehicle: VehicleParams, problem: ProblemParams
) -> Settled:
    """A step of a demand at a speed, before it is split; not `slip_aware`, as if no wheel slipped."""
    force = demand_force_n(power_demand_w, speed_mps, problem.friction, slip_aware, vehicle)
    # A driver makes up for what a split did not deliver: the speed follows what was asked for, as far as the road can
    # carry it. Would it follow what was delivered, then braking less than was asked for would leave a higher speed, at
    # which the same power is less force, and less of it were missing: a policy would be rewarded for not braking.
    grip = _usable_grip_n(vehicle, problem)
    resistance = road_load_n(speed_mps, 0.0, vehicle.chassis)
    acceleration = (min(max(force, -grip), grip) - resistance) / equivalent_mass_kg(vehicle)
    after = max(speed_mps + problem.dt_s * acceleration, 0.0)
    return Settled(force, axles_of(force, speed_mps, problem.friction, slip_aware, vehicle), after)


@kernel
def settled_step(
    before: Settled,
    power_demand_w: float,
    speed_mps: float,
    front_share: float,
    slip_aware: bool,
    least: bool,
    vehicle: VehicleParams,
    problem: ProblemParams,
) -> Step:
    """`step_cost_and_next` with settled slip, from what `settled` says of the same demand and speed.

    Where a bound of the cost will do, never larger but for rounding, `least` spares solving for the slip.
    """
    battery, force = vehicle.battery, before.force_n
    power, missing, over = split_outcome_w(
        before.axles, force, speed_mps, front_share, problem.friction, slip_aware, least, vehicle
    )
    shortfall = 0.0
    if power_demand_w > 0.0:
        shortfall = missing * speed_mps + max(power - chemical_power_w(battery.discharge_limit_w, battery), 0.0)
        given = force - missing
    else:
        power = max(power, chemical_power_w(-battery.charge_limit_w, battery))
        given = force + missing
    # What is missing at rest still counts: a car that cannot pull away has not delivered its demand.
    rolling = max(speed_mps, vehicle.driver.power_speed_floor_mps)
    error = error_cost_j(force * rolling, given * rolling, problem)
    cost = power * problem.dt_s + error + over * rolling * HANDOVER_S
    return Step(cost, before.speed_mps, 0.0, 0.0, shortfall)


@kernel
def slip_followed(
    force_n: float, speed_mps: float, held_s: float, vehicle: VehicleParams, problem: ProblemParams
) -> float:
    """Part of the slip of a road force, 0..1, that wheels reach on average while it is held for `held_s`.

    They have to be turned faster, or slower, by the force itself: at a constant one their slip lags behind the settled
    one, s, by m v s / F, with m what their inertia stands for (docs/solver.md). That is hundredths of a second on a dry
    road, and a tenth near the grip of an icy one. Beyond the grip the slip limiter holds it, whatever is asked for.
    """
    if force_n == 0.0 or abs(force_n) >= _usable_grip_n(vehicle, problem):
        return 1.0
    inertia_kg = equivalent_mass_kg(vehicle) - vehicle.chassis.mass_kg
    lag_s = inertia_kg * speed_mps * demand_slip(force_n, problem.friction, vehicle) / force_n
    if lag_s <= 0.0:
        return 1.0
    return 1.0 - lag_s / held_s * (1.0 - math.exp(-held_s / lag_s))
