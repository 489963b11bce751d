# SPDX-License-Identifier: Apache-2.0
"""Many tasks at once: results in order, an error of one ends all."""

import os

import psutil
import pytest

from iwm_power_manager.errors import ConfigError
from iwm_sim import cluster
from iwm_sim.cluster import on_all_cores


def square(number):
    """Stands for a drive; a worker has to find it by name."""
    if number < 0:
        raise ConfigError("numbers", "", f"{number} has no place here")
    return number * number


def workers():
    """Processes that this one has started to work for it."""
    found = psutil.Process().children(recursive=True)
    return {child.pid for child in found if any("spawn_main" in word for word in child.cmdline())}


def test_results_come_in_the_order_of_the_items_whoever_made_them():
    heard = []
    assert on_all_cores(abs, [-3, 1, -2], 2, heard.append) == [3, 1, 2]
    assert sorted(heard) == [1, 2, 3]
    assert on_all_cores(square, [3, 1, 2], 1, heard.append) == [9, 1, 4]


def test_an_error_of_one_ends_all_and_leaves_no_process():
    before = workers()
    with pytest.raises(TypeError):
        on_all_cores(len, [1, [2], [3]], 2)
    assert workers() <= before
    with pytest.raises(ConfigError, match="no place here"):
        on_all_cores(square, [1, -1], 1)


def test_without_the_library_one_process_does_all_and_says_so(monkeypatch, capsys):
    monkeypatch.setattr(cluster.importlib.util, "find_spec", lambda _: None)
    heard = []
    assert on_all_cores(lambda number: heard.append(number) or os.getpid(), range(3), 2) == [os.getpid()] * 3
    assert heard == [0, 1, 2]
    assert capsys.readouterr().err.count("pip install distributed") == 1
