# SPDX-License-Identifier: Apache-2.0
"""The interface, once: every topic with its name, type, unit, quality of service, rate, and what its loss means.

Nodes, tools, bags, documentation and the tests of the running nodes take them from here. Without ROS.
"""

from __future__ import annotations

from typing import NamedTuple

from iwm_power_manager.control.types import WHEEL_NAMES as WHEEL_NAMES  # part of this interface

TWIST_STAMPED = "geometry_msgs/msg/TwistStamped"
JOINT_STATE = "sensor_msgs/msg/JointState"
BATTERY_STATE_TYPE = "sensor_msgs/msg/BatteryState"
FLOAT64 = "std_msgs/msg/Float64"

VEHICLE_SPEED = "vehicle_speed"
WHEEL_STATES = "wheel_states"
POWER_DEMAND = "power_demand"
ACCELERATOR_PEDAL = "accelerator_pedal"
BRAKE_PEDAL = "brake_pedal"
BATTERY_STATE = "battery_state"
ROAD_FRICTION = "road_friction"
DIRECTION = "direction"
IMU = "imu"
WHEEL_TORQUE_COMMAND = "wheel_torque_command"
FRICTION_BRAKE_COMMAND = "friction_brake_command"
POWER_MANAGER_STATE = "power_manager/state"
#: The same as the node itself names it: private, so that a renamed node has one of its own.
NODE_STATE = "~/state"
NODE_FRICTION = "~/road_friction"
DIAGNOSTICS = "/diagnostics"
RECORDER_READY = "recorder/ready"
CLOCK = "/clock"


class Topic(NamedTuple):
    """One topic.

    Attributes
    ----------
    name : relative names live in the node's namespace and can be remapped
    type : message type
    direction : "in" or "out", as the power manager sees it; "" if it has nothing to do with it
    publisher : who sends it
    carries : what stands in it, with the unit
    rate : how often it comes
    reliability : that the power manager asks for (in) or offers (out)
    loss : what the power manager does without it
    durability : "volatile", or "transient_local" where the last message waits for those who come later
    """

    name: str
    type: str
    direction: str
    publisher: str
    carries: str
    rate: str
    reliability: str
    loss: str
    durability: str = "volatile"


_STEP = "each control step"
_CAR = "your car, or simulator"
TOPICS = (
    Topic(
        VEHICLE_SPEED,
        TWIST_STAMPED,
        "in",
        _CAR,
        "`twist.linear.x`: speed over ground along the car, m/s, forwards positive",
        "100 Hz",
        "best_effort",
        "the speed of the wheel that slips least stands in; motor torque fades to zero",
    ),
    Topic(
        WHEEL_STATES,
        JOINT_STATE,
        "in",
        _CAR,
        "`velocity`: wheel speeds by `name`, rad/s, forwards positive; `effort`: torques that the motors report, N m",
        "100 Hz",
        "best_effort",
        "motor torque fades to zero, friction brakes follow the demand",
    ),
    Topic(
        POWER_DEMAND,
        FLOAT64,
        "in",
        _CAR,
        "`data`: power demand at the wheels, W, braking negative",
        "100 Hz",
        "best_effort",
        "motor torque fades to zero; a braking force is held, then released",
    ),
    Topic(
        BATTERY_STATE,
        BATTERY_STATE_TYPE,
        "in",
        _CAR,
        "`percentage`: state of charge, 0..1; `temperature`, degC, NaN if it is not measured",
        "10 Hz",
        "best_effort",
        "motor torque fades to zero",
    ),
    Topic(
        ROAD_FRICTION,
        FLOAT64,
        "in",
        "whoever knows it",
        "`data`: peak friction coefficient; optional",
        "any",
        "best_effort",
        "the parameter `friction` counts",
    ),
    Topic(
        DIRECTION,
        FLOAT64,
        "in",
        f"{_CAR} (scenarios)",
        "`data`: direction of travel the driver asks for, above 0 forwards, below reverse, 0 changes nothing; optional",
        "any",
        "best_effort",
        "the last one counts; forwards before the first",
    ),
    Topic(
        WHEEL_TORQUE_COMMAND,
        JOINT_STATE,
        "out",
        "power_manager",
        "`effort`: torque of each motor by `name`, N m, driving positive",
        _STEP,
        "reliable",
        "",
    ),
    Topic(
        FRICTION_BRAKE_COMMAND,
        JOINT_STATE,
        "out",
        "power_manager",
        "`effort`: torque of each friction brake by `name`, N m, never positive",
        _STEP,
        "reliable",
        "",
    ),
    Topic(
        NODE_STATE,
        JOINT_STATE,
        "out",
        "power_manager",
        "named numbers: `name` is the signal, `position` its value",
        _STEP,
        "reliable",
        "",
    ),
    Topic(
        NODE_FRICTION,
        JOINT_STATE,
        "out",
        "power_manager",
        "the road under the wheels of either side as estimated, signals `left_friction` to `right_friction_confidence` "
        "of the state, in the same form",
        "10 Hz",
        "reliable",
        "",
    ),
    Topic(
        DIAGNOSTICS,
        "diagnostic_msgs/msg/DiagnosticArray",
        "out",
        "power_manager, recorder",
        "state, reason, ages, rates, counters",
        "1 Hz, and at every change",
        "reliable",
        "",
    ),
    Topic(
        IMU,
        "sensor_msgs/msg/Imu",
        "",
        "simulator (scenarios)",
        "`angular_velocity.z`, rad/s, and `linear_acceleration`, m/s2, of `base_link`: what a sensor there reads",
        _STEP,
        "reliable",
        "",
    ),
    Topic(
        RECORDER_READY,
        "std_msgs/msg/Bool",
        "",
        "recorder",
        "`data`: every topic it waits for is matched; nothing will be missed",
        "at every change",
        "reliable",
        "",
        "transient_local",
    ),
    Topic(ACCELERATOR_PEDAL, FLOAT64, "", "simulator", "`data`: accelerator pedal, 0..1", "10 Hz", "reliable", ""),
    Topic(BRAKE_PEDAL, FLOAT64, "", "simulator", "`data`: brake pedal, 0..1", "10 Hz", "reliable", ""),
    Topic(
        CLOCK,
        "rosgraph_msgs/msg/Clock",
        "",
        "simulator",
        "simulated time",
        "each step of the simulator",
        "reliable",
        "",
    ),
)
#: Message type of every topic, and of the state by the name that others know it by.
TYPES = {topic.name: topic.type for topic in TOPICS} | {POWER_MANAGER_STATE: JOINT_STATE}


class Service(NamedTuple):
    """One service: node, private name, type, and what it is for."""

    node: str
    name: str
    type: str
    meaning: str


_PARAMETERS = (
    ("describe_parameters", "rcl_interfaces/srv/DescribeParameters", "type, range and meaning of parameters"),
    ("get_parameter_types", "rcl_interfaces/srv/GetParameterTypes", "their types"),
    ("get_parameters", "rcl_interfaces/srv/GetParameters", "their values"),
    ("list_parameters", "rcl_interfaces/srv/ListParameters", "their names"),
    ("set_parameters", "rcl_interfaces/srv/SetParameters", "change some, each for itself"),
    ("set_parameters_atomically", "rcl_interfaces/srv/SetParametersAtomically", "change all or none"),
)
_LIFECYCLE = (
    ("change_state", "lifecycle_msgs/srv/ChangeState", "configure, activate, deactivate, cleanup, shutdown"),
    ("get_available_states", "lifecycle_msgs/srv/GetAvailableStates", "states of the lifecycle"),
    ("get_available_transitions", "lifecycle_msgs/srv/GetAvailableTransitions", "transitions from here"),
    ("get_state", "lifecycle_msgs/srv/GetState", "present state"),
    ("get_transition_graph", "lifecycle_msgs/srv/GetAvailableTransitions", "all transitions"),
)
_RECORDER = (
    ("start", "std_srvs/srv/Trigger", "begin a bag"),
    ("stop", "std_srvs/srv/Trigger", "end it"),
    ("split", "std_srvs/srv/Trigger", "begin a new file"),
    ("snapshot", "std_srvs/srv/Trigger", "write what is kept in memory"),
)
SERVICES = (
    *(Service("power_manager", *entry) for entry in (*_LIFECYCLE, *_PARAMETERS)),
    *(Service("recorder", *entry) for entry in (*_RECORDER, *_PARAMETERS)),
    *(Service("simulator", *entry) for entry in _PARAMETERS),
)
