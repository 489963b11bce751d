#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""What it costs to turn bytes into readings and commands into bytes: the signals' code beside rclpy's.

Both do the same work, turn about, in one process; the ratio is that of the fastest rounds.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rclpy.serialization import deserialize_message, serialize_message

from iwm_power_manager.control.record import SIGNAL_NAMES
from iwm_power_manager.ros import messages
from iwm_power_manager.signals.commands import FRICTION, MOTOR, CommandWriter, standard
from iwm_power_manager.signals.contract import BATTERY_STATE, POWER_DEMAND, VEHICLE_SPEED, WHEEL_NAMES, WHEEL_STATES
from iwm_power_manager.signals.mapping import load_mapping
from iwm_power_manager.signals.readings import Assembly, joint_state_writer, topic_readers
from iwm_power_manager.signals.types import types_of

_TOPICS = (VEHICLE_SPEED, WHEEL_STATES, BATTERY_STATE, POWER_DEMAND)


def inputs(count: int) -> list[dict[str, bytes]]:
    """Bytes of one message of each topic, for each of `count` steps."""
    made = []
    for i in range(1, count + 1):
        stamp_ns, wheels = i * 10_000_000, [0.1 * i + k for k in range(4)]
        message = {
            VEHICLE_SPEED: messages.vehicle_speed_message(stamp_ns, 0.03 * i),
            WHEEL_STATES: messages.wheel_states_message(stamp_ns, WHEEL_NAMES, wheels, wheels),
            BATTERY_STATE: messages.battery_state_message(stamp_ns, soc=0.5, voltage_v=200.0, discharge_current_a=3.0),
            POWER_DEMAND: messages.number_message(5.0 * i),
        }
        made.append({topic: serialize_message(message[topic]) for topic in _TOPICS})
    return made


def contenders() -> dict[str, Callable[[dict[str, bytes]], object]]:
    """Functions from the bytes of one step to its readings."""
    mapping = load_mapping()
    types = {source.topic: types_of(source.type) for sources in mapping.sources.values() for source in sources}
    readers = topic_readers(mapping, types, Assembly(WHEEL_NAMES))

    def stamp(message: Any) -> int:
        return messages.stamp_to_ns(message.header.stamp)

    reads: dict[str, Callable[[Any], object]] = {
        VEHICLE_SPEED: lambda m: (stamp(m), m.twist.linear.x),
        WHEEL_STATES: lambda m: (stamp(m), tuple(m.name), tuple(m.velocity)),
        BATTERY_STATE: lambda m: (stamp(m), m.percentage, m.temperature, m.voltage, -m.current),
        POWER_DEMAND: lambda m: m.data,
    }
    in_order = [(topic, readers[topic]) for topic in _TOPICS]
    decoded = [(topic, messages.TOPIC_TYPES[topic], reads[topic]) for topic in _TOPICS]
    return {
        "signals": lambda step: [reader(step[topic], 0) for topic, reader in in_order],
        "rclpy": lambda step: [read(deserialize_message(step[topic], kind)) for topic, kind, read in decoded],
    }


def writers() -> dict[str, Callable[[object], object]]:
    """Functions that make the bytes of one step's two commands and of its state."""
    write = [CommandWriter(Path("standard.yaml"), standard()[kind]) for kind in (MOTOR, FRICTION)]
    write_state = joint_state_writer(SIGNAL_NAMES, "position")
    torques, numbers = (1.0, 2.0, 3.0, 4.0), [1.0] * len(SIGNAL_NAMES)

    def by_message(_: object) -> object:
        made = [messages.joint_message(5, WHEEL_NAMES, effort=torques) for _ in write]
        return [serialize_message(m) for m in (*made, messages.joint_message(5, SIGNAL_NAMES, position=numbers))]

    return {
        "signals": lambda _: [one(5, torques) for one in write] + [write_state(5, numbers)],
        "rclpy": by_message,
    }


def fastest_us(ways: dict[str, Callable[[Any], object]], rounds: int, steps: Sequence[Any]) -> dict[str, float]:
    """Time for one step, us, in the fastest round of each way."""
    best = dict.fromkeys(ways, float("inf"))
    for _ in range(rounds):
        for name, way in ways.items():
            started = time.perf_counter()
            for step in steps:
                way(step)
            best[name] = min(best[name], (time.perf_counter() - started) / len(steps) * 1e6)
    return best


def main() -> int:
    """Print both times and their ratio, for inputs and outputs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--steps", type=int, default=2000)
    options = parser.parse_args()
    steps = inputs(options.steps)
    for what, ways in (("four inputs", contenders()), ("two commands and the state", writers())):
        best = fastest_us(ways, options.rounds, steps)
        print(f"{what}: signals {best['signals']:.2f} us, rclpy {best['rclpy']:.2f} us, ", end="")
        print(f"ratio {best['rclpy'] / best['signals']:.1f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
