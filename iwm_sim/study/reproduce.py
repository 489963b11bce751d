"""All tables and figures of the paper, and what beats them: drives everything and gathers the numbers.

The result is a `Study` (stored as `study.json`), from which `pages` makes tables, and a few series for the figures.
"""

from __future__ import annotations

import functools
import json
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from iwm_power_manager import __version__
from iwm_power_manager.control.settings import GATE_MODES, default_settings
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.files import atomic_write
from iwm_power_manager.mdp.problem import FORMAT as PROBLEM_FORMAT
from iwm_power_manager.policy import Policy
from iwm_power_manager.vehicle import Vehicle, pack_energy_wh
from iwm_sim.study import battery_fit, cases, criteria, labels, pages, paper, sensitivity, skid
from iwm_sim.study.cases import Case, Change, Result, Rule, SensorNoise
from iwm_sim.study.content import Frontier, FrontierPoint, PolicyIdentity, Robustness, Study
from iwm_sim.study.driving import on_all_cores, warm_up
from iwm_sim.study.policies import PolicySource, solved
from iwm_sim.study.rows import Row, rows_of
from iwm_sim.study.study_figures import Material, drawn

FloatArray = npt.NDArray[np.float64]

IDLE_DRIVES = ("none", "drag")
#: The strategy that plays our policy.
STRATEGY = "sdp_lookahead"

#: Grids of the paper's formulation, with and without Table 2 in it.
PAPER_GRID, PAPER_GRID_WITHOUT = "paper", "paper_without_skid_avoidance"

#: The paper decides every 0.1 s.
PAPER_PERIOD_S = 0.1

#: Power a change has to save, W, of the strongest rival in the tables.
RIVAL_SWITCHING_W = (40.0, 60.0, 100.0)

#: The switching frontier: cycle and road, and the prices along it.
FRONTIER_CYCLE, FRONTIER_FRICTION = "udds", 0.9
FRONTIER_POWERS_W = (0.0, 15.0, 30.0, 60.0, 100.0, 200.0, 400.0)
FRONTIER_COSTS_J = (0.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0)
FRONTIER_FACTORS = (0.25, 0.5, 1.0, 2.0, 4.0)

ROBUSTNESS_CYCLES = ("hwfet", "udds")

#: Where and when Figures 14 and 15 look.
WINDOW_CYCLE, WINDOW_FRICTION, WINDOW_S = "udds", 0.2, (345.0, 430.0)
_WINDOW_SIGNALS = ("time_s", "front_power_w", "rear_power_w", "front_slip", "rear_slip")

#: Loss coefficients of a direct-drive hub motor, the second set of docs/model.md.
HUB_MOTOR = (
    Change("motor", "loss_constant_w", 40.0),
    Change("motor", "loss_linear_speed", 1.57),
    Change("motor", "loss_quadratic_speed", 0.0166),
    Change("motor", "loss_linear_torque", 1.50),
    Change("motor", "loss_quadratic_torque", 0.045),
)


class _Plan(NamedTuple):
    """Cases by the part of the study they are for."""

    cells: list[Case]
    gates: list[Case]
    frontier: list[Case]
    robustness: list[tuple[str, Case]]


def study(
    output: Path,
    *,
    vehicle: str,
    policy: str,
    jobs: int,
    quiet: bool,
    document: Path | None = None,
    cycles: Sequence[str] = paper.CYCLES,
) -> Study:
    """Make the whole study and write it into a folder: `study.json`, `study.html`, `study.md`, `figures/`.

    Parameters
    ----------
    output : folder, made if it is not there
    vehicle, policy : car, and folder or file of our policies for it
    jobs : processes
    quiet : no progress
    document : Markdown file whose generated part is replaced; the study's JSON goes beside it
    cycles : driven in the tables; the first one is also that of the frontier, the robustness and the slips if the
        usual ones are not among them
    """
    started = time.perf_counter()
    try:
        for folder in ("figures", "grids"):
            (output / folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(output, "", f"cannot be created: {error.strerror}", "a folder") from None
    say = _silent if quiet else _say
    ours = _our_policies(vehicle, policy, say)
    paper_policies = {
        grid: {key: solved(_car(vehicle, key[0]), key[1], grid, say) for key in ours}
        for grid in (PAPER_GRID, PAPER_GRID_WITHOUT)
    }
    priced = _priced(vehicle, ours[IDLE_DRIVES[0], FRONTIER_FRICTION], output, say)
    warm_up(_warming(vehicle, cycles[0], ours), say)

    with tqdm(total=1, unit="run", file=sys.stderr, disable=quiet, leave=False) as bar:
        rules = _rules(vehicle, ours, jobs)
        plan = _plan(vehicle, cycles, ours, paper_policies, rules, priced)
        tasks: list[Callable[[], Any]] = [functools.partial(cases.result, case) for case in _all(plan)]
        stops = _stops(vehicle, ours)
        tasks += [functools.partial(battery_fit.fit, vehicle, IDLE_DRIVES[0], _fit_cycles(cycles))]
        tasks += [functools.partial(_all_stops, stops)]
        bar.total = len(tasks)
        bar.refresh()
        made = on_all_cores(_call, tasks, jobs, lambda _: _tick(bar))
    results: list[Result] = made[: len(_all(plan))]
    stored = _study(vehicle, plan, results, made[-2], made[-1], ours, paper_policies).to_json()
    content = Study.from_json(stored)  # its numbers are those that a reader of the file has
    key = (IDLE_DRIVES[0], paper.FRICTIONS[0])
    convergence = cases.policy_of(paper_policies[PAPER_GRID][key])
    material = Material(
        battery=made[-2],
        rule=rules[key],
        convergence=_convergence(convergence),
        window=_window(results),
        chain=(convergence.chain.probability, convergence.chain.power_w),
    )
    pages.write(output, content, drawn(content.frontier, material, _car(vehicle, IDLE_DRIVES[0]).params))
    atomic_write(output / "study.json", stored)
    if document:
        pages.update_document(document, content)
        atomic_write(document.with_suffix(".json"), stored)
    say(f"{len(tasks)} runs in {time.perf_counter() - started:.0f} s: {output / 'study.html'}")
    return content


def _tick(bar: Any) -> None:
    bar.update()


def _call(task: Callable[[], Any]) -> Any:
    return task()


def _car(vehicle: str, idle_drive: str) -> Vehicle:
    return cases.vehicle_of(vehicle, idle_drive)


def _our_policies(vehicle: str, policy: str, say: Callable[[str], None]) -> dict[tuple[str, float], str]:
    source = PolicySource(policy, say=say)
    return {
        (idle_drive, friction): source.find(_car(vehicle, idle_drive), friction)
        for idle_drive in IDLE_DRIVES
        for friction in paper.FRICTIONS
    }


def _priced(vehicle: str, policy: str, output: Path, say: Callable[[str], None]) -> dict[float, str]:
    """Our policy solved for other prices of a change, by price in J; the problems go to `output`."""
    problem = cases.policy_of(policy).problem
    made = {}
    for factor in FRONTIER_FACTORS:
        price = factor * max(problem.switching_fixed_cost_j, problem.switching_cost_j)
        settings = problem.settings() | {
            "format": PROBLEM_FORMAT,
            "switching_cost_j": factor * problem.switching_cost_j,
            "switching_fixed_cost_j": factor * problem.switching_fixed_cost_j,
        }
        del settings["name"]
        grid = output / "grids" / f"price_{price:g}_j.yaml"  # JSON is YAML
        atomic_write(grid, json.dumps(settings).encode())
        at_hand = factor == 1.0
        made[price] = policy if at_hand else solved(_car(vehicle, IDLE_DRIVES[0]), FRONTIER_FRICTION, str(grid), say)
    return made


def _warming(vehicle: str, cycle: str, ours: Mapping[tuple[str, float], str]) -> list[Case]:
    idle_drive, friction = next(iter(ours))
    base = Case(cycle, vehicle, idle_drive, friction, "equal")
    return [
        base,
        replace(base, strategy=STRATEGY, policy=ours[idle_drive, friction]),
        replace(base, strategy="preview"),
    ]


def _rules(vehicle: str, ours: Iterable[tuple[str, float]], jobs: int) -> dict[tuple[str, float], Rule]:
    keys = list(ours)
    wanted = [Case(cases.RULE_CYCLE, vehicle, idle_drive, friction, "rule") for idle_drive, friction in keys]
    return dict(zip(keys, on_all_cores(cases.fitted_rule, wanted, jobs), strict=True))


def _fit_cycles(cycles: Sequence[str]) -> tuple[str, ...]:
    return tuple(cycle for cycle in battery_fit.CYCLES if cycle in cycles) or (cycles[0],)


# --- what is driven -------------------------------------------------------------------------------------------------


def _plan(
    vehicle: str,
    cycles: Sequence[str],
    ours: Mapping[tuple[str, float], str],
    paper_policies: Mapping[str, Mapping[tuple[str, float], str]],
    rules: Mapping[tuple[str, float], Rule],
    priced: Mapping[float, str],
) -> _Plan:
    plan = _Plan([], [], [], [])
    by_length = sorted(cycles, key=lambda cycle: -cases.cycle_of(cycle).duration_s)
    for cycle in by_length:
        for (idle_drive, friction), policy in ours.items():
            base = Case(cycle, vehicle, idle_drive, friction, "equal")
            key = (idle_drive, friction)
            watched = cycle == _among(WINDOW_CYCLE, cycles) and key == (IDLE_DRIVES[0], WINDOW_FRICTION)
            keep = _WINDOW_SIGNALS if watched else ()
            plan.cells.extend(_cell(base, policy, paper_policies[PAPER_GRID][key], rules[key].coefficients, keep))
            plan.gates.extend(
                _gates(base, paper_policies[PAPER_GRID][key], paper_policies[PAPER_GRID_WITHOUT][key], keep)
            )
    base = Case(_among(FRONTIER_CYCLE, cycles), vehicle, IDLE_DRIVES[0], FRONTIER_FRICTION, "equal")
    plan.frontier.extend(_frontier(base, priced))
    for idle_drive in IDLE_DRIVES:
        for cycle in {_among(name, cycles): None for name in ROBUSTNESS_CYCLES}:
            base = Case(cycle, vehicle, idle_drive, 0.9, "equal")
            plan.robustness.extend(_robustness(base, ours))
    return plan


def _among(cycle: str, cycles: Sequence[str]) -> str:
    return cycle if cycle in cycles else cycles[0]


def _all(plan: _Plan) -> list[Case]:
    return [*plan.cells, *plan.gates, *plan.frontier, *(case for _, case in plan.robustness)]


def _cell(base: Case, policy: str, paper_policy: str, rule: tuple[float, ...], keep: tuple[str, ...]) -> list[Case]:
    """All strategies in one cell of Tables 3 to 5, all under the law's normal settings."""
    problem = cases.policy_of(policy).problem
    settings = base.settings
    rivals = [
        replace(
            base,
            strategy="instantaneous_slip",
            label=f"{labels.INSTANTANEOUS_SLIP} {power:g} W",
            settings=settings._replace(switching_power_w=power),
        )
        for power in RIVAL_SWITCHING_W
    ]
    return [
        replace(base, label=labels.ED, keep=keep),
        replace(base, strategy="rule", label=labels.GRDP, rule=rule),
        replace(
            base,
            strategy="sdp",
            label=labels.PAPER_SDP,
            policy=paper_policy,
            settings=settings._replace(decision_period_s=PAPER_PERIOD_S),
        ),
        replace(base, strategy=STRATEGY, label=labels.OURS, policy=policy, keep=keep),
        replace(base, strategy="instantaneous", label=labels.INSTANTANEOUS),
        *rivals,
        replace(
            base,
            strategy="preview",
            label=labels.BOUND,
            switching_cost_j=problem.switching_cost_j,
            switching_fixed_cost_j=problem.switching_fixed_cost_j,
        ),
        replace(base, strategy="preview", label=labels.FREE_BOUND),
    ]


def _gates(base: Case, paper_policy: str, without: str, keep: tuple[str, ...]) -> list[Case]:
    """Table 6: the paper's SDP without skid avoidance, and with Table 2 as printed."""
    settings = base.settings._replace(decision_period_s=PAPER_PERIOD_S)
    return [
        replace(
            base,
            strategy="sdp",
            label=labels.GATE_OFF,
            policy=without,
            settings=settings._replace(gate_mode=GATE_MODES["off"]),
            keep=keep,
        ),
        replace(
            base,
            strategy="sdp",
            label=labels.GATE_TABLE_2,
            policy=paper_policy,
            settings=settings._replace(gate_mode=GATE_MODES["table2"], gate_hysteresis=0.0, gate_driving=False),
            keep=keep,
        ),
    ]


def _frontier(base: Case, priced: Mapping[float, str]) -> list[Case]:
    """Saving against share changes: what the price of a change does, for each strategy that has one."""
    rival = [
        replace(
            base,
            strategy="instantaneous_slip",
            label=f"instantaneous_slip|{power:g} W",
            settings=base.settings._replace(switching_power_w=power),
        )
        for power in FRONTIER_POWERS_W
    ]
    bound = [
        replace(base, strategy="preview", label=f"preview|{cost:g} J", switching_cost_j=cost)
        for cost in FRONTIER_COSTS_J
    ]
    ours = [
        replace(base, strategy=STRATEGY, label=f"ours|{price:g} J", policy=policy) for price, policy in priced.items()
    ]
    return [replace(base, label="ED|"), *rival, *bound, *ours]


def _robustness(base: Case, ours: Mapping[tuple[str, float], str]) -> list[tuple[str, Case]]:
    """Cars, roads and sensors that are not what the policy was solved for; each with equal split beside it."""
    params = cases.vehicle_of(base.vehicle, base.idle_drive).params
    chassis = params.chassis
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
        policy = ours[base.idle_drive, case.told_friction]
        made.append((name, replace(case, label=labels.ED)))
        made.append((name, replace(case, strategy=STRATEGY, label=labels.OURS, policy=policy)))
    return made


def _stops(vehicle: str, ours: Mapping[tuple[str, float], str]) -> list[skid.Stop]:
    return [
        skid.Stop(vehicle, IDLE_DRIVES[1], friction, gate_mode, strategy, policy)
        for friction in paper.FRICTIONS
        for strategy, policy in (("equal", ""), (STRATEGY, ours[IDLE_DRIVES[1], friction]))
        for gate_mode in GATE_MODES
    ]


def _all_stops(stops: Sequence[skid.Stop]) -> list[skid.Stopped]:
    return [skid.emergency_stop(stop) for stop in stops]


# --- what came of it ------------------------------------------------------------------------------------------------


def _study(
    vehicle: str,
    plan: _Plan,
    results: Sequence[Result],
    battery: battery_fit.Fit,
    stops: list[skid.Stopped],
    ours: Mapping[tuple[str, float], str],
    paper_policies: Mapping[str, Mapping[tuple[str, float], str]],
) -> Study:
    tables = len(plan.cells) + len(plan.gates)
    cell_rows = rows_of(results[:tables])
    rows, gate_rows = cell_rows[: len(plan.cells)], cell_rows[len(plan.cells) :]
    car = _car(vehicle, IDLE_DRIVES[0])
    driven = {cases.cycle_of(case.cycle).name: cases.cycle_of(case.cycle) for case in plan.cells}
    printed = [cases.cycle_of(name) for name in paper.CYCLES]
    settings = default_settings(STRATEGY)
    return Study(
        package_version=__version__,
        vehicle=car.name,
        vehicle_hashes={idle_drive: _car(vehicle, idle_drive).hash for idle_drive in IDLE_DRIVES},
        cycles={name: cycle.sha256 for name, cycle in driven.items()},
        strategy=STRATEGY,
        settings=settings._asdict(),
        policies={
            "ours": [_identity(key, path) for key, path in ours.items()],
            **{grid: [_identity(key, path) for key, path in made.items()] for grid, made in paper_policies.items()},
        },
        cells=rows,
        gates=gate_rows,
        stops=stops,
        frontier=_frontier_of(plan.frontier[0], results[tables : tables + len(plan.frontier)]),
        robustness=_robustness_rows([name for name, _ in plan.robustness], results[tables + len(plan.frontier) :]),
        battery_fit=battery.estimates(),
        sensitivity=_sensitivity(vehicle),
        paper=paper.consequences(
            pack_energy_wh(car.params.battery),
            {cycle.name: cycle.distance_m for cycle in printed},
            {cycle.name: cycle.distance_m / cycle.duration_s for cycle in printed},
        ),
        criteria=criteria.check(rows, stops, settings.slew_down_nmps),
    )


def _identity(key: tuple[str, float], path: str) -> PolicyIdentity:
    policy: Policy = cases.policy_of(path)
    return PolicyIdentity(
        idle_drive=key[0],
        friction=key[1],
        solved_for_friction=policy.friction,
        grid=policy.problem.name,
        checksum=policy.checksum,
        switching_cost_j=policy.problem.switching_cost_j,
        switching_fixed_cost_j=policy.problem.switching_fixed_cost_j,
    )


def _frontier_of(base: Case, results: Sequence[Result]) -> Frontier:
    points = []
    for row in rows_of(results):
        family, price = row.label.split("|")
        points.append(FrontierPoint(family, price, row.saving_percent, row.metrics.share_changes_per_min))
    return Frontier(cases.cycle_of(base.cycle).name, base.friction, points)


def _robustness_rows(names: Sequence[str], results: Sequence[Result]) -> list[Robustness]:
    groups: dict[tuple[str, str], list[Row]] = {}
    for name, row in zip(names, rows_of(results), strict=True):
        if row.label == labels.OURS:
            groups.setdefault((name, row.place.idle_drive), []).append(row)
    return [
        Robustness(
            variant=name,
            idle_drive=idle_drive,
            saving_percent={row.place.cycle: row.saving_percent for row in rows},
            trace_held=all(row.metrics.trace_held for row in rows),
            share_changes_per_min=max(row.metrics.share_changes_per_min for row in rows),
        )
        for (name, idle_drive), rows in groups.items()
    ]


def _sensitivity(vehicle: str) -> dict[str, dict[str, float]]:
    params = _car(vehicle, IDLE_DRIVES[0]).params
    curves = {
        "figure_8": sensitivity.figure_8(params),
        "figure_9": sensitivity.figure_9(params),
        "figure_10": [curve for _, panel in sensitivity.figure_10(params) for curve in panel],
    }
    return {name: {curve.label: sensitivity.best_front_share(curve) for curve in made} for name, made in curves.items()}


def _convergence(policy: Policy) -> tuple[FloatArray, FloatArray]:
    """Change of the policy, and the Bellman residual (half its span), in each iteration."""
    change = np.array([iteration.policy_change for iteration in policy.iterations])
    bound = np.array([iteration.bound_j for iteration in policy.iterations])
    discount = policy.problem.discount
    return change, bound * (1.0 - discount) / discount


def _window(results: Sequence[Result]) -> dict[str, dict[str, FloatArray]]:
    """Series of the watched runs, by label, inside the window (or all of it, where the cycle is shorter)."""
    made = {}
    for result in results:
        if result.series:
            time_s = result.series["time_s"]
            inside = (time_s >= WINDOW_S[0]) & (time_s <= WINDOW_S[1])
            keep = inside if inside.any() else np.ones(time_s.size, dtype=bool)
            made[result.case.name] = {name: values[keep] for name, values in result.series.items()}
    return made


def _say(line: str) -> None:
    tqdm.write(line, file=sys.stderr)


def _silent(_: str) -> None:
    pass
