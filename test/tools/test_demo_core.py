# SPDX-License-Identifier: Apache-2.0
"""The demo without processes: its command line, what it starts nodes with, comparisons and the table."""

import json
import signal
from dataclasses import replace

import numpy as np
import pytest
import yaml

from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.control.table import empty_table
from iwm_power_manager.cycle import make_cycle
from iwm_power_manager.nodes import power_manager_config
from iwm_power_manager.share import resolve
from iwm_power_manager.tools.command import plain
from iwm_power_manager.vehicle import load_vehicle
from iwm_sim import closed_loop, dds_drive, metrics, simulator
from iwm_sim.closed_loop import COLUMNS, Run
from iwm_sim.drive_bag import DriveBag, problems, with_decisions
from iwm_sim.metrics import Metrics
from iwm_sim.plant import initial_plant
from iwm_sim.study.drive_page import COLUMNS as RESULT
from iwm_sim.study.drive_page import Driven, DriveRow, drive_page, row
from iwm_sim.study.report import Chart
from iwm_sim.study.tables import plain_table
from iwm_sim.tools import demo


def run_of(steps=100, **columns):
    series = np.full((steps, len(COLUMNS)), np.nan)
    for name in COLUMNS:
        series[:, COLUMNS.index(name)] = columns.get(name, 1.0)
    series[:, COLUMNS.index("time_s")] = np.arange(steps) * 0.02
    params = load_vehicle(resolve("config/vehicles/jalalmaab_2015.yaml")).params
    return Run(0.02, series, initial_plant(params, 0.8))


# --- command line ---------------------------------------------------------------------------------------------------


def test_without_arguments_it_drives_nycc_with_the_shipped_policy_in_lockstep():
    plan = demo.parse([])
    assert plan.cycle == "config/cycles/nycc.csv"
    assert (plan.policy, plan.strategy) == ("policies", "sdp_lookahead")
    assert plan.rate_hz >= 50.0
    assert plan.record
    assert not plan.realtime
    assert plan.output.parent.name == "runs"


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--cycle", "/nowhere.csv", "--strategy", "equal"], "demo: /nowhere.csv: cannot be read"),
        (["--vehicle", "/nowhere.yaml", "--strategy", "equal"], "demo: /nowhere.yaml: cannot be read"),
        (["--policy", "/nowhere.npz"], "demo: /nowhere.npz: cannot be read"),
        (["--policy", ""], "demo: policy_file: is empty"),
        (["--strategy", "equal", "--output", "."], "demo: .: cannot be created: File exists"),
    ],
)
def test_a_bad_file_gives_one_line_before_anything_starts(tmp_path, monkeypatch, capsys, arguments, expected):
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    assert demo.main(["--output", str(tmp_path / "run"), *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(expected)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--friction", "7"], "argument --friction: 7 is out of range; allowed: 0.05 to 1.5"),
        (["--friction", "nan"], "argument --friction: nan is out of range; allowed: 0.05 to 1.5"),
        (["--rate", "5"], "argument --rate: 5 is out of range; allowed: 10 to 1000"),
        (["--strategy", "preview"], "argument --strategy: invalid choice: 'preview'"),
        (["--animate", "drive.svg"], "--animate drive.svg: draws a cycle's drive; allowed: a file that ends with .gif"),
    ],
)
def test_a_bad_argument_is_refused_with_what_is_allowed(capsys, arguments, expected):
    with pytest.raises(SystemExit) as stop:
        demo.parse(arguments)
    assert stop.value.code == 2
    assert expected in capsys.readouterr().err


# --- what the nodes are started with --------------------------------------------------------------------------------


def test_parameters_keep_their_type_on_the_way_to_a_node():
    values = {"idle_drive": "", "friction": 0.5, "lockstep": True, "policy_file": "1", "rate_hz": 100.0}
    command = dds_drive.node_command("power_manager", values)
    given = [command[at + 1] for at, word in enumerate(command) if word == "-p"]
    assert {name: yaml.safe_load(value) for name, value in (text.split(":=", 1) for text in given)} == values


def test_every_node_has_its_parameter_file():
    for node, path in dds_drive.PARAMETER_FILES.items():
        assert resolve(path).is_file(), node
        assert str(resolve(path)) in dds_drive.node_command(node, {})


def test_nodes_get_their_domain_on_this_machine(tmp_path):
    given = dds_drive.environment(tmp_path, 17)
    assert given["ROS_DOMAIN_ID"] == "17"
    assert given["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST"
    assert given["ROS_LOG_DIR"].startswith(str(tmp_path))


def test_demos_at_the_same_time_have_different_domains(tmp_path, monkeypatch):
    plan = demo.parse(["--output", str(tmp_path)])
    domains = []

    class AnotherDemoMeanwhile:
        def __init__(self, environment, _logs):
            domains.append(environment["ROS_DOMAIN_ID"])
            if len(domains) == 40:
                raise InterruptedError
            dds_drive.drive_over_dds(plan, None)

    monkeypatch.setattr(dds_drive, "Children", AnotherDemoMeanwhile)
    with pytest.raises(InterruptedError):
        dds_drive.drive_over_dds(plan, None)
    assert len(set(domains)) == 40


def test_the_closed_loop_gets_the_settings_the_power_managers_file_gives(monkeypatch):
    monkeypatch.setattr(dds_drive.files, "read_yaml", lambda _: {"/**": {"ros__parameters": {"critical_slip": 0.3}}})
    values = dds_drive.power_manager_parameters()
    assert power_manager_config.law_settings(values, "equal").critical_slip == 0.3
    assert values["rate_hz"] == 100.0


# --- comparisons ----------------------------------------------------------------------------------------------------


def test_equal_runs_are_the_same_whatever_the_law_says_of_itself():
    same, line = dds_drive.compare(run_of(front_share=np.nan), run_of(front_share=0.5))
    assert same
    assert line == "The same drive in one process gives the same numbers, bit for bit."


def test_one_bit_of_difference_is_found_with_its_time_and_signal():
    changed = run_of()
    changed.series[50:, COLUMNS.index("speed_mps")] = np.nextafter(1.0, 2.0)
    same, line = dds_drive.compare(changed, run_of())
    assert not same
    assert "differs from 1.00 s on (speed_mps); its energy by 0.0e+00 relative" in line


def bag_of(steps=3, **counts):
    stamps = [20 * (step + 1) for step in range(steps)]
    topics = ("vehicle_speed", "wheel_torque_command", "friction_brake_command", "power_manager/state")
    return DriveBag(
        {"power_demand": steps, "clock": steps, **counts},
        {topic: list(stamps) for topic in topics},
        np.arange(steps * 6, dtype=float).reshape(steps, 6),
    )


def test_a_whole_bag_has_no_problem():
    assert problems(bag_of(), {"power_demand": 3, "/clock": 3}, [20, 40, 60]) == []


def test_missing_messages_and_steps_are_named():
    bag = bag_of(power_demand=2)
    bag.stamps_ns["wheel_torque_command"].remove(40)
    assert problems(bag, {"power_demand": 3, "/clock": 3}, [20, 40, 60]) == [
        "power_demand: 3 published, 2 recorded",
        "wheel_torque_command: 1 of 3 steps are not recorded",
    ]


def test_each_step_gets_the_decision_with_its_stamp():
    run = with_decisions(run_of(3), bag_of())
    assert run["decided_share"].tolist() == [0.0, 6.0, 12.0]
    assert run["rear_power_w"].tolist() == [5.0, 11.0, 17.0]
    assert run["speed_mps"].tolist() == [1.0, 1.0, 1.0]


def test_in_real_time_a_step_gets_the_latest_decision_before_it():
    bag = bag_of()
    bag.stamps_ns["power_manager/state"] = [35, 36, 59]
    run = with_decisions(run_of(3, decided_share=np.nan), bag)
    np.testing.assert_array_equal(run["decided_share"], [np.nan, 6.0, 12.0])


def test_a_bag_of_other_steps_is_not_mixed_in():
    untouched = run_of(5)
    assert with_decisions(untouched, bag_of()) is untouched


# --- the table ------------------------------------------------------------------------------------------------------


def test_the_table_lines_up_and_shows_what_is_missing():
    measured = Metrics(**dict.fromkeys(Metrics._fields, 0.0))._replace(distance_m=1900.0, trace_held=False)
    first = DriveRow("sdp", "one process", measured, None, 3.0)
    rows = [first, replace(first, strategy="sdp_lookahead", saving_percent=1.234)]
    *head, lost, equal = plain_table(rows, RESULT).splitlines()
    assert len(head) == 3
    assert "lost" in lost
    assert "–" in lost
    assert equal.index("1.23") + 4 == lost.index("–") + 1
    assert max(map(len, (*head, lost, equal))) <= 100


def test_the_split_is_not_drawn_while_the_car_stands():
    run = run_of(speed_mps=np.repeat((5.0, 0.0), 50), front_share=0.65)
    driven = Driven(
        "equal", "in one process", run, metrics.measure(run, load_vehicle(resolve("jalalmaab_2015")).params)
    )
    page = drive_page(driven, driven, cycle="c", idle_drive="drag", critical_slip=0.2, settings={}, remarks=())
    (chart,) = (block for block in page.blocks if isinstance(block, Chart))
    (panel,) = (panel for panel in chart.panels if panel.label == "Front share")
    for series in panel.series:
        assert np.isfinite(series.values[:50]).all()
        assert np.isnan(series.values[50:]).all()


def test_rows_of_a_car_that_never_moved_are_still_json():
    vehicle = load_vehicle(resolve("config/vehicles/jalalmaab_2015.yaml"))
    standing = make_cycle("standing", [0.0, 1.0], [0.0, 0.0])
    run = closed_loop.run(standing, vehicle, default_settings("equal"), empty_table(), 0.9)
    driven = Driven("equal", "one process", run, metrics.measure(run, vehicle.params))
    assert json.loads(json.dumps(plain(row(driven, driven)), allow_nan=False))["wh_per_km"] is None


def test_simulator_and_demo_agree_on_the_rate_a_command_line_can_give():
    (spec,) = (spec for spec in simulator.PARAMETERS if spec.name == "rate_hz")
    assert (spec.low, spec.high) == (10.0, 1000.0)
