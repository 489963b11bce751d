# SPDX-License-Identifier: Apache-2.0
"""Readings of the project's own messages by way of rclpy's, field by field."""

from __future__ import annotations

from typing import Any

from iwm_power_manager.control.monitor import BatteryReading, JointReading, SpeedReading
from iwm_power_manager.ros.messages import stamp_to_ns


def stamp_ns(message: Any) -> int:
    """Stamp of the header."""
    return stamp_to_ns(message.header.stamp)


def vehicle_speed(message: Any) -> SpeedReading:
    """Of `vehicle_speed`."""
    return SpeedReading(stamp_ns(message), message.twist.linear.x)


def wheel_speeds(message: Any) -> JointReading:
    """Of `wheel_states`, in the order of the message."""
    return JointReading(stamp_ns(message), tuple(message.name), tuple(message.velocity))


def battery_state(message: Any) -> BatteryReading:
    """Of `battery_state`; the current on the wire is negative when discharging."""
    return BatteryReading(stamp_ns(message), message.percentage, message.temperature, message.voltage, -message.current)
