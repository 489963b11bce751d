# SPDX-License-Identifier: Apache-2.0
"""Solve power-split policies: `solve_policy --help`.

Exit codes: 0 solved (or checked); 1 a policy did not reach its bound; 2 bad arguments or files; 130 interrupted.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from iwm_power_manager import __version__
from iwm_power_manager.command_line import Written, refuse_without_effect
from iwm_power_manager.cycle import Cycle, load_cycle
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.files import check_number
from iwm_power_manager.mdp.certify import bellman_bound
from iwm_power_manager.mdp.demand import (
    THIN_ROW_STEPS,
    DemandChain,
    Source,
    chain_of,
    source_of,
)
from iwm_power_manager.mdp.demand_counts import transitions_source
from iwm_power_manager.mdp.export import export_mdp
from iwm_power_manager.mdp.policy_iteration import Iteration
from iwm_power_manager.mdp.problem import Problem
from iwm_power_manager.mdp.transitions import build_model
from iwm_power_manager.model.parameters import IDLE_DRIVES
from iwm_power_manager.policy import load_policy
from iwm_power_manager.replay.recorded import read_drives
from iwm_power_manager.share import resolve
from iwm_power_manager.solve import Solved, load_grid, solve_one, targets
from iwm_power_manager.tools.command import described, doubts, ended, note_replaced, output_file, picture, write_json
from iwm_power_manager.tools.options import several
from iwm_power_manager.tools.progress import Bar
from iwm_power_manager.vehicle import Vehicle, load_vehicle

SOLVED, UNSOLVED = 0, 1

_DESCRIPTION = """\
Solve the stochastic power split of a car and write it as policy files.

The driver's power demand becomes a Markov chain, counted from drive cycles and from recorded driving. For every state
(demand, speed, slip of both axles, previous front share) policy iteration then finds the front share with the least
expected, discounted cost: battery energy, undelivered power, switching. It stops when the cost-to-go is certified to
be within the grid's tolerance of the optimum; the table shows how it got there.
"""

_EXAMPLES = """\
examples:
  The paper's problem, for a dry, a wet and an icy road, one file each:
    solve_policy --vehicle jalalmaab_2015 --cycle ftp75 hwfet nycc \\
                 --grid paper --friction 0.9 0.5 0.2 --output policies/

  From what your own car recorded, each second of it counting as much as ten of the cycle, with a picture:
    solve_policy --vehicle my_car.yaml --cycle udds.csv --bag drive_1 drive_2 --bag-weight 10 \\
                 --mapping my_topics.yaml --friction 0.9 --output policies/ --plot solution.png

  Your own grid: copy config/grids/fine.yaml, edit it, and pass the file:
    solve_policy --vehicle my_car.yaml --cycle udds.csv --grid my_grid.yaml --friction 0.9 --output my_policy.npz

  Check that a policy file belongs to a car and keeps the bound it claims:
    solve_policy --vehicle my_car.yaml --check my_policy.npz

Vehicles, cycles and grids that come with the package are found by name. On one machine the same inputs give the same
file, byte for byte. Results go to stdout, progress to stderr.

exit codes: 0 solved or checked, 1 a policy missed its bound, 2 bad arguments or files, 130 interrupted
"""


def parser() -> argparse.ArgumentParser:
    """Arguments of the command."""
    result = described("solve_policy", _DESCRIPTION, _EXAMPLES)
    problem = result.add_argument_group("problem")
    problem.add_argument("--vehicle", required=True, metavar="FILE", help="car, YAML (config/vehicles/)")
    problem.add_argument(
        "--friction", nargs="+", type=float, metavar="MU", help="peak friction coefficient(s): one policy each"
    )
    problem.add_argument(
        "--grid",
        default="coupled",
        metavar="NAME|FILE",
        help="paper, fine, coupled or a YAML file (default: %(default)s)",
    )
    problem.add_argument("--idle-drive", choices=sorted(IDLE_DRIVES), help="replaces the car's idle_drive")
    problem.add_argument("--discount", type=float, metavar="GAMMA", help="replaces the grid's discount")

    demand = result.add_argument_group("demand")
    demand.add_argument("--cycle", **several, metavar="CSV", help="time_s,speed_mps[,grade], one or more")
    demand.add_argument(
        "--bag",
        **several,
        metavar="BAG",
        help="rosbag2 recording with a power demand",
    )
    demand.add_argument(
        "--transitions",
        **several,
        metavar="NPZ",
        help="demand counted by the power manager (its parameter demand_log)",
    )
    demand.add_argument("--mapping", metavar="YAML", help="topics and units of foreign bags (config/signals/)")
    demand.add_argument(
        "--bag-weight",
        type=float,
        default=1.0,
        metavar="W",
        help="a recorded second counts as W seconds of a cycle (default: %(default)s)",
    )

    output = result.add_argument_group("output")
    output.add_argument(
        "--output", type=Written, metavar="DIR|FILE", help="folder for the policies, or a .npz file for a single one"
    )
    output.add_argument("--plot", type=picture, metavar="PICTURE", help="demand, convergence, policy: .pdf, .png, .svg")
    output.add_argument("--json", type=output_file, metavar="FILE", help="the run's numbers; - for standard output")
    output.add_argument(
        "--export-mdp",
        type=Written,
        metavar="NPZ",
        help="the exact problem, for another solver (one friction; docs/solver.md)",
    )
    output.add_argument(
        "--verify",
        action="store_true",
        help="compute the Bellman residual of each policy after solving, and store it and what it proves in the file",
    )
    output.add_argument("--quiet", action="store_true", help="print errors and warnings only")
    output.add_argument("--check", nargs="+", metavar="POLICY", help="verify policy files instead of solving")
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = parser().parse_args(arguments)
    options.quiet |= options.json == "-"  # nothing else in what another program is to read
    return ended(
        "solve_policy",
        lambda: _check(options) if options.check else _solve(options),
        options.output,
        quiet=options.quiet,
    )


#: What --check takes beside the files.
_OF_CHECK = {"--check", "--vehicle", "--idle-drive", "--json", "--quiet"}


def _solve(options: argparse.Namespace) -> int:
    _demand_arguments(options)
    vehicle = load_vehicle(resolve(options.vehicle), options.idle_drive)
    problem = _problem(options, vehicle)
    frictions = [check_number("arguments", "--friction", value, 0.01, 2.0) for value in options.friction]
    paths = targets(Path(options.output), vehicle, problem, frictions)
    say = _silent if options.quiet else print

    cycles = [load_cycle(resolve(path)) for path in options.cycle]
    for line in doubts(vehicle, cycles, frictions):
        print(f"solve_policy: {line}", file=sys.stderr)
    note_replaced(*paths, *filter(None, [options.export_mdp]))
    sources = _sources(options, cycles, problem, vehicle)
    chain = chain_of(problem, sources)
    say(_problem_text(problem, vehicle))
    say(_demand_text(chain, sources, problem.dt_s))
    for warning in demand_warnings(chain, problem.dt_s):
        print(f"solve_policy: warning: {warning}", file=sys.stderr)

    solved = []
    for friction, path in zip(frictions, paths, strict=True):
        with _Progress(f"friction {friction:g}", problem.tolerance_j, options.quiet) as progress:
            solved.append(solve_one(problem, vehicle, friction, chain, sources, path, progress.show, options.verify))
        say(_convergence_text(solved[-1]))
    if options.export_mdp:
        priced = solved[0].policy.problem  # with the price of a change that was found
        export_mdp(build_model(priced, vehicle.params, frictions[0], chain.matrix), options.export_mdp)
        say(f"problem: {options.export_mdp}")
    if options.plot:
        from iwm_power_manager.tools.solver_figures import draw_solution

        draw_solution([result.policy for result in solved], options.plot)
        say(f"picture: {options.plot}")
    if options.json:
        write_json(options.json, _numbers(chain, sources, solved))
    return SOLVED if all(result.policy.converged for result in solved) else UNSOLVED


def _demand_arguments(options: argparse.Namespace) -> None:
    """What argparse cannot say: needed for solving, but not for --check."""
    needed = {"friction": "each 0.01 to 2, as in --friction 0.9 0.5 0.2", "output": "a folder, or a .npz file"}
    for name, allowed in needed.items():
        if not getattr(options, name):
            raise ConfigError("arguments", f"--{name}", "is missing", allowed)
    if not (options.cycle or options.bag or options.transitions):
        raise ConfigError("arguments", "--cycle", "is missing", "one cycle, bag or file of transitions, or more")
    if options.export_mdp and len(options.friction) > 1:
        raise ConfigError("arguments", "--export-mdp", "takes one problem", "one --friction")
    check_number("arguments", "--bag-weight", options.bag_weight, 0.0, 1e6, above=True)
    refuse_without_effect(
        options,
        {
            "--mapping": (options.bag, "it is for --bag"),
            "--bag-weight": (options.bag or options.transitions, "it is for --bag and --transitions"),
        },
    )


def _problem(options: argparse.Namespace, vehicle: Vehicle) -> Problem:
    problem = load_grid(options.grid, vehicle.params)
    if options.discount is None:
        return problem
    discount = check_number("arguments", "--discount", options.discount, 0.0, 0.9999)
    return dataclasses.replace(problem, discount=discount)


def _sources(options: argparse.Namespace, cycles: Sequence[Cycle], problem: Problem, vehicle: Vehicle) -> list[Source]:
    sources = [source_of(cycle, problem, vehicle.params) for cycle in cycles]
    drives = read_drives(options.bag, options.mapping, vehicle, "solve_policy")
    sources += [drive.source(name, problem, options.bag_weight) for name, drive in drives]
    return sources + [transitions_source(path, problem.dt_s, options.bag_weight) for path in options.transitions]


class _Progress(Bar):
    """A bar over the orders of magnitude from the first bound to the tolerance."""

    def __init__(self, label: str, tolerance_j: float, quiet: bool) -> None:
        style = "{desc} |{bar}| {n_fmt}% [{elapsed}]{postfix}"
        super().__init__(100, "%", f"{label}: tabulating", quiet=quiet, bar_format=style)
        self._label, self._tolerance, self._first = label, tolerance_j, 0.0

    def show(self, iteration: Iteration) -> None:
        """Show one more policy."""
        bound = max(iteration.bound_j, self._tolerance)
        if self._first == 0.0:
            self._first = bound
            self.set_description_str(f"{self._label}: solving")
        span = math.log(self._first / self._tolerance)
        self.n = round(100.0 * (math.log(self._first / bound) / span if span > 0.0 else 1.0))
        self.set_postfix_str(f"policy {iteration.number}, bound {iteration.bound_j:.3g} J")


def _check(options: argparse.Namespace) -> int:
    """Verify policy files against a car: identity, integrity, and the bound, computed anew."""
    refuse_without_effect(options, {option: (option in _OF_CHECK, "not with --check") for option in options.given})
    vehicle = load_vehicle(resolve(options.vehicle), options.idle_drive)
    rows = []
    for name in options.check:
        path = resolve(name)
        policy = load_policy(path)
        policy.check_vehicle(vehicle, str(path))
        model = build_model(policy.problem, vehicle.params, policy.friction, policy.chain.matrix)
        cost = policy.cost_by_state_j()
        bound = bellman_bound(model, cost)
        # A cost-to-go within b of the optimum has a residual of at most (1 + gamma) b.
        claimed = policy.bound_j * (1.0 + policy.problem.discount) / (1.0 - policy.problem.discount)
        good = bound <= claimed + 1e-9 * float(np.max(np.abs(cost)))
        numbers = {"friction": policy.friction, "checksum": policy.checksum, "claimed_j": policy.bound_j}
        rows.append({"policy": str(path), **numbers, "proven_j": bound, "keeps_its_bound": bool(good)})
        if not options.quiet or (not good and options.json != "-"):
            verdict = "ok" if good else "does NOT keep its bound"
            print(
                f"{path}: {verdict}; friction {policy.friction:g}, {policy.vehicle_name}, {policy.checksum[:12]}, "
                f"claims {policy.bound_j:.3g} J, Bellman residual proves {bound:.3g} J"
            )
    if options.json:
        write_json(options.json, rows)
    return SOLVED if all(row["keeps_its_bound"] for row in rows) else UNSOLVED


def demand_warnings(chain: DemandChain, dt_s: float) -> list[str]:
    """What is thin about the demand's data, one line each."""
    lines = []
    if chain.unvisited_w.size:
        where = _kilowatts(chain.unvisited_w, chain.power_w)
        lines.append(f"no data at {where} kW: taken to return to the nearest demand with data")
    if chain.thin_w.size:
        lines.append(f"less than {THIN_ROW_STEPS * dt_s:g} s of data at {_kilowatts(chain.thin_w, chain.power_w)} kW")
    if chain.clipped > 0.01:
        lines.append(f"{chain.clipped:.1%} of the demand lies outside the power axis and counts as its end")
    return lines


def _kilowatts(values: np.ndarray[Any, Any], axis: np.ndarray[Any, Any]) -> str:
    """Points of an axis, W; neighbours as a range."""
    runs = np.split(values, np.flatnonzero(np.diff(np.searchsorted(axis, values)) > 1) + 1)
    return ", ".join(" to ".join(f"{value / 1000.0:g}" for value in dict.fromkeys((run[0], run[-1]))) for run in runs)


def _silent(_: str) -> None:
    pass


def _problem_text(problem: Problem, vehicle: Vehicle) -> str:
    points = " x ".join(str(n) for n in problem.shape)
    horizon = problem.dt_s / (1.0 - problem.discount)
    return (
        f"{vehicle.name} (idle_drive {vehicle.idle_drive}), grid {problem.name}: {points} states "
        f"(power, speed, slip front, slip rear, previous share), {problem.share.size} controls\n"
        f"step {problem.dt_s:g} s, discount {problem.discount:g} (horizon {horizon:.3g} s), "
        f"alpha {problem.alpha:g}, power error at the {problem.power_error} ({problem.error_norm}), slip "
        f"{problem.slip_model}, skid avoidance {problem.skid_avoidance}, switching {_price_text(problem)} "
        f"+ {problem.switching_fixed_cost_j:g} J for any change"
    )


def _price_text(problem: Problem) -> str:
    if problem.changes_per_min > 0.0 and problem.switching_cost_j == 0.0:
        return f"priced for {problem.changes_per_min:g} changes a minute"
    if not problem.switching_cost_by_friction:
        return f"{problem.switching_cost_j:g} J"
    return ", ".join(f"{price:g} J at friction {friction:g}" for friction, price in problem.switching_cost_by_friction)


def _demand_text(chain: DemandChain, sources: Sequence[Source], dt_s: float) -> str:
    by_speed = " at each speed" if chain.by_speed.size else ""
    lines = [
        f"demand{by_speed} from " + ", ".join(f"{s.name} ({s.steps * dt_s:.0f} s x {s.weight:g})" for s in sources)
    ]
    lines.append("seconds of data by demand in kW:")
    cells = [
        f"{power / 1000.0:6.4g}: {steps * dt_s:<8.1f}"
        for power, steps in zip(chain.power_w, chain.row_steps, strict=True)
    ]
    lines += ["  " + "".join(cells[i : i + 8]).rstrip() for i in range(0, len(cells), 8)]
    return "\n".join(lines)


def _convergence_text(result: Solved) -> str:
    policy = result.policy
    lines = [f"\nfriction {policy.friction:g}", "policy    sweeps     bound J   norm of change   changed states"]
    lines += [
        f"{i.number:6d} {i.evaluation_sweeps:9d} {i.bound_j:11.3e} {i.policy_change:16.6g} {i.changed_states:16d}"
        for i in policy.iterations
    ]
    if policy.trials:
        lines.append(f"price of a change, J: changes a minute; {policy.problem.switching_cost_j:.4g} J is taken")
        lines.append("  " + "".join(f"{t.price_j:.4g}: {t.changes_per_min:<8.3g}" for t in policy.trials).rstrip())
    if policy.residual_j is not None:
        lines.append(f"verified: Bellman residual {policy.residual_j:.2g} J, proves {policy.proven_j:.2g} J")
    verdict = "certified" if policy.converged else "NOT within the tolerance: only certified"
    lines.append(
        f"{verdict} to {policy.bound_j:.2g} J in {result.build_s:.2f} + {result.solve_s:.2f} s (tabulate + solve)\n"
        f"policy: {result.path} ({result.path.stat().st_size / 1e3:.0f} kB, {policy.checksum[:12]})"
    )
    return "\n".join(lines)


def _numbers(chain: DemandChain, sources: Sequence[Source], solved: Sequence[Solved]) -> dict[str, Any]:
    """The run's numbers, for --json."""
    return {
        "package_version": __version__,
        "demand": {
            "power_w": chain.power_w,
            "row_steps": chain.row_steps,
            "probability": chain.probability,
            "clipped": chain.clipped,
            "sources": [{"name": s.name, "sha256": s.sha256, "weight": s.weight, "steps": s.steps} for s in sources],
        },
        "policies": [
            {
                "friction": result.policy.friction,
                "path": str(result.path),
                "checksum": result.policy.checksum,
                "vehicle_hash": result.policy.vehicle_hash,
                "bound_j": result.policy.bound_j,
                "residual_j": result.policy.residual_j,
                "proven_j": result.policy.proven_j,
                "converged": result.policy.converged,
                "build_s": result.build_s,
                "solve_s": result.solve_s,
                "iterations": result.policy.iterations,
            }
            for result in solved
        ],
    }


if __name__ == "__main__":
    sys.exit(main())
