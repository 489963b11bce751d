# SPDX-License-Identifier: Apache-2.0
"""What is missing by the counter of one publisher, and nothing by those of several."""

from __future__ import annotations

from pathlib import Path

import pytest

from bags_helpers import float64, topic
from iwm_power_manager.bags.losses import Losses
from iwm_power_manager.bags.recover import recover
from iwm_power_manager.bags.writer import BagWriter


def taken(numbers: list[int]) -> Losses:
    losses = Losses()
    for number in numbers:
        losses.take(number)
    return losses


@pytest.mark.parametrize(
    ("numbers", "missing"),
    [
        ([], 0),
        ([7, 8, 9], 0),
        ([7, 9, 12], 3),
        ([1, 2, 5, 6, 1, 2, 4], 3),
        ([5, 6, 7, 3, 4, 5, 7, 3, 4, 6], 2),
    ],
    ids=["none", "whole", "gaps", "started again", "started again twice"],
)
def test_what_one_publisher_left_out_is_counted_also_where_it_was_started_again(
    numbers: list[int], missing: int
) -> None:
    losses = taken(numbers)
    assert (losses.count, losses.several) == (missing, False)


@pytest.mark.parametrize(
    "numbers",
    [
        [600, 601, 1, 602, 2, 603],
        [1, 500, 2, 501, 3],
        [1, 2, 500, 3, 4],
        [2, 1, 3, 2, 4, 5, 3],
        [1, 2, 3, 3, 4, 4, 9, 5],
    ],
    ids=["a younger one", "an older one", "once", "nearly alike", "alike, with a loss"],
)
def test_numbers_that_go_back_and_forth_are_of_several_and_nothing_is_counted(numbers: list[int]) -> None:
    losses = taken(numbers)
    assert (losses.count, losses.several) == (0, True)


def test_two_publishers_of_one_topic_have_lost_nothing_by_the_numbers_in_a_bag(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        both, one = bag.add_topic(topic("/both")), bag.add_topic(topic("/one"))
        for step in range(50):
            bag.write(both, step, float64(0.0), step, 200 + step)
            bag.write(both, step, float64(0.0), step, 1 + step)
            bag.write(one, step, float64(0.0), step, 1 + step + (step > 9))
    assert recover(tmp_path / "bag").missing == {"/one": 1}


def test_a_counter_that_passes_its_largest_after_it_went_back_is_another_s():
    losses = Losses()
    for number in (100, 1, 101):
        losses.take(number)
    assert losses.several
