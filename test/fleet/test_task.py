# SPDX-License-Identifier: Apache-2.0
"""A task gives the same rows wherever it runs, and a worker that would give others does nothing."""

import pytest

from iwm_power_manager.errors import ConfigError, IwmError
from iwm_power_manager.policy import load_policy
from iwm_sim.fleet.plan import plan_of
from iwm_sim.fleet.task import Car, Drive, Given, Road, Solve, differences, fingerprint, work
from iwm_sim.study import cases
from iwm_sim.study.cases import Case, Change

CAR = Car("config/vehicles/jalalmaab_2015.yaml", "none", (Change("chassis", "mass_kg", 700.0),))


def test_a_drive_gives_a_row_for_each_strategy_with_what_evaluate_measures(fleet, tmp_path):
    task = fleet.drives[0]
    equal, other = task.run(tmp_path).rows
    assert (equal["strategy"], other["strategy"]) == ("equal", "instantaneous")
    assert other["wh_per_km"] == cases.result(task.cases[1]).metrics.wh_per_km
    assert other["saving_percent"] == 100.0 * (1.0 - other["energy_wh"] / equal["energy_wh"])
    assert (other["car"], other["fair"]) == ("jalalmaab_2015, chassis.mass_kg 700", True)


def test_a_place_whose_trace_is_lost_has_no_saving(hill, tmp_path):
    base = Case(str(hill), "jalalmaab_2015", "none", 0.05, "equal", dt_s=0.02)
    equal, other = Drive((base, Case(**(vars(base) | {"strategy": "instantaneous"})))).run(tmp_path).rows
    assert not equal["trace_held"]
    assert (other["fair"], other["saving_percent"]) == (False, None)


def test_policies_of_two_budgets_are_solved_and_driven(hill, small_grid, tmp_path):
    cars = [{"vehicle": "jalalmaab_2015", "idle_drive": "none"}]
    content = {"format": 1, "cars": cars, "cycles": [str(hill)], "strategies": "sdp", "budgets": [2, 50]}
    plan = plan_of("fleet.yaml", content | {"grid": str(small_grid), "dt_s": 0.02})
    few, many = (solve.run(tmp_path) for solve in plan.solves)
    assert few.rows[0]["price_j"] > many.rows[0]["price_j"]
    for made in (few, many):
        ((name, content),) = made.policies.items()
        (tmp_path / name).write_bytes(content)
        assert load_policy(tmp_path / name).checksum == made.rows[0]["policy"]
    rows = plan.drives[0].run(tmp_path).rows
    assert [row["policy"] for row in rows] == ["", few.rows[0]["policy"], many.rows[0]["policy"]]


def test_a_scenario_is_driven_with_another_car(tmp_path):
    rows = Road("config/scenarios/stop_09.yaml", CAR, "equal").run(tmp_path).rows
    assert {row["car"] for row in rows} == {CAR.label}
    assert any(row["measure"] == "adhesion_used" and row["value"] > 0.5 for row in rows)


def test_a_drawn_car_and_cycle_are_those_of_their_seed():
    assert cases.cycle_of("generated:3").name == "generated_3"
    assert cases.vehicle_of("generated:5", "drag").params.chassis.mass_kg != 800.0
    assert (
        Solve(Car("generated:5", "drag"), 0.9, "coupled").file != Solve(Car("generated:6", "drag"), 0.9, "coupled").file
    )


def test_another_processor_is_no_difference_but_other_numbers_are():
    mine = fingerprint()
    assert differences(mine, mine | {"processor": "other"}) == ""
    assert "numbers 0 instead of" in differences(mine, mine | {"numbers": "0"})


def test_a_worker_with_other_numbers_or_another_file_refuses(fleet, hill):
    given = Given("", fingerprint() | {"numbers": "0", "numpy": "1.0"}, {})
    with pytest.raises(IwmError, match=r"worker .*: computes other numbers than this study: numpy .* instead of 1.0"):
        work(fleet.drives[:1], given)
    with pytest.raises(ConfigError, match=r"hill.csv: worker .* has another file") as found:
        work(fleet.drives[:1], Given("", fingerprint(), {str(hill): "0"}))
    rebuilt = found.value.__reduce__()
    assert str(rebuilt[0](*rebuilt[1])) == str(found.value)
