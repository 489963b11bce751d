# SPDX-License-Identifier: Apache-2.0
"""Between standard ROS messages and plain numbers, both ways, for every topic of the project.

Writers return a new message, readers return plain Python numbers; nobody else touches message fields. Readers convert
and match by name, they do not judge the values: that is `control.inputs`. Sign of the battery current follows
`sensor_msgs/BatteryState`: negative when discharging.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Sequence

from builtin_interfaces.msg import Time
from geometry_msgs.msg import TwistStamped
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import BatteryState, Imu, JointState
from std_msgs.msg import Float64

from iwm_power_manager.control.monitor import JointReading
from iwm_power_manager.control.monitor import select_by_name as select_by_name  # part of this interface
from iwm_power_manager.model.chassis import GRAVITY_MPS2
from iwm_power_manager.signals.contract import *  # noqa: F403 - names of topics and wheels: part of this interface
from iwm_power_manager.signals.contract import TYPES


def message_class(msgtype: str) -> type:
    """Class of a type such as `std_msgs/msg/Float64`; `ImportError` if it is not installed."""
    package, _, rest = msgtype.partition("/")
    kind, _, name = rest.partition("/")
    try:
        found: type = getattr(importlib.import_module(f"{package}.{kind}"), name)
    except AttributeError:
        raise ImportError(f"{msgtype} is not installed") from None
    return found


#: Message type of every topic.
TOPIC_TYPES: dict[str, type] = {name: message_class(msgtype) for name, msgtype in TYPES.items()}

_NANOSECONDS = 1_000_000_000


def stamp_to_ns(stamp: Time) -> int:
    """Nanoseconds of a `builtin_interfaces/Time`."""
    return int(stamp.sec) * _NANOSECONDS + int(stamp.nanosec)


def ns_to_stamp(time_ns: int) -> Time:
    """`builtin_interfaces/Time` of nanoseconds."""
    return Time(sec=time_ns // _NANOSECONDS, nanosec=time_ns % _NANOSECONDS)


def clock_message(time_ns: int) -> Clock:
    """`/clock` at a time."""
    return Clock(clock=ns_to_stamp(time_ns))


def number_message(value: float) -> Float64:
    """`power_demand` (W), `accelerator_pedal`, `brake_pedal` (0..1), `road_friction` or `direction`."""
    return Float64(data=value)


def imu_message(stamp_ns: int, yaw_rate_radps: float, forward_mps2: float, left_mps2: float) -> Imu:
    """`imu`: what a sensor in `base_link` of a level car reads; the orientation is not measured."""
    message = Imu()
    message.header.stamp = ns_to_stamp(stamp_ns)
    message.header.frame_id = "base_link"
    message.orientation_covariance[0] = -1.0
    message.angular_velocity.z = yaw_rate_radps
    message.linear_acceleration.x = forward_mps2
    message.linear_acceleration.y = left_mps2
    message.linear_acceleration.z = GRAVITY_MPS2
    return message


def vehicle_speed_message(stamp_ns: int, speed_mps: float, frame_id: str = "base_link") -> TwistStamped:
    """`vehicle_speed`: the speed over ground along the car."""
    message = TwistStamped()
    message.header.stamp = ns_to_stamp(stamp_ns)
    message.header.frame_id = frame_id
    message.twist.linear.x = speed_mps
    return message


def joint_message(
    stamp_ns: int,
    names: Sequence[str],
    *,
    position: Sequence[float] = (),
    velocity: Sequence[float] = (),
    effort: Sequence[float] = (),
) -> JointState:
    """A JointState with the given fields: `wheel_states` or one of the two commands."""
    message = JointState()
    message.header.stamp = ns_to_stamp(stamp_ns)
    message.name = list(names)
    message.position = position
    message.velocity = velocity
    message.effort = effort
    return message


def wheel_states_message(
    stamp_ns: int, names: Sequence[str], speed_radps: Sequence[float], torque_nm: Sequence[float]
) -> JointState:
    """`wheel_states`: wheel speeds (`velocity`) and the torques actually applied (`effort`)."""
    return joint_message(stamp_ns, names, velocity=speed_radps, effort=torque_nm)


def read_torques(message: JointState) -> JointReading:
    """Names and torques (N m) of a command or of `wheel_states`, in the order of the message."""
    return JointReading(stamp_to_ns(message.header.stamp), tuple(message.name), tuple(message.effort))


def battery_state_message(
    stamp_ns: int,
    *,
    soc: float,
    voltage_v: float,
    discharge_current_a: float,
    temperature_c: float = 25.0,
    capacity_ah: float = math.nan,
) -> BatteryState:
    """`battery_state`; what is not measured is NaN, as the message's definition asks for."""
    message = BatteryState()
    message.header.stamp = ns_to_stamp(stamp_ns)
    message.voltage = voltage_v
    message.current = -discharge_current_a
    message.temperature = temperature_c
    message.charge = soc * capacity_ah
    message.capacity = capacity_ah
    message.design_capacity = capacity_ah
    message.percentage = soc
    message.power_supply_status = (
        BatteryState.POWER_SUPPLY_STATUS_CHARGING
        if discharge_current_a < 0.0
        else BatteryState.POWER_SUPPLY_STATUS_DISCHARGING
    )
    message.power_supply_technology = BatteryState.POWER_SUPPLY_TECHNOLOGY_LIFE
    message.present = True
    return message


def read_named_numbers(message: JointState) -> tuple[int, dict[str, float]]:
    """Stamp (ns) and values by name of a list of named numbers: `name` is the signal, `position` its value."""
    return stamp_to_ns(message.header.stamp), dict(zip(message.name, message.position, strict=True))
