# SPDX-License-Identifier: Apache-2.0
"""Whether a demand can have moved the car: by its energy and the car's, second by second."""

from __future__ import annotations

import numpy as np
import pytest

from iwm_power_manager.trace_units import Energies

MASS_KG = 850.0


def said(demand_of, step_s):
    """What is said of a car that speeds up and slows down by turns, `demand_of` its kinetic power."""
    energies, speed_mps = Energies(MASS_KG), 8.0
    energies.add(speed_mps, 0.0, 0.0)
    for k in range(round(60.0 / step_s)):
        before_mps, speed_mps = speed_mps, speed_mps + (1.0 if k * step_s % 8.0 < 4.0 else -1.0) * step_s
        kinetic_w = 0.5 * MASS_KG * (speed_mps**2 - before_mps**2) / step_s
        energies.add(speed_mps, demand_of(kinetic_w), step_s)
    return energies.apart()


@pytest.mark.parametrize("step_s", [0.01, 0.1, 1.0])
def test_a_demand_in_kilowatts_is_said_however_often_it_comes(step_s):
    assert said(lambda kinetic_w: 1e-3 * kinetic_w, step_s).endswith("is it in kW?")
    assert not said(lambda kinetic_w: kinetic_w, step_s)


@pytest.mark.parametrize("demand_w", [0.0, 1000.0, -5000.0])
def test_a_demand_that_stands_while_the_car_speeds_up_is_said(demand_w):
    assert said(lambda _: demand_w, 0.1).startswith("power_demand does not change, and yet the car speeds up")
    assert not said(lambda _: 20_000.0, 0.1)  # that may be what moves a heavier car


def test_of_a_demand_that_has_nothing_to_do_with_the_motion_nothing_is_said():
    for seed in range(20):
        random = np.random.default_rng(seed)
        assert not said(lambda _, random=random: float(random.normal(0.0, 1.0)), 0.1)
