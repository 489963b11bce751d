#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""How fast the solver and the closed loop are: beside their peers, beside an earlier checkout, and how exact.

Every row is a process of its own, after one that compiles: a warm-up, then the timed runs; its peak memory is its own.
Times are of the processor, summed over the threads, so that another busy process tells in the spread but not in the
median, and on the clock. `--before FOLDER` runs an earlier checkout of this package in turns; `--fastsim PYTHON` an
interpreter that has the packages of benchmarks/requirements.txt; `--page FILE` puts the table between that page's
markers.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import hashlib
import json
import math
import os
import platform
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
FRICTION = 0.9
BEGIN, END = "<!-- measured: benchmarks/performance.py -->", "<!-- end -->"


class Row(NamedTuple):
    """What a row is, its goals (seconds on the clock, times the peer's processor time, MB), and its peer."""

    what: str
    clock_s: float = math.inf
    of_peer: float = math.inf
    memory_mb: float = math.inf
    peer: str = ""

    def goal(self) -> str:
        """The goals in words."""
        said = []
        if self.clock_s < math.inf:
            said.append(f"{self.clock_s:g} s on the clock")
        if self.of_peer < math.inf:
            said.append(
                f"{1.0 / self.of_peer:g} times as fast as the peer" if self.of_peer < 1.0 else "no slower than the peer"
            )
        if self.memory_mb < math.inf:
            said.append(f"{self.memory_mb:g} MB")
        return ", ".join(said)

    def met(self, now: dict[str, Any], peer: dict[str, Any] | None) -> bool:
        """Whether all of them are."""
        theirs = statistics.median(peer["cpu_s"]) if peer else math.inf
        return (
            statistics.median(now.get("clock_s", [0.0])) <= self.clock_s
            and statistics.median(now["cpu_s"]) <= self.of_peer * theirs
            and now["peak_mb"] <= self.memory_mb
        )


ROWS = {
    "transitions": Row("transitions of the paper's problem, 41 controls", clock_s=0.25),
    "solve": Row(
        "the paper's problem, 41 controls, discount 0.95: solve", of_peer=0.05, memory_mb=150.0, peer="quantecon"
    ),
    "coupled": Row("grid `coupled`, one price: tabulate + solve", clock_s=0.2),
    "fine": Row("grid `fine`, 1.4 million states: tabulate + solve", clock_s=5.0),
    "drive": Row("UDDS, `equal`, 100 Hz, four wheels and slip", clock_s=0.15),
    "drive_10hz": Row("UDDS, `equal`, 10 Hz, four wheels and slip", of_peer=1.0, peer="fastsim"),
    "lookahead": Row("UDDS, `sdp_lookahead`, 100 Hz", clock_s=0.5),
    "imports": Row("imports of the solver alone"),
}

FASTSIM = """\
import importlib.metadata, json, sys, time, resource, fastsim
veh = fastsim.Vehicle.from_resource("2022_Renault_Zoe_ZE50_R135.yaml")
times = []
for _ in range(int(sys.argv[1]) + 1):
    sim = fastsim.SimDrive(veh, fastsim.Cycle.from_resource("udds.csv"))
    started = time.process_time()
    sim.walk()
    times.append(time.process_time() - started)
print(json.dumps({"cpu_s": times[1:], "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
                  "version": importlib.metadata.version("fastsim")}))
"""


def _timed(repeat: int, run: Callable[[], Any]) -> tuple[Any, dict[str, list[float]]]:
    """What `run` gives, and the time of each run but the first, of the processor and on the clock."""
    times: dict[str, list[float]] = {"cpu_s": [], "clock_s": []}
    for _ in range(repeat + 1):
        began, started = time.perf_counter(), time.process_time()
        result = run()
        times["cpu_s"].append(time.process_time() - started)
        times["clock_s"].append(time.perf_counter() - began)
    return result, {name: values[1:] for name, values in times.items()}


def _problem(grid: str, **changes: Any) -> tuple[Any, Any, Any]:
    """A problem, its car and its demand's chain."""
    from iwm_power_manager.cycle import load_cycle
    from iwm_power_manager.mdp.demand import chain_of, source_of
    from iwm_power_manager.share import resolve
    from iwm_power_manager.solve import load_grid
    from iwm_power_manager.vehicle import load_vehicle

    car = load_vehicle(resolve("jalalmaab_2015"), "drag").params
    problem = dataclasses.replace(load_grid(grid, car), **changes)
    cycles = [load_cycle(resolve(name)) for name in ("ftp75", "hwfet", "nycc")]
    return problem, car, chain_of(problem, [source_of(cycle, problem, car) for cycle in cycles]).matrix


def _paper() -> tuple[Any, Any, Any]:
    return _problem("paper", share=np.arange(41) / 40.0, discount=0.95)


def transitions(repeat: int) -> dict[str, Any]:
    """Tabulate; the error is that of the cost of every 50th pair, against the step that starts from nowhere."""
    from iwm_power_manager.mdp.transitions import build_model
    from iwm_power_manager.model.decision import step_cost_and_next

    problem, car, demand = _paper()
    model, times = _timed(repeat, lambda: build_model(problem, car, FRICTION, demand))
    shape, n_u = model.cell_shape, problem.share.size
    error = 0.0
    for p in range(problem.power_w.size):
        first, last = model.free_start[p : p + 2]
        for k in range(p % 50, (last - first) * n_u, 50):
            i = first * n_u + k
            if np.isfinite(model.free_cost[i]):
                v, f, r = np.unravel_index(model.free_cell[first + k % (last - first)], shape)
                state = (problem.speed_mps[v], problem.slip_front[f], problem.slip_rear[r])
                share = problem.share[k // (last - first)]
                step = step_cost_and_next(problem.power_w[p], *state, share, car, problem.params(FRICTION))
                error = max(error, abs(step.cost_j - model.free_cost[i]))
    return times | {"pairs": int(model.free_cost.size), "exact": f"cost within {error:.1e} J of its oracle"}


def _solved(problem: Any, model: Any) -> Any:
    from iwm_power_manager.mdp.policy_iteration import solve

    return solve(model, problem.share, problem.tolerance_j, problem.max_iterations)


def _exact(model: Any, solution: Any) -> str:
    from iwm_power_manager.mdp.certify import bellman_bound

    return f"certified {solution.bound_j:.1e} J, residual proves {bellman_bound(model, solution.cost_j):.1e} J"


def solve_paper(repeat: int) -> dict[str, Any]:
    """Solve the paper's problem."""
    from iwm_power_manager.mdp.transitions import build_model

    problem, car, demand = _paper()
    model = build_model(problem, car, FRICTION, demand)
    solution, times = _timed(repeat, lambda: _solved(problem, model))
    return times | {"exact": _exact(model, solution)}


def grid(name: str, repeat: int, **changes: Any) -> dict[str, Any]:
    """Tabulate and solve a grid."""
    from iwm_power_manager.mdp.transitions import build_model

    problem, car, demand = _problem(name, **changes)

    def run() -> Any:
        model = build_model(problem, car, FRICTION, demand)
        return model, _solved(problem, model)

    (model, solution), times = _timed(repeat, run)
    sweeps = solution.iterations[-1].evaluation_sweeps
    return times | {"exact": f"{sweeps} sweeps, {_exact(model, solution)}"}


def drive(strategy: str, dt_s: float, repeat: int) -> dict[str, Any]:
    """Drive a cycle in the closed loop; the series' hash tells whether two checkouts drive the same."""
    from iwm_power_manager.control.settings import default_settings
    from iwm_power_manager.cycle import load_cycle
    from iwm_power_manager.policy import load_policy
    from iwm_power_manager.share import resolve
    from iwm_power_manager.vehicle import load_vehicle
    from iwm_sim import closed_loop

    car = load_vehicle(resolve("jalalmaab_2015"), "drag")
    table = load_policy(resolve("jalalmaab_2015_drag_coupled_mu090")).table()
    cycle, settings = load_cycle(resolve("udds")), default_settings(strategy)
    run, times = _timed(repeat, lambda: closed_loop.run(cycle, car, settings, table, FRICTION, dt_s=dt_s))
    return times | {"exact": f"series {hashlib.sha256(run.series.tobytes()).hexdigest()[:8]}"}


def imports(_: int) -> dict[str, Any]:
    """What the solver's modules take before anything is solved."""
    started = time.process_time()
    import numba  # noqa: F401

    import iwm_power_manager.solve  # noqa: F401

    return {"cpu_s": [time.process_time() - started], "exact": ""}


def quantecon(repeat: int) -> dict[str, Any]:
    """The peer: the same problem as a sparse matrix, by QuantEcon's modified policy iteration to the same tolerance."""
    import quantecon.markov as markov
    from scipy.sparse import coo_matrix, vstack

    from iwm_power_manager.mdp.export import arrays_of
    from iwm_power_manager.mdp.transitions import build_model

    problem, car, demand = _paper()
    model = build_model(problem, car, FRICTION, demand)
    solution = _solved(problem, model)
    data = arrays_of(model)
    started = time.process_time()
    cells, powers = int(np.prod(data["cell_shape"])), demand.shape[1]
    kept = np.isfinite(data["cost_j"])
    power, cell, control, cost, successor, weight = (
        data[name][kept] for name in ("power", "cell", "control", "cost_j", "successor", "weight")
    )
    order = np.lexsort((control, power * cells + cell))
    blocks = []
    for p in range(powers):
        rows = order[power[order] == p]
        next_p = np.flatnonzero(demand[0, p])
        columns = (next_p[None, :, None] * cells + successor[rows][:, None, :]).reshape(rows.size, -1)
        values = (demand[0, p, next_p][None, :, None] * weight[rows][:, None, :]).reshape(rows.size, -1)
        used = values > 0.0
        places = np.broadcast_to(np.arange(rows.size)[:, None], used.shape)
        blocks.append(coo_matrix((values[used], (places[used], columns[used])), (rows.size, powers * cells)).tocsr())
    matrix = vstack(blocks, format="csr")
    built = time.process_time()
    states, actions = (power * cells + cell)[order], np.maximum(control[order], 0)
    peer = markov.DiscreteDP(-cost[order], matrix, problem.discount, states, actions)
    made = time.process_time()
    found, times = _timed(
        repeat, lambda: peer.solve(method="modified_policy_iteration", epsilon=2.0 * problem.tolerance_j)
    )
    apart = float(np.max(np.abs(found.v + solution.cost_j.ravel())))
    return {
        "cpu_s": [built - started + made - built + seconds for seconds in times["cpu_s"]],
        "exact": f"matrix {built - started:.2f} s + constructor {made - built:.2f} s + solve "
        f"{statistics.median(times['cpu_s']):.2f} s; {apart:.1e} J from ours",
    }


CHILDREN: dict[str, Callable[[int], dict[str, Any]]] = {
    "transitions": transitions,
    "solve": solve_paper,
    "coupled": lambda repeat: grid("coupled", repeat, switching_cost_j=14.4),
    "fine": lambda repeat: grid("fine", min(repeat, 1)),
    "drive": lambda repeat: drive("equal", 0.01, repeat),
    "drive_10hz": lambda repeat: drive("equal", 0.1, repeat),
    "lookahead": lambda repeat: drive("sdp_lookahead", 0.01, repeat),
    "imports": imports,
    "quantecon": quantecon,
}


def measured(name: str, repeat: int, checkout: Path) -> dict[str, Any]:
    """One row in a process of its own, with the code of a checkout."""
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    for times in (1, repeat):  # what the first one may have to compile takes memory, too
        command = [sys.executable, "-P", __file__, "--child", name, "--repeat", str(times)]
        made = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, text=True)
    return dict(json.loads(made.stdout.splitlines()[-1]))


def seconds(found: dict[str, Any] | None) -> str:
    """Median and spread of a row, and what it takes beside."""
    if not found:
        return "-"
    times = found["cpu_s"]
    spread = f" ({min(times):.3g} to {max(times):.3g})" if len(times) > 1 else ""
    clock = f", {statistics.median(found['clock_s']):.3g} s on the clock" if "clock_s" in found else ""
    return f"{statistics.median(times):.3g} s{spread}{clock}, {found['peak_mb']:.0f} MB"


def table(results: dict[str, Any]) -> str:
    """The table of all rows, with the machine."""
    lines = [
        f"{results['machine']}; processor time, median of {results['repeat']} (least to most), and peak memory; "
        f"load average {results['load']:.1f} of {os.cpu_count()} cores.",
        "",
        "| work | peer | before | now | goal | how exact |",
        "|---|---|---|---|---|---|",
    ]
    for name, row in ROWS.items():
        found = results["rows"].get(name)
        if not found:
            continue
        of_peer = found.get("peer")
        theirs = f"{row.peer}: {seconds(of_peer)}" if of_peer else "-"
        before, now = found.get("before"), found["now"]
        exact = now["exact"]
        if before and exact.startswith("series"):
            exact = "same bits as before" if before["exact"] == exact else "not the bits of before"
        if of_peer and of_peer.get("exact"):
            exact = f"{exact}; peer: {of_peer['exact']}"
        goal = f"{row.goal()}: {'met' if row.met(now, of_peer) else 'missed'}" if row.goal() else ""
        lines.append(f"| {row.what} | {theirs} | {seconds(before)} | {seconds(now)} | {goal} | {exact} |")
    return "\n".join(lines)


def _peer(name: str, options: argparse.Namespace) -> dict[str, Any] | None:
    if name == "quantecon":
        return measured(name, 1, ROOT)
    if name == "fastsim" and options.fastsim:
        made = subprocess.run(
            [options.fastsim, "-c", FASTSIM, str(options.repeat)], check=True, stdout=subprocess.PIPE, text=True
        )
        found = dict(json.loads(made.stdout))
        return found | {"exact": f"version {found['version']}, 1 Hz, no wheels"}
    return None


def main() -> None:
    """Measure the rows, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", nargs="+", choices=list(ROWS), default=list(ROWS), help="default: all")
    parser.add_argument("--repeat", type=int, default=5, help="timed runs of each row (default: %(default)s)")
    parser.add_argument("--before", type=Path, metavar="FOLDER", help="an earlier checkout")
    parser.add_argument("--fastsim", metavar="PYTHON", help="an interpreter with benchmarks/requirements.txt")
    parser.add_argument("--json", metavar="FILE", help="write all numbers")
    parser.add_argument("--page", type=Path, metavar="FILE", help="put the table between the markers of this page")
    parser.add_argument("--child", choices=list(CHILDREN), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        found = CHILDREN[options.child](options.repeat)
        print(json.dumps(found | {"peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0}))
        return
    processor = platform.processor() or platform.machine()
    with contextlib.suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        processor = next(line.split(": ")[1] for line in lines if line.startswith("model name"))
    results: dict[str, Any] = {
        "machine": f"{processor}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "repeat": options.repeat,
        "load": os.getloadavg()[0],
        "rows": {},
    }
    for name in options.rows:
        row = {"before": measured(name, options.repeat, options.before.resolve())} if options.before else {}
        row["now"] = measured(name, options.repeat, ROOT)
        if peer := _peer(ROWS[name].peer, options):
            row["peer"] = peer
        results["rows"][name] = row
        print(f"{name}: {seconds(row['now'])}", file=sys.stderr, flush=True)
    text = table(results)
    print(text)
    if options.json:
        Path(options.json).write_text(json.dumps(results, indent=1) + "\n")
    if options.page:
        page = options.page.read_text(encoding="utf-8")
        head, rest = page.split(BEGIN, 1)
        _, tail = rest.split(END, 1)
        options.page.write_text(f"{head}{BEGIN}\n{text}\n{END}{tail}", encoding="utf-8")


if __name__ == "__main__":
    main()
