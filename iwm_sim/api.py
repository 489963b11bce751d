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

import inspect
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from iwm_power_manager.control.settings import TABLE, Settings, as_shown, check_together, default_settings, problem_with
from iwm_power_manager.control.strategies import DEFAULT_STRATEGY, STRATEGIES, drivable
from iwm_power_manager.control.table import empty_table
from iwm_power_manager.cycle import Cycle, load_cycle
from iwm_power_manager.errors import ConfigError, IwmError, did_you_mean, spelled_like
from iwm_power_manager.files import check_number
from iwm_power_manager.policy import Policy, choose, load_policy, load_policy_bank
from iwm_power_manager.share import resolve
from iwm_power_manager.tools.solver_figures import draw_share, share_map
from iwm_power_manager.vehicle import Vehicle, load_vehicle
from iwm_sim import closed_loop
from iwm_sim.closed_loop import COLUMNS
from iwm_sim.metrics import Metrics, measure
from iwm_sim.study import rows
from iwm_sim.study.names import MAX_DT_S

#: Range of each number that a drive takes.
_RANGES = {"friction": (0.05, 1.5), "soc": (0.0, 1.0), "dt_s": (1e-4, MAX_DT_S), "until_s": (MAX_DT_S, 1e9)}
_OPTIONS = [
    name for name, known in inspect.signature(closed_loop.run).parameters.items() if known.kind is known.KEYWORD_ONLY
]

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
    cycle, car, friction : what was driven
    run : series of every signal, `run["speed_mps"]`; its names with their units are `iwm_sim.closed_loop.Row`
    metrics : energy, trace, slip, changes of the split
    """

    strategy: str
    cycle: Cycle
    car: Vehicle
    friction: float
    run: closed_loop.Run = field(repr=False)
    metrics: Metrics

    def saving_percent(self, reference: Drive) -> float:
        """Energy saved against another drive, %; NaN if their distances differ by 0.1 %, or one lost the trace.

        `IwmError` if the other is of another cycle or road: that is no saving.
        """
        for what, one, other in (
            ("cycle", self.cycle.name, reference.cycle.name),
            ("friction", self.friction, reference.friction),
        ):
            if one != other:
                raise IwmError(f"no saving: one drive has {what} {one}, the other {other}")
        saved = rows.saving_percent(self.metrics, reference.metrics)
        return np.nan if saved is None else saved

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
    car: str | Vehicle,
    friction: float,
    policy: Policy | None = None,
    strategy: str = "",
    settings: Settings | None = None,
    rule: Sequence[float] = (),
    **options: Any,
) -> Drive:
    """Drive a cycle: driver, control law and plant in this process, as `evaluate` does.

    Parameters
    ----------
    cycle : file, short name, or a loaded cycle
    car : file, short name, or a loaded car
    friction : peak friction coefficient of the road
    policy : of this car; with one, the strategy is the default one
    strategy : one of `control.strategies.drivable()`; "" is `sdp_lookahead` with a policy and `equal` without
    settings : of the law; its strategy is replaced
    rule : coefficients a, b, c, d of strategy `rule`, as the power manager's parameter has them
    options : `dt_s` (control step, 0.01 s unless given), `soc` (at the start, 0..1), `until_s` and what else
        `closed_loop.run` takes

    The split is decided every `settings.decision_period_s`, 0.02 s by default. `evaluate`'s `paper_sdp` is no strategy
    of its own but strategy `sdp` with a policy on grid `paper`, decided every 0.1 s (`docs/python.md` has the lines).

    Raises
    ------
    ConfigError, PolicyError
        A file is wrong, a number out of its range, a policy is missing or belongs to another car.
    """
    name = strategy or (DEFAULT_STRATEGY if policy else "equal")
    _check(name, policy, rule, settings or default_settings(), {"friction": friction, **options})
    loaded = load_cycle_file(cycle) if isinstance(cycle, str) else cycle
    car = load_car(car) if isinstance(car, str) else car
    if policy is not None:
        policy.check_vehicle(car)
    law = (settings or default_settings())._replace(strategy=STRATEGIES[name].code)
    table = policy.table() if policy is not None and STRATEGIES[name].needs_policy else empty_table(rule=rule)
    run = closed_loop.run(loaded, car, law, table, friction, **options)
    return Drive(name, loaded, car, friction, run, measure(run, car.params))


def _check(
    strategy: str, policy: Policy | None, rule: Sequence[float], settings: Settings, options: Mapping[str, Any]
) -> None:
    """Refuse what cannot be driven, as the commands do."""
    if strategy not in drivable():
        future = strategy in STRATEGIES and STRATEGIES[strategy].knows_future
        problem = "knows the whole cycle; `evaluate --strategy preview` plans and drives it" if future else "is none"
        raise ConfigError("arguments", "strategy", f"{strategy!r} {problem}", ", ".join(drivable()))
    if STRATEGIES[strategy].needs_policy and policy is None:
        raise ConfigError("arguments", "policy", f"is missing; {strategy} needs one")
    if len(rule) != (4 if strategy == "rule" else 0):
        raise ConfigError("arguments", "rule", f"has {len(rule)} numbers", "four for strategy rule, none for others")
    for key, value in options.items():
        if key in _RANGES and not (key == "until_s" and value == np.inf):
            check_number("arguments", key, value, *_RANGES[key])
        elif key != "friction" and key not in _OPTIONS:
            near = did_you_mean(spelled_like(key, _OPTIONS))
            raise ConfigError("arguments", key, "is no option", ", ".join(_OPTIONS) + near)
    shown = as_shown(settings)
    for key, value in shown.items():
        if key in TABLE and problem_with(TABLE[key], value):
            raise ConfigError("settings", key, problem_with(TABLE[key], value))
    if problem := check_together(shown):
        raise ConfigError("settings", "", problem)


def plot_share(policy: Policy, previous_share: float = 0.5, slip: float = 0.0) -> Figure:
    """A picture of `share_map`, as `solve_policy --plot` has it."""
    with mpl.rc_context({"font.size": 10.0}):
        figure = Figure(figsize=(6.0, 4.0), layout="constrained")
        draw_share(figure.subplots(), policy, previous_share, slip)
    return figure
