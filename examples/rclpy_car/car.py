#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""A car on the desk, in rclpy: publishes what config/signals/odometry_and_pedals.yaml reads, and obeys the torques.

It drives off, brakes to a stop and ends with 0. The plant is a mass on four wheels that do not slip.
"""

import argparse
import math
import sys
import time

import rclpy
from nav_msgs.msg import Odometry
from rclpy.duration import Duration
from rclpy.qos import QoSProfile
from rclpy.utilities import remove_ros_args
from sensor_msgs.msg import JointState
from std_msgs.msg import Float32, Float64

from iwm_power_manager.errors import IwmError
from iwm_power_manager.model.chassis import equivalent_mass_kg, road_load_n
from iwm_power_manager.share import resolve
from iwm_power_manager.vehicle import load_vehicle

PERIOD_S = 0.01
#: As a motor controller has it: without commands for so long there is no torque.
TIME_OUT_S = 0.1
JOINTS = ["wheel_fl_joint", "wheel_fr_joint", "wheel_rl_joint", "wheel_rr_joint"]


def main() -> int:
    """Drive; exit code 1 if the car did not get going or did not stop."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--vehicle", default="jalalmaab_2015", help="YAML of the car, or its name in the package")
    parser.add_argument("--pedal", type=float, default=30.0, help="of either pedal, %%")
    parser.add_argument("--target", type=float, default=3.0, help="speed at which it starts to brake, m/s")
    parser.add_argument("--seconds", type=float, default=60.0, help="patience for all of it")
    options = parser.parse_args(remove_ros_args(sys.argv)[1:])
    try:
        car = load_vehicle(resolve(options.vehicle)).params
    except IwmError as error:
        parser.error(str(error))
    radii_m = [axle.wheel.radius_m for axle in (car.front, car.front, car.rear, car.rear)]
    rclpy.init()
    node = rclpy.create_node("car")
    topics = {"/pedals/accelerator": Float64, "/pedals/brake": Float64, "/battery/charge": Float32}
    topics |= {"/battery/temperature": Float32, "/odom": Odometry, "/joint_states": JointState}
    send = {topic: node.create_publisher(kind, topic, 1).publish for topic, kind in topics.items()}
    forces_n = {"wheel_torque_command": (0.0, 0.0), "friction_brake_command": (0.0, 0.0)}  # with the time they came

    def obey(command: str, message: JointState) -> None:  # torques stand in the order front left to rear right
        forces_n[command] = (sum(map(float.__truediv__, message.effort, radii_m)), time.monotonic())

    fresh_only = QoSProfile(depth=1, lifespan=Duration(seconds=5 * PERIOD_S))
    for name in forces_n:
        node.create_subscription(JointState, name, lambda message, name=name: obey(name, message), fresh_only)
    speed, braking, due = 0.0, False, time.monotonic()
    end = due + options.seconds
    while time.monotonic() < end and not (braking and speed == 0.0):
        stamp = node.get_clock().now().to_msg()
        odometry, wheels = Odometry(), JointState(name=JOINTS)
        odometry.header.stamp = wheels.header.stamp = stamp
        odometry.twist.twist.linear.x = speed
        wheels.velocity = [speed / radius * 30.0 / math.pi for radius in radii_m]
        send["/odom"](odometry)
        send["/joint_states"](wheels)
        pedals = (0.0, options.pedal) if braking else (options.pedal, 0.0)
        for topic, number in zip(topics, (*pedals, 80.0, 25.0), strict=False):
            send[topic](topics[topic](data=number))
        due = max(due + PERIOD_S, time.monotonic())
        rclpy.spin_once(node, timeout_sec=0.0)
        while (left := due - time.monotonic()) > 0.0:
            rclpy.spin_once(node, timeout_sec=left)
        force = sum(force for force, at in forces_n.values() if time.monotonic() - at < TIME_OUT_S)
        force -= road_load_n(speed, 0.0, car.chassis) if speed > 0.0 else 0.0
        speed = max(speed + force / equivalent_mass_kg(car) * PERIOD_S, 0.0)
        braking = braking or speed > options.target
    unheard = [node.resolve_topic_name(name) for name, (_, at) in forces_n.items() if at == 0.0]
    print(f"nothing came on {', '.join(unheard)}: is the power manager in another namespace?\n" * bool(unheard), end="")
    print("stopped" if braking and speed == 0.0 else f"did not stop: {speed:.2f} m/s")
    return 0 if braking and speed == 0.0 else 1


if __name__ == "__main__":
    sys.exit(main())
