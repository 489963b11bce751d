# SPDX-License-Identifier: Apache-2.0
"""What a study drives: the cells of the paper's tables, the rivals, the frontier, the robustness and the stops."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from iwm_power_manager.control.settings import GATE_MODES
from iwm_power_manager.files import atomic_write
from iwm_power_manager.mdp.problem import FORMAT as PROBLEM_FORMAT
from iwm_power_manager.mdp.problem import Problem
from iwm_power_manager.vehicle import Vehicle
from iwm_sim.cluster import on_all_cores
from iwm_sim.study import cases, labels, paper, skid
from iwm_sim.study.cases import Case, Change, Rule, SensorNoise
from iwm_sim.study.frontier import Frontier, Place
from iwm_sim.study.policies import PolicySource, solved
from iwm_sim.study.unseen import budgets_of
from iwm_sim.study.variants import VARIANTS

IDLE_DRIVES = ("none", "drag")
#: The strategy that plays our policy.
STRATEGY = "sdp_lookahead"

#: Power a change has to save, W, of the strongest rival in the tables.
RIVAL_SWITCHING_W = (40.0, 60.0, 100.0)

#: The frontier: cycle and road, and our budgets of changes a minute; the last one is as good as none.
FRONTIER_CYCLE, FRONTIER_FRICTION = "udds", 0.9
FRONTIER_BUDGETS_PER_MIN = (2.0, 4.0, 8.0, 14.0, 1000.0)

ROBUSTNESS_CYCLES = ("hwfet", "udds")

#: Where Figures 14 and 15 look, and what they need.
WINDOW_CYCLE, WINDOW_FRICTION = "udds", 0.2
WINDOW_SIGNALS = ("time_s", "front_power_w", "rear_power_w", "front_slip", "rear_slip")

#: Loss coefficients of a direct-drive hub motor, the second set of docs/model.md.
HUB_MOTOR = (
    Change("motor", "loss_constant_w", 40.0),
    Change("motor", "loss_linear_speed", 1.57),
    Change("motor", "loss_quadratic_speed", 0.0166),
    Change("motor", "loss_linear_torque", 1.50),
    Change("motor", "loss_quadratic_torque", 0.045),
)

#: A car's idle drive, and a road.
Key = tuple[str, float]


class Policies:
    """The policies of a study, each found or solved when it is first asked for.

    Parameters
    ----------
    vehicle, policy : car, and folder or file of our policies for it
    say, grid, may_solve : as in `PolicySource`

    `used` holds what was asked for, by name, idle drive and friction.
    """

    def __init__(
        self,
        vehicle: str,
        policy: str,
        say: Callable[[str], None] = lambda _: None,
        grid: str = "",
        may_solve: bool = True,
    ) -> None:
        self.vehicle = vehicle
        self._source = PolicySource(policy, grid, may_solve, say)
        self._say = say
        self.used: dict[tuple[str, str, float], str] = {}

    def car(self, idle_drive: str) -> Vehicle:
        """The car with an idle drive."""
        return cases.vehicle_of(self.vehicle, idle_drive)

    def ours(self, idle_drive: str, friction: float) -> str:
        """Our policy for a road."""
        key = (labels.OURS, idle_drive, friction)
        if key not in self.used:
            self.used[key] = self._source.find(self.car(idle_drive), friction)
        return self.used[key]

    def of_variant(self, name: str, idle_drive: str, friction: float) -> str:
        """The policy of a name in `VARIANTS` for a road."""
        key = (name, idle_drive, friction)
        if key not in self.used:
            self.used[key] = solved(self.car(idle_drive), friction, VARIANTS[name].grid, self._say)
        return self.used[key]


def grid_file(folder: Path, name: str, problem: Problem, settings: Mapping[str, Any]) -> Path:
    """A grid's file: that of a problem with some of its settings replaced."""
    content = problem.settings() | {"format": PROBLEM_FORMAT, **settings}
    del content["name"]
    path = folder / f"{name}.yaml"  # JSON is YAML
    atomic_write(path, json.dumps(content).encode())
    return path


@dataclass(frozen=True)
class Plan:
    """Cases by the part of the study they are for."""

    cells: list[Case] = field(default_factory=list)
    gates: list[Case] = field(default_factory=list)
    robustness: list[tuple[str, Case]] = field(default_factory=list)

    @property
    def cases(self) -> list[Case]:
        """All of them, in this order."""
        return [*self.cells, *self.gates, *(case for _, case in self.robustness)]


def keys() -> list[Key]:
    """Every idle drive on every road."""
    return [(idle_drive, friction) for idle_drive in IDLE_DRIVES for friction in paper.FRICTIONS]


def fitted_rules(vehicle: str, wanted: Sequence[Key], jobs: int) -> dict[Key, Rule]:
    """The paper's generalized rule for each idle drive and road."""
    over = [Case(cases.RULE_CYCLE, vehicle, idle_drive, friction, "rule") for idle_drive, friction in wanted]
    return dict(zip(wanted, on_all_cores(cases.fitted_rule, over, jobs), strict=True))


def whole(policies: Policies, cycles: Sequence[str], rules: Mapping[Key, Rule]) -> Plan:
    """All that a study drives, the longest cycles first."""
    plan = Plan()
    for cycle in sorted(cycles, key=lambda name: -cases.cycle_of(name).duration_s):
        for key in keys():
            watched = cycle == among(WINDOW_CYCLE, cycles) and key == (IDLE_DRIVES[0], WINDOW_FRICTION)
            keep = WINDOW_SIGNALS if watched else ()
            base = Case(cycle, policies.vehicle, *key, "equal")
            plan.cells.extend(cell(base, policies, rules[key].coefficients, keep))
            plan.gates.extend(gates(base, policies, keep))
    for idle_drive in IDLE_DRIVES:
        for cycle in dict.fromkeys(among(name, cycles) for name in ROBUSTNESS_CYCLES):
            plan.robustness.extend(robustness(Case(cycle, policies.vehicle, idle_drive, 0.9, "equal"), policies))
    return plan


def among(cycle: str, cycles: Sequence[str]) -> str:
    """A cycle, or the first one if it is not driven."""
    return cycle if cycle in cycles else cycles[0]


def cell(base: Case, policies: Policies, rule: tuple[float, ...], keep: tuple[str, ...] = ()) -> list[Case]:
    """All strategies in one cell of Tables 3 to 5, all under the law's normal settings."""
    key = (base.idle_drive, base.friction)
    policy = policies.ours(*key)
    rivals = [_rival(base, f"{labels.INSTANTANEOUS_SLIP} {power:g} W", power) for power in RIVAL_SWITCHING_W]
    return [
        replace(base, label=labels.ED, keep=keep),
        replace(base, strategy="rule", label=labels.GRDP, rule=rule),
        variant(base, labels.PAPER_SDP, policies),
        replace(base, strategy=STRATEGY, label=labels.OURS, policy=policy, keep=keep),
        replace(base, strategy="instantaneous", label=labels.INSTANTANEOUS),
        *rivals,
        replace(cases.priced_as(base, policy), strategy="preview", label=labels.BOUND),
        replace(base, strategy="preview", label=labels.FREE_BOUND),
    ]


def _rival(base: Case, label: str, power_w: float) -> Case:
    """The split of least battery power now, changed only where that saves so much."""
    settings = base.settings._replace(switching_power_w=power_w)
    return replace(base, strategy="instantaneous_slip", label=label, settings=settings)


def variant(base: Case, name: str, policies: Policies) -> Case:
    """The paper's strategy by name."""
    policy = policies.of_variant(name, base.idle_drive, base.friction)
    return VARIANTS[name].case(base, name, policy)


def gates(base: Case, policies: Policies, keep: tuple[str, ...] = ()) -> list[Case]:
    """Table 6: the paper's SDP without skid avoidance, and with Table 2 as printed."""
    made = [variant(base, name, policies) for name in (labels.GATE_OFF, labels.GATE_TABLE_2)]
    return [replace(case, keep=keep) for case in made]


def frontier_on(cycle: str, vehicle: str) -> Frontier:
    """Saving against changes of the split of every strategy that weighs them, and what could be saved."""
    car, trace = cases.vehicle_of(vehicle, IDLE_DRIVES[0]), cases.cycle_of(cycle)
    return budgets_of(Place(trace.name, car, trace, FRONTIER_FRICTION), FRONTIER_BUDGETS_PER_MIN)


def robustness(base: Case, policies: Policies) -> list[tuple[str, Case]]:
    """Cars, roads and sensors that are not what the policy was solved for; each with equal split beside it."""
    chassis = policies.car(base.idle_drive).params.chassis
    variants = {"as solved for": base}
    for factor in (0.8, 1.2):
        change = Change("chassis", "mass_kg", factor * chassis.mass_kg)
        variants[f"mass {factor - 1.0:+.0%}"] = replace(base, plant=(change,))
    for factor in (0.7, 1.3):
        changes = tuple(
            Change("chassis", name, factor * getattr(chassis, name))
            for name in ("drag_coefficient", "rolling_resistance")
        )
        variants[f"road load {factor - 1.0:+.0%}"] = replace(base, plant=changes)
    for true, assumed in ((0.5, 0.9), (0.2, 0.9), (0.9, 0.2)):
        variants[f"friction {true:g}, assumed {assumed:g}"] = replace(base, friction=true, assumed_friction=assumed)
    variants["direct-drive hub motor"] = replace(base, plant=HUB_MOTOR)
    variants["noise 0.1 m/s, 0.3 rad/s"] = replace(base, noise=SensorNoise(0.1, 0.3))
    made = []
    for name, case in variants.items():
        policy = policies.ours(base.idle_drive, case.law_friction)
        made.append((name, replace(case, label=labels.ED)))
        made.append((name, replace(case, strategy=STRATEGY, label=labels.OURS, policy=policy)))
    return made


def stops(policies: Policies) -> list[skid.Stop]:
    """Emergency stops on every road, with and without our policy, under every kind of skid avoidance."""
    return [
        skid.Stop(policies.vehicle, IDLE_DRIVES[1], friction, gate_mode, strategy, policy)
        for friction in paper.FRICTIONS
        for strategy, policy in (("equal", ""), (STRATEGY, policies.ours(IDLE_DRIVES[1], friction)))
        for gate_mode in GATE_MODES
    ]
