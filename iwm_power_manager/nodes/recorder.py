# SPDX-License-Identifier: Apache-2.0
"""Node `recorder`: writes topics to a rosbag2 MCAP bag as the bytes that came over the wire.

Three threads share the work: this module's main loop takes messages from DDS (`ros.raw`), the recording writes them
(`bags.recording`), and an rclpy executor serves parameters, services and the status timer.
"""

from __future__ import annotations

import argparse
import math
import re
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

from iwm_power_manager import __version__
from iwm_power_manager.bags.mcap_file import COMPRESSIONS
from iwm_power_manager.bags.metadata import Topic
from iwm_power_manager.bags.recording import FAILED, Recording, RecordingOptions
from iwm_power_manager.bags.recover import recover
from iwm_power_manager.bags.writer import Sample, WriterOptions
from iwm_power_manager.command_line import CommandParser
from iwm_power_manager.errors import BagError, IwmError, of_parameter, one_line
from iwm_power_manager.exit_codes import CANNOT_TELL, DONE
from iwm_power_manager.exit_codes import FAILED as EXIT_FAILED
from iwm_power_manager.files import content_sha256
from iwm_power_manager.ros import ending
from iwm_power_manager.ros.arguments import EXIT_CODES, check_parameter_files, parameters_help
from iwm_power_manager.ros.interruption import Interruption
from iwm_power_manager.ros.messages import (
    CLOCK,
    NODE_FRICTION,
    NODE_STATE,
    POWER_MANAGER_STATE,
    RECORDER_READY,
    TOPIC_TYPES,
    ns_to_stamp,
)
from iwm_power_manager.ros.parameters import Change, ParameterError, Spec, declare
from iwm_power_manager.ros.raw import CLOCK_FIELDS, CLOCK_FIELDS_OFFSET, RawSubscriptions, Taken
from iwm_power_manager.ros.remote_parameters import RemoteParameters
from iwm_power_manager.ros.spinning import in_thread
from iwm_power_manager.share import resolve
from iwm_power_manager.signals.mapping import DEFAULT_MAPPING, DEMANDS, PEDALS, load_mapping
from iwm_power_manager.signals.types import definition_of

DIAGNOSTICS = "/diagnostics"
DEFAULT_TOPICS = [topic for topic in TOPIC_TYPES if topic not in (NODE_FRICTION, NODE_STATE, RECORDER_READY)]
#: Signals a closed loop cannot run without: `~/ready` waits for their topics.
_LOOP = ("speed", "wheel_speed", *DEMANDS, *PEDALS)

_MEBIBYTE = 1024 * 1024
_STATUS_PERIOD_S = 1.0
_DISCOVERY_FAST_S = 0.05
_DISCOVERY_SLOW_S = 0.25
#: After this time it says which topics it waits for.
_TELL_S = 5.0
#: The publisher learns of the match a little after the subscription does.
_SETTLE_S = 0.5
#: What a power cut may cost; a disk that takes longer is reported.
_DISK_BEHIND_S = 1.0
#: After the signal to end: taking goes on until nothing has come for the one, at most for the other.
_FINAL_QUIET_S = 0.1
_FINAL_WAIT_S = 2.0

_spec = partial(Spec, change=Change.NEVER)

#: What stands in the bag's custom metadata about a file of the drive: its name and SHA-256.
_IDENTIFIED_FILES = ("policy", "vehicle")

PARAMETERS = (
    _spec("output", "", "Folder of the bag to create; empty: rosbag2_<date and time> in the working directory."),
    _spec("topics", DEFAULT_TOPICS, "Topics to record; relative names honour namespace and remaps."),
    _spec("regex", "", "Regular expression; every topic whose full name matches it is recorded, too."),
    _spec(
        "signals_file",
        DEFAULT_MAPPING,
        "Signals YAML of the car: every topic it names is recorded, too; '': none but those of topics and regex.",
    ),
    _spec(
        "wait_for",
        [""],
        "Topics that must be matched before ~/ready says true; '': those of speed, wheels, demand and commands in the "
        "signals file, and power_manager/state; without a signals file those of topics.",
    ),
    _spec("record", True, "Begin to record at once; false: wait for ~/start."),
    _spec("compression", "zstd", "Compression of the chunks.", choices=COMPRESSIONS),
    _spec("chunk_bytes", 786_432, "Uncompressed size at which a chunk is written, bytes.", 1024, 64 * _MEBIBYTE),
    _spec("flush_period_s", 0.25, "Longest time a message is in memory only, s.", 0.05, 60.0),
    _spec("sync", True, "Have the disk take the data at each flush, so that a power cut loses hardly more."),
    _spec("max_bytes", 0, "Size at which the next file of the bag begins, bytes; 0: never.", 0, 2**62),
    _spec("max_duration_s", 0.0, "Time after which the next file of the bag begins, s; 0: never.", 0.0, 1e9),
    _spec("max_message_bytes", 64 * _MEBIBYTE, "A larger message is dropped and counted, bytes.", 1, 2**31),
    _spec("queue_bytes", 64 * _MEBIBYTE, "Memory for messages that wait to be written, bytes.", 1024, 2**40),
    _spec("depth", 2000, "Messages each subscription keeps until they are taken.", 1, 100_000),
    _spec("poll_period_s", 0.02, "Time between two rounds of taking messages, s.", 0.001, 0.2),
    _spec("snapshot_s", 0.0, "Time span kept in memory for ~/snapshot, s; 0: none.", 0.0, 3600.0),
    _spec("snapshot_bytes", 64 * _MEBIBYTE, "Memory for the snapshot, bytes; the oldest go first.", 1024, 2**40),
    _spec("node_parameters", True, "Put the parameters of the nodes that publish into the bag's metadata."),
    _spec("exit_on_error", True, "End with an error when recording fails; false: stay and report."),
    _spec("policy_file", "", "Policy of the drive; its name and SHA-256 go into the bag's metadata."),
    _spec("vehicle_file", "", "Vehicle of the drive; its name and SHA-256 go into the bag's metadata."),
    _spec("metadata", [""], "More custom metadata of the bag, each as key=value."),
)


class Recorder(Node):
    """The node: parameters, discovery, services and status around a `Recording`.

    Raises
    ------
    IwmError
        A parameter is wrong, or the bag cannot be created.
    """

    def __init__(self) -> None:
        super().__init__("recorder")
        self._leave_clock_to_the_recording()
        values = declare(self, PARAMETERS)
        topics = list(filter(None, values["topics"]))
        of_car, loop = self._of_car(values["signals_file"]) if values["signals_file"] else ([], topics)
        self._wait_for = self._in_full("wait_for", list(filter(None, values["wait_for"])) or loop)
        self._poll_s = values["poll_period_s"]
        self._exit_on_error = values["exit_on_error"]
        self._remote_parameters = RemoteParameters(self) if values["node_parameters"] else None
        self._clock_topic = -1
        self._now_ns: int | None = None
        self._held: list[Taken] = []
        self._raw = RawSubscriptions(
            self,
            self._in_full("topics", (*topics, *of_car)),
            _pattern(values["regex"]),
            values["depth"],
            _learn,
        )
        path = Path(values["output"] or datetime.now().strftime("rosbag2_%Y_%m_%d-%H_%M_%S"))
        self.recording = Recording(path, _options(values), _custom_data(values))
        if values["record"]:
            try:
                with of_parameter("output"):
                    self.recording.start()
            except IwmError:
                self.recording.close()  # its thread would keep this node, and with it DDS, alive
                raise

        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._ready_publisher = self.create_publisher(Bool, "~/ready", latched)
        self._diagnostics = self.create_publisher(DiagnosticArray, DIAGNOSTICS, 1)
        self.create_service(Trigger, "~/start", self._service(self.recording.start))
        self.create_service(Trigger, "~/stop", self._service(self.recording.stop))
        self.create_service(Trigger, "~/split", self._service(self.recording.split))
        self.create_service(Trigger, "~/snapshot", self._service(self.recording.snapshot))
        # Wall time: the status must come whether simulated time runs or not.
        self.create_timer(_STATUS_PERIOD_S, self._publish_status, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._ready = False
        self._matched_since: float | None = None
        self._waits_since = time.monotonic()
        self._ready_publisher.publish(Bool(data=False))

    def _of_car(self, signals_file: str) -> tuple[list[str], list[str]]:
        """Topics that a signals file names, and those without which a closed loop cannot run."""
        with of_parameter("signals_file"):
            mapping = load_mapping(resolve(signals_file))
            mapping.check_topics(self.resolve_topic_name)
        commands = [sink.topic for sinks in mapping.commands.values() for sink in sinks]
        sources = [source.topic for signal in _LOOP for source in mapping.sources.get(signal, ())]
        return [*mapping.topics(), *commands], [*sources, *commands, POWER_MANAGER_STATE]

    def _in_full(self, parameter: str, names: Iterable[str]) -> list[str]:
        """Full names of topics."""
        try:
            return list(map(self.resolve_topic_name, names))
        except Exception as error:  # noqa: BLE001 - rclpy's own, which is no public one
            problem = str(error).split(", at /")[0].removeprefix("failed to resolve name: ")
            raise ParameterError(f"parameter {parameter}: {problem}") from None

    # --- main loop --------------------------------------------------------------------------------------------------

    def run(self, interruption: Interruption) -> None:
        """Discover and take until asked to end or recording has failed."""
        next_discovery = 0.0
        while not interruption.wait(self._poll_s):
            now = time.monotonic()
            if now >= next_discovery:
                self._discover(now)
                next_discovery = now + (_DISCOVERY_SLOW_S if self._ready else _DISCOVERY_FAST_S)
            self._take()
            if self._exit_on_error and self.recording.failed.is_set():
                break

    def finish(self) -> None:
        """Take what still arrives, close the bag; `BagError` if recording had failed or fails now."""
        deadline = time.monotonic() + _FINAL_WAIT_S
        quiet_since = time.monotonic()
        while (now := time.monotonic()) < min(deadline, quiet_since + _FINAL_QUIET_S):
            if self._take():
                quiet_since = now
            time.sleep(self._poll_s)
        if self._held:
            # No /clock ever came: all messages keep the time they were received.
            self.recording.put(self._held)
        self.recording.close()
        status = self.recording.status()
        if self.recording.failed.is_set():
            raise BagError(f"{status.error}; {status.dropped_error} messages were not recorded")
        lost = sum(lost for _, lost, _ in self._raw.counts().values())
        dropped = status.dropped_queue + status.dropped_size
        self.get_logger().info(
            f"{status.path or 'no bag'}: {status.written} messages, {status.bytes_on_disk / 1e6:.1f} MB, "
            f"{status.files} file(s); dropped {dropped}, lost on the way {lost}"
        )

    def _discover(self, now: float) -> None:
        found, problems = self._raw.discover()
        for line in problems:
            self.get_logger().warning(line)
        for topic in found:
            try:
                definition, type_hash = definition_of(topic.type)
            except BagError as error:
                self.get_logger().warning(f"{topic.name}: recorded without a definition: {error}")
                definition, type_hash = "", topic.type_hash
            number = self.recording.add_topic(
                Topic(topic.name, topic.type, definition, topic.type_hash or type_hash, topic.offered)
            )
            if number != topic.number:
                raise AssertionError("topics are announced in the order they are found")
            if topic.name == CLOCK:
                self._clock_topic = number
        if self._remote_parameters is not None:
            for publisher in self._raw.publishers:
                self._remote_parameters.ask(publisher)
            answers = self._remote_parameters.answers()
            if answers:
                self.recording.add_custom_data({f"parameters {name}": text for name, text in answers.items()})
        self._update_ready(now)

    def _update_ready(self, now: float) -> None:
        missing = self._raw.unmatched(self._wait_for)
        if missing and now - self._waits_since >= _TELL_S:
            self._waits_since = math.inf
            self.get_logger().info(f"not ready, no publisher of {', '.join(missing)}; it records what comes")
        if missing:
            self._matched_since = None
        elif self._matched_since is None:
            self._matched_since = now
        ready = self._matched_since is not None and now - self._matched_since >= _SETTLE_S
        if ready != self._ready:
            self._ready = ready
            self._waits_since = now
            self._ready_publisher.publish(Bool(data=ready))
            self.get_logger().info("ready" if ready else "a topic has lost its publisher")

    def _take(self) -> bool:
        batch = self._raw.take()
        if not batch:
            return False
        self.recording.put(self._at_simulated_time(batch) if self._use_sim_time else batch)
        return True

    def _at_simulated_time(self, batch: list[Taken]) -> list[Sample]:
        """The batch with the time /clock showed when each message arrived.

        What comes before the first /clock is kept until then and gets its time: time had not begun.
        """
        samples: list[Sample] = []
        for taken in batch:
            number, _, data, sent, sequence = taken
            if number == self._clock_topic and len(data) >= CLOCK_FIELDS_OFFSET + CLOCK_FIELDS.size:
                seconds, nanoseconds = CLOCK_FIELDS.unpack_from(data, CLOCK_FIELDS_OFFSET)
                self._now_ns = max(seconds * 1_000_000_000 + nanoseconds, 0)
            if self._now_ns is None:
                self._held.append(taken)
                continue
            if self._held:
                samples += [(held[0], self._now_ns, *held[2:]) for held in self._held]
                self._held = []
            samples.append((number, self._now_ns, data, sent, sequence))
        return samples

    def _leave_clock_to_the_recording(self) -> None:
        """With use_sim_time rclpy would decode every /clock for a node clock that nothing here reads."""
        self._use_sim_time = bool(self.get_parameter("use_sim_time").value)
        for subscription in list(self.subscriptions):
            if subscription.topic_name == CLOCK:
                self.destroy_subscription(subscription)

    # --- services and status ----------------------------------------------------------------------------------------

    def _service(self, command: Callable[[], Path]) -> Callable[[Trigger.Request, Trigger.Response], Trigger.Response]:
        def handle(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            try:
                response.message = str(command())
                response.success = True
            except BagError as error:
                response.message = str(error)
                response.success = False
            return response

        return handle

    def _publish_status(self) -> None:
        status = self.recording.status()
        counts = self._raw.counts()
        lost = sum(lost for _, lost, _ in counts.values())
        dropped = status.dropped_queue + status.dropped_size + status.dropped_error
        if status.state == FAILED:
            level, text = DiagnosticStatus.ERROR, status.error
        elif dropped or lost:
            level, text = DiagnosticStatus.WARN, f"{status.state}; {dropped} dropped, {lost} lost on the way"
        elif status.disk_behind_s > _DISK_BEHIND_S:
            level = DiagnosticStatus.WARN
            text = f"{status.state}; the disk is slow: a power cut now would lose {status.disk_behind_s:.1f} s"
        elif self._use_sim_time and self._now_ns is None:
            level, text = DiagnosticStatus.WARN, f"{status.state}; waiting for {CLOCK}"
        else:
            level, text = DiagnosticStatus.OK, status.state
        values = {**asdict(status), "lost": lost, "topics": len(counts), "ready": self._ready}
        for name, (taken, missing, missed) in counts.items():
            values[name] = f"{taken} taken, {missing} lost, {missed} before the first"
        message = DiagnosticArray()
        now_ns = self._now_ns if self._use_sim_time else time.time_ns()
        message.header.stamp = ns_to_stamp(now_ns or 0)
        message.status = [
            DiagnosticStatus(
                level=level,
                name=f"{self.get_fully_qualified_name()}: recording",
                message=text,
                hardware_id=self.get_fully_qualified_name(),
                values=[KeyValue(key=str(key), value=str(value)) for key, value in values.items()],
            )
        ]
        self._diagnostics.publish(message)


def _learn(msgtype: str) -> None:
    """Have a type's definition at hand: nothing may be imported or compiled while messages are already coming."""
    with suppress(BagError):  # said when the topic is announced
        definition_of(msgtype)


def _pattern(text: str) -> re.Pattern[str] | None:
    try:
        return re.compile(text) if text else None
    except re.error as error:
        raise ParameterError(f"parameter regex: {text!r} is no regular expression: {error}") from None


def _options(values: Mapping[str, Any]) -> RecordingOptions:
    of_writer = {name: values[name] for name in ("compression", "chunk_bytes", "max_bytes", "max_message_bytes")}
    writer = WriterOptions(max_duration_ns=int(values["max_duration_s"] * 1e9), **of_writer)
    names = ("flush_period_s", "sync", "queue_bytes", "snapshot_s", "snapshot_bytes")
    return RecordingOptions(writer=writer, **{name: values[name] for name in names})


def _custom_data(values: Mapping[str, Any]) -> dict[str, str]:
    custom = {"package_version": __version__}
    for kind in _IDENTIFIED_FILES:
        if values[f"{kind}_file"]:
            path = resolve(values[f"{kind}_file"])
            custom[f"{kind}_file"] = path.name
            with of_parameter(f"{kind}_file"):
                custom[f"{kind}_sha256"] = content_sha256(path)
    for pair in filter(None, values["metadata"]):
        key, _, value = pair.partition("=")
        if not (key and value):
            raise ParameterError(f"parameter metadata: {pair!r} is not allowed; allowed: key=value")
        custom[key] = value
    return custom


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until Ctrl-C or SIGTERM, or recover bags; returns the exit code."""
    arguments = list(sys.argv[1:] if args is None else args)
    folders = _parser().parse_args(
        arguments[: arguments.index("--ros-args")] if "--ros-args" in arguments else arguments
    )
    try:
        if folders.recover:
            return _recover(folders.recover)
        return _run_node(arguments)
    except IwmError as error:
        print(f"recorder: {error}", file=sys.stderr)
        return error.exit_code


_EXAMPLES = f"""\
examples:
  The power manager's topics, into the folder drive_01:
    recorder --ros-args -p output:=drive_01
  Those of a car that has other topics, and the power manager's:
    recorder --ros-args -p output:=drive_01 -p signals_file:=my_signals.yaml
  Two more of the car's own topics, in a new file every ten minutes:
    recorder --ros-args -p output:=drive_01 -p regex:='/imu|/gps/.*' -p max_duration_s:=600.0
  My own topics alone:
    recorder --ros-args -p output:=drive_01 -p "signals_file:=''" -p "topics:=[/imu, /gps/fix]"
  What a power cut left:
    recorder --recover drive_01

{EXIT_CODES}, 3 what --recover was given
holds no message
"""


def _parser() -> argparse.ArgumentParser:
    parser = CommandParser(
        "recorder",
        usage="recorder [--ros-args -p NAME:=VALUE ... | --params-file FILE | -r FROM:=TO]\n"
        "       recorder --recover BAG ...",
        description="Record topics to a rosbag2 MCAP bag until Ctrl-C, or make a valid bag of what a crash left.",
        epilog=f"{parameters_help(PARAMETERS)}\n\n{_EXAMPLES}",
    )
    parser.add_argument(
        "--recover",
        metavar="BAG",
        nargs="+",
        help="make valid what a killed recorder left: folders, or single .mcap, .db3, .mcap.zstd files",
    )
    return parser


def _recover(bags: Sequence[str]) -> int:
    """Recover bags; returns the exit code, of the last one that was refused or has no message."""
    code = DONE
    for bag in bags:
        try:
            found = recover(bag)
            print("\n".join(map(one_line, found.lines())))
            code = code if found.message_count else CANNOT_TELL
        except IwmError as error:
            print(f"recorder: {error}", file=sys.stderr)
            code = error.exit_code
    return code


def _run_node(arguments: list[str]) -> int:
    interruption = Interruption(started=True)  # a bag that has been created is closed in order
    interruption.install()
    for kind in {*TOPIC_TYPES.values(), DiagnosticArray}:
        _learn(f"{kind.__module__.partition('.')[0]}/msg/{kind.__name__}")
    try:
        # rclpy's own handlers would close DDS before the last messages are taken.
        rclpy.init(args=["recorder", *arguments], signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # rcl's only word for a wrong --ros-args
        raise ParameterError(" ".join(str(error).split())) from None
    node: Recorder | None = None
    code = EXIT_FAILED
    try:
        node = Recorder()
        check_parameter_files(arguments, node.get_fully_qualified_name())
        _record(node, interruption)
        code = DONE
    except IwmError as error:  # not left to the caller: as long as it is on its way, it keeps the node
        code = EXIT_FAILED if node is not None and isinstance(error, BagError) else error.exit_code
        print(f"recorder: {error}", file=sys.stderr)
    finally:
        with ending.bounded(code):
            if node is not None:
                node.destroy_node()
                node = None
    return code


def _record(node: Recorder, interruption: Interruption) -> None:
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    with in_thread(executor, "executor"):
        node.run(interruption)
        node.finish()


if __name__ == "__main__":
    sys.exit(ending.at_exit(main()))
