# SPDX-License-Identifier: Apache-2.0
"""Which policy runs: the bank by friction, what is refused, and the fallback."""

from __future__ import annotations

import dataclasses
import os

import numpy as np
import pytest

from iwm_power_manager.errors import PolicyError
from iwm_power_manager.mdp.demand import Source, demand_chain
from iwm_power_manager.mdp.problem import load_problem
from iwm_power_manager.nodes.policy_choice import choose_policies
from iwm_power_manager.policy import Policy, load_policy, save_policy
from iwm_power_manager.ros.diagnostics import OK, WARN
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml"))
RULE = [0.0, 0.5, 0.0, 0.5]
AXES = {
    "power_w": np.array([-6000.0, 0.0, 6000.0]),
    "speed_mps": np.array([0.0, 20.0]),
    "slip_front": np.array([-0.35, 0.0]),
    "slip_rear": np.array([-0.35, 0.0]),
    "share": np.array([0.0, 0.5, 1.0]),
}


def write_policy(path, friction: float, vehicle=CAR) -> str:
    """Write a policy nobody solved: whole and consistent, and that is all that counts here; returns its checksum."""
    problem = dataclasses.replace(
        load_problem(share_path("config/grids/fine.yaml")), name="tiny", **AXES, previous_share=True, discount=0.9
    )
    source = Source("drive", "ab" * 32, 1.0, (np.array([0.0, 6000.0, 0.0, -6000.0, 0.0]),))
    policy = Policy(
        problem=problem,
        friction=friction,
        front_share=np.full(problem.shape, friction),
        cost_j=np.zeros(problem.shape),
        dearer_cost_j=np.zeros((0, *problem.shape)),
        trials=(),
        chain=demand_chain(problem.power_w, [source]),
        vehicle_name=vehicle.name,
        vehicle_hash=vehicle.hash,
        idle_drive=vehicle.idle_drive,
        sources=({"name": "drive", "sha256": "ab" * 32, "weight": 1.0, "steps": 4},),
        iterations=(),
        bound_j=0.0,
        converged=True,
        package_version="0",
        checksum="",
    )
    save_policy(policy, path)
    return load_policy(path).checksum


@pytest.fixture
def bank(tmp_path):
    for friction in (0.2, 0.5, 0.9):
        write_policy(tmp_path / f"mu_{friction}.npz", friction)
    return tmp_path


@pytest.mark.parametrize(("friction", "nearest"), [(0.9, 0.9), (1.2, 0.9), (0.55, 0.5), (0.25, 0.2), (0.05, 0.2)])
def test_the_policy_for_the_nearest_friction_is_used_and_named(bank, friction, nearest) -> None:
    policies = choose_policies(str(bank), "sdp", "none", RULE, CAR)
    assert policies.table(friction).front_share.flat[0] == nearest
    assert len(policies.tables()) == 3
    status = policies.status()
    assert (status.level, status.message) == (OK, "sdp")
    assert status.values["friction"] == f"{nearest:g}"
    assert status.values["vehicle hash"] == CAR.hash


def test_the_identity_is_the_files_checksum(tmp_path) -> None:
    checksum = write_policy(tmp_path / "one.npz", 0.9)
    policies = choose_policies(str(tmp_path / "one.npz"), "sdp", "none", RULE, CAR)
    policies.table(0.9)
    assert policies.status().values["checksum"] == checksum


def test_a_policy_for_another_car_is_refused(tmp_path) -> None:
    other = load_vehicle(CAR.path, "enabled" if CAR.idle_drive != "enabled" else "none")
    write_policy(tmp_path / "other.npz", 0.9, other)
    with pytest.raises(PolicyError, match="holds no policy for"):
        choose_policies(str(tmp_path), "sdp", "none", RULE, CAR)


@pytest.mark.parametrize("path", ["", "/nowhere", "config"])
def test_a_strategy_that_needs_a_policy_is_refused_without_one(path) -> None:
    with pytest.raises(PolicyError):
        choose_policies(path, "sdp_lookahead", "none", RULE, CAR)


def test_the_fallback_runs_equal_and_remembers_why() -> None:
    policies = choose_policies("/nowhere", "sdp", "equal", RULE, CAR)
    assert policies.strategy == "equal"
    assert "/nowhere" in policies.fallback_reason
    assert policies.table(0.9).front_share.shape == (1, 1, 1, 1, 1)
    assert policies.status().level == WARN
    assert "fallback to equal" in policies.status().message
    assert "/nowhere" in policies.problem_with("sdp")
    assert policies.problem_with("instantaneous") == ""


def test_a_strategy_that_needs_no_policy_runs_without_one_and_says_what_it_lacks() -> None:
    policies = choose_policies("/nowhere", "equal", "none", RULE, CAR)
    assert policies.strategy == "equal"
    assert policies.fallback_reason == ""
    assert policies.status().level == OK
    assert "/nowhere" in policies.problem_with("sdp")
    assert len(policies.tables()) == 1


def test_with_a_policy_every_strategy_may_run(bank) -> None:
    policies = choose_policies(str(bank), "equal", "none", RULE, CAR)
    assert policies.problem_with("sdp") == ""
    assert policies.problem_with("sdp_lookahead") == ""


def test_a_file_that_changes_on_disk_is_told_and_does_not_matter(bank) -> None:
    policies = choose_policies(str(bank), "sdp", "none", RULE, CAR)
    before = policies.table(0.5)
    file = bank / "mu_0.5.npz"
    os.utime(file, ns=(1, 1))
    assert policies.status().level == WARN
    assert "mu_0.5.npz changed on disk" in policies.status().message
    assert policies.table(0.5) is before
    file.unlink()
    assert policies.status().level == WARN


def test_the_coefficients_of_the_rule_reach_every_table(bank) -> None:
    rule = [1.0, 0.2, 3.0, 0.4]
    assert list(choose_policies(str(bank), "rule", "none", rule, CAR).table(0.9).rule) == rule
    assert list(choose_policies("", "rule", "none", rule, CAR).table(0.9).rule) == rule
