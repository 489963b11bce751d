# SPDX-License-Identifier: Apache-2.0
"""The examples drive: another DDS without ROS, and whatever else a folder in examples/ promises."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from bench import Running, arguments, environment

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = ROOT / "examples"
#: What `run` says where nothing can be downloaded.
NO_PACKAGES = 69
DOMAIN = int(os.environ["ROS_DOMAIN_ID"])


def test_a_car_on_cyclonedds_drives_and_stops(tmp_path: Path, compiled_law: None) -> None:
    name = f"/cyclone_{os.getpid()}"
    args = arguments({"strategy": "equal", "policy_file": ""}, {"__ns": name, "/diagnostics": f"{name}/diagnostics"})
    running = Running("iwm_power_manager.nodes.power_manager", args, DOMAIN, tmp_path)
    try:
        car = subprocess.run(
            [EXAMPLES / "cyclonedds_car" / "run", "--namespace", name, "--domain", str(DOMAIN)],
            env=environment(DOMAIN, tmp_path) | {"CAR_ENV": str(tmp_path / "env"), "PYTHON": sys.executable},
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        if car.returncode == NO_PACKAGES and "CI" not in os.environ:
            pytest.skip(car.stderr.strip())
        assert car.returncode == 0, car.stdout + car.stderr + running.text()
        assert "stopped" in car.stdout
        assert running.stop() == 0
        assert "first torque" in running.text()
    finally:
        running.process.kill()
        running.process.wait()


def test_a_car_in_rclpy_drives_and_stops(tmp_path: Path, compiled_law: None) -> None:
    name = f"/desk_{os.getpid()}"
    absolute = ("/odom", "/joint_states", "/pedals/accelerator", "/pedals/brake")
    absolute += ("/battery/charge", "/battery/temperature", "/diagnostics")
    remaps = {"__ns": name} | {topic: name + topic for topic in absolute}
    given = {"strategy": "equal", "policy_file": "", "signals_file": "config/signals/odometry_and_pedals.yaml"}
    running = Running("iwm_power_manager.nodes.power_manager", arguments(given, remaps), DOMAIN, tmp_path)
    try:
        car = subprocess.run(
            [sys.executable, EXAMPLES / "rclpy_car" / "car.py", "--seconds", "100", *arguments({}, remaps)],
            env=environment(DOMAIN, tmp_path),
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        assert (car.returncode, car.stdout) == (0, "stopped\n"), car.stdout + car.stderr + running.text()
        assert running.stop() == 0
        assert "first torque" in running.text()
    finally:
        running.process.kill()
        running.process.wait()


def test_a_car_that_is_nowhere_is_one_line(tmp_path: Path) -> None:
    car = subprocess.run(
        [sys.executable, EXAMPLES / "rclpy_car" / "car.py", "--vehicle", "compact_two_motor"],
        env=environment(DOMAIN, tmp_path),
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert car.returncode == 2
    assert "error: compact_two_motor: cannot be read" in car.stderr
    assert "did you mean compact_two_motors" in car.stderr
    assert "Traceback" not in car.stderr
