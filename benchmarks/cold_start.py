# SPDX-License-Identifier: Apache-2.0
"""Seconds from nothing to the first command: the control law's first step from an empty and from a full kernel cache.

Each run is a process of its own: import, vehicle, policy, first step. `--peer FOLDER` runs another checkout beside it,
in turns, so that both see the same machine.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

FIRST_STEP = """\
import importlib
from iwm_power_manager.control import law
from iwm_power_manager.control.types import Measurement, initial_state
from iwm_power_manager.policy import load_policy
from iwm_power_manager.share import resolve
from iwm_power_manager.vehicle import load_vehicle

def found(name, *modules):
    for module in modules:  # where it stands now, and where it stood in earlier versions
        try:
            return getattr(importlib.import_module(f"iwm_power_manager.{module}"), name)
        except (ImportError, AttributeError):
            pass

settings = found("default_settings", "control.settings", "control.types")("sdp_lookahead")
params = load_vehicle(resolve("jalalmaab_2015")).params
table = load_policy(resolve("jalalmaab_2015_drag_coupled_mu090")).table()
discharge, charge = found("battery_limits_w", "model.limits", "actuation.limits")(0.8, 25.0, params.battery)
measurement = Measurement(1.0, (3.0,) * 4, 500.0, 0.01, 0.9, discharge, charge, 0.8)
law.step(measurement, initial_state(), settings, params, table)
print(law.__file__)
"""


def first_command_s(checkout: Path, cache: Path) -> tuple[float, float]:
    """Seconds on the clock and of the processor until the law has answered once."""
    environment = {**os.environ, "PYTHONPATH": str(checkout), "IWM_CACHE_DIR": str(cache)}
    started, used = time.perf_counter(), os.times()
    command = [sys.executable, "-P", "-c", FIRST_STEP]
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    if not Path(done.stdout.strip()).is_relative_to(checkout):
        raise SystemExit(f"{checkout} was not what ran: {done.stdout.strip()}")
    passed, after = time.perf_counter() - started, os.times()
    return passed, after.children_user + after.children_system - used.children_user - used.children_system


def main() -> None:
    """Time cold and warm starts, print a line for each, and JSON if asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeat", type=int, default=3, help="runs of each (default: %(default)s)")
    parser.add_argument("--peer", type=Path, metavar="FOLDER", help="another checkout, timed in turns")
    parser.add_argument("--json", metavar="FILE", help="write all times")
    options = parser.parse_args()
    checkouts = {"this": ROOT} | ({"peer": options.peer.resolve()} if options.peer else {})
    times: dict[str, dict[str, list[tuple[float, float]]]] = {name: {"cold": [], "warm": []} for name in checkouts}
    for _ in range(options.repeat):
        for name, checkout in checkouts.items():
            with tempfile.TemporaryDirectory() as cache:
                times[name]["cold"].append(first_command_s(checkout, Path(cache)))
                times[name]["warm"].append(first_command_s(checkout, Path(cache)))
    for name, kinds in times.items():
        for kind, measured in kinds.items():
            clock = [wall for wall, _ in measured]
            processor = statistics.median(cpu for _, cpu in measured)
            print(
                f"{name:5} {kind}: {statistics.median(clock):6.2f} s to the first command "
                f"({min(clock):.2f} to {max(clock):.2f}), {processor:.2f} s of the processor"
            )
    if options.json:
        Path(options.json).write_text(json.dumps(times, indent=2) + "\n")


if __name__ == "__main__":
    main()
