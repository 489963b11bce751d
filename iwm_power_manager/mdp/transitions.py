"""What one decision step costs and where it leads: the physics of the optimisation problem.

`step_cost_and_next` is the one kernel that the solver tabulates and that a one-step lookahead calls at run time. It
holds no physics of its own: gate (Table 2), torque conversion and limits (eq. 16-20, 40-43) and the vehicle's motion
(eq. 1-11) come from `actuation` and `model`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iwm_power_manager.grid import locate
from iwm_power_manager.jit import kernel, parallel_kernel
from iwm_power_manager.mdp.policy_iteration import Model, list_cells
from iwm_power_manager.mdp.problem import (
    ERROR_LAGRANGE,
    ERROR_SQUARED,
    POWER_ERROR_WHEEL,
    SKID_BOTH,
    SKID_NONE,
    SLIP_QUASI_STEADY,
    Problem,
    ProblemParams,
)
from iwm_power_manager.mdp.threads import over_ranges
from iwm_power_manager.model.battery import chemical_power_w
from iwm_power_manager.model.chassis import equivalent_mass_kg, road_load_n
from iwm_power_manager.model.gate import axle_gated, gated_split
from iwm_power_manager.model.limits import battery_scale, car_power_w
from iwm_power_manager.model.longitudinal import step
from iwm_power_manager.model.motor import idle_drag_nm, torque_limit_nm
from iwm_power_manager.model.quasi_steady import demand_force_n, split_power_w
from iwm_power_manager.model.torque import blend, conversion_speed_radps
from iwm_power_manager.model.tyre import slip_ratio
from iwm_power_manager.vehicle import VehicleParams

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
def wheel_speed_of_state(slip: float, speed_mps: float, vehicle: VehicleParams) -> float:
    """Wheel speed, rad/s, at a slip as `tyre.slip_ratio` defines it, its floor at rest included."""
    floor = vehicle.tyre.slip_speed_floor_mps
    if slip > 0.0:
        bounded = min(slip, SPINNING_SLIP)
        rim = speed_mps / (1.0 - bounded)
        if rim < floor:
            rim = speed_mps + bounded * floor
    else:
        rim = max(speed_mps + slip * max(speed_mps, floor), 0.0)
    return rim / vehicle.wheel.radius_m


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
        return _quasi_steady_step(power_demand_w, speed_mps, front_share, vehicle, problem)
    return _dynamic_step(power_demand_w, speed_mps, slip_front, slip_rear, front_share, vehicle, problem)


@kernel
def _axle_torque(
    power_w: float, wheel_speed_radps: float, speed_mps: float, vehicle: VehicleParams, problem: ProblemParams
) -> tuple[float, float, float]:
    """Motor and friction torque of one wheel for its axle's power, and the axle's power beyond the motor's limit."""
    conversion = conversion_speed_radps(wheel_speed_radps, speed_mps, problem.critical_slip, vehicle)
    torque = 0.5 * power_w / conversion
    if torque > 0.0:
        limit = torque_limit_nm(wheel_speed_radps, 0.0, vehicle.motor)
        if torque > limit:
            return limit, 0.0, 2.0 * (torque - limit) * conversion
        return torque, 0.0, 0.0
    motor, friction = blend(torque, wheel_speed_radps, speed_mps, 0.0, vehicle)
    return motor, max(friction, -vehicle.friction_brake.max_torque_nm), 0.0


@kernel
def _dynamic_step(
    power_demand_w: float,
    speed_mps: float,
    slip_front: float,
    slip_rear: float,
    front_share: float,
    vehicle: VehicleParams,
    problem: ProblemParams,
) -> Step:
    radius = vehicle.wheel.radius_m
    motor = vehicle.motor
    battery = vehicle.battery
    dt = problem.dt_s
    gate_front, gate_rear = axles_gated(power_demand_w, slip_front, slip_rear, problem)
    power_front, power_rear = gated_split(power_demand_w, front_share, gate_front, gate_rear)
    front_speed = wheel_speed_of_state(slip_front, speed_mps, vehicle)
    rear_speed = wheel_speed_of_state(slip_rear, speed_mps, vehicle)

    front_motor, front_friction, front_short = _axle_torque(power_front, front_speed, speed_mps, vehicle, problem)
    rear_motor, rear_friction, rear_short = _axle_torque(power_rear, rear_speed, speed_mps, vehicle, problem)
    shortfall = front_short + rear_short
    scale = battery_scale(
        front_motor, rear_motor, front_speed, rear_speed, battery.discharge_limit_w, battery.charge_limit_w, motor
    )
    if scale < 1.0:
        cut_front = (1.0 - scale) * front_motor
        cut_rear = (1.0 - scale) * rear_motor
        front_motor -= cut_front
        rear_motor -= cut_rear
        if power_demand_w < 0.0:
            front_friction = max(front_friction + cut_front, -vehicle.friction_brake.max_torque_nm)
            rear_friction = max(rear_friction + cut_rear, -vehicle.friction_brake.max_torque_nm)
        else:
            shortfall += 2.0 * (cut_front * front_speed + cut_rear * rear_speed)

    drag_front = idle_drag_nm(front_motor, front_speed, motor)
    drag_rear = idle_drag_nm(rear_motor, rear_speed, motor)
    resisting_front = drag_front - front_friction
    resisting_rear = drag_rear - rear_friction
    motion = step(
        speed_mps,
        (front_speed, front_speed, rear_speed, rear_speed),
        0.0,
        (front_motor, front_motor, rear_motor, rear_motor),
        (resisting_front, resisting_front, resisting_rear, resisting_rear),
        0.0,
        (problem.friction, problem.friction, problem.friction, problem.friction),
        dt,
        vehicle,
    )
    # Constant torques and forces over the step: their work is exact with the mean of the speeds before and after it.
    front_mean = 0.5 * (front_speed + motion.wheel_speed_radps[0])
    rear_mean = 0.5 * (rear_speed + motion.wheel_speed_radps[2])
    speed_mean = 0.5 * (speed_mps + motion.speed_mps)
    electrical = car_power_w(front_motor, rear_motor, front_mean, rear_mean, motor)
    if problem.power_error == POWER_ERROR_WHEEL:
        front_brake = max(motion.resisting_torque_nm[0] - drag_front, 0.0)
        rear_brake = max(motion.resisting_torque_nm[2] - drag_rear, 0.0)
        delivered = 2.0 * ((front_motor - front_brake) * front_mean + (rear_motor - rear_brake) * rear_mean)
    else:
        # Work of the tyres on the car, plus what the inertia of rolling wheels takes: without slip, this is exactly
        # the power at the wheels.
        inertia_force = (equivalent_mass_kg(vehicle) - vehicle.chassis.mass_kg) * (motion.speed_mps - speed_mps) / dt
        delivered = (2.0 * (motion.tyre_force_n[0] + motion.tyre_force_n[2]) + inertia_force) * speed_mean
    floor = vehicle.tyre.slip_speed_floor_mps
    return Step(
        chemical_power_w(electrical, battery) * dt + error_cost_j(power_demand_w, delivered, problem),
        motion.speed_mps,
        slip_ratio(motion.wheel_speed_radps[0], motion.speed_mps, radius, floor),
        slip_ratio(motion.wheel_speed_radps[2], motion.speed_mps, radius, floor),
        shortfall,
    )


@kernel
def _quasi_steady_step(
    power_demand_w: float, speed_mps: float, front_share: float, vehicle: VehicleParams, problem: ProblemParams
) -> Step:
    battery = vehicle.battery
    dt = problem.dt_s
    force = demand_force_n(power_demand_w, speed_mps, problem.friction, True, vehicle)
    power, missing = split_power_w(force, speed_mps, front_share, problem.friction, True, vehicle)
    shortfall = 0.0
    if power_demand_w > 0.0:
        shortfall = missing * speed_mps + max(power - chemical_power_w(battery.discharge_limit_w, battery), 0.0)
        given = force - missing
    else:
        power = max(power, chemical_power_w(-battery.charge_limit_w, battery))
        given = force + missing
    resistance = road_load_n(speed_mps, 0.0, vehicle.chassis)
    after = max(speed_mps + dt * (given - resistance) / equivalent_mass_kg(vehicle), 0.0)
    # What is missing at rest still counts: a car that cannot pull away has not delivered its demand.
    rolling = max(speed_mps, vehicle.driver.power_speed_floor_mps)
    error = error_cost_j(force * rolling, given * rolling, problem)
    return Step(power * dt + error, after, 0.0, 0.0, shortfall)


@kernel
def _mark_gated(power_w, slip_front, slip_rear, n_speed, problem, gated):
    n_f, n_r = slip_front.size, slip_rear.size
    for p in range(power_w.size):
        for f in range(n_f):
            for r in range(n_r):
                front, rear = axles_gated(power_w[p], slip_front[f], slip_rear[r], problem)
                for v in range(n_speed):
                    gated[p, (v * n_f + f) * n_r + r] = front or rear


@kernel
def _store(outcome, i, speed_mps, slip_front, slip_rear, cost, corner, fraction):
    a, fa = locate(speed_mps, outcome.speed_mps)
    b, fb = locate(slip_front, outcome.slip_front)
    c, fc = locate(slip_rear, outcome.slip_rear)
    cost[i] = outcome.cost_j
    corner[i] = (a * slip_front.size + b) * slip_rear.size + c
    fraction[i, 0] = fa
    fraction[i, 1] = fb
    fraction[i, 2] = fc


@parallel_kernel
def _fill_free(
    power_w,
    speed_mps,
    slip_front,
    slip_rear,
    share,
    vehicle,
    problem,
    start,
    cell,
    first_state,
    last_state,
    cost,
    corner,
    fraction,
):
    n_u = share.size
    plane = slip_front.size * slip_rear.size
    shortfall = np.empty(n_u)
    for state in range(first_state, last_state):
        p = np.searchsorted(start, state, side="right") - 1
        first = start[p]
        n = start[p + 1] - first
        c = cell[state]
        v = speed_mps[c // plane]
        f = slip_front[c // slip_rear.size % slip_front.size]
        r = slip_rear[c % slip_rear.size]
        least = np.inf
        for u in range(n_u):
            i = first * n_u + u * n + state - first
            outcome = step_cost_and_next(power_w[p], v, f, r, share[u], vehicle, problem)
            _store(outcome, i, speed_mps, slip_front, slip_rear, cost, corner, fraction)
            shortfall[u] = outcome.shortfall_w
            least = min(least, outcome.shortfall_w)
        # Feasible controls have no shortfall; where none is feasible, those that deliver most are left.
        for u in range(n_u):
            if shortfall[u] > least + 1e-6:
                cost[first * n_u + u * n + state - first] = np.inf


@parallel_kernel
def _fill_gated(
    power_w,
    speed_mps,
    slip_front,
    slip_rear,
    vehicle,
    problem,
    start,
    cell,
    first_state,
    last_state,
    cost,
    corner,
    fraction,
):
    plane = slip_front.size * slip_rear.size
    for state in range(first_state, last_state):
        p = np.searchsorted(start, state, side="right") - 1
        c = cell[state]
        v = speed_mps[c // plane]
        f = slip_front[c // slip_rear.size % slip_front.size]
        r = slip_rear[c % slip_rear.size]
        outcome = step_cost_and_next(power_w[p], v, f, r, 0.5, vehicle, problem)
        _store(outcome, state, speed_mps, slip_front, slip_rear, cost, corner, fraction)


def gated_states(problem: Problem, friction: float) -> NDArray[np.bool_]:
    """bool[P, C]: states in which skid avoidance leaves no choice."""
    cells = problem.speed_mps.size * problem.slip_front.size * problem.slip_rear.size
    gated = np.zeros((problem.power_w.size, cells), dtype=np.bool_)
    _mark_gated(
        problem.power_w, problem.slip_front, problem.slip_rear, problem.speed_mps.size, problem.params(friction), gated
    )
    return gated


def build_model(problem: Problem, vehicle: VehicleParams, friction: float, demand: NDArray[np.float64]) -> Model:
    """Tabulate cost and next state of every state and control.

    Parameters
    ----------
    problem : grids and settings
    vehicle : the car
    friction : peak friction coefficient of the road
    demand : float64[G, P, P], `DemandChain.matrix` over `problem.power_w`
    """
    params = problem.params(friction)
    axes = (problem.power_w, problem.speed_mps, problem.slip_front, problem.slip_rear)
    no_choice = gated_states(problem, friction)
    free_start, free_cell = list_cells(~no_choice)
    gated_start, gated_cell = list_cells(no_choice)

    def empty(n: int) -> tuple[NDArray[np.float64], NDArray[np.int32], NDArray[np.float64]]:
        return np.empty(n), np.empty(n, np.int32), np.empty((n, 3))

    free = empty(free_cell.size * problem.share.size)
    over_ranges(
        free_cell.size,
        lambda first, last: _fill_free(
            *axes, problem.share, vehicle, params, free_start, free_cell, first, last, *free
        ),
    )
    gated = empty(gated_cell.size)
    over_ranges(
        gated_cell.size,
        lambda first, last: _fill_gated(*axes, vehicle, params, gated_start, gated_cell, first, last, *gated),
    )
    return Model(
        problem.discount,
        np.ascontiguousarray(demand, dtype=np.float64),
        (problem.speed_mps.size, problem.slip_front.size, problem.slip_rear.size),
        problem.switching_cost(),
        free_start,
        free_cell,
        *free,
        gated_start,
        gated_cell,
        *gated,
    )
