# SPDX-License-Identifier: Apache-2.0
"""What the pedals mean."""

from __future__ import annotations

import pytest

from iwm_power_manager.model.pedals import full_braking_w, full_power_w, pedal_power_w
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params


@pytest.mark.parametrize(("speed", "power"), [(20.0, 30e3), (5.0, 4 * 200.0 * 5.0 / 0.33), (0.0, 4 * 200.0 / 0.33)])
def test_the_full_accelerator_asks_for_what_the_motors_have(speed, power):
    assert full_power_w(speed, CAR) == pytest.approx(power)
    assert pedal_power_w(0.25, 0.0, speed, CAR) == pytest.approx(0.25 * power)


@pytest.mark.parametrize(("speed", "power"), [(20.0, 0.8 * 800.0 * 9.81 * 20.0), (0.0, 0.8 * 800.0 * 9.81)])
def test_the_full_brake_asks_for_its_deceleration(speed, power):
    assert full_braking_w(speed, CAR) == pytest.approx(power)
    assert pedal_power_w(0.0, 0.5, speed, CAR) == pytest.approx(-0.5 * power)


def test_the_brake_overrides_the_accelerator():
    assert pedal_power_w(1.0, 0.1, 10.0, CAR) == pedal_power_w(0.0, 0.1, 10.0, CAR) < 0.0
