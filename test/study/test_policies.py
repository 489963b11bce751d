# SPDX-License-Identifier: Apache-2.0
"""Which policy drives: the one that fits, or one that is solved now, or a clear refusal."""

import shutil

import pytest

from iwm_power_manager.errors import IwmError, PolicyError
from iwm_power_manager.policy import load_policy
from iwm_power_manager.vehicle import with_params
from iwm_sim.study import policies
from iwm_sim.study.cases import vehicle_of
from iwm_sim.study.policies import PolicySource

VEHICLE = "jalalmaab_2015"


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """A user's cache that is empty."""
    monkeypatch.setattr(policies, "cache_folder", lambda: tmp_path / "cache")
    return tmp_path / "cache"


def test_a_folder_is_searched_with_its_subfolders_and_other_cars_do_not_count(tmp_path, small_policy):
    (tmp_path / "none").mkdir()
    shutil.copy(small_policy, tmp_path / "none" / "a.npz")
    source = PolicySource(str(tmp_path))
    assert source.find(vehicle_of(VEHICLE, "none"), 0.5) == str(tmp_path / "none" / "a.npz")
    words = r"holds no policy for 'jalalmaab_2015' with idle_drive drag \(it has some with idle_drive none\); solve one"
    with pytest.raises(PolicyError, match=words):
        source.find(vehicle_of(VEHICLE, "drag"), 0.5)
    car = vehicle_of(VEHICLE, "none")
    heavier = car.params._replace(chassis=car.params.chassis._replace(mass_kg=1000.0))
    with pytest.raises(PolicyError, match=r"\(it has some from before a number of the car changed\); solve one"):
        source.find(with_params(car, car.name, heavier), 0.5)


def test_a_file_that_was_named_has_to_fit(small_policy):
    source = PolicySource(str(small_policy))
    assert source.find(vehicle_of(VEHICLE, "none"), 0.2) == str(small_policy)
    with pytest.raises(PolicyError, match="was solved for"):
        source.find(vehicle_of(VEHICLE, "drag"), 0.9)


def test_a_place_that_is_not_there_is_an_error(tmp_path):
    with pytest.raises(PolicyError, match="neither a policy file nor a folder"):
        PolicySource(str(tmp_path / "nowhere")).find(vehicle_of(VEHICLE, "none"), 0.9)


def test_what_is_missing_is_solved_once_and_kept(cache, small_grid, hill, monkeypatch):
    monkeypatch.setattr(policies.solved, "__defaults__", (*policies.solved.__defaults__[:2], (str(hill),)))
    said = []
    source = PolicySource("policies", str(small_grid), say=said.append)
    file = source.find(vehicle_of(VEHICLE, "drag"), 0.35)
    policy = load_policy(file)
    assert policy.friction == 0.35
    assert policy.idle_drive == "drag"
    assert len(said) == 1
    assert "solving the policy on grid small for friction 0.35" in said[0]
    assert source.find(vehicle_of(VEHICLE, "drag"), 0.35) == file
    assert len(said) == 1


def test_a_damaged_policy_in_the_cache_is_solved_again(cache, small_grid, hill):
    file = policies.solved(vehicle_of(VEHICLE, "none"), 0.9, str(small_grid), cycles=(str(hill),))
    whole = load_policy(file).checksum
    with open(file, "r+b") as stream:
        stream.truncate(1000)
    assert policies.solved(vehicle_of(VEHICLE, "none"), 0.9, str(small_grid), cycles=(str(hill),)) == file
    assert load_policy(file).checksum == whole


def test_a_grid_that_is_wrong_is_reported_in_the_solvers_words(tmp_path, cache, hill):
    grid = tmp_path / "bad.yaml"
    grid.write_text("format: 1\n")
    with pytest.raises(IwmError, match="is missing"):
        policies.solved(vehicle_of(VEHICLE, "none"), 0.9, str(grid), cycles=(str(hill),))
