# SPDX-License-Identifier: Apache-2.0
"""A policy or a vehicle from a stranger: refused, and the node says why."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter


def faults(node) -> list[str]:
    return [status.message for status in node.own_statuses() if status.name == "fault"]


def garbage(path: Path) -> None:
    path.write_bytes(bytes(range(256)) * 40)


def bomb(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("front_share.npy", bytes(2**28))


def other_arrays(path: Path) -> None:
    np.savez(path, friction=np.nan, front_share=np.array([{}], dtype=object))


def aliases(path: Path) -> None:
    names = "abcdefghij"
    doubled = (f"{name}: &{name} [*{before}, *{before}]\n" for before, name in pairwise(names))
    path.write_text("a: &a [x, x]\n" + "".join(doubled))


@pytest.mark.parametrize("key", ["policy_file", "vehicle_file"])
@pytest.mark.parametrize("spoil", [garbage, bomb, other_arrays, aliases, Path.mkdir, os.mkfifo])
def test_a_hostile_policy_or_vehicle_is_refused_with_the_reason_in_the_diagnostics(
    node, tmp_path: Path, key: str, spoil: Callable[[Path], None]
) -> None:
    path = tmp_path / ("stranger.npz" if key == "policy_file" else "stranger.yaml")
    spoil(path)
    wanted = {key: str(path), "strategy": "sdp"}  # which needs a policy
    assert all(
        done.successful
        for done in node.set_parameters([Parameter(name, value=value) for name, value in wanted.items()])
    )
    assert node.trigger_configure() == TransitionCallbackReturn.FAILURE
    assert node.lifecycle_state() == "unconfigured"
    (reason,) = faults(node)
    assert reason.isprintable()
    assert len(reason) <= 1000
    assert "stranger" in reason
