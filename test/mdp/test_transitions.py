# SPDX-License-Identifier: Apache-2.0
"""The step kernel against plain Python, its limits, and the tables made from it."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iwm_power_manager.mdp.problem import load_problem
from iwm_power_manager.mdp.transitions import build_model, gated_states
from iwm_power_manager.model.decision import (
    ERROR_NORMS,
    axles_gated,
    error_cost_j,
    slip_followed,
    step_cost_and_next,
    wheel_speed_of_state,
)
from iwm_power_manager.model.quasi_steady import demand_force_n, split_power_w
from iwm_power_manager.model.tyre import friction_coefficient, slip_at_friction, slip_ratio
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle
from oracles import step as oracle

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml"), "drag")
PAPER = load_problem(share_path("config/grids/paper.yaml"))
FINE = load_problem(share_path("config/grids/fine.yaml"))


def _params(problem=FINE, friction=0.9, **changes):
    return dataclasses.replace(problem, **changes).params(friction)


@pytest.mark.parametrize("idle_drive", ["none", "drag", "enabled"])
@pytest.mark.parametrize("power_error", ["wheel", "road"])
def test_a_step_solves_the_equations_of_the_paper(idle_drive, power_error):
    vehicle = load_vehicle(CAR.path, idle_drive).params
    cases = itertools.product(
        (-6000.0, -500.0, 800.0, 7000.0), (6.0, 20.0), (0.0, 0.5, 0.8), ((0.0, 0.0), (0.01, -0.02))
    )
    params = _params(power_error=power_error, error_norm="absolute", skid_avoidance="none")
    for power, speed, share, slips in cases:
        ours = step_cost_and_next(power, speed, *slips, share, vehicle, params)
        energy, after, slip, at_wheel, at_road = oracle.dynamic_step(power, speed, slips, share, vehicle, params)
        delivered = at_wheel if power_error == "wheel" else at_road
        assert ours.shortfall_w == 0.0
        assert ours.speed_mps == pytest.approx(after, rel=1e-8)
        assert (ours.slip_front, ours.slip_rear) == pytest.approx(tuple(slip), abs=1e-7)
        cost = energy + params.alpha * abs(power - delivered) * params.dt_s
        assert ours.cost_j == pytest.approx(cost, rel=1e-6, abs=1e-4)


def test_without_slip_the_power_at_the_road_is_the_power_at_the_wheels():
    vehicle = load_vehicle(CAR.path, "none").params

    def lost_j(stiffness):
        tyre = vehicle.front.tyre
        car = vehicle.with_axles(tyre=tyre._replace(coefficients=(stiffness, *tyre.coefficients[1:])))
        params = [_params(power_error=where, error_norm="lagrange", alpha=1.0) for where in ("road", "wheel")]
        road, wheel = (step_cost_and_next(5000.0, 15.0, 0.0, 0.0, 0.5, car, p).cost_j for p in params)
        return road - wheel

    # Slip falls with stiffness, and with it the only difference between the two.
    assert lost_j(10.0) > 4.0
    assert lost_j(100.0) == pytest.approx(lost_j(10.0) / 10.0, rel=0.2)


@pytest.mark.parametrize(
    ("norm", "over", "under"),
    [("squared", 8.0, 8.0), ("absolute", 4.0, 4.0), ("lagrange", -4.0, 4.0)],
)
def test_the_error_costs_what_its_norm_says(norm, over, under):
    params = _params(error_norm=norm, alpha=0.02, dt_s=0.1)
    assert set(ERROR_NORMS) == {"squared", "absolute", "lagrange"}
    assert error_cost_j(5000.0, 7000.0, params) == pytest.approx(over)
    assert error_cost_j(5000.0, 3000.0, params) == pytest.approx(under)
    # Braking too little is as short as driving too little.
    assert error_cost_j(-5000.0, -3000.0, params) == pytest.approx(under)


def test_a_motor_asked_for_more_than_its_torque_is_short():
    params = _params()
    # 4 kW on one axle at 2 m/s is 330 N m a wheel; the peak is 200 N m.
    alone = step_cost_and_next(4000.0, 2.0, 0.0, 0.0, 1.0, CAR.params, params)
    halved = step_cost_and_next(4000.0, 2.0, 0.0, 0.0, 0.5, CAR.params, params)
    assert alone.shortfall_w == pytest.approx(2.0 * (2000.0 * 0.33 / 2.0 - 200.0) * 2.0 / 0.33, rel=1e-9)
    assert halved.shortfall_w == 0.0
    assert halved.speed_mps > alone.speed_mps


def test_braking_is_never_short_because_friction_makes_up_the_rest():
    params = _params()
    for share in (0.0, 0.5, 1.0):
        hard = step_cost_and_next(-12000.0, 12.0, 0.0, 0.0, share, CAR.params, params)
        assert hard.shortfall_w == 0.0
        assert hard.speed_mps < 12.0 - 0.1 * 0.8


def test_a_small_battery_limits_driving_and_leaves_braking_to_friction():
    params = _params()
    small = CAR.params._replace(battery=CAR.params.battery._replace(discharge_limit_w=3000.0, charge_limit_w=1000.0))
    drive = step_cost_and_next(8000.0, 12.0, 0.0, 0.0, 0.5, small, params)
    assert drive.shortfall_w == pytest.approx(5000.0, rel=0.15)
    free = step_cost_and_next(-6000.0, 12.0, 0.0, 0.0, 0.5, CAR.params, params)
    brake = step_cost_and_next(-6000.0, 12.0, 0.0, 0.0, 0.5, small, params)
    assert brake.shortfall_w == 0.0
    assert brake.speed_mps == pytest.approx(free.speed_mps, abs=1e-9)
    assert brake.cost_j > free.cost_j


@pytest.mark.parametrize(
    ("skid", "power", "slips", "gated"),
    [
        ("braking", -5000.0, (-0.21, 0.0), (True, False)),
        ("braking", -5000.0, (0.0, -0.5), (False, True)),
        ("braking", -5000.0, (-0.3, -0.3), (True, True)),
        ("braking", -5000.0, (-0.2, -0.1), (False, False)),
        ("braking", 5000.0, (0.5, -0.5), (False, False)),
        ("both", 5000.0, (0.5, 0.0), (True, False)),
        ("none", -5000.0, (-1.0, -1.0), (False, False)),
    ],
)
def test_table_2_decides_which_axles_are_gated(skid, power, slips, gated):
    params = _params(skid_avoidance=skid, critical_slip=0.2)
    assert axles_gated(power, *slips, params) == gated


def test_a_gated_axle_gets_nothing_and_the_share_does_not_matter():
    params = _params(skid_avoidance="braking")
    locked_front = [
        step_cost_and_next(-4000.0, 15.0, -0.35, 0.0, share, CAR.params, params) for share in (0.0, 0.4, 1.0)
    ]
    assert locked_front[0] == locked_front[1] == locked_front[2]
    # The freed wheel spins up again within the step; the other axle brakes alone.
    assert locked_front[0].slip_front > -0.02
    assert locked_front[0].slip_rear < 0.0
    both = step_cost_and_next(-4000.0, 15.0, -0.35, -0.35, 0.5, CAR.params, params)
    assert min(both.slip_front, both.slip_rear) > -0.02


@given(st.floats(0.0, 30.0), st.floats(-1.0, 1.0))
def test_a_state_s_wheel_speed_has_the_state_s_slip(speed, slip):
    tyre, radius = CAR.params.front.tyre, CAR.params.front.wheel.radius_m
    wheel_speed = wheel_speed_of_state(slip, speed, CAR.params.front)
    assert wheel_speed >= 0.0
    found = slip_ratio(wheel_speed, speed, radius, tyre.slip_speed_floor_mps)
    rolls_backwards = speed + slip * max(speed, tyre.slip_speed_floor_mps) < 0.0
    if not rolls_backwards:
        assert found == pytest.approx(min(slip, 0.95), abs=1e-9)


@settings(max_examples=200)
@given(
    power=st.floats(-30e3, 40e3),
    speed=st.floats(0.0, 40.0),
    front=st.floats(-1.0, 1.0),
    rear=st.floats(-1.0, 1.0),
    share=st.floats(0.0, 1.0),
    friction=st.sampled_from([0.1, 0.2, 0.5, 0.9]),
    slip_model=st.sampled_from(["dynamic", "quasi_steady"]),
)
def test_every_step_is_finite_and_possible(power, speed, front, rear, share, friction, slip_model):
    outcome = step_cost_and_next(
        power, speed, front, rear, share, CAR.params, _params(FINE, friction, slip_model=slip_model)
    )
    assert np.all(np.isfinite(outcome))
    assert outcome.speed_mps >= 0.0
    assert -1.0 <= outcome.slip_front <= 1.0
    assert -1.0 <= outcome.slip_rear <= 1.0
    assert outcome.shortfall_w >= 0.0
    # No car speeds up or slows down faster than its tyres hold; drag and rolling resistance come on top.
    assert abs(outcome.speed_mps - speed) <= 0.1 * (9.81 * (friction + 0.01) + 0.7)


def test_a_quasi_steady_step_costs_what_the_settled_split_draws():
    params = _params(slip_model="quasi_steady", error_norm="absolute")
    force = demand_force_n(6000.0, 12.0, params.friction, True, CAR.params)
    power, missing = split_power_w(force, 12.0, 0.3, params.friction, True, CAR.params)
    outcome = step_cost_and_next(6000.0, 12.0, 0.0, 0.0, 0.3, CAR.params, params)
    assert missing == 0.0
    assert outcome.cost_j == pytest.approx(power * 0.1)
    assert outcome.shortfall_w == 0.0
    gain = (force * 12.0 - (0.5 * 1.2 * 1.66 * 0.34 * 144.0 + 0.01 * 800.0 * 9.81) * 12.0) * 0.1
    inertia = 800.0 + 4.0 * 1.1 / 0.33**2
    assert 0.5 * inertia * (outcome.speed_mps**2 - 144.0) == pytest.approx(gain, rel=0.01)


def test_a_quasi_steady_demand_beyond_the_grip_is_short_and_priced():
    params = _params(friction=0.1, slip_model="quasi_steady", error_norm="absolute")
    outcome = step_cost_and_next(19000.0, 12.0, 0.0, 0.0, 0.5, CAR.params, params)
    assert outcome.shortfall_w > 5000.0
    assert outcome.cost_j > params.alpha * outcome.shortfall_w * params.dt_s


def _tiny(**changes):
    axes = {
        "power_w": np.array([-6000.0, 0.0, 4000.0, 19000.0]),
        "speed_mps": np.array([0.0, 2.0, 12.0]),
        "slip_front": np.array([-0.35, 0.0, 0.1]),
        "slip_rear": np.array([-0.35, 0.0]),
        "share": np.array([0.0, 0.5, 1.0]),
    }
    return dataclasses.replace(FINE, **{**axes, **changes})


def test_the_tables_hold_one_entry_for_every_state_and_control():
    problem = _tiny()
    demand = np.full((1, 4, 4), 0.25)
    model = build_model(problem, CAR.params, 0.5, demand)
    params = problem.params(0.5)
    gated = gated_states(problem, 0.5)
    _, n_f, n_r = model.cell_shape
    for p, power in enumerate(problem.power_w):
        first, last = model.free_start[p : p + 2]
        cells = model.free_cell[first:last]
        assert np.array_equal(cells, np.flatnonzero(~gated[p]))
        for k, cell in enumerate(cells):
            v, f, r = np.unravel_index(cell, model.cell_shape)
            state = (problem.speed_mps[v], problem.slip_front[f], problem.slip_rear[r])
            outcomes = [step_cost_and_next(power, *state, u, CAR.params, params) for u in problem.share]
            least = min(outcome.shortfall_w for outcome in outcomes)
            for u, outcome in enumerate(outcomes):
                i = first * 3 + u * (last - first) + k
                allowed = outcome.shortfall_w <= least + 1e-6
                assert model.free_cost[i] == pytest.approx(outcome.cost_j if allowed else np.inf, rel=1e-6, abs=1e-6)
                a, b, c = np.unravel_index(model.free_corner[i], (3, n_f, n_r))
                place = [
                    axis[j] + t * (axis[j + 1] - axis[j])
                    for axis, j, t in zip(
                        (problem.speed_mps, problem.slip_front, problem.slip_rear),
                        (a, b, c),
                        model.free_fraction[i],
                        strict=True,
                    )
                ]
                clipped = [
                    np.clip(outcome.speed_mps, 0.0, 12.0),
                    np.clip(outcome.slip_front, -0.35, 0.1),
                    np.clip(outcome.slip_rear, -0.35, 0.0),
                ]
                assert place == pytest.approx(clipped, abs=1e-7)


def test_gated_states_hold_the_one_step_that_table_2_leaves():
    problem = _tiny()
    model = build_model(problem, CAR.params, 0.5, np.eye(4)[None])
    assert model.gated_cell.size == np.count_nonzero(gated_states(problem, 0.5))
    assert model.gated_cell.size > 0
    p = 0
    for i in range(model.gated_start[p], model.gated_start[p + 1]):
        v, f, r = np.unravel_index(model.gated_cell[i], model.cell_shape)
        state = (problem.speed_mps[v], problem.slip_front[f], problem.slip_rear[r])
        outcome = step_cost_and_next(problem.power_w[p], *state, 0.9, CAR.params, problem.params(0.5))
        assert model.gated_cost[i] == pytest.approx(outcome.cost_j, rel=1e-6, abs=1e-6)


def test_where_no_control_is_feasible_those_that_deliver_most_are_left():
    # 19 kW at 2 m/s is beyond every split: equal split delivers most.
    problem = _tiny(
        power_w=np.array([19000.0]), speed_mps=np.array([2.0]), slip_front=np.zeros(1), slip_rear=np.zeros(1)
    )
    model = build_model(problem, CAR.params, 0.9, np.eye(1)[None])
    assert np.array_equal(np.isfinite(model.free_cost), [False, True, False])


@pytest.mark.parametrize("speed", [3.0, 10.0, 30.0])
@pytest.mark.parametrize(("part", "near"), [(0.05, 0.01), (0.6, 0.05), (0.9, 0.15)])
def test_slip_is_followed_as_far_as_a_force_turns_wheels_while_it_is_held(speed, part, near):
    car, friction, held_s, dt = CAR.params, 0.2, 0.1, 1e-5
    wheel, load_n = car.front.wheel, car.chassis.mass_kg * 9.81 / 4.0
    force_n = part * friction * load_n
    slip = mean = 0.0
    for _ in range(round(held_s / dt)):
        surplus_nm = (force_n - friction_coefficient(slip, friction, car.front.tyre) * load_n) * wheel.radius_m
        slip += surplus_nm / wheel.inertia_kgm2 * dt * wheel.radius_m / speed
        mean += slip * dt / held_s
    reached = mean / slip_at_friction(part * friction, friction, car.front.tyre)
    ours = slip_followed(4.0 * force_n, speed, held_s, car, _params(friction=friction))
    assert ours == pytest.approx(reached, abs=near)
    assert slip_followed(-4.0 * force_n, speed, held_s, car, _params(friction=friction)) == ours


def test_beyond_the_grip_slip_is_the_limiters_and_lags_behind_no_demand():
    params, weight_n = _params(friction=0.2), CAR.params.chassis.mass_kg * 9.81
    for force_n in (0.21 * weight_n, -0.21 * weight_n, 0.6 * weight_n):
        assert slip_followed(force_n, 20.0, 0.1, CAR.params, params) == 1.0
    assert slip_followed(0.19 * weight_n, 20.0, 0.1, CAR.params, params) < 0.9


@pytest.mark.parametrize("better", ["front", "rear"])
def test_beyond_the_grip_is_what_the_better_axles_tyres_do_not_carry(better):
    axle = getattr(CAR.params, better)
    stiffness, shape, peak, *rest = axle.tyre.coefficients
    tyre = axle.tyre._replace(coefficients=(stiffness, shape, 1.2 * peak, *rest))
    car = CAR.params._replace(**{better: axle._replace(tyre=tyre)})
    params, weight_n = _params(friction=0.2), car.chassis.mass_kg * 9.81
    assert slip_followed(0.21 * weight_n, 20.0, 0.1, car, params) < 0.9
    assert slip_followed(0.25 * weight_n, 20.0, 0.1, car, params) == 1.0


def test_a_wheel_at_rest_or_without_force_has_no_slip_to_follow():
    params = _params(friction=0.2)
    assert slip_followed(0.0, 20.0, 0.1, CAR.params, params) == 1.0
    assert slip_followed(900.0, 0.0, 0.1, CAR.params, params) == 1.0
