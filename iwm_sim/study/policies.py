# SPDX-License-Identifier: Apache-2.0
"""Which policy a case drives with: one of a folder that fits car and road, or one solved now and kept for next time."""

from __future__ import annotations

import dataclasses
import hashlib
import os
from collections.abc import Callable, Sequence
from pathlib import Path

from iwm_power_manager.cycle import load_cycle
from iwm_power_manager.errors import PolicyError
from iwm_power_manager.files import make_folder, read_bytes
from iwm_power_manager.kernel_cache import cache_folder, sources_hash
from iwm_power_manager.mdp.demand import chain_of, source_of
from iwm_power_manager.mdp.problem import load_problem
from iwm_power_manager.policy import Policy, choose, load_policy
from iwm_power_manager.share import resolve
from iwm_power_manager.solve import grid_path, solve_one
from iwm_power_manager.vehicle import Vehicle
from iwm_sim.study.cases import policy_of
from iwm_sim.study.names import DEFAULT_GRID, DEFAULT_POLICY

#: Cycles a policy learns its demand from, as in the paper. UDDS is a part of FTP-75.
TRAINING_CYCLES = tuple(f"config/cycles/{name}.csv" for name in ("ftp75", "hwfet", "nycc"))


class PolicySource:
    """Finds policies in a folder or a file, and solves those that are missing.

    Parameters
    ----------
    path : folder (searched with its subfolders) or policy file
    grid : of the policies that count; "" takes any of a folder's, and solves a missing one on `DEFAULT_GRID`
    may_solve : False makes a missing policy an error; of a place that is not the package's own it is one anyway, since
        whoever names a place wants what is in it
    say : told, in one line, of everything that is solved
    """

    def __init__(
        self, path: str, grid: str = "", may_solve: bool = True, say: Callable[[str], None] = lambda _: None
    ) -> None:
        self._path = resolve(path)
        self._given = path
        self._grid = grid
        self._may_solve = may_solve and path == DEFAULT_POLICY
        self._say = say
        self._bank: dict[str, Policy] | None = None

    def find(self, vehicle: Vehicle, friction: float) -> str:
        """File of the policy for a car on a road: that for the nearest friction, as the power manager chooses it.

        A file that was named has to fit. Of a folder, the policies for other cars do not count; where none is left in
        the package's own, one is solved for exactly this friction.

        Raises
        ------
        PolicyError, ConfigError
        """
        bank = self._load()
        if os.path.isfile(self._path):
            ((file, policy),) = bank.items()
            policy.check_vehicle(vehicle, file)
            if not self._is_on_grid(policy):
                raise PolicyError(f"{file}: was solved on grid {policy.problem.name}, not on {self._grid}")
            return file
        fitting = {
            file: policy
            for file, policy in bank.items()
            if policy.vehicle_hash == vehicle.hash and self._is_on_grid(policy)
        }
        if fitting:
            best = choose(list(fitting.values()), friction)
            return next(file for file, policy in fitting.items() if policy is best)
        on_grid = f" on grid {self._grid}" if self._grid else ""
        problem = f"{self._given}: holds no policy for '{vehicle.name}' with idle_drive {vehicle.idle_drive}{on_grid}"
        if not self._may_solve:
            same = [policy for policy in bank.values() if policy.vehicle_name == vehicle.name]
            held = ", ".join(sorted({policy.idle_drive for policy in same}))
            held = f" (it has some with idle_drive {held})" if held not in ("", vehicle.idle_drive) else ""
            if any(policy.idle_drive == vehicle.idle_drive and policy.vehicle_hash != vehicle.hash for policy in same):
                held = " (it has some from before a number of the car changed)"
            raise PolicyError(f"{problem}{held}; solve one with solve_policy")
        return solved(vehicle, friction, self._grid or DEFAULT_GRID, self._say, because=problem)

    def _is_on_grid(self, policy: Policy) -> bool:
        return not self._grid or policy.problem.name == grid_path(self._grid).stem

    def _load(self) -> dict[str, Policy]:
        if self._bank is None:
            if os.path.isdir(self._path):
                files = sorted(self._path.rglob("*.npz"))
            elif os.path.isfile(self._path) or self._path.suffix == ".npz":
                files = [self._path]
            else:
                raise PolicyError(f"{self._given}: is neither a policy file nor a folder")
            self._bank = {str(file): policy_of(str(file)) for file in files}
        return self._bank


def solved(
    vehicle: Vehicle,
    friction: float,
    grid: str,
    say: Callable[[str], None] = lambda _: None,
    because: str = "",
    cycles: Sequence[str] = TRAINING_CYCLES,
    *,
    budget_per_min: float | None = None,
) -> str:
    """A policy for a car (as its file has it) and a road, from the user's cache, or solved now.

    Parameters
    ----------
    vehicle, friction : what it is for
    grid : preset or file
    say : told in one line if it is solved
    because : why it is needed, for that line
    cycles : it learns its demand from
    budget_per_min : changes of the split a minute; None is the grid's own

    Returns
    -------
    its file

    Raises
    ------
    IwmError
        It cannot be solved or written.
    """
    grid_file = grid_path(grid)
    solver = sources_hash("iwm_power_manager.solve")
    digest = hashlib.sha256(f"{vehicle.hash} {friction!r} {solver}".encode())
    if budget_per_min is not None:
        digest.update(f"{budget_per_min!r} a minute".encode())
    for file in (grid_file, *map(resolve, cycles)):
        digest.update(read_bytes(file))
    folder = cache_folder() / "policies"
    file = folder / f"{digest.hexdigest()[:24]}.npz"
    if not _is_whole(file):
        what = f"solving the policy on grid {grid_file.stem} for friction {friction:g}, idle_drive {vehicle.idle_drive}"
        say(f"{because}; {what}" if because else what)
        make_folder(folder)
        problem = load_problem(grid_file).for_car(vehicle.params)
        if budget_per_min is not None:
            problem = dataclasses.replace(problem, changes_per_min=budget_per_min)
        sources = [source_of(load_cycle(resolve(cycle)), problem, vehicle.params) for cycle in cycles]
        solve_one(problem, vehicle, friction, chain_of(problem, sources), sources, file)
    return str(file)


def _is_whole(file: Path) -> bool:
    try:
        load_policy(file)
    except PolicyError:
        return False
    return True
