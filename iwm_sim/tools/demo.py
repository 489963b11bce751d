# SPDX-License-Identifier: Apache-2.0
"""`demo`: a whole drive over DDS in one command.

Recorder, power manager and simulator run as three processes on a DDS domain of their own, on this machine only. In
lock-step the result does not depend on how fast they are; the same drive in one process has to give the same bits, and
this command says whether it did. Equal distribution, driven in one process, stands beside it.
"""

from __future__ import annotations

import dataclasses
import json
import signal
import sys
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from iwm_power_manager import files
from iwm_power_manager.command_line import CommandParser
from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.control.strategies import DEFAULT_STRATEGY, STRATEGIES, drivable
from iwm_power_manager.errors import ConfigError, IwmError
from iwm_power_manager.exit_codes import DONE, FAILED, INTERRUPTED
from iwm_power_manager.model.parameters import IDLE_DRIVES
from iwm_power_manager.tools import command
from iwm_power_manager.tools.options import number
from iwm_power_manager.tools.progress import show_compiling
from iwm_sim import metrics
from iwm_sim.closed_loop import Run
from iwm_sim.dds_drive import REFERENCE, Loaded, Outcome, Plan, closed_loop_run, compare, drive_over_dds, load
from iwm_sim.processes import ChildError
from iwm_sim.road_report import text
from iwm_sim.road_run import checked_run
from iwm_sim.scenario import load_scenario
from iwm_sim.study.drive_page import COLUMNS, Driven, drive_page, row
from iwm_sim.study.report import write_page
from iwm_sim.study.tables import plain_table, screen
from iwm_sim.tools.precompile import compile_for_a_drive

_LOCK_STEP = "over DDS"
_REAL_TIME = "in real time"
_ONE_PROCESS = "one process"


# --- command line ---------------------------------------------------------------------------------------------------


_EXAMPLES = """\
examples:
  The New York City Cycle as fast as it goes (a minute), recorded; the page is runs/nycc/drive.html:
    demo --output runs/nycc
  Your car, policies and commute; its first half minute only:
    demo --vehicle my_car.yaml --policy my_policies --cycle my_commute.csv --until 30
  A full brake with one side on ice:
    demo --scenario split_stop
  The drive as a moving picture:
    demo --output runs/nycc --animate nycc.gif

exit codes: 0 driven, 1 failed, 2 bad arguments or files, 130 interrupted
"""


def parse(arguments: Sequence[str] | None = None) -> Plan:
    """The plan of a command line; ends the program on a wrong one."""
    parser = CommandParser(
        "demo",
        description="Drive a cycle over DDS with recorder, power manager and simulator, and show the result.",
        epilog=_EXAMPLES,
    )
    shown = "(default: %(default)s)"
    parser.add_argument(
        "--cycle", metavar="CSV", default="config/cycles/nycc.csv", help=f"drive cycle: time_s,speed_mps {shown}"
    )
    parser.add_argument(
        "--scenario", default="", metavar="YAML", help="scenario instead of cycle, vehicle, friction and charge"
    )
    parser.add_argument(
        "--vehicle", metavar="YAML", default="config/vehicles/jalalmaab_2015.yaml", help=f"the car {shown}"
    )
    parser.add_argument(
        "--policy", metavar="DIR|FILE", default="policies", help=f"policy file, or folder with a bank of them {shown}"
    )
    parser.add_argument(
        "--strategy",
        metavar="NAME",
        default=DEFAULT_STRATEGY,
        choices=drivable(),
        help=f"how the power manager splits the demand: {', '.join(drivable())} {shown}",
    )
    parser.add_argument(
        "--friction", metavar="MU", default=0.9, type=number(0.05, 1.5), help=f"peak friction coefficient {shown}"
    )
    parser.add_argument(
        "--idle-drive",
        metavar="NAME",
        default="",
        choices=["", *IDLE_DRIVES],
        help=f"what a motor at zero torque costs: {', '.join(IDLE_DRIVES)} (default: as the car's file says)",
    )
    parser.add_argument("--rate", metavar="HZ", default=50.0, type=number(10.0, 1000.0), help=f"control rate {shown}")
    parser.add_argument(
        "--soc", metavar="SOC", default=0.8, type=number(0.0, 1.0), help=f"state of charge at the start, 0..1 {shown}"
    )
    parser.add_argument(
        "--until", metavar="S", default=0.0, type=number(0.0, 1e6), help="drive only its first S seconds (default: all)"
    )
    parser.add_argument("--realtime", action="store_true", help="in real time instead of lock-step")
    parser.add_argument("--no-record", action="store_true", help="without the recorder")
    parser.add_argument(
        "--output", metavar="DIR", type=Path, help="folder for everything that is made (default: runs/<date and time>)"
    )
    parser.add_argument("--json", metavar="FILE", type=Path, help="also write the result's rows here")
    parser.add_argument("--animate", metavar="GIF", type=Path, help="also draw the drive as a moving picture")
    given = parser.parse_args(arguments)
    if given.animate and (given.scenario or given.animate.suffix != ".gif"):
        parser.error(f"--animate {given.animate}: draws a cycle's drive; allowed: a file that ends with .gif")
    of_cycle = dict.fromkeys(
        ("--cycle", "--vehicle", "--friction", "--soc"), (not given.scenario, "--scenario says it")
    )
    with_policy = (STRATEGIES[given.strategy].needs_policy, f"strategy {given.strategy} takes none")
    parser.check(given, of_cycle | {"--policy": with_policy})
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
        scenario=given.scenario,
        animate=given.animate,
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demo; returns the exit code."""
    plan = parse(arguments)
    show_compiling()
    for wanted in (signal.SIGINT, signal.SIGTERM):
        signal.signal(wanted, _terminated)
    try:
        return run(plan)
    except KeyboardInterrupt:
        kept = f"; what was recorded stays in {plan.output}" if plan.output.is_dir() else ""
        print(f"\ndemo: stopped; all processes have ended{kept}", file=sys.stderr)
        return INTERRUPTED
    except IwmError as error:
        last_lines = error.last_lines if isinstance(error, ChildError) else []
        print(f"demo: {error}{'; its last lines:' if last_lines else ''}", file=sys.stderr)
        for line in last_lines:
            print(f"    {line}", file=sys.stderr)
        return error.exit_code


def _terminated(_number: int, _frame: Any) -> NoReturn:
    raise KeyboardInterrupt


# --- the run --------------------------------------------------------------------------------------------------------


def run(plan: Plan) -> int:
    """Do all of it; returns the exit code: `FAILED` if the bag lacks anything that was published."""
    if plan.scenario:
        return run_scenario(plan)
    loaded = load(plan)
    _make_output(plan)
    vehicle = loaded.vehicle
    print(f"{vehicle.name} on {loaded.cycle.name}, friction {plan.friction:g}, idle drive {vehicle.idle_drive}")
    compile_for_a_drive()
    alone = closed_loop_run(plan, loaded)
    reference = closed_loop_run(plan, loaded, equal=True)

    outcome = drive_over_dds(plan, loaded.cycle.name)
    remarks = outcome.remarks
    driven_run = outcome.run
    if not plan.realtime:
        same, remark = compare(driven_run, alone)
        remarks = [*remarks, remark]
        if same and np.isnan(driven_run["decided_share"]).all():
            driven_run = alone  # without a bag, the law's decisions of the identical run
    return show(plan, loaded, driven_run, reference, remarks, outcome)


def run_scenario(plan: Plan) -> int:
    """Drive a scenario over DDS and say what it requires; the exit code is `FAILED` if that or the bag falls short."""
    scenario = load_scenario(plan.scenario, plan.idle_drive or None)
    plan = dataclasses.replace(plan, vehicle=str(scenario.vehicle.path), friction=scenario.told_friction)
    load(plan)
    _make_output(plan)
    print(f"{scenario.name}: {scenario.about}")
    compile_for_a_drive()
    outcome = drive_over_dds(plan, scenario.name)
    result = checked_run(scenario, outcome.run, default_settings(plan.strategy))
    print(f"\n{text(result)}")
    for remark in outcome.remarks:
        print(remark)
    if plan.json:
        files.atomic_write(plan.json, json.dumps(result.values, indent=1).encode() + b"\n")
    return DONE if outcome.complete and result.passed else FAILED


def _make_output(plan: Plan) -> None:
    try:
        (plan.output / "log").mkdir(parents=True)
    except OSError as error:
        raise ConfigError(
            plan.output, "", f"cannot be created: {error.strerror}", "a folder that is not there yet"
        ) from None


# --- the result -----------------------------------------------------------------------------------------------------


def show(plan: Plan, loaded: Loaded, run: Run, reference: Run, remarks: list[str], outcome: Outcome) -> int:
    """Write page and JSON, print table and paths; returns the exit code."""
    params = loaded.vehicle.params
    driven = Driven(plan.strategy, _REAL_TIME if plan.realtime else _LOCK_STEP, run, metrics.measure(run, params))
    other = Driven(REFERENCE, _ONE_PROCESS, reference, metrics.measure(reference, params))
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
    content = {"rows": [made.to_json() for made in rows], "settings": settings, "remarks": remarks}
    stored = json.dumps(content, indent=1, allow_nan=False).encode() + b"\n"
    for path in filter(None, (plan.output / "result.json", plan.json)):
        files.atomic_write(path, stored)
    print(f"\n{plain_table(rows, COLUMNS, screen())}\n\n{made_with(plan, loaded)}")
    for remark in remarks:
        print(remark)
    if plan.record:
        print(f"bag:  {plan.output / 'bag'}")
    print(f"page: {plan.output / 'drive.html'}")
    if plan.animate:
        from iwm_sim.study.moving_picture import animate

        animate(
            run,
            plan.animate,
            f"{loaded.cycle.name}, friction {plan.friction:g}, idle drive {loaded.vehicle.idle_drive}, {plan.strategy}",
        )
        print(f"moving picture: {plan.animate}")
    return DONE if outcome.complete else FAILED


def made_with(plan: Plan, loaded: Loaded) -> str:
    """What the numbers depend on, in a line."""
    law = (plan.rate_hz, loaded.settings.decision_period_s, [loaded.policy_identity])
    return command.made_with(f"{plan.friction:g}", loaded.vehicle.idle_drive, *law)


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


if __name__ == "__main__":
    sys.exit(main())
