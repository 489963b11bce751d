# SPDX-License-Identifier: Apache-2.0
"""How the solver's time and memory grow with the number of states: grid `fine`, with coarser and finer axes.

Each size is solved in a process of its own, so that its peak memory is its own. `--states 1e7` takes minutes and
1.3 GB.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

#: States asked for, and the points of the speed axis and of each slip axis that give about so many.
SIZES = {1e4: (4, 3), 1e5: (11, 5), 1e6: (11, 17), 1e7: (40, 27)}
FRICTION = 0.9


def refined(axis: np.ndarray, points: int) -> np.ndarray:
    """The axis with another number of points, dense where it was dense."""
    return np.interp(np.linspace(0.0, axis.size - 1.0, points), np.arange(axis.size), axis)


def solve_size(speeds: int, slips: int) -> dict[str, float]:
    """Solve one size in this process."""
    from iwm_power_manager.cycle import load_cycle
    from iwm_power_manager.mdp.demand import chain_of, source_of
    from iwm_power_manager.mdp.policy_iteration import solve
    from iwm_power_manager.mdp.problem import load_problem
    from iwm_power_manager.mdp.transitions import build_model
    from iwm_power_manager.share import resolve
    from iwm_power_manager.vehicle import load_vehicle

    vehicle = load_vehicle(resolve("jalalmaab_2015")).params
    base = load_problem(resolve("config/grids/fine.yaml"))
    problem = dataclasses.replace(
        base,
        speed_mps=refined(base.speed_mps, speeds),
        slip_front=refined(base.slip_front, slips),
        slip_rear=refined(base.slip_rear, slips),
    )
    chain = chain_of(problem, [source_of(load_cycle(resolve("nycc")), problem, vehicle)])
    before_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    started = time.perf_counter()
    model = build_model(problem, vehicle, FRICTION, chain.matrix)
    built = time.perf_counter()
    solution = solve(model, problem.share, problem.tolerance_j, problem.max_iterations, lambda _: None)
    solved = time.perf_counter()
    return {
        "states": float(np.prod(model.state_shape)),
        "controls": float(problem.share.size),
        "tabulate_s": built - started,
        "solve_s": solved - built,
        "sweeps": float(solution.iterations[-1].evaluation_sweeps),
        "bound_j": solution.bound_j,
        "before_mb": before_mb,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
    }


def main() -> None:
    """Solve every size and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--states", nargs="+", type=float, choices=sorted(SIZES), default=[1e4, 1e5, 1e6], help="default: to 1e6"
    )
    parser.add_argument("--json", metavar="FILE", help="write all numbers")
    parser.add_argument("--child", nargs=2, type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        print(json.dumps(solve_size(*options.child)))
        return
    results = []
    for states in options.states:
        command = [sys.executable, __file__, "--child", *map(str, SIZES[states])]
        found = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
        results.append(found)
        grown = (found["peak_mb"] - found["before_mb"]) * 2**20 / found["states"]
        print(
            f"{found['states']:>12,.0f} states x {found['controls']:.0f}: tabulate {found['tabulate_s']:7.2f} s, solve "
            f"{found['solve_s']:7.2f} s in {found['sweeps']:.0f} sweeps, {grown:5.0f} bytes a state, "
            f"{found['peak_mb']:6.0f} MB at most, within {found['bound_j']:.3f} J",
            flush=True,
        )
    if options.json:
        Path(options.json).write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
