# SPDX-License-Identifier: Apache-2.0
"""Depletion over the split: symmetric where it must be, and nothing where a motor cannot."""

import numpy as np
import pytest

from iwm_power_manager.model.battery import current_a
from iwm_power_manager.model.motor import electrical_power_w
from iwm_sim.study import sensitivity
from iwm_sim.study.cases import vehicle_of


@pytest.fixture(scope="module")
def car():
    return vehicle_of("jalalmaab_2015", "none").params


def test_depletion_is_that_of_the_current_over_a_step(car):
    w = 10.0 / 0.33 / 0.99
    power = 2.0 * sum(electrical_power_w(axle_w / (2.0 * w), w, car.front.motor) for axle_w in (2000.0, 3000.0))
    current = current_a(power, 72 * 3.3, car.battery.resistance_ohm)
    expected = 100.0 * current * 0.1 / (3600.0 * 200.0)
    assert sensitivity.depletion_percent(2000.0, 5000.0, 10.0, 0.01, 0.01, car) == pytest.approx(expected, rel=1e-12)


def test_equal_slips_make_front_and_rear_exchangeable(car):
    for made in sensitivity.figure_8(car):
        depletion = np.array(made.delta_soc_percent)
        np.testing.assert_allclose(depletion, depletion[::-1], rtol=1e-9)


def test_a_slipping_front_axle_is_a_reason_to_drive_with_the_rear(car):
    # Its wheel turns twice as fast as the car moves: for the same power less torque, but power that moves nothing.
    low, _, high = sensitivity.figure_9(car)
    assert sensitivity.best_front_share(low) == pytest.approx(0.5, abs=0.01)
    assert sensitivity.best_front_share(high) != pytest.approx(0.5, abs=0.05)


def test_a_split_no_motor_can_drive_has_no_depletion(car):
    assert np.isnan(sensitivity.depletion_percent(8000.0, 8000.0, 2.0, 0.01, 0.01, car))
    assert np.isnan(sensitivity.best_front_share(sensitivity.Curve("none", [0.0, 1.0], [np.nan, np.nan])))
