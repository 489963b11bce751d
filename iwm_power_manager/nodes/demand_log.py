# SPDX-License-Identifier: Apache-2.0
"""What the power manager keeps of the driver's demand for the next `solve_policy`, off the control path."""

from __future__ import annotations

import os
import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from iwm_power_manager.control.record import SIGNAL_NAMES
from iwm_power_manager.control.supervision import MODE_NORMAL
from iwm_power_manager.control.table import PolicyTable
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.mdp.demand_counts import DemandCounter, load_transitions, save_transitions
from iwm_power_manager.mdp.problem import load_problem
from iwm_power_manager.model.parameters import VehicleParams
from iwm_power_manager.ros import diagnostics
from iwm_power_manager.share import share_path

_SPEED = SIGNAL_NAMES.index("speed_mps")
_DEMAND = SIGNAL_NAMES.index("power_demand_w")
_MODE = SIGNAL_NAMES.index("mode")


class DemandLog:
    """Counts transitions of the demand and writes them to a file now and then.

    Parameters
    ----------
    path : file to write; one that exists is gone on from
    period_s : time between two writes
    table : policy in use, whose axes are counted on; without a policy those of the package's grid `coupled`
    vehicle : the car, whose powers and speeds that grid is relative to

    Raises
    ------
    ConfigError
        The file that exists is no such file, or is on other axes.
    """

    def __init__(self, path: Path, period_s: float, table: PolicyTable, vehicle: VehicleParams) -> None:
        self._path = path
        self._period_s = period_s
        axes = table.power_w, table.speed_mps, table.problem.dt_s
        if table.power_w.size < 2:
            grid = load_problem(share_path("config/grids/coupled.yaml")).for_car(vehicle)
            axes = grid.power_w, grid.speed_mps, grid.dt_s
        before = load_transitions(path) if os.path.exists(path) else None
        if before is not None and not before.fits(*axes):
            raise ConfigError(path, "", "was counted on the axes of another policy; choose another file")
        if not os.path.isdir(path.parent):
            raise ConfigError(path, "", "is in a folder that does not exist")
        self._counter = DemandCounter(*axes, before)
        self._written_s = time.monotonic()
        self._writer = ThreadPoolExecutor(1, "demand log")
        self._writing: Future[None] | None = None
        self._problem = ""

    def note(self, stamp_ns: int, numbers: list[float]) -> None:
        """Take one control step, as `control.record` has it; only normal driving counts."""
        if numbers[_MODE] == MODE_NORMAL:
            self._counter.add(stamp_ns, numbers[_SPEED], numbers[_DEMAND])
        else:
            self._counter.pause()

    def pause(self) -> None:
        """The next step does not follow from the last."""
        self._counter.pause()

    def write_if_due(self) -> None:
        """Start writing in a thread, if it is time and the last write is over."""
        if self._writing is not None and self._writing.done():
            self._writing = None
        if self._writing is None and time.monotonic() - self._written_s >= self._period_s:
            self._written_s = time.monotonic()
            self._writing = self._writer.submit(self._write)

    def write(self) -> str:
        """Write now, and wait for it; returns what went wrong, "" if nothing did."""
        self._writer.submit(self._write).result()
        return self._problem

    def close(self) -> None:
        """Write and end the thread."""
        self.write()
        self._writer.shutdown()

    def _write(self) -> None:
        try:
            save_transitions(self._counter.transitions(), self._path)
            self._problem = ""
        except ConfigError as error:
            self._problem = str(error)

    def status(self) -> diagnostics.Status:
        """File, number of transitions, and whether writing works."""
        level = diagnostics.WARN if self._problem else diagnostics.OK
        values = {"file": str(self._path), "transitions": str(self._counter.total)}
        return diagnostics.Status("demand log", level, self._problem or "counting", values)
