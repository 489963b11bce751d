# SPDX-License-Identifier: Apache-2.0
"""What a case is: one drive of one car over one cycle on one road with one strategy.

A case holds file names and plain numbers only, so that it travels to a worker process as it is. Everything it needs is
loaded there, once for each worker. The same case always gives the same numbers, whoever drives it.
"""

from __future__ import annotations

import dataclasses
import functools
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from iwm_power_manager.control.settings import Settings, default_settings
from iwm_power_manager.control.strategies import STRATEGIES
from iwm_power_manager.control.table import PolicyTable, empty_table
from iwm_power_manager.cycle import Cycle, load_cycle
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.files import atomic_write, friction_in_name
from iwm_power_manager.model.parameters import VehicleParams
from iwm_power_manager.policy import Policy, PolicyBank, load_policy
from iwm_power_manager.share import resolve
from iwm_power_manager.vehicle import Vehicle, load_vehicle, with_params
from iwm_sim import closed_loop, preview
from iwm_sim.closed_loop import Noise, Run
from iwm_sim.metrics import Metrics, measure
from iwm_sim.study import generate
from iwm_sim.study.names import REFERENCE

FloatArray = npt.NDArray[np.float64]

#: Strategies that need a solved policy.
POLICY_STRATEGIES = frozenset(name for name, known in STRATEGIES.items() if known.needs_policy)

#: The cycle the generalized rule is fitted to, as in the paper.
RULE_CYCLE = "config/cycles/ftp75.csv"

#: The car that drawn ones are drawn around.
BASE_CAR = "config/vehicles/jalalmaab_2015.yaml"


class SensorNoise(NamedTuple):
    """White noise of the sensors, rms, with the seed it is drawn from."""

    speed_mps: float = 0.0
    wheel_radps: float = 0.0
    seed: int = 1


NO_NOISE = SensorNoise()


class Change(NamedTuple):
    """A number of the car that is not what its file says: `chassis.mass_kg` becomes `value`."""

    section: str
    name: str
    value: float


@dataclass(frozen=True)
class Case:
    """One drive.

    Attributes
    ----------
    cycle, vehicle : files, or names of files of the package
    idle_drive : "none", "drag" or "enabled"
    friction : peak friction coefficient of the road
    strategy : name in `STRATEGIES`
    label : what tables call it; "" is the strategy
    settings : of the law; its strategy is replaced by `strategy`
    policy : policy file; "" if the strategy needs none
    rule : coefficients of strategy `rule`
    switching_cost_j, switching_fixed_cost_j : of strategy `preview`
    changes_per_min : of strategy `preview`: a budget of changes, whose price is found; 0 takes the prices
    dt_s : control step
    soc : at the start
    assumed_friction : what the law is told; None is the truth
    policies : folder or file of policies over friction; with it, the law is told the friction it has estimated
    noise : of the sensors
    car : changes of the car, known to driver and law
    plant : changes of the car nobody knows of
    keep : columns of `closed_loop.COLUMNS` to hand back
    """

    cycle: str
    vehicle: str
    idle_drive: str
    friction: float
    strategy: str
    label: str = ""
    settings: Settings = field(default_factory=default_settings)
    policy: str = ""
    rule: tuple[float, ...] = ()
    switching_cost_j: float = 0.0
    switching_fixed_cost_j: float = 0.0
    changes_per_min: float = 0.0
    dt_s: float = 0.01
    soc: float = 0.8
    assumed_friction: float | None = None
    policies: str = ""
    noise: SensorNoise = NO_NOISE
    car: tuple[Change, ...] = ()
    plant: tuple[Change, ...] = ()
    keep: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """What tables call the strategy."""
        return self.label or self.strategy

    @property
    def price_text(self) -> str:
        """What a change of the share costs strategy `preview`, or how many it may make."""
        if self.changes_per_min > 0.0:
            return f"at most {self.changes_per_min:g} changes a minute"
        fixed = f" + {self.switching_fixed_cost_j:g} J for any change" if self.switching_fixed_cost_j else ""
        return f"{self.switching_cost_j:g} J a move{fixed}"

    @property
    def law_friction(self) -> float:
        """Friction the law assumes."""
        return self.friction if self.assumed_friction is None else self.assumed_friction


class Result(NamedTuple):
    """A driven case: its metrics, and the columns it was to keep."""

    case: Case
    metrics: Metrics
    series: dict[str, FloatArray]


def drawn_seed(name: str) -> int | None:
    """Seed of a car or cycle that is drawn (`generated:1000`) and stands in no file; None for a file."""
    kind, _, seed = name.partition(":")
    return int(seed) if kind == "generated" and seed.isdecimal() else None


@functools.lru_cache(maxsize=64)
def cycle_of(path: str) -> Cycle:
    """A cycle by file or short name, or drawn: `generated:SEED`."""
    seed = drawn_seed(path)
    return load_cycle(resolve(path)) if seed is None else generate.cycle(seed)


@functools.lru_cache(maxsize=16)
def vehicle_of(path: str, idle_drive: str, changes: tuple[Change, ...] = ()) -> Vehicle:
    """A car by file or short name, or drawn (`generated:SEED`), with some of its numbers changed."""
    seed = drawn_seed(path)
    vehicle = load_vehicle(resolve(path), idle_drive or None) if seed is None else drawn_car(seed, BASE_CAR, idle_drive)
    return with_params(vehicle, vehicle.name, changed(vehicle.params, changes)) if changes else vehicle


def drawn_car(seed: int, base: str, idle_drive: str) -> Vehicle:
    """A car that nobody chose, around another one; a third of them has the package's motor map, scaled."""
    around = load_vehicle(resolve(base), idle_drive or None)
    mapped = load_vehicle(resolve("jalalmaab_2015_map")).params.front.motor
    return generate.car(seed, around, mapped._replace(idle_drive=around.params.front.motor.idle_drive))


@functools.lru_cache(maxsize=16)
def policy_of(path: str) -> Policy:
    """A verified policy."""
    return load_policy(path)


@functools.lru_cache(maxsize=8)
def _table_of(path: str) -> PolicyTable:
    return policy_of(path).table()


def changed(params: VehicleParams, changes: Sequence[Change]) -> VehicleParams:
    """The numbers of a car with some of them replaced."""
    for change in changes:
        value = {change.name: float(change.value)}
        if change.section in params.front._fields:
            params = params.with_axles(**{change.section: getattr(params.front, change.section)._replace(**value)})
        else:
            params = params._replace(**{change.section: getattr(params, change.section)._replace(**value)})
    return params


def drive(case: Case, until_s: float = np.inf) -> Run:
    """Drive a case, or only its first `until_s` seconds.

    Raises
    ------
    ConfigError, PolicyError
        A file of it is wrong, or its policy was solved for another car.
    """
    vehicle = vehicle_of(case.vehicle, case.idle_drive, case.car)
    settings = case.settings._replace(strategy=STRATEGIES[case.strategy].code)
    table_of = None
    if case.policies:
        table_of = functools.partial(PolicyBank(case.policies, case.rule, vehicle).table, settings.strategy)
    return _driven(
        case,
        vehicle,
        settings,
        empty_table() if table_of else _policy_table(case, vehicle, until_s),
        until_s,
        noise=_noise(case.noise, cycle_of(case.cycle), case.dt_s),
        plant_vehicle=vehicle_of(case.vehicle, case.idle_drive, case.car + case.plant) if case.plant else None,
        table_of=table_of,
    )


def _driven(
    case: Case, vehicle: Vehicle, settings: Settings, policy: PolicyTable, until_s: float, **others: Any
) -> Run:
    """A drive of a case's cycle on its road; `others` as in `closed_loop.run`."""
    return closed_loop.run(
        cycle_of(case.cycle),
        vehicle,
        settings,
        policy,
        case.friction,
        assumed_friction=case.assumed_friction,
        dt_s=case.dt_s,
        soc=case.soc,
        until_s=until_s,
        **others,
    )


def result(case: Case) -> Result:
    """Drive a case and measure it."""
    run = drive(case)
    truth = vehicle_of(case.vehicle, case.idle_drive, case.car + case.plant)
    return Result(case, measure(run, truth.params), {name: run[name].copy() for name in case.keep})


def _policy_table(case: Case, vehicle: Vehicle, until_s: float) -> PolicyTable:
    if case.strategy in POLICY_STRATEGIES:
        policy_of(case.policy).check_vehicle(vehicle, case.policy)
        return _table_of(case.policy)
    if case.strategy == "rule":
        return empty_table(rule=case.rule)
    if case.strategy == "preview":
        return empty_table(schedule=known_in_advance(case, vehicle, until_s)[1].tolist())
    return empty_table()


def known_in_advance(case: Case, vehicle: Vehicle, until_s: float = np.inf) -> tuple[Run, FloatArray]:
    """A drive of the cycle with equal split, and the best schedule for the demand it had (`preview`)."""
    law = case.settings._replace(strategy=STRATEGIES[REFERENCE].code)
    equal = _driven(case, vehicle, law, empty_table(), until_s)
    prices_j = (case.switching_cost_j, case.switching_fixed_cost_j)
    drive = (equal, case.settings.decision_period_s, vehicle.params, case.law_friction)
    return equal, preview.schedule(*drive, case.changes_per_min or None, prices_j)


def priced_as(case: Case, policy: str) -> Case:
    """A case with a policy's budget of changes; without one, with its prices of a change."""
    problem = policy_of(policy).problem
    if problem.changes_per_min > 0.0:
        return dataclasses.replace(case, changes_per_min=problem.changes_per_min)
    return dataclasses.replace(
        case, switching_cost_j=problem.switching_cost_j, switching_fixed_cost_j=problem.switching_fixed_cost_j
    )


class Rule(NamedTuple):
    """The generalized rule and what it was fitted to: demand and schedule of each decision, and the line's numbers."""

    coefficients: tuple[float, ...]
    power_demand_w: FloatArray
    front_share: FloatArray


def fitted_rule(case: Case) -> Rule:
    """Strategy `rule` for a case's car and road: dynamic programming on FTP-75 and straight lines through it.

    On equal motors the front axle alone and the rear axle alone are as good, and a line through a mixture of both says
    neither. So the lines are also fitted with every split turned to the front, and to the rear; of the three, the one
    that drives FTP-75 with the least energy is the rule.
    """
    over = dataclasses.replace(case, cycle=RULE_CYCLE, strategy="rule", keep=())
    equal, schedule = known_in_advance(over, vehicle_of(case.vehicle, case.idle_drive, case.car))
    demand = equal["power_demand_w"][:: round(case.settings.decision_period_s / case.dt_s)]
    candidates = [
        Rule(tuple(preview.fit_rule(demand, share).tolist()), demand, share)
        for share in (schedule, np.maximum(schedule, 1.0 - schedule), np.minimum(schedule, 1.0 - schedule))
    ]
    return min(candidates, key=lambda rule: result(dataclasses.replace(over, rule=rule.coefficients)).metrics.wh_per_km)


def _noise(noise: SensorNoise, cycle: Cycle, dt_s: float) -> Noise:
    if noise.speed_mps == 0.0 and noise.wheel_radps == 0.0:
        return closed_loop.NO_NOISE
    steps = int(cycle.duration_s / dt_s) + 2
    random = np.random.default_rng(noise.seed)
    return Noise(
        noise.speed_mps * random.standard_normal(steps), noise.wheel_radps * random.standard_normal((steps, 4))
    )


def check(case: Case) -> None:
    """Refuse what argument types cannot exclude, before any work is done: bad files, a step that fits nothing."""
    cycle = cycle_of(case.cycle)
    vehicle_of(case.vehicle, case.idle_drive, case.car + case.plant)
    if cycle.duration_s < 2 * case.dt_s:
        raise ConfigError(case.cycle, "time_s", f"{cycle.duration_s:g} s is too short", f">= {2 * case.dt_s:g} s")
    period = case.settings.decision_period_s / case.dt_s
    if case.strategy in ("preview", "rule") and abs(period - round(period)) > 1e-6:
        raise ConfigError(
            "arguments",
            "--dt",
            f"{case.dt_s:g} s does not divide the decision period {case.settings.decision_period_s:g} s, which "
            f"{case.strategy} needs",
            "for instance 0.01, 0.005, 0.002 s",
        )


def save_series(folder: Path | str, made: Result) -> None:
    """Write what a result kept as a compressed .npz named after the case; `ConfigError` if it cannot be written."""
    case = made.case
    road = f"mu{friction_in_name(case.friction)}"
    name = f"{cycle_of(case.cycle).name}_{case.idle_drive}_{road}_{case.name}.npz"
    stream = io.BytesIO()
    np.savez_compressed(stream, allow_pickle=False, **made.series)
    atomic_write(Path(folder) / name, stream.getvalue())
