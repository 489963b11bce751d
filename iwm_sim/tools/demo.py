# SPDX-License-Identifier: Apache-2.0
"""`demo`: a whole drive over DDS in one command.

Recorder, power manager and simulator run as three processes on a DDS domain of their own, on this machine only. In
lock-step the result does not depend on how fast they are; the same drive in one process has to give the same bits, and
this command says whether it did. Equal distribution, driven in one process, stands beside it.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from iwm_power_manager.command_line import CommandParser
from iwm_power_manager.control.strategies import DEFAULT_STRATEGY, STRATEGIES, drivable
from iwm_power_manager.errors import IwmError
from iwm_power_manager.exit_codes import INTERRUPTED
from iwm_power_manager.model.parameters import IDLE_DRIVES
from iwm_power_manager.tools.command import beside_json, output_file, write_json
from iwm_power_manager.tools.options import number
from iwm_power_manager.tools.progress import show_compiling

if TYPE_CHECKING:
    from iwm_sim.dds_drive import Plan

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
    parser.add_argument(
        "--rate", dest="rate_hz", metavar="HZ", default=50.0, type=number(10.0, 1000.0), help=f"control rate {shown}"
    )
    parser.add_argument(
        "--soc", metavar="SOC", default=0.8, type=number(0.0, 1.0), help=f"state of charge at the start, 0..1 {shown}"
    )
    parser.add_argument(
        "--until",
        dest="until_s",
        metavar="S",
        default=0.0,
        type=number(0.0, 1e6),
        help="drive only its first S seconds (default: all)",
    )
    parser.add_argument("--realtime", action="store_true", help="in real time instead of lock-step")
    parser.add_argument("--no-record", dest="record", action="store_false", help="without the recorder")
    parser.add_argument(
        "--output", metavar="DIR", type=Path, help="folder for everything that is made (default: runs/<date and time>)"
    )
    parser.add_argument(
        "--json",
        metavar="FILE",
        type=output_file,
        help="also write the result's rows here; - for standard output, with nothing else there",
    )
    parser.add_argument("--animate", metavar="GIF", type=Path, help="also draw the drive as a moving picture")
    given = parser.parse_args(arguments)
    if given.animate and (given.scenario or given.animate.suffix != ".gif"):
        parser.error(f"--animate {given.animate}: draws a cycle's drive; allowed: a file that ends with .gif")
    of_cycle = dict.fromkeys(
        ("--cycle", "--vehicle", "--friction", "--soc"), (not given.scenario, "--scenario says it")
    )
    with_policy = (STRATEGIES[given.strategy].needs_policy, f"strategy {given.strategy} takes none")
    parser.check(given, of_cycle | {"--policy": with_policy})
    from iwm_sim.dds_drive import Plan  # `--help` needs no DDS

    given.output = given.output or Path("runs") / datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    return Plan(**{name: getattr(given, name) for name in Plan.__dataclass_fields__})


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demo; returns the exit code."""
    plan = parse(arguments)
    from iwm_sim.processes import ChildError
    from iwm_sim.tools.demo_run import run

    show_compiling()
    for wanted in (signal.SIGINT, signal.SIGTERM):
        signal.signal(wanted, _terminated)
    try:
        with beside_json(plan.json):
            code, content = run(plan)
        if plan.json:
            write_json(plan.json, content)
        return code
    except KeyboardInterrupt:
        what = "what was recorded" if (plan.output / "bag").is_dir() else "the log"
        kept = f"; {what} stays in {plan.output}" if plan.output.is_dir() else ""
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


if __name__ == "__main__":
    sys.exit(main())
