# SPDX-License-Identifier: Apache-2.0
"""Many steps in one call are the steps one by one, bit by bit."""

from __future__ import annotations

import numpy as np

from iwm_power_manager.control import law
from iwm_power_manager.control.record import DECIDED_NAMES, SIGNALS, decided, measurement_of
from iwm_power_manager.control.repeat import advance, repeat
from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.control.table import empty_table
from iwm_power_manager.control.types import initial_state
from iwm_power_manager.held import Held
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle

VEHICLE = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params
STEPS = 300


def drive() -> np.ndarray:
    """Numbers of `SIGNALS`: driving, braking, slip, a failing motor, reverse; all but the measurements is nonsense."""
    random = np.random.default_rng(7)
    numbers = random.normal(size=(STEPS, len(SIGNALS)))
    speed = 8.0 * np.cos(0.02 * np.arange(STEPS))
    numbers[:, 0] = speed
    numbers[:, 1:5] = speed[:, None] / 0.33 * (1.0 + 0.05 * random.normal(size=(STEPS, 4)))
    numbers[:, 5] = 9e3 * np.sin(0.1 * np.arange(STEPS))
    numbers[:, 6:11] = 0.01, 0.9, 3e4, 2e4, 0.7
    numbers[:, 11:15] = random.integers(0, 2, size=(STEPS, 4))
    numbers[:, 15] = np.where(speed < -2.0, -1.0, 1.0)
    numbers[:, 16:20] = 0.0
    return numbers


def test_steps_in_one_call_are_those_one_by_one() -> None:
    numbers = drive()
    settings = default_settings("instantaneous_slip")
    results = np.full((STEPS, len(DECIDED_NAMES)), np.nan)
    end = repeat(numbers, initial_state(), settings, VEHICLE, empty_table(), results)
    state = initial_state()
    for row, result in zip(numbers.tolist(), results, strict=True):
        command, after = law.step(measurement_of(row), state, settings, VEHICLE, empty_table())
        assert tuple(result) == decided(command, state, after)
        state = after
    assert end == state
    assert np.ptp(results[:, :8], axis=0).min() > 1.0


def test_a_step_between_held_memories_is_the_same() -> None:
    numbers = drive()
    settings = default_settings("instantaneous_slip")
    state = initial_state()
    before, after, car = Held(state), Held(state), Held(VEHICLE)
    for row in numbers[:60].tolist():
        measurement = measurement_of(row)
        command, state = law.step(measurement, before.value, settings, VEHICLE, empty_table())
        found, values, friction = advance(measurement, before, after, settings, car, empty_table())
        assert found == command
        assert after.value == state
        assert values == decided(command, before.value, state)
        assert friction == state.friction.assumed
        before, after = after, before


def test_cut_in_blocks_it_is_the_same() -> None:
    numbers = drive()
    settings = default_settings("instantaneous_slip")
    whole, parts = np.empty((2, STEPS, len(DECIDED_NAMES)))
    end = repeat(numbers, initial_state(), settings, VEHICLE, empty_table(), whole)
    state = initial_state()
    for part in (slice(0, 1), slice(1, 1), slice(1, 120), slice(120, STEPS)):
        state = repeat(numbers[part], state, settings, VEHICLE, empty_table(), parts[part])
    assert state == end
    assert np.array_equal(whole, parts)
