#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Is what a recorded drive taught worth having? A policy learned from a drive beside one learned from standard cycles.

    python benchmarks/learning.py             the table of docs/bags.md
    python benchmarks/learning.py --scales 12 the same over twelve variants of the cycle, with standard errors

The cycle is driven once with equal split. From what a bag of that drive would hold, from the three standard cycles and
from both, policies are solved for every road and car, and drive the cycle. In percent of equal split's consumption by
distance: the energy, and in brackets the same with the price of moving the split, which is what is minimized.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import sys
import tempfile
from functools import partial
from pathlib import Path

import numpy as np

from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.control.table import empty_table
from iwm_power_manager.cycle import load_cycle
from iwm_power_manager.files import atomic_write
from iwm_power_manager.mdp.demand import chain_of, signal_source, source_of
from iwm_power_manager.mdp.problem import load_problem
from iwm_power_manager.share import share_path
from iwm_power_manager.solve import solve_one
from iwm_power_manager.vehicle import load_vehicle
from iwm_sim import learning
from iwm_sim.closed_loop import run
from iwm_sim.cluster import on_all_cores
from iwm_sim.study.names import cores

CAR = "config/vehicles/jalalmaab_2015.yaml"
CYCLES = ("ftp75", "hwfet", "nycc")
FRICTIONS = (0.9, 0.5, 0.2)
TAUGHT_BY = ("bag alone", "three cycles", "bag and cycles")
#: Variants of the cycle: its speed scaled by up to so much.
SPREAD = 0.03


def compare(cell: tuple[str, float], learned: str, scales: int) -> list[list[tuple[float, float]]]:
    """Energy, and energy with the price of moves, against equal split, %: by teacher, by variant of the cycle."""
    idle_drive, friction = cell
    vehicle = load_vehicle(share_path(CAR), idle_drive)
    problem = load_problem(share_path("config/grids/coupled.yaml")).for_car(vehicle.params)
    cycle = load_cycle(share_path(f"config/cycles/{learned}.csv"))
    equal = partial(run, vehicle=vehicle, settings=default_settings("equal"), policy=empty_table(), friction=friction)
    drive = equal(cycle)
    bag = signal_source(learned, drive["time_s"], drive["power_demand_w"], problem.dt_s, 1.0, drive["speed_mps"])
    general = [
        source_of(load_cycle(share_path(f"config/cycles/{name}.csv")), problem, vehicle.params) for name in CYCLES
    ]
    tables = []
    with tempfile.TemporaryDirectory() as folder:
        for sources in ([bag], general, [bag, *general]):
            chain = chain_of(problem, sources)
            tables.append(
                solve_one(problem, vehicle, friction, chain, sources, Path(folder) / "policy.npz").policy.table()
            )
    results: list[list[tuple[float, float]]] = [[] for _ in tables]
    for scale in np.linspace(1.0 - SPREAD, 1.0 + SPREAD, scales) if scales > 1 else (1.0,):
        variant = dataclasses.replace(cycle, speed_mps=cycle.speed_mps * scale)
        reference = equal(variant)
        base_j, base_m = reference["chemical_j"][-1], reference["distance_m"][-1]
        for table, result in zip(tables, results, strict=True):
            made = run(variant, vehicle, default_settings("sdp_lookahead"), table, friction)
            energy = 100.0 * (made["chemical_j"][-1] / made["distance_m"][-1] * base_m / base_j - 1.0)
            moves = learning.moves_j(np.diff(made["decided_share"]), tables[1])
            result.append((float(energy), float(energy + 100.0 * moves / base_j)))
    return results


def main() -> int:
    """Compare and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cycle", choices=CYCLES, default="nycc", help="is recorded, and driven (nycc)")
    parser.add_argument("--scales", type=int, default=1, metavar="N", help="variants of the cycle (1: as it is)")
    parser.add_argument("--jobs", type=int, default=0, metavar="N", help="processes (0: one for each core)")
    parser.add_argument("--json", metavar="FILE", help="write the numbers, too")
    options = parser.parse_args()
    cells = list(itertools.product(("none", "drag"), FRICTIONS))
    results = on_all_cores(
        partial(compare, learned=options.cycle, scales=options.scales), cells, options.jobs or cores()
    )
    print(f"| idle drive, friction | {' | '.join(TAUGHT_BY)} |")
    print("|---" * (1 + len(TAUGHT_BY)) + "|")
    for (idle_drive, friction), by_teacher in zip(cells, results, strict=True):
        means = np.mean(by_teacher, axis=1)
        print(
            f"| {idle_drive}, {friction:g} | "
            + " | ".join(f"{energy:.3f} ({priced:.3f})" for energy, priced in means)
            + " |"
        )
    if options.scales > 1:
        print(
            f"\nmore than the three cycles, percentage points, and its standard error over {options.scales} variants:"
        )
        print("| idle drive, friction | bag alone | bag and cycles |\n|---|---|---|")
        for (idle_drive, friction), by_teacher in zip(cells, results, strict=True):
            bag, general, both = np.array(by_teacher)
            texts = []
            for more in (bag - general, both - general):
                mean, error = more.mean(axis=0), more.std(axis=0, ddof=1) / np.sqrt(len(more))
                texts.append(f"{mean[0]:+.3f} ± {error[0]:.3f} ({mean[1]:+.3f} ± {error[1]:.3f})")
            print(f"| {idle_drive}, {friction:g} | {' | '.join(texts)} |")
    if options.json:
        named = [
            {"idle_drive": idle_drive, "friction": friction, **dict(zip(TAUGHT_BY, by_teacher, strict=True))}
            for (idle_drive, friction), by_teacher in zip(cells, results, strict=True)
        ]
        atomic_write(options.json, json.dumps(named, indent=1).encode())
    return 0


if __name__ == "__main__":
    sys.exit(main())
