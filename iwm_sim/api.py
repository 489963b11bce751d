# SPDX-License-Identifier: Apache-2.0
"""The package from Python: load a car and its policies, look into them, drive, and get the numbers.

>>> from iwm_sim import api
>>> car = api.load_car("jalalmaab_2015", idle_drive="drag")
>>> policy = api.load_bank("policies", car).nearest(friction=0.45)
>>> api.plot_share(policy, previous_share=0.5).savefig("share.png")
>>> ours = api.drive("nycc", car, friction=0.9, policy=policy)
>>> equal = api.drive("nycc", car, friction=0.9, strategy="equal")
>>> ours.saving_percent(equal), ours.metrics.wh_per_km
>>> frame = ours.frame()  # a pandas.DataFrame, a row for each control step

Files are named as the commands name them: by path, or, where they come with the package, by their short name. Bad input
raises an `iwm_power_manager.errors.IwmError`, whose text is one line.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from iwm_power_manager.control.settings import Settings, default_settings
from iwm_power_manager.control.strategies import DEFAULT_STRATEGY, STRATEGIES
from iwm_power_manager.control.table import empty_table
from iwm_power_manager.cycle import Cycle, load_cycle
from iwm_power_manager.errors import ConfigError, IwmError
from iwm_power_manager.policy import Policy, choose, load_policy, load_policy_bank
from iwm_power_manager.share import resolve
from iwm_power_manager.vehicle import Vehicle, load_vehicle
from iwm_sim import closed_loop
from iwm_sim.closed_loop import COLUMNS
from iwm_sim.metrics import Metrics, measure
from iwm_sim.study import rows

__all__ = ["Bank", "Drive", "drive", "load_bank", "load_car", "load_cycle_file", "plot_share", "share_map"]


@dataclass(frozen=True)
class Bank:
    """Policies for one car, by the friction they were solved for."""

    policies: tuple[Policy, ...]

    def nearest(self, friction: float) -> Policy:
        """The policy that the power manager would take on a road: the nearest friction by ratio."""
        return choose(list(self.policies), friction)


@dataclass(frozen=True)
class Drive:
    """A drive of a cycle in the closed loop.

    Attributes
    ----------
    strategy : its name
    cycle, car : what was driven
    run : series of every signal, `run["speed_mps"]`; its names with their units are `iwm_sim.closed_loop.Row`
    metrics : energy, trace, slip, changes of the split
    """

    strategy: str
    cycle: Cycle
    car: Vehicle
    run: closed_loop.Run = field(repr=False)
    metrics: Metrics

    def saving_percent(self, reference: Drive) -> float | None:
        """Energy saved against another drive, %; None if their distances differ by 0.1 %, or one lost the trace."""
        return rows.saving_percent(self.metrics, reference.metrics)

    def columns(self) -> Mapping[str, NDArray[np.float64]]:
        """Every signal by name, (N,) each; units are in the names."""
        return {name: self.run[name] for name in COLUMNS}

    def frame(self) -> Any:
        """The signals as a pandas.DataFrame: a row for each control step, `time_s` as its index.

        Its columns are those of `iwm_sim.closed_loop.Row`, which says what each is and its unit. `IwmError` without
        pandas.
        """
        try:
            import pandas as pd
        except ImportError:
            raise IwmError("a DataFrame needs pandas, which is not installed: pip install pandas") from None
        return pd.DataFrame(self.columns()).set_index("time_s")


def load_car(name: str, idle_drive: str | None = None) -> Vehicle:
    """A car by file or short name; `idle_drive` ("none", "drag", "enabled") replaces what its file says."""
    return load_vehicle(resolve(name), idle_drive)


def load_bank(path: str, car: Vehicle) -> Bank:
    """Policies of a folder that belong to a car, or a single policy file."""
    found = resolve(path)
    if os.path.isfile(found):
        policy = load_policy(found)
        policy.check_vehicle(car, path)
        return Bank((policy,))
    return Bank(tuple(load_policy_bank(found, car)))


def load_cycle_file(name: str) -> Cycle:
    """A drive cycle by file or short name."""
    return load_cycle(resolve(name))


def drive(
    cycle: str | Cycle,
    car: Vehicle,
    friction: float,
    policy: Policy | None = None,
    strategy: str = "",
    settings: Settings | None = None,
    **options: Any,
) -> Drive:
    """Drive a cycle: driver, control law and plant in this process, as `evaluate` does.

    Parameters
    ----------
    cycle : file, short name, or a loaded cycle
    car : what is driven
    friction : peak friction coefficient of the road
    policy : of this car; with one, the strategy is the default one
    strategy : key of `control.strategies.STRATEGIES`; "" is `sdp_lookahead` with a policy and `equal` without
    settings : of the law; its strategy is replaced
    options : `dt_s` (control step, 0.01 s unless given), `soc` (at the start, 0..1), `until_s` and what else
        `closed_loop.run` takes

    The split is decided every `settings.decision_period_s`, 0.02 s by default. `evaluate`'s `paper_sdp` is no strategy
    of its own but strategy `sdp` with a policy on grid `paper`, decided every 0.1 s (`docs/python.md` has the lines).

    Raises
    ------
    ConfigError, PolicyError
        A file is wrong, the strategy needs a policy, or the policy belongs to another car.
    """
    name = strategy or (DEFAULT_STRATEGY if policy else "equal")
    if name not in STRATEGIES:
        raise ConfigError("arguments", "strategy", f"{name!r} is none", ", ".join(STRATEGIES))
    if STRATEGIES[name].needs_policy and policy is None:
        raise ConfigError("arguments", "policy", f"is missing; {name} needs one")
    loaded = load_cycle_file(cycle) if isinstance(cycle, str) else cycle
    if policy is not None:
        policy.check_vehicle(car)
    law = (settings or default_settings())._replace(strategy=STRATEGIES[name].code)
    table = policy.table() if policy is not None and STRATEGIES[name].needs_policy else empty_table()
    run = closed_loop.run(loaded, car, law, table, friction, **options)
    return Drive(name, loaded, car, run, measure(run, car.params))


def share_map(
    policy: Policy, previous_share: float = 0.5, slip: float = 0.0
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """The front share over demand and speed, both slips and the previous share at their nearest grid points.

    Returns
    -------
    demand, W, (P,); speed, m/s, (V,); front share (P, V)
    """
    problem = policy.problem
    at = [
        int(np.argmin(np.abs(np.asarray(axis) - value)))
        for axis, value in (
            (problem.slip_front, slip),
            (problem.slip_rear, slip),
            (problem.previous_shares, previous_share),
        )
    ]
    return problem.power_w, problem.speed_mps, policy.front_share[:, :, at[0], at[1], at[2]]


def plot_share(policy: Policy, previous_share: float = 0.5, slip: float = 0.0) -> Figure:
    """A picture of `share_map`."""
    power_w, speed_mps, share = share_map(policy, previous_share, slip)
    with mpl.rc_context({"font.size": 10.0}):
        figure = Figure(figsize=(6.0, 4.0), layout="constrained")
        axis = figure.subplots()
        image = axis.pcolormesh(
            speed_mps, power_w / 1000.0, share, cmap="coolwarm", vmin=0.0, vmax=1.0, shading="nearest", rasterized=True
        )
        axis.set_xlabel("Speed, m/s")
        axis.set_ylabel("Power demand, kW")
        before = f", previous share {previous_share:g}" if policy.problem.previous_share else ""
        axis.set_title(
            f"Grid {policy.problem.name}, friction {policy.friction:g}, idle drive {policy.idle_drive}{before}",
            fontsize=10.0,
        )
        figure.colorbar(image, ax=axis).set_label("Front share")
    return figure
