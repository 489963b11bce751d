# SPDX-License-Identifier: Apache-2.0
"""Frontiers: margins, bounds and verdicts from points, and one small drive."""

from __future__ import annotations

import numpy as np
import pytest

from iwm_power_manager.control.table import empty_table
from iwm_power_manager.cycle import make_cycle
from iwm_power_manager.policy import load_policy
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle
from iwm_sim.study import frontier, unseen
from iwm_sim.study.frontier import COUNTS, Frontier, Place, Point

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml"), "drag")


MADE = "friction 0.9, idle drive drag, control at 100 Hz, split decided every 0.02 s"


def point(saving, changes, fine=None, travel=None, held=True, strategy="instantaneous_slip"):
    fine, travel = (changes if value is None else value for value in (fine, travel))
    return Point(strategy, 0.0, saving, changes, fine, travel, 3, held)


def test_a_margin_is_against_the_best_rival_with_no_more_changes():
    rivals = [point(0.5, 10.0), point(0.4, 5.0), point(0.45, 5.0, fine=20.0), point(0.9, 5.0, held=False)]
    assert frontier.margin(point(0.5, 6.0), rivals, "changes_per_min") == pytest.approx(0.05)
    assert frontier.margin(point(0.5, 6.0), rivals, "fine_changes_per_min") == pytest.approx(0.1)
    assert frontier.margin(point(-0.1, 0.0), rivals, "changes_per_min") == pytest.approx(-0.1)  # equal split is a rival
    assert frontier.margin(point(0.5, 6.0, held=False), rivals, "changes_per_min") is None
    assert frontier.margin(point(None, 6.0), rivals, "changes_per_min") is None


def test_margins_by_swings_stand_beside_the_judgement_and_are_no_part_of_it():
    rivals = (point(0.5, 1.0)._replace(swings_per_min=120.0), point(0.2, 5.0)._replace(swings_per_min=5.0))
    blind = Frontier("blind", MADE, rivals, (point(0.3, 5.0)._replace(swings_per_min=5.0),), ())
    (swings,) = unseen.judge([blind], (frontier.SWINGS,))
    assert swings.worst == pytest.approx(0.1)
    assert [verdict.worst for verdict in unseen.judge([blind])] == pytest.approx([-0.2, -0.2, -0.2])
    assert "swings_per_min, no part of the target: worst +0.100 points" in unseen.report([blind])
    assert unseen.to_json([blind])["swings"] == [swings]
    before = blind._replace(ours=(point(0.3, 5.0),))  # of a file without them
    assert unseen.judge([before], (frontier.SWINGS,)) == []


def test_margins_by_energy_for_a_kilometre_stand_beside_the_judgement_and_are_no_part_of_it():
    def driven(saving, per_km):
        return point(saving, 5.0)._replace(saving_per_km_percent=per_km)

    further = Frontier("further", MADE, (driven(0.5, 0.4), driven(0.6, None)), (driven(0.3, 0.45),), ())
    by_km = unseen.judge([further], saved=frontier.SAVED_PER_KM)
    assert [verdict.worst for verdict in by_km] == pytest.approx([0.05] * 3)
    assert [verdict.worst for verdict in unseen.judge([further])] == pytest.approx([-0.3] * 3)
    assert "travel_per_min and by Wh/km, no part of the target: worst +0.050 points" in unseen.report([further])
    assert unseen.to_json([further])["per_km"] == by_km
    before = further._replace(ours=(point(0.3, 5.0),))  # of a file without it
    assert unseen.judge([before], saved=frontier.SAVED_PER_KM) == []


def test_the_busiest_minute_counts_changes_by_more_than_a_quarter():
    share = np.full(20_000, 0.5)
    share[3000:] = 1.0
    share[5000:] = 0.8
    share[8900:] = 0.0
    share[9100:] = 0.5
    assert frontier.busiest_minute(share, 0.01) == 2
    assert frontier.busiest_minute(np.full(100, 0.5), 0.01) == 0


def test_a_verdict_needs_nearly_all_cells_close_none_far_below_and_the_mean_above():
    good = [Frontier(str(k), MADE, (point(0.3, 5.0),), (point(0.35, 5.0),), ()) for k in range(19)]
    near = Frontier("near", MADE, (point(0.3, 5.0),), (point(0.28, 5.0),), ())
    far = Frontier("far", MADE, (point(0.3, 5.0),), (point(0.2, 5.0),), ())
    assert all(verdict.reached for verdict in unseen.judge([*good, near]))
    assert not any(verdict.reached for verdict in unseen.judge([*good, far]))
    assert not any(verdict.reached for verdict in unseen.judge([*good, near, near]))
    text = unseen.report([*good, far])
    assert "NOT reached" in text and text.rindex("far") > text.index("worst cells")
    assert {row["counted"] for row in unseen.to_json([far])["verdicts"]} == set(COUNTS)


def test_what_ours_saves_is_said_by_kind_of_cell():
    labels = ("mine, cycle 1, friction 0.9", "mine, cycle 2, friction 0.9", "mine, cycle 1, friction 0.9, logged with")
    found = [
        Frontier(label, MADE, (point(0.3, 5.0),), (point(saving, 5.0),), ())
        for label, saving in zip((*labels, "car 7, cycle 1, friction 0.5"), (0.1, 0.5, 0.2, -0.4), strict=True)
    ]
    rows = {row.name: row for row in unseen.kinds(found)}
    assert list(rows) == ["drawn cars", "mine, friction 0.9", "mine, logged", "all"]
    row = rows["mine, friction 0.9"]
    assert (row.cells, row.mean, row.worst) == (2, pytest.approx(0.3), 0.1)
    assert (row.margin, row.worst_margin) == (pytest.approx(0.0), pytest.approx(-0.2))
    assert row.worst < row.low < row.high < 0.5
    assert (rows["all"].cells, rows["all"].worst, rows["drawn cars"].worst_margin) == (4, -0.4, pytest.approx(-0.7))
    assert unseen.to_json(found)["kinds"][-1].name == "all"


def test_a_report_says_what_its_cells_were_made_with():
    ours = [point(0.3, 5.0)._replace(policy=name) for name in ("coupled 1a", "coupled 2b", "coupled 3c")]
    labels = ("mine, cycle 1, friction 0.9", "mine, cycle 1, friction 0.5", "car 7, cycle 1, friction 0.5")
    text = unseen.report([Frontier(label, MADE, (), (o,), ()) for label, o in zip(labels, ours, strict=True)])
    assert (
        "idle drive drag, control at 100 Hz, split decided every 0.02 s; "
        "policies: coupled 1a, coupled 2b, 1 of drawn cars, each solved for its own\n"
    ) in text


def test_cells_are_drawn_from_seeds_with_and_without_noise():
    cells = unseen.cells("jalalmaab_2015", "drag", 1000, 2, 1)
    assert len(cells) == 2 * (2 + 3) and len(set(cells)) == len(cells)
    assert {cell.cycle for cell in cells} >= {1000, 1001}
    assert sum(cell.noise_kmh is None for cell in cells) == 5
    assert unseen.place_of(cells[1]).noise_seed == 1000
    assert unseen.car_of(cells[-1]).name == "generated_1000"


def test_the_bound_is_never_below_what_a_strategy_reached_with_no_more_changes():
    speed = np.concatenate([np.linspace(0.0, 12.0, 10), np.full(12, 12.0), np.linspace(12.0, 0.0, 8), np.zeros(3)])
    place = Place("short", CAR, make_cycle("short", np.arange(speed.size, dtype=float), speed), 0.9)
    policy = load_policy(share_path("policies/jalalmaab_2015_drag_coupled_mu090.npz"))
    found = frontier.measure_frontier(place, [policy], thresholds_w=(0.0, 60.0), bounds=True)
    (ours,), (bound,) = found.ours, found.bounds
    assert ours.held and bound.saving_percent >= ours.saving_percent > 0.0
    within = [p for p in found.rivals if p.changes_per_min <= ours.changes_per_min]
    assert all(bound.saving_percent >= p.saving_percent for p in within)
    assert len(found.rivals) == 3
    runs = [frontier.drive(place, name, empty_table()).final for name in ("equal", "instantaneous")]
    equal_j_per_m, blind_j_per_m = (final.energies.chemical_j / final.distance_m for final in runs)
    per_km = 100.0 * (1.0 - blind_j_per_m / equal_j_per_m)
    assert found.rivals[-1].saving_per_km_percent == pytest.approx(per_km, rel=1e-9)
    assert found.rivals[-1].saving_percent != found.rivals[-1].saving_per_km_percent
    assert found.made_with == MADE
    assert ours.policy == f"coupled {policy.checksum[:8]}" and ours.setting == policy.problem.changes_per_min
