"""Learn a policy from recorded driving, and keep it only if it is no worse: `learn_policy --help`.

Ten minutes of driving do not fill a transition matrix, and the driver's demand is no Markov chain. So how much a
recording should count beside standard cycles, how far around its speed a step of it should, and how dear a move should
be to a solver that does not know the driver's next one, cannot be told from the data alone; but it can be tried.
Policies are solved with the recorded drive at several weights, bandwidths and prices, and each drives what was recorded
in the closed loop. Of those that need no more energy than the policy of the cycles alone, the one that costs least of
what the solver minimizes, energy and the true price of moving the split, is written; if that is no less than what the
cycles' policy costs, theirs is. (Laroche et al. 2019,
*Safe policy improvement with baseline bootstrapping*, fall back on a baseline where data are few; here, as a whole.)

Exit codes: 0 done; 2 bad arguments or files; 130 interrupted.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import math
import sys
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

from iwm_power_manager import __version__
from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.control.table import PolicyTable, empty_table
from iwm_power_manager.cycle import Cycle, load_cycle, make_cycle
from iwm_power_manager.errors import ConfigError, IwmError
from iwm_power_manager.files import atomic_write, check_number
from iwm_power_manager.mdp.demand import Source, chain_of, source_of
from iwm_power_manager.mdp.problem import Problem
from iwm_power_manager.model.parameters import IDLE_DRIVES
from iwm_power_manager.policy import Policy, load_policy, save_policy
from iwm_power_manager.share import resolve
from iwm_power_manager.signals.recorded import RecordedDrive
from iwm_power_manager.tools.solve_policy import drive_source, load_grid, read_drives, solve_one, targets
from iwm_power_manager.vehicle import Vehicle, load_vehicle
from iwm_sim import closed_loop
from iwm_sim.metrics import measure
from iwm_sim.study.driving import cores, on_all_cores

DONE, BAD_INPUT, INTERRUPTED = 0, 2, 130

#: Weights of a recorded second beside a second of a cycle. 0: the cycles alone; infinite: the recording alone.
CYCLES_ALONE, RECORDING_ALONE = 0.0, math.inf
WEIGHTS = (0.05, 0.2, 0.5, 1.0, 2.0, 5.0, 20.0, RECORDING_ALONE)
#: What a move costs the solver, of its true price. Only the true one is judged by.
PRICES = (0.8, 0.9, 0.97, 1.0, 1.1)
#: Of the grid's bandwidth in speed, over which steps of the demand are taken together.
BANDWIDTHS = (1.0, 1.3)
CYCLES = ("ftp75", "hwfet", "nycc")
#: A recorded speed is followed from second to second, like a standard cycle: noise is no wish of the driver's.
_TRACE_STEP_S = 1.0

_DESCRIPTION = """\
Learn a policy from recorded driving, and keep it only if it is no worse than one of standard cycles.

Policies are solved from the recorded drives alone and beside the cycles, a recorded second counting as much as several
seconds of a cycle, or as a part of one, with steps of the demand taken together over more or less speed, and with moves
of the split a little cheaper or dearer than they are. Each of them drives the recorded speed in simulation. Of those
that need no more energy than the cycles' own policy, the one with the least cost is written: energy, and the true price
of moving the split, which is what policies are solved for.
If none costs less than the cycles' policy, that one is written.
"""

_EXAMPLES = """\
examples:
  From two recorded drives, for a dry and a wet road:
    learn_policy --vehicle my_car.yaml --bag drive_1 --bag drive_2 --friction 0.9 0.5 --output my_policies/

  Bags of another project; what they have to prove themselves on is a cycle:
    learn_policy --vehicle my_car.yaml --bag drive_1 --mapping my_topics.yaml --drive my_commute.csv \\
                 --friction 0.9 --output my_policies/

A bag knows no grade: a recorded speed is driven on the flat. Differences of less than 0.01 % are chance: a change of
the split a moment sooner or later. Results go to stdout, progress to stderr.

exit codes: 0 done, 2 bad arguments or files, 130 interrupted
"""


class Candidate(NamedTuple):
    """How a policy is solved.

    Attributes
    ----------
    weight : of a recorded second beside a second of a cycle
    price : of a move in the solver, as a multiple of the true one
    bandwidth : in speed, as a multiple of the grid's
    """

    weight: float
    price: float
    bandwidth: float


#: The policy that every other one is held against.
BASELINE = Candidate(CYCLES_ALONE, 1.0, 1.0)
_NOT_SOLVED = Candidate(math.nan, math.nan, math.nan)


class Outcome(NamedTuple):
    """What a policy cost on the drives, all of them together.

    Attributes
    ----------
    candidate : how it was solved
    energy_wh_per_km : out of the cells
    moves_wh_per_km : true price of moving the split, in the same unit
    changes_per_min : changes of the split that count
    trace_held : on every drive
    """

    candidate: Candidate
    energy_wh_per_km: float
    moves_wh_per_km: float
    changes_per_min: float
    trace_held: bool

    @property
    def cost_wh_per_km(self) -> float:
        """What the solver minimizes."""
        return self.energy_wh_per_km + self.moves_wh_per_km


class Task(NamedTuple):
    """All that is needed to solve and drive a candidate."""

    problem: Problem
    vehicle: Vehicle
    friction: float
    recorded: tuple[Source, ...]
    general: tuple[Source, ...]
    drives: tuple[Cycle, ...]
    folder: str


def recorded_cycle(name: str, drive: RecordedDrive) -> Cycle:
    """The recorded speed as a cycle, a point a second, each the mean of the second around it.

    Raises
    ------
    ConfigError
        The recording is shorter than two seconds.
    """
    whole = math.floor(float(drive.time_s[-1] - drive.time_s[0]) / _TRACE_STEP_S)
    if whole < 2:
        raise ConfigError(name, "", "is too short to be driven", "2 s or more")
    time = np.arange(whole + 1) * _TRACE_STEP_S
    # Exact means of a signal that is linear between its samples: differences of its integral.
    speed = np.maximum(drive.speed_mps, 0.0)
    since = drive.time_s - drive.time_s[0]
    integral = np.concatenate([[0.0], np.cumsum(np.diff(since) * 0.5 * (speed[1:] + speed[:-1]))])
    first, last = np.maximum(time - 0.5 * _TRACE_STEP_S, 0.0), np.minimum(time + 0.5 * _TRACE_STEP_S, since[-1])
    mean = (np.interp(last, since, integral) - np.interp(first, since, integral)) / (last - first)
    return make_cycle(name, time, mean)


def sources_at(weight: float, recorded: Sequence[Source], general: Sequence[Source]) -> list[Source]:
    """Sources of the demand with the recording at a weight."""
    if weight == CYCLES_ALONE:
        return list(general)
    if weight == RECORDING_ALONE:
        return list(recorded)
    return [dataclasses.replace(source, weight=weight) for source in recorded] + list(general)


def varied(problem: Problem, candidate: Candidate) -> Problem:
    """The problem with moves at a multiple of their price, and a multiple of the bandwidth."""
    price = candidate.price
    by_friction = tuple((friction, cost_j * price) for friction, cost_j in problem.switching_cost_by_friction)
    return dataclasses.replace(
        problem,
        switching_cost_j=problem.switching_cost_j * price,
        switching_cost_by_friction=by_friction,
        speed_bandwidth_mps=problem.speed_bandwidth_mps * candidate.bandwidth,
    )


def policy_path(folder: str, candidate: Candidate) -> Path:
    """Where the policy of a candidate is while it is tried; every one has a file of its own."""
    return Path(folder) / ("_".join(f"{name}_{value}" for name, value in candidate._asdict().items()) + ".npz")


def try_candidate(candidate: Candidate, task: Task) -> Outcome:
    """Solve, and drive."""
    problem = varied(task.problem, candidate)
    sources = sources_at(candidate.weight, task.recorded, task.general)
    chain = chain_of(problem, sources)
    path = policy_path(task.folder, candidate)
    solved = solve_one(problem, task.vehicle, task.friction, chain, sources, path)
    true_price_j = task.problem.on_road(task.friction).switching_cost_j
    return drive_all(candidate, "sdp_lookahead", solved.policy.table(), true_price_j, task)


def drive_all(candidate: Candidate, strategy: str, table: PolicyTable, price_j: float, task: Task) -> Outcome:
    """Drive every drive with a strategy."""
    energy_wh = moves_wh = distance_m = minutes = changes = 0.0
    held = True
    for cycle in task.drives:
        run = closed_loop.run(cycle, task.vehicle, default_settings(strategy), table, task.friction)
        found = measure(run, task.vehicle.params)
        lasted_min = run.series.shape[0] * run.dt_s / 60.0
        energy_wh += found.energy_wh
        moves_wh += price_j * found.share_travel_per_min * lasted_min / 3600.0
        distance_m += found.distance_m
        minutes += lasted_min
        changes += found.share_changes_per_min * lasted_min
        held = held and found.trace_held
    if distance_m <= 0.0:
        raise ConfigError(", ".join(cycle.source for cycle in task.drives), "", "the car does not move")
    per_km = 1000.0 / distance_m
    return Outcome(candidate, energy_wh * per_km, moves_wh * per_km, changes / minutes, held)


def choose(outcomes: Sequence[Outcome]) -> Outcome:
    """The least cost of those that need no more energy than the cycles' and hold the trace; else the cycles'.

    Parameters
    ----------
    outcomes : one of them of `BASELINE`
    """
    (safe,) = (outcome for outcome in outcomes if outcome.candidate == BASELINE)
    # Energy that was saved by not following the trace is no saving.
    fair = [
        outcome
        for outcome in outcomes
        if outcome.energy_wh_per_km <= safe.energy_wh_per_km and (outcome.trace_held or not safe.trace_held)
    ]
    best = min(fair, key=lambda outcome: outcome.cost_wh_per_km)
    return best if best.cost_wh_per_km < safe.cost_wh_per_km else safe


def candidates_of(
    problem: Problem, weights: Sequence[float], prices: Sequence[float], bandwidths: Sequence[float]
) -> list[Candidate]:
    """Give the baseline, and then every weight from the smallest to the greatest, with every price and bandwidth."""
    if not problem.demand_by_speed:
        bandwidths = (1.0,)
    product = itertools.product(*(sorted(set(values)) for values in (weights, prices, bandwidths)))
    return [BASELINE, *(candidate for values in product if (candidate := Candidate(*values)) != BASELINE)]


def learn(
    task: Task, candidates: Sequence[Candidate], jobs: int, quiet: bool
) -> tuple[Outcome, list[Outcome], Outcome, Policy]:
    """Try candidates, the baseline first, on one road.

    Returns
    -------
    equal split; what each candidate cost; the chosen one of these; its policy
    """
    order = list(candidates)
    with tqdm(
        total=len(order), desc=f"friction {task.friction:g}", unit="policy", file=sys.stderr, disable=quiet, leave=False
    ) as bar:
        equal = drive_all(_NOT_SOLVED, "equal", empty_table(), 0.0, task)
        # The first one in this process: what it compiles, the others find in the cache.
        outcomes = [try_candidate(order[0], task)]
        bar.update()

        def done(_: Outcome) -> None:
            bar.update()

        outcomes += on_all_cores(partial(try_candidate, task=task), order[1:], jobs, done)
    chosen = choose(outcomes)
    policy = load_policy(policy_path(task.folder, chosen.candidate))
    return equal, outcomes, chosen, policy


def parser() -> argparse.ArgumentParser:
    """Arguments of the command."""
    result = argparse.ArgumentParser(
        prog="learn_policy",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    result.add_argument("--vehicle", required=True, metavar="FILE", help="car, YAML (config/vehicles/)")
    result.add_argument("--bag", action="append", required=True, metavar="BAG", help="recorded drive; repeat for more")
    result.add_argument("--friction", nargs="+", type=float, required=True, metavar="MU", help="one policy each")
    result.add_argument("--output", required=True, metavar="DIR|FILE", help="folder, or a .npz file for a single one")
    result.add_argument("--mapping", metavar="YAML", help="topics and units of foreign bags (config/bags/)")
    result.add_argument(
        "--cycle", action="append", metavar="CSV", help=f"cycles beside the bags (default: {', '.join(CYCLES)})"
    )
    result.add_argument(
        "--drive", action="append", metavar="CSV", help="cycles to prove themselves on (default: the recorded speed)"
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
        "--prices",
        nargs="+",
        type=float,
        default=list(PRICES),
        metavar="P",
        help=f"a move costs the solver P times its price (default: {' '.join(f'{price:g}' for price in PRICES)})",
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
    result.add_argument("--jobs", type=int, default=cores(), metavar="N", help="processes (default: one for each core)")
    result.add_argument("--json", metavar="FILE", help="write the numbers, too")
    result.add_argument("--quiet", action="store_true", help="print errors only")
    result.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = parser().parse_args(arguments)
    try:
        _learn(options)
    except IwmError as error:
        print(f"learn_policy: error: {error}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("learn_policy: interrupted; nothing half-written is left", file=sys.stderr)
        return INTERRUPTED
    return DONE


def _learn(options: argparse.Namespace) -> None:
    for weight in options.weights:
        if not weight >= 0.0:
            raise ConfigError("arguments", "--weights", f"{weight:g} is out of range", "0 or more, inf included")
    for key, values in (("--prices", options.prices), ("--bandwidths", options.bandwidths)):
        for value in values:
            if not 0.0 < value < math.inf:
                raise ConfigError("arguments", key, f"{value:g} is out of range", "above 0 and finite")
    vehicle = load_vehicle(resolve(options.vehicle), options.idle_drive)
    problem = load_grid(options.grid)
    frictions = [check_number("arguments", "--friction", value, 0.01, 2.0) for value in options.friction]
    paths = targets(Path(options.output), vehicle, problem, frictions)
    general = tuple(source_of(load_cycle(resolve(name)), problem, vehicle.params) for name in options.cycle or CYCLES)
    recordings = read_drives(options.bag, options.mapping, vehicle, "learn_policy")
    recorded = tuple(drive_source(name, drive, problem, 1.0) for name, drive in recordings)
    drives = tuple(
        [load_cycle(resolve(name)) for name in options.drive]
        if options.drive
        else [recorded_cycle(name, drive) for name, drive in recordings]
    )
    candidates = candidates_of(problem, options.weights, options.prices, options.bandwidths)
    roads = []
    for friction, path in zip(frictions, paths, strict=True):
        with tempfile.TemporaryDirectory(prefix="iwm-learn-") as folder:
            task = Task(problem, vehicle, friction, recorded, general, drives, folder)
            equal, outcomes, chosen, policy = learn(task, candidates, max(options.jobs, 1), options.quiet)
        save_policy(policy, path)
        if not options.quiet:
            print(_text(task, equal, outcomes, chosen, path))
        roads.append(
            {
                "friction": friction,
                "policy": str(path),
                "checksum": policy.checksum,
                "chosen_weight": _named(chosen.candidate.weight),
                "chosen_price": chosen.candidate.price,
                "chosen_bandwidth": chosen.candidate.bandwidth,
                "equal": _row(equal),
                "outcomes": [_row(outcome) for outcome in outcomes],
            }
        )
    if options.json:
        content = {"package_version": __version__, "idle_drive": vehicle.idle_drive, "roads": roads}
        atomic_write(options.json, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())


def _named(number: float) -> float | str | None:
    """A weight or price as JSON has it, which knows no infinite numbers; null where there is none."""
    if math.isnan(number):
        return None
    return "inf" if math.isinf(number) else number


def _row(outcome: Outcome) -> dict[str, float | str | bool | None]:
    measured = {name: value for name, value in outcome._asdict().items() if name != "candidate"}
    solved = {name: _named(value) for name, value in outcome.candidate._asdict().items()}
    return {**solved, **measured, "cost_wh_per_km": outcome.cost_wh_per_km}


def _text(task: Task, equal: Outcome, outcomes: Sequence[Outcome], chosen: Outcome, path: Path) -> str:
    drives = ", ".join(f"{cycle.name} ({cycle.duration_s:.0f} s)" for cycle in task.drives)
    lines = [
        f"friction {task.friction:g}, idle drive {task.vehicle.idle_drive}; driven: {drives}",
        f"equal split: {equal.energy_wh_per_km:.2f} Wh/km; saved by policies, %:",
        "recorded second counts as   moves at   bandwidth   energy   with price of moves   changes/min   trace",
    ]
    for outcome in _best_of_each_weight(outcomes):
        saved = 100.0 * (1.0 - outcome.energy_wh_per_km / equal.energy_wh_per_km)
        net = saved - 100.0 * outcome.moves_wh_per_km / equal.energy_wh_per_km
        lines.append(
            f"{_weight_text(outcome.candidate.weight):<27} {outcome.candidate.price:8.2f}   "
            f"{outcome.candidate.bandwidth:9.2f}  {saved:7.3f}   {net:19.3f}   "
            f"{outcome.changes_per_min:11.1f}   "
            f"{'held' if outcome.trace_held else 'left'}{'   <- chosen' if outcome is chosen else ''}"
        )
    if chosen.candidate.weight == CYCLES_ALONE:
        lines.append("the recorded drives teach nothing that the cycles do not; the policy is that of the cycles")
    return "\n".join([*lines, f"policy: {path}", ""])


def _best_of_each_weight(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """The baseline, and of each weight what `choose` would take; where it would take none, what costs least."""
    safe, *others = outcomes
    best = [safe]
    for _, group in itertools.groupby(others, key=lambda outcome: outcome.candidate.weight):
        tried = list(group)
        found = choose([safe, *tried])
        best.append(found if found is not safe else min(tried, key=lambda outcome: outcome.cost_wh_per_km))
    return best


def _weight_text(weight: float) -> str:
    if weight == CYCLES_ALONE:
        return "nothing: cycles alone"
    if weight == RECORDING_ALONE:
        return "all: recorded drives alone"
    return f"{weight:g} s of a cycle"


if __name__ == "__main__":
    sys.exit(main())
