# SPDX-License-Identifier: Apache-2.0
"""The power manager alone, for a car that is there already.

    ros2 launch iwm_power_manager power_manager.launch.py signals_file:=my_signals.yaml vehicle_file:=my_car.yaml

`lifecycle:=autostart` lets the node configure and activate itself, `managed` lets this launch do it, `manual` leaves it
unconfigured for a lifecycle manager of your own. `--show-args` lists every argument.
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, EmitEvent, RegisterEventHandler
from launch.conditions import IfCondition
from launch.events import matches_action
from launch.substitutions import EqualsSubstitution, LaunchConfiguration
from launch_ros.actions import LifecycleNode
from launch_ros.event_handlers import OnStateTransition
from launch_ros.events.lifecycle import ChangeState
from launch_ros.parameter_descriptions import ParameterValue
from lifecycle_msgs.msg import Transition

from launch import LaunchDescription

PACKAGE = "iwm_power_manager"
SHARE = Path(get_package_share_directory(PACKAGE))

#: Name, default and meaning of every argument.
ARGUMENTS = (
    ("namespace", "", "Namespace of the node; its relative topics live in it."),
    ("name", "power_manager", "Name of the node."),
    ("params_file", str(SHARE / "config" / "nodes" / "power_manager.yaml"), "Parameter file; may begin with `/**:`."),
    ("signals_file", "config/signals/standard.yaml", "Signals YAML: your car's topics, fields and units."),
    ("vehicle_file", "config/vehicles/jalalmaab_2015.yaml", "Vehicle YAML."),
    ("policy_file", "policies", "Policy file, or folder with a bank of them."),
    ("lifecycle", "autostart", "autostart | managed | manual: who configures and activates."),
    ("respawn", "false", "Start the node again, after a second, when it ends by a fault."),
    ("log_level", "info", "debug | info | warn | error."),
)


def generate_launch_description() -> LaunchDescription:
    chosen = {name: LaunchConfiguration(name) for name, _, _ in ARGUMENTS}
    node = LifecycleNode(
        package=PACKAGE,
        executable="power_manager",
        name=chosen["name"],
        namespace=chosen["namespace"],
        output="screen",
        respawn=chosen["respawn"],
        respawn_delay=1.0,
        arguments=["--ros-args", "--log-level", chosen["log_level"]],
        parameters=[
            chosen["params_file"],
            {
                **{name: ParameterValue(chosen[name], value_type=str) for name in ("signals_file", "vehicle_file")},
                "policy_file": ParameterValue(chosen["policy_file"], value_type=str),
                "autostart": EqualsSubstitution(chosen["lifecycle"], "autostart"),
            },
        ],
    )
    managed = IfCondition(EqualsSubstitution(chosen["lifecycle"], "managed"))
    configure = EmitEvent(
        event=ChangeState(lifecycle_node_matcher=matches_action(node), transition_id=Transition.TRANSITION_CONFIGURE),
        condition=managed,
    )
    activate = RegisterEventHandler(
        OnStateTransition(
            target_lifecycle_node=node,
            start_state="configuring",
            goal_state="inactive",
            entities=[
                EmitEvent(
                    event=ChangeState(
                        lifecycle_node_matcher=matches_action(node), transition_id=Transition.TRANSITION_ACTIVATE
                    )
                )
            ],
        ),
        condition=managed,
    )
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=meaning) for name, default, meaning in ARGUMENTS
    ]
    return LaunchDescription([*arguments, activate, node, configure])
