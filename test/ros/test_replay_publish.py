# SPDX-License-Identifier: Apache-2.0
"""A recorded drive, played to the real node, gives what the offline replay gives; and what the node does, replays."""

from __future__ import annotations

import dataclasses
import json
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

import foreign_bags as foreign
from bags_helpers import ScriptedDrive
from iwm_power_manager.bags.reader import BagReader
from iwm_power_manager.exit_codes import DONE, FAILED
from iwm_power_manager.policy import load_policy, save_policy
from iwm_power_manager.ros.player import paced
from iwm_power_manager.share import share_path
from iwm_power_manager.signals.contract import FRICTION_BRAKE_COMMAND as FRICTION_COMMAND
from iwm_power_manager.signals.contract import WHEEL_TORQUE_COMMAND as MOTOR_COMMAND
from iwm_power_manager.tools.replay import main

PATIENCE_S = 90.0
COUNT = 120
INPUTS = ("/vehicle_speed", "/wheel_states", "/battery_state", "/power_demand")


@pytest.fixture
def start() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Start a module of the package as a process; its output is kept."""
    started: list[subprocess.Popen[str]] = []

    def run(module: str, *arguments: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-m", f"iwm_power_manager.{module}", *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            stdin=subprocess.PIPE,
            text=True,
        )
        started.append(process)
        return process

    yield run
    for process in started:
        process.kill()
        process.communicate()


def end(process: subprocess.Popen[str], number: signal.Signals | None = signal.SIGINT) -> tuple[str, str]:
    """Signal a process, wait for it, and expect a clean end."""
    if number is not None:
        process.send_signal(number)
    out, error = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, error
    return out, error


def until_says(process: subprocess.Popen[str], word: str) -> None:
    """Read standard error until a line with this word."""
    assert process.stderr is not None
    for line in process.stderr:
        if word in line:
            return
    pytest.fail(f"ended without saying {word}")


def played_to_the_node(
    tmp_path: Path,
    start: Callable[..., subprocess.Popen[str]],
    lockstep: bool,
    strategy: str,
    inputs: Path,
    policy_file: str = "''",
) -> Path:
    """Play `inputs` to a real power manager, record what happens; returns that bag."""
    parameters = [
        f"lockstep:={str(lockstep).lower()}",
        f"strategy:={strategy}",
        f"policy_file:={policy_file}",
        "use_sim_time:=true",
        "switching_power_w:=0.0",
        "friction_source:=parameter",  # a replay from inputs alone is told the friction
    ]
    manager = start("nodes.power_manager", "--ros-args", *(text for name in parameters for text in ("-p", name)))
    recorder = start(
        "nodes.recorder", "--ros-args", "-p", f"output:={tmp_path / 'recorded'}",
        "-p", "wait_for:=[power_manager/state]",
    )  # fmt: skip
    until_says(recorder, "ready")  # the node is active by then, its law compiled
    player = start("tools.replay", str(inputs), "--publish", "--rate", "1.0", "--listeners", "2")
    out, _ = end(player, None)
    assert f"{4 * COUNT} messages of 4 topics published" in out
    end(recorder)
    end(manager)
    return tmp_path / "recorded"


def commands(path: Path) -> dict[str, list[bytes]]:
    with BagReader(path) as reader:
        found = [(m.topic, m.data) for m in reader.messages()]
        assert reader.damage == []
    return {kind: [data for topic, data in found if topic == f"/{kind}"] for kind in (MOTOR_COMMAND, FRICTION_COMMAND)}


def test_the_lockstep_node_driven_by_a_bag_commands_what_the_offline_replay_does(
    tmp_path: Path, start: Callable[..., subprocess.Popen[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    strategy, policies = "sdp", share_path("policies")
    inputs = ScriptedDrive(strategy, policies).write(tmp_path / "inputs", COUNT, state=False, commands=False)
    recorded = played_to_the_node(tmp_path, start, True, strategy, inputs, str(policies))
    with BagReader(recorded) as reader, BagReader(inputs) as source:
        sent = [(m.topic, m.data) for m in source.messages()]
        for topic in INPUTS:  # played byte by byte
            got = [m.data for m in reader.messages() if m.topic == topic]
            wanted = [data for name, data in sent if name == topic]
            # DDS pads to a multiple of four bytes.
            assert [data[: len(want)] for data, want in zip(got, wanted, strict=True)] == wanted
        assert json.loads(reader.custom_data["parameters /power_manager"])["strategy"] == strategy
    assert main([str(inputs), "--output", str(tmp_path / "offline")]) == DONE
    online, offline = commands(recorded), commands(tmp_path / "offline")
    assert len(online[MOTOR_COMMAND]) == COUNT
    # The node's last command is zero torque, at deactivation; it may or may not be in time for the recorder.
    assert {kind: data[:COUNT] for kind, data in online.items()} == offline
    # And from the recorded state alone, the same once more; a changed gain or policy is seen.
    capsys.readouterr()
    assert main([str(recorded), "--compare", "--json", "-"]) == DONE
    report = json.loads(capsys.readouterr().out)
    assert (report["exact"], report["steps"]) == (True, COUNT)
    policy = load_policy(policies / "jalalmaab_2015_drag_coupled_mu090.npz")
    nudged = dataclasses.replace(policy, front_share=np.clip(policy.front_share + 0.01, 0.0, 1.0))
    save_policy(nudged, tmp_path / "nudged.npz")
    for change in (
        ["--set", "slew_up_nmps=1599"],
        ["--policy", str(tmp_path / "nudged.npz")],
        ["--friction", "0.2"],
    ):
        assert main([str(recorded), "--compare", *change]) == FAILED, change


def test_a_recording_of_the_real_time_node_replays_exactly(
    tmp_path: Path, start: Callable[..., subprocess.Popen[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    inputs = ScriptedDrive("instantaneous_slip").write(tmp_path / "inputs", COUNT, state=False, commands=False)
    recorded = played_to_the_node(tmp_path, start, False, "instantaneous_slip", inputs)
    assert main([str(recorded), "--compare", "--json", "-"]) == DONE
    report = json.loads(capsys.readouterr().out)
    assert report["exact"]
    assert report["steps"] > 20
    assert [entry["largest"] for entry in report["comparison"]] == [0.0, 0.0, 0.0]
    # Another car is seen, by its slip, whether or not its motors were allowed to regenerate meanwhile.
    car = share_path("config/vehicles/jalalmaab_2015.yaml").read_text()
    other = car.replace("radius_m: 0.33", "radius_m: 0.30")
    assert other != car
    (tmp_path / "other.yaml").write_text(other)
    assert main([str(recorded), "--compare", "--vehicle", str(tmp_path / "other.yaml")]) == FAILED


def test_start_end_and_steps_choose_what_is_played(tmp_path: Path, start: Callable[..., subprocess.Popen[str]]) -> None:
    inputs = ScriptedDrive("equal").write(tmp_path / "inputs", 100, state=False, commands=False)
    arguments = ("--start", "0.2", "--end", "0.6", "--topics", "vehicle_speed", "--listeners", "1")
    recorder = start(
        "nodes.recorder", "--ros-args", "-p", f"output:={tmp_path / 'played'}", "-p", "topics:=[/vehicle_speed,/clock]",
    )  # fmt: skip
    player = start("tools.replay", str(inputs), "--publish", "--step", *arguments)
    out, _ = player.communicate("\n" * 80, timeout=PATIENCE_S)
    assert player.returncode == 0
    assert "40 messages of 1 topics published" in out or "41 messages of 1 topics published" in out
    end(recorder)
    with BagReader(tmp_path / "played") as reader:
        found = list(reader.messages())
    speeds = [m for m in found if m.topic == "/vehicle_speed"]
    assert len(speeds) in (40, 41)
    assert any(m.topic == "/clock" for m in found)


def test_ctrl_c_ends_an_endless_loop_cleanly(tmp_path: Path, start: Callable[..., subprocess.Popen[str]]) -> None:
    inputs = ScriptedDrive("equal").write(tmp_path / "inputs", 5, state=False, commands=False)
    player = start("tools.replay", str(inputs), "--publish", "--loop")
    until_says(player, "nobody listens")
    out, _ = end(player)
    assert "published" in out


def test_a_part_without_messages_is_refused_with_the_part_that_has_some(
    tmp_path: Path, start: Callable[..., subprocess.Popen[str]]
) -> None:
    inputs = ScriptedDrive("equal").write(tmp_path / "inputs", 50, state=False, commands=False)
    player = start("tools.replay", str(inputs), "--publish", "--start", "100")
    _, error = player.communicate(timeout=PATIENCE_S)
    assert player.returncode == 2
    assert "holds no message to play between --start and --end; it holds some from 0.000 to 0." in error


def test_an_unknown_topic_is_named(tmp_path: Path, start: Callable[..., subprocess.Popen[str]]) -> None:
    inputs = ScriptedDrive("equal").write(tmp_path / "inputs", 5, state=False, commands=False)
    player = start("tools.replay", str(inputs), "--publish", "--topics", "/nope")
    _, error = player.communicate(timeout=PATIENCE_S)
    assert player.returncode == 2
    assert error.startswith(f"replay: error: {inputs}: holds no topic /nope; it holds /battery_state, ")


def test_a_drive_with_a_signals_file_of_its_own_is_not_played_without_it(
    tmp_path: Path, start: Callable[..., subprocess.Popen[str]]
) -> None:
    drive = ScriptedDrive("equal")
    drive.parameters = {**drive.parameters, "signals_file": "my_signals.yaml"}
    bag = drive.write(tmp_path / "drive", 5, state=False, commands=False)
    player = start("tools.replay", str(bag), "--publish")
    out, error = player.communicate(timeout=PATIENCE_S)
    assert player.returncode == 2
    assert out == ""
    assert "--mapping 'my_signals.yaml'" in error
    out, _ = end(start("tools.replay", str(bag), "--publish", "--rate", "1000", "--mapping", "standard"), None)
    assert "published" in out


def clocked(path: Path, clock_ns: Callable[[int], int], *more: foreign.Channel) -> Path:
    """A bag of a drive with a /clock beside, and one message of each further channel."""
    clock = foreign.Channel("/clock", "rosgraph_msgs/msg/Clock", "builtin_interfaces/Time clock\n")
    entries = foreign.drive(10)
    entries += [
        (foreign.START_NS + i * foreign.PERIOD_NS - 500, 3, foreign.header(clock_ns(i))[:12]) for i in range(10)
    ]
    entries += [(foreign.START_NS + 5, 4 + i, b"\0\1\0\0") for i in range(len(more))]
    return foreign.write_bag(path, sorted(entries), [*foreign.CHANNELS, clock, *more])


@pytest.mark.parametrize(
    ("shown", "jump"),
    [(lambda i: 50 + i % 5, "back by 0.080 s"), (lambda i: 50 + i + (i > 4) * 10**9, "forward by 20000000.020 s")],
    ids=["back", "forward"],
)
def test_a_clock_that_jumps_is_played_on_at_its_own_pace_and_said(
    tmp_path: Path, shown: Callable[[int], int], jump: str
) -> None:
    bag = clocked(tmp_path / "bag", lambda i: shown(i) * foreign.PERIOD_NS)
    jumps: list[str] = []
    with BagReader(bag) as reader:
        found = [(offset, time) for offset, time, message in paced(reader, jumps) if message.topic == "/demand"]
    pace = [0, 1, 2, 3, 4, 4, 5, 6, 7, 8]  # the time between the two drives is not known
    assert [offset for offset, _ in found] == [i * foreign.PERIOD_NS for i in pace]
    assert [time for _, time in found] == [shown(i) * foreign.PERIOD_NS for i in range(10)]
    assert jumps == [f"the recorded clock jumps {jump} after 0.080 s: played on at its own pace"]


def test_a_topic_whose_type_is_not_installed_is_left_out_with_one_line_and_the_rest_is_played(
    tmp_path: Path, start: Callable[..., subprocess.Popen[str]]
) -> None:
    lidar = foreign.Channel("/lidar", "vendor_msgs/msg/Packet", "uint8[] data\n")
    bag = clocked(tmp_path / "bag", lambda i: i * foreign.PERIOD_NS, lidar, foreign.log_channel()[0])
    out, error = end(start("tools.replay", str(bag), "--publish", "--rate", "1000"), None)
    assert "20 messages of 2 topics published" in out
    assert error.splitlines()[:3] == [
        "replay: /car/speed is left out: type my_msgs/msg/Speed is not installed here",
        "replay: /lidar is left out: type vendor_msgs/msg/Packet is not installed here",
        "replay: /log is left out: its messages are 'json', not CDR",
    ]
