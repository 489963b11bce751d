# SPDX-License-Identifier: Apache-2.0
"""Criteria: met and not met, and what counts where."""

from dataclasses import replace

import pytest

from iwm_sim.metrics import Metrics
from iwm_sim.study import criteria
from iwm_sim.study.labels import BOUND, ED, GRDP, INSTANTANEOUS, INSTANTANEOUS_SLIP, OURS
from iwm_sim.study.rows import Place, Row
from iwm_sim.study.skid import Stopped

RIVAL = f"{INSTANTANEOUS_SLIP} 60 W"
METRICS = Metrics(**dict.fromkeys(Metrics._fields, 0.0))._replace(
    trace_held=True,
    share_changes_per_min=5.0,
    wh_per_km=80.0,
    rms_speed_error_mps=0.1,
    max_torque_rate_nmps=4000.0,
    longest_locked_s=0.0,
)


def row(label, saving, cycle="udds", **measured):
    return Row(Place(cycle, 0.9, "none"), label, "sdp", METRICS._replace(**measured), saving, None, True)


def cell(ours=2.3, rival=2.2, bound=2.4, **of_ours):
    return [
        row(ED, 0.0),
        row(GRDP, 0.5),
        row(INSTANTANEOUS, 2.2),
        row(RIVAL, rival),
        row(BOUND, bound),
        row(OURS, ours, **of_ours),
    ]


STOP = Stopped(
    idle_drive="drag",
    friction=0.9,
    gate_mode="limiter",
    strategy="equal",
    distance_m=37.0,
    best_m=36.0,
    best_slip=-0.18,
    longer_percent=3.0,
    stopped=True,
    min_slip=-0.18,
    locked_s=0.02,
    longest_locked_s=0.02,
    rms_jerk_mps3=10.0,
)


def unmet(rows, stops=(STOP,)):
    return [criterion.text for criterion in criteria.check(rows, stops, 20000.0) if not criterion.met]


def test_a_policy_that_is_best_everywhere_meets_all():
    assert unmet(cell()) == []


@pytest.mark.parametrize(("ours", "met"), [(2.16, True), (2.14, False)])
def test_a_rival_may_be_better_by_five_hundredths(ours, met):
    missed = [text for text in unmet(cell(ours=ours, bound=2.2)) if "never worse than instantaneous by" in text]
    assert (not missed) == met


def of_slip_aware(rows):
    return next(made for made in criteria.check(rows, [STOP], 20000.0) if INSTANTANEOUS_SLIP in made.text)


def test_the_slip_aware_rival_is_taken_at_as_many_changes_along_its_price():
    calm = row(f"{INSTANTANEOUS_SLIP} 100 W", 1.2, share_changes_per_min=3.0)
    between = [*cell(ours=1.8, share_changes_per_min=4.0), calm]  # halfway from (3, 1.2) to (5, 2.2): 1.7
    assert of_slip_aware(between).value.startswith("+0.10 points")
    fewest = [*cell(ours=1.0, share_changes_per_min=2.0), calm]
    assert of_slip_aware(fewest).value.startswith("-0.20 points")
    assert not of_slip_aware(fewest).met
    most = [*cell(ours=2.3, share_changes_per_min=9.0), calm]
    assert of_slip_aware(most).value.startswith("+0.10 points")


def test_ninety_percent_of_a_large_possible_saving_have_to_be_taken():
    assert any("takes 90%" in text for text in unmet(cell(ours=2.25, bound=2.6)))
    assert not any("takes 90%" in text for text in unmet(cell(ours=0.26, rival=0.2, bound=0.29)))


def test_cells_whose_trace_is_lost_are_judged_by_how_they_follow():
    lost = cell(ours=-5.0, trace_held=False, rms_speed_error_mps=0.2)
    assert [text for text in unmet(lost) if "saving" in text or "never worse" in text] == []
    assert any("trace is lost" in text for text in unmet(lost))
    followed = cell(ours=-5.0, trace_held=False, rms_speed_error_mps=0.09, wh_per_km=79.0)
    assert unmet(followed) == []


def test_too_many_changes_too_fast_a_torque_too_long_a_skid_are_named():
    texts = unmet(cell(share_changes_per_min=10.1, max_torque_rate_nmps=20001.0, longest_locked_s=0.11))
    assert len(texts) == 3
    assert len(unmet(cell(), [replace(STOP, longer_percent=5.1, longest_locked_s=0.2)])) == 2
    assert len(unmet(cell(), [replace(STOP, stopped=False)])) == 1
    assert unmet(cell(), [STOP, replace(STOP, gate_mode="off", longer_percent=9.0)]) == []


def test_the_worst_cell_is_named():
    rows = [*cell(), *(replace(made, place=made.place._replace(cycle="nycc")) for made in cell(ours=2.21))]
    first = criteria.check(rows, [STOP], 20000.0)[0]
    assert first.where == "nycc 0.9 none"
    assert "+2.21 points" in first.value
