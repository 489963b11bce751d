# SPDX-License-Identifier: Apache-2.0
"""Cases: driven alike wherever, compared only where comparing makes sense."""

import dataclasses
import pickle

import numpy as np
import pytest

from iwm_power_manager.errors import ConfigError, PolicyError
from iwm_sim.study import cases
from iwm_sim.study.cases import Case, Change, SensorNoise
from iwm_sim.study.rows import rows_of

VEHICLE = "jalalmaab_2015"


@pytest.fixture
def equal(hill):
    return Case(str(hill), VEHICLE, "none", 0.9, "equal")


def test_a_case_survives_the_way_to_a_worker(equal):
    case = dataclasses.replace(equal, plant=(Change("chassis", "mass_kg", 900.0),), noise=SensorNoise(0.1, 0.3))
    assert pickle.loads(pickle.dumps(case)) == case


def test_the_same_case_gives_the_same_numbers(equal):
    noisy = dataclasses.replace(equal, noise=SensorNoise(0.1, 0.3, seed=7))
    other = dataclasses.replace(equal, noise=SensorNoise(0.1, 0.3, seed=8))
    assert cases.result(noisy).metrics == cases.result(noisy).metrics
    assert cases.result(noisy).metrics != cases.result(other).metrics


def test_a_heavier_plant_takes_more_energy_than_the_car_the_law_believes_in(equal):
    heavier = dataclasses.replace(equal, plant=(Change("chassis", "mass_kg", 960.0),))
    assert cases.result(heavier).metrics.energy_wh > 1.05 * cases.result(equal).metrics.energy_wh


def test_only_the_columns_asked_for_come_back(equal):
    made = cases.result(dataclasses.replace(equal, keep=("time_s", "front_slip")))
    assert set(made.series) == {"time_s", "front_slip"}
    assert len(made.series["time_s"]) == 3000


def test_a_policy_for_another_car_is_refused(equal, small_policy):
    case = dataclasses.replace(equal, idle_drive="drag", strategy="sdp", policy=str(small_policy))
    with pytest.raises(PolicyError, match="was solved for"):
        cases.drive(case)


def test_preview_saves_what_it_schedules(equal):
    free = dataclasses.replace(equal, strategy="preview")
    rows = rows_of([cases.result(equal), cases.result(free)])
    assert rows[0].saving_percent == 0.0
    assert rows[1].saving_percent > 0.5
    assert rows[1].share_of_possible is None  # without a budget of changes there is nothing called possible
    within = rows_of([cases.result(equal), cases.result(dataclasses.replace(free, changes_per_min=8.0))])[1]
    assert within.share_of_possible == 1.0
    assert within.possible_percent == within.saving_percent


def test_share_of_possible_is_the_part_of_the_previews_saving(equal):
    results = [
        cases.result(dataclasses.replace(equal, strategy=name, changes_per_min=8.0))
        for name in ("equal", "preview", "instantaneous_slip")
    ]
    _, bound, rival = rows_of(results)
    assert rival.share_of_possible == pytest.approx(rival.saving_percent / bound.saving_percent)


def test_energies_of_runs_over_different_distances_are_not_compared(equal):
    made = cases.result(equal)
    further = made._replace(
        case=dataclasses.replace(equal, strategy="sdp"),
        metrics=made.metrics._replace(distance_m=1.002 * made.metrics.distance_m),
    )
    row = rows_of([made, further])[1]
    assert row.same_distance_as_equal is False
    assert row.saving_percent is None


def test_a_run_that_lost_the_trace_saves_nothing_and_against_one_nothing_is_saved(equal):
    made = cases.result(equal)
    other = made._replace(case=dataclasses.replace(equal, strategy="sdp"))
    for runs in ((made, _lost(other)), (_lost(made), other)):
        assert rows_of(runs)[1].saving_percent is None
    assert rows_of((made, other))[1].saving_percent == 0.0


def _lost(made):
    return made._replace(metrics=made.metrics._replace(trace_held=False))


def test_preview_keeps_a_budget_of_changes_and_the_possible_is_never_below_what_a_strategy_reached(equal):
    tight = dataclasses.replace(equal, strategy="preview", changes_per_min=4.0)
    bound = cases.result(tight)
    assert 0.0 < bound.metrics.share_changes_per_min <= 4.0
    assert tight.price_text == "at most 4 changes a minute"
    made = cases.result(equal)
    better = bound._replace(
        case=dataclasses.replace(equal, strategy="sdp"),
        metrics=bound.metrics._replace(energy_wh=0.99 * bound.metrics.energy_wh),
    )
    restless = better._replace(metrics=better.metrics._replace(share_changes_per_min=5.0))
    assert [rows_of((made, bound, run))[1].share_of_possible for run in (better, restless)] == [
        pytest.approx(rows_of((made, bound))[1].saving_percent / rows_of((made, better))[1].saving_percent),
        1.0,
    ]


def test_runs_of_different_roads_are_not_compared(equal):
    icy = dataclasses.replace(equal, friction=0.2, strategy="instantaneous")
    assert rows_of([cases.result(equal), cases.result(icy)])[1].saving_percent is None


def test_a_row_names_what_it_was_made_with(equal, small_policy):
    row = rows_of([cases.result(dataclasses.replace(equal, strategy="sdp", policy=str(small_policy)))])[0]
    assert row.made_with["vehicle_hash"] == cases.vehicle_of(VEHICLE, "none").hash
    assert row.made_with["policy_checksum"] == cases.policy_of(str(small_policy)).checksum
    assert row.made_with["settings"]["critical_slip"] == 0.2


def test_the_rule_is_the_best_of_its_lines_on_its_own_cycle(equal, hill, monkeypatch):
    monkeypatch.setattr(cases, "RULE_CYCLE", str(hill))
    rule = cases.fitted_rule(equal)
    assert len(rule.coefficients) == 4
    assert rule.front_share.size == rule.power_demand_w.size
    fixed = dataclasses.replace(equal, strategy="rule")
    best = cases.result(dataclasses.replace(fixed, rule=rule.coefficients)).metrics.wh_per_km
    plain = tuple(cases.preview.fit_rule(rule.power_demand_w, np.maximum(rule.front_share, 1 - rule.front_share)))
    assert best <= cases.result(dataclasses.replace(fixed, rule=plain)).metrics.wh_per_km


def test_a_step_that_does_not_divide_the_decision_period_is_refused_for_preview(equal):
    with pytest.raises(ConfigError, match="does not divide"):
        cases.check(dataclasses.replace(equal, strategy="preview", dt_s=0.013))


def test_a_cycle_shorter_than_two_steps_is_refused(tmp_path, equal):
    path = tmp_path / "blink.csv"
    path.write_text("time_s,speed_mps\n0,0\n0.01,0\n")
    with pytest.raises(ConfigError, match="too short"):
        cases.check(dataclasses.replace(equal, cycle=str(path)))


def test_changes_reach_the_numbers_they_name():
    params = cases.vehicle_of(VEHICLE, "none").params
    changed = cases.changed(params, [Change("motor", "loss_constant_w", 40.0)])
    assert changed.front.motor.loss_constant_w == 40.0
    assert repr(changed.with_axles(motor=params.front.motor)) == repr(params)
