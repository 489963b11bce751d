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
DOMAIN = int(os.environ["ROS_DOMAIN_ID"])


def test_a_car_on_cyclonedds_drives_and_stops(tmp_path: Path, compiled_law: None) -> None:
    pytest.importorskip("cyclonedds")
    name = f"/cyclone_{os.getpid()}"
    args = arguments({"strategy": "equal", "policy_file": ""}, {"__ns": name, "/diagnostics": f"{name}/diagnostics"})
    running = Running("iwm_power_manager.nodes.power_manager", args, DOMAIN, tmp_path)
    try:
        car = subprocess.run(
            [sys.executable, EXAMPLES / "cyclonedds_car" / "car.py", "--namespace", name, "--domain", str(DOMAIN)],
            env=environment(DOMAIN, tmp_path),
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        assert car.returncode == 0, car.stdout + car.stderr + running.text()
        assert "stopped" in car.stdout
        assert running.stop() == 0
        assert "first torque" in running.text()
    finally:
        running.process.kill()
        running.process.wait()
