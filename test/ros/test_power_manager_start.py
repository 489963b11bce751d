# SPDX-License-Identifier: Apache-2.0
"""How the node starts alone: parameter file, namespace, remaps; one clear line and an exit code when it cannot."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from bench import PATIENCE_S, Bench, Running, arguments

from iwm_power_manager.exit_codes import BAD_INPUT
from iwm_power_manager.files import read_yaml
from iwm_power_manager.nodes import power_manager_config as config
from iwm_power_manager.ros import messages, qos
from iwm_power_manager.share import resolve
from parameter_pages import parameter_file

MODULE = "iwm_power_manager.nodes.power_manager"
DOMAIN = int(os.environ["ROS_DOMAIN_ID"])


def fails_with(folder: Path, args: list[str]) -> str:
    running = Running(MODULE, args, DOMAIN, folder)
    assert running.wait() == BAD_INPUT
    lines = [line for line in running.text().splitlines() if line.strip()]
    assert len(lines) == 1, running.text()
    return lines[0]


@pytest.mark.parametrize(
    ("parameters", "expected"),
    [
        ({"policy_file": "/nowhere/policy.npz"}, "parameter policy_file: /nowhere/policy.npz: cannot be read"),
        ({"policy_file": ""}, "[power_manager]: parameter policy_file: is empty"),
        (
            {"strategy": "equal", "vehicle_file": "/nowhere/car.yaml"},
            "parameter vehicle_file: /nowhere/car.yaml: cannot be read",
        ),
        ({"signals_file": "/nowhere/odom.yaml"}, "parameter signals_file: /nowhere/odom.yaml: cannot be read"),
        ({"rate_hz": 100}, "parameter rate_hz: 100 is not allowed; allowed: 10 to 1000 (double: write 100.0)"),
        ({"rate_hz": 2}, "parameter rate_hz: 2 is not allowed; allowed: 10 to 1000 (double)"),
        ({"friction": [2]}, "parameter friction: [2] is not allowed; allowed: 0.05 to 1.5 (double)"),
        ({"rule": [1, 2, 3, 4]}, "100000 (double_array: write [1.0, 2.0, 3.0, 4.0])"),
        ({"rule": [1, 2]}, "100000 (double_array)"),
        ({"rate_hz": 1e6}, "parameter rate_hz: 1000000.0 is not allowed; allowed: 10 to 1000"),
        ({"rate_hz": "fast"}, "parameter rate_hz: 'fast' is not allowed; allowed: 10 to 1000"),
        ({"strategy": "clever"}, "parameter strategy: 'clever' is not allowed; allowed: equal | rule"),
        ({"slip_target": 0.3}, "parameter slip_target: 0.3 is not allowed; allowed: at most critical_slip"),
        ({"cpu_affinity": "first"}, "parameter cpu_affinity: 'first' is no list of processors"),
        ({"friction": ".nan"}, "parameter friction: nan is not allowed"),
    ],
)
def test_what_it_cannot_start_with_gives_one_line(tmp_path, parameters, expected) -> None:
    assert expected in fails_with(tmp_path, arguments(parameters))


@pytest.mark.parametrize(
    ("right", "wrong"), [("topic: /odom", "topik: /odom"), ("linear.x", "linear.q"), ("msg/Odometry", "msg/Odometri")]
)
def test_a_mistake_in_a_signals_file_is_told_before_anything_is_compiled(tmp_path, right, wrong) -> None:
    text = resolve("config/signals/odometry_and_pedals.yaml").read_text()
    (tmp_path / "signals.yaml").write_text(text.replace(right, wrong))
    program = f"""
import sys
from iwm_power_manager.errors import IwmError
from iwm_power_manager.nodes import power_manager_config as config
from iwm_power_manager.nodes.preparation import prepare
values = {{spec.name: spec.default for spec in config.SPECS}}
try:
    prepare(values | {{"signals_file": {str(tmp_path / "signals.yaml")!r}}})
except IwmError as error:
    print(error, "numba" in sys.modules)
"""
    told = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert "signals.speed" in told
    assert told.endswith(" False\n")


def test_a_damaged_policy_gives_one_line(tmp_path) -> None:
    damaged = tmp_path / "policy.npz"
    damaged.write_bytes(b"PK\x03\x04 and then nothing that makes sense")
    assert "damaged" in fails_with(tmp_path, arguments({"policy_file": damaged}))


def test_a_vehicle_with_a_bad_value_is_named_with_its_key(tmp_path) -> None:
    text = resolve("config/vehicles/jalalmaab_2015.yaml").read_text()
    car = tmp_path / "car.yaml"
    car.write_text(text.replace("mass_kg: 800.0", "mass_kg: -800.0"))
    assert f"{car}: chassis.mass_kg" in fails_with(tmp_path, arguments({"strategy": "equal", "vehicle_file": car}))


def test_pedals_on_two_topics_close_no_set_of_lockstep(tmp_path) -> None:
    given = {"strategy": "equal", "lockstep": True, "signals_file": "config/signals/odometry_and_pedals.yaml"}
    line = fails_with(tmp_path, arguments(given))
    assert (
        "signals: the demand closes a set of inputs in lock-step, and comes on two topics; allowed: one topic" in line
    )


def test_a_parameter_file_that_is_missing_or_no_yaml_gives_one_line(tmp_path) -> None:
    line = fails_with(tmp_path, ["--ros-args", "--params-file", "/nowhere/params.yaml"])
    assert line == "power_manager: /nowhere/params.yaml: cannot be read: No such file or directory"
    broken = tmp_path / "params.yaml"
    broken.write_text("power_manager: [")
    assert f"power_manager: {broken}: line 1" in fails_with(tmp_path, ["--ros-args", "--params-file", str(broken)])


def test_a_parameter_file_for_another_node_is_refused(tmp_path) -> None:
    """ROS passes over it without a word, and the node would drive with its defaults."""
    path = tmp_path / "params.yaml"
    path.write_text("power_manager:\n  ros__parameters:\n    friction: 0.3\n")
    line = fails_with(tmp_path, ["--ros-args", "-r", "__ns:=/car_1", "--params-file", str(path)])
    assert line.startswith(f"power_manager: {path}: /power_manager: is not this node, which is /car_1/power_manager; ")


def test_it_runs_from_its_parameter_file_in_a_namespace_with_remaps(tmp_path, compiled_law) -> None:
    params = str(resolve("config/nodes/power_manager.yaml"))
    args = arguments({"strategy": "equal"}, {"__ns": "/car", "vehicle_speed": "/gps/speed"})
    args[1:1] = ["--params-file", params]
    running = Running(MODULE, args, DOMAIN, tmp_path)
    bench = Bench(namespace="/car")
    try:
        bench.node.destroy_publisher(bench.publishers[messages.VEHICLE_SPEED])
        bench.publishers[messages.VEHICLE_SPEED] = bench.node.create_publisher(
            messages.TOPIC_TYPES[messages.VEHICLE_SPEED], "/gps/speed", 1
        )
        bench.connect()
        bench.drive(lambda: bench.mode() == 1, "normal operation")
        assert running.stop(signal.SIGTERM) == 0
    finally:
        running.process.kill()
        bench.close()


def test_ctrl_c_while_it_compiles_ends_it_at_once(tmp_path, empty_cache) -> None:
    cache = Path(empty_cache["IWM_CACHE_DIR"])
    running = Running(MODULE, arguments({"strategy": "equal"}), DOMAIN, tmp_path, empty_cache)
    end = time.monotonic() + PATIENCE_S
    while not any(cache.rglob("iwm_power_manager.*")):  # what the law's step needs beside it
        assert running.process.poll() is None, running.text()
        assert time.monotonic() < end
        time.sleep(0.01)
    assert running.stop(signal.SIGINT) == 0
    assert "Traceback" not in running.text()
    assert not any(cache.rglob("*.repeat.advance-*")), "it went on compiling"


def test_services_are_answered_while_it_compiles(tmp_path, empty_cache) -> None:
    bench = Bench(namespace="/compiling")
    given = {"strategy": "equal", "lockstep": True}  # where it waits for the compiled law
    running = Running(MODULE, arguments(given, {"__ns": "/compiling"}), DOMAIN, tmp_path, empty_cache)
    try:
        assert bench.lifecycle_state() == "unconfigured"
        assert bench.get_parameter("rate_hz") == 100.0
        assert not any((tmp_path / "cache").rglob("*.repeat.advance-*")), "it has compiled already"
    finally:
        running.process.kill()
        running.wait()
        bench.close()


#: A start that fails because a library makes something else of the KeyboardInterrupt, as a ctypes callback does.
SWALLOWED = """
import signal, sys
from iwm_power_manager.nodes import power_manager, power_manager_node
def start(node):
    try:
        signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt:
        return False
power_manager_node.PowerManager.start = start
sys.exit(power_manager.main())
"""


def test_a_start_that_fails_of_ctrl_c_is_no_failure() -> None:
    assert subprocess.run([sys.executable, "-c", SWALLOWED], timeout=PATIENCE_S, check=False).returncode == 0


def test_a_parameter_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    line = fails_with(tmp_path, arguments({"strategy": "equal", "frictoin": 0.3}))
    assert line == "power_manager: parameter frictoin is unknown; is friction meant?"


def test_inputs_are_heard_from_best_effort_publishers(start_pair) -> None:
    bench = start_pair().bench
    for topic in list(bench.publishers):
        bench.node.destroy_publisher(bench.publishers[topic])
        best_effort = qos.profile(lockstep=False, reliability="best_effort")
        bench.publishers[topic] = bench.node.create_publisher(messages.TOPIC_TYPES[topic], topic, best_effort)
    bench.connect()
    bench.drive(lambda: bench.mode() == 1, "normal operation")


def test_the_parameter_file_holds_every_parameter_with_its_default() -> None:
    path = resolve("config/nodes/power_manager.yaml")
    assert path.read_text() == parameter_file(), "run scripts/update_interface"
    values = read_yaml(path)["/**"]["ros__parameters"]
    flat = {}
    for key, value in values.items():
        if isinstance(value, dict):
            flat |= {f"{key}.{name}": item for name, item in value.items()}
        else:
            flat[key] = value
    assert flat == {spec.name: spec.default for spec in config.SPECS}
    assert all(type(flat[spec.name]) is type(spec.default) for spec in config.SPECS)
