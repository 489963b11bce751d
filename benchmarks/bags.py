# SPDX-License-Identifier: Apache-2.0
"""Bags: messages per second written, read, replayed and recorded over DDS, beside other writers and bare reading.

    python benchmarks/bags.py                 all but the recording over DDS
    python benchmarks/bags.py --dds 10        with 10 s of 5 topics at 1 kHz into a real recorder

Everything is measured in one run, the contenders in turns, the median of several rounds counts. All write the same
messages, made beforehand.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer

from iwm_power_manager.bags.metadata import DEFAULT_QOS, Topic
from iwm_power_manager.bags.reader import BagReader, Message
from iwm_power_manager.bags.recording import Recording
from iwm_power_manager.bags.writer import BagWriter, Sample, WriterOptions
from iwm_power_manager.replay.plan import Choice, make_plan
from iwm_power_manager.replay.run import Replay, ReplayOutput
from iwm_power_manager.signals.contract import WHEEL_NAMES
from iwm_power_manager.signals.mapping import JOINT_STATE
from iwm_power_manager.signals.readings import joint_state_writer
from iwm_power_manager.signals.types import definition_of, standard_types

TWIST, FLOAT64 = "geometry_msgs/msg/TwistStamped", "std_msgs/msg/Float64"
TOPICS = 5
ROUNDS = 7
#: Messages the recorder's node hands over at a time: 20 ms of 5 topics at 1 kHz; and batches that wait at most, more
#: than ever do there.
BATCH, WAITING = 100, 10
MESSAGES = [
    joint_state_writer(WHEEL_NAMES, "effort")(i * 1_000_000, [math.sin(i + k) * 100.0 for k in range(4)])
    for i in range(1000)
]


def main() -> int:
    """Run what was asked for and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--messages", type=int, default=200_000, help="to write (default 200000)")
    parser.add_argument("--steps", type=int, default=6000, help="control steps to replay (default 6000)")
    parser.add_argument("--dds", type=float, default=0.0, metavar="S", help="seconds of recording over DDS")
    parser.add_argument("--folder", help="disk to write to (default: a temporary folder)")
    parser.add_argument("--json", metavar="FILE", help="write the numbers")
    options = parser.parse_args()
    numbers: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(prefix="iwm_bench_", dir=options.folder) as name:
        folder = Path(name)
        numbers["write"] = _write(folder, options.messages)
        numbers["read"] = _read(folder, options.steps)
        if options.dds:
            numbers["dds"] = _record_over_dds(folder, options.dds)
    if options.json:
        Path(options.json).write_text(json.dumps(numbers, indent=1) + "\n")
    return 0


def _medians(contenders: dict[str, Callable[[], int]], reference: str, what: str) -> dict[str, float]:
    """Median rate of each contender, taking turns; prints the table. A ratio is the median of those turn by turn."""
    rates: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(ROUNDS):
        for name, run in contenders.items():
            started = time.process_time()
            count = run()
            rates[name].append(count / (time.process_time() - started))
    print(f"\n{what:44} {'per CPU s':>12} {'ratio':>7}")
    for name, found in rates.items():
        ratio = median(one / other for one, other in zip(found, rates[reference], strict=True))
        print(f"{name:44} {median(found):12.0f} {ratio:7.2f}")
    return {name: median(found) for name, found in rates.items()}


# --- writing --------------------------------------------------------------------------------------------------------


def _write(folder: Path, count: int) -> dict[str, float]:
    definition = definition_of(JOINT_STATE)
    reference = "rosbags, none"
    contenders: dict[str, Callable[[], int]] = {}
    samples = [(i % TOPICS + 1, i * 200_000, MESSAGES[i % 1000], i * 200_000, i) for i in range(count)]

    def fresh(suffix: str = "") -> Path:
        path = folder / f"bag{suffix}"
        if path.is_dir():
            shutil.rmtree(path)
        path.unlink(missing_ok=True)
        return path

    def topics(add: Callable[[Topic], int]) -> list[int]:
        return [add(Topic(f"/topic_{i}", JOINT_STATE, *definition, (DEFAULT_QOS,))) for i in range(TOPICS)]

    def ours(compression: str) -> int:
        with BagWriter(fresh(), WriterOptions(compression=compression)) as bag:
            topics(bag.add_topic)
            bag.write_all(iter(samples), max(map(len, MESSAGES)))
        return count

    def recorder_path() -> int:
        """All the recorder's node does with a message it has taken: queue, thread, flush by time, wait for the disk."""
        recording = Recording(fresh())
        recording.start()
        topics(recording.add_topic)
        for first in range(0, count, BATCH):
            recording.put(samples[first : first + BATCH])
            if first % (BATCH * WAITING) == 0:
                recording.call(lambda: None)  # until all of that is written
        recording.close()
        if recording.status().written != count:
            raise RuntimeError(f"wrote {recording.status().written} of {count} messages")
        return count

    def rosbags(mode: CompressionMode) -> int:
        writer = Writer(fresh(), version=9, storage_plugin=StoragePlugin.MCAP)
        writer.set_compression(mode, CompressionFormat.ZSTD)
        with writer:
            connections = [
                writer.add_connection(f"/topic_{i}", JOINT_STATE, typestore=standard_types()) for i in range(TOPICS)
            ]
            for topic, time_ns, data, _, _ in samples:
                writer.write(connections[topic - 1], time_ns, data)
        return count

    contenders[reference] = lambda: rosbags(CompressionMode.NONE)
    contenders["rosbags, zstd"] = lambda: rosbags(CompressionMode.STORAGE)
    contenders["mcap (Python), zstd"] = lambda: _mcap_package(fresh(".mcap"), definition[0], samples)
    try:
        import foxglove  # noqa: F401

        contenders["foxglove-sdk (Rust), zstd, bare .mcap"] = lambda: _foxglove_sdk(
            fresh(".mcap"), definition[0], samples
        )
    except ImportError:
        print("foxglove-sdk is not installed: left out")
    for compression in ("none", "lz4", "zstd"):
        contenders[f"BagWriter, {compression}"] = lambda compression=compression: ours(compression)
    contenders["recorder: queue + thread + sync, zstd"] = recorder_path
    return _medians(contenders, reference, f"write {count} JointStates, {TOPICS} topics")


def _mcap_package(path: Path, definition: str, samples: Sequence[Sample]) -> int:
    from mcap.writer import CompressionType
    from mcap.writer import Writer as McapWriter

    with path.open("wb") as stream:
        writer = McapWriter(stream, compression=CompressionType.ZSTD)
        writer.start("ros2")
        schema = writer.register_schema(JOINT_STATE, "ros2msg", definition.encode())
        channels = [writer.register_channel(f"/topic_{i}", "cdr", schema) for i in range(TOPICS)]
        for topic, time_ns, data, sent_ns, sequence in samples:
            writer.add_message(channels[topic - 1], time_ns, data, sent_ns, sequence)
        writer.finish()
    return len(samples)


def _foxglove_sdk(path: Path, definition: str, samples: Sequence[Sample]) -> int:
    import foxglove

    context = foxglove.Context()
    with foxglove.open_mcap(path, context=context):
        schema = foxglove.Schema(name=JOINT_STATE, encoding="ros2msg", data=definition.encode())
        channels = [
            foxglove.Channel(f"/topic_{i}", schema=schema, message_encoding="cdr", context=context)
            for i in range(TOPICS)
        ]
        for topic, time_ns, data, _, _ in samples:
            channels[topic - 1].log(data, log_time=time_ns)
    return len(samples)


# --- reading and replaying ------------------------------------------------------------------------------------------


def _read(folder: Path, steps: int) -> dict[str, float]:
    inputs, drive = folder / "inputs", folder / "drive"
    _write_inputs(inputs, steps)
    choice = Choice(strategy="instantaneous_slip")

    def replay(path: Path, output: Path | None, wanted: Choice, reader: type[BagReader] = BagReader) -> int:
        count = 0
        with reader(path) as bag:
            plan = make_plan(wanted, bag.custom_data)
            run = Replay(bag, plan)
            writer = BagWriter(output, WriterOptions(), bag.custom_data) if output else None
            sink = ReplayOutput(writer, bag, plan) if writer else None
            for message, made in run.steps():
                count += 1
                if sink is not None:
                    sink.write(message, made)
            if writer is not None:
                writer.close()
            if run.report().steps != steps:
                raise RuntimeError(f"{run.report().steps} of {steps} steps")
        return count

    replay(inputs, drive, choice)

    def bare(deserialize: bool) -> int:
        count = 0
        with AnyReader([drive]) as reader:
            for connection, _, data in reader.messages():
                if deserialize:
                    reader.deserialize(data, connection.msgtype)
                count += 1
        return count

    def raw(reader: type[BagReader]) -> int:
        with reader(drive) as bag:
            return sum(1 for _ in bag.messages())

    def again(path: Path) -> int:
        shutil.rmtree(folder / "again", ignore_errors=True)
        return replay(path, folder / "again", Choice() if path == drive else choice)

    reference = "AnyReader with deserialisation"
    return _medians(
        {
            reference: lambda: bare(True),
            "AnyReader, raw": lambda: bare(False),
            "mcap's reader, raw": lambda: raw(_ThroughMcap),
            "BagReader, raw": lambda: raw(BagReader),
            "replay with control, compared": lambda: replay(drive, None, Choice()),
            "  the same through mcap's reader": lambda: replay(drive, None, Choice(), _ThroughMcap),
            "  the same through rosbags' reader": lambda: replay(drive, None, Choice(), _ThroughRosbags),
            "replay with control, compared and written": lambda: again(drive),
            "replay from inputs alone, written": lambda: again(inputs),
        },
        reference,
        f"read a drive of {steps} steps",
    )


class _ThroughMcap(BagReader):
    """Messages as the `mcap` package reads them: nothing is bounded."""

    def messages(self) -> Iterator[Message]:
        for path in sorted(self.path.glob("*.mcap")):
            with path.open("rb") as stream:
                for _, channel, found in make_reader(stream).iter_messages():
                    yield Message(found.log_time, channel.topic, found.data, found.publish_time, found.sequence)


class _ThroughRosbags(BagReader):
    """Messages as rosbags reads them: nothing is bounded, and when they were sent and their numbers are not there."""

    def messages(self) -> Iterator[Message]:
        with Reader(self.path) as reader:
            for connection, log_time, data in reader.messages():
                yield Message(log_time, connection.topic, data, log_time, 0)


def _write_inputs(path: Path, steps: int) -> None:
    """Inputs of a drive as the simulator publishes them: nothing that is real, everything at its real size."""
    types = standard_types().types
    stamp_type, header_type = types["builtin_interfaces/msg/Time"], types["std_msgs/msg/Header"]
    vector, battery_type = types["geometry_msgs/msg/Vector3"], types["sensor_msgs/msg/BatteryState"]
    wheels = joint_state_writer(WHEEL_NAMES, "velocity")
    cells = np.zeros(0, dtype=np.float32)
    kinds = {
        "/clock": "rosgraph_msgs/msg/Clock",
        "/vehicle_speed": TWIST,
        "/wheel_states": JOINT_STATE,
        "/battery_state": "sensor_msgs/msg/BatteryState",
        "/accelerator_pedal": FLOAT64,
        "/brake_pedal": FLOAT64,
        "/power_demand": FLOAT64,
    }
    with BagWriter(path) as bag:
        numbers = {name: bag.add_topic(Topic(name, kind, *definition_of(kind))) for name, kind in kinds.items()}
        for i in range(steps):
            now = (i + 1) * 20_000_000
            stamp = stamp_type(now // 10**9, now % 10**9)
            header = header_type(stamp, "base_link")
            speed = 8.0 + 5.0 * math.sin(0.1 * i * 0.02)
            demand = 2500.0 * math.sin(0.02 * i) + (0.0, 9e3, 0.0, -7e3)[i // 100 % 4]
            twist = types["geometry_msgs/msg/Twist"](vector(speed, 0.0, 0.0), vector(0.0, 0.0, 0.0))
            battery = battery_type(
                header_type(stamp, ""),
                230.0,
                25.0,
                -9.0,
                math.nan,
                200.0,
                200.0,
                0.7,
                2,
                0,
                3,
                True,
                cells,
                cells,
                "",
                "",
            )
            content = {
                "/clock": types["rosgraph_msgs/msg/Clock"](stamp),
                "/vehicle_speed": types[TWIST](header, twist),
                "/wheel_states": wheels(now, [speed / 0.33] * 4),
                "/battery_state": battery,
                "/accelerator_pedal": types[FLOAT64](0.1),
                "/brake_pedal": types[FLOAT64](0.0),
                "/power_demand": types[FLOAT64](demand),
            }
            for order, (name, message) in enumerate(content.items()):
                data = (
                    message
                    if isinstance(message, bytes)
                    else bytes(standard_types().serialize_cdr(message, kinds[name]))
                )
                bag.write(numbers[name], now + order * 1000, data)


# --- over DDS -------------------------------------------------------------------------------------------------------

_PUBLISHER = """
import sys, time
import rclpy
from rclpy.duration import Duration
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
rclpy.init()
node = rclpy.create_node("load")
publishers = [node.create_publisher(JointState, f"/topic_{i}", QoSProfile(depth=1000)) for i in range(5)]
message = JointState(name=["front_left", "front_right", "rear_left", "rear_right"], effort=[1.0, 2.0, 3.0, 4.0])
while any(publisher.get_subscription_count() == 0 for publisher in publishers):
    time.sleep(0.01)
time.sleep(0.5)
rounds = int(1000 * float(sys.argv[1]))
start = time.monotonic()
for i in range(rounds):
    for publisher in publishers:
        publisher.publish(message)
    time.sleep(max(0.0, start + (i + 1) * 1e-3 - time.monotonic()))
took = time.monotonic() - start
for publisher in publishers:
    publisher.wait_for_all_acked(Duration(seconds=10))
print(rounds * 5, took)
"""


def _record_over_dds(folder: Path, seconds: float) -> dict[str, float]:
    environment = {**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_LOG_DIR": str(folder)}
    environment.setdefault("ROS_DOMAIN_ID", "97")
    arguments = [
        "-p",
        f"output:={folder / 'dds'}",
        "-p",
        "topics:=['']",
        "-p",
        "regex:=/topic_.*",
        "-p",
        "wait_for:=['']",
    ]
    recorder = subprocess.Popen(
        [sys.executable, "-m", "iwm_power_manager.nodes.recorder", "--ros-args", *arguments],
        env=environment,
        stderr=subprocess.PIPE,
        text=True,
    )
    load = subprocess.run(
        [sys.executable, "-c", _PUBLISHER, str(seconds)], env=environment, capture_output=True, text=True, check=True
    )
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    recorder.terminate()
    _, said = recorder.communicate(timeout=60)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    sent, took = load.stdout.split()
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    with BagReader(folder / "dds") as bag:
        recorded = sum(1 for _ in bag.messages())
    lost = re.search(r"dropped (\d+), lost on the way (\d+)", said)
    print(f"\n5 topics at 1 kHz over DDS for {float(took):.1f} s: {sent} sent, {recorded} recorded, missing "
          f"{int(sent) - recorded}; the recorder says: {lost[0] if lost else said.strip()}")  # fmt: skip
    print(f"recorder: {cpu_s:.2f} s of CPU with its start, {100 * cpu_s / float(took):.0f} % of a core")
    return {"sent": float(sent), "recorded": recorded, "cpu_s": cpu_s, "seconds": float(took)}


if __name__ == "__main__":
    sys.exit(main())
