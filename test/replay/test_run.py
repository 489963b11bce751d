# SPDX-License-Identifier: Apache-2.0
"""Replay: bit by bit where nothing has changed, and never silent where something has."""

from __future__ import annotations

import dataclasses
import json
import math
import re
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer

from bags_helpers import TWIST, ScriptedDrive, float64, topic, twist
from iwm_power_manager.bags.metadata import Topic
from iwm_power_manager.bags.reader import BagReader
from iwm_power_manager.bags.writer import BagWriter
from iwm_power_manager.control.record import SIGNAL_NAMES, YOUNGER_SIGNALS
from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.errors import ConfigError, PolicyError
from iwm_power_manager.exit_codes import BAD_INPUT, CANNOT_TELL, DONE, FAILED
from iwm_power_manager.files import content_sha256
from iwm_power_manager.policy import load_policy, save_policy
from iwm_power_manager.replay.compare import TopicComparer
from iwm_power_manager.replay.plan import Choice, make_plan, recorded_parameters
from iwm_power_manager.replay.run import STATE, Replay, report_topics
from iwm_power_manager.share import share_path
from iwm_power_manager.signals.contract import WHEEL_TORQUE_COMMAND
from iwm_power_manager.signals.readings import joint_state_reader, joint_state_writer
from iwm_power_manager.signals.types import standard_types
from iwm_power_manager.tools.replay import main

COUNT = 150
STRATEGY = "instantaneous_slip"


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recorded drive with inputs, commands and state."""
    return ScriptedDrive(STRATEGY).write(tmp_path_factory.mktemp("drive") / "drive", COUNT)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same drive, inputs and commands only."""
    return ScriptedDrive(STRATEGY).write(tmp_path_factory.mktemp("inputs") / "inputs", COUNT, state=False)


def result(capsys: pytest.CaptureFixture[str]) -> dict[str, object]:
    found: dict[str, object] = json.loads(capsys.readouterr().out)
    return found


@pytest.mark.parametrize("kind", ["drive", "inputs"])
def test_an_unchanged_law_gives_the_recorded_commands_bit_by_bit(
    kind: str, request: pytest.FixtureRequest, capsys: pytest.CaptureFixture[str]
) -> None:
    path = request.getfixturevalue(kind)
    assert main([str(path), "--compare", "--json", "-"]) == DONE
    report = result(capsys)
    assert (report["exact"], report["steps"], report["gaps"]) == (kind == "drive", COUNT, 0)
    comparison = report["comparison"]
    assert isinstance(comparison, list)
    assert len(comparison) == (3 if kind == "drive" else 2)
    for entry in comparison:
        assert (entry["compared"], entry["differing"], entry["largest"], entry["first"]) == (COUNT, 0, 0.0, None)


@pytest.mark.parametrize("in_sets", [True, False], ids=["in sets", "at each wheel speed"])
def test_without_a_recorded_state_imu_and_direction_count_as_they_did_in_the_drive(
    in_sets: bool, tmp_path: Path
) -> None:
    drive = ScriptedDrive(STRATEGY, moving=True)
    driven = drive.write(tmp_path / "driven", COUNT, state=False)
    mapping = tmp_path / "signals.yaml"
    imu = "{topic: imu, type: sensor_msgs/msg/Imu, field: "
    mapping.write_text(
        share_path("config/signals/standard.yaml")
        .read_text()
        .replace(
            "\ncommands:",
            f"\n  yaw_rate: {imu}angular_velocity.z, unit: rad/s}}"
            f"\n  longitudinal_acceleration: {imu}linear_acceleration.x, unit: m/s2}}\ncommands:",
        )
    )
    if in_sets:
        assert main([str(driven), "--mapping", str(mapping), "--compare"]) == DONE
    with BagReader(driven) as old, BagWriter(tmp_path / "inputs", custom_data=old.custom_data) as new:
        left_out = () if in_sets else ("/battery_state",)
        numbers = {name: new.add_topic(found) for name, found in old.topics.items() if name not in left_out}
        for log_time_ns, name, data, publish_time_ns, sequence in old.messages():
            if name in numbers:
                new.write(numbers[name], log_time_ns, data, publish_time_ns, sequence)
    with BagReader(tmp_path / "inputs") as bag:
        replay = Replay(bag, make_plan(Choice(mapping=str(mapping)), bag.custom_data))
        made = [dict(zip(SIGNAL_NAMES, step.values, strict=True)) for _, steps in replay.steps() for step in steps]
    assert len(made) == (COUNT if in_sets else COUNT - 1)  # the first wheel speeds came before the first demand
    heard = 0
    for i, step in enumerate(made, COUNT - len(made)):
        heard = i if drive.motion(i) else heard
        shown = drive.motion(heard) if i - heard <= 10 else None
        assert (step["gyroscope"], step["accelerometer"]) == (float(shown is not None),) * 2
        assert (step["yaw_rate_radps"], step["acceleration_mps2"]) == (shown or (0.0, 0.0))
        assert step["direction"] == drive.direction(i)


@pytest.mark.parametrize(
    "change",
    [["--set", "slew_up_nmps=1599"], ["--set", "slip_target=0.01"], ["--strategy", "equal"]],
)
@pytest.mark.parametrize("kind", ["drive", "inputs"])
def test_a_changed_gain_limit_or_strategy_is_caught(
    kind: str, change: list[str], request: pytest.FixtureRequest, capsys: pytest.CaptureFixture[str]
) -> None:
    path = request.getfixturevalue(kind)
    assert main([str(path), "--compare", *change]) == FAILED
    text = capsys.readouterr().out
    assert "/wheel_torque_command" in text
    assert "first at message" in text


def test_a_changed_limit_of_the_vehicle_is_caught(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = share_path("config/vehicles/jalalmaab_2015.yaml").read_text()
    changed = tmp_path / "weaker.yaml"
    assert "regeneration_torque_nm" in text
    lines = [
        line.replace("80", "20", 1) if line.strip().startswith("regeneration_torque_nm") else line
        for line in text.splitlines()
    ]
    changed.write_text("\n".join(lines) + "\n")
    assert changed.read_text() != text
    assert main([str(drive), "--compare", "--vehicle", str(changed)]) == FAILED
    assert "friction_brake_command" in capsys.readouterr().out


POLICY = "jalalmaab_2015_drag_coupled_mu090.npz"


def changed_policies(folder: Path) -> dict[str, list[str]]:
    """Arguments for `replay` that stand for the recorded policy and for four others."""
    policy = load_policy(share_path(f"policies/{POLICY}"))
    nudged = dataclasses.replace(policy, front_share=np.clip(policy.front_share + 0.01, 0.0, 1.0))
    save_policy(nudged, folder / "nudged.npz")
    return {
        "the same": [],
        "the same file, copied": ["--policy", str(share_path(f"policies/{POLICY}"))],
        "another friction": ["--friction", "0.2"],
        "another file": ["--policy", str(share_path(f"policies/{POLICY}".replace("mu090", "mu050")))],
        "a table 0.01 off": ["--policy", str(folder / "nudged.npz")],
    }


@pytest.mark.parametrize("state", [True, False], ids=["drive", "inputs"])
def test_a_changed_policy_is_caught_and_the_same_one_matches(
    state: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # Long enough for the policies of friction 0.9 and 0.5, which are much alike, to disagree.
    drive = ScriptedDrive("sdp", share_path("policies")).write(tmp_path / "drive", 2 * COUNT, state=state)
    for name, arguments in changed_policies(tmp_path).items():
        wanted = DONE if name.startswith("the same") else FAILED
        assert main([str(drive), "--compare", *arguments]) == wanted, name
        text = capsys.readouterr().out
        assert ("first at message" in text) == (wanted == FAILED), name


def test_a_bag_of_before_a_signal_was_added_is_replayed(drive: Path, tmp_path: Path) -> None:
    read = joint_state_reader("position")
    names = [name for name in SIGNAL_NAMES if name not in YOUNGER_SIGNALS]
    write = joint_state_writer(names, "position")
    with BagReader(drive) as old, BagWriter(tmp_path / "old", custom_data=old.custom_data) as new:
        numbers = {name: new.add_topic(found) for name, found in old.topics.items()}
        for message in old.messages():
            data = message.data
            if message.topic.endswith(STATE):
                recorded = read(data)
                values = dict(zip(recorded.names, recorded.values, strict=True))
                data = write(recorded.stamp_ns, [values[name] for name in names])
            new.write(numbers[message.topic], message.log_time_ns, data, message.publish_time_ns, message.sequence)
    assert main([str(tmp_path / "old"), "--compare"]) == DONE


def test_commands_without_a_stamp_find_their_steps_also_where_the_clock_was_set_back(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    read = joint_state_reader("effort")
    hour_ns = 3600 * 10**9
    with BagReader(drive) as old, BagWriter(tmp_path / "bag", custom_data=old.custom_data) as new:
        numbers = {name: new.add_topic(found) for name, found in old.topics.items() if "torque" not in name}
        torques = [new.add_topic(topic(f"/torque_{wheel}")) for wheel in range(4)]
        for message in old.messages():
            back_ns = hour_ns if message.log_time_ns < old.start_ns + COUNT // 2 * ScriptedDrive.DT_NS else 0
            sent = [(numbers.get(message.topic), message.data)]
            if "torque" in message.topic:
                values = read(message.data).values
                sent = [(n, float64(v * s)) for n, v, s in zip(torques, values, (1, -1, 1, -1), strict=True)]
            for number, data in sent:
                times = message.log_time_ns + back_ns, data, message.publish_time_ns + back_ns
                new.write(number, *times, message.sequence)
    mapping = tmp_path / "mapping.yaml"
    four, standard = (share_path(f"config/signals/{name}.yaml").read_text() for name in ("four_topics", "standard"))
    brakes = standard[standard.index("  friction_torque:") :]
    mapping.write_text(four.replace("  friction_torque: none\n", brakes))
    assert main([str(tmp_path / "bag"), "--compare", "--mapping", str(mapping)]) == DONE
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[1:3] for line in lines if line.startswith("  /") and "clock" not in line] == [
        [str(COUNT), "0"]
    ] * 6
    assert not [line for line in lines if "time(s) steps before" in line]


@pytest.mark.parametrize("name", ["/splitter/state", "/cars/left/splitter/state", "/cars/left/power_manager/state"])
def test_the_state_of_a_node_of_any_name_is_found(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    """With the parameters under its name, and other topics called `state` beside it."""
    own = next(key for key in _custom(drive) if key.startswith("parameters "))
    renamed = {"parameters " + name.removesuffix("/state"): _custom(drive)[own], "parameters /a": '{"rate_hz": 1.0}'}
    foreign = joint_state_writer(("arm",), "position")
    with BagReader(drive) as old, BagWriter(tmp_path / "renamed", custom_data=renamed) as new:
        numbers = {
            topic: new.add_topic(found._replace(name=name) if topic.endswith(STATE) else found)
            for topic, found in old.topics.items()
        }
        state = next(found for topic, found in old.topics.items() if topic.endswith(STATE))
        others = [new.add_topic(state._replace(name=f"/{arm}/state")) for arm in ("arm", "broken", "silent")]
        for i, message in enumerate(old.messages()):
            if i == 3:
                new.write(others[0], message.log_time_ns, foreign(0, (1.0,)))
                new.write(others[1], message.log_time_ns, b"nothing")
            new.write(
                numbers[message.topic], message.log_time_ns, message.data, message.publish_time_ns, message.sequence
            )
    assert main([str(tmp_path / "renamed"), "--compare", "--json", "-"]) == DONE
    report = result(capsys)
    assert (report["exact"], report["steps"]) == (True, COUNT)
    assert main([str(tmp_path / "renamed"), "--output", str(tmp_path / "again")]) == DONE
    with BagReader(tmp_path / "again") as again:
        assert name in again.topics and not any(topic == f"/{STATE}" for topic in again.topics)


def test_the_states_of_two_nodes_are_refused_by_name(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with BagReader(drive) as old, BagWriter(tmp_path / "two") as new:
        (state,) = (found for topic, found in old.topics.items() if topic.endswith(STATE))
        numbers = [new.add_topic(state._replace(name=f"/{node}/state")) for node in ("a", "b")]
        for message in old.messages():
            if message.topic == state.name:
                for number in numbers:
                    new.write(number, message.log_time_ns, message.data)
    assert main([str(tmp_path / "two")]) == BAD_INPUT
    assert "holds the states of several nodes: /a/state, /b/state" in capsys.readouterr().err


def _custom(path: Path) -> dict[str, str]:
    with BagReader(path) as bag:
        return dict(bag.custom_data)


def test_a_policy_changed_in_its_place_is_caught(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "policy.npz"
    policy = load_policy(share_path(f"policies/{POLICY}"))
    save_policy(policy, file)
    drive = ScriptedDrive("sdp", file).write(tmp_path / "drive", COUNT)
    assert main([str(drive), "--compare", "--policy", str(file)]) == DONE
    save_policy(dataclasses.replace(policy, front_share=1.0 - policy.front_share), file)
    assert main([str(drive), "--compare", "--policy", str(file)]) == FAILED
    assert "first at message" in capsys.readouterr().out


def test_another_policy_that_decides_the_same_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "policy.npz"
    policy = load_policy(share_path(f"policies/{POLICY}"))
    save_policy(policy, file)
    drive = ScriptedDrive("sdp", file).write(tmp_path / "drive", 20, policy_sha256=content_sha256(file))
    assert main([str(drive), "--compare", "--policy", str(file)]) == DONE
    assert "not the one that was recorded" not in capsys.readouterr().out
    save_policy(dataclasses.replace(policy, package_version="0"), file)
    assert main([str(drive), "--compare", "--policy", str(file)]) == DONE
    assert "the policy is not the one that was recorded" in capsys.readouterr().out


def test_a_drive_with_a_policy_of_ones_own_says_which_and_finds_it_in_a_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A bag names files but opens none: it may choose among those that the user gives."""
    policies = tmp_path / "mine"
    policies.mkdir()
    policy = load_policy(share_path(f"policies/{POLICY}"))
    driven = dataclasses.replace(policy, front_share=np.clip(policy.front_share + 0.01, 0.0, 1.0))
    save_policy(policy, policies / "a.npz")  # of the same friction: no bank holds both
    save_policy(driven, policies / "b.npz")
    sha256 = content_sha256(policies / "b.npz")
    drive = str(ScriptedDrive("sdp", policies / "b.npz").write(tmp_path / "drive", COUNT, policy_sha256=sha256))
    assert main([drive, "--compare"]) == BAD_INPUT
    error = capsys.readouterr().err
    assert "strategy sdp needs a policy" in error
    assert f"--policy '{policies / 'b.npz'}' (SHA-256 {sha256[:12]}) (a file that a bag names is opened" in error
    assert main([drive, "--compare", "--policy", str(policies)]) == DONE
    assert f"of {policies}, b.npz is taken, as recorded" in capsys.readouterr().out
    (policies / "b.npz").rename(policies / "c.npz")  # another name, the same content
    assert main([drive, "--compare", "--policy", str(policies)]) == DONE
    (policies / "a.npz").rename(policies / "b.npz")  # the name of the one, the content of another
    assert main([drive, "--compare", "--policy", str(policies)]) == DONE
    assert "c.npz is taken" in capsys.readouterr().out
    assert main([drive, "--compare", "--policy", str(policies), "--friction", "0.9"]) == BAD_INPUT
    assert "is for friction 0.9, as is b.npz" in capsys.readouterr().err


def test_a_recorded_policy_of_unknown_hash_is_known_by_its_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    policies = tmp_path / "mine"
    policies.mkdir()
    policy = load_policy(share_path(f"policies/{POLICY}"))
    save_policy(policy, policies / "a.npz")
    drive = str(ScriptedDrive("sdp", policies / "a.npz").write(tmp_path / "drive", 20))
    save_policy(policy, policies / "b.npz")
    assert main([drive, "--compare", "--policy", str(policies)]) == DONE
    assert "a.npz is taken, as recorded" in capsys.readouterr().out


def test_a_difference_within_the_tolerance_is_none(drive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(drive), "--compare", "--set", "slew_up_nmps=1599", "--tolerance", "1e9"]) == DONE
    assert "/wheel_torque_command" in capsys.readouterr().out


def test_the_output_holds_the_inputs_as_recorded_and_the_same_bytes_every_time(drive: Path, tmp_path: Path) -> None:
    for name in ("one", "two"):
        assert main([str(drive), "--output", str(tmp_path / name / "out"), "--strategy", "equal"]) == DONE
    first, second = ({f.name: f.read_bytes() for f in (tmp_path / n / "out").iterdir()} for n in ("one", "two"))
    assert first == second
    with BagReader(drive) as recorded, BagReader(tmp_path / "one" / "out") as replayed:
        assert replayed.custom_data["replay_strategy"] == "equal"
        before, after = list(recorded.messages()), list(replayed.messages())
    inputs = ("/vehicle_speed", "/wheel_states", "/battery_state", "/power_demand")
    assert [m for m in after if m.topic in inputs] == [m for m in before if m.topic in inputs]
    assert len(after) == len(before)
    with AnyReader([tmp_path / "one" / "out"]) as reader:
        torques = [
            reader.deserialize(data, c.msgtype).effort
            for c, _, data in reader.messages()
            if c.topic == "/wheel_torque_command"
        ]
    assert any(abs(t[0]) > 1.0 for t in torques)


def test_a_replayed_bag_replays_exactly_itself(drive: Path, tmp_path: Path) -> None:
    assert main([str(drive), "--output", str(tmp_path / "equal"), "--strategy", "equal"]) == DONE
    assert main([str(tmp_path / "equal"), "--compare"]) == DONE


def test_missing_steps_are_reported_because_the_memory_of_the_law_is_then_unknown(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    state = "/power_manager/state"
    with BagReader(drive) as source, BagWriter(tmp_path / "gap") as bag:
        numbers = {name: bag.add_topic(topic) for name, topic in source.topics.items()}
        for message in source.messages():
            if not (message.topic == state and 40 <= message.sequence < 43):
                bag.write(numbers[message.topic], message.log_time_ns, message.data)
    main([str(tmp_path / "gap"), "--compare"])
    text = capsys.readouterr().out
    assert "1 time(s) steps before are not in the bag" in text
    assert "without counterpart: 3 recorded, 0 recomputed" in text


def without_its_start(drive: Path, path: Path, first: int) -> str:
    """A recording that began at step `first` of a drive."""
    with BagReader(drive) as source, BagWriter(path, custom_data=source.custom_data) as bag:
        numbers = {name: bag.add_topic(topic) for name, topic in source.topics.items()}
        for message in source.messages():
            if message.sequence >= first:
                bag.write(numbers[message.topic], message.log_time_ns, message.data)
    return str(path)


def test_a_recording_that_begins_in_the_middle_of_a_run_is_no_verdict(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([without_its_start(drive, tmp_path / "late", 40), "--compare"]) == CANNOT_TELL
    last = capsys.readouterr().out.splitlines()[-1]
    assert last == "  cannot tell: the recording lacks steps whose memory may explain it; start the recorder first"


def test_steps_of_two_nodes_on_one_topic_are_said_and_no_verdict(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    state = "/power_manager/state"
    with BagReader(drive) as source, BagWriter(tmp_path / "two") as bag:
        numbers = {name: bag.add_topic(topic) for name, topic in source.topics.items()}
        steps = []
        for message in source.messages():
            bag.write(numbers[message.topic], message.log_time_ns, message.data)
            if message.topic == state:
                steps.append(message.data)
                if len(steps) > 40:  # the other node was started later
                    bag.write(numbers[state], message.log_time_ns, steps[-41])
    assert main([str(tmp_path / "two"), "--compare"]) == CANNOT_TELL
    assert (
        capsys.readouterr().out.splitlines()[-1].startswith("  cannot tell: two nodes seem to have published the state")
    )


class CalmDrive(ScriptedDrive):
    """Sensors that agree, and a demand that jumps now and then: nothing to remember from before the first jump."""

    def inputs(self, i: int) -> tuple[float, list[float], float]:
        """Speed, wheel speeds and demand of step `i`."""
        return 8.0, [8.0 / 0.33] * 4, (0.0, 9000.0)[i // 100 % 2]


@pytest.mark.parametrize("first", [40, 90])
def test_a_change_is_told_from_a_late_start(first: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drive = CalmDrive("equal").write(tmp_path / "drive", 900)
    late = without_its_start(drive, tmp_path / "late", first)
    assert main([late, "--compare"]) != FAILED
    capsys.readouterr()
    assert main([late, "--compare", "--set", "slew_up_nmps=200"]) == FAILED
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.endswith("step(s) differ whatever the law remembered of those the recording lacks")
    assert int(last.split()[0]) > 0


def test_json_of_a_command_that_is_no_number_can_be_read_by_any_program(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with BagReader(drive) as old, BagWriter(tmp_path / "spoilt", custom_data=old.custom_data) as new:
        numbers = {topic: new.add_topic(found) for topic, found in old.topics.items()}
        for message in old.messages():
            spoilt = message.topic.endswith(WHEEL_TORQUE_COMMAND) and message.sequence == 20
            data = message.data[:-8] + struct.pack("<d", math.nan) if spoilt else message.data  # its last torque
            new.write(numbers[message.topic], message.log_time_ns, data)
    assert main([str(tmp_path / "spoilt"), "--compare", "--json", "-"]) == FAILED
    out = capsys.readouterr().out
    assert "NaN" not in out and "Infinity" not in out
    (torques,) = (entry for entry in json.loads(out)["comparison"] if entry["differing"])
    assert (torques["largest"], torques["first"]["recorded"]) == (None, None)


@pytest.mark.parametrize(
    ("name", "number"), [("step", math.inf), ("setting.strategy", 99.0), ("setting.gate_mode", 1e300)]
)
def test_a_state_that_no_law_can_have_had_is_a_bad_message(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, number: float
) -> None:
    read, write = joint_state_reader("position"), joint_state_writer(SIGNAL_NAMES, "position")
    with BagReader(drive) as old, BagWriter(tmp_path / "bad", custom_data=old.custom_data) as new:
        numbers = {topic: new.add_topic(found) for topic, found in old.topics.items()}
        for message in old.messages():
            data = message.data
            if message.topic.endswith(STATE) and message.sequence == 20:
                found = read(data)
                values = dict(zip(found.names, found.values, strict=True)) | {name: number}
                data = write(found.stamp_ns, list(values.values()))
            new.write(numbers[message.topic], message.log_time_ns, data)
    main([str(tmp_path / "bad"), "--compare"])
    assert "1 bad messages skipped" in capsys.readouterr().out


def test_a_command_recorded_under_another_name_is_named(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copied(drive, tmp_path / "renamed", {"/wheel_torque_command": "/torques"})
    main([str(tmp_path / "renamed"), "--compare"])
    (line,) = (line for line in capsys.readouterr().out.splitlines() if "not compared: " in line)
    assert "not compared: motor_torque on wheel_torque_command" in line
    assert "not in the bag; of its type: /torques; if it is one of them: --mapping with a copy" in line


def test_a_command_topic_that_carries_another_type_is_not_compared(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copied(drive, tmp_path / "renamed", {"/battery_state": "/bms", "/wheel_torque_command": "/torques"})
    text = share_path("config/signals/standard.yaml").read_text()
    mapping = tmp_path / "signals.yaml"
    mapping.write_text(text.replace("topic: battery_state", "topic: pack").replace("wheel_torque_command", "bms"))
    main([str(tmp_path / "renamed"), "--compare", "--mapping", str(mapping)])
    (line,) = (line for line in capsys.readouterr().out.splitlines() if "/bms" in line)
    carries = "commands.motor_torque.type: /bms carries sensor_msgs/msg/BatteryState, not sensor_msgs/msg/JointState"
    assert f"not compared: /bms: {mapping}: {carries}" in line


def test_a_bag_with_nothing_to_compare_cannot_tell(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with BagReader(drive) as source, BagWriter(tmp_path / "inputs") as bag:
        ours = ("/wheel_torque_command", "/friction_brake_command", "/power_manager/state")
        numbers = {name: bag.add_topic(topic) for name, topic in source.topics.items() if name not in ours}
        for message in source.messages():
            if message.topic in numbers:
                bag.write(numbers[message.topic], message.log_time_ns, message.data)
    assert main([str(tmp_path / "inputs"), "--compare"]) == CANNOT_TELL
    assert "nothing to compare" in capsys.readouterr().out


def copied(drive: Path, path: Path, names: dict[str, str], *more: Topic) -> None:
    """The same bag with other names of topics, and a message of `more` topics, each of a state."""
    with BagReader(drive) as source, BagWriter(path) as bag:
        numbers = {
            name: bag.add_topic(topic._replace(name=names.get(name, name))) for name, topic in source.topics.items()
        }
        others = [bag.add_topic(topic) for topic in more]
        for message in source.messages():
            bag.write(numbers[message.topic], message.log_time_ns, message.data)
            if message.topic == "/power_manager/state" and others:
                bag.write(others.pop(), message.log_time_ns, message.data)


@pytest.mark.parametrize("topic", ["wheel_torque_command", "friction_brake_command"])
def test_a_drive_with_commands_under_another_name_is_not_published(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], topic: str
) -> None:
    copied(drive, tmp_path / "renamed", {f"/{topic}": "/torques"})
    assert main([str(tmp_path / "renamed"), "--publish"]) == 2
    told = capsys.readouterr()
    assert "which a replay must not send: perhaps /torques; allowed: with --mapping" in told.err
    assert told.out == ""


def test_what_the_node_reports_is_neither_played_nor_copied_nor_taken_for_a_command(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with BagReader(drive) as source:
        state = source.topics["/power_manager/state"]
    estimate = state._replace(name="/power_manager/road_friction")
    copied(drive, tmp_path / "all", {"/wheel_torque_command": "/torques"}, estimate)
    with BagReader(tmp_path / "all") as bag:
        assert report_topics(bag) == ["/power_manager/state", "/power_manager/road_friction"]
    assert main([str(tmp_path / "all"), "--output", str(tmp_path / "again"), "--compare"]) in (0, 1)
    assert "of its type: /torques; if" in capsys.readouterr().out
    with BagReader(tmp_path / "again") as again:
        assert "/power_manager/road_friction" not in again.topics


def test_two_activations_in_one_bag_are_both_repeated_from_their_first_step(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    second = ScriptedDrive(STRATEGY).write(tmp_path / "second", 50, start=COUNT)
    with BagWriter(tmp_path / "both") as bag:
        numbers: dict[str, int] = {}
        for path in (drive, second):
            with BagReader(path) as source:
                for name, described in source.topics.items():
                    numbers.setdefault(name, bag.add_topic(described) if name not in numbers else 0)
                for message in source.messages():
                    bag.write(numbers[message.topic], message.log_time_ns, message.data)
    assert main([str(tmp_path / "both"), "--compare"]) == DONE
    assert f"{COUNT + 50} steps" in capsys.readouterr().out


def test_a_repeated_answer_is_compared_but_not_stepped_twice(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with BagReader(drive) as source, BagWriter(tmp_path / "twice") as bag:
        numbers = {name: bag.add_topic(topic) for name, topic in source.topics.items()}
        for message in source.messages():
            for _ in range(2 if message.sequence == 60 else 1):
                bag.write(numbers[message.topic], message.log_time_ns, message.data)
    assert main([str(tmp_path / "twice"), "--compare"]) == DONE
    assert f" {COUNT + 1} " in capsys.readouterr().out  # compared once more, and equal


def test_bad_messages_are_counted_and_skipped(drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with BagReader(drive) as source, BagWriter(tmp_path / "bad") as bag:
        numbers = {name: bag.add_topic(topic) for name, topic in source.topics.items()}
        for message in source.messages():
            bag.write(numbers[message.topic], message.log_time_ns, message.data)
            if message.sequence == 70 and message.topic in ("/power_manager/state", "/wheel_torque_command"):
                bag.write(numbers[message.topic], message.log_time_ns, b"\0\1\0\0\1\2")
    assert main([str(tmp_path / "bad"), "--compare"]) == DONE
    assert "2 bad messages skipped" in capsys.readouterr().out


def test_a_damaged_bag_is_replayed_as_far_as_it_goes(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "cut.mcap"
    with BagReader(drive) as source, BagWriter(tmp_path / "small") as bag:
        numbers = {name: bag.add_topic(topic) for name, topic in source.topics.items()}
        for i, message in enumerate(source.messages()):
            bag.write(numbers[message.topic], message.log_time_ns, message.data)
            if i % 70 == 69:
                bag.flush()
    content = (tmp_path / "small" / "small_0.mcap").read_bytes()
    path.write_bytes(content[: len(content) // 2])
    assert main([str(path), "--compare"]) == DONE
    text = capsys.readouterr().out
    assert "damaged: " in text
    assert "repeated from the recorded state" in text


def foreign_bag(path: Path, count: int) -> Path:
    """Another car: odometry, wheels in rpm by other names, demand in kW as Float32; sqlite3, 50 Hz, no lock-step."""
    script = ScriptedDrive(STRATEGY)
    types = standard_types().types
    stamp_type, header_type = types["builtin_interfaces/msg/Time"], types["std_msgs/msg/Header"]
    with Writer(path, version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        odometry = writer.add_connection("/odom", "nav_msgs/msg/Odometry", typestore=standard_types())
        wheels = writer.add_connection("/joint_states", "sensor_msgs/msg/JointState", typestore=standard_types())
        demand = writer.add_connection("/demand", "std_msgs/msg/Float32", typestore=standard_types())
        for i in range(count):
            now = i * 20_000_000
            stamp = stamp_type(now // 10**9, now % 10**9)
            header = header_type(stamp, "odom")
            speed, radps, watts = script.inputs(2 * i)
            vector, point = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Point"](0, 0, 0)
            twist_type = types["geometry_msgs/msg/Twist"](vector(speed, 0, 0), vector(0, 0, 0))
            pose = types["geometry_msgs/msg/Pose"](point, types["geometry_msgs/msg/Quaternion"](0, 0, 0, 1))
            matrix = np.zeros(36)
            message = types["nav_msgs/msg/Odometry"](
                header,
                "base",
                types["geometry_msgs/msg/PoseWithCovariance"](pose, matrix),
                types["geometry_msgs/msg/TwistWithCovariance"](twist_type, matrix),
            )
            rpm = np.array([radps[k] for k in (3, 0, 2, 1)]) * 30.0 / np.pi
            joint = types["sensor_msgs/msg/JointState"](header, ["d", "a", "c", "b"], np.zeros(0), rpm, np.zeros(0))
            writer.write(odometry, now + 3_000_000, standard_types().serialize_cdr(message, "nav_msgs/msg/Odometry"))
            writer.write(
                demand,
                now + 4_000_000,
                standard_types().serialize_cdr(types["std_msgs/msg/Float32"](watts / 1000.0), "std_msgs/msg/Float32"),
            )
            writer.write(wheels, now + 5_000_000, standard_types().serialize_cdr(joint, "sensor_msgs/msg/JointState"))
    return path


def test_another_cars_bag_is_replayed_through_a_mapping(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = foreign_bag(tmp_path / "foreign", 60)
    mapping = tmp_path / "mapping.yaml"
    mapping.write_text(
        "signals:\n  speed: {topic: /odom, field: twist.twist.linear.x, unit: m/s}\n"
        "  wheel_speed: {topic: /joint_states, field: velocity, unit: rpm, names: [a, b, c, d]}\n"
        "  power_demand: {topic: /demand, field: data, unit: kW}\n"
    )
    arguments = [str(path), "--mapping", str(mapping), "--strategy", STRATEGY, "--output", str(tmp_path / "out")]
    assert main([*arguments, "--json", "-"]) == DONE
    report = result(capsys)
    assert (report["exact"], report["steps"], report["bad_messages"], report["dropped"]) == (False, 60, 0, {})
    assert report["comparison"] == []
    with BagReader(tmp_path / "out") as reader:
        assert set(reader.topics) == {
            "/odom", "/joint_states", "/demand",
            "/wheel_torque_command", "/friction_brake_command", "/power_manager/state",
        }  # fmt: skip
        assert reader.counts["/wheel_torque_command"] == 60
    assert main([str(tmp_path / "out"), "--compare"]) == DONE  # its own state repeats it exactly


def _write_inputs(path: Path, times_ns: Sequence[int]) -> None:
    """A bag of inputs alone, at these times."""
    script = ScriptedDrive(STRATEGY)
    with BagWriter(path) as bag:
        from bags_helpers import joint_state_writer

        speed, demand = bag.add_topic(topic("/vehicle_speed", TWIST)), bag.add_topic(topic("/power_demand"))
        wheels = bag.add_topic(topic("/wheel_states", "sensor_msgs/msg/JointState"))
        encode = joint_state_writer(("front_left", "front_right", "rear_left", "rear_right"), "velocity")
        for i, now in enumerate(times_ns):
            metres, radps, watts = script.inputs(i)
            bag.write(speed, now, twist(now, metres))
            bag.write(demand, now + 1, float64(watts))
            bag.write(wheels, now + 2, encode(now, radps))


def test_a_pause_in_the_inputs_starts_the_law_anew(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _write_inputs(tmp_path / "bag", [i * 10_000_000 + (5_000_000_000 if i >= 30 else 0) for i in range(60)])
    assert main([str(tmp_path / "bag"), "--strategy", "equal", "--json", "-"]) == DONE
    report = result(capsys)
    assert report["restarts"] == 1
    assert report["steps"] == 59  # the first wheel speed after the pause had no speed and demand to go with it


def test_what_if_shows_the_recorded_energy_and_that_of_each_strategy(
    drive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [str(drive), "--what-if", "jalalmaab_2015", "--strategy", "equal", STRATEGY, "--json", "-"]
    assert main(arguments) == DONE
    rows = {row["label"]: row for row in result(capsys)["rows"]}  # type: ignore[attr-defined, index]
    assert list(rows) == ["recorded", "equal", STRATEGY]
    assert rows["recorded"] == {**rows[STRATEGY], "label": "recorded"}
    assert rows["equal"]["chemical_wh"] != rows["recorded"]["chemical_wh"]
    assert rows["equal"]["distance_m"] == rows["recorded"]["distance_m"] > 1.0
    assert rows["equal"]["idle_drag_wh"] < rows["recorded"]["idle_drag_wh"]


def test_what_if_says_what_it_was_made_with(drive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(drive), "--what-if", "jalalmaab_2015", "--strategy", "equal", "sdp", "--friction", "0.5"]) == DONE
    lines = [line for line in capsys.readouterr().out.splitlines() if "control at" in line]
    made = "friction 0.5, idle drive drag, control at 100 Hz, split decided every 0.02 s"
    assert lines[0] == f"  equal: {made}"
    assert re.fullmatch(rf"  sdp: {made}, policy coupled [0-9a-f]{{8}}", lines[1])


def test_a_rate_that_is_not_the_nodes_is_called_a_mean(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _write_inputs(tmp_path / "bag", [i * 10_000_000 for i in range(60) if i % 3])
    assert main([str(tmp_path / "bag"), "--what-if", "jalalmaab_2015", "--strategy", "equal"]) == DONE
    (line,) = (line for line in capsys.readouterr().out.splitlines() if "control at" in line)
    assert line.endswith("; the rate is the mean of the recorded steps")


def test_energy_of_a_constant_step_is_power_times_time(drive: Path) -> None:
    from iwm_power_manager.control.types import Measurement
    from iwm_power_manager.model.motor import electrical_power_w
    from iwm_power_manager.replay.what_if import Consumption

    car = ScriptedDrive("equal").vehicle.params
    found = Consumption("x")
    measurement = Measurement(10.0, (30.0,) * 4, 0.0, 0.5, 0.9, 1e5, 1e5, 0.7)
    for _ in range(8):
        found.add(car, measurement, (20.0,) * 4, (0.0, 0.0, -1.0, -1.0))
    assert found.distance_m == pytest.approx(40.0)
    backwards = Consumption("x")
    backwards.add(car, measurement._replace(speed_mps=-10.0, wheel_speed_radps=(-30.0,) * 4), (-20.0,) * 4, (0.0,) * 4)
    assert backwards.distance_m == pytest.approx(5.0)
    assert found.electrical_wh == pytest.approx(4 * electrical_power_w(20.0, 30.0, car.front.motor) * 4.0 / 3600.0)
    assert found.chemical_wh > found.electrical_wh
    assert found.friction_wh == pytest.approx(-2 * 30.0 * 4.0 / 3600.0)
    assert found.wheel_work_wh == pytest.approx((4 * 20.0 - 2.0) * 30.0 * 4.0 / 3600.0)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["/none"], "/none: does not exist"),
        (["{drive}", "--strategy", "best"], "--strategy: strategy: 'best' is not allowed; allowed: equal | "),
        (["{drive}", "--strategy", "preview"], "--strategy: strategy: 'preview' is not allowed"),
        (["{drive}", "--strategy", "sdp", "--policy", "/none.npz"], "/none.npz"),
        (["{drive}", "--strategy", "sdp", "--policy", ""], "strategy sdp needs a policy: name one with --policy"),
        (["{drive}", "--set", "gain=1"], "--set: gain: is no setting of the law; allowed: strategy, decision_period_s"),
        (["{drive}", "--set", "critical_slip=x"], "--set: critical_slip"),
        (["{drive}", "--set", "gate_mode=x"], "--set: gate_mode: 'x' is not allowed; allowed: off | table2 | limiter"),
        (["{drive}", "--set", "gate_driving=1"], "--set: gate_driving: '1' is not allowed; allowed: true | false"),
        (["{drive}", "--set", "slip_speed_floor_mps=0"], "slip_speed_floor_mps: '0' is not allowed; allowed: 0.01"),
        (["{drive}", "--set", "slip_target=0.3"], "slip_target: 0.3 is not allowed; allowed: at most"),
        (["{drive}", "--vehicle", "/none.yaml"], "/none.yaml"),
        (["{drive}", "--mapping", "/none.yaml"], "/none.yaml"),
        (["{drive}", "--friction", "7"], "--friction"),
        (["{drive}", "--tolerance", "-1"], "--tolerance"),
        (["{drive}", "--publish", "--compare"], "--publish: excludes"),
        (["{drive}", "--what-if", "jalalmaab_2015", "--compare"], "--what-if: excludes"),
        (["{drive}", "--strategy", "equal", "sdp"], "--strategy: several make sense with --what-if only"),
        (["{drive}", "--publish", "--start", "3", "--end", "2"], "--end"),
        (["{drive}", "--output", "{drive}"], "exists already and is not overwritten"),
    ],
)
def test_a_mistake_gets_one_line_and_exit_code_2(
    arguments: list[str], line: str, drive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        code = main([argument.replace("{drive}", str(drive)) for argument in arguments])
    except SystemExit as ended:  # a value that the parser refuses
        code = ended.code
    assert code == BAD_INPUT
    error = capsys.readouterr().err
    assert line in error
    assert error.startswith("replay: error: ")
    assert len(error.strip().splitlines()) == 1


def test_a_bag_without_wheel_speeds_or_steps_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        speed, demand = bag.add_topic(topic("/vehicle_speed", TWIST)), bag.add_topic(topic("/power_demand"))
        bag.write(speed, 1, twist(1, 1.0))
        bag.write(demand, 2, float64(1.0))
    assert main([str(tmp_path / "bag"), "--strategy", "equal"]) == BAD_INPUT
    assert "maps to wheel_speed" in capsys.readouterr().err


def test_a_replay_that_fails_leaves_nothing_in_the_way(drive: Path, tmp_path: Path) -> None:
    arguments = [str(drive), "--output", str(tmp_path / "out")]
    assert main([*arguments, "--strategy", "sdp", "--policy", "/none.npz"]) == BAD_INPUT
    assert not (tmp_path / "out").exists()
    assert main([*arguments, "--output", str(drive)]) == BAD_INPUT  # what is not ours stays
    assert (drive / "metadata.yaml").exists()
    assert main(arguments) == DONE


def test_a_bag_whose_inputs_never_come_together_gives_no_step(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from bags_helpers import joint_state_writer

    with BagWriter(tmp_path / "bag") as bag:
        speed, demand = bag.add_topic(topic("/vehicle_speed", TWIST)), bag.add_topic(topic("/power_demand"))
        wheels = bag.add_topic(topic("/wheel_states", "sensor_msgs/msg/JointState"))
        encode = joint_state_writer(("front_left", "front_right", "rear_left", "rear_right"), "velocity")
        bag.write(wheels, 1, encode(1, (1.0, 1.0, 1.0, 1.0)))
        bag.write(speed, 2, twist(2, 1.0))
        bag.write(demand, 3, float64(1.0))
    assert main([str(tmp_path / "bag"), "--strategy", "equal", "--output", str(tmp_path / "out")]) == BAD_INPUT
    assert "gave no control step" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_plan_comes_from_the_options_else_from_the_bag_else_from_the_package() -> None:
    parameters = {"strategy": "rule", "rule": [1.0, 0.25, 0.0, 0.5], "friction": 0.4, "critical_slip": 0.1,
                  "gate_mode": "table2", "rate_hz": 50.0, "idle_drive": "none"}  # fmt: skip
    custom = {"parameters /car/power_manager": json.dumps(parameters), "parameters /other": "{}"}
    plan = make_plan(Choice(), custom)
    assert plan.settings == default_settings("rule")._replace(critical_slip=0.1, gate_mode=1)
    assert (plan.friction, plan.keeps_friction, plan.period_s) == (0.4, True, 0.02)
    assert plan.vehicle.idle_drive == "none"
    assert plan.policies.table(plan.settings.strategy, 0.4).rule.tolist() == [1.0, 0.25, 0.0, 0.5]
    plan = make_plan(Choice(strategy="equal", friction=0.7, settings=("critical_slip=0.3",)), custom)
    assert plan.changes == {"strategy": default_settings("equal").strategy, "critical_slip": 0.3}
    assert (plan.friction, plan.keeps_friction) == (0.7, False)
    assert make_plan(Choice(strategy="equal"), {}).settings == default_settings("equal")
    assert recorded_parameters({"parameters /power_manager": "not json"}) == {}


def test_a_policy_for_another_car_is_refused(tmp_path: Path) -> None:
    with pytest.raises((PolicyError, ConfigError)):
        make_plan(Choice(policy=str(tmp_path)), {}).policies.table(default_settings("sdp").strategy, 0.9)


def test_a_comparison_tells_largest_rms_first_and_what_has_no_counterpart() -> None:
    comparer = TopicComparer("/t", 0.5)
    nan = float("nan")
    comparer.recorded(1, 101, ("a", "b"), (1.0, 2.0))
    comparer.recomputed(1, 0, ("a", "b"), (1.0, 2.25))  # within the tolerance
    comparer.recomputed(2, 0, ("a", "b"), (4.0, 2.0))  # recomputed may come first
    comparer.recorded(2, 102, ("b", "a"), (2.0, 1.0))  # and names in another order
    comparer.recorded(3, 103, ("a", "b"), (nan, nan))
    comparer.recomputed(3, 0, ("a", "b"), (nan, nan))
    comparer.recorded(4, 104, ("a", "b"), (0.0, 0.0))
    comparer.recomputed(5, 0, ("a", "b"), (0.0, 0.0))
    found = comparer.result()
    assert (found.compared, found.differing, found.largest, found.worst) == (3, 1, 3.0, "a")
    assert found.rms == pytest.approx(np.sqrt((0.25**2 + 9.0) / 6.0))
    assert (found.only_recorded, found.only_recomputed) == (1, 1)
    assert found.first is not None
    assert dataclasses.asdict(found.first) == {
        "message": 1, "stamp_ns": 2, "log_time_ns": 102, "name": "a", "recorded": 1.0, "recomputed": 4.0,
    }  # fmt: skip
    for side in (comparer.recorded, comparer.recomputed):  # an answer that was sent again
        side(7, 107, ("a", "b"), (1.0, 1.0))
        side(7, 108, ("a", "b"), (1.0, 1.0))
    assert dataclasses.replace(comparer.result(), compared=3, rms=found.rms) == found
    assert comparer.result().compared == 5
    comparer.recorded(6, 106, ("a",), (0.0,))
    comparer.recomputed(6, 0, ("a", "b"), (0.0, 1.0))  # a value the record lacks
    assert comparer.result().largest == np.inf


def test_a_state_of_another_version_is_refused_by_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from bags_helpers import joint_state_writer

    with BagWriter(tmp_path / "bag") as bag:
        number = bag.add_topic(topic("/power_manager/state", "sensor_msgs/msg/JointState"))
        bag.write(number, 1, joint_state_writer(("speed_mps",), "position")(1, (2.0,)))
    assert main([str(tmp_path / "bag"), "--compare"]) == BAD_INPUT
    assert "lacks the signal 'front_left_speed_radps': recorded by another version" in capsys.readouterr().err


def test_progress_is_called_with_messages_and_time(drive: Path) -> None:
    seen: list[tuple[int, int]] = []
    with BagReader(drive) as bag:
        replay = Replay(bag, make_plan(Choice(strategy="equal"), bag.custom_data))
        from iwm_power_manager.replay import run as module

        every = module.PROGRESS_EVERY
        module.PROGRESS_EVERY = 100
        try:
            for _ in replay.steps(lambda messages, log_time_ns: seen.append((messages, log_time_ns))):
                pass
        finally:
            module.PROGRESS_EVERY = every
    assert [messages for messages, _ in seen] == list(range(100, COUNT * 7 + 1, 100))
    assert [time for _, time in seen] == sorted(time for _, time in seen)


@pytest.mark.parametrize(("recorded", "differing"), [(("old",), 0), (("old", "new"), 1)])
def test_a_younger_signal_is_compared_where_the_record_has_it(recorded, differing):
    comparer = TopicComparer("/t", 0.5, {"new"})
    comparer.recorded(0, 0, recorded, (1.0, 7.0)[: len(recorded)])
    comparer.recomputed(0, 0, ("old", "new"), (1.0, 9.0))
    assert comparer.result().differing == differing
    comparer.recorded(1, 0, (), ())
    comparer.recomputed(1, 0, ("old",), (1.0,))
    assert comparer.result().differing == differing + 1
