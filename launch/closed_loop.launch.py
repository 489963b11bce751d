# SPDX-License-Identifier: Apache-2.0
"""Simulator, power manager and, if wanted, recorder, for a ROS 2 Jazzy installation with launch_ros.

    ros2 launch iwm_power_manager closed_loop.launch.py cycle_file:=config/cycles/udds.csv strategy:=equal record:=true

The nodes take their parameters from config/nodes; the arguments below replace single ones. When the simulator reaches
the end of its cycle, the other nodes are stopped.
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, EmitEvent, RegisterEventHandler
from launch.conditions import IfCondition
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchDescription

PACKAGE = "iwm_power_manager"

#: Name, default and meaning of every argument.
ARGUMENTS = (
    ("namespace", "", "Namespace of all nodes."),
    ("vehicle_file", "config/vehicles/jalalmaab_2015.yaml", "Vehicle file of simulator and power manager."),
    ("cycle_file", "config/cycles/nycc.csv", "Drive cycle of the simulator."),
    ("friction", "0.9", "Peak friction coefficient of the road, and what the power manager assumes."),
    ("rate_hz", "100.0", "Rate of simulator and power manager."),
    ("lockstep", "false", "One step at a time, as fast as the nodes answer, instead of real time."),
    ("strategy", "sdp_lookahead", "Strategy of the power manager."),
    ("policy_file", "policies", "Policy file, or folder with a bank of them."),
    ("record", "false", "Also run the recorder, which writes to `bag`."),
    ("bag", "", "Folder of the bag to create; empty: named by date and time, in the working directory."),
)


def _argument(name: str, kind: type) -> ParameterValue:
    return ParameterValue(LaunchConfiguration(name), value_type=kind)


def generate_launch_description() -> LaunchDescription:
    nodes = Path(get_package_share_directory(PACKAGE)) / "config" / "nodes"
    namespace = LaunchConfiguration("namespace")
    common = {
        "vehicle_file": _argument("vehicle_file", str),
        "friction": _argument("friction", float),
        "rate_hz": _argument("rate_hz", float),
        "lockstep": _argument("lockstep", bool),
    }
    simulator = Node(
        package=PACKAGE,
        executable="simulator",
        name="simulator",
        namespace=namespace,
        output="screen",
        parameters=[
            str(nodes / "simulator.yaml"),
            {**common, "cycle_file": _argument("cycle_file", str), "wait_for_recorder": _argument("record", bool)},
        ],
    )
    power_manager = Node(
        package=PACKAGE,
        executable="power_manager",
        name="power_manager",
        namespace=namespace,
        output="screen",
        parameters=[
            str(nodes / "power_manager.yaml"),
            {**common, "strategy": _argument("strategy", str), "policy_file": _argument("policy_file", str)},
        ],
    )
    recorder = Node(
        package=PACKAGE,
        executable="recorder",
        name="recorder",
        namespace=namespace,
        output="screen",
        condition=IfCondition(LaunchConfiguration("record")),
        parameters=[
            str(nodes / "recorder.yaml"),
            {"output": _argument("bag", str), "vehicle_file": _argument("vehicle_file", str)},
        ],
    )
    end = RegisterEventHandler(
        OnProcessExit(target_action=simulator, on_exit=[EmitEvent(event=Shutdown(reason="the simulator has ended"))])
    )
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=meaning) for name, default, meaning in ARGUMENTS
    ]
    return LaunchDescription([*arguments, recorder, power_manager, simulator, end])
