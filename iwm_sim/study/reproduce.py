# SPDX-License-Identifier: Apache-2.0
"""All tables and figures of the paper, and what beats them: drives everything and gathers the numbers.

The result is a `Study` (stored as `study.json`), from which `pages` makes tables, and a few series for the figures.
"""

from __future__ import annotations

import functools
import operator
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from iwm_power_manager import __version__
from iwm_power_manager.control.settings import as_shown, default_settings
from iwm_power_manager.files import atomic_write, make_folder
from iwm_power_manager.model.parameters import VehicleParams
from iwm_power_manager.policy import Policy
from iwm_power_manager.tools.progress import Bar
from iwm_power_manager.vehicle import pack_energy_wh
from iwm_sim.cluster import on_all_cores
from iwm_sim.study import ablation, battery_fit, cases, criteria, labels, pages, paper, sensitivity, skid
from iwm_sim.study.cases import Case, Result
from iwm_sim.study.content import PolicyIdentity, Robustness, Study
from iwm_sim.study.driving import silent, tell, warm_up
from iwm_sim.study.frontier import Frontier
from iwm_sim.study.plan import (
    FRONTIER_CYCLE,
    IDLE_DRIVES,
    STRATEGY,
    Plan,
    Policies,
    among,
    fitted_rules,
    frontier_on,
    keys,
    stops,
    whole,
)
from iwm_sim.study.rows import Row, rows_of
from iwm_sim.study.study_figures import Material, convergence_of, drawn, window_of
from iwm_sim.study.variants import VARIANTS

FloatArray = npt.NDArray[np.float64]


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
    for folder in ("figures", "grids"):
        make_folder(output / folder)
    say = silent if quiet else tell
    policies = Policies(vehicle, policy, say)
    for name in VARIANTS:
        for key in keys():
            policies.of_variant(name, *key)
    warm_up(_warming(policies, cycles[0]))
    with Bar(1, "runs", quiet=quiet) as bar:
        rules = fitted_rules(vehicle, keys(), jobs)
        plan = whole(policies, cycles, rules)
        tasks: list[Callable[[], Any]] = [functools.partial(frontier_on, among(FRONTIER_CYCLE, cycles), vehicle)]
        tasks += [functools.partial(battery_fit.fit, vehicle, IDLE_DRIVES[0], _fit_cycles(cycles))]
        tasks += [functools.partial(_all_stops, stops(policies))]
        tasks += [functools.partial(cases.result, case) for case in plan.cases]
        bar.total = len(tasks)
        bar.refresh()
        frontier, battery, stopped, *results = on_all_cores(operator.call, tasks, jobs, lambda _: bar.update())
    places = tuple((among(cycle, cycles), friction) for cycle, friction in ablation.PLACES)
    with tempfile.TemporaryDirectory(prefix="iwm-ablation-") as grids:  # of a study that is stopped, nothing is left
        ablated = ablation.ablation(policies, Path(grids), jobs, say, tuple(dict.fromkeys(places)))
        for grid in Path(grids).iterdir():
            atomic_write(output / "grids" / grid.name, grid.read_bytes())
    stored = _study(policies, plan, results, frontier, battery, stopped, ablated).to_json()
    content = Study.from_json(stored)  # its numbers are those that a reader of the file has
    key = (IDLE_DRIVES[0], paper.FRICTIONS[0])
    solved = cases.policy_of(policies.of_variant(labels.PAPER_SDP, *key))
    material = Material(
        battery=battery,
        rule=rules[key],
        convergence=convergence_of(solved),
        window=window_of(results),
        chain=solved.chain,
    )
    pages.write(output, content, drawn(content.frontier, material, policies.car(IDLE_DRIVES[0]).params))
    atomic_write(output / "study.json", stored)
    if document:
        pages.update_document(document, content)
        atomic_write(document.with_suffix(".json"), stored)
    say(f"{len(tasks)} runs in {time.perf_counter() - started:.0f} s: {output / 'study.html'}")
    return content


def _all_stops(wanted: Sequence[skid.Stop]) -> list[skid.Stopped]:
    return [skid.emergency_stop(stop) for stop in wanted]


def _warming(policies: Policies, cycle: str) -> list[Case]:
    base = Case(cycle, policies.vehicle, *keys()[0], "equal")
    return [base, replace(base, strategy=STRATEGY, policy=policies.ours(*keys()[0])), replace(base, strategy="preview")]


def _fit_cycles(cycles: Sequence[str]) -> tuple[str, ...]:
    return tuple(cycle for cycle in battery_fit.CYCLES if cycle in cycles) or (cycles[0],)


# --- what came of it ------------------------------------------------------------------------------------------------


def _study(
    policies: Policies,
    plan: Plan,
    results: Sequence[Result],
    frontier: Frontier,
    battery: battery_fit.Fit,
    stops: list[skid.Stopped],
    ablated: list[ablation.Ablated],
) -> Study:
    tables = len(plan.cells) + len(plan.gates)
    cell_rows = rows_of(results[:tables])
    rows, gate_rows = cell_rows[: len(plan.cells)], cell_rows[len(plan.cells) :]
    car = policies.car(IDLE_DRIVES[0])
    driven = {cases.cycle_of(case.cycle).name: cases.cycle_of(case.cycle) for case in plan.cells}
    printed = [cases.cycle_of(name) for name in paper.CYCLES]
    settings = default_settings(STRATEGY)
    return Study(
        package_version=__version__,
        vehicle=car.name,
        vehicle_hashes={idle_drive: policies.car(idle_drive).hash for idle_drive in IDLE_DRIVES},
        cycles={name: cycle.sha256 for name, cycle in driven.items()},
        strategy=STRATEGY,
        settings=as_shown(settings),
        policies={
            labels.OURS: [_identity(key, policies.ours(*key)) for key in keys()],
            **{name: [_identity(key, policies.of_variant(name, *key)) for key in keys()] for name in VARIANTS},
        },
        cells=rows,
        gates=gate_rows,
        stops=stops,
        frontier=frontier,
        robustness=_robustness_rows([name for name, _ in plan.robustness], results[tables:]),
        battery_fit=battery.estimates,
        sensitivity=_sensitivity(car.params),
        ablation=ablated,
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


def _sensitivity(params: VehicleParams) -> dict[str, dict[str, float]]:
    curves = {
        "figure_8": sensitivity.figure_8(params),
        "figure_9": sensitivity.figure_9(params),
        "figure_10": [curve for _, panel in sensitivity.figure_10(params) for curve in panel],
    }
    return {name: {curve.label: sensitivity.best_front_share(curve) for curve in made} for name, made in curves.items()}
