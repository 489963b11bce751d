# SPDX-License-Identifier: Apache-2.0
"""What each way to say a demand means to a car at rest, through the law: docs/connect.md promises it."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from rclpy.serialization import serialize_message

from iwm_power_manager.control.controller import Controller, ControllerLimits
from iwm_power_manager.control.monitor import BatteryReading, JointReading, SpeedReading
from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.control.table import empty_table
from iwm_power_manager.control.thresholds import RECORDED, actuator_limits, input_limits, supervision_limits
from iwm_power_manager.model.chassis import equivalent_mass_kg, road_load_n
from iwm_power_manager.model.pedals import full_braking_w, full_power_w
from iwm_power_manager.ros import messages
from iwm_power_manager.share import share_path
from iwm_power_manager.signals.contract import WHEEL_NAMES
from iwm_power_manager.signals.mapping import load_mapping
from iwm_power_manager.signals.readings import Assembly, topic_readers
from iwm_power_manager.signals.types import types_of
from iwm_power_manager.vehicle import load_vehicle

CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params
RADIUS_M = CAR.front.wheel.radius_m
FLOOR_MPS = CAR.driver.power_speed_floor_mps
MASS_KG = equivalent_mass_kg(CAR)


def wheel_force_n(tmp_path: Path, signal: str, unit: str, value: float, speed_mps: float) -> float:
    """Force over all wheels that the power manager settles on, motors and brakes."""
    path = tmp_path / "signals.yaml"
    path.write_text(f"signals: {{{signal}: {{topic: d, field: data, unit: {unit}}}}}")
    limits = ControllerLimits(
        input_limits(RECORDED, RADIUS_M, by_clock=False), None, supervision_limits(RECORDED), actuator_limits(RECORDED)
    )
    controller = Controller(CAR, WHEEL_NAMES, limits, default_settings("equal"), empty_table(), 0.9)
    monitor = controller.monitor
    assembly = Assembly(WHEEL_NAMES, CAR, lambda: monitor.speed_mps)
    read = topic_readers(load_mapping(path), {"d": types_of("std_msgs/msg/Float64")}, assembly)["d"]
    data = serialize_message(messages.number_message(value))
    for i in range(1, 150):
        now = i * 10_000_000
        monitor.take_speed(SpeedReading(now, speed_mps), now)
        monitor.take_wheels(JointReading(now, WHEEL_NAMES, (speed_mps / RADIUS_M,) * 4), now)
        monitor.take_battery(BatteryReading(now, 0.5, 25.0, math.nan, math.nan), now)
        (demand,) = read(data, now)
        monitor.take_demand(demand.power_w, 0.0, now)
        command = controller.step(now, 0.01).command
    return (sum(command.motor_torque_nm) + sum(command.friction_torque_nm)) / RADIUS_M


@pytest.mark.parametrize("speed_mps", [0.0, 0.5, 5.0])
@pytest.mark.parametrize(
    ("signal", "unit", "value", "force"),
    [
        ("power_demand", "W", 600.0, lambda v: 600.0 / max(v, FLOOR_MPS)),
        ("power_demand", "W", -600.0, lambda v: -600.0 / max(v, FLOOR_MPS)),
        ("force_demand", "N", 500.0, lambda v: 500.0),
        ("force_demand", "N", -500.0, lambda v: -500.0),
        ("torque_demand", "N m", 150.0, lambda v: 150.0 / RADIUS_M),
        ("acceleration_demand", "m/s2", 0.0, lambda v: min(v / FLOOR_MPS, 1.0) * road_load_n(v, 0.0, CAR.chassis)),
        (
            "acceleration_demand",
            "m/s2",
            1.0,
            lambda v: MASS_KG + min(v / FLOOR_MPS, 1.0) * road_load_n(v, 0.0, CAR.chassis),
        ),
        ("accelerator_pedal", '"1"', 0.1, lambda v: 0.1 * full_power_w(v, CAR) / max(v, FLOOR_MPS)),
        ("brake_pedal", '"1"', 0.2, lambda v: -0.2 * full_braking_w(v, CAR) / max(v, FLOOR_MPS)),
    ],
)
def test_a_car_at_rest_gets_the_force_that_was_asked_for(
    tmp_path: Path, speed_mps: float, signal: str, unit: str, value: float, force
) -> None:
    found = wheel_force_n(tmp_path, signal, unit, value, speed_mps)
    assert found == pytest.approx(force(speed_mps), rel=1e-6, abs=1e-9)
