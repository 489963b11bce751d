#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""A car on another DDS: CycloneDDS and nothing of ROS. It publishes what it measures and obeys the torques it is sent.

    ./run --seconds 20 --demand 4000        # in an environment of its own, which it makes

The types below are those that ROS 2 messages have on the wire; names of topics begin with `rt`. The plant is a mass on
four wheels that do not slip: enough to see that commands arrive and mean what they say.
"""

import argparse
import os
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

# Before CycloneDDS is imported: this machine only, found without multicast.
os.environ.setdefault("CYCLONEDDS_URI", f"file://{Path(__file__).resolve().parent / 'cyclonedds.xml'}")

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float32, float64, int32, sequence, uint8, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

WHEELS = ["front_left", "front_right", "rear_left", "rear_right"]
MASS_KG, RADIUS_M, ROAD_LOAD_N = 800.0, 0.33, 100.0
PERIOD_S = 0.01


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    """`builtin_interfaces/msg/Time`."""

    sec: int32 = 0
    nanosec: uint32 = 0


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    """`std_msgs/msg/Header`."""

    stamp: Time = field(default_factory=Time)
    frame_id: str = "base_link"


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    """`geometry_msgs/msg/Vector3`."""

    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass
class Twist(IdlStruct, typename="geometry_msgs::msg::dds_::Twist_"):
    """`geometry_msgs/msg/Twist`."""

    linear: Vector3 = field(default_factory=Vector3)
    angular: Vector3 = field(default_factory=Vector3)


@dataclass
class TwistStamped(IdlStruct, typename="geometry_msgs::msg::dds_::TwistStamped_"):
    """`geometry_msgs/msg/TwistStamped`."""

    header: Header = field(default_factory=Header)
    twist: Twist = field(default_factory=Twist)


@dataclass
class JointState(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
    """`sensor_msgs/msg/JointState`."""

    header: Header = field(default_factory=Header)
    name: sequence[str] = field(default_factory=list)
    position: sequence[float64] = field(default_factory=list)
    velocity: sequence[float64] = field(default_factory=list)
    effort: sequence[float64] = field(default_factory=list)


@dataclass
class Float64(IdlStruct, typename="std_msgs::msg::dds_::Float64_"):
    """`std_msgs/msg/Float64`."""

    data: float64 = 0.0


@dataclass
class BatteryState(IdlStruct, typename="sensor_msgs::msg::dds_::BatteryState_"):
    """`sensor_msgs/msg/BatteryState`."""

    header: Header = field(default_factory=Header)
    voltage: float32 = 237.0
    temperature: float32 = 25.0
    current: float32 = 0.0
    charge: float32 = float("nan")
    capacity: float32 = float("nan")
    design_capacity: float32 = float("nan")
    percentage: float32 = 0.8
    power_supply_status: uint8 = 2
    power_supply_health: uint8 = 0
    power_supply_technology: uint8 = 3
    present: bool = True
    cell_voltage: sequence[float32] = field(default_factory=list)
    cell_temperature: sequence[float32] = field(default_factory=list)
    location: str = ""
    serial_number: str = ""


class Car:
    """Writers and readers of the car, and its one state: how fast it drives."""

    def __init__(self, domain: int, prefix: str) -> None:
        self.participant = DomainParticipant(domain)
        best_effort = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(1), Policy.Durability.Volatile)
        reliable = Qos(
            Policy.Reliability.Reliable(duration(milliseconds=100)),
            Policy.History.KeepLast(1),
            Policy.Durability.Volatile,
        )

        def topic(name: str, kind: type) -> Topic:
            return Topic(self.participant, f"rt{prefix}/{name}", kind)

        self.speed = DataWriter(self.participant, topic("vehicle_speed", TwistStamped), best_effort)
        self.wheels = DataWriter(self.participant, topic("wheel_states", JointState), best_effort)
        self.battery = DataWriter(self.participant, topic("battery_state", BatteryState), best_effort)
        self.demand = DataWriter(self.participant, topic("power_demand", Float64), reliable)
        self.torques = [
            DataReader(self.participant, topic(name, JointState), reliable)
            for name in ("wheel_torque_command", "friction_brake_command")
        ]
        self.commanded_nm = [0.0, 0.0]
        self.received = 0
        self.speed_mps = 0.0

    def publish(self, demand_w: float) -> None:
        """Everything that was measured, the demand last."""
        now = time.time_ns()
        header = Header(Time(now // 10**9, now % 10**9))
        turning = self.speed_mps / RADIUS_M
        self.speed.write(TwistStamped(header, Twist(Vector3(self.speed_mps))))
        self.wheels.write(JointState(header, WHEELS, velocity=[turning] * 4))
        self.battery.write(BatteryState(header))
        self.demand.write(Float64(demand_w))

    def obey(self) -> None:
        """Take the newest torques; samples without valid data only tell that a writer came or went."""
        for i, reader in enumerate(self.torques):
            for sample in reader.take(100):
                if sample.sample_info.valid_data:
                    self.commanded_nm[i] = sum(sample.effort)
                    self.received += 1

    def move(self) -> None:
        """One period on: a mass, and the road's load."""
        force = sum(self.commanded_nm) / RADIUS_M - (ROAD_LOAD_N if self.speed_mps > 0.0 else 0.0)
        self.speed_mps = max(self.speed_mps + force / MASS_KG * PERIOD_S, 0.0)


def main() -> int:
    """Drive, then brake to a stop; exit code 1 if the car did not get going or did not stop."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--domain", type=int, default=int(os.environ.get("ROS_DOMAIN_ID", "0")))
    parser.add_argument("--namespace", default="", help="namespace of the power manager, such as /car_1")
    parser.add_argument("--demand", type=float, default=4000.0, help="power while driving, W")
    parser.add_argument("--target", type=float, default=2.0, help="speed at which it starts to brake, m/s")
    parser.add_argument("--seconds", type=float, default=60.0, help="patience for all of it")
    options = parser.parse_args()
    car = Car(options.domain, options.namespace)
    end, due, fastest, braking = time.monotonic() + options.seconds, time.monotonic(), 0.0, False
    while time.monotonic() < end and not (braking and car.speed_mps == 0.0):
        car.publish(-2.0 * options.demand if braking else options.demand)
        due += PERIOD_S
        time.sleep(max(due - time.monotonic(), 0.0))
        car.obey()
        car.move()
        fastest = max(fastest, car.speed_mps)
        braking = braking or car.speed_mps > options.target
    stopped = braking and car.speed_mps == 0.0
    print(f"{car.received} commands, {fastest:.2f} m/s at most, {'stopped' if stopped else 'not stopped'}")
    return 0 if stopped else 1


if __name__ == "__main__":
    sys.exit(main())
