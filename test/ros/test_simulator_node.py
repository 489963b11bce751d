# SPDX-License-Identifier: Apache-2.0
"""The simulator as a process of its own, with a stand-in for the power manager in this one."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench import Bench, Running, arguments
from member import Member

from iwm_power_manager.cycle import load_cycle
from iwm_power_manager.exit_codes import BAD_INPUT, FAILED
from iwm_power_manager.files import read_yaml
from iwm_power_manager.ros import messages as m
from iwm_power_manager.ros import qos
from iwm_power_manager.share import resolve
from iwm_power_manager.vehicle import load_vehicle
from iwm_sim import simulator
from iwm_sim.drive import Drive, RoadRow, load_run
from iwm_sim.scenario import on_cycle
from iwm_sim.simulator import PARAMETERS
from oracles import readings

MODULE = "iwm_sim.simulator"
DOMAIN = int(os.environ["ROS_DOMAIN_ID"])
NAMES = m.WHEEL_NAMES
STAMPED = {
    m.VEHICLE_SPEED: readings.stamp_ns,
    m.WHEEL_STATES: readings.stamp_ns,
    m.BATTERY_STATE: readings.stamp_ns,
}


@pytest.fixture(scope="module", autouse=True)
def compiled_drive(hill: Path) -> None:
    """Compile the drive once, before processes are started that have to answer in time."""
    vehicle = load_vehicle(resolve("config/vehicles/jalalmaab_2015.yaml"))
    Drive(on_cycle(vehicle, load_cycle(hill), 0.9), dt_s=0.02)


@pytest.fixture(scope="module")
def hill(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short cycle: up to 6 m/s and back."""
    path = tmp_path_factory.mktemp("cycle") / "hill.csv"
    path.write_text("time_s,speed_mps\n0,0\n4,6\n6,6\n9,0\n10,0\n")
    return path


class StandIn(Member):
    """Listens to the simulator, and commands what `policy` makes of a set: motor and friction torques, or None."""

    count = 0

    def __init__(self, folder: Path, *, lockstep: bool, **parameters: Any) -> None:
        StandIn.count += 1
        self.namespace = f"/simulated_{os.getpid()}_{StandIn.count}"
        self.result = folder / "drive.npz"
        super().__init__("stand_in", self.namespace)
        profile = qos.profile(lockstep=lockstep)
        self.motors = self.node.create_publisher(m.JointState, m.WHEEL_TORQUE_COMMAND, profile)
        self.brakes = self.node.create_publisher(m.JointState, m.FRICTION_BRAKE_COMMAND, profile)
        self.received: dict[str, list[Any]] = {}
        self.answered = 0
        self.lockstep = lockstep
        everything = qos.profile(lockstep=True)
        for topic, kind in m.TOPIC_TYPES.items():
            name = f"{self.namespace}/clock" if topic == m.CLOCK else topic
            self.received[topic] = []
            self.node.create_subscription(kind, name, self._keeper(topic), everything)
        self.node.create_timer(0.05, self._serve)
        self.answer: Callable[[int, float, float], None] = self.obey
        values = {"result_file": self.result, "lockstep": lockstep, "answer_timeout_s": 90.0, **parameters}
        # A busy machine may keep this process waiting; a set is sent twice only where a test is about that.
        values.setdefault("resend_after_s", 60.0)
        remaps = {"__ns": self.namespace, "/clock": f"{self.namespace}/clock"}
        self.running = Running(MODULE, arguments(values, remaps), DOMAIN, folder)

    def _keeper(self, topic: str) -> Callable[[Any], None]:
        def keep(message: Any) -> None:
            self.received[topic].append(message)
            self._serve()

        return keep

    def _serve(self) -> None:
        """Answer each demand whose set's speed is here too: topics are not ordered among each other.

        The simulator counts publishers, so it may drive before these have found its subscriptions.
        """
        demands, speeds = self.received[m.POWER_DEMAND], self.received[m.VEHICLE_SPEED]
        while self.answered < min(len(demands), len(speeds)) and all(
            publisher.get_subscription_count() for publisher in (self.motors, self.brakes)
        ):
            # Only in lock-step does every message arrive.
            speed = readings.vehicle_speed(speeds[self.answered if self.lockstep else -1])
            demand = demands[self.answered]
            self.answered += 1
            self.answer(speed.stamp_ns, speed.speed_mps, demand.data)

    def obey(self, stamp_ns: int, speed_mps: float, power_w: float) -> None:
        """Equal torque on all wheels, motors driving and brakes braking."""
        torque = power_w / (max(speed_mps, 1.0) / 0.33) / 4.0
        self.command(stamp_ns, (max(torque, 0.0),) * 4, (min(torque, 0.0),) * 4)

    def command(self, stamp_ns: int, motor: tuple[float, ...], friction: tuple[float, ...], names: Any = NAMES) -> None:
        self.motors.publish(m.joint_message(stamp_ns, names, effort=motor))
        self.brakes.publish(m.joint_message(stamp_ns, names, effort=friction))

    def finish(self) -> int:
        """Serve until the simulator has ended; returns its exit code."""
        Bench.spin_until(self, lambda: self.running.process.poll() is not None, "the simulator to end")
        return self.running.wait()

    def run(self) -> tuple[Any, dict[str, Any]]:
        assert self.finish() == 0, self.running.text()
        return load_run(self.result)

    def close(self) -> None:
        super().close()
        self.running.process.kill()
        self.running.process.wait()


@pytest.fixture
def stand_in(tmp_path: Path, hill: Path) -> Iterator[Callable[..., StandIn]]:
    started: list[StandIn] = []

    def start(*, lockstep: bool = True, **parameters: Any) -> StandIn:
        started.append(StandIn(tmp_path, lockstep=lockstep, **{"cycle_file": hill, **parameters}))
        return started[-1]

    yield start
    for each in started:
        each.close()


def stamps(stand_in: StandIn, topic: str) -> list[int]:
    return [STAMPED[topic](message) for message in stand_in.received[topic]]


# --- lock-step ------------------------------------------------------------------------------------------------------


def test_each_step_of_a_lockstep_drive_is_one_set_with_one_stamp(stand_in) -> None:
    pair = stand_in(rate_hz=50.0)
    run, notes = pair.run()
    expected = [20_000_000 * (step + 1) for step in range(500)]
    for topic in STAMPED:
        assert stamps(pair, topic) == expected
    assert [m.stamp_to_ns(message.clock) for message in pair.received[m.CLOCK]] == expected
    assert [message.data for message in pair.received[m.POWER_DEMAND]] == run["power_demand_w"].tolist()
    assert notes["published"] == {
        m.CLOCK: 500,
        m.ACCELERATOR_PEDAL: 100,
        m.BRAKE_PEDAL: 100,
        m.VEHICLE_SPEED: 500,
        m.WHEEL_STATES: 500,
        m.BATTERY_STATE: 500,
        m.POWER_DEMAND: 500,
    }
    assert run["speed_mps"].max() == pytest.approx(6.0, abs=0.3)


def test_topics_show_the_car_as_it_is(stand_in) -> None:
    pair = stand_in(rate_hz=50.0)
    run, _ = pair.run()
    speeds = [readings.vehicle_speed(message).speed_mps for message in pair.received[m.VEHICLE_SPEED]]
    np.testing.assert_array_equal(speeds, run["speed_mps"])
    wheels = [readings.wheel_speeds(message).values for message in pair.received[m.WHEEL_STATES]]
    np.testing.assert_array_equal(np.array(wheels)[:, 0], run["front_wheel_radps"])
    # What the motors did in a step is shown at the next one.
    efforts = np.array([message.effort for message in pair.received[m.WHEEL_STATES]])
    np.testing.assert_array_equal(efforts[1:, 2], run["rear_motor_nm"][:-1])
    batteries = [readings.battery_state(message) for message in pair.received[m.BATTERY_STATE]]
    np.testing.assert_array_equal([battery.soc for battery in batteries], run["soc"].astype(np.float32))
    assert batteries[200].discharge_current_a > 5.0
    assert batteries[200].voltage_v == pytest.approx(240.0, abs=15.0)
    pedals = [message.data for message in pair.received[m.ACCELERATOR_PEDAL]]
    np.testing.assert_array_equal(pedals, run["accelerator"][::5])


def test_commands_are_matched_by_wheel_name(stand_in) -> None:
    pair = stand_in(rate_hz=50.0, until_s=1.0)
    pair.answer = lambda stamp, *_: pair.command(
        stamp, (40.0, 30.0, 20.0, 10.0), (0.0,) * 4, ("rear_right", "rear_left", "front_right", "front_left")
    )
    run, _ = pair.run()
    assert (run["front_motor_nm"] == 10.0).all()
    assert (run["rear_motor_nm"] == 30.0).all()


def test_a_set_without_an_answer_is_sent_again_and_stepped_once(stand_in) -> None:
    pair = stand_in(rate_hz=50.0, until_s=1.0, resend_after_s=0.1)
    deaf = {20_000_000 * 10, 20_000_000 * 30}

    def answer(stamp_ns: int, *rest: float) -> None:
        if stamp_ns in deaf:
            deaf.remove(stamp_ns)
        else:
            pair.obey(stamp_ns, *rest)

    pair.answer = answer
    run, notes = pair.run()
    assert notes["resent"] >= 2
    assert len(run.series) == 50
    assert len(set(stamps(pair, m.VEHICLE_SPEED))) == 50
    assert notes["published"][m.VEHICLE_SPEED] == 50 + notes["resent"]


def test_commands_that_are_late_or_broken_change_nothing(stand_in) -> None:
    pair = stand_in(rate_hz=50.0, until_s=1.0)

    def answer(stamp_ns: int, *_: float) -> None:
        pair.command(stamp_ns - 20_000_000, (99.0,) * 4, (0.0,) * 4)
        pair.command(stamp_ns, (float("nan"), 1.0, 1.0, 1.0), (0.0,) * 4)
        pair.command(stamp_ns, (99.0,) * 3, (0.0,) * 3, NAMES[:3])
        pair.command(stamp_ns, (5.0,) * 4, (0.0,) * 4)

    pair.answer = answer
    run, _ = pair.run()
    assert (run["front_motor_nm"] == 5.0).all()


def test_without_an_answer_it_ends_with_one_clear_line(stand_in) -> None:
    pair = stand_in(rate_hz=50.0, resend_after_s=0.2, answer_timeout_s=0.5)
    pair.answer = lambda *_: None
    assert pair.finish() == 1
    last = pair.running.text().splitlines()[-1]
    assert last.startswith(
        "simulator: no wheel_torque_command and friction_brake_command with stamp 0.020 s within 0.5 s"
    )


def test_with_a_recorder_expected_it_waits_for_its_word(stand_in) -> None:
    pair = stand_in(rate_hz=50.0, until_s=0.2, wait_for_recorder=True, partner_timeout_s=3.0)
    assert pair.finish() == 1
    last = pair.running.text().splitlines()[-1]
    assert "no second subscription of" in last
    assert last.endswith("no word from the recorder that it is ready")


def test_what_it_waits_for_is_told_before_it_gives_up(stand_in) -> None:
    """A power manager that takes the demand from pedals does not subscribe to `power_demand`."""
    pair = stand_in(lockstep=False, rate_hz=50.0, until_s=0.2)
    demand = next(one for one in pair.node.subscriptions if one.topic_name.endswith(m.POWER_DEMAND))
    assert pair.node.destroy_subscription(demand)
    waits = f"waits: there is still no subscription of {pair.namespace}/{m.POWER_DEMAND}\n"
    Bench.spin_until(pair, lambda: waits in pair.running.text(), "what it misses")
    pair.node.create_subscription(m.TOPIC_TYPES[m.POWER_DEMAND], m.POWER_DEMAND, lambda _: None, 1)
    assert pair.finish() == 0


# --- real time ------------------------------------------------------------------------------------------------------


@pytest.mark.processes
def test_faster_than_real_time_it_publishes_the_clock_and_reaches_the_end(stand_in) -> None:
    pair = stand_in(lockstep=False, rate_hz=50.0, speed_factor=5.0, command_timeout_s=5.0)
    run, notes = pair.run()
    assert len(run.series) == 500
    clock = [m.stamp_to_ns(message.clock) for message in pair.received[m.CLOCK]]
    assert clock == sorted(set(clock))
    assert notes["published"][m.CLOCK] == 500
    assert run["speed_mps"].max() > 3.0


@pytest.mark.processes
def test_in_real_time_there_is_no_clock_and_stamps_are_the_systems_time(stand_in) -> None:
    pair = stand_in(lockstep=False, rate_hz=50.0, until_s=1.0)
    before = pair.node.get_clock().now().nanoseconds
    run, _ = pair.run()
    after = pair.node.get_clock().now().nanoseconds
    assert pair.received[m.CLOCK] == []
    assert before < stamps(pair, m.VEHICLE_SPEED)[0] <= stamps(pair, m.VEHICLE_SPEED)[-1] < after
    assert len(run.series) == 50


@pytest.mark.processes
def test_commands_that_stop_leave_motors_off_and_brakes_at_the_pedal(stand_in) -> None:
    pair = stand_in(lockstep=False, rate_hz=50.0, speed_factor=2.0, command_timeout_s=1.0)

    def answer(stamp_ns: int, *rest: float) -> None:
        # The power manager falls silent while the car is fast.
        if stamp_ns < 5_500_000_000:
            pair.obey(stamp_ns, *rest)

    pair.answer = answer
    run, notes = pair.run()
    # Silent at 5.5 s and 1 s of patience: by 7.5 s, a second later, everything of the last command is gone.
    late = run["time_s"] > 7.5
    assert notes["command_timeouts"] >= 1
    assert (run["front_motor_nm"][late] == 0.0).all()
    braking = late & (run["brake"] > 0.1) & (run["speed_mps"] > 1.0)
    assert braking.any()
    assert (run["front_friction_nm"][braking] < -10.0).all()
    assert run["speed_mps"][-1] < 0.2
    assert "motors off, brakes follow the pedal" in pair.running.text()


# --- alone ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("parameters", "expected"),
    [
        ({"cycle_file": "/nowhere/cycle.csv"}, "simulator: parameter cycle_file: /nowhere/cycle.csv: cannot be read"),
        ({"vehicle_file": "/nowhere/car.yaml"}, "simulator: parameter vehicle_file: /nowhere/car.yaml: cannot be read"),
        (
            {"scenario_file": "/nowhere/road.yaml"},
            "simulator: parameter scenario_file: /nowhere/road.yaml: cannot be read",
        ),
        (
            {"scenario_file": "demand_lost", "lockstep": "true"},
            "faults: has faults of messages, and lock-step waits for each as it is measured; allowed: lockstep: false",
        ),
        ({"friction": 7.0}, "parameter friction: 7.0 is not allowed; allowed: 0.05 to 1.5"),
        ({"friction": ".nan"}, "parameter friction: nan is not allowed"),
        ({"rate_hz": "fast"}, "parameter rate_hz: 'fast' is not allowed"),
        ({"idle_drive": "sleeping"}, "parameter idle_drive: 'sleeping' is not allowed"),
        ({"partner_timeout_s": 0.2}, "after 0.2 s there is still no subscription of"),
    ],
)
def test_what_it_cannot_work_with_gives_one_line(capfd, monkeypatch, parameters, expected) -> None:
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    code = FAILED if "partner_timeout_s" in parameters else BAD_INPUT
    assert simulator.main(["simulator", *arguments(parameters, {"__ns": f"/alone_{os.getpid()}"})]) == code
    output = capfd.readouterr()
    lines = [line for line in (output.out + output.err).splitlines() if not line.startswith("[INFO]")]
    assert len(lines) == 1, lines
    assert expected in lines[0]


@pytest.mark.parametrize("given_by", ["cycle_file", "scenario_file"])
def test_a_gap_in_the_cycle_is_said(given_by, tmp_path, capfd, monkeypatch) -> None:
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    cycle, road = tmp_path / "tunnel.csv", tmp_path / "tunnel.yaml"
    cycle.write_text("time_s,speed_mps\n0,9\n1,10\n2,10\n62,10\n63,9\n64,9\n")
    road.write_text(f"format: 1\nabout: A tunnel.\ncycle: {cycle}\nroad: {{friction: 0.9}}\n")
    given = {given_by: {"cycle_file": cycle, "scenario_file": road}[given_by], "partner_timeout_s": 0.2}
    assert simulator.main(["simulator", *arguments(given, {"__ns": f"/gap_{os.getpid()}"})]) == FAILED
    output = capfd.readouterr()
    assert f"{cycle}: line 5: is 60 s after the one before" in output.out + output.err


def test_a_parameter_that_does_not_exist_is_refused(capfd, monkeypatch) -> None:
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    given = arguments({"cycle": "udds"}, {"__ns": f"/alone_{os.getpid()}"})
    assert simulator.main(["simulator", *given]) == BAD_INPUT
    assert "parameter cycle is unknown; is cycle_file meant?" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("args", "expected"),
    [
        (["--ros-args", "--params-file", "/nowhere.yaml"], "simulator: /nowhere.yaml: cannot be read"),
        (
            ["--ros-args", "-p", "friction=0.5"],
            "simulator: -p 'friction=0.5' is not allowed; allowed: PARAMETER:=VALUE",
        ),
        (["--ros-args", "--log-level"], "simulator: Failed to parse ROS arguments: Couldn't parse trailing log level"),
        (["--friction", "0.5"], "simulator: error: unrecognized arguments: --friction 0.5"),
    ],
)
def test_a_wrong_command_line_is_refused_in_one_line(capsys, monkeypatch, args, expected) -> None:
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    try:
        found = simulator.main(["simulator", *args])
    except SystemExit as stop:
        found = stop.code
    assert found == BAD_INPUT
    assert capsys.readouterr().err.splitlines()[-1].startswith(expected)


def test_help_names_every_parameter(capsys, monkeypatch) -> None:
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    with pytest.raises(SystemExit) as stop:
        simulator.main(["simulator", "--help"])
    assert stop.value.code == 0
    shown = capsys.readouterr().out
    assert all(f"  {spec.name} = " in shown for spec in PARAMETERS)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_cleanly(stand_in, number) -> None:
    pair = stand_in(rate_hz=50.0)
    Bench.spin_until(pair, lambda: len(pair.received[m.POWER_DEMAND]) > 20, "the drive")
    assert pair.running.stop(number) == 0
    assert "Traceback" not in pair.running.text()


def test_topics_follow_namespace_and_remaps(tmp_path, hill) -> None:
    onlooker = Member("onlooker")
    node = onlooker.node
    space = f"/car_{os.getpid()}"
    running = Running(
        MODULE,
        arguments({"cycle_file": hill}, {"__ns": space, "vehicle_speed": "speed_over_ground", "__node": "virtual_car"}),
        DOMAIN,
        tmp_path,
    )
    try:
        expected = {f"{space}/speed_over_ground", f"{space}/wheel_states", f"{space}/power_demand"}
        Bench.spin_until(
            onlooker,
            lambda: (
                expected <= {name for name, _ in node.get_publisher_names_and_types_by_node("virtual_car", space)}
                if ("virtual_car", space) in node.get_node_names_and_namespaces()
                else False
            ),
            "the renamed topics",
        )
        assert running.stop() == 0
    finally:
        running.process.kill()
        running.process.wait()
        onlooker.close()


#: A simulator whose car has to be compiled.
COMPILES = """
import sys
from iwm_power_manager import jit
from iwm_power_manager.errors import IwmError
from iwm_sim import simulator
def compiling():
    jit.watch.begin("iwm_sim.plant.advance", 3)
    jit.watch.end()
    raise IwmError("and so on")
simulator.Simulator = compiling
sys.exit(simulator.main([]))
"""


def test_a_simulator_that_has_to_compile_its_car_says_so() -> None:
    done = subprocess.run([sys.executable, "-c", COMPILES], capture_output=True, text=True, check=False)
    first, last = done.stderr.splitlines()
    assert first.startswith("compiling for this machine")
    assert last == "simulator: and so on"


def test_the_shipped_parameter_file_holds_its_defaults() -> None:
    given = read_yaml(resolve("config/nodes/simulator.yaml"))["/**"]["ros__parameters"]
    defaults = {spec.name: spec.default for spec in PARAMETERS}
    assert {name: defaults[name] for name in given} == given


def test_every_parameter_has_a_description_and_every_number_a_range() -> None:
    for spec in PARAMETERS:
        assert spec.description.endswith("."), spec.name
        if isinstance(spec.default, float):
            assert np.isfinite([spec.low, spec.high]).all(), spec.name


def test_a_scenario_is_driven_as_its_file_says(tmp_path: Path, stand_in: Callable[..., StandIn]) -> None:
    road = tmp_path / "split.yaml"
    road.write_text(
        "format: 1\nabout: A stop on a split road.\nstart: {speed_mps: 5.0}\n"
        "demand: [{from_s: 0.1, brake: 0.2}]\nsteering: lane\n"
        "road: {friction: [{from_m: -10, left: 0.2, right: 0.9}], grade: 0.01}\n"
        "until: {time_s: 20.0, standstill: true}\n"
    )
    run, _ = stand_in(scenario_file=road, rate_hz=50.0).run()
    assert run.final.speed_mps == 0.0
    assert 1.0 < run.final.distance_m < 15.0
    assert run.road is not None
    first = RoadRow(*run.road[0])
    assert {first.road_fl, first.road_fr, first.road_rl, first.road_rr} == {0.2, 0.9}


@pytest.mark.processes
def test_in_real_time_a_late_message_comes_with_the_stamp_of_its_measurement(
    tmp_path: Path, stand_in: Callable[..., StandIn]
) -> None:
    road = tmp_path / "late.yaml"
    road.write_text(
        "format: 1\nabout: A late speed.\nstart: {speed_mps: 5.0}\ndemand: [{from_s: 0.1, brake: 0.3}]\n"
        "road: {friction: 0.9}\nuntil: {time_s: 2.0}\n"
        "faults:\n  - {message: vehicle_speed, delay_s: 0.1}\n  - {message: battery_state, rate_hz: 10}\n"
        "  - {message: wheel_states, delay_s: 0.04, stamp_error_s: 0.02}\n"
    )
    car = stand_in(lockstep=False, scenario_file=road, rate_hz=50.0, command_timeout_s=10.0)
    run, notes = car.run()
    period_ns, steps = notes["period_ns"], len(run.series)
    assert notes["published"][m.VEHICLE_SPEED] == steps - 5
    assert notes["published"][m.WHEEL_STATES] == steps - 2
    assert notes["published"][m.BATTERY_STATE] == steps / 5
    assert notes["published"][m.POWER_DEMAND] == steps
    # Stamps follow the clock where the timer is late, so that each step has its own.
    speeds = {readings.vehicle_speed(each).stamp_ns: each for each in car.received[m.VEHICLE_SPEED]}
    imus = [m.stamp_to_ns(each.header.stamp) for each in car.received[m.IMU]]
    assert list(speeds) == imus[: steps - 5]
    shown = [readings.vehicle_speed(each).speed_mps for each in speeds.values()]
    np.testing.assert_array_equal(shown, run["speed_mps"][: steps - 5])
    assert stamps(car, m.WHEEL_STATES) == [stamp + period_ns for stamp in imus[: steps - 2]]


@pytest.mark.parametrize(("scenario", "direction"), [("split_stop", 1.0), ("hill_start_reverse", -1.0)])
def test_in_a_scenario_it_shows_the_direction_asked_for_and_what_an_imu_reads(
    stand_in: Callable[..., StandIn], scenario: str, direction: float
) -> None:
    car = stand_in(scenario_file=scenario, rate_hz=50.0, until_s=1.0)
    right_brakes = (-10.0, -200.0, 0.0, 0.0)
    car.answer = lambda stamp_ns, speed_mps, power_w: car.command(stamp_ns, (0.0,) * 4, right_brakes)
    run, _ = car.run()
    assert run.road is not None
    columns = RoadRow._fields
    yaw = run.road[:, columns.index("yaw_rate_radps")]
    assert {message.data for message in car.received[m.DIRECTION]} == {direction}
    shown = car.received[m.IMU]
    assert [message.angular_velocity.z for message in shown] == list(yaw)
    assert [m.stamp_to_ns(message.header.stamp) for message in shown] == stamps(car, m.VEHICLE_SPEED)
    if scenario == "split_stop":
        assert yaw[-1] < -0.001  # to the right
        assert shown[-1].linear_acceleration.x < -0.1
    else:
        assert shown[0].linear_acceleration.x == pytest.approx(-9.81 * math.sin(math.atan(0.1)), rel=1e-3)
    assert shown[0].linear_acceleration.z == pytest.approx(9.81, rel=1e-3)


def test_on_a_cycle_the_car_goes_straight_ahead(stand_in: Callable[..., StandIn]) -> None:
    car = stand_in(rate_hz=50.0, until_s=0.2)
    car.run()
    assert not car.received[m.DIRECTION] and not car.received[m.IMU]
