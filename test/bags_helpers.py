# SPDX-License-Identifier: Apache-2.0
"""Small messages and topics for the tests of bags."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from iwm_power_manager.bags.metadata import DEFAULT_QOS, Topic
from iwm_power_manager.bags.writer import BagWriter
from iwm_power_manager.control.controller import Controller, ControllerLimits
from iwm_power_manager.control.monitor import BatteryReading, JointReading, SpeedReading
from iwm_power_manager.control.record import SIGNAL_NAMES
from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.control.table import empty_table
from iwm_power_manager.control.thresholds import RECORDED, actuator_limits, input_limits, supervision_limits
from iwm_power_manager.policy import choose, load_policy_bank
from iwm_power_manager.share import share_path
from iwm_power_manager.signals.contract import (
    FRICTION_BRAKE_COMMAND,
    JOINT_STATE,
    POWER_MANAGER_STATE,
    WHEEL_NAMES,
    WHEEL_TORQUE_COMMAND,
)
from iwm_power_manager.signals.readings import joint_state_writer
from iwm_power_manager.signals.types import definition_of, standard_types
from iwm_power_manager.vehicle import load_vehicle

FLOAT64 = "std_msgs/msg/Float64"
TWIST = "geometry_msgs/msg/TwistStamped"
BATTERY = "sensor_msgs/msg/BatteryState"
IMU = "sensor_msgs/msg/Imu"
FRICTION = 0.9


def float64(value: float) -> bytes:
    """CDR of a Float64 message."""
    return b"\0\1\0\0" + struct.pack("<d", value)


def topic(name: str, msgtype: str = FLOAT64) -> Topic:
    """A topic with its true definition and hash."""
    return Topic(name, msgtype, *definition_of(msgtype), (DEFAULT_QOS,))


class ScriptedDrive:
    """A drive written into a bag by the same `Controller` the node has: inputs, commands and state, as in lock-step.

    The car is no model: speed follows a smooth script, with some slip, driving and braking.

    Parameters
    ----------
    strategy : of the law
    policy_file : file or folder of policies, for strategies that need one
    moving : the bag has an IMU, silent for a while, and a direction, in which the car goes backwards for a while
    """

    DT_NS = 10_000_000

    def __init__(
        self, strategy: str = "instantaneous_slip", policy_file: Path | None = None, moving: bool = False
    ) -> None:
        self.moving = moving
        self.vehicle = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml"))
        # No price for a change of the share: so that the strategy does something in a second.
        self.parameters: dict[str, str | float] = {"strategy": strategy, "switching_power_w": 0.0}
        self.settings = default_settings(strategy)._replace(switching_power_w=0.0)
        limits = ControllerLimits(
            input_limits(RECORDED, 0.33, by_clock=False), None, supervision_limits(RECORDED), actuator_limits(RECORDED)
        )
        table = empty_table()
        if policy_file is not None:
            self.parameters["policy_file"] = str(policy_file)
            table = choose(load_policy_bank(policy_file, self.vehicle), FRICTION).table()
        self.controller = Controller(self.vehicle.params, WHEEL_NAMES, limits, self.settings, table, FRICTION)

    def inputs(self, i: int) -> tuple[float, list[float], float]:
        """Speed, wheel speeds and demand of step `i`."""
        t = i * 0.01
        speed = 8.0 + 2.0 * math.sin(2.0 * t)
        demand = 2500.0 * math.sin(5.0 * t) + (0.0, 12e3, 0.0, -9e3)[int(t / 0.3) % 4]
        slip = 0.002 * demand / 1e3
        return speed, [speed / 0.33 * (1.0 + slip * k) for k in (1.0, 1.1, 0.9, 1.0)], demand

    def motion(self, i: int) -> tuple[float, float] | None:
        """Yaw rate and acceleration of step `i`; None where the IMU is silent."""
        return None if 30 <= i < 60 else (0.05 * math.sin(0.1 * i), 4.0 * math.cos(0.02 * i))

    def direction(self, i: int) -> float:
        """Direction asked for in step `i`."""
        return -1.0 if 80 <= i < 110 else 1.0

    def write(
        self,
        path: Path,
        count: int,
        *,
        state: bool = True,
        commands: bool = True,
        start: int = 0,
        **custom_data: str,
    ) -> Path:
        """Drive `count` steps from step `start` on, starting the controller anew."""
        wheel_states = joint_state_writer(WHEEL_NAMES, "velocity")
        torque, numbers = joint_state_writer(WHEEL_NAMES, "effort"), joint_state_writer(SIGNAL_NAMES, "position")
        custom_data["parameters /power_manager"] = json.dumps(self.parameters)
        with BagWriter(path, custom_data=custom_data) as bag:
            speed_topic = bag.add_topic(topic("/vehicle_speed", TWIST))
            wheel_topic = bag.add_topic(topic("/wheel_states", JOINT_STATE))
            battery_topic = bag.add_topic(topic("/battery_state", BATTERY))
            demand_topic = bag.add_topic(topic("/power_demand"))
            moving = [bag.add_topic(topic("/imu", IMU)), bag.add_topic(topic("/direction"))] if self.moving else []
            names = (WHEEL_TORQUE_COMMAND, FRICTION_BRAKE_COMMAND, POWER_MANAGER_STATE)
            outputs = [bag.add_topic(topic(f"/{name}", JOINT_STATE)) for name in names] if commands or state else []
            for i in range(start, start + count):
                now = (i + 1) * self.DT_NS
                speed, wheels, demand = self.inputs(i)
                log = now
                shown = self.motion(i)
                if self.moving:
                    bag.write(moving[1], log, float64(self.direction(i)), log, i + 1)
                    self.controller.monitor.direction = self.direction(i)
                if self.moving and shown:
                    bag.write(moving[0], log, imu(now, *shown), log, i + 1)
                    self.controller.monitor.take_motion("yaw_rate", shown[0], now)
                    self.controller.monitor.take_motion("longitudinal_acceleration", shown[1], now)
                for number, data in (
                    (speed_topic, twist(now, speed)),
                    (wheel_topic, wheel_states(now, wheels)),
                    (battery_topic, battery(now, 0.7)),
                    (demand_topic, float64(demand)),
                ):
                    bag.write(number, log, data, log, i + 1)
                    log += 1000
                monitor = self.controller.monitor
                monitor.take_speed(SpeedReading(now, speed), now)
                monitor.take_wheels(JointReading(now, WHEEL_NAMES, tuple(wheels)), now)
                monitor.take_battery(BatteryReading(now, float(np.float32(0.7)), 25.0, math.nan, math.nan), now)
                monitor.take_demand(demand, 0.0, now)
                command, values = self.controller.step(now, 0.01)
                for kind, data in (
                    (0, torque(now, command.motor_torque_nm)),
                    (1, torque(now, command.friction_torque_nm)),
                    (2, numbers(now, values)),
                ):
                    if state if kind == 2 else commands:
                        bag.write(outputs[kind], log, data, log, i + 1)
                    log += 1000
        return path


def twist(stamp_ns: int, speed_mps: float) -> bytes:
    """CDR of a TwistStamped."""
    return b"\0\1\0\0" + struct.pack("<iII4x6d", stamp_ns // 10**9, stamp_ns % 10**9, 1, speed_mps, 0, 0, 0, 0, 0)


def imu(stamp_ns: int, yaw_rate_radps: float, forward_mps2: float) -> bytes:
    """CDR of an Imu."""
    types = standard_types().types
    stamp = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="base_link")
    level = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    vector, nothing = types["geometry_msgs/msg/Vector3"], np.zeros(9)
    turning, pushing = vector(0.0, 0.0, yaw_rate_radps), vector(forward_mps2, 0.0, 9.81)
    message = types[IMU](header, level, nothing, turning, nothing, pushing, nothing)
    return bytes(standard_types().serialize_cdr(message, IMU))


def battery(stamp_ns: int, soc: float, temperature_c: float = 25.0) -> bytes:
    """CDR of a BatteryState."""
    types = standard_types().types
    stamp = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="")
    empty = np.zeros(0, dtype=np.float32)
    message = types[BATTERY](
        header, 230.0, temperature_c, 0.0, math.nan, math.nan, math.nan, soc, 2, 0, 3, True, empty, empty, "", ""
    )
    return bytes(standard_types().serialize_cdr(message, BATTERY))


def write_drive(path: Path, speed_mps: Iterable[float], demand_w: Iterable[float]) -> None:
    """A bag with speed and demand every 10 ms, as the recorder writes it."""
    with BagWriter(path) as writer:
        speed_topic = writer.add_topic(topic("/vehicle_speed", TWIST))
        demand_topic = writer.add_topic(topic("/power_demand"))
        for i, (speed, demand) in enumerate(zip(speed_mps, demand_w, strict=True)):
            now = (i + 1) * 10_000_000
            writer.write(speed_topic, now, twist(now, float(speed)), now, i + 1)
            writer.write(demand_topic, now + 1000, float64(float(demand)), now + 1000, i + 1)
