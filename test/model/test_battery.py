# SPDX-License-Identifier: Apache-2.0
"""The control model's battery against the circuit it stands for."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iwm_power_manager.model import battery as model
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle
from oracles.physics import battery_w

BATTERY = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params.battery
VOLT = 72.0 * 3.3


@given(st.floats(-100e3, 200e3), st.floats(0.01, 1.0))
def test_the_current_gives_the_power_at_the_terminals(power, resistance):
    current = model.current_a(power, VOLT, resistance)
    if power < VOLT**2 / (4.0 * resistance):
        assert current * (VOLT - resistance * current) == pytest.approx(power, rel=1e-6, abs=1e-6)
    else:
        assert current == pytest.approx(VOLT / (2.0 * resistance))


def test_no_power_takes_no_current_and_charging_current_is_negative():
    assert model.current_a(0.0, VOLT, 0.063) == 0.0
    assert model.current_a(-5000.0, VOLT, 0.063) < 0.0
    assert model.current_a(1e-9, VOLT, 0.063) == pytest.approx(1e-9 / VOLT, rel=1e-12)


@given(st.floats(-60e3, 300e3))
def test_the_cells_give_the_power_and_the_loss(power):
    assert model.chemical_power_w(power, BATTERY) == pytest.approx(battery_w(power, BATTERY), rel=1e-9, abs=1e-6)


def test_the_pack_s_energy_is_emptied_once():
    # 72 cells x 3.3 V x 200 Ah = 47.52 kWh
    assert model.depletion_per_joule(BATTERY) * 47520.0 * 3600.0 == pytest.approx(1.0)
