# SPDX-License-Identifier: Apache-2.0
"""Numbers survive the journey through a standard message and back."""

from __future__ import annotations

import math

from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message

from iwm_power_manager.ros import messages as m
from oracles import readings

finite = st.floats(allow_nan=False, allow_infinity=False)
stamps = st.integers(0, 2**31 * 10**9 - 1)


def sent(message):
    return deserialize_message(serialize_message(message), type(message))


@given(stamps)
def test_a_time_keeps_every_nanosecond(time_ns) -> None:
    assert m.stamp_to_ns(m.ns_to_stamp(time_ns)) == time_ns
    assert m.stamp_to_ns(sent(m.clock_message(time_ns)).clock) == time_ns


@given(stamps, finite)
def test_speed_and_numbers_keep_their_bits(stamp, value) -> None:
    assert readings.vehicle_speed(sent(m.vehicle_speed_message(stamp, value))) == (stamp, value)
    assert sent(m.number_message(value)).data == value


@given(stamps, st.tuples(finite, finite, finite, finite), st.tuples(finite, finite, finite, finite))
def test_wheels_keep_names_speeds_and_torques(stamp, speeds, torques) -> None:
    message = sent(m.wheel_states_message(stamp, m.WHEEL_NAMES, speeds, torques))
    assert readings.wheel_speeds(message) == (stamp, m.WHEEL_NAMES, speeds)
    assert m.read_torques(message) == (stamp, m.WHEEL_NAMES, torques)
    command = sent(m.joint_message(stamp, m.WHEEL_NAMES, effort=torques))
    assert m.read_torques(command) == (stamp, m.WHEEL_NAMES, torques)
    assert len(command.velocity) == len(command.position) == 0


@given(stamps, st.lists(finite, max_size=60))
def test_named_numbers_come_back_by_name(stamp, values) -> None:
    names = [f"signal_{i}" for i in range(len(values))]
    expected = dict(zip(names, values, strict=True))
    assert m.read_named_numbers(sent(m.joint_message(stamp, names, position=values))) == (stamp, expected)


@given(stamps, st.floats(0.0, 1.0, width=32), st.floats(-500.0, 500.0, width=32))
def test_a_battery_discharges_with_negative_current_on_the_wire(stamp, soc, current) -> None:
    message = sent(m.battery_state_message(stamp, soc=soc, voltage_v=237.5, discharge_current_a=current))
    assert message.current == -current
    assert message.present
    reading = readings.battery_state(message)
    assert reading == (stamp, soc, 25.0, 237.5, current)


def test_a_battery_says_what_it_is_doing_and_what_is_not_known() -> None:
    message = m.battery_state_message(0, soc=0.5, voltage_v=237.0, discharge_current_a=-1.0)
    assert message.power_supply_status == message.POWER_SUPPLY_STATUS_CHARGING
    assert math.isnan(message.capacity)
    message = m.battery_state_message(0, soc=0.5, voltage_v=237.0, discharge_current_a=1.0, capacity_ah=200.0)
    assert message.power_supply_status == message.POWER_SUPPLY_STATUS_DISCHARGING
    assert message.charge == 100.0


def test_every_topic_has_a_type() -> None:
    names = {
        value for key, value in vars(m).items() if key.isupper() and isinstance(value, str) and "/msg/" not in value
    }
    assert names == set(m.TOPIC_TYPES)
