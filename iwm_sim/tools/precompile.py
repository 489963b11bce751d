# SPDX-License-Identifier: Apache-2.0
"""Compile every kernel that the programs call, once, so that they start warm: the last step of an installation."""

from __future__ import annotations

import argparse
import itertools
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from iwm_power_manager.command_line import CommandParser
from iwm_power_manager.tools.command import ended, write_json

#: What the work needs, but `--help` does not.
NEEDS = (
    "iwm_power_manager.compilation",
    "iwm_power_manager.solve",
    "iwm_power_manager.tools.progress",
    "iwm_sim.drive",
    "iwm_sim.preview",
)

#: Kernels of earlier versions that nobody has read for so long are removed, s.
UNUSED_FOR_S = 60 * 86400.0

Job = tuple[str, Callable[[], object]]


def jobs() -> Iterator[Job]:
    """What each program does first, in the smallest form, by name."""
    import numpy as np

    from iwm_power_manager.control.record import DECIDED_NAMES, SIGNALS
    from iwm_power_manager.control.repeat import advance, battery_limits, repeat
    from iwm_power_manager.control.settings import default_settings
    from iwm_power_manager.control.thresholds import Thresholds, for_car
    from iwm_power_manager.control.types import Measurement, initial_state
    from iwm_power_manager.cycle import Cycle
    from iwm_power_manager.files import read_yaml
    from iwm_power_manager.held import Held
    from iwm_power_manager.mdp.demand import chain_of, cycle_source, driven_source
    from iwm_power_manager.mdp.problem import problem_from
    from iwm_power_manager.model.limits import battery_limits_w
    from iwm_power_manager.policy import load_policy
    from iwm_power_manager.share import resolve
    from iwm_power_manager.solve import grid_path, solve_one
    from iwm_power_manager.vehicle import load_vehicle
    from iwm_sim import closed_loop, preview
    from iwm_sim.drive import Drive
    from iwm_sim.scenario import on_cycle

    vehicle = load_vehicle(resolve("jalalmaab_2015"))
    speed = np.array([0.0, 1.0, 2.0, 1.0, 0.0, 0.0])
    cycle = Cycle("precompile", np.arange(6.0), speed, np.zeros(6), "")
    table = load_policy(resolve("jalalmaab_2015_drag_coupled_mu090")).table()
    settings = default_settings()

    def control_law() -> None:
        for_car(Thresholds(), vehicle.params)
        discharge, charge = battery_limits_w(0.8, 25.0, vehicle.params.battery)
        measurement = Measurement(1.0, (3.0, 3.0, 3.0, 3.0), 500.0, 0.01, 0.9, discharge, charge, 0.8)
        before, after, car = Held(initial_state()), Held(initial_state()), Held(vehicle.params)
        battery_limits(0.8, 25.0, car)
        advance(measurement, before, after, settings, car, table)
        steps = np.zeros((0, len(SIGNALS)))
        repeat(steps, initial_state(), settings, vehicle.params, table, np.zeros((0, len(DECIDED_NAMES))))

    def simulated_car() -> None:
        drive = Drive(on_cycle(vehicle, cycle, 0.9), dt_s=0.01)
        drive.sense()
        drive.advance((0.0,) * 4, drive.pedal_brake_torque_nm())

    def closed_loop_run() -> closed_loop.Run:
        return closed_loop.run(cycle, vehicle, settings, table, 0.9, until_s=0.1)

    def schedule_known_ahead() -> None:
        preview.schedule(closed_loop_run(), 0.1, vehicle.params, 0.9)

    def solver() -> None:
        axes = {"power_w": [-1000, 0, 1000], "speed_mps": [0, 2], "share": [0, 0.5, 1]}
        quick = {"dt_s": 1.0, "discount": 0.5, "tolerance_j": 1.0}
        problem = problem_from(read_yaml(grid_path("coupled")) | axes | quick, "precompile")
        for source in (cycle_source(cycle, problem.dt_s, vehicle.params), driven_source(cycle, 0.1, vehicle.params)):
            chain = chain_of(problem, [source])
        with tempfile.TemporaryDirectory() as folder:
            solve_one(problem, vehicle, 0.9, chain, [source], Path(folder) / "policy.npz")

    yield "control law", control_law
    yield "simulated car", simulated_car
    yield "closed loop", closed_loop_run
    yield "schedule known ahead", schedule_known_ahead
    yield "solver", solver


def compile_for_a_drive() -> None:
    """What nodes and a drive in one process call: here, where it is shown, and once for all of them."""
    for _, job in itertools.islice(jobs(), 3):
        job()


def parser() -> argparse.ArgumentParser:
    """Options of `precompile`."""
    made = CommandParser(
        "precompile",
        description="Compile the vehicle model, the control law and the solver once, so that every program starts "
        "warm. The code is kept in ~/.cache/iwm_power_manager or, if it is set, in IWM_CACHE_DIR, which then has to "
        "be the same where the programs run. Needed again after an update; what is compiled already is only looked up.",
        epilog="exit codes: 0 done, 2 bad arguments, or a shipped file is unusable",
    )
    made.add_argument("--json", action="store_true", help="list every entry point with its seconds, as JSON")
    made.add_argument("--quiet", action="store_true", help="no progress bar")
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    """Compile everything; returns the exit code."""
    options = parser().parse_args(arguments)
    return ended("precompile", lambda: _compile(options), quiet=options.quiet)


def _compile(options: argparse.Namespace) -> None:
    from iwm_power_manager import compilation, kernel_cache
    from iwm_power_manager.tools.progress import Bar

    work = list(jobs())
    with Bar(len(work), "parts", "compiling", quiet=options.quiet) as bar:
        for name, job in work:
            bar.set_postfix_str(name)
            job()
            bar.update()
    kernel_cache.prune(UNUSED_FOR_S)
    if options.json:
        write_json("-", compilation.USES)
    else:
        new = [use for use in compilation.USES if not use.found]
        print(
            f"{len(compilation.USES)} entry points are ready, {len(new)} of them compiled now "
            f"({sum(use.seconds for use in new):.0f} s)"
        )


if __name__ == "__main__":
    sys.exit(main())
