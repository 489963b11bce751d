# SPDX-License-Identifier: Apache-2.0
"""The battery's estimation: what the static circuit says, and that the fit finds it."""

import math

import numpy as np
import pytest

from iwm_sim.study import battery_fit

POWER_W = np.concatenate([np.full(500, 8000.0), np.full(300, -4000.0), np.zeros(200)])


def test_soc_of_the_model_is_the_integral_of_eq_21_and_22():
    soc = battery_fit.soc_of_model(POWER_W, 0.1, 0.063, 237.6, 200.0, 0.8)
    expected = [0.8]
    for power in POWER_W[:-1]:
        current = (237.6 - math.sqrt(237.6**2 - 4.0 * 0.063 * power)) / (2.0 * 0.063)
        expected.append(expected[-1] - current * 0.1 / (3600.0 * 200.0))
    np.testing.assert_allclose(soc, expected, rtol=0.0, atol=1e-12)


def test_a_lossless_circuit_takes_the_power_over_the_voltage():
    soc = battery_fit.soc_of_model(POWER_W, 0.1, 0.0, 250.0, 200.0, 0.8)
    assert soc[1] == pytest.approx(0.8 - 8000.0 / 250.0 * 0.1 / 720000.0, abs=1e-15)


def test_more_resistance_depletes_more_in_driving_and_charges_less_in_braking():
    low, high = (battery_fit.soc_of_model(POWER_W, 0.1, ohm, 237.6, 200.0, 0.8) for ohm in (0.02, 0.2))
    assert high[500] < low[500]
    assert high[799] - high[500] < low[799] - low[500]


def test_the_fit_is_a_minimum_and_the_error_has_its_1_over_n(hill):
    fit = battery_fit.fit("jalalmaab_2015", "none", [str(hill)])
    nominal, plant, free, file = (fit.estimates[name] for name in battery_fit.CIRCUITS)
    for estimate in (plant, nominal):
        assert estimate.rmse <= file.rmse or estimate is plant
        assert estimate.rmse == pytest.approx(estimate.rmse_by_cycle["hill"])
    assert free.rmse <= min(plant.rmse, nominal.rmse) * (1.0 + 1e-3)
    assert plant.voltage_v > nominal.voltage_v  # an LFP cell at 80 % stands above 3.3 V
    comparison = fit.comparison
    assert len(comparison.time_s) == len(comparison.model_soc) == len(comparison.plant_speed_mps)
    assert np.abs(comparison.plant_speed_mps - comparison.model_speed_mps).max() < 0.05
    shown = fit.text()
    assert f"{plant.resistance_ohm:.4f}" in shown
