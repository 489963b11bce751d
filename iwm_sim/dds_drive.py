# SPDX-License-Identifier: Apache-2.0
"""A drive over DDS: recorder, power manager and simulator as processes on a domain of their own, and what they left.

In lock-step the result does not depend on how fast they are; the same drive in one process has to give the same bits.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from iwm_power_manager import files
from iwm_power_manager.control.settings import Settings
from iwm_power_manager.control.strategies import STRATEGIES
from iwm_power_manager.control.table import PolicyTable, empty_table
from iwm_power_manager.cycle import Cycle, load_cycle
from iwm_power_manager.nodes import power_manager_config
from iwm_power_manager.nodes.policy_choice import choose_policies
from iwm_power_manager.share import resolve
from iwm_power_manager.tools.progress import Bar
from iwm_power_manager.vehicle import Vehicle, load_vehicle
from iwm_sim import closed_loop
from iwm_sim.closed_loop import Run
from iwm_sim.domains import claimed_domain
from iwm_sim.drive import CAR_COLUMNS, load_run
from iwm_sim.drive_bag import problems, read_drive_bag, with_decisions
from iwm_sim.processes import Child, Children

REFERENCE = "equal"

MODULES = {
    "recorder": "iwm_power_manager.nodes.recorder",
    "power_manager": "iwm_power_manager.nodes.power_manager",
    "simulator": "iwm_sim.simulator",
}
PARAMETER_FILES = {name: f"config/nodes/{name}.yaml" for name in MODULES}

#: A node that has to compile first, on a busy machine, takes this long to be there.
_PARTNER_TIMEOUT_S = 300.0
#: What the simulator sends at its rate, which the power manager has to know to notice when it is missing.
_PERIODIC_INPUTS = ("vehicle_speed", "wheel_states", "power_demand")


@dataclass(frozen=True)
class Plan:
    """What is to be driven.

    Attributes
    ----------
    cycle, vehicle, policy : files, or names of the package's
    strategy, friction, idle_drive, rate_hz, soc : how
    until_s : only so much of the cycle, s; 0 is all
    realtime, record : instead of lock-step; with the recorder
    output : folder for everything that is made
    json : also write the result's rows here
    scenario : file, or name of one of the package's, instead of the cycle; its car and friction are the plan's then
    animate : draw the drive as a GIF here
    """

    cycle: str
    vehicle: str
    policy: str
    strategy: str
    friction: float
    idle_drive: str
    rate_hz: float
    soc: float
    until_s: float
    realtime: bool
    record: bool
    output: Path
    json: str | None
    scenario: str = ""
    animate: Path | None = None


class Loaded(NamedTuple):
    """The plan's files, read and checked.

    Attributes
    ----------
    vehicle, cycle : the car and its trace, as far as it is driven
    settings, policy : of the control law, as the power manager builds them
    policy_identity : which policy that is, for the reader
    """

    vehicle: Vehicle
    cycle: Cycle
    settings: Settings
    policy: PolicyTable
    policy_identity: str


class Outcome(NamedTuple):
    """What the three processes left: the drive, its notes, and lines about checks, with whether all went well."""

    run: Run
    notes: dict[str, Any]
    remarks: list[str]
    complete: bool


def load(plan: Plan) -> Loaded:
    """Read and check every file of the plan, before anything is started."""
    vehicle = load_vehicle(resolve(plan.vehicle), plan.idle_drive or None)
    cycle = load_cycle(resolve(plan.cycle))
    parameters = power_manager_parameters()
    policies = choose_policies(plan.policy, plan.strategy, "none", list(parameters["rule"]), vehicle)
    table = policies.table(plan.friction)
    identity = policies.status().values
    return Loaded(
        vehicle,
        cycle,
        power_manager_config.law_settings(parameters, policies.strategy),
        table,
        "none needed" if "checksum" not in identity else f"{identity['grid']} {identity['checksum'][:12]}",
    )


def power_manager_parameters() -> dict[str, Any]:
    """Parameters of the power manager as its node gets them: defaults, and over them its file in `config/nodes`."""
    path = resolve(PARAMETER_FILES["power_manager"])
    given = files.read_yaml(path).get("/**", {}).get("ros__parameters", {})
    return {spec.name: given.get(spec.name, spec.default) for spec in power_manager_config.SPECS}


def closed_loop_run(plan: Plan, loaded: Loaded, *, equal: bool = False) -> Run:
    """The same drive in this process, or the reference."""
    period_s = round(1e9 / plan.rate_hz) / 1e9
    settings = loaded.settings._replace(strategy=STRATEGIES[REFERENCE].code) if equal else loaded.settings
    policy = empty_table() if equal else loaded.policy
    return closed_loop.run(
        loaded.cycle,
        loaded.vehicle,
        settings,
        policy,
        plan.friction,
        dt_s=period_s,
        soc=plan.soc,
        until_s=plan.until_s or math.inf,
    )


def compare(driven: Run, alone: Run) -> tuple[bool, str]:
    """Whether two runs are the same bit for bit, in all that the car knows, and a sentence about it."""
    steps = len(driven.series)
    for name in CAR_COLUMNS:
        different = np.flatnonzero(driven[name] != alone[name][:steps])
        if len(different):
            used, other = driven["chemical_j"][-1], alone["chemical_j"][steps - 1]
            at = driven["time_s"][different[0]]
            return False, (
                f"The same drive in one process differs from {at:.2f} s on ({name}); its energy by "
                f"{abs(used - other) / abs(other):.1e} relative."
            )
    return True, "The same drive in one process gives the same numbers, bit for bit."


# --- processes --------------------------------------------------------------------------------------------------------


def node_command(node: str, parameters: Mapping[str, Any]) -> list[str]:
    """Command that runs a node with its parameter file and single parameters over it."""
    command = [sys.executable, "-m", MODULES[node], "--ros-args", "--params-file", str(resolve(PARAMETER_FILES[node]))]
    for name, value in parameters.items():
        # JSON is YAML: texts keep their quotes, so that an empty one or '1' stays text.
        command += ["-p", f"{name}:={json.dumps(value)}"]
    return command


def environment(output: Path, domain: int) -> dict[str, str]:
    """Environment of the nodes: their DDS domain, on this machine only, logs below the output."""
    return os.environ | {
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(output / "log" / "ros"),
    }


def drive_over_dds(plan: Plan, name: str) -> Outcome:
    """Start the nodes, follow the drive, stop them, read what they left; `name` is what progress calls it."""
    vehicle_file = str(resolve(plan.vehicle).absolute())
    common = {"vehicle_file": vehicle_file, "idle_drive": plan.idle_drive, "lockstep": not plan.realtime}
    common |= {"rate_hz": plan.rate_hz, "friction": plan.friction}
    told = {} if plan.scenario else {"friction_source": "parameter"}
    result = plan.output / "drive.npz"
    bag = plan.output / "bag"
    with (
        claimed_domain() as domain,
        Children(environment(plan.output.absolute(), domain), plan.output / "log") as children,
    ):
        recorder = None
        if plan.record:
            recorder = children.start(
                "recorder",
                node_command(
                    "recorder",
                    {"output": str(bag), "vehicle_file": vehicle_file, "use_sim_time": not plan.realtime}
                    | _policy_file(plan),
                ),
            )
        power_manager = children.start(
            "power manager",
            node_command(
                "power_manager",
                {
                    **common,
                    **told,
                    "strategy": plan.strategy,
                    "policy_file": _absolute(plan.policy),
                    **{f"input_period_s.{topic}": 1.0 / plan.rate_hz for topic in _PERIODIC_INPUTS},
                },
            ),
        )
        simulator = children.start(
            "simulator",
            node_command(
                "simulator",
                {
                    **common,
                    "cycle_file": _absolute(plan.cycle),
                    "scenario_file": _absolute(plan.scenario) if plan.scenario else "",
                    "initial_soc": plan.soc,
                    "until_s": plan.until_s,
                    "wait_for_recorder": plan.record,
                    "partner_timeout_s": _PARTNER_TIMEOUT_S,
                    "result_file": str(result.absolute()),
                    "progress": True,
                },
            ),
            stdout=subprocess.PIPE,
        )
        others = [child for child in (recorder, power_manager) if child]
        follow(simulator, others, name)
        # The recorder last: it takes what the power manager says in the end, too.
        power_manager.interrupt()
        if recorder:
            recorder.interrupt(60.0)
    driven, notes = load_run(result)
    steps, wall_s = len(driven.series), notes["wall_s"]
    pace = f"{steps / wall_s:.0f} steps/s, {driven.dt_s * steps / wall_s:.1f} x real time"
    print(f"{steps} steps in {wall_s:.0f} s: {pace}")
    return check_bag(plan, driven, notes, bag)


def check_bag(plan: Plan, driven: Run, notes: dict[str, Any], path: Path) -> Outcome:
    """Read the bag, say whether all is in it, and add the law's decisions to the drive."""
    if not plan.record:
        return Outcome(driven, notes, ["Not recorded."], True)
    stamps = [notes["first_stamp_ns"] + step * notes["period_ns"] for step in range(len(driven.series))]
    bag = read_drive_bag(path)
    lines = problems(bag, notes["published"], [] if plan.realtime else stamps)
    total = sum(bag.counts.values())
    remark = f"The bag holds {total} messages on {len(bag.counts)} topics: "
    remark += f"incomplete: {'; '.join(lines)}." if lines else "all that were published."
    return Outcome(with_decisions(driven, bag), notes, [remark], not lines)


def _policy_file(plan: Plan) -> dict[str, str]:
    """The policy whose hash belongs into the bag, where it is one file."""
    path = resolve(plan.policy)
    return {"policy_file": str(path.absolute())} if os.path.isfile(path) else {}


def _absolute(path: str) -> str:
    return str(resolve(path).absolute()) if path else ""


def follow(simulator: Child, others: Sequence[Child], name: str) -> None:
    """Show progress until the simulator ends; `ChildError` as soon as any process fails."""
    stream = simulator.process.stdout
    assert stream is not None
    os.set_blocking(stream.fileno(), False)
    pending = b""
    bar: Bar | None = None
    try:
        while simulator.running:
            for child in others:
                child.check_running()
            pending += stream.read() or b""
            *lines, pending = pending.split(b"\n")
            for now_s, whole_s in _progress(lines):
                if bar is None:
                    bar = _bar(name, whole_s)
                bar.update(now_s - bar.n)
            time.sleep(0.05)
    finally:
        stream.close()
        if bar is not None:
            bar.close()
    simulator.check()


def _bar(name: str, whole_s: float) -> Bar:
    style = "{desc} {percentage:3.0f}% |{bar}| {n:.0f} of {total:.0f} s, {elapsed} so far, {remaining} to go"
    return Bar(whole_s, "s", f"driving {name}", bar_format=style)


def _progress(lines: Sequence[bytes]) -> Iterator[tuple[float, float]]:
    for line in lines:
        word, *numbers = line.split()
        if word == b"progress":
            yield float(numbers[0]), float(numbers[1])
