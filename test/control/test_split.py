# SPDX-License-Identifier: Apache-2.0
"""The power split within a step of the law: what the strategy is asked with, and how its answer is applied."""

from __future__ import annotations

import numpy as np
import pytest

from iwm_power_manager.control import law
from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.control.table import empty_table
from iwm_power_manager.control.types import Measurement, initial_state
from iwm_power_manager.share import share_path
from iwm_power_manager.vehicle import load_vehicle

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params
SPEED = 12.0


def shared_by_slip_of(axle):
    """A policy whose front share is the slip of one axle, ten times over, on top of a half."""
    slips = np.array([-0.05, 0.0, 0.05])
    shape = [1, 1, 1, 1, 1]
    shape[2 if axle == "front" else 3] = 3
    flat = np.zeros(1)
    return empty_table()._replace(
        slip_front=slips if axle == "front" else flat,
        slip_rear=slips if axle == "rear" else flat,
        front_share=(0.5 + 10.0 * slips).reshape(shape),
        expected_cost_j=np.zeros(shape),
    )


@pytest.mark.parametrize("axle", ["front", "rear"])
def test_a_strategy_is_asked_with_each_axle_s_own_slip(axle):
    rolling = SPEED / CAR.front.wheel.radius_m
    front, rear = rolling / 0.98, rolling / 0.97
    measurement = Measurement(
        speed_mps=SPEED,
        wheel_speed_radps=(front, front, rear, rear),
        power_demand_w=3000.0,
        dt_s=0.01,
        friction=0.9,
        discharge_limit_w=30e3,
        charge_limit_w=30e3,
        soc=0.6,
    )
    command, _ = law.step(measurement, initial_state(), default_settings("sdp"), CAR, shared_by_slip_of(axle))
    assert command.decided_share == pytest.approx(0.7 if axle == "front" else 0.8, abs=1e-6)
