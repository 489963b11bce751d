# SPDX-License-Identifier: Apache-2.0
"""Counted transitions: what was driven is what is counted, kept, and given to the solver."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from iwm_power_manager.errors import ConfigError
from iwm_power_manager.mdp.demand import chain_of, count_steps, signal_source
from iwm_power_manager.mdp.demand_counts import (
    DemandCounter,
    load_transitions,
    save_transitions,
    transitions_source,
    walk_through,
)
from iwm_power_manager.mdp.problem import load_problem
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle

POWER_W = np.array([-2000.0, -500.0, 0.0, 1000.0, 3000.0])
SPEED_MPS = np.array([0.0, 2.0, 10.0])
STEP_NS = 10_000_000


def counter(**options: Any) -> DemandCounter:
    return DemandCounter(POWER_W, SPEED_MPS, 0.1, **options)


def drive(count: DemandCounter, power_w: np.ndarray, speed_mps: np.ndarray, start_ns: int = 0) -> None:
    """A control step each 10 ms; the values are those of every tenth, garbage in between must not matter."""
    for k in range(10 * power_w.size):
        if k % 10 == 0:
            count.add(start_ns + k * STEP_NS, float(speed_mps[k // 10]), float(power_w[k // 10]))
        else:
            count.add(start_ns + k * STEP_NS, 99.0, 1e9)


@given(st.lists(st.floats(-3000.0, 4000.0), min_size=1, max_size=60), st.integers(0, 10**18), st.integers(0, 2**32 - 1))
def test_every_tenth_step_is_counted_as_the_solver_counts_a_sequence(
    powers: list[float], start_ns: int, seed: int
) -> None:
    power, speed = np.array(powers), np.random.default_rng(seed).uniform(-0.5, 12.0, len(powers))
    count = counter()
    drive(count, power, speed, start_ns)
    found = count.transitions()
    assert np.array_equal(found.counts.sum(axis=0), count_steps(POWER_W, power))
    by_speed = np.bincount([np.argmin(np.abs(SPEED_MPS - v)) for v in speed[1:]], minlength=3)
    assert np.array_equal(found.counts.sum(axis=(1, 2)), by_speed)
    assert found.clipped == np.count_nonzero((power < -2000.0) | (power > 3000.0))
    assert found.total == count.total == power.size - 1


@given(st.lists(st.integers(-4_000_000, 4_000_000), min_size=2, max_size=200))
def test_steps_that_are_not_quite_on_time_lose_no_transition(jitter_ns: list[int]) -> None:
    count = counter()
    for k, late in enumerate(jitter_ns):
        count.add(10**9 + k * STEP_NS + late, 1.0, 0.0)
    samples = 1 + (len(jitter_ns) - 1) // 10
    assert abs(count.total - (samples - 1)) <= 1  # the first and the last may fall to either side


@pytest.mark.parametrize("how", ["gap", "back", "pause"])
def test_no_transition_leads_over_a_gap_a_jump_back_or_a_pause(how: str) -> None:
    count = counter()
    drive(count, np.array([0.0, 0.0]), np.zeros(2))
    if how == "pause":
        count.pause()
    drive(count, np.array([3000.0, 3000.0, 3000.0]), np.zeros(3), {"gap": 10**9, "back": 0, "pause": 2 * 10**8}[how])
    found = count.transitions().counts.sum(axis=0)
    assert found[2, 2] == 1
    assert found[4, 4] == 2
    assert found.sum() == 3


def test_counts_are_kept_in_a_file_and_gone_on_from(tmp_path: Path) -> None:
    first = counter()
    drive(first, np.array([0.0, 900.0, 5000.0]), np.array([0.0, 2.0, 9.0]))
    save_transitions(first.transitions(), tmp_path / "log.npz")
    before = load_transitions(tmp_path / "log.npz")
    assert before.fits(POWER_W, SPEED_MPS, 0.1)
    assert not before.fits(POWER_W, SPEED_MPS, 0.2)
    assert not before.fits(POWER_W[1:], SPEED_MPS, 0.1)
    assert np.array_equal(before.counts, first.transitions().counts)
    second = counter(before=before)
    drive(second, np.array([0.0, 900.0]), np.array([0.0, 2.0]))
    assert (second.total, second.transitions().clipped) == (3, 1)
    assert second.transitions().counts[1, 2, 3] == 2
    assert np.array_equal(before.counts, first.transitions().counts)  # the copy that was read stays as it is


@given(st.integers(0, 2**32 - 1), st.integers(1, 60))
def test_walks_make_each_transition_as_often_as_it_was_counted(seed: int, size: int) -> None:
    draw = np.random.default_rng(seed)
    counts = np.zeros((3, 5, 5), dtype=np.int64)
    np.add.at(counts, tuple(draw.integers(0, (3, 5, 5), (size, 3)).T), 1)
    again = np.zeros_like(counts)
    for bins, speeds in walk_through(counts):
        assert bins.size == speeds.size >= 2
        np.add.at(again, (speeds[1:], bins[:-1], bins[1:]), 1)
    assert np.array_equal(again, counts)


def test_the_solver_gets_the_same_chain_as_from_the_drive_itself(tmp_path: Path) -> None:
    car = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params
    problem = load_problem(share_path("config/grids/coupled.yaml")).for_car(car)
    draw = np.random.default_rng(7)
    # On the axes' points, so that nothing is rounded on the way.
    power = problem.power_w[np.clip(np.cumsum(draw.integers(-3, 4, 3000)) % problem.power_w.size, 0, None)]
    speed = problem.speed_mps[np.cumsum(draw.integers(0, 2, 3000)) % problem.speed_mps.size]
    count = DemandCounter(problem.power_w, problem.speed_mps, problem.dt_s)
    for k in range(power.size):
        count.add(k * round(problem.dt_s * 1e9), float(speed[k]), float(power[k]))
    save_transitions(count.transitions(), tmp_path / "log.npz")
    source = transitions_source(tmp_path / "log.npz", problem.dt_s, 3.0)
    assert (source.name, source.steps, source.weight) == ("log.npz", 2999, 3.0)
    learned = chain_of(problem, [source])
    wanted = chain_of(
        problem, [signal_source("drive", np.arange(3000) * problem.dt_s, power, problem.dt_s, 3.0, speed)]
    )
    assert learned.row_steps == pytest.approx(wanted.row_steps)
    assert learned.probability == pytest.approx(wanted.probability)
    assert learned.by_speed == pytest.approx(wanted.by_speed)


def test_counts_at_another_step_or_none_at_all_are_refused(tmp_path: Path) -> None:
    count = counter()
    save_transitions(count.transitions(), tmp_path / "log.npz")
    with pytest.raises(ConfigError, match=r"log\.npz: counts: holds no transition yet"):
        transitions_source(tmp_path / "log.npz", 0.1)
    with pytest.raises(ConfigError, match=r"log\.npz: dt_s: 0\.1 s is not the grid's step; allowed: 0\.5 s"):
        transitions_source(tmp_path / "log.npz", 0.5)


def members(path: Path) -> dict[str, Any]:
    with np.load(path) as archive:
        return dict(archive)


def changed(**values: Any) -> Any:
    return lambda found: found | {name: np.asarray(value) for name, value in values.items()}


def changed_metadata(**values: Any) -> Any:
    def change(found: dict[str, Any]) -> dict[str, Any]:
        metadata = json.loads(found["metadata"].tobytes()) | values
        return found | {"metadata": np.frombuffer(json.dumps(metadata).encode(), dtype=np.uint8)}

    return change


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda found: {"power_w": found["power_w"]}, "is no file of demand transitions, or a damaged one"),
        (changed(metadata=np.frombuffer(b"{", dtype=np.uint8)), "is no file of demand transitions"),
        (changed_metadata(format="other"), "format: 'other' is unknown"),
        (changed_metadata(format_version=2), "format_version: 2 cannot be read; allowed: 1"),
        (changed_metadata(dt_s=0.0), "is damaged: dt_s or clipped is out of range"),
        (changed_metadata(clipped="x"), "is damaged: "),
        (changed(power_w=[1.0, 0.0]), "is damaged: power_w does not rise"),
        (changed(speed_mps=[np.nan]), "is damaged: speed_mps is no axis"),
        (changed(counts=[1]), "is damaged: cells and counts do not fit"),
        (changed(cells=[[0, 0, 9]], counts=[1]), "is damaged: a cell or a count is out of range"),
        (changed(cells=[[0, 0, 0]], counts=[-1]), "is damaged: a cell or a count is out of range"),
    ],
)
def test_a_damaged_file_gets_one_clear_line(tmp_path: Path, change: Any, line: str) -> None:
    count = counter()
    drive(count, np.array([0.0, 900.0, 5000.0]), np.zeros(3))
    save_transitions(count.transitions(), tmp_path / "log.npz")
    np.savez(tmp_path / "bad.npz", **change(members(tmp_path / "log.npz")))
    with pytest.raises(ConfigError) as caught:
        load_transitions(tmp_path / "bad.npz")
    assert line in str(caught.value)
    assert "\n" not in str(caught.value)


@given(st.floats(0.0, 1.0, exclude_max=True))
def test_a_file_cut_anywhere_is_refused(cut: float) -> None:
    import tempfile

    count = counter()
    drive(count, np.array([0.0, 900.0]), np.zeros(2))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.npz"
        save_transitions(count.transitions(), path)
        content = path.read_bytes()
        path.write_bytes(content[: int(cut * len(content))])
        with pytest.raises(ConfigError, match=r"log\.npz"):
            load_transitions(path)
