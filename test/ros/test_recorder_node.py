# SPDX-License-Identifier: Apache-2.0
"""The recorder as a process of its own, over real DDS."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TwistStamped
from member import Member
from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.highlevel import AnyReader
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Float64, String
from std_srvs.srv import Trigger

from disk_helpers import on_small_disk
from iwm_power_manager.bags.reader import BagReader, Message
from iwm_power_manager.bags.recover import recover
from iwm_power_manager.exit_codes import BAD_INPUT, CANNOT_TELL

PATIENCE_S = 60.0
LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
RELIABLE = QoSProfile(depth=1000)


def exactly(count: int) -> QoSProfile:
    """Reliable, for so many messages: a full history asks for acknowledgement at once, not at the next heartbeat."""
    return QoSProfile(depth=count)


class RecorderProcess:
    """A recorder started like a user would, its output kept."""

    def __init__(self, output: Path, *parameters: str, remaps: tuple[str, ...] = (), disk: str = "") -> None:
        arguments = [f"-p {name}" for name in (f"output:={output}", *parameters)] + [f"-r {remap}" for remap in remaps]
        command = [sys.executable, "-m", "iwm_power_manager.nodes.recorder"]
        command += ["--ros-args", *" ".join(arguments).split()]
        self.process = subprocess.Popen(
            on_small_disk(output.parent, disk, command) if disk else command,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def end(self, number: signal.Signals = signal.SIGINT) -> tuple[int, str]:
        """Signal it and wait; returns its exit code and what it said on standard error."""
        if self.process.poll() is None:
            self.process.send_signal(number)
        _, error = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, error


class Peer(Member):
    """A node in this process that publishes and listens."""

    def __init__(self) -> None:
        super().__init__("peer")

    def until(self, condition: Callable[[], bool], what: str) -> None:
        """Spin until a condition holds."""
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            if time.monotonic() > deadline:
                pytest.fail(f"{what}: did not happen within {PATIENCE_S:g} s")
            self.executor.spin_once(timeout_sec=0.05)

    def until_ready(self, namespace: str = "", name: str = "recorder") -> None:
        """Spin until the recorder says that it is ready."""
        heard: list[bool] = []
        listener = self.node.create_subscription(
            Bool, f"{namespace}/{name}/ready", lambda message: heard.append(message.data), LATCHED
        )
        self.until(lambda: bool(heard) and heard[-1], "recorder ready")
        self.node.destroy_subscription(listener)

    def call(self, service: str) -> Trigger.Response:
        """Call one of the recorder's services."""
        client = self.node.create_client(Trigger, f"/recorder/{service}")
        self.until(client.service_is_ready, f"service {service}")
        future = client.call_async(Trigger.Request())
        self.until(future.done, f"answer of {service}")
        self.node.destroy_client(client)
        return future.result()


@pytest.fixture
def peer() -> Iterator[Peer]:
    created = Peer()
    yield created
    created.close()


@pytest.fixture
def recorder() -> Iterator[Callable[..., RecorderProcess]]:
    started: list[RecorderProcess] = []

    def start(output: Path, *parameters: str, remaps: tuple[str, ...] = (), disk: str = "") -> RecorderProcess:
        started.append(RecorderProcess(output, *parameters, remaps=remaps, disk=disk))
        return started[-1]

    yield start
    for process in started:
        process.process.kill()
        process.process.communicate()


def recorded(path: Path) -> dict[str, list[Message]]:
    """Messages by topic; the bag has to be whole."""
    found: dict[str, list[Message]] = {}
    with BagReader(path) as reader:
        for message in reader.messages():
            found.setdefault(message.topic, []).append(message)
        assert reader.damage == []
    return found


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_every_message_is_recorded_byte_by_byte_and_a_signal_ends_it_cleanly(
    tmp_path: Path, peer: Peer, recorder: Callable[..., RecorderProcess], number: signal.Signals
) -> None:
    process = recorder(tmp_path / "bag", "wait_for:=[/numbers,/joints]", "topics:=[/numbers]", "regex:=/joi.*")
    numbers = peer.node.create_publisher(Float64, "/numbers", RELIABLE)
    joints = peer.node.create_publisher(JointState, "/joints", exactly(200))
    peer.until_ready()
    sent_numbers = [Float64(data=float(i)) for i in range(1000)]
    sent_joints = [JointState(name=["a", "b"], velocity=[float(i), 0.5]) for i in range(200)]
    for i, message in enumerate(sent_numbers):
        numbers.publish(message)
        if i % 5 == 0:
            joints.publish(sent_joints[i // 5])
    assert numbers.wait_for_all_acked(Duration(seconds=PATIENCE_S))
    assert joints.wait_for_all_acked(Duration(seconds=PATIENCE_S))
    code, error = process.end(number)
    assert code == 0, error
    assert "dropped 0, lost on the way 0" in error
    found = recorded(tmp_path / "bag")
    assert [m.data for m in found["/numbers"]] == [serialize_message(m) for m in sent_numbers]
    assert [deserialize_message(m.data, JointState) for m in found["/joints"]] == sent_joints
    assert [m.sequence for m in found["/numbers"]] == list(range(1, 1001))
    for message in found["/numbers"]:
        assert 0 <= message.log_time_ns - message.publish_time_ns < 10e9
    with AnyReader([tmp_path / "bag"]) as reader:  # independent: schemas, index, counts
        assert {c.topic: c.msgcount for c in reader.connections} == {"/numbers": 1000, "/joints": 200}
        last = [reader.deserialize(d, c.msgtype) for c, _, d in reader.messages() if c.topic == "/joints"][-1]
        assert list(last.velocity) == [199.0, 0.5]


def test_without_a_signals_file_it_records_the_topics_it_is_given_alone_and_says_what_it_waits_for(
    tmp_path: Path, peer: Peer, recorder: Callable[..., RecorderProcess]
) -> None:
    speed = peer.node.create_publisher(TwistStamped, "/vehicle_speed", RELIABLE)
    numbers = peer.node.create_publisher(Float64, "/numbers", RELIABLE)
    process = recorder(tmp_path / "bag", "signals_file:=''", "topics:=[/numbers,/late]")
    assert process.process.stderr is not None
    while "not ready, no publisher of /late; it records what comes" not in process.process.stderr.readline():
        assert process.process.poll() is None
    late = peer.node.create_publisher(Float64, "/late", RELIABLE)
    peer.until_ready()
    speed.publish(TwistStamped())
    for publisher in (numbers, late):
        publisher.publish(Float64(data=1.0))
        assert publisher.wait_for_all_acked(Duration(seconds=PATIENCE_S))
    code, error = process.end()
    assert code == 0, error
    assert set(recorded(tmp_path / "bag")) == {"/numbers", "/late"}


def test_default_topics_honour_namespace_and_remaps_and_metadata_tells_files_and_parameters(
    tmp_path: Path, peer: Peer, recorder: Callable[..., RecorderProcess]
) -> None:
    vehicle = tmp_path / "vehicle.yaml"
    vehicle.write_text("name: car\n")
    peer.node.declare_parameter("mass_kg", 812.5)
    speed = peer.node.create_publisher(TwistStamped, "/car/vehicle_speed", 10)
    demand = peer.node.create_publisher(Float64, "/other/demand", 10)
    process = recorder(
        tmp_path / "bag",
        "wait_for:=[vehicle_speed,power_demand]",
        f"vehicle_file:={vehicle}",
        "metadata:=['run=7']",
        remaps=("__ns:=/car", "power_demand:=/other/demand"),
    )
    peer.until_ready("/car")
    # The recorder has found both publishers; they may not have found it yet.
    peer.until(lambda: speed.get_subscription_count() > 0 < demand.get_subscription_count(), "both subscriptions")
    speed.publish(TwistStamped())
    demand.publish(Float64(data=1.0))

    def parameters_are_there() -> bool:
        with BagReader(tmp_path / "bag") as reader:
            return "parameters /peer" in reader.custom_data

    peer.until(parameters_are_there, "parameters of the publisher")
    code, error = process.end()
    assert code == 0, error
    found = recorded(tmp_path / "bag")
    assert (
        {"/car/vehicle_speed", "/other/demand", "/diagnostics"} >= set(found) >= {"/car/vehicle_speed", "/other/demand"}
    )
    with BagReader(tmp_path / "bag") as reader:
        assert json.loads(reader.custom_data["parameters /peer"])["mass_kg"] == 812.5
        assert reader.custom_data["run"] == "7"
        assert reader.custom_data["vehicle_file"] == "vehicle.yaml"
        assert len(reader.custom_data["vehicle_sha256"]) == 64


def test_latched_and_best_effort_publishers_are_met_with_their_own_qos(
    tmp_path: Path, peer: Peer, recorder: Callable[..., RecorderProcess]
) -> None:
    latched = peer.node.create_publisher(String, "/latched", LATCHED)
    latched.publish(String(data="before the recorder"))
    best_effort = peer.node.create_publisher(
        Float64, "/best_effort", QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
    )
    process = recorder(tmp_path / "bag", "regex:=/(latched|best_effort)", "wait_for:=[/latched,/best_effort]")
    peer.until_ready()
    peer.until(lambda: best_effort.get_subscription_count() == 1, "match seen by the publisher")
    best_effort.publish(Float64(data=2.0))
    # A volatile, best-effort newcomer cannot meet what was asked of the first: the recorder asks for less.
    newcomer = peer.node.create_publisher(
        String, "/latched", QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    )
    peer.until(lambda: newcomer.get_subscription_count() == 1, "match with the newcomer")
    newcomer.publish(String(data="newcomer"))

    def newcomer_is_there() -> bool:
        with BagReader(tmp_path / "bag") as reader:
            return any(b"newcomer" in message.data for message in reader.messages())

    peer.until(newcomer_is_there, "message of the newcomer on disk")
    assert process.end()[0] == 0
    found = recorded(tmp_path / "bag")
    assert [m.data for m in found["/best_effort"]] == [serialize_message(Float64(data=2.0))]
    texts = [m.data[8:].rstrip(b"\0").decode() for m in found["/latched"]]
    assert texts[0] == "before the recorder"
    assert texts[-1] == "newcomer"
    with BagReader(tmp_path / "bag") as reader:
        assert reader.topics["/latched"].qos[0].durability.name == "TRANSIENT_LOCAL"
        assert reader.topics["/best_effort"].qos[0].reliability.name == "BEST_EFFORT"


def test_services_start_split_stop_and_take_snapshots(
    tmp_path: Path, peer: Peer, recorder: Callable[..., RecorderProcess]
) -> None:
    numbers = peer.node.create_publisher(Float64, "/numbers", RELIABLE)
    process = recorder(
        tmp_path / "bag", "topics:=[/numbers]", "wait_for:=[/numbers]", "record:=false", "snapshot_s:=100.0"
    )
    peer.until_ready()
    numbers.publish(Float64(data=0.0))
    assert not peer.call("stop").success
    started = peer.call("start")
    assert (started.success, started.message) == (True, str(tmp_path / "bag"))
    again = peer.call("start")
    assert not again.success
    assert "is being recorded already" in again.message

    def publish_and_see(value: float, path: Path) -> None:
        numbers.publish(Float64(data=value))
        peer.until(
            lambda: any(m.data == serialize_message(Float64(data=value)) for m in partly(path)), f"{value} on disk"
        )

    def partly(path: Path) -> list[Message]:
        with BagReader(path) as reader:
            return list(reader.messages())

    publish_and_see(1.0, tmp_path / "bag")
    assert peer.call("split").success
    publish_and_see(2.0, tmp_path / "bag")
    snapshot = peer.call("snapshot")
    assert snapshot.success
    assert peer.call("stop").message == str(tmp_path / "bag")
    numbers.publish(Float64(data=3.0))
    assert peer.call("start").message == str(tmp_path / "bag_1")
    publish_and_see(4.0, tmp_path / "bag_1")
    assert process.end()[0] == 0

    def values(path: str | Path) -> list[float]:
        with AnyReader([Path(path)]) as reader:
            return [reader.deserialize(data, c.msgtype).data for c, _, data in reader.messages()]

    assert [value for value in values(tmp_path / "bag") if value] == [1.0, 2.0]
    assert len(list((tmp_path / "bag").glob("*.mcap"))) == 2
    assert values(snapshot.message) == [0.0, 1.0, 2.0]
    assert values(tmp_path / "bag_1")[-1] == 4.0


def test_simulated_time_is_the_log_time_and_nothing_before_the_clock_is_lost(
    tmp_path: Path, peer: Peer, recorder: Callable[..., RecorderProcess]
) -> None:
    numbers = peer.node.create_publisher(Float64, "/numbers", exactly(51))
    clock = peer.node.create_publisher(Clock, "/clock", RELIABLE)
    process = recorder(
        tmp_path / "bag", "use_sim_time:=true", "topics:=[/numbers,/clock]", "wait_for:=[/numbers,/clock]"
    )
    peer.until_ready()
    numbers.publish(Float64(data=-1.0))
    for i in range(50):
        message = Clock()
        message.clock.sec, message.clock.nanosec = 100 + i // 10, i % 10 * 100_000_000
        clock.publish(message)
        numbers.publish(Float64(data=float(i)))
    assert numbers.wait_for_all_acked(Duration(seconds=PATIENCE_S))
    assert process.end()[0] == 0
    found = recorded(tmp_path / "bag")
    times = [m.log_time_ns for m in found["/numbers"]]
    assert times == [100_000_000_000, *(100_000_000_000 + i * 100_000_000 for i in range(50))]
    assert len(found["/clock"]) == 50


def test_without_any_clock_simulated_time_falls_back_to_the_time_of_reception(
    tmp_path: Path, peer: Peer, recorder: Callable[..., RecorderProcess]
) -> None:
    numbers = peer.node.create_publisher(Float64, "/numbers", exactly(1))
    process = recorder(tmp_path / "bag", "use_sim_time:=true", "topics:=[/numbers]", "wait_for:=[/numbers]")
    peer.until_ready()
    numbers.publish(Float64(data=1.0))
    assert numbers.wait_for_all_acked(Duration(seconds=PATIENCE_S))
    assert process.end()[0] == 0
    (message,) = recorded(tmp_path / "bag")["/numbers"]
    assert 0 <= message.log_time_ns - message.publish_time_ns < 10e9


def test_diagnostics_report_counts_and_losses(
    tmp_path: Path, peer: Peer, recorder: Callable[..., RecorderProcess]
) -> None:
    numbers = peer.node.create_publisher(Float64, "/numbers", RELIABLE)
    reports: list[DiagnosticArray] = []
    peer.node.create_subscription(DiagnosticArray, "/diagnostics", reports.append, 10)
    process = recorder(tmp_path / "bag", "topics:=[/numbers]", "wait_for:=[/numbers]", "max_message_bytes:=11")
    peer.until_ready()
    for _ in range(7):
        numbers.publish(Float64(data=1.0))

    def latest() -> dict[str, str]:
        return {entry.key: entry.value for entry in reports[-1].status[0].values} if reports else {}

    peer.until(lambda: latest().get("dropped_size") == "7", "report of seven messages over the limit")
    status = reports[-1].status[0]
    assert status.level == b"\x01"
    assert status.name.endswith("/recorder: recording")
    assert latest()["/numbers"] == "7 taken, 0 lost, 0 before the first"
    assert (latest()["state"], latest()["ready"], latest()["written"]) == ("recording", "True", "0")
    assert process.end()[0] == 0


def test_of_two_publishers_of_a_topic_nothing_is_lost(
    tmp_path: Path, peer: Peer, recorder: Callable[..., RecorderProcess]
) -> None:
    """The one has sent hundreds of messages before the other begins: their counters are far apart."""
    first, second = (peer.node.create_publisher(Float64, "/numbers", RELIABLE) for _ in range(2))
    for _ in range(300):
        first.publish(Float64(data=1.0))
    heard: list[bool] = []
    peer.node.create_subscription(Bool, "/recorder/ready", lambda message: heard.append(message.data), LATCHED)
    process = recorder(tmp_path / "bag", "topics:=[/numbers]", "wait_for:=[/numbers]")

    def ready() -> bool:
        for _ in range(5):
            first.publish(Float64(data=1.0))
            second.publish(Float64(data=2.0))
        return True in heard

    peer.until(ready, "recorder ready")
    assert second.wait_for_all_acked(Duration(seconds=PATIENCE_S))
    code, error = process.end()
    assert code == 0
    assert "dropped 0, lost on the way 0" in error


def test_a_failing_disk_ends_the_node_with_one_line(
    tmp_path: Path, peer: Peer, recorder: Callable[..., RecorderProcess]
) -> None:
    numbers = peer.node.create_publisher(Float64, "/numbers", RELIABLE)
    process = recorder(tmp_path / "bag", "topics:=[/numbers]", "wait_for:=[/numbers]", "flush_period_s:=0.05")
    peer.until_ready()
    (tmp_path / "bag" / "bag_0.mcap").unlink()
    (tmp_path / "bag").rmdir()

    def ended() -> bool:
        numbers.publish(Float64(data=1.0))
        return process.process.poll() is not None

    peer.until(ended, "end of the recorder")
    code, error = process.end()
    assert code == 1
    last = error.strip().splitlines()[-1]
    assert last.startswith(f"recorder: {tmp_path / 'bag'}: cannot be written: the file was removed")
    assert "Traceback" not in error


def test_on_a_full_disk_the_node_ends_with_one_line_or_stays_and_reports(
    tmp_path: Path, peer: Peer, recorder: Callable[..., RecorderProcess]
) -> None:
    numbers = peer.node.create_publisher(Float64, "/numbers", RELIABLE)
    parameters = ("topics:=[/numbers]", "wait_for:=[/numbers]", "compression:=none", "flush_period_s:=0.05")
    ending = recorder(tmp_path / "bag", *parameters, disk="size=64k")
    staying = recorder(
        tmp_path / "bag", *parameters, "exit_on_error:=false", disk="size=64k", remaps=("__node:=stays",)
    )
    peer.until_ready()
    peer.until_ready(name="stays")
    reports: list[DiagnosticArray] = []
    peer.node.create_subscription(DiagnosticArray, "/diagnostics", reports.append, 10)

    def both_have_failed() -> bool:
        for _ in range(100):
            numbers.publish(Float64(data=1.0))
        failed = any(r.status[0].name.endswith("/stays: recording") and r.status[0].level == b"\x02" for r in reports)
        return failed and ending.process.poll() is not None

    peer.until(both_have_failed, "end of one recorder and error report of the other")
    code, error = ending.end()
    assert code == 1
    line = f"{tmp_path / 'bag'}: cannot be written: No space left on device"
    assert error.strip().splitlines()[-1].startswith(f"recorder: {line}; ")
    assert line in {report.status[0].message for report in reports}
    assert staying.process.poll() is None
    # Its disk is its own, but Linux lets us look.
    (file,) = Path(f"/proc/{staying.process.pid}/root{tmp_path}/bag").glob("*.mcap")
    with BagReader(file) as reader:
        assert sum(1 for _ in reader.messages()) > 500
    code, error = staying.end()
    assert code == 1
    assert error.strip().splitlines()[-1].startswith(f"recorder: {line}; ")


def test_into_a_read_only_folder_nothing_is_recorded_and_one_line_says_so(
    tmp_path: Path, recorder: Callable[..., RecorderProcess]
) -> None:
    process = recorder(tmp_path / "bag", disk="ro,size=64k")
    process.process.wait(PATIENCE_S)
    code, error = process.end()
    assert (code, error) == (
        BAD_INPUT,
        f"recorder: parameter output: {tmp_path / 'bag'}: cannot be created: Read-only file system\n",
    )


@pytest.mark.parametrize(
    ("parameter", "line"),
    [
        ("compression:=gzip", "parameter compression: 'gzip' is not allowed; allowed: none | lz4 | zstd"),
        ("flush_period_s:=100.0", "parameter flush_period_s: 100.0 is not allowed"),
        ("regex:=(", "parameter regex: '(' is no regular expression"),
        (
            "policy_file:=/no/policy.npz",
            "parameter policy_file: /no/policy.npz: cannot be read: No such file or directory",
        ),
        ("metadata:=[a]", "parameter metadata: 'a' is not allowed; allowed: key=value"),
        ("signals_file:=/no/odom.yaml", "parameter signals_file: /no/odom.yaml: cannot be read"),
        ("output:=/proc/none/bag", "parameter output: /proc/none/bag: cannot be created: No such file or directory"),
        ("output:={existing}", "exists already and is not overwritten"),
    ],
)
def test_a_wrong_parameter_gets_one_line(
    tmp_path: Path, recorder: Callable[..., RecorderProcess], parameter: str, line: str
) -> None:
    process = recorder(tmp_path / "bag", parameter.replace("{existing}", str(tmp_path)))
    process.process.wait(PATIENCE_S)
    code, error = process.end()
    assert code == BAD_INPUT
    assert line in error
    assert len(error.strip().splitlines()) == 1
    assert error.startswith("recorder: ")


def test_a_parameter_that_does_not_exist_is_refused(tmp_path: Path, recorder: Callable[..., RecorderProcess]) -> None:
    process = recorder(tmp_path / "bag", "topic:=[/speed]")
    process.process.wait(PATIENCE_S)
    assert "recorder: parameter topic is unknown; is topics meant?" in process.end()[1]


def test_the_recover_command_needs_no_ros_and_says_what_was_lost(tmp_path: Path) -> None:
    from bags_helpers import float64, topic
    from iwm_power_manager.bags.writer import BagWriter

    bag = BagWriter(tmp_path / "bag")
    number = bag.add_topic(topic("/a"))
    bag.write(number, 5, float64(1.0))
    bag.flush()
    bag.abandon()
    command = [sys.executable, "-m", "iwm_power_manager.nodes.recorder", "--recover", str(tmp_path / "bag")]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env={**os.environ, "ROS_DOMAIN_ID": "x"})
    assert "rebuilt with 1 messages" in done.stdout
    assert "metadata.yaml written" in done.stdout
    done = subprocess.run([*command, str(tmp_path / "none")], capture_output=True, text=True, check=False)
    assert done.returncode == BAD_INPUT
    assert done.stderr == f"recorder: {tmp_path / 'none'}: does not exist\n"


@pytest.mark.parametrize("length", [0, 4, 8, 60], ids=["empty", "within the magic", "the magic", "the header"])
def test_a_recording_that_holds_nothing_has_no_answer_however_little_is_left(tmp_path: Path, length: int) -> None:
    from iwm_power_manager.bags.writer import BagWriter
    from iwm_power_manager.nodes.recorder import main

    with BagWriter(tmp_path / "bag"):
        pass
    file = tmp_path / "bag" / "bag_0.mcap"
    file.write_bytes(file.read_bytes()[:length])
    assert [main(["--recover", str(tmp_path / "bag")]) for _ in range(2)] == [CANNOT_TELL] * 2


def kill_while_publishing(path: Path, recorder: Callable[..., RecorderProcess], delay_s: float) -> float:
    """Kill the node at 1 kHz, `delay_s` after it was matched, recover, compare; returns what was lost, in s.

    The publisher is there first and never waits: the promise begins with the first message that can arrive.
    """
    # A publisher that has seen a recorder die reaches the next one a second or more late (Fast DDS: a killed process
    # says no goodbye): that is about the start of a recording, and this is about its end. So each has a new one.
    peer = Peer()
    numbers = peer.node.create_publisher(Float64, "/numbers", RELIABLE)
    process = recorder(path, "topics:=[/numbers]")
    matched_ns = killed_ns = 0
    deadline = time.monotonic() + PATIENCE_S
    try:
        started_ns = time.time_ns()
        published_ns: list[int] = []
        while process.process.poll() is None:
            now = time.time_ns()
            numbers.publish(Float64(data=float(len(published_ns))))
            published_ns.append(now)
            if not matched_ns and numbers.get_subscription_count():
                matched_ns = now
            if matched_ns and not killed_ns and now - matched_ns >= delay_s * 1e9:
                process.process.kill()
                killed_ns = time.time_ns()
            assert time.monotonic() < deadline
            time.sleep(max(0.0, (started_ns + len(published_ns) * 1_000_000 - time.time_ns()) * 1e-9))
    finally:
        peer.close()
    report = recover(path)
    if report.files[0].message_count == 0:
        lost_s = (killed_ns - matched_ns) * 1e-9
    else:
        with BagReader(path) as reader:
            messages = list(reader.messages())
            assert reader.damage == []
        sequences = [message.sequence for message in messages]
        first_missing = sequences[-1]  # its number, which is one less than its sequence
        lost_s = (killed_ns - published_ns[first_missing]) * 1e-9 if first_missing < len(published_ns) else 0.0
        assert sequences == list(range(sequences[0], sequences[0] + len(sequences)))
        assert [m.data for m in messages] == [serialize_message(Float64(data=float(n - 1))) for n in sequences]
    assert lost_s < 1.0, f"killed after {delay_s:.3f} s: lost {lost_s:.3f} s"
    return lost_s


@pytest.mark.processes
def test_killed_at_1_khz_the_node_loses_less_than_its_last_second(
    tmp_path: Path, recorder: Callable[..., RecorderProcess]
) -> None:
    kill_while_publishing(tmp_path / "bag", recorder, 0.7)


@pytest.mark.processes
@pytest.mark.nightly
@pytest.mark.timeout(1800)
def test_killed_fifty_times_at_1_khz_the_node_loses_less_than_its_last_second(
    tmp_path: Path, recorder: Callable[..., RecorderProcess], record_property: Callable[[str, object], None]
) -> None:
    draw = random.Random(20150602)
    lost_s = [kill_while_publishing(tmp_path / f"bag{run}", recorder, draw.uniform(0.0, 2.5)) for run in range(50)]
    record_property("largest_loss_s", max(lost_s))
    print(f"largest loss of {len(lost_s)} kills: {max(lost_s):.3f} s")
