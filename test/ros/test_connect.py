# SPDX-License-Identifier: Apache-2.0
"""Cars of other stacks, connected by YAML alone: what they send, what they obey, over DDS between processes."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from bench import Running, arguments
from stack import JOINTS, NUMBER, NUMBERS, Stack, number, of_type

from iwm_power_manager.exit_codes import BAD_INPUT
from iwm_power_manager.ros import messages
from iwm_power_manager.share import share_path
from iwm_power_manager.signals.contract import WHEEL_NAMES
from iwm_power_manager.tools.replay import main as replay
from iwm_power_manager.vehicle import load_vehicle

MODULE = "iwm_power_manager.nodes.power_manager"
DOMAIN = int(os.environ["ROS_DOMAIN_ID"])
CAR = load_vehicle(share_path("config/vehicles/jalalmaab_2015.yaml")).params
RADIUS_M = CAR.front.wheel.radius_m
ODOMETRY, TWIST, ACCEL = "nav_msgs/msg/Odometry", "geometry_msgs/msg/Twist", "geometry_msgs/msg/AccelStamped"
BATTERY = "sensor_msgs/msg/BatteryState"
COMMANDS = {"wheel_torque_command": JOINTS, "friction_brake_command": JOINTS}


class Connected:
    """A power manager told by a signals file of the stack beside it."""

    def __init__(
        self,
        folder: Path,
        name: str,
        text: str | Path,
        stack: Stack,
        parameters: dict[str, Any],
        more_remaps: dict[str, str],
    ) -> None:
        path = text if isinstance(text, Path) else folder / "signals.yaml"
        if isinstance(text, str):
            path.write_text(text)
        given = {"strategy": "equal", "policy_file": "", "signals_file": path, **parameters}
        remaps = {"__ns": name, "/diagnostics": f"{name}/diagnostics"}
        remaps |= {topic: name + topic for topic in ("/odom", "/joint_states", "/pedals/accelerator", "/pedals/brake")}
        remaps |= {topic: name + topic for topic in ("/battery/charge", "/battery/temperature")}
        remaps |= {topic: name + other for topic, other in more_remaps.items()}
        self.stack = stack
        self.running = Running(MODULE, arguments(given, remaps), DOMAIN, folder)


@pytest.fixture
def connect(tmp_path: Path, compiled_law: None, request: pytest.FixtureRequest) -> Iterator[Callable[..., Connected]]:
    made: list[Connected] = []

    def start(
        text: str | Path,
        sends: dict[str, str],
        hears: dict[str, str] | None = None,
        reliability: str = "best_effort",
        remaps: dict[str, str] | None = None,
        **parameters: Any,
    ) -> Connected:
        name = f"/stack_{os.getpid()}_{abs(hash(request.node.name)) % 10**6}_{len(made)}"
        stack = Stack(name, sends, COMMANDS if hears is None else hears, reliability)
        made.append(Connected(tmp_path, name, text, stack, parameters, remaps or {}))
        return made[-1]

    yield start
    for one in made:
        one.running.process.kill()
        one.running.process.wait()
        one.stack.close()


def torque_nm(message: Any) -> float:
    return sum(message.effort) if message is not None else 0.0


def test_a_car_with_odometry_pedals_and_foreign_joints_drives_and_brakes(connect: Callable[..., Connected]) -> None:
    """The shipped file as it is; every absolute topic of it remapped, as a launch file would."""
    sends = {
        "odom": ODOMETRY,
        "joint_states": JOINTS,
        "pedals/accelerator": NUMBER,
        "pedals/brake": NUMBER,
        "battery/charge": "std_msgs/msg/Float32",
        "battery/temperature": "std_msgs/msg/Float32",
    }
    car = connect(share_path("config/signals/odometry_and_pedals.yaml"), sends)
    brake = 0.0

    def inputs(stack: Stack) -> dict[str, Any]:
        names = ["wheel_rr_joint", "wheel_fl_joint", "steering", "wheel_rl_joint", "wheel_fr_joint"]
        rpm = 10.0 / RADIUS_M * 30.0 / math.pi
        return {
            "odom": of_type(ODOMETRY, header__stamp=stack.stamp(), twist__twist__linear__x=10.0),
            "joint_states": of_type(
                JOINTS, header__stamp=stack.stamp(), name=names, velocity=[rpm, rpm, 0.0, rpm, rpm]
            ),
            "pedals/accelerator": number(30.0),
            "pedals/brake": number(brake),
            "battery/charge": of_type("std_msgs/msg/Float32", data=80.0),
            "battery/temperature": of_type("std_msgs/msg/Float32", data=25.0),
        }

    last = car.stack.last

    def drives() -> bool:
        return torque_nm(last("wheel_torque_command")) > 100.0

    def without(silent: str) -> Callable[[Stack], dict[str, Any]]:
        return lambda stack: {topic: message for topic, message in inputs(stack).items() if topic != silent}

    car.stack.drive(without("pedals/brake"), lambda: "waits for power_demand" in car.running.text(), "the brake pedal")
    car.stack.drive(inputs, drives, "driving torque")
    for silent in ("pedals/brake", "pedals/accelerator"):
        car.stack.drive(
            without(silent), lambda: torque_nm(last("wheel_torque_command")) == 0.0, f"no torque without {silent}"
        )
        words = f"power_demand is missing on {car.stack.node.get_namespace()}/{silent}"
        named = partial(says, car.stack, "inputs", words)
        car.stack.drive(without(silent), named, "its topic in diagnostics")
        car.stack.drive(inputs, drives, "driving torque again")
    brake = 50.0
    car.stack.drive(
        without("pedals/accelerator"), lambda: torque_nm(last("friction_brake_command")) < -100.0, "braking torque"
    )
    assert torque_nm(last("wheel_torque_command")) < 0.0


FOUR_TOPICS = share_path("config/signals/four_topics.yaml").read_text()


def test_a_car_with_four_rpm_topics_and_an_acceleration_demand_starts_from_rest(
    connect: Callable[..., Connected],
) -> None:
    """At 50 Hz, best effort, unstamped: the periods are parameters, the time is DDS's."""
    sends = {"speed_kmh": TWIST, "wanted": ACCEL, "charge": NUMBER} | {f"rpm_{i}": NUMBER for i in range(4)}
    hears = {f"torque_{i}": NUMBER for i in range(4)}
    periods = {f"input_period_s.{name}": 0.02 for name in ("vehicle_speed", "wheel_states", "power_demand")}
    car = connect(FOUR_TOPICS, sends, hears, **periods)

    def inputs(stack: Stack) -> dict[str, Any]:
        wheels = {f"rpm_{i}": number(0.0) for i in range(4)}
        for topic, message in wheels.items():  # bursts of one wheel, then of the next, as after a moment without a step
            for _ in range(4):
                stack.publishers[topic].publish(message)
        wanted = of_type(ACCEL, header__stamp=stack.stamp(), accel__linear__x=1.0)
        return {"speed_kmh": of_type(TWIST), "wanted": wanted, "charge": number(80.0), **wheels}

    def torques() -> list[float]:
        found = [car.stack.last(f"torque_{i}") for i in range(4)]
        return [message.data for message in found] if all(found) else [0.0] * 4

    mass_kg = CAR.chassis.mass_kg + 4.0 * CAR.front.wheel.inertia_kgm2 / RADIUS_M**2
    each = mass_kg * 1.0 * RADIUS_M / 4.0
    wanted = [each, -each, each, -each]
    car.stack.drive(inputs, lambda: torques() == pytest.approx(wanted, rel=0.02), "the torque of 1 m/s2", 0.02)
    assert "friction_torque goes nowhere" in car.running.text()
    assert "axle lost" not in car.running.text()


def test_wheels_on_topics_of_their_own_are_counted_however_slow_the_loop_is(connect: Callable[..., Connected]) -> None:
    """Five messages of each come between two steps; of each the newest drives, and all of them count."""
    sends = {"speed_kmh": TWIST, "wanted": ACCEL, "charge": NUMBER} | {f"rpm_{i}": NUMBER for i in range(4)}
    periods = {f"input_period_s.{name}": 0.05 for name in ("vehicle_speed", "wheel_states", "power_demand")}
    car = connect(FOUR_TOPICS, sends, {"power_manager/state": JOINTS}, rate_hz=10.0, **periods)

    def inputs(stack: Stack) -> dict[str, Any]:
        wanted = of_type(ACCEL, header__stamp=stack.stamp(), accel__linear__x=1.0)
        wheels = {f"rpm_{i}": number(0.0) for i in range(4)}
        return {"speed_kmh": of_type(TWIST), "wanted": wanted, "charge": number(80.0), **wheels}

    states = car.stack.received["power_manager/state"]
    car.stack.drive(inputs, lambda: "first torque" in car.running.text(), "torque", 0.02)
    before = len(states)
    car.stack.drive(inputs, lambda: len(states) > before + 40, "four seconds", 0.02)
    assert "comes at" not in car.running.text()

    def slow() -> list[str]:
        return [line for line in car.running.text().splitlines() if ": comes at" in line and "WARN" in line]

    car.stack.drive(inputs, slow, "that they are slow", 0.25)
    car.stack.drive(inputs, lambda: len(states) > before + 80, "four more seconds", 0.25)
    wheels = [line for line in slow() if "wheel_states" in line]
    assert len(wheels) <= 1, "one line for the four of them"
    assert car.running.stop() == 0


def test_topics_remapped_on_the_command_line_are_the_ones_that_are_watched(connect: Callable[..., Connected]) -> None:
    """A speed and a command that are remapped, and somebody else who commands there."""
    sends = {"ecu/speed": TWIST, "wanted": ACCEL, "charge": NUMBER, "ecu/torque": NUMBER}
    sends |= {f"rpm_{i}": NUMBER for i in range(4)}
    remaps = {"speed_kmh": "/ecu/speed", "torque_0": "/ecu/torque"}
    car = connect(FOUR_TOPICS, sends, {"ecu/torque": NUMBER}, remaps=remaps)

    def inputs(stack: Stack) -> dict[str, Any]:
        wanted = of_type(ACCEL, header__stamp=stack.stamp(), accel__linear__x=1.0)
        wheels = {f"rpm_{i}": number(0.0) for i in range(4)}
        return {"ecu/speed": of_type(TWIST), "wanted": wanted, "charge": number(80.0), **wheels}

    car.stack.drive(inputs, lambda: car.stack.last("ecu/torque") and car.stack.last("ecu/torque").data > 50.0, "torque")
    name = car.stack.node.get_namespace()
    said = f"{name}/ecu/torque has 2 publishers: {name}/power_manager, {name}/stack"
    car.stack.drive(inputs, lambda: said in car.running.text(), "the other commander")
    assert f"{name}/ecu/torque: publishers: 2" in values(car.stack, "command topics")


def test_pedals_of_another_unit_are_told(connect: Callable[..., Connected]) -> None:
    """0..1 where the file says %: next to no torque, and a log that is normal otherwise."""
    sends = {"odom": ODOMETRY, "joint_states": JOINTS} | dict.fromkeys(("pedals/accelerator", "pedals/brake"), NUMBER)
    sends |= dict.fromkeys(("battery/charge", "battery/temperature"), "std_msgs/msg/Float32")
    car = connect(share_path("config/signals/odometry_and_pedals.yaml"), sends)
    accelerator = 0.0

    def inputs(stack: Stack) -> dict[str, Any]:
        names = [f"wheel_{wheel}_joint" for wheel in ("fl", "fr", "rl", "rr")]
        return {
            "odom": of_type(ODOMETRY, header__stamp=stack.stamp()),
            "joint_states": of_type(JOINTS, header__stamp=stack.stamp(), name=names, velocity=[0.0] * 4),
            "pedals/accelerator": number(accelerator),
            "pedals/brake": number(0.0),
            "battery/charge": of_type("std_msgs/msg/Float32", data=80.0),
            "battery/temperature": of_type("std_msgs/msg/Float32", data=25.0),
        }

    log = car.running.text
    car.stack.drive(inputs, lambda: "normal operation" in log(), "normal operation")
    accelerator = 0.3
    said = "signals.accelerator_pedal on /pedals/accelerator was held, and never beyond 0.3 %: where it is 0..1, write"
    car.stack.drive(inputs, lambda: said in log(), "the unit")
    (line,) = [line for line in log().splitlines() if said in line]
    assert "WARN" in line


ROS2_CONTROL = Path(__file__).resolve().parents[2] / "examples" / "ros2_control" / "signals.yaml"


@pytest.mark.parametrize(("reliability", "rate_hz"), [("best_effort", 50), ("reliable", 1000)])
def test_ros2_control_is_commanded_in_the_order_of_its_joints(
    connect: Callable[..., Connected], reliability: str, rate_hz: int
) -> None:
    """joint_state_broadcaster and forward_command_controller, played by a stand-in at the rate of its controllers."""
    sends = {
        "joint_states": JOINTS,
        "cmd_force": NUMBER,
        "odom": ODOMETRY,
        "battery_state": "sensor_msgs/msg/BatteryState",
    }
    hears = {"wheel_effort_controller/commands": NUMBERS, "brake_effort_controller/commands": NUMBERS}
    names = ("vehicle_speed", "wheel_states", "power_demand", "battery_state")
    periods = {f"input_period_s.{name}": max(1.0 / rate_hz, 0.01) for name in names}
    split = {"strategy": "rule", "rule": [0.0, 0.75, 0.0, 0.5]}
    car = connect(ROS2_CONTROL, sends, hears, reliability, **split, **periods)
    wheels = ("rear_left", "rear_right", "front_left", "front_right")

    def inputs(stack: Stack) -> dict[str, Any]:
        joints = [f"{wheel}_wheel_joint" for wheel in wheels]
        stamp = stack.stamp()
        return {
            "joint_states": of_type(JOINTS, header__stamp=stamp, name=joints, velocity=[10.0 / RADIUS_M] * 4),
            "odom": of_type(ODOMETRY, header__stamp=stamp, twist__twist__linear__x=10.0),
            "battery_state": of_type(
                "sensor_msgs/msg/BatteryState", header__stamp=stamp, percentage=0.5, temperature=25.0
            ),
            "cmd_force": number(400.0),
        }

    def commanded() -> list[float]:
        message = car.stack.last("wheel_effort_controller/commands")
        return list(message.data) if message else [0.0] * 4

    rear, front = (400.0 * RADIUS_M * part / 2.0 for part in (0.25, 0.75))
    expected = pytest.approx([rear, rear, front, front], rel=0.02)
    car.stack.drive(inputs, lambda: commanded() == expected, "400 N", 1.0 / rate_hz)


def test_a_drive_on_mapped_topics_is_recorded_without_naming_them_and_its_commands_are_compared(
    connect: Callable[..., Connected], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Commands without a stamp, each to a topic of its own; the brakes are another system's."""
    sends = {"speed_kmh": TWIST, "wanted": ACCEL, "charge": NUMBER} | {f"rpm_{i}": NUMBER for i in range(4)}
    hears = {f"torque_{i}": NUMBER for i in range(4)} | {
        "power_manager/state": JOINTS,
        "recorder/ready": "std_msgs/msg/Bool",
    }
    car = connect(FOUR_TOPICS, sends, hears)
    name = car.stack.node.get_namespace()
    signals = tmp_path / "signals.yaml"
    recording = {"output": tmp_path / "bag", "signals_file": signals}
    recorder = Running(
        "iwm_power_manager.nodes.recorder", arguments(recording, {"__ns": name, "/diagnostics": f"{name}/diagnostics"}),
        DOMAIN, tmp_path,
    )  # fmt: skip
    wanted = 1.0

    def inputs(stack: Stack) -> dict[str, Any]:
        rpm = 10.0 / RADIUS_M * 30.0 / math.pi
        speeds = {f"rpm_{i}": number(rpm if i % 2 == 0 else -rpm) for i in range(4)}
        acceleration = of_type(ACCEL, header__stamp=stack.stamp(), accel__linear__x=wanted)
        return {"speed_kmh": of_type(TWIST, linear__x=36.0), "wanted": acceleration, "charge": number(80.0), **speeds}

    def torques() -> list[float]:
        found = [car.stack.last(f"torque_{i}") for i in range(4)]
        return [message.data for message in found] if all(found) else [0.0] * 4

    def state() -> dict[str, float]:
        message = car.stack.last("power_manager/state")
        return dict(zip(message.name, message.position, strict=True)) if message else {}

    try:
        car.stack.drive(inputs, lambda: recorder.text().count("ready") and torques()[0] > 50.0, "drive torque")
        wanted = -6.0
        limit = CAR.front.motor.regeneration_torque_nm
        full = pytest.approx([-limit, limit, -limit, limit])
        car.stack.drive(inputs, lambda: torques() == full and state(), "all four motors regenerate as hard as they can")
        # Nobody is told to brake with brakes that are not there.
        assert [state()[f"{wheel}_friction_torque_nm"] for wheel in WHEEL_NAMES] == [0.0] * 4
        car.stack.drive(inputs, lambda: "limits that bind: regeneration" in values(car.stack, "control"), "the status")
        assert recorder.stop() == 0
    finally:
        recorder.process.kill()
        recorder.process.wait()
    bag = str(tmp_path / "bag")
    assert replay([bag, "--compare", "--mapping", str(signals), "--json", str(tmp_path / "found.json"), "--quiet"]) == 0
    found = json.loads((tmp_path / "found.json").read_text())
    compared = {row["topic"]: row["compared"] for row in found["comparison"]}
    assert set(compared) == {f"{name}/{topic}" for topic in (*(f"torque_{i}" for i in range(4)), "power_manager/state")}
    assert min(compared.values()) > 50
    text = capsys.readouterr().out
    assert f"not compared: friction_torque: goes nowhere ({signals})" in text
    assert f"of {signals} only the commands count" in text
    # With brakes that were not there; 3 where the node took a step before the recorder was up.
    assert replay([bag, "--compare", "--quiet"]) in (1, 3)
    text = capsys.readouterr().out
    assert f"give the files that the drive was recorded with, or others: --mapping '{signals}'" in text
    assert "not compared: motor_torque on wheel_torque_command" in text
    assert replay([bag, "--what-if", "--vehicle", "jalalmaab_2015", "--mapping", str(signals), "--quiet"]) == 0
    rows = [
        line.split() for line in capsys.readouterr().out.splitlines() if line.startswith(("  recorded ", "  equal "))
    ]
    assert [float(row[4]) for row in rows] == [0.0, 0.0], "no friction brakes"


def says(stack: Stack, name: str, words: str) -> bool:
    """Whether a status of the last diagnostics has these words."""
    statuses = stack.diagnostics[-1].status if stack.diagnostics else []
    return any(words in status.message for status in statuses if status.name.endswith(f": {name}"))


def values(stack: Stack, name: str) -> str:
    """Values of a status of the last diagnostics, as lines."""
    statuses = stack.diagnostics[-1].status if stack.diagnostics else []
    return "; ".join(f"{v.key}: {v.value}" for s in statuses if s.name.endswith(f": {name}") for v in s.values)


WRONG_IN_THREE_WAYS = """
signals:
  speed: {topic: odom, type: geometry_msgs/msg/TwistStamped, field: twist.linear.x, unit: m/s}
  wheel_speed:
    - {topic: rpm_0, type: std_msgs/msg/Float64, field: data, unit: rpm}
    - {topic: rpm_1, type: std_msgs/msg/Float64, field: data, unit: rpm}
    - {topic: rpm_2, type: std_msgs/msg/Float64, field: data, unit: rpm}
    - {topic: rpm_3, type: std_msgs/msg/Float64, field: data, unit: rpm}
  force_demand: {topic: force, type: std_msgs/msg/Float64, field: data, unit: kN}
  soc: {topic: charge, type: std_msgs/msg/Float64, field: data, unit: "1"}
"""


BACKWARDS = """
signals:
  speed: {topic: odom, type: nav_msgs/msg/Odometry, field: twist.twist.linear.x, unit: m/s, sign: -1}
  wheel_speed:
    - {topic: rpm, type: std_msgs/msg/Float32MultiArray, field: "data[2]", unit: rpm, offset: -8000}
    - {topic: rpm, type: std_msgs/msg/Float32MultiArray, field: "data[3]", unit: rpm, offset: -8000, sign: -1}
    - {topic: rpm, type: std_msgs/msg/Float32MultiArray, field: "data[0]", unit: rpm, offset: -8000}
    - {topic: rpm, type: std_msgs/msg/Float32MultiArray, field: "data[1]", unit: rpm, offset: -8000, sign: -1}
  accelerator_pedal: {topic: throttle, type: std_msgs/msg/Int8, field: data, unit: "%"}
  brake_pedal: {topic: pressure_bar, type: std_msgs/msg/Float32, field: data, unit: "%", factor: 1.25}
  soc: {topic: bms, type: sensor_msgs/msg/BatteryState, field: voltage, unit: "%", offset: -200}
commands:
  motor_torque:
    - {topic: motor_0, type: std_msgs/msg/Float64MultiArray, field: "data[1]", unit: N m}
    - {topic: motor_1, type: std_msgs/msg/Float64MultiArray, field: "data[1]", unit: N m, sign: -1}
    - {topic: motor_2, type: std_msgs/msg/Float64MultiArray, field: "data[1]", unit: N m}
    - {topic: motor_3, type: std_msgs/msg/Float64MultiArray, field: "data[1]", unit: N m, sign: -1}
  friction_torque: {topic: brakes, type: trajectory_msgs/msg/JointTrajectory, field: "points[0].effort", unit: N m,
                    sign: -1, order: [rear_left, rear_right, front_left, front_right]}
"""


def test_a_car_seen_from_behind_with_counts_bars_and_lists_in_lists_drives_after_its_sensors_came_back(
    connect: Callable[..., Connected],
) -> None:
    """Right-hand motors turn the other way, the rear stands first, motors obey the second number of their array."""
    counts, text = "std_msgs/msg/Float32MultiArray", "trajectory_msgs/msg/JointTrajectory"
    sends = {"odom": ODOMETRY, "rpm": counts, "throttle": "std_msgs/msg/Int8", "pressure_bar": "std_msgs/msg/Float32"}
    motors = [f"motor_{i}" for i in range(4)]
    car = connect(BACKWARDS, sends | {"bms": BATTERY}, dict.fromkeys(motors, NUMBERS) | {"brakes": text})
    braking = False

    def inputs(stack: Stack) -> dict[str, Any]:
        rpm = 5.0 / RADIUS_M * 30.0 / math.pi
        return {
            "odom": of_type(ODOMETRY, header__stamp=stack.stamp(), twist__twist__linear__x=-5.0),
            "rpm": of_type(counts, data=[8000.0 + turn * rpm for turn in (1, -1, 1, -1)]),
            "throttle": of_type("std_msgs/msg/Int8", data=0 if braking else 30),
            "pressure_bar": of_type("std_msgs/msg/Float32", data=40.0 if braking else 0.0),
            "bms": of_type(BATTERY, header__stamp=stack.stamp(), voltage=260.0, current=-3.0, percentage=math.nan),
        }

    def torques() -> list[float]:
        heard = [car.stack.last(topic) for topic in motors]
        assert all(len(message.data) == 2 for message in heard if message)
        return [message.data[1] if message else 0.0 for message in heard]

    def drives() -> bool:
        front_left, front_right, rear_left, rear_right = torques()
        return min(front_left, -front_right, rear_left, -rear_right) > 30.0

    car.stack.drive(inputs, drives, "driving torque")
    car.stack.drive(lambda _: {}, lambda: not any(torques()), "no torque without sensors")
    for topic, kind in sends.items():
        car.stack.node.destroy_publisher(car.stack.publishers[topic])
        car.stack.publishers[topic] = car.stack.node.create_publisher(messages.message_class(kind), topic, 1)
    car.stack.drive(inputs, drives, "driving torque again")
    braking = True

    def brakes() -> bool:
        (point,) = car.stack.last("brakes").points
        return len(point.effort) == 4 and min(point.effort) > 10.0 and torques()[0] < -10.0

    car.stack.drive(inputs, brakes, "braking torque")


def test_what_it_waits_for_names_the_topic_the_reason_and_the_remedy(connect: Callable[..., Connected]) -> None:
    """A speed of another type, two of four wheels, and a force in N where the file says kN."""
    sends = {"odom": ODOMETRY, "rpm_2": NUMBER} | dict.fromkeys(("rpm_0", "rpm_1", "force", "charge"), NUMBER)
    car = connect(WRONG_IN_THREE_WAYS, sends)

    def inputs(stack: Stack) -> dict[str, Any]:
        odometry = of_type(ODOMETRY, header__stamp=stack.stamp())
        return {
            "odom": odometry,
            "rpm_0": number(0.0),
            "rpm_1": number(0.0),
            "force": number(4e3),
            "charge": number(0.5),
        }

    def waits() -> str:
        lines = [line for line in car.running.text().splitlines() if "waits for" in line]
        return lines[-1] if "force_demand" in (lines or [""])[-1] else ""

    line = car.stack.drive(inputs, waits, "what it waits for")
    remedy = "sends nav_msgs/msg/Odometry, not geometry_msgs/msg/TwistStamped; to hear it, write signals.speed: "
    assert remedy + "{type: nav_msgs/msg/Odometry, field: twist.twist.linear.x}" in line
    name = car.stack.node.get_namespace()
    assert f"wheel_states on {name}/rpm_2, {name}/rpm_3 (no message; no publisher)" in line
    assert "out of range: force_demand 4000 kN on force, which is 4e+06 W; allowed: demand_min_w -600000 to" in line
    assert "battery" not in line


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (
            {"linear.x": "linear.q"},
            "has no field linear.q; allowed: a field of geometry_msgs/msg/Twist that is a number, such as linear.",
        ),
        ({"unit: km/h": "unit: knots"}, "signals.speed.unit: 'knots' is unknown; allowed: m/s"),
        (
            {"geometry_msgs/msg/Twist,": "my_msgs/msg/Speed,"},
            "signals.speed.type: my_msgs/msg/Speed is not installed here",
        ),
        (
            {"geometry_msgs/msg/Twist,": "geometry_msg/msg/Twist,"},
            "geometry_msg/msg/Twist is not installed here; allowed: a type of a sourced workspace, such as "
            "std_msgs/msg/Float64; did you mean geometry_msgs/msg/Twist",
        ),
        ({"  soc:": "  sox:"}, "signals.sox: is an unknown key"),
        ({"friction_torque: none": "friction_torque: nothing"}, "commands.friction_torque"),
        ({"torque_3, type: std_msgs/msg/Float64": "torque_3, type: std_msgs/msg/UInt32"}, "cannot hold 1 torques"),
        (
            {"acceleration_demand": "accelerator_pedal", "m/s2": '"1"'},
            "the demand comes from accelerator_pedal; allowed: one of power_demand, force_demand",
        ),
    ],
)
def test_a_mapping_that_cannot_work_is_one_line_that_names_the_key(
    tmp_path: Path, change: dict[str, str], problem: str
) -> None:
    text = FOUR_TOPICS
    for old, new in change.items():
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / "signals.yaml"
    path.write_text(text)
    running = Running(
        MODULE, arguments({"strategy": "equal", "policy_file": "", "signals_file": path}), DOMAIN, tmp_path
    )
    assert running.wait() == BAD_INPUT
    (line,) = [line for line in running.text().splitlines() if line.startswith("[ERROR]")]
    assert f"parameter signals_file: {path}: " in line
    assert problem in line
