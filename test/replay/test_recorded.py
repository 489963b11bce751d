# SPDX-License-Identifier: Apache-2.0
"""Demand and speed of recorded drives as arrays."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from bags_helpers import TWIST, ScriptedDrive, float64, topic, twist
from iwm_power_manager.bags.reader import BagReader
from iwm_power_manager.bags.writer import BagWriter
from iwm_power_manager.errors import BagError, ConfigError
from iwm_power_manager.model.pedals import pedal_power_w
from iwm_power_manager.replay.recorded import SignalStream, read_signal
from iwm_power_manager.share import share_path
from iwm_power_manager.signals.contract import JOINT_STATE
from iwm_power_manager.signals.mapping import load_mapping
from iwm_power_manager.signals.readings import joint_state_writer
from iwm_power_manager.vehicle import load_vehicle

S = 1_000_000_000


def speed_and_demand(path: Path, rows: list[tuple[int, int, float, float]]) -> Path:
    """Rows of log time, stamp, speed, demand."""
    with BagWriter(path) as bag:
        speed, demand = bag.add_topic(topic("/vehicle_speed", TWIST)), bag.add_topic(topic("/power_demand"))
        for log_ns, stamp_ns, metres, watts in rows:
            bag.write(speed, log_ns, twist(stamp_ns, metres))
            bag.write(demand, log_ns + 1, float64(watts))
    return path


def test_a_lockstep_drive_recorded_faster_than_real_time_has_the_time_of_its_stamps(tmp_path: Path) -> None:
    rows = [(7 * S + i * 1_000_000, i * 20_000_000, 0.1 * i, 100.0 * i) for i in range(50)]
    drive = read_signal(speed_and_demand(tmp_path / "bag", rows))
    np.testing.assert_allclose(drive.time_s, 0.02 * np.arange(50), atol=1e-12)
    np.testing.assert_array_equal(drive.power_demand_w, 100.0 * np.arange(50))
    np.testing.assert_array_equal(drive.speed_mps, [0.1 * i for i in range(50)])
    assert (drive.bad_messages, drive.damage) == (0, [])


def test_without_stamps_the_log_time_counts(tmp_path: Path) -> None:
    rows = [(7 * S + i * 1_000_000, 0, 1.0, 5.0) for i in range(50)]
    drive = read_signal(speed_and_demand(tmp_path / "bag", rows))
    np.testing.assert_allclose(drive.time_s, 0.001 * np.arange(50), atol=1e-12)


def test_time_is_strictly_increasing_whatever_the_stamps_do(tmp_path: Path) -> None:
    stamps = [1, 2, 2, 3, 1, 2, 4, 4, 5]
    rows = [(i * S, stamp * S, 1.0, float(i)) for i, stamp in enumerate(stamps, 1)]
    drive = read_signal(speed_and_demand(tmp_path / "bag", rows))
    assert drive.time_s.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert drive.power_demand_w.tolist() == [1.0, 3.0, 4.0, 8.0, 9.0]


def test_bad_messages_are_counted_and_left_out(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        speed, demand = bag.add_topic(topic("/vehicle_speed", TWIST)), bag.add_topic(topic("/power_demand"))
        bag.write(demand, 5, float64(9.0))  # before any speed: nothing to learn from
        for i in range(10):
            bag.write(speed, 10 + 2 * i, twist((i + 1) * S, math.nan if i == 3 else 2.0))
            bag.write(demand, 11 + 2 * i, (b"", b"\0\1\0\0", float64(math.inf))[i - 5] if 5 <= i < 8 else float64(i))
    drive = read_signal(tmp_path / "bag")
    assert drive.bad_messages == 4
    assert drive.power_demand_w.tolist() == [0.0, 1.0, 3.0, 4.0, 8.0, 9.0]


def test_pedals_mean_what_the_vehicle_says(tmp_path: Path) -> None:
    mapping_file = tmp_path / "pedals.yaml"
    mapping_file.write_text(
        "signals:\n  speed: {topic: vehicle_speed, field: twist.linear.x, unit: m/s}\n"
        '  accelerator_pedal: {topic: a, field: data, unit: "%"}\n  brake_pedal: {topic: b, field: data, unit: "1"}\n'
    )
    with BagWriter(tmp_path / "bag") as bag:
        speed = bag.add_topic(topic("/vehicle_speed", TWIST))
        accelerator, brake = bag.add_topic(topic("/car/a")), bag.add_topic(topic("/car/b"))
        for i in range(4):
            bag.write(speed, i * S, twist(i * S, 10.0))
            bag.write(accelerator, i * S + 1, float64(25.0 * i))
            bag.write(brake, i * S + 2, float64(0.5 if i == 2 else 0.0))
    car = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params
    mapping = load_mapping(mapping_file)
    drive = read_signal(tmp_path / "bag", mapping, car)
    expected = [pedal_power_w(a, b, 10.0, car) for a, b in ((0.0, 0.0), (0.25, 0.0), (0.5, 0.5), (0.75, 0.0))]
    assert drive.power_demand_w.tolist() == expected
    assert expected[2] < 0.0 < expected[3]
    with pytest.raises(ConfigError, match="accelerator_pedal: is no power: name the vehicle"):
        read_signal(tmp_path / "bag", mapping)


def test_a_bag_without_what_is_needed_says_what_it_holds(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        bag.write(bag.add_topic(topic("/a")), 1, float64(1.0))
    with pytest.raises(
        BagError, match=r"holds no topic that .*standard.yaml maps to speed; it holds /a; other topics .*--mapping"
    ):
        read_signal(tmp_path / "bag")


def test_a_drive_of_this_project_reads_as_it_was_driven(tmp_path: Path) -> None:
    script = ScriptedDrive("equal")
    drive = read_signal(script.write(tmp_path / "bag", 40))
    assert drive.power_demand_w.tolist() == [script.inputs(i)[2] for i in range(40)]
    assert drive.speed_mps.tolist() == [script.inputs(i)[0] for i in range(40)]
    np.testing.assert_allclose(np.diff(drive.time_s), 0.01, atol=1e-12)


def test_a_wheel_that_is_missing_is_named_whatever_the_order_of_the_message(tmp_path: Path) -> None:
    names = ["rear_right", "front_left", "steering", "rear_left"]
    data = joint_state_writer(names, "velocity")(5 * S, [4.0, math.nan, 0.0, 3.0])
    with BagWriter(tmp_path / "bag") as bag:
        bag.write(bag.add_topic(topic("/wheel_states", JOINT_STATE)), 1, data)
    with BagReader(tmp_path / "bag") as reader:
        stream = SignalStream(reader, load_mapping())
        found = next(iter(stream))
    assert found.reading.names == tuple(names)
    assert list(stream.without) == ["/wheel_states: front_left"]
