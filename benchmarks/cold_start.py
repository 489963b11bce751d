# SPDX-License-Identifier: Apache-2.0
"""Seconds from nothing to the first command: the control law's first step from an empty and from a full kernel cache.

Each run is a process of its own: import, vehicle, policy, first step. `--peer FOLDER` runs another checkout beside it,
in turns, so that both see the same machine. Of this checkout alone it also times every command's `--help`, and the node
until its first step with either cache, and until it drives with the compiled law.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from importlib import metadata
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
advance, Held = found("advance", "control.repeat"), found("Held", "held")
if advance:
    advance(measurement, Held(initial_state()), Held(initial_state()), settings, Held(params), table)
else:
    law.step(measurement, initial_state(), settings, params, table)
print(law.__file__)
"""


def first_command_s(checkout: Path, cache: Path) -> tuple[float, float]:
    """Seconds on the clock and of the processor until the law has answered once."""
    environment = environment_of(checkout, cache)
    started, used = time.perf_counter(), os.times()
    command = [sys.executable, "-P", "-c", FIRST_STEP]
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    if not Path(done.stdout.strip()).is_relative_to(checkout):
        raise SystemExit(f"{checkout} was not what ran: {done.stdout.strip()}")
    passed, after = time.perf_counter() - started, os.times()
    return passed, after.children_user + after.children_system - used.children_user - used.children_system


def environment_of(checkout: Path, cache: Path) -> dict[str, str]:
    """What a process needs to run a checkout's code with a kernel cache of its own, heard by nobody else."""
    return {
        **os.environ,
        "PYTHONPATH": str(checkout),
        "IWM_CACHE_DIR": str(cache),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(cache / "log"),
        "PYTHONUNBUFFERED": "1",
    }


def help_s(target: str, cache: Path) -> tuple[float, float]:
    """Seconds of a command's `--help`, on the clock and of the processor."""
    module, function = target.split(":")
    code = f"import sys; from {module} import {function}; sys.argv = ['{function}', '--help']; {function}()"
    started, used = time.perf_counter(), os.times()
    subprocess.run([sys.executable, "-c", code], env=environment_of(ROOT, cache), check=True, capture_output=True)
    passed, after = time.perf_counter() - started, os.times()
    return passed, after.children_user + after.children_system - used.children_user - used.children_system


def node_s(cache: Path) -> dict[str, tuple[float, float]]:
    """Seconds until the node's first control step is heard, and until it says that its law is compiled.

    On the clock, and of the processor: to the step that of the node alone, to the compiled law also that of the process
    that compiles, and of ending both.
    """
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray
    from sensor_msgs.msg import JointState

    from iwm_sim.domains import claimed_domain

    heard: list[JointState] = []
    reports: list[DiagnosticArray] = []

    def compiled() -> bool:
        said = [status for report in reports for status in report.status if status.name.endswith(": law")]
        return any(status.message == "compiled" for status in said)

    with claimed_domain() as domain:
        context = rclpy.Context()
        rclpy.init(context=context, domain_id=domain, args=[])
        listener = rclpy.create_node("cold_start", context=context)
        listener.create_subscription(JointState, "power_manager/state", heard.append, 10)
        listener.create_subscription(DiagnosticArray, "/diagnostics", reports.append, 10)
        executor = rclpy.executors.SingleThreadedExecutor(context=context)
        executor.add_node(listener)
        environment = environment_of(ROOT, cache) | {"ROS_DOMAIN_ID": str(domain)}
        started, used = time.perf_counter(), os.times()
        first: tuple[float, float] | None = None
        with subprocess.Popen(
            [sys.executable, "-m", "iwm_power_manager.nodes.power_manager"],
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        ) as node:
            while not (first and compiled()) and node.poll() is None:
                executor.spin_once(timeout_sec=0.01)
                if heard and first is None:
                    ticks = Path(f"/proc/{node.pid}/stat").read_text().rpartition(")")[2].split()[11:13]
                    first = time.perf_counter() - started, sum(map(int, ticks)) / os.sysconf("SC_CLK_TCK")
            passed = time.perf_counter() - started
            node.send_signal(signal.SIGINT)
        executor.shutdown()
        listener.destroy_node()
        rclpy.shutdown(context=context)
    if first is None or not compiled():
        raise SystemExit("the node ended before its law was compiled")
    after = os.times()
    spent = after.children_user + after.children_system - used.children_user - used.children_system
    return {"first step": first, "compiled law": (passed, spent)}


def median_line(name: str, measured: list[tuple[float, float]], what: str) -> str:
    """One line: median, extremes and processor time."""
    clock = [wall for wall, _ in measured]
    processor = statistics.median(cpu for _, cpu in measured)
    return (
        f"{name}: {statistics.median(clock):6.2f} s {what} ({min(clock):.2f} to {max(clock):.2f}), "
        f"{processor:.2f} s of the processor"
    )


def started_programs(repeat: int) -> dict[str, list[tuple[float, float]]]:
    """Times of each `--help`, and of the node with an empty and with a full cache."""
    commands = {
        entry.name: entry.value
        for entry in metadata.distribution("iwm_power_manager").entry_points
        if entry.group == "console_scripts"
    }
    times: dict[str, list[tuple[float, float]]] = {}
    with tempfile.TemporaryDirectory() as folder:
        cache = Path(folder)
        for name, target in sorted(commands.items()):
            times[f"{name} --help"] = [help_s(target, cache) for _ in range(repeat)]
        for _ in range(repeat):
            with tempfile.TemporaryDirectory(dir=folder) as empty:
                cold, warm = node_s(Path(empty)), node_s(Path(empty))
            for name, measured in (
                ("power_manager", warm["first step"]),
                ("power_manager, empty cache", cold["first step"]),
                ("power_manager, empty cache, compiled", cold["compiled law"]),
            ):
                times.setdefault(name, []).append(measured)
    return times


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
            print(median_line(f"{name:5} {kind}", measured, "to the first command"))
    programs = started_programs(options.repeat)
    for name, measured in programs.items():
        what = "until its first step" if name.startswith("power_manager") else ""
        print(median_line(f"{name:22}", measured, "until its law is compiled" if name.endswith("compiled") else what))
    if options.json:
        Path(options.json).write_text(json.dumps(times | programs, indent=2) + "\n")


if __name__ == "__main__":
    main()
