# SPDX-License-Identifier: Apache-2.0
"""A fleet file becomes every combination it names, each with a key of its own, or one line of complaint."""

import pytest
import yaml

from iwm_power_manager.errors import ConfigError
from iwm_power_manager.share import share_path
from iwm_sim.fleet.plan import FOLDER, load_plan, needed, plan_of
from iwm_sim.fleet.task import key_of

CAR = {"vehicle": "jalalmaab_2015", "idle_drive": ["none", "drag"], "change": {"chassis.mass_kg": [700, 800, 900]}}


def plan(**changes):
    return plan_of("fleet.yaml", {"format": 1, "cars": [CAR], "cycles": ["nycc"], "friction": [0.9, 0.5]} | changes)


def test_all_combinations_are_driven_each_with_equal_split_first_and_a_key_of_its_own():
    made = plan(strategies=["instantaneous", "instantaneous_slip"])
    assert len(made.drives) == 2 * 3 * 2
    assert {tuple(case.strategy for case in task.cases) for task in made.drives} == {
        ("equal", "instantaneous", "instantaneous_slip")
    }
    assert len({key_of(task) for task in made.drives}) == len(made.drives)
    assert [key_of(task) for task in made.drives] == [
        key_of(task) for task in plan(strategies=["instantaneous", "instantaneous_slip"]).drives
    ]


def test_a_policy_is_solved_for_every_car_road_and_budget_that_a_strategy_needs_one_for():
    made = plan(strategies=["sdp_lookahead", "instantaneous"], budgets=[4, 8])
    assert len(made.solves) == len(needed(made)) == 6 * 2 * 2
    assert len({solve.file for solve in made.solves}) == 24
    labels = [case.name for case in made.drives[0].cases]
    assert labels == ["equal", "instantaneous", "sdp_lookahead, 4/min", "sdp_lookahead, 8/min"]
    assert needed(plan(strategies=["instantaneous"])) == []


def test_drawn_cars_and_cycles_come_from_their_seeds():
    made = plan(cars=[{"vehicle": "generated:1000..1002"}], cycles=["generated:7", "nycc"], friction=0.9)
    assert [(task.cases[0].vehicle, task.cases[0].cycle) for task in made.drives] == [
        (f"generated:{seed}", cycle)
        for seed in (1000, 1001, 1002)
        for cycle in ("generated:7", "config/cycles/nycc.csv")
    ]
    assert set(made.files) == {"config/cycles/nycc.csv", "config/grids/coupled.yaml"}


def test_a_scenario_is_driven_with_every_car_on_the_road_it_brings(hill):
    made = plan(cycles=[], scenarios=["stop_02"], strategies=["instantaneous", "sdp_lookahead"])
    assert len(made.drives) == 0
    assert len(made.roads) == 6 * 3
    assert {solve.friction for solve in needed(made)} == {0.2}


def test_files_of_the_package_have_the_same_name_on_every_machine_and_others_their_full_path(hill, monkeypatch):
    monkeypatch.chdir(hill.parent)
    assert set(plan(cycles=["nycc", hill.name]).files) == {
        "config/vehicles/jalalmaab_2015.yaml",
        "config/cycles/nycc.csv",
        "config/grids/coupled.yaml",
        str(hill),
    }


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"format": 2}, r"format: 2 is unknown; allowed: 1"),
        ({"cycle": ["nycc"]}, r"cycle: is an unknown key; allowed: .*cycles"),
        ({"cars": [{"idle_drive": "drag"}]}, r"cars\[0\].vehicle: is missing"),
        ({"cars": [CAR | {"idle_drive": "off"}]}, r"cars\[0\].idle_drive: 'off' is unknown; allowed: .*drag"),
        ({"cars": [CAR | {"change": {"chassis.mass": 1}}]}, r"change.chassis.mass: is an unknown key"),
        ({"cars": [CAR | {"change": {"chassis.mass_kg": [700, 1]}}]}, r"mass_kg: 1 is out of range; .* 50 to 50000 kg"),
        ({"cars": [CAR | {"change": {"motor.peak_torque_nm": 60}}]}, r"peak_torque_nm is below continuous_torque_nm"),
        ({"cars": [CAR | {"change": {"motor.max_power_w": 7.5}}]}, r"kW in a W field"),
        ({"cars": [CAR | {"vehicle": 7}]}, r"cars\[0\].vehicle: 7 is no file name"),
        ({"friction": [0.9, "wet"]}, r"friction: 'wet' is no number; allowed: 0.01 to 2"),
        ({"friction": []}, r"friction: is an empty list"),
        ({"strategies": "magic"}, r"strategies: 'magic' is unknown; allowed: equal"),
        ({"budgets": [0]}, r"budgets: 0 is out of range"),
        ({"cycles": ["nycx"]}, r"nycx.*did you mean nycc"),
        ({"cycles": ["generated:9..3"]}, r"cycles: generated:9..3 names no seeds"),
        ({"cycles": ["generated:0..900000"], "friction": [0.5, 0.6]}, r"fleet.yaml: makes 10800012 places"),
        ({"dt_s": 1.0}, r"dt_s: 1.0 is out of range"),
    ],
)
def test_a_mistake_is_named_with_its_key_and_what_is_allowed(changes, words):
    with pytest.raises(ConfigError, match=words):
        plan(**changes)


def test_options_take_the_place_of_the_files_keys(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump({"format": 1, "cars": [CAR], "cycles": ["nycc"], "friction": [0.9, 0.5]}))
    assert len(load_plan(path, {}).drives) == 12
    assert len(load_plan(path, {"friction": [0.2]}).drives) == 6


@pytest.mark.parametrize("path", sorted(share_path(FOLDER).glob("*.yaml")), ids=lambda path: path.stem)
def test_every_fleet_of_the_package_can_be_planned(path):
    assert load_plan(path.stem, {}).drives
