# SPDX-License-Identifier: Apache-2.0
"""Learn a policy from recorded driving, and keep it only if it is no worse: `learn_policy --help`.

Exit codes: 0 done; 2 bad arguments or files; 130 interrupted.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from iwm_power_manager import __version__
from iwm_power_manager.command_line import Written, refuse_without_effect
from iwm_power_manager.control.settings import DEFAULTS
from iwm_power_manager.cycle import load_cycle
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.files import check_number
from iwm_power_manager.mdp.demand import source_of
from iwm_power_manager.model.parameters import IDLE_DRIVES
from iwm_power_manager.policy import save_policy
from iwm_power_manager.replay.recorded import read_drives
from iwm_power_manager.share import resolve
from iwm_power_manager.solve import load_grid, targets
from iwm_power_manager.tools.command import described, doubts, ended, made_with, note_replaced, output_file, write_json
from iwm_power_manager.tools.options import several, whole
from iwm_power_manager.tools.progress import Bar
from iwm_power_manager.vehicle import load_vehicle
from iwm_sim.learning import (
    BANDWIDTHS,
    CHANCE_PERCENT,
    CYCLES,
    CYCLES_ALONE,
    RECORDING_ALONE,
    WEIGHTS,
    Candidate,
    Learned,
    Outcome,
    Task,
    best_of_each_weight,
    candidates_of,
    learn,
    recorded_cycle,
)
from iwm_sim.study.names import cores

_DESCRIPTION = """\
Learn a policy from recorded driving, and keep it only if it is no worse than one of standard cycles.

Policies are solved from the recorded drives alone and beside the cycles, a recorded second counting as much as several
seconds of a cycle, or as a part of one, and with steps of the demand taken together over more or less speed. Each of
them drives the recorded speed in simulation. Of those that need no more energy than the cycles' own policy, the one
with the least cost is written: energy, and the price of moving the split, which is what policies are solved for.
If none costs at least 0.01 % less than the cycles' policy, that one is written: smaller differences are chance, a
change of the split a moment sooner or later.
"""

_EXAMPLES = """\
examples:
  From two recorded drives, for a dry and a wet road:
    learn_policy --vehicle my_car.yaml --bag drive_1 drive_2 --friction 0.9 0.5 --output my_policies/

  Bags of another project; what they have to prove themselves on is a cycle:
    learn_policy --vehicle my_car.yaml --bag drive_1 --mapping my_topics.yaml --drive my_commute.csv \\
                 --friction 0.9 --output my_policies/

A bag knows no grade: a recorded speed is driven on the flat. With all weights and bandwidths 17 policies are
solved and driven on each road; after the first, the command says how long that will take. Results go to stdout,
progress to stderr.

exit codes: 0 done, 2 bad arguments or files, 130 interrupted
"""


def parser() -> argparse.ArgumentParser:
    """Arguments of the command."""
    result = described("learn_policy", _DESCRIPTION, _EXAMPLES)
    result.add_argument("--vehicle", required=True, metavar="FILE", help="car, YAML (config/vehicles/)")
    result.add_argument("--bag", **several, required=True, metavar="BAG", help="recorded drives")
    result.add_argument("--friction", nargs="+", type=float, required=True, metavar="MU", help="one policy each")
    result.add_argument(
        "--output", type=Written, required=True, metavar="DIR|FILE", help="folder, or a .npz file for a single one"
    )
    result.add_argument("--mapping", metavar="YAML", help="topics and units of foreign bags (config/signals/)")
    result.add_argument(
        "--cycle", **several, metavar="CSV", help=f"cycles beside the bags (default: {', '.join(CYCLES)})"
    )
    result.add_argument(
        "--drive", **several, metavar="CSV", help="cycles to prove themselves on (default: the recorded speed)"
    )
    result.add_argument(
        "--weights",
        nargs="+",
        type=float,
        default=list(WEIGHTS),
        metavar="W",
        help="a recorded second counts as W seconds of a cycle; inf: the bags alone, 0: the cycles alone, to see what "
        "the other two do without a bag "
        f"(default: {' '.join(f'{weight:g}' for weight in WEIGHTS)})",
    )
    result.add_argument(
        "--bandwidths",
        nargs="+",
        type=float,
        default=list(BANDWIDTHS),
        metavar="B",
        help="a step of the demand counts for speeds around its own, B times as far as the grid's speed_bandwidth_mps "
        f"(default: {' '.join(f'{bandwidth:g}' for bandwidth in BANDWIDTHS)})",
    )
    result.add_argument("--grid", default="coupled", metavar="NAME|FILE", help="grid (default: %(default)s)")
    result.add_argument("--idle-drive", choices=sorted(IDLE_DRIVES), help="replaces the car's idle_drive")
    result.add_argument(
        "--jobs", type=whole(1, 1024), default=cores(), metavar="N", help="processes (default: one for each core)"
    )
    result.add_argument("--json", type=output_file, metavar="FILE", help="write the numbers, too")
    result.add_argument("--quiet", action="store_true", help="print errors and warnings only")
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = parser().parse_args(arguments)
    options.quiet |= options.json == "-"  # nothing else in what another program is to read
    return ended("learn_policy", lambda: _learn(options), options.output, quiet=options.quiet)


def _learn(options: argparse.Namespace) -> None:
    _check(options)
    vehicle = load_vehicle(resolve(options.vehicle), options.idle_drive)
    problem = load_grid(options.grid, vehicle.params)
    refuse_without_effect(
        options, {"--bandwidths": (problem.demand_by_speed, f"grid {problem.name} has one demand for all speeds")}
    )
    frictions = [check_number("arguments", "--friction", value, 0.01, 2.0) for value in options.friction]
    paths = targets(Path(options.output), vehicle, problem, frictions)
    general = tuple(source_of(load_cycle(resolve(name)), problem, vehicle.params) for name in options.cycle or CYCLES)
    recordings = read_drives(options.bag, options.mapping, vehicle, "learn_policy")
    recorded = tuple(drive.source(name, problem, 1.0) for name, drive in recordings)
    drives = tuple(
        [load_cycle(resolve(name)) for name in options.drive]
        if options.drive
        else [recorded_cycle(name, drive) for name, drive in recordings]
    )
    given = [load_cycle(resolve(name)) for name in dict.fromkeys([*(options.cycle or ()), *(options.drive or ())])]
    missed = [f"warning: {drive.gap}" for drive in ([] if options.drive else drives) if drive.gap]
    for line in (*doubts(vehicle, given, frictions), *missed):
        print(f"learn_policy: {line}", file=sys.stderr)
    note_replaced(*paths)
    candidates = candidates_of(problem, options.weights, options.bandwidths)
    roads = []
    for friction, path in zip(frictions, paths, strict=True):
        with tempfile.TemporaryDirectory(prefix="iwm-learn-") as folder:
            task = Task(problem, vehicle, friction, recorded, general, drives, folder)
            learned = _tried(task, candidates, options.jobs, options.quiet)
        save_policy(learned.policy, path)
        if not options.quiet:
            print(_text(task, learned, path))
        roads.append(
            {
                "friction": friction,
                "policy": str(path),
                "checksum": learned.policy.checksum,
                "chosen_weight": _named(learned.chosen.candidate.weight),
                "chosen_bandwidth": learned.chosen.candidate.bandwidth,
                "equal": _row(learned.equal),
                "outcomes": [_row(outcome) for outcome in learned.outcomes],
            }
        )
    if options.json:
        content = {"package_version": __version__, "idle_drive": vehicle.idle_drive, "roads": roads}
        write_json(options.json, content)


def _check(options: argparse.Namespace) -> None:
    for weight in options.weights:
        if not weight >= 0.0:
            raise ConfigError("arguments", "--weights", f"{weight:g} is out of range", "0 or more, inf included")
    for value in options.bandwidths:
        if not 0.0 < value < math.inf:
            raise ConfigError("arguments", "--bandwidths", f"{value:g} is out of range", "above 0 and finite")


def _tried(task: Task, candidates: Sequence[Candidate], jobs: int, quiet: bool) -> Learned:
    """Try candidates with a bar, and say after the first how long all of them will take."""
    with Bar(len(candidates), "policies", f"friction {task.friction:g}", quiet=quiet) as bar:
        return learn(task, candidates, jobs, _announcing(bar, len(candidates), jobs, quiet))


def _announcing(bar: Bar, count: int, jobs: int, quiet: bool) -> Callable[[Outcome], None]:
    started = time.perf_counter()

    def done(_: Outcome) -> None:
        if bar.n == 0 and not quiet:
            took_s = time.perf_counter() - started
            whole_min = took_s * (1 + (count - 1) / jobs) / 60.0
            bar.write(f"{count} policies are solved and driven; by the first, about {whole_min:.1f} min", sys.stderr)
        bar.update()

    return done


def _named(number: float) -> float | str | None:
    """A weight as JSON has it, which knows no infinite numbers; null where there is none."""
    if math.isnan(number):
        return None
    return "inf" if math.isinf(number) else number


def _row(outcome: Outcome) -> dict[str, float | str | bool | None]:
    measured = {name: value for name, value in outcome._asdict().items() if name != "candidate"}
    solved = {name: _named(value) for name, value in outcome.candidate._asdict().items()}
    return {**solved, **measured, "cost_wh_per_km": outcome.cost_wh_per_km}


def _text(task: Task, learned: Learned, path: Path) -> str:
    drives = ", ".join(f"{cycle.name} ({cycle.duration_s:.0f} s)" for cycle in task.drives)
    equal_wh = learned.equal.energy_wh_per_km
    how = made_with(f"{task.friction:g}", task.vehicle.idle_drive, 100.0, DEFAULTS.decision_period_s)
    lines = [
        f"{how}; driven: {drives}",
        f"equal split: {equal_wh:.2f} Wh/km; saved by policies, %:",
        "recorded second counts as   bandwidth   energy   with price of moves   changes/min   trace",
    ]
    for outcome in best_of_each_weight(learned.outcomes):
        saved = 100.0 * (1.0 - outcome.energy_wh_per_km / equal_wh)
        net = saved - 100.0 * outcome.moves_wh_per_km / equal_wh
        lines.append(
            f"{_weight_text(outcome.candidate.weight):<27} "
            f"{outcome.candidate.bandwidth:9.2f}  {saved:7.3f}   {net:19.3f}   "
            f"{outcome.changes_per_min:11.1f}   "
            f"{'held' if outcome.trace_held else 'left'}{'   <- chosen' if outcome is learned.chosen else ''}"
        )
    if learned.chosen.candidate.weight == CYCLES_ALONE:
        lines.append(
            f"the recorded drives teach nothing that is worth more than {CHANCE_PERCENT:g} %, which is chance; the "
            "policy is that of the cycles"
        )
    return "\n".join([*lines, f"policy: {path} (grid {task.problem.name}, {learned.policy.checksum[:12]})", ""])


def _weight_text(weight: float) -> str:
    if weight == CYCLES_ALONE:
        return "nothing: cycles alone"
    if weight == RECORDING_ALONE:
        return "all: recorded drives alone"
    return f"{weight:g} s of a cycle"


if __name__ == "__main__":
    sys.exit(main())
