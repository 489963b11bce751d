# SPDX-License-Identifier: Apache-2.0
"""Reading and setting a running node's parameters, and moving it through its lifecycle, without `ros2`."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest


@pytest.fixture(scope="module")
def pair(start_pair):
    return start_pair({"autostart": False})


def run(pair, *arguments: str) -> subprocess.CompletedProcess[str]:
    name = f"{pair.bench.node.get_namespace()}/power_manager"
    return subprocess.run(
        [sys.executable, "-m", "iwm_power_manager.tools.set_parameter", "--node", name, "--patience", "30", *arguments],
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
        env=dict(os.environ),
    )


def test_values_are_read_and_set_and_a_transition_is_made(pair) -> None:
    assert run(pair, "friction", "strategy").stdout == "friction: 0.9\nstrategy: equal\n"
    done = run(pair, "friction=1", "friction=0.4", "strategy=rule", "--transition", "configure")
    assert (done.returncode, done.stdout) == (0, "friction: 0.9 -> 0.4\nstrategy: equal -> rule\n")
    done = run(pair, "friction=1")
    assert (done.returncode, done.stdout) == (0, "friction: 0.4 -> 1.0\n")
    assert pair.bench.lifecycle_state() == "inactive"


@pytest.mark.parametrize(
    ("argument", "problem"),
    [
        ("friction=7.0", "friction"),
        ("=3", "'=3' is not allowed; allowed: NAME=VALUE"),
        ("frictoin=0.3", "frictoin: no such parameter; did you mean friction"),
    ],
)
def test_what_is_refused_is_one_line(pair, argument: str, problem: str) -> None:
    done = run(pair, argument)
    assert done.returncode == 1
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith("set_parameter: ")
    assert problem in line


def test_a_node_that_is_not_there_is_one_line(pair) -> None:
    done = run(pair, "--node", "/nobody/here", "--patience", "1")
    assert (done.returncode, done.stderr) == (
        1,
        "set_parameter: /nobody/here: no such node on this domain within 1 s\n",
    )
