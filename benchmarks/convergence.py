#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Does the step matter? Energy of the four cycles at half the control step and at two plant steps to a control step.

Exit code 1 where halving either changes a cycle's chemical energy by 0.1 % or more.
"""

from __future__ import annotations

import argparse
import sys

from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.control.strategies import STRATEGIES
from iwm_power_manager.control.table import empty_table
from iwm_power_manager.cycle import load_cycle
from iwm_power_manager.errors import IwmError
from iwm_power_manager.share import resolve, share_path
from iwm_power_manager.vehicle import load_vehicle
from iwm_sim.closed_loop import run

CYCLES = ("ftp75", "hwfet", "nycc", "udds")
ALLOWED_PERCENT = 0.1
#: Strategies that need no solved policy.
CHOICES = [name for name in STRATEGIES if name in ("equal", "instantaneous", "instantaneous_slip")]


def main() -> int:
    """Run all, print the table."""
    parser = argparse.ArgumentParser(description="Convergence of the closed loop with its step.")
    parser.add_argument("--vehicle", default="config/vehicles/jalalmaab_2015.yaml")
    parser.add_argument("--cycle", nargs="+", default=list(CYCLES), metavar="FILE")
    parser.add_argument("--strategy", choices=CHOICES, default="equal")
    parser.add_argument("--friction", type=float, default=0.9)
    parser.add_argument("--dt", type=float, default=0.01, metavar="SECONDS", help="control step")
    args = parser.parse_args()

    try:
        vehicle = load_vehicle(resolve(args.vehicle))
        cycles = [
            load_cycle(share_path(f"config/cycles/{name}.csv") if name in CYCLES else resolve(name))
            for name in args.cycle
        ]
    except IwmError as error:
        print(error, file=sys.stderr)
        return 1
    settings, table = default_settings(args.strategy), empty_table()

    def energy_wh(cycle, dt_s, substeps):
        made = run(cycle, vehicle, settings, table, args.friction, dt_s=dt_s, substeps=substeps)
        return made.final.energies.chemical_j / 3600.0

    print(f"{vehicle.name}, {args.strategy}, friction {args.friction:g}: chemical energy, Wh, and its change")
    print(f"{'cycle':10} {f'{args.dt:g} s':>12} {f'{args.dt / 2:g} s':>12} {'%':>9} {'2 substeps':>12} {'%':>9}")
    worst = 0.0
    for cycle in cycles:
        base = energy_wh(cycle, args.dt, 1)
        halved = energy_wh(cycle, args.dt / 2.0, 1)
        split = energy_wh(cycle, args.dt, 2)
        changes = [100.0 * (x / base - 1.0) for x in (halved, split)]
        worst = max(worst, *map(abs, changes))
        print(f"{cycle.name:10} {base:12.3f} {halved:12.3f} {changes[0]:9.4f} {split:12.3f} {changes[1]:9.4f}")
    print(f"largest change {worst:.4f} %, allowed {ALLOWED_PERCENT:g} %")
    return 0 if worst < ALLOWED_PERCENT else 1


if __name__ == "__main__":
    sys.exit(main())
