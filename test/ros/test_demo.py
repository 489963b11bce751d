# SPDX-License-Identifier: Apache-2.0
"""The demo as a user runs it: three processes over DDS on a piece of NYCC, and everything they leave."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from iwm_power_manager.bags.reader import BagReader
from iwm_power_manager.control.record import measurement_of
from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.control.table import empty_table
from iwm_power_manager.cycle import load_cycle
from iwm_power_manager.exit_codes import INTERRUPTED
from iwm_power_manager.model.motor import electrical_power_w
from iwm_power_manager.replay.plan import Choice, make_plan
from iwm_power_manager.replay.run import Replay
from iwm_power_manager.replay.what_if import what_if
from iwm_power_manager.share import resolve
from iwm_power_manager.vehicle import load_vehicle
from iwm_sim import closed_loop
from iwm_sim.closed_loop import COLUMNS, Run
from iwm_sim.drive import load_run
from iwm_sim.drive_bag import read_drive_bag, with_decisions
from iwm_sim.tools import demo as demo_tool
from iwm_sim.tools import demo_run

STEPS = 1200
STRATEGY = "instantaneous_slip"
TOPICS = {
    "/vehicle_speed": "geometry_msgs/msg/TwistStamped",
    "/wheel_states": "sensor_msgs/msg/JointState",
    "/battery_state": "sensor_msgs/msg/BatteryState",
    "/power_demand": "std_msgs/msg/Float64",
    "/accelerator_pedal": "std_msgs/msg/Float64",
    "/brake_pedal": "std_msgs/msg/Float64",
    "/wheel_torque_command": "sensor_msgs/msg/JointState",
    "/friction_brake_command": "sensor_msgs/msg/JointState",
    "/power_manager/state": "sensor_msgs/msg/JointState",
    "/clock": "rosgraph_msgs/msg/Clock",
}


class Finished(NamedTuple):
    folder: Path
    cycle: Path
    code: int
    output: str
    error: str


def demo(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "iwm_sim.tools.demo", *map(str, arguments)]


@pytest.fixture(scope="module")
def cycle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """NYCC's first two hills, 24 s."""
    whole = load_cycle(resolve("config/cycles/nycc.csv"))
    path = tmp_path_factory.mktemp("cycle") / "two_hills.csv"
    rows = [f"{t - 46:g},{v}" for t, v in zip(whole.time_s, whole.speed_mps, strict=True) if 46 <= t <= 70]
    path.write_text("\n".join(["time_s,speed_mps", *rows]) + "\n")
    return path


@pytest.fixture(scope="module")
def alone(cycle: Path) -> Run:
    """The same drive in this process."""
    vehicle = load_vehicle(resolve("config/vehicles/jalalmaab_2015.yaml"))
    return closed_loop.run(load_cycle(cycle), vehicle, default_settings(STRATEGY), empty_table(), 0.9, dt_s=0.02)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory, cycle: Path, alone: Run) -> Finished:
    folder = tmp_path_factory.mktemp("demo") / "run"
    run = subprocess.run(
        demo("--cycle", cycle, "--strategy", STRATEGY, "--output", folder, "--json", folder.parent / "rows.json"),
        capture_output=True,
        text=True,
        timeout=280,
        check=False,
    )
    return Finished(folder, cycle, run.returncode, run.stdout, run.stderr)


def test_it_ends_well_and_says_where_everything_is(finished) -> None:
    assert finished.code == 0, finished.error
    assert f"bag:  {finished.folder / 'bag'}" in finished.output
    assert f"page: {finished.folder / 'drive.html'}" in finished.output
    assert "idle drive drag" in finished.output
    assert "all that were published" in finished.output


def test_the_drive_over_dds_is_the_drive_in_one_process_bit_for_bit(finished, alone) -> None:
    run, notes = load_run(finished.folder / "drive.npz")
    assert notes["resent"] == 0 or run.series.shape == alone.series.shape
    run = with_decisions(run, read_drive_bag(finished.folder / "bag"))
    assert len(run.series) == STEPS
    assert run["speed_mps"].max() > 8.0
    for name in COLUMNS:
        np.testing.assert_array_equal(run[name], alone[name], err_msg=name)
    assert run.final == alone.final
    assert "bit for bit" in finished.output


def test_the_bag_opens_with_rosbags_and_holds_every_message_that_was_published(finished) -> None:
    _, notes = load_run(finished.folder / "drive.npz")
    with AnyReader([finished.folder / "bag"]) as reader:
        found = {name: info for name, info in reader.topics.items() if name in TOPICS}
        assert {name: info.msgtype for name, info in found.items()} == TOPICS
        assert all(connection.msgdef.data for connection in reader.connections)
        counts = {name: info.msgcount for name, info in found.items()}
        for topic, published in notes["published"].items():
            assert counts[f"/{topic.lstrip('/')}"] == published
        demands = [
            reader.deserialize(data, connection.msgtype).data
            for connection, _, data in reader.messages(
                [connection for connection in reader.connections if connection.topic == "/power_demand"]
            )
        ]
    run, _ = load_run(finished.folder / "drive.npz")
    if notes["resent"] == 0:
        np.testing.assert_array_equal(demands, run["power_demand_w"])


def test_the_bag_opens_with_mcaps_reader_and_has_schemas_and_simulated_time(finished) -> None:
    (path,) = (finished.folder / "bag").glob("*.mcap")
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    schemas = {channel.topic: summary.schemas[channel.schema_id] for channel in summary.channels.values()}
    assert TOPICS.keys() <= schemas.keys()
    assert all(schemas[topic].encoding == "ros2msg" and schemas[topic].data for topic in TOPICS)
    span_s = (summary.statistics.message_end_time - summary.statistics.message_start_time) / 1e9
    assert span_s == pytest.approx(STEPS * 0.02, abs=0.1)


def test_the_table_shows_the_policy_beside_equal_distribution(finished) -> None:
    lines = finished.output.splitlines()
    for name, made in ((STRATEGY, "over DDS"), ("equal", "one process")):
        assert any(line.startswith(name) and line.endswith(made) for line in lines)
    assert all(len(line) <= 100 for line in lines if line.startswith(("Strategy", STRATEGY, "equal")))


def test_the_result_is_there_as_json(finished) -> None:
    result = json.loads((finished.folder.parent / "rows.json").read_text())
    assert result == json.loads((finished.folder / "result.json").read_text())
    driven, equal = result["rows"]
    assert driven["strategy"] == STRATEGY
    assert equal["strategy"] == "equal"
    assert driven["trace_held"] is True
    expected = 100.0 * (1.0 - driven["energy_wh"] / equal["energy_wh"])
    assert driven["saving_percent"] == pytest.approx(expected)
    assert result["settings"]["idle drive"] == "drag"


def test_the_page_shows_the_whole_drive(finished) -> None:
    page = (finished.folder / "drive.html").read_text()
    data = json.loads(page.split('<script type="application/json">')[1].split("</script>")[0])
    assert [panel["label"] for panel in data["panels"]] == [
        "Speed",
        "Power",
        "Front share",
        "Slip",
        "Torque of a wheel",
        "Gate",
        "State of charge",
        "Energy saved",
    ]
    assert data["time"][-1] == pytest.approx(STEPS * 0.02, abs=0.1)
    assert "✓ valid" in page


def test_what_replay_estimates_of_the_drive_differs_from_the_simulation_by_what_the_page_says(finished, alone) -> None:
    """docs/bags.md, What if: the law's battery, and speeds at the beginning of each step."""
    with BagReader(finished.folder / "bag") as bag:
        plan = make_plan(Choice(), bag.custom_data)
        recorded = what_if(bag, [(STRATEGY, plan)])[0][0]
        steps = [step for _, steps in Replay(bag, plan).steps() for step in steps]
    books = alone.final.energies
    assert recorded.chemical_wh == pytest.approx(books.chemical_j / 3600.0, rel=0.01)
    assert recorded.chemical_wh - recorded.electrical_wh > (books.ohmic_j + books.polarisation_j) / 3600.0
    speeds = np.array([measurement_of(step.values).wheel_speed_radps for step in steps])
    middle = np.vstack([(speeds[1:] + speeds[:-1]) / 2.0, speeds[-1:]])
    motors = [plan.vehicle.params.front.motor] * 2 + [plan.vehicle.params.rear.motor] * 2
    joules = 0.02 * sum(
        electrical_power_w(torque, speed, motor)
        for step, at in zip(steps, middle, strict=True)
        for torque, speed, motor in zip(step.command.motor_torque_nm, at, motors, strict=True)
    )
    assert joules == pytest.approx(books.chemical_j - books.ohmic_j - books.polarisation_j, rel=5e-4)


def test_it_refuses_to_write_over_another_run(finished) -> None:
    run = subprocess.run(
        demo("--cycle", finished.cycle, "--strategy", "equal", "--output", finished.folder),
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert run.returncode == 2
    assert run.stderr.splitlines() == [
        f"demo: {finished.folder}: cannot be created: File exists; allowed: a folder that is not there yet"
    ]


def children_of(process: int) -> set[int]:
    listed = subprocess.run(["ps", "-o", "pid=", "--ppid", str(process)], capture_output=True, text=True, check=False)
    return {int(line) for line in listed.stdout.split()}


def alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


def until(condition: Any, what: str) -> Any:
    end = time.monotonic() + 240.0
    while not (found := condition()):
        assert time.monotonic() < end, f"waited in vain for {what}"
        time.sleep(0.05)
    return found


@pytest.fixture
def in_the_middle(tmp_path: Path, alone: Run) -> Any:
    """A demo that is driving, with the ids of its three nodes by name."""
    folder = tmp_path / "run"
    process = subprocess.Popen(
        demo("--strategy", "equal", "--output", folder), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    log = folder / "log" / "simulator.log"
    until(lambda: log.exists() and "driving" in log.read_text(), "the drive to begin")
    nodes = children_of(process.pid)
    assert len(nodes) == 3
    yield process, nodes
    process.kill()
    process.communicate()


def test_ctrl_c_ends_every_process_and_says_what_stays(in_the_middle, tmp_path) -> None:
    process, nodes = in_the_middle
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130
    kept = f"what was recorded stays in {tmp_path / 'run'}"
    assert error.splitlines()[-1] == f"demo: stopped; all processes have ended; {kept}"
    assert not any(alive(node) for node in nodes)


def test_a_node_that_dies_ends_the_demo_with_its_name(in_the_middle) -> None:
    process, nodes = in_the_middle
    commands = {node: Path(f"/proc/{node}/cmdline").read_text() for node in nodes}
    (victim,) = (node for node, line in commands.items() if "iwm_power_manager.nodes.power_manager\0" in line)
    os.kill(victim, signal.SIGKILL)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "demo: the power manager was killed by SIGKILL" in error
    assert not any(alive(node) for node in nodes)


def test_a_scenario_is_driven_over_dds_and_held_against_what_it_requires(tmp_path: Path) -> None:
    scenario = tmp_path / "short_stop.yaml"
    scenario.write_text(
        "format: 1\nabout: A short stop.\nstart: {speed_mps: 5.0}\ndemand: [{from_s: 0.1, brake: 0.5}]\n"
        "road: {friction: 0.9}\nuntil: {time_s: 4.0, standstill: true}\n"
        "require: {stopping_distance_m: {at_most: 20.0}}\n"
    )
    arguments = ("--scenario", scenario, "--strategy", "equal", "--output", tmp_path / "run", "--json", "-")
    done = subprocess.run(demo(*arguments), capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert 1.0 < json.loads(done.stdout)["stopping_distance_m"] < 20.0  # and nothing else stands there
    assert "pass  short_stop: A short stop." in done.stderr
    assert "all that were published" in done.stderr


def test_a_gap_in_a_scenarios_cycle_is_said_before_it_is_driven(tmp_path: Path, monkeypatch, capsys) -> None:
    cycle, road = tmp_path / "tunnel.csv", tmp_path / "tunnel.yaml"
    cycle.write_text("time_s,speed_mps\n0,9\n1,10\n2,10\n62,10\n63,9\n64,9\n")
    road.write_text(f"format: 1\nabout: A tunnel.\ncycle: {cycle}\nroad: {{friction: 0.9}}\nuntil: {{time_s: 1}}\n")

    def interrupted() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(demo_run, "compile_for_a_drive", interrupted)
    arguments = ["--scenario", str(road), "--strategy", "equal", "--output", str(tmp_path / "run")]
    assert demo_tool.main(arguments) == INTERRUPTED
    assert f"demo: warning: {cycle}: line 5: is 60 s after the one before" in capsys.readouterr().err
