#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""How fast all of it is: beside its peers, beside an earlier checkout, and how exact.

Every row is a process of its own, after one that compiles: a warm-up, then the timed runs; its peak memory is its own.
Times are of the processor, summed over the threads, so that another busy process tells in the spread but not in the
median, and on the clock. `--before FOLDER` runs an earlier checkout of this package in turns; `--fastsim PYTHON` an
interpreter that has the packages of benchmarks/requirements.txt; `--page FILE` puts the table between that page's
markers. Bags, starts and the fleet of 1,000 drives have programs of their own beside this one, which are run for their
rows; with `--page` that of the fleet fills scale.md and scale.json beside the page.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import functools
import gc
import hashlib
import json
import math
import os
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
FRICTION = 0.9
BEGIN, END = "<!-- measured: benchmarks/performance.py -->", "<!-- end -->"


class Row(NamedTuple):
    """What a row is, its goals (seconds on the clock, times the peer's processor time, MB), and its peer.

    `size`: points of the speed axis and of each slip axis of a grid that is solved once, without an earlier checkout.
    """

    what: str
    clock_s: float = math.inf
    of_peer: float = math.inf
    memory_mb: float = math.inf
    peer: str = ""
    size: tuple[int, int] | None = None

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
        theirs = statistics.median(peer["cpu_s"]) if peer and peer["cpu_s"] else math.inf
        return (
            statistics.median(now.get("clock_s", [0.0])) <= self.clock_s
            and statistics.median(now["cpu_s"]) <= self.of_peer * theirs
            and now["peak_mb"] <= self.memory_mb
        )


#: What a solver of sparse matrices may take before it has got as far as it gets, bytes.
PEER_LIMIT = 8 * 2**30
ROWS = {
    "transitions": Row("transitions of the paper's problem, 41 controls", clock_s=0.25, peer="naive"),
    "solve": Row(
        "the paper's problem, 41 controls, discount 0.95: solve", of_peer=0.05, memory_mb=150.0, peer="quantecon"
    ),
    "coupled": Row("grid `coupled`, one price: tabulate + solve", clock_s=0.2),
    "fine": Row("grid `fine`, 1.4 million states: tabulate + solve", clock_s=5.0),
    "states_1e4": Row("`fine` with other axes, 10^4 states", peer="quantecon", size=(4, 3)),
    "states_1e5": Row("10^5 states", peer="quantecon", size=(11, 5)),
    "states_1e6": Row("10^6 states", peer="quantecon", size=(11, 17)),
    "states_1e7": Row("10^7 states", size=(40, 27)),
    "drive": Row("UDDS, `equal`, 100 Hz, four wheels and slip", clock_s=0.15),
    "drive_10hz": Row("UDDS, `equal`, 10 Hz, four wheels and slip", of_peer=1.0, peer="fastsim"),
    "lookahead": Row("UDDS, `sdp_lookahead`, 100 Hz", clock_s=0.5),
    "step": Row("one step of the power manager, `sdp_lookahead`, NYCC: its 99th percentile", clock_s=100e-6),
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
        began = time.perf_counter()
        model = build_model(problem, car, FRICTION, demand)
        tabulated = time.perf_counter()
        solution = _solved(problem, model)
        return model, solution, {"tabulate": tabulated - began, "solve": time.perf_counter() - tabulated}

    (model, solution, parts), times = _timed(repeat, run)
    sweeps = solution.iterations[-1].evaluation_sweeps
    return times | {"parts": parts, "exact": f"{sweeps} sweeps, {_exact(model, solution)}"}


def _sized(speeds: int, slips: int) -> tuple[Any, Any, Any]:
    """Grid `fine` with so many points, dense where it was dense."""

    def refined(axis: Any, points: int) -> Any:
        return np.interp(np.linspace(0.0, axis.size - 1.0, points), np.arange(axis.size), axis)

    base = _problem("fine")[0]
    front, rear = refined(base.slip_front, slips), refined(base.slip_rear, slips)
    return _problem("fine", speed_mps=refined(base.speed_mps, speeds), slip_front=front, slip_rear=rear)


def states(speeds: int, slips: int) -> dict[str, Any]:
    """Tabulate and solve a size, once."""
    from iwm_power_manager.mdp.transitions import build_model

    def run(size: tuple[int, int]) -> tuple[Any, Any, float]:
        problem, car, demand = _sized(*size)
        started = time.perf_counter()
        model = build_model(problem, car, FRICTION, demand)
        tabulated_s = time.perf_counter() - started
        return model, _solved(problem, model), tabulated_s

    run((4, 3))  # loads the kernels
    before_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    began, started = time.perf_counter(), time.process_time()
    model, solution, tabulated_s = run((speeds, slips))
    cpu_s, clock_s = time.process_time() - started, time.perf_counter() - began
    count = int(np.prod(model.state_shape))
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0 - before_mb) * 2**20 / count
    return {
        "cpu_s": [cpu_s],
        "clock_s": [clock_s],
        "parts": {"tabulate": tabulated_s, "solve": clock_s - tabulated_s},
        "exact": f"{count:,} states, {grown:.0f} bytes and {1e6 * cpu_s / count:.1f} us each, "
        f"{solution.iterations[-1].evaluation_sweeps} sweeps, certified {solution.bound_j:.1e} J",
    }


def naive(repeat: int) -> dict[str, Any]:
    """The peer of `transitions`: the step of every state and control, one after the other, compiled."""
    import numba

    from iwm_power_manager.model.decision import step_cost_and_next

    problem, car, _ = _paper()

    @numba.njit
    def tabulate(powers, speeds, fronts, rears, shares, car, params):
        cost, i = np.empty(powers.size * speeds.size * fronts.size * rears.size * shares.size), 0
        for p in powers:
            for v in speeds:
                for f in fronts:
                    for r in rears:
                        for u in shares:
                            cost[i] = step_cost_and_next(p, v, f, r, u, car, params).cost_j
                            i += 1
        return cost

    axes = (problem.power_w, problem.speed_mps, problem.slip_front, problem.slip_rear, problem.share)
    cost, times = _timed(repeat, lambda: tabulate(*axes, car, problem.params(FRICTION)))
    return times | {"exact": f"{cost.size:,} pairs in a plain loop"}


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
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    plant_s = _plant_s(run, car.params, dt_s) if repeat > 1 else 0.0
    rest_s = statistics.median(times["clock_s"]) - plant_s
    return times | {
        "peak_mb": peak_mb,
        "parts": {"simulated car": plant_s, "law and driver": rest_s},
        "series": hashlib.sha256(run.series.tobytes()).hexdigest()[:8],
        "exact": _step_error(run, car.params, dt_s),
    }


def _plant_s(run: Any, car: Any, dt_s: float) -> float:
    """What the simulated car takes of a drive: its steps alone, on the torques of the drive."""
    import numba

    from iwm_sim.plant import Surroundings, advance, initial_plant

    @numba.njit
    def steps(state, torques, surroundings, car):
        for k in range(len(torques)):
            a, b, c, d = torques[k]
            state = advance(state, (a, a, b, b), (c, c, d, d), 0.0, surroundings, dt_s, 1, car)
        return state.speed_mps

    names = ("front_motor_nm", "rear_motor_nm", "front_friction_nm", "rear_friction_nm")
    torques = np.column_stack([run[name] for name in names])
    around = Surroundings((FRICTION,) * 4, 0.0, 0.0)
    _, times = _timed(3, lambda: steps(initial_plant(car, 0.8, float(run["speed_mps"][0])), torques, around, car))
    return statistics.median(times["clock_s"])


def _step_error(run: Any, car: Any, dt_s: float, seconds: float = 0.2) -> str:
    """Of the simulated car, on torques of the drive, beside the equations of motion integrated by SciPy."""
    sys.path.insert(0, str(ROOT / "test"))
    from iwm_sim.plant import Surroundings, advance, initial_plant
    from oracles.physics import dynamics

    front, rear, front_brake, rear_brake = (
        run[f"{axle}_{kind}_nm"] for kind in ("motor", "friction") for axle in ("front", "rear")
    )
    moving = np.flatnonzero((run["speed_mps"] > 3.0) & (np.abs(front) > 1.0) & (np.abs(rear) > 1.0))
    error = 0.0
    for i in moving[:: len(moving) // 50]:
        motors = (front[i], front[i], rear[i], rear[i])
        brakes = (front_brake[i], front_brake[i], rear_brake[i], rear_brake[i])
        speed = float(run["speed_mps"][i])
        state = start = initial_plant(car, 0.8, speed)
        for _ in range(round(seconds / dt_s)):
            state = advance(state, motors, brakes, 0.0, Surroundings((FRICTION,) * 4, 0.0, 0.0), dt_s, 1, car)
        resisting = tuple(-torque for torque in brakes)
        true, _ = dynamics(speed, start.wheel_speed_radps, motors, resisting, 0.0, (FRICTION,) * 4, seconds, car)
        error = max(error, abs(state.speed_mps - true))
    return f"speed after {seconds:g} s within {1e3 * error:.2g} mm/s of its oracle"


def step(repeat: int) -> dict[str, Any]:
    """Times of single steps from checked inputs to commands, as the node runs them, without DDS; the slowest count.

    Every drive takes the same steps, so a step's own time is the median of its times in three drives: what interrupts
    the machine meets another step each time. A loop of additions that takes as long says how much that is. Garbage is
    not collected within a step, as in the node (`ros/realtime.py`).
    """
    from iwm_power_manager.cycle import load_cycle
    from iwm_power_manager.share import resolve
    from iwm_power_manager.vehicle import load_vehicle
    from iwm_sim.road_run import controller_of, drive_scenario
    from iwm_sim.scenario import on_cycle

    scenario = on_cycle(load_vehicle(resolve("jalalmaab_2015"), "drag"), load_cycle(resolve("nycc")), FRICTION)
    drives: list[Any] = []
    gc.disable()
    for _ in range(repeat + 3):
        gc.collect()
        controller = controller_of(scenario)
        own, taken = controller.step, []

        def timed(*args: Any, own: Any = own, taken: list[Any] = taken) -> Any:
            began, started = time.perf_counter(), time.thread_time()
            made = own(*args)
            taken.append((time.thread_time() - started, time.perf_counter() - began))
            return made

        controller.step = timed  # type: ignore[method-assign]
        drive_scenario(scenario, controller)
        drives.append(np.array(taken))
    gc.enable()
    drives = drives[1:]
    middle, single = np.percentile(drives, (50, 99), axis=1)[..., 1]
    slow = np.array([np.percentile(np.median(drives[k : k + 3], axis=0), 99, axis=0) for k in range(repeat)])
    idle_s = _interruptions(len(taken), float(np.median(middle)))
    return {
        "cpu_s": slow[:, 0].tolist(),
        "clock_s": slow[:, 1].tolist(),
        "parts": {"median": float(np.median(middle))},
        "exact": f"{len(taken):,} steps, each the median of three drives; in single drives the 99th percentile is "
        f"{np.median(single):.3g} s, where as many loops of additions as long have {idle_s:.3g} s",
    }


def _interruptions(count: int, loop_s: float) -> float:
    """99th percentile of the times of loops of additions whose median is about `loop_s`."""

    def loops(size: int, repeat: int) -> Any:
        times = []
        for _ in range(repeat):
            began, total = time.perf_counter(), 0
            for i in range(size):
                total += i
            times.append(time.perf_counter() - began)
        return times

    size = round(loop_s / np.median(loops(1000, 1000)) * 1000)
    return float(np.percentile(loops(size, count), 99))


def imports(_: int) -> dict[str, Any]:
    """What the solver's modules take before anything is solved."""
    started = time.process_time()
    import numba  # noqa: F401

    import iwm_power_manager.solve  # noqa: F401

    return {"cpu_s": [time.process_time() - started], "exact": ""}


def quantecon(repeat: int, size: tuple[int, int] | None = None) -> dict[str, Any]:
    """The peer: the same problem as a sparse matrix, by QuantEcon's modified policy iteration to the same tolerance."""
    import quantecon.markov as markov

    from iwm_power_manager.mdp.transitions import build_model

    problem, car, demand = _sized(*size) if size else _paper()
    model = build_model(problem, car, FRICTION, demand)
    solution = _solved(problem, model)
    resource.setrlimit(resource.RLIMIT_AS, (PEER_LIMIT, PEER_LIMIT))
    started = time.process_time()
    try:
        states, actions, cost, matrix = _pairs(model, demand[0])
        built = time.process_time()
        peer = markov.DiscreteDP(-cost, matrix, problem.discount, states, actions)
        made = time.process_time()
        found, times = _timed(
            repeat,
            lambda: peer.solve(
                method="modified_policy_iteration", epsilon=2.0 * problem.tolerance_j, max_iter=problem.max_iterations
            ),
        )
    except MemoryError:
        return {"cpu_s": [], "exact": f"needs more than {PEER_LIMIT / 2**30:g} GB"}
    apart = float(np.max(np.abs(found.v + solution.cost_j.ravel())))
    return {
        "cpu_s": [made - started + seconds for seconds in times["cpu_s"]],
        "exact": f"matrix {built - started:.2f} s + constructor {made - built:.2f} s + solve "
        f"{statistics.median(times['cpu_s']):.2f} s; {apart:.1e} J from ours",
    }


def _pairs(model: Any, demand: Any) -> tuple[Any, Any, Any, Any]:
    """State, control, cost and sparse successors of every pair, in the order of states and controls."""
    from scipy.sparse import coo_matrix, vstack

    from iwm_power_manager.mdp.export import NO_CHOICE, arrays_of

    data = arrays_of(model)
    cells, (shares, _) = int(np.prod(data["cell_shape"])), data["switching_j"].shape
    kept = np.isfinite(data["cost_j"])
    power, cell, control, cost, successor, weight = (
        data[name][kept] for name in ("power", "cell", "control", "cost_j", "successor", "weight")
    )
    share = np.arange(shares)[:, None]
    free, control = control != NO_CHOICE, np.maximum(control, 0)
    after = (np.where(free, control, share) if shares > 1 else 0 * share + 0 * control).ravel()
    cost = (cost + np.where(free, data["switching_j"][share, control], 0.0)).ravel()
    states, actions = ((power * shares + share) * cells + cell).ravel(), np.tile(control, shares)
    row, order = np.tile(np.arange(power.size), shares), np.lexsort((actions, states))
    blocks = []
    for p, following in enumerate(demand):
        pairs = order[power[row[order]] == p]
        next_p = np.flatnonzero(following)
        base = (next_p[None, :] * shares + after[pairs][:, None]) * cells
        columns = (base[:, :, None] + successor[row[pairs]][:, None, :]).reshape(pairs.size, -1)
        values = (following[next_p][None, :, None] * weight[row[pairs]][:, None, :]).reshape(pairs.size, -1)
        used = values > 0.0
        places = np.broadcast_to(np.arange(pairs.size)[:, None], used.shape)
        shape = (pairs.size, len(demand) * shares * cells)
        blocks.append(coo_matrix((values[used], (places[used], columns[used])), shape).tocsr())
    return states[order], actions[order], cost[order], vstack(blocks, format="csr")


CHILDREN: dict[str, Callable[[int], dict[str, Any]]] = {
    "transitions": transitions,
    "solve": solve_paper,
    "coupled": lambda repeat: grid("coupled", repeat, switching_cost_j=14.4),
    "fine": lambda repeat: grid("fine", min(repeat, 1)),
    "drive": lambda repeat: drive("equal", 0.01, repeat),
    "drive_10hz": lambda repeat: drive("equal", 0.1, repeat),
    "lookahead": lambda repeat: drive("sdp_lookahead", 0.01, repeat),
    "step": step,
    "imports": imports,
    "quantecon": quantecon,
    "naive": naive,
    **{name: (lambda size: lambda _: states(*size))(row.size) for name, row in ROWS.items() if row.size},
    **{f"quantecon_{name}": functools.partial(quantecon, size=row.size) for name, row in ROWS.items() if row.size},
}


def measured(name: str, repeat: int, checkout: Path) -> dict[str, Any]:
    """One row in a process of its own, with the code of a checkout."""
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    for times in (
        (1, repeat) if name in ROWS and not ROWS[name].size else (repeat,)
    ):  # what the first one may have to compile takes memory, too
        command = [sys.executable, "-P", __file__, "--child", name, "--repeat", str(times)]
        made = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, text=True)
    return dict(json.loads(made.stdout.splitlines()[-1]))


def seconds(found: dict[str, Any] | None) -> str:
    """Median and spread of a row, its parts on the clock, and what it takes beside."""
    if not found:
        return "-"
    times = found["cpu_s"]
    if not times:
        return str(found["exact"])
    spread = f" ({min(times):.3g} to {max(times):.3g})" if len(times) > 1 else ""
    clock = f", {statistics.median(found['clock_s']):.3g} s on the clock" if "clock_s" in found else ""
    parts = " + ".join(f"{name} {part_s:.3g}" for name, part_s in found.get("parts", {}).items())
    return f"{statistics.median(times):.3g} s{spread}{clock}{f': {parts}' * bool(parts)}, {found['peak_mb']:.0f} MB"


def table(results: dict[str, Any]) -> str:
    """The table of all rows, with the machine."""
    most = max(len(found["now"]["cpu_s"]) for found in results["rows"].values() if "cpu_s" in found.get("now", {}))
    lines = [
        f"{results['machine']}; processor time, median of up to {most} (least to most), and peak memory; "
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
        exact = [now["exact"]]
        if before and "series" in now:
            exact.append("same bits as before" if before["series"] == now["series"] else "not the bits of before")
        if of_peer and of_peer.get("exact") and of_peer["cpu_s"]:
            exact.append(f"peer: {of_peer['exact']}")
        error = "; ".join(filter(None, exact))
        goal = f"{row.goal()}: {'met' if row.met(now, of_peer) else 'missed'}" if row.goal() else ""
        lines.append(f"| {row.what} | {theirs} | {seconds(before)} | {seconds(now)} | {goal} | {error} |")
    for name, (_, rows_of) in PROGRAMS.items():
        if name in results["programs"]:
            lines += [f"| {' | '.join(cells)} |" for cells in rows_of(results["programs"][name])]
    return "\n".join(lines)


# --- what has a program of its own: its command, and its rows ---------------------------------------------------------


def _compared(what: str, goal: float, peer: str, theirs: float, ours: float) -> tuple[str, ...]:
    """A row of rates, with what the ratio has to be (0: anything)."""
    wanted = f"{goal:g} of the peer: {'met' if ours >= goal * theirs else 'missed'}" if goal else ""
    return what, f"{peer}: {theirs:,.0f}", "-", f"{ours:,.0f}", wanted, f"{ours / theirs:.2f} of the peer"


def bag_rows(found: dict[str, Any]) -> list[tuple[str, ...]]:
    """Writing, reading and replaying."""
    write, read, unit = found["write"], found["read"], "messages per second of processor"
    plain = read["AnyReader with deserialisation"]
    return [
        _compared(f"bags, write, {unit}", 0.0, "rosbags", write["rosbags, zstd"], write["BagWriter, zstd"]),
        _compared(
            f"bags, record: queue, thread, disk, {unit}",
            0.8,
            "rosbags",
            write["rosbags, zstd"],
            write["recorder: queue + thread + sync, zstd"],
        ),
        _compared(f"bags, read, {unit}", 0.0, "rosbags", read["AnyReader, raw"], read["BagReader, raw"]),
        _compared(
            f"bags, replay with control, {unit}",
            1.0,
            "bare reading with deserialisation, rosbags",
            plain,
            read["replay with control, compared"],
        ),
    ]


#: Half of what the first command took from an empty kernel cache when that was to be halved, s.
HALF_OF_COLD_S = 7.55


def start_rows(found: dict[str, Any]) -> list[tuple[str, ...]]:
    """Cold start, warm start, and the slowest `--help`."""

    def cells(what: str, times: list[list[float]], goal: float, note: str = "") -> tuple[str, ...]:
        clock_s, cpu_s = (statistics.median(column) for column in zip(*times, strict=True))
        wanted = f"{goal:g} s on the clock: {'met' if clock_s <= goal else 'missed'}" if goal < math.inf else ""
        return what, "-", "-", f"{cpu_s:.3g} s, {clock_s:.3g} s on the clock", wanted, note

    helps = {name: times for name, times in found.items() if name.endswith("--help")}
    slowest = max(helps, key=lambda name: statistics.median(clock for clock, _ in helps[name]))
    rows = [
        cells("compiled law until its first command, empty kernel cache", found["this"]["cold"], math.inf),
        cells("compiled law until its first command, full kernel cache", found["this"]["warm"], math.inf),
        cells("node until its first step, full kernel cache", found["power_manager"], math.inf),
        cells(f"`--help`, slowest of {len(helps)}", helps[slowest], 0.5, f"`{slowest}`"),
    ]
    if cold := found.get("power_manager, empty cache"):
        over = found["power_manager, empty cache, compiled"]
        note = "law as plain Python, equal split"
        rows.insert(2, cells("node until its first step, empty kernel cache", cold, HALF_OF_COLD_S, note))
        note = "with the process that compiles, which gives way to the node"
        rows.insert(3, cells("node until it drives with the compiled law, empty kernel cache", over, math.inf, note))
    return rows


def fleet_rows(found: dict[str, Any]) -> list[tuple[str, ...]]:
    """A study on both cores, and the same with a worker that dies."""
    alone_s = found["serial_cpu_s"]
    rows = []
    for row in found["settings"]:
        if (row["workers"], row["batch_s"]) == (2, 2.0):
            goal = f"cores above 95 % busy: {'met' if row['busy_percent'] > 95.0 else 'missed'}"
            rows.append(
                (
                    f"{found['drives']} drives, two workers{', one killed half-way' * row['killed']}",
                    f"one process: {alone_s:.3g} s",
                    "-",
                    f"{row['wall_s']:.3g} s on the clock",
                    "" if row["killed"] else goal,
                    f"rows of one process, bit for bit; cores {row['busy_percent']:.1f} % busy",
                )
            )
    return rows


PROGRAMS: dict[str, tuple[list[str], Callable[[dict[str, Any]], list[tuple[str, ...]]]]] = {
    "bags": (["bags.py", "--steps", "3000"], bag_rows),
    "start": (["cold_start.py"], start_rows),
    "fleet": (["fleet.py"], fleet_rows),
}


def _of_program(name: str, page: Path | None) -> dict[str, Any]:
    """What a program measured; that of the fleet writes the page beside this one, too."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "found.json"
        beside: list[str | Path] = []
        if page and name == "fleet":
            path, beside = page.with_name("scale.json"), ["--page", page.with_name("scale.md")]
        script, *given = PROGRAMS[name][0]
        command = [sys.executable, Path(__file__).with_name(script), *given, "--json", path, *beside]
        subprocess.run(command, env={**os.environ, "PYTHONPATH": str(ROOT)}, check=True, stdout=sys.stderr)
        return dict(json.loads(path.read_text()))


def _peer(row: str, options: argparse.Namespace) -> dict[str, Any] | None:
    name = ROWS[row].peer
    if name == "quantecon":
        return measured(f"quantecon_{row}" if ROWS[row].size else name, 1, ROOT)
    if name == "naive":
        return measured(name, options.repeat, ROOT)
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
    every = [*ROWS, *PROGRAMS]
    words = "default: all; the others stay as they stand in --json"
    parser.add_argument("--rows", nargs="+", choices=every, default=every, help=words)
    parser.add_argument("--repeat", type=int, default=5, help="timed runs of each row (default: %(default)s)")
    parser.add_argument("--before", type=Path, metavar="FOLDER", help="an earlier checkout")
    parser.add_argument("--fastsim", metavar="PYTHON", help="an interpreter with benchmarks/requirements.txt")
    parser.add_argument("--json", metavar="FILE", help="write all numbers")
    parser.add_argument("--page", type=Path, metavar="FILE", help="put the table between the markers of this page")
    parser.add_argument("--child", choices=list(CHILDREN), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        found = CHILDREN[options.child](options.repeat)
        print(json.dumps({"peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0} | found))
        return
    processor = platform.processor() or platform.machine()
    with contextlib.suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        processor = next(line.split(": ")[1] for line in lines if line.startswith("model name"))
    known = Path(options.json or "")
    stored = json.loads(known.read_text()) if options.rows != every and known.is_file() else {}
    results: dict[str, Any] = {
        "machine": f"{processor}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "load": max(os.getloadavg()[0], stored.get("load", 0.0)),
        "rows": stored.get("rows", {}),
        "programs": stored.get("programs", {}),
    }
    for name in options.rows:
        began = time.perf_counter()
        if name in PROGRAMS:
            results["programs"][name] = _of_program(name, options.page)
        else:
            compared = options.before and not ROWS[name].size
            row = {"before": measured(name, options.repeat, options.before.resolve())} if compared else {}
            row["now"] = measured(name, options.repeat, ROOT)
            if peer := _peer(name, options):
                row["peer"] = peer
            results["rows"][name] = row
        print(f"{name}: measured in {time.perf_counter() - began:.0f} s", file=sys.stderr, flush=True)
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
