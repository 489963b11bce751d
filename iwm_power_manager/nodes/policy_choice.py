# SPDX-License-Identifier: Apache-2.0
"""Which policy the node runs: the bank over friction, the fallback, and what can be said about both."""

from __future__ import annotations

import os
from pathlib import Path

from iwm_power_manager.control.strategies import STRATEGIES
from iwm_power_manager.control.table import PolicyTable, empty_table
from iwm_power_manager.errors import PolicyError
from iwm_power_manager.policy import Policy, choose, load_policy_bank
from iwm_power_manager.ros import diagnostics
from iwm_power_manager.share import resolve
from iwm_power_manager.vehicle import Vehicle


class Policies:
    """The tables the law may be given, all loaded and verified before the node is active.

    Attributes
    ----------
    strategy : name of the strategy that runs
    fallback_reason : why `equal` runs instead of the strategy that was asked for; "" if it does not
    """

    def __init__(
        self,
        bank: list[Policy],
        files: dict[Path, int],
        strategy: str,
        missing: str,
        fallback_reason: str,
        rule: list[float],
    ) -> None:
        self.strategy = strategy
        self.fallback_reason = fallback_reason
        self._missing = missing
        self._bank = bank
        self._files = files
        self._tables = {policy.checksum: policy.table(rule) for policy in bank}
        self._empty = empty_table(rule=rule)
        self._chosen: Policy | None = None

    def table(self, friction: float) -> PolicyTable:
        """Table of the policy for the nearest friction; one without a policy if there is none."""
        if not self._bank:
            return self._empty
        self._chosen = choose(self._bank, friction)
        return self._tables[self._chosen.checksum]

    def tables(self) -> list[PolicyTable]:
        """Every table `table` can return."""
        return list(self._tables.values()) or [self._empty]

    def problem_with(self, strategy: str) -> str:
        """Why a strategy cannot run; "" if it can."""
        return (
            f"strategy: {strategy} needs a policy; {self._missing}" if _needs_policy(strategy) and self._missing else ""
        )

    def description(self) -> str:
        """Strategy and policy in use, in a few words."""
        if self._chosen is None:
            return f"strategy {self.strategy}, no policy"
        policy = self._chosen
        return f"strategy {self.strategy}, policy {policy.checksum[:12]} for friction {policy.friction:g}"

    def status(self) -> diagnostics.Status:
        """Identity of the policy in use, and whether its file is still the one that was loaded."""
        values = {"strategy": self.strategy, "policies": str(len(self._bank))}
        if self._chosen:
            values |= {
                "grid": self._chosen.problem.name,
                "friction": f"{self._chosen.friction:g}",
                "checksum": self._chosen.checksum,
                "vehicle": self._chosen.vehicle_name,
                "vehicle hash": self._chosen.vehicle_hash,
                "solved by version": self._chosen.package_version,
                "bound (J)": f"{self._chosen.bound_j:g}",
            }
        changed = [file.name for file, when in self._files.items() if _modified_ns(file) != when]
        if self.fallback_reason:
            return diagnostics.Status("policy", diagnostics.WARN, f"fallback to equal: {self.fallback_reason}", values)
        if changed:
            message = f"{', '.join(changed)} changed on disk; the policy loaded at configure stays in use"
            return diagnostics.Status("policy", diagnostics.WARN, message, values)
        return diagnostics.Status("policy", diagnostics.OK, f"{self.strategy}", values)


def choose_policies(path: str, strategy: str, fallback: str, rule: list[float], vehicle: Vehicle) -> Policies:
    """Load the bank a strategy needs, or fall back.

    Parameters
    ----------
    path : policy file or folder; "" for none
    strategy : name of the strategy
    fallback : "none", or "equal" to run equal split where the strategy's policy cannot be used
    rule : coefficients of the strategy `rule`
    vehicle : the car the policies have to be solved for

    Raises
    ------
    PolicyError
        The strategy needs a policy, there is none that is whole and for this car, and there is no fallback.
    """
    try:
        bank, files = _load(path, vehicle)
    except PolicyError as error:
        missing = str(error)
        if not _needs_policy(strategy):
            return Policies([], {}, strategy, missing, "", rule)
        if fallback == "none":
            raise
        return Policies([], {}, "equal", missing, missing, rule)
    return Policies(bank, files, strategy, "", "", rule)


def _needs_policy(strategy: str) -> bool:
    return STRATEGIES[strategy].needs_policy


def _load(path: str, vehicle: Vehicle) -> tuple[list[Policy], dict[Path, int]]:
    if not path:
        raise PolicyError("policy_file: is empty; allowed: a policy file, or a folder of them")
    resolved = resolve(path)
    bank = load_policy_bank(resolved, vehicle)
    files = sorted(resolved.glob("*.npz")) if os.path.isdir(resolved) else [resolved]
    return bank, {file: _modified_ns(file) for file in files}


def _modified_ns(file: Path) -> int:
    """When a file was last written; 0 if it is gone."""
    try:
        return file.stat().st_mtime_ns
    except OSError:
        return 0
