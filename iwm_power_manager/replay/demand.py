# SPDX-License-Identifier: Apache-2.0
"""Recorded drives as a source of demand for the solver."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from iwm_power_manager.mdp.demand import Source, signal_source
from iwm_power_manager.mdp.problem import Problem
from iwm_power_manager.replay.recorded import RecordedDrive, read_signal
from iwm_power_manager.share import resolve
from iwm_power_manager.signals.mapping import load_mapping
from iwm_power_manager.vehicle import Vehicle


def read_drives(
    bags: Sequence[str], mapping: str | None, vehicle: Vehicle, command: str
) -> list[tuple[str, RecordedDrive]]:
    """Name and content of recorded drives; what is wrong with them goes to stderr in the name of a command."""
    known = load_mapping(resolve(mapping) if mapping else None) if bags else None
    drives = []
    for path in bags:
        drive = read_signal(path, known, vehicle.params)
        for damage in drive.damage:
            print(f"{command}: warning: {path}: {damage}", file=sys.stderr)
        if drive.bad_messages:
            print(f"{command}: warning: {path}: {drive.bad_messages} bad messages left out", file=sys.stderr)
        drives.append((Path(path).name, drive))
    return drives


def drive_source(name: str, drive: RecordedDrive, problem: Problem, weight: float) -> Source:
    """A recorded drive as a source of demand."""
    return signal_source(name, drive.time_s, drive.power_demand_w, problem.dt_s, weight, drive.speed_mps)
