# SPDX-License-Identifier: Apache-2.0
"""A recorded drive played to a power manager: the node decides anew on what the car once sent.

    ros2 launch iwm_power_manager replay.launch.py bag:=drive_01

Once the power manager is active, the player publishes the bag's inputs with its own /clock, on which it runs.
`--show-args` lists every argument.
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, EmitEvent, ExecuteProcess, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode
from launch_ros.event_handlers import OnStateTransition
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import ExecutableInPackage

from launch import LaunchDescription

PACKAGE = "iwm_power_manager"

#: Name, default and meaning of every argument.
ARGUMENTS = (
    ("bag", None, "Bag to play: folder or file."),
    ("rate", "1.0", "Times real time."),
    ("namespace", "", "Namespace of the power manager: that of the recorded topics."),
    ("signals_file", "config/signals/standard.yaml", "Signals YAML: the recorded topics, fields and units."),
    ("vehicle_file", "config/vehicles/jalalmaab_2015.yaml", "Vehicle YAML."),
    ("policy_file", "policies", "Policy file, or folder with a bank of them."),
    ("strategy", "sdp_lookahead", "Strategy of the power manager."),
)


def generate_launch_description() -> LaunchDescription:
    share = Path(get_package_share_directory(PACKAGE))
    chosen = {name: LaunchConfiguration(name) for name, _, _ in ARGUMENTS}
    texts = ("signals_file", "vehicle_file", "policy_file", "strategy")
    power_manager = LifecycleNode(
        package=PACKAGE,
        executable="power_manager",
        name="power_manager",
        namespace=chosen["namespace"],
        output="screen",
        parameters=[
            str(share / "config" / "nodes" / "power_manager.yaml"),
            {name: ParameterValue(chosen[name], value_type=str) for name in texts} | {"use_sim_time": True},
        ],
    )
    command = [ExecutableInPackage("replay", PACKAGE), chosen["bag"], "--publish", "--rate", chosen["rate"]]
    player = ExecuteProcess(cmd=command, output="screen")
    play = RegisterEventHandler(
        OnStateTransition(target_lifecycle_node=power_manager, goal_state="active", entities=[player])
    )
    end = RegisterEventHandler(
        OnProcessExit(target_action=player, on_exit=[EmitEvent(event=Shutdown(reason="the bag has ended"))])
    )
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=meaning) for name, default, meaning in ARGUMENTS
    ]
    return LaunchDescription([*arguments, play, end, power_manager])
