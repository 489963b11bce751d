# SPDX-License-Identifier: Apache-2.0
"""Many cases at once: in order, longest first, and an error of one ends all."""

import dataclasses
import multiprocessing

import pytest

from iwm_power_manager.errors import ConfigError
from iwm_sim.study import cases, driving
from iwm_sim.study.cases import Case


def square(number):
    """Stands for a drive; a worker has to find it by name."""
    if number < 0:
        raise ConfigError("numbers", "", f"{number} has no place here")
    return number * number


def test_results_come_in_the_order_of_the_items_whoever_made_them():
    heard = []
    assert driving.on_all_cores(abs, [-3, 1, -2], 2, heard.append) == [3, 1, 2]
    assert sorted(heard) == [1, 2, 3]
    assert driving.on_all_cores(square, [3, 1, 2], 1, heard.append) == [9, 1, 4]


def test_an_error_of_one_ends_all_and_leaves_no_process():
    with pytest.raises(TypeError):
        driving.on_all_cores(len, [1, [2], [3]], 2)
    assert not [child for child in multiprocessing.active_children() if "SpawnProcess" in child.name]
    with pytest.raises(ConfigError, match="no place here"):
        driving.on_all_cores(square, [1, -1], 1)


def test_two_processes_drive_as_one_does(hill):
    base = Case(str(hill), "jalalmaab_2015", "none", 0.9, "equal")
    wanted = [base, dataclasses.replace(base, strategy="instantaneous"), dataclasses.replace(base, friction=0.2)]
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
