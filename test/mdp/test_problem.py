# SPDX-License-Identifier: Apache-2.0
"""Problem files: the two presets, and everything that can be wrong with a user's own."""

from __future__ import annotations

import copy
import json

import numpy as np
import pytest

from iwm_power_manager.errors import ConfigError
from iwm_power_manager.files import read_yaml
from iwm_power_manager.mdp.problem import load_problem, problem_from
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle

PAPER = share_path("config/grids/paper.yaml")
FINE = share_path("config/grids/fine.yaml")


def test_the_paper_s_grid_is_the_paper_s():
    problem = load_problem(PAPER)
    assert problem.power_w.tolist() == [1000.0 * k for k in range(-12, 20)]
    assert problem.speed_mps.tolist() == [0.0, 5.0, 10.0, 25.0]
    slips = [-1.0, -0.35, -0.21, -0.1, -0.001, 0.0, 0.001, 0.1, 0.21, 0.35, 1.0]
    assert problem.slip_front.tolist() == problem.slip_rear.tolist() == slips
    assert problem.shape == (32, 4, 11, 11, 1)
    assert (problem.power_error, problem.error_norm, problem.skid_avoidance) == ("wheel", "squared", "braking")
    assert (problem.dt_s, problem.critical_slip) == (0.1, 0.2)


def test_the_fine_grid_has_the_previous_share_and_a_price_on_changing_it():
    problem = load_problem(FINE)
    assert problem.shape == (32, 11, 19, 19, problem.share.size)
    cost = problem.switching_cost()
    assert np.all(np.diag(cost) == 0.0)
    assert cost[0, -1] == problem.switching_cost_j
    assert np.array_equal(cost, cost.T)


def test_the_price_of_a_change_may_depend_on_the_road():
    content = {**read_yaml(FINE), "switching_cost_j": 0, "switching_cost_by_friction": [[0.2, 50], [0.6, 30]]}
    problem = problem_from(content, "g.yaml")
    prices = {mu: problem.on_road(mu).switching_cost_j for mu in (0.1, 0.2, 0.4, 0.6, 0.9)}
    assert prices == pytest.approx({0.1: 50.0, 0.2: 50.0, 0.4: 40.0, 0.6: 30.0, 0.9: 30.0})
    there = problem.on_road(0.4)
    assert there.on_road(0.9) is there
    same = load_problem(FINE)
    assert same.on_road(0.4) is same
    with pytest.raises(ConfigError, match="switching_cost_by_friction: stands beside switching_cost_j"):
        problem_from({**content, "switching_cost_j": 1}, "g.yaml")


def test_axes_relative_to_the_car_grow_with_its_powers_and_speeds():
    coupled = load_problem(share_path("config/grids/coupled.yaml"))
    assert coupled.needs_car
    car = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params
    strong = car.with_axles(motor=car.front.motor._replace(max_power_w=30e3))
    small, large = coupled.for_car(car), coupled.for_car(strong)
    assert not small.needs_car and small.for_car(strong) is small
    assert (small.power_w[0], small.power_w[-1]) == (-60e3, 30e3)
    assert large.power_w == pytest.approx(4.0 * small.power_w, abs=0.5)
    # Launching keeps its speeds; the top grows with what the road load lets through.
    assert np.array_equal(small.speed_mps[:8], large.speed_mps[:8])
    assert large.speed_mps[-1] > 1.3 * small.speed_mps[-1]
    assert np.all(np.diff(small.speed_mps) > 0.0) and np.all(np.diff(large.speed_mps) > 0.0)
    with pytest.raises(ConfigError, match="of_car"):
        problem_from({**read_yaml(FINE), "power_w": {"of_car": [1, 0]}}, "g.yaml")


def test_a_fixed_switching_cost_falls_due_with_any_change():
    content = {**read_yaml(FINE), "share": [0, 0.5, 1], "switching_cost_j": 10, "switching_fixed_cost_j": 3}
    expected = [[0.0, 8.0, 13.0], [8.0, 0.0, 8.0], [13.0, 8.0, 0.0]]
    assert problem_from(content, "g.yaml").switching_cost().tolist() == expected


def test_settings_are_plain_and_give_the_same_problem_again():
    problem = load_problem(FINE)
    settings = json.loads(json.dumps(problem.settings()))
    name = settings.pop("name")
    again = problem_from({"format": 1, **settings}, f"{name}.yaml")
    assert again.settings() == problem.settings()


def test_axes_from_steps_are_the_numbers_a_list_would_hold():
    content = {**read_yaml(PAPER), "share": {"from": 0, "to": 1, "step": 0.1}}
    assert problem_from(content, "g.yaml").share.tolist() == [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0]


def test_mirrored_axes_may_leave_out_zero():
    content = {**read_yaml(PAPER), "slip_front": {"mirrored": [0.1, 0.2]}}
    assert problem_from(content, "g.yaml").slip_front.tolist() == [-0.2, -0.1, 0.1, 0.2]


def test_every_axis_may_have_a_single_point():
    content = {
        **read_yaml(PAPER),
        "power_w": [0],
        "speed_mps": [10],
        "slip_front": [0],
        "slip_rear": [0],
        "share": [0.5],
    }
    assert problem_from(content, "g.yaml").shape == (1, 1, 1, 1, 1)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"power_w": None}, "power_w: is missing"),
        ({"gamma": 0.9}, "gamma: is an unknown key; allowed: format, power_w"),
        ({"format": 2}, "format: 2 is out of range; allowed: 1 to 1"),
        ({"discount": 1.0}, "discount: 1.0 is out of range; allowed: 0 to 0.9999"),
        ({"discount": "high"}, "discount: 'high' is no number"),
        ({"dt_s": 0}, "dt_s: 0 is out of range; allowed: 0.001 to 10 s"),
        ({"alpha": float("nan")}, "alpha: nan is not finite"),
        ({"power_error": "tyre"}, "power_error: 'tyre' is unknown; allowed: wheel | road"),
        ({"error_norm": 2}, "error_norm: 2 is unknown; allowed: squared | absolute | lagrange"),
        ({"slip_model": "static"}, "slip_model: 'static' is unknown; allowed: dynamic | quasi_steady"),
        ({"skid_avoidance": True}, "skid_avoidance: True is unknown; allowed: none | braking | both"),
        ({"previous_share": "yes"}, "previous_share: 'yes' is neither true nor false"),
        ({"critical_slip": 0}, "critical_slip: 0 is out of range; allowed: 0.01 to 1"),
        ({"tolerance_j": 0}, "tolerance_j: 0 is out of range"),
        ({"max_iterations": 1.5}, "max_iterations: 1.5 is no integer"),
        ({"power_w": []}, "power_w: [] is no axis; allowed: [a, b, ...]"),
        ({"power_w": 5}, "power_w: 5 is no axis"),
        ({"power_w": [0, "x"]}, "power_w[1]: 'x' is no number"),
        ({"power_w": [0, 2000, 1000]}, "power_w[2]: 1000 does not increase; allowed: > 2000"),
        ({"speed_mps": [-1, 0]}, "speed_mps[0]: -1 is out of range; allowed: 0 to 100 m/s"),
        ({"share": [0, 1.2]}, "share[1]: 1.2 is out of range; allowed: 0 to 1"),
        ({"power_w": {"from": 0, "to": 10}}, "power_w.step: is missing"),
        ({"power_w": {"from": 0, "to": 10, "step": 0}}, "power_w.step: 0 is out of range"),
        ({"power_w": {"from": 0, "to": 10, "step": 3}}, "power_w.step: 3 does not divide 0 to 10"),
        ({"power_w": {"from": 0, "to": 10, "step": 5e-324}}, "power_w.step: 4.94066e-324"),
        ({"power_w": {"from": 10, "to": 0, "step": 1}}, "power_w.to: 0 is out of range; allowed: 10 to 1e+06 W"),
        ({"power_w": {"from": 0, "to": 10000, "step": 1}}, "power_w.step: 1 gives 10001 points; allowed: <= 1000"),
        ({"slip_front": {"mirrored": [-0.1, 0.1]}}, "slip_front.mirrored[0]: -0.1 is out of range; allowed: 0 to 1"),
        ({"slip_front": {"mirrored": [0, 0.1], "step": 1}}, "slip_front.step: is an unknown key"),
        ({"slip_model": "quasi_steady"}, "slip_front: is no state with slip_model quasi_steady; allowed: [0]"),
        ({"switching_cost_j": 10}, "switching_cost_j: needs previous_share: true"),
        ({"switching_cost_by_friction": [[0.5, 10]]}, "switching_cost_by_friction: needs previous_share: true"),
        ({"switching_cost_by_friction": 7}, "switching_cost_by_friction: 7 is no list of pairs"),
        ({"switching_cost_by_friction": [[0.5]]}, "switching_cost_by_friction[0]: [0.5] is no pair"),
        ({"switching_cost_by_friction": [[0.5, 1], [0.5, 2]]}, "[1]: 0.5 does not increase; allowed: > 0.5"),
        ({"switching_cost_by_friction": [[5, 1]]}, "friction[0]: 5 is out of range; allowed: 0.01 to 2"),
        ({"switching_cost_by_friction": [[0.5, -1]]}, "friction[0]: -1 is out of range; allowed: 0 to 1e+06 J"),
        ({"cycle_demand": "guessed"}, "cycle_demand: 'guessed' is unknown"),
        ({"switching_fixed_cost_j": -1}, "switching_fixed_cost_j: -1 is out of range"),
        (
            {"power_w": {"from": 0, "to": 900, "step": 1}, "speed_mps": {"from": 0, "to": 90, "step": 0.5}},
            "pairs of state and control; allowed: <= 2e+07",
        ),
    ],
)
def test_a_wrong_setting_is_refused_with_key_value_and_range(changes, words):
    content = copy.deepcopy(read_yaml(PAPER))
    for key, value in changes.items():
        if value is None:
            del content[key]
        else:
            content[key] = value
    with pytest.raises(ConfigError) as caught:
        problem_from(content, "my_grid.yaml")
    assert str(caught.value).startswith("my_grid.yaml: ")
    assert words in str(caught.value)
