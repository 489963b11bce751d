# SPDX-License-Identifier: Apache-2.0
"""One table or one figure of the study, without the rest of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from iwm_sim.study import battery_fit, cases, labels, paper
from iwm_sim.study.cases import Case
from iwm_sim.study.driving import Progress, drive_all
from iwm_sim.study.names import TABLES
from iwm_sim.study.plan import (
    FRONTIER_CYCLE,
    IDLE_DRIVES,
    STRATEGY,
    WINDOW_CYCLE,
    WINDOW_FRICTION,
    WINDOW_SIGNALS,
    Policies,
    cell,
    fitted_rules,
    frontier_on,
    gates,
    variant,
)
from iwm_sim.study.rows import rows_of
from iwm_sim.study.study_figures import (
    Drawn,
    battery_figure,
    convergence_of,
    depletion_figures,
    frontier_figure,
    rule_figure,
    solver_figures,
    window_figures,
    window_of,
)
from iwm_sim.study.study_tables import TableOf, paper_tables, table_6

#: Strategies that Tables 3 to 5 show.
_SHOWN = (labels.ED, labels.GRDP, labels.PAPER_SDP, labels.OURS, labels.BOUND)


def paper_table(
    number: str,
    policies: Policies,
    cycles: Sequence[str] = paper.CYCLES,
    idle_drives: Sequence[str] = IDLE_DRIVES,
    jobs: int = 1,
    quiet: bool = True,
) -> list[TableOf]:
    """Drive the cells of a table of the paper, and give it beside the paper's, once for each idle drive.

    Parameters
    ----------
    number : key of `TABLES`
    policies : of the car
    cycles, idle_drives : which of its cells
    jobs : processes
    quiet : no progress bar
    """
    wanted: list[Case] = []
    keys = [(idle_drive, friction) for idle_drive in idle_drives for friction in TABLES[number]]
    rules = {} if number == "6" else fitted_rules(policies.vehicle, keys, jobs)
    for cycle in cycles:
        for key in keys:
            base = Case(cycle, policies.vehicle, *key, "equal")
            if number == "6":
                ours = replace(base, strategy=STRATEGY, label=labels.OURS, policy=policies.ours(*key))
                wanted += [replace(base, label=labels.ED), *gates(base, policies), ours]
            else:
                wanted += [case for case in cell(base, policies, rules[key].coefficients) if case.label in _SHOWN]
    with Progress(len(wanted), quiet) as progress:
        rows = rows_of(drive_all(wanted, jobs, progress.done))
    names = [cases.cycle_of(cycle).name for cycle in cycles]
    tables = table_6(rows) if number == "6" else paper_tables(rows, names)
    return [table for table in tables if table.rows]


def figure(name: str, policies: Policies, jobs: int = 1) -> Drawn:
    """Draw one of `FIGURES`, driving and solving no more than it needs."""
    base = Case(WINDOW_CYCLE, policies.vehicle, IDLE_DRIVES[0], WINDOW_FRICTION, "equal")
    first = (IDLE_DRIVES[0], paper.FRICTIONS[0])
    if name == "7":
        return battery_figure(battery_fit.fit(policies.vehicle, IDLE_DRIVES[0]))
    if name in ("8", "9", "10"):
        return depletion_figures(policies.car(IDLE_DRIVES[0]).params)[int(name) - 8]
    if name in ("12", "transitions"):
        policy = cases.policy_of(policies.of_variant(labels.PAPER_SDP, *first))
        return solver_figures(convergence_of(policy), policy.chain)[name == "transitions"]
    if name == "13":
        return rule_figure(fitted_rules(policies.vehicle, [first], jobs)[first])
    if name in ("14", "15"):
        wanted = [
            replace(base, label=labels.ED),
            replace(base, strategy=STRATEGY, label=labels.OURS, policy=policies.ours(IDLE_DRIVES[0], WINDOW_FRICTION)),
            variant(base, labels.GATE_OFF, policies),
        ]
        made = drive_all([replace(case, keep=WINDOW_SIGNALS) for case in wanted], jobs)
        return window_figures(window_of(made))[int(name) - 14]
    return frontier_figure(frontier_on(FRONTIER_CYCLE, policies.vehicle))
