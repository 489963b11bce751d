# SPDX-License-Identifier: Apache-2.0
"""Not to know the friction of the road costs nothing: a few of the cells and jumps that `make roads` drives all of."""

from __future__ import annotations

import pytest

from campaigns import unknown_friction as unknown
from campaigns.road_page import unknown as page
from iwm_sim.scenario import DEFAULT_VEHICLE, Demand

BRAKES, BRAKES_GENTLY, DRIVES = unknown.DEMANDS[:3]


@pytest.mark.parametrize(
    ("name", "speed_mps", "demand"),
    [
        ("0.9 to 0.2", 20.0, BRAKES),
        ("0.2 to 0.9", 20.0, BRAKES),
        ("0.5 to 0.2", 30.0, BRAKES_GENTLY),
        ("0.9 to split", 20.0, BRAKES_GENTLY),
        ("split to its mirror image", 30.0, BRAKES),
        ("0.9 to 0.2", 10.0, DRIVES),
    ],
)
def test_a_second_after_a_jump_nothing_skids_longer_than_where_the_friction_is_told(name, speed_mps, demand):
    found = unknown.jumped(unknown.jump(name, speed_mps, demand))
    assert found.no_worse
    assert found.road == name
    assert max(found.estimated) <= 0.1


def test_a_car_that_stands_when_the_second_is_over_has_no_figures():
    found = unknown.jumped(unknown.jump("0.9 to 0.2", 5.0, Demand(1.0, "brake", 1.0)))
    assert found.told == found.estimated == (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def slippery():
    return unknown.savings([("nycc", 0.5, "drag")], 1, DEFAULT_VEHICLE, "policies")


def test_a_slippery_town_saves_as_much_as_where_the_friction_is_told(slippery):
    (cell,) = slippery
    assert cell.told_percent is not None
    assert cell.told_percent > 0.2
    assert not unknown.differs(cell)


def test_the_page_tells_each_cell_and_each_jump(slippery):
    jump = unknown.Jumped(unknown.jump("0.9 to 0.2", 10.0, DRIVES), (0.0, 0.0, 0.1), (0.0, 0.0, 0.25))
    text = page([*slippery, slippery[0]._replace(estimated_percent=None)], [jump])
    assert "1 of 2 differ by more than 0.02 points, 1 have a saving both ways" in text
    assert "| nycc | 0.5 | drag |" in text
    assert "| 0.9 to 0.2 | 0.00 / 0.00 | 0.00 / 0.00 | 0.10 / 0.25 |" in text
    assert "1 of all 1 drives is worse" in text


def test_every_cell_of_the_study_and_every_jump_is_in_the_whole():
    assert len(set(unknown.all_cells())) == 24
    names = [scenario.name for scenario in unknown.all_jumps()]
    assert len(set(names)) == len(unknown.JUMPS) * 15
