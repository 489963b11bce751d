"""`demo`: a whole drive over DDS in one command.

Recorder, power manager and simulator run as three processes on a DDS domain of their own, on this machine only. In
lock-step the result does not depend on how fast they are; the same drive in one process has to give the same bits, and
this command says whether it did. Equal distribution, driven in one process, stands beside it.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np
from tqdm import tqdm

from iwm_power_manager import files, jit
from iwm_power_manager.control.settings import Settings
from iwm_power_manager.control.strategies import DEFAULT_STRATEGY, STRATEGIES, drivable
from iwm_power_manager.control.table import PolicyTable, empty_table
from iwm_power_manager.cycle import Cycle, load_cycle
from iwm_power_manager.errors import ConfigError, IwmError
from iwm_power_manager.model.parameters import IDLE_DRIVES
from iwm_power_manager.nodes import power_manager_config
from iwm_power_manager.nodes.policy_choice import choose_policies
from iwm_power_manager.share import resolve
from iwm_power_manager.vehicle import Vehicle, load_vehicle
from iwm_sim import closed_loop, metrics
from iwm_sim.closed_loop import Run
from iwm_sim.domains import claimed_domain
from iwm_sim.drive import CAR_COLUMNS, load_run
from iwm_sim.drive_bag import problems, read_drive_bag, with_decisions
from iwm_sim.processes import Child, ChildError, Children
from iwm_sim.study.drive_page import Driven, drive_page, row
from iwm_sim.study.report import format_value as shown
from iwm_sim.study.report import write_page

#: A node that has to compile first, on a busy machine, takes this long to be there.
_PARTNER_TIMEOUT_S = 300.0
#: What the simulator sends at its rate, which the power manager has to know to notice when it is missing.
_PERIODIC_INPUTS = ("vehicle_speed", "wheel_states", "power_demand")
_REFERENCE = "equal"
_LOCK_STEP = "over DDS, lock-step"
_REAL_TIME = "over DDS, real time"
_ONE_PROCESS = "in one process"


@dataclass(frozen=True)
class Plan:
    """What the demo is asked for; see `--help`."""

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
    json: Path | None


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


# --- command line ---------------------------------------------------------------------------------------------------


def parse(arguments: Sequence[str] | None = None) -> Plan:
    """The plan of a command line; ends the program on a wrong one."""
    parser = argparse.ArgumentParser(
        prog="demo",
        description="Drive a cycle over DDS with recorder, power manager and simulator, and show the result.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--cycle", default="config/cycles/nycc.csv", help="drive cycle, CSV")
    parser.add_argument("--vehicle", default="config/vehicles/jalalmaab_2015.yaml", help="vehicle, YAML")
    parser.add_argument("--policy", default="policies", help="policy file, or folder with a bank of them")
    parser.add_argument(
        "--strategy", default=DEFAULT_STRATEGY, choices=drivable(), help="how the power manager splits the demand"
    )
    parser.add_argument("--friction", default=0.9, type=_number(0.05, 1.5), help="peak friction coefficient")
    parser.add_argument(
        "--idle-drive", default="", choices=["", *IDLE_DRIVES], help="replaces the vehicle's idle_drive; '': as it is"
    )
    parser.add_argument("--rate", default=50.0, type=_number(10.0, 1000.0), help="control rate, Hz")
    parser.add_argument("--soc", default=0.8, type=_number(0.0, 1.0), help="state of charge at the start, 0..1")
    parser.add_argument("--until", default=0.0, type=_number(0.0, 1e6), help="drive only so much of it, s; 0: all")
    parser.add_argument("--realtime", action="store_true", help="in real time instead of lock-step")
    parser.add_argument("--no-record", action="store_true", help="without the recorder")
    parser.add_argument(
        "--output", type=Path, help="folder for everything that is made (default: runs/<date and time>)"
    )
    parser.add_argument("--json", type=Path, help="also write the result's rows here")
    given = parser.parse_args(arguments)
    return Plan(
        cycle=given.cycle,
        vehicle=given.vehicle,
        policy=given.policy,
        strategy=given.strategy,
        friction=given.friction,
        idle_drive=given.idle_drive,
        rate_hz=given.rate,
        soc=given.soc,
        until_s=given.until,
        realtime=given.realtime,
        record=not given.no_record,
        output=given.output or Path("runs") / datetime.now().strftime("%Y-%m-%d_%H-%M-%S"),
        json=given.json,
    )


def _number(low: float, high: float) -> Any:
    def number(text: str) -> float:
        value = float(text)
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text} is out of range; allowed: {low:g} to {high:g}")
        return value

    return number


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demo; returns the exit code."""
    plan = parse(arguments)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _terminated)
    try:
        return run(plan)
    except KeyboardInterrupt:
        print("\ndemo: stopped; all processes have ended", file=sys.stderr)
        return 130
    except ChildError as error:
        print(f"demo: {error}; its last lines:", file=sys.stderr)
        for line in error.last_lines:
            print(f"    {line}", file=sys.stderr)
        return 1
    except IwmError as error:
        print(f"demo: {error}", file=sys.stderr)
        return 1


def _terminated(_number: int, _frame: Any) -> NoReturn:
    raise KeyboardInterrupt


# --- the run --------------------------------------------------------------------------------------------------------


def run(plan: Plan) -> int:
    """Do all of it; returns the exit code: 1 if the bag lacks anything that was published."""
    loaded = load(plan)
    try:
        (plan.output / "log").mkdir(parents=True)
    except OSError as error:
        raise ConfigError(
            plan.output, "", f"cannot be created: {error.strerror}", "a folder that is not there yet"
        ) from None
    vehicle = loaded.vehicle
    print(f"{vehicle.name} on {loaded.cycle.name}, friction {plan.friction:g}, idle drive {vehicle.idle_drive}")
    if not jit.cache_folder().exists():
        print("compiling the vehicle model; this is done once and takes a minute")
    alone = closed_loop_run(plan, loaded)
    reference = closed_loop_run(plan, loaded, equal=True)

    outcome = drive_over_dds(plan, loaded)
    remarks = outcome.remarks
    driven_run = outcome.run
    if not plan.realtime:
        same, remark = compare(driven_run, alone)
        remarks = [*remarks, remark]
        if same and np.isnan(driven_run["decided_share"]).all():
            driven_run = alone  # without a bag, the law's decisions of the identical run
    return show(plan, loaded, driven_run, reference, remarks, outcome)


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
        identity.get("checksum", "none needed"),
    )


def power_manager_parameters() -> dict[str, Any]:
    """Parameters of the power manager as its node gets them: defaults, and over them its file in `config/nodes`."""
    path = resolve(PARAMETER_FILES["power_manager"])
    given = files.read_yaml(path).get("/**/power_manager", {}).get("ros__parameters", {})
    return {spec.name: given.get(spec.name, spec.default) for spec in power_manager_config.SPECS}


def closed_loop_run(plan: Plan, loaded: Loaded, *, equal: bool = False) -> Run:
    """The same drive in this process, or the reference."""
    period_s = round(1e9 / plan.rate_hz) / 1e9
    settings = loaded.settings._replace(strategy=STRATEGIES[_REFERENCE].code) if equal else loaded.settings
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


# --- over DDS -------------------------------------------------------------------------------------------------------

MODULES = {
    "recorder": "iwm_power_manager.nodes.recorder",
    "power_manager": "iwm_power_manager.nodes.power_manager",
    "simulator": "iwm_sim.simulator",
}
PARAMETER_FILES = {name: f"config/nodes/{name}.yaml" for name in MODULES}


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


def drive_over_dds(plan: Plan, loaded: Loaded) -> Outcome:
    """Start the nodes, follow the drive, stop them, read what they left."""
    vehicle_file = str(resolve(plan.vehicle).absolute())
    common = {"vehicle_file": vehicle_file, "idle_drive": plan.idle_drive, "lockstep": not plan.realtime}
    common |= {"rate_hz": plan.rate_hz, "friction": plan.friction}
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
        follow(simulator, others, loaded.cycle.name)
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
    return {"policy_file": str(path.absolute())} if path.is_file() else {}


def _absolute(path: str) -> str:
    return str(resolve(path).absolute()) if path else ""


def follow(simulator: Child, others: Sequence[Child], name: str) -> None:
    """Show progress until the simulator ends; `ChildError` as soon as any process fails."""
    stream = simulator.process.stdout
    assert stream is not None
    os.set_blocking(stream.fileno(), False)
    pending = b""
    bar: Any = None
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


def _bar(name: str, whole_s: float) -> Any:
    return tqdm(
        desc=f"driving {name}",
        total=whole_s,
        bar_format="{desc} {percentage:3.0f}% |{bar}| {n:.0f} of {total:.0f} s, {elapsed} so far, {remaining} to go",
        mininterval=0.1 if sys.stderr.isatty() else 10.0,
        leave=False,
    )


def _progress(lines: Sequence[bytes]) -> Iterator[tuple[float, float]]:
    for line in lines:
        word, *numbers = line.split()
        if word == b"progress":
            yield float(numbers[0]), float(numbers[1])


# --- the result -----------------------------------------------------------------------------------------------------


def show(plan: Plan, loaded: Loaded, run: Run, reference: Run, remarks: list[str], outcome: Outcome) -> int:
    """Write page and JSON, print table and paths; returns the exit code."""
    params = loaded.vehicle.params
    driven = Driven(plan.strategy, _REAL_TIME if plan.realtime else _LOCK_STEP, run, metrics.measure(run, params))
    other = Driven(_REFERENCE, _ONE_PROCESS, reference, metrics.measure(reference, params))
    rows = [row(driven, other), row(other, other)]
    settings = described(plan, loaded, outcome.notes)
    page = drive_page(
        driven,
        other,
        cycle=loaded.cycle.name,
        idle_drive=loaded.vehicle.idle_drive,
        critical_slip=loaded.settings.critical_slip,
        settings=settings,
        remarks=remarks,
    )
    write_page(plan.output / "drive.html", page)
    content = json.dumps({"rows": rows, "settings": settings, "remarks": remarks}, indent=1, allow_nan=False)
    for path in filter(None, (plan.output / "result.json", plan.json)):
        files.atomic_write(path, content.encode() + b"\n")
    print()
    for line in table(rows):
        print(line)
    print()
    for remark in remarks:
        print(remark)
    if plan.record:
        print(f"bag:  {plan.output / 'bag'}")
    print(f"page: {plan.output / 'drive.html'}")
    return 0 if outcome.complete else 1


def described(plan: Plan, loaded: Loaded, notes: Mapping[str, Any]) -> dict[str, Any]:
    """What the runs were made with, for page and JSON."""
    return {
        "vehicle": f"{loaded.vehicle.name} ({loaded.vehicle.hash})",
        "idle drive": loaded.vehicle.idle_drive,
        "cycle": f"{loaded.cycle.name} ({loaded.cycle.sha256[:16]})",
        "friction of the road": plan.friction,
        "friction assumed": plan.friction,
        "state of charge at the start": plan.soc,
        "strategy": plan.strategy,
        "policy": loaded.policy_identity,
        "control rate, Hz": plan.rate_hz,
        "time": "real" if plan.realtime else "lock-step",
        "duration of the run, s": round(notes["wall_s"], 1),
        "sets sent twice": notes["resent"],
        "command time-outs": notes["command_timeouts"],
        "recorded": plan.record,
    }


def table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Lines of the table on the terminal."""
    columns = (
        ("strategy", "", lambda r: r["strategy"]),
        ("distance", "km", lambda r: shown(r["distance_km"], 3)),
        ("energy", "Wh/km", lambda r: shown(r["wh_per_km"], 2)),
        ("ΔSoC", "%", lambda r: shown(r["delta_soc_percent"], 3)),
        ("saving", "%", lambda r: shown(r["saving_percent"], 2)),
        ("speed error", "m/s rms", lambda r: shown(r["rms_speed_error_mps"], 3)),
        ("slip", "", lambda r: f"{shown(r['min_slip'], 3)}..{shown(r['max_slip'], 3)}"),
        ("share changes", "1/min", lambda r: shown(r["share_changes_per_min"], 1)),
        ("trace", "", lambda r: "held" if r["trace_held"] else "LOST"),
        ("run", "", lambda r: r["made"]),
    )
    cells = [[name for name, _, _ in columns], [unit for _, unit, _ in columns]]
    cells += [[value(r) for _, _, value in columns] for r in rows]
    widths = [max(len(line[i]) for line in cells) for i in range(len(columns))]
    left = (0, len(columns) - 1)
    lines = []
    for line in cells:
        padded = [text.ljust(widths[i]) if i in left else text.rjust(widths[i]) for i, text in enumerate(line)]
        lines.append("  ".join(padded).rstrip())
    return [*lines[:2], "-" * max(map(len, lines)), *lines[2:]]


if __name__ == "__main__":
    sys.exit(main())
