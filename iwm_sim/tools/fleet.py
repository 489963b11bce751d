# SPDX-License-Identifier: Apache-2.0
"""Parameter studies over fleets of cars, on this machine's cores or on a cluster: `fleet --help`.

Exit codes: 0 done; 2 bad arguments or files; 130 interrupted.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from iwm_power_manager import __version__
from iwm_power_manager.command_line import refuse_without_effect
from iwm_power_manager.control.strategies import drivable
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.model.parameters import IDLE_DRIVES
from iwm_power_manager.tools.command import described, ended, output_file, picture, write_json
from iwm_power_manager.tools.options import number, several, whole
from iwm_power_manager.tools.progress import Bar
from iwm_sim.study.names import cores

_DESCRIPTION = """\
Drive many cars over many cycles, roads and scenarios, or solve policies for them, and see the whole on one page.

A fleet is a YAML file (config/fleets/); options take the place of its keys. Rows are written to a folder as they come
(Parquet), so that a study that was stopped goes on where it was, and one that is there can grow. It runs on this
machine's cores, or with --scheduler on every worker of a dask cluster, with the same rows, bit for bit; workers whose
processor or libraries compute other numbers are refused.
"""

_EXAMPLES = """\
examples:
  The example of the package on all cores, then its page:
    fleet drive small --output runs/fleet
    fleet report runs/fleet

  Without a file: two cars that nobody chose on three drawn cycles, on two roads:
    fleet drive --vehicle generated:1000..1001 --cycle generated:1000..1002 --friction 0.9 0.3 --output runs/drawn

  Policies over friction and budget, on a cluster whose scheduler runs on host c1 (docs/scale.md says how to start it):
    fleet solve --vehicle jalalmaab_2015 --friction 0.9 0.5 0.2 --budget 4 8 --output runs/policies --scheduler tcp://c1:8786

Results go to stdout, progress to stderr. exit codes: 0 done, 2 bad arguments or files, 130 interrupted (run the same
command again to go on)
"""


def parser() -> argparse.ArgumentParser:
    """Arguments of the command."""
    result = described("fleet", _DESCRIPTION, _EXAMPLES)
    commands = result.add_subparsers(dest="command", required=True, metavar="drive | solve | report")
    for name, words in (("drive", "drive every car everywhere"), ("solve", "solve every policy, drive nothing")):
        command = commands.add_parser(name, help=words, description=_DESCRIPTION, epilog=_EXAMPLES)
        _add_fleet(command.add_argument_group("fleet (an option takes the place of the file's key)"), name)
        _add_running(command.add_argument_group("running"))
    report = commands.add_parser("report", help="one page of a study")
    report.add_argument("folder", type=Path, metavar="DIR", help="folder of a study")
    report.add_argument("--page", type=Path, metavar="HTML", help="the page (default: DIR/fleet.html)")
    report.add_argument("--picture", type=picture, metavar="PICTURE", help="its first picture: .pdf, .png or .svg")
    report.add_argument("--json", type=output_file, metavar="FILE", help="write what the page says as JSON")
    return result


def _add_fleet(group: argparse._ArgumentGroup, command: str) -> None:
    group.add_argument("file", nargs="?", metavar="YAML", help="fleet: file, or name of config/fleets (small)")
    group.add_argument("--vehicle", **several, metavar="YAML", help="cars: file, name, or generated:1000..1009")
    group.add_argument("--idle-drive", **several, choices=list(IDLE_DRIVES), metavar="NAME", help="of --vehicle")
    group.add_argument("--friction", **several, type=number(0.01, 2.0), metavar="MU", help="roads")
    group.add_argument("--budget", **several, type=number(0.1, 1e4), metavar="N", help="changes of the split a minute")
    group.add_argument("--grid", metavar="NAME|FILE", help="grid of the policies (default: coupled)")
    if command == "drive":
        group.add_argument("--cycle", **several, metavar="CSV", help="cycles: file, name, or generated:1000..1009")
        group.add_argument("--scenario", **several, metavar="YAML", help="scenarios of real roads (config/scenarios)")
        names = ", ".join(drivable())
        group.add_argument("--strategy", **several, choices=list(drivable()), metavar="NAME", help=f"of {names}")


def _add_running(group: argparse._ArgumentGroup) -> None:
    group.add_argument("--output", required=True, type=Path, metavar="DIR", help="folder of the study, new or begun")
    group.add_argument("--scheduler", metavar="ADDRESS", help="of a running dask scheduler, tcp://HOST:8786")
    group.add_argument(
        "--jobs",
        type=whole(1, 256),
        default=cores(),
        metavar="N",
        help="processes on this machine without --scheduler; 1 stays in this one (default: all cores)",
    )
    group.add_argument(
        "--batch", type=number(0.0, 3600.0), default=2.0, metavar="S", help="seconds of work sent at once (default: 2)"
    )
    group.add_argument("--json", type=output_file, metavar="FILE", help="write what was done as JSON")
    group.add_argument("--quiet", action="store_true", help="no progress and no summary")


#: Options, and the keys of the file they take the place of.
_KEYS = {"friction": "friction", "budget": "budgets", "grid": "grid", "cycle": "cycles", "scenario": "scenarios"}
_KEYS |= {"strategy": "strategies"}


def _given(options: argparse.Namespace) -> dict[str, Any]:
    given = {key: value for name, key in _KEYS.items() if (value := getattr(options, name, None))}
    if options.vehicle:
        drives = {"idle_drive": options.idle_drive} if options.idle_drive else {}
        given["cars"] = [{"vehicle": options.vehicle} | drives]
    elif not options.file:
        raise ConfigError("arguments", "", "names no fleet", "a YAML file, or --vehicle")
    return given


def _run(options: argparse.Namespace) -> None:
    """Solve what is needed, then drive."""
    from iwm_sim.fleet.plan import load_plan, needed

    plan = load_plan(options.file, _given(options))  # first: a name that is misspelled needs no library
    _check_libraries()
    from iwm_sim.fleet.run import runner
    from iwm_sim.fleet.store import Store
    from iwm_sim.fleet.task import Drive, Road, Solve
    from iwm_sim.study.driving import silent, tell
    from iwm_sim.tools.precompile import compile_for_a_drive

    parts: list[tuple[type[Any], Sequence[Any]]] = [(Solve, plan.solves)]
    if options.command == "drive":
        if not plan.drives and not plan.roads:
            raise ConfigError(options.file or "arguments", "cycles", "is missing", "cycles or scenarios to drive")
        parts = [(Solve, needed(plan)), (Drive, plan.drives), (Road, plan.roads)]
    _check_options(options, bool(parts[0][1]), any(case.policy for drive in plan.drives for case in drive.cases))
    say: Callable[[str], None] = silent if options.quiet else tell
    store = Store(options.output)
    made = {}
    if plan.drives and not options.scheduler:
        compile_for_a_drive()
    with runner(store, plan.files, options.scheduler, options.jobs, options.batch) as running:
        running.check_workers(say)
        for kind, tasks in parts:
            with Bar(len(tasks), "tasks", kind.__name__.lower(), quiet=options.quiet or not tasks) as bar:
                made[kind.__name__.lower()] = running.run(kind, tasks, bar.update)
    if not options.quiet:
        for name, summary in made.items():
            if summary.tasks:
                rate = f": {summary.cpu_s:.1f} s of processor in {summary.wall_s:.1f} s" if summary.batches else ""
                print(f"{name}: {summary.tasks} tasks, {summary.known} known before, {summary.batches} batches{rate}")
        print(f"study: {options.output}; its page: fleet report {options.output}")
    if options.json:
        write_json(options.json, {"package_version": __version__, **made})


def _check_options(options: argparse.Namespace, solves: bool, drives_policies: bool) -> None:
    """Refuse what changes nothing: whether policies are solved, and whether cycles are driven with them, is known."""
    of_no_policy = "no strategy here takes a policy"
    alone = options.command == "solve"
    refuse_without_effect(
        options,
        {
            "--idle-drive": (options.vehicle, "it is for --vehicle; a fleet file says it for its own cars"),
            "--jobs": (not options.scheduler, "the workers of --scheduler are used"),
            "--grid": (solves, of_no_policy),
            "--budget": (alone or drives_policies, f"{of_no_policy} on a cycle"),
            "--friction": (alone or drives_policies or options.cycle or options.file, "scenarios have their own"),
        },
    )


def _report(options: argparse.Namespace) -> None:
    _check_libraries()
    from iwm_sim.fleet import report

    report.make(options.folder, options.page or options.folder / "fleet.html", options.picture, options.json)


def _check_libraries() -> None:
    for name in ("distributed", "pyarrow"):
        try:
            importlib.import_module(name)
        except ImportError:
            raise ConfigError(name, "", "is not installed", "pip install distributed pyarrow") from None


def _work(options: argparse.Namespace) -> None:
    (_report if options.command == "report" else _run)(options)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    options = parser().parse_args(argv)
    options.quiet = getattr(options, "quiet", False) or options.json == "-"  # nothing else in what a program is to read
    return ended("fleet", lambda: _work(options), quiet=options.quiet)


if __name__ == "__main__":
    sys.exit(main())
