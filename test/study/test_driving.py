# SPDX-License-Identifier: Apache-2.0
"""Many cases at once: in order, longest first."""

import dataclasses

from iwm_sim.study import cases, driving
from iwm_sim.study.cases import Case


def test_two_processes_drive_as_one_does(hill, monkeypatch):
    base = Case(str(hill), "jalalmaab_2015", "none", 0.9, "equal")
    wanted = [base, dataclasses.replace(base, strategy="instantaneous"), dataclasses.replace(base, friction=0.2)]
    monkeypatch.setattr(driving, "seconds_of", lambda case: 10.0 + len(case.strategy))  # worth two processes
    together = driving.drive_all(wanted, 2)
    assert [made.case for made in together] == wanted
    assert [made.metrics for made in together] == [cases.result(case).metrics for case in wanted]


def test_each_car_and_road_gets_one_rule(hill, monkeypatch):
    monkeypatch.setattr(cases, "RULE_CYCLE", str(hill))
    base = Case(str(hill), "jalalmaab_2015", "none", 0.9, "rule")
    equal = dataclasses.replace(base, strategy="equal")
    given = dataclasses.replace(base, rule=(0.0, 0.6, 0.0, 0.6))
    first, other, left, kept = driving.with_rules([base, dataclasses.replace(base, soc=0.8), equal, given], 1)
    assert first.rule == other.rule != ()
    assert left == equal
    assert kept == given
