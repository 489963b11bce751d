# SPDX-License-Identifier: Apache-2.0
"""A demo's drive and what comes of it: processes, comparison, page, table."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np

from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.exit_codes import DONE, FAILED
from iwm_power_manager.files import make_folder
from iwm_power_manager.tools import command
from iwm_sim import metrics
from iwm_sim.closed_loop import Run
from iwm_sim.dds_drive import REFERENCE, Loaded, Outcome, Plan, closed_loop_run, compare, drive_over_dds, load
from iwm_sim.road_report import text
from iwm_sim.road_run import checked_run
from iwm_sim.scenario import load_scenario
from iwm_sim.study.drive_page import COLUMNS, Driven, drive_page, row
from iwm_sim.study.report import write_page
from iwm_sim.study.tables import plain_table, screen
from iwm_sim.tools.precompile import compile_for_a_drive

_LOCK_STEP = "over DDS"
_REAL_TIME = "in real time"
_ONE_PROCESS = "one process"


def run(plan: Plan) -> tuple[int, dict[str, Any]]:
    """Do all of it; returns the exit code, `FAILED` if the bag lacks anything that was published, and what JSON has."""
    if plan.scenario:
        return run_scenario(plan)
    loaded = load(plan)
    for line in command.doubts(loaded.vehicle, [loaded.cycle], [plan.friction]):
        print(f"demo: {line}", file=sys.stderr)
    make_folder(make_folder(plan.output, new=True) / "log")
    vehicle = loaded.vehicle
    print(f"{vehicle.name} on {loaded.cycle.name}, friction {plan.friction:g}, idle drive {vehicle.idle_drive}")
    compile_for_a_drive()
    alone = closed_loop_run(plan, loaded)
    reference = closed_loop_run(plan, loaded, equal=True)

    outcome = drive_over_dds(plan, loaded.cycle.name)
    remarks = outcome.remarks
    driven_run = outcome.run
    if not plan.realtime:
        same, remark = compare(driven_run, alone)
        remarks = [*remarks, remark]
        if same and np.isnan(driven_run["decided_share"]).all():
            driven_run = alone  # without a bag, the law's decisions of the identical run
    return show(plan, loaded, driven_run, reference, remarks, outcome)


def run_scenario(plan: Plan) -> tuple[int, dict[str, Any]]:
    """Drive a scenario over DDS and say what it requires; the exit code is `FAILED` if that or the bag falls short."""
    scenario = load_scenario(plan.scenario, plan.idle_drive or None)
    plan = dataclasses.replace(plan, vehicle=str(scenario.vehicle.path), friction=scenario.assumed_friction)
    load(plan)
    if scenario.cycle and scenario.cycle.gap:
        print(f"demo: warning: {scenario.cycle.gap}", file=sys.stderr)
    make_folder(make_folder(plan.output, new=True) / "log")
    print(f"{scenario.name}: {scenario.about}")
    compile_for_a_drive()
    outcome = drive_over_dds(plan, scenario.name)
    result = checked_run(scenario, outcome.run, default_settings(plan.strategy))
    print(f"\n{text(result)}")
    for remark in outcome.remarks:
        print(remark)
    return DONE if outcome.complete and result.passed else FAILED, result.values


# --- the result -----------------------------------------------------------------------------------------------------


def show(
    plan: Plan, loaded: Loaded, run: Run, reference: Run, remarks: list[str], outcome: Outcome
) -> tuple[int, dict[str, Any]]:
    """Write page and JSON, print table and paths; returns the exit code and what stands in the JSON."""
    params = loaded.vehicle.params
    driven = Driven(plan.strategy, _REAL_TIME if plan.realtime else _LOCK_STEP, run, metrics.measure(run, params))
    other = Driven(REFERENCE, _ONE_PROCESS, reference, metrics.measure(reference, params))
    rows = [row(driven, other), row(other, other)]
    settings = described(plan, loaded, outcome.notes)
    page = drive_page(
        driven,
        other,
        cycle=loaded.cycle.name,
        idle_drive=loaded.vehicle.idle_drive,
        critical_slip=loaded.settings.critical_slip,
        settings=settings,
        remarks=remarks,
    )
    write_page(plan.output / "drive.html", page)
    content = {"rows": rows, "settings": settings, "remarks": remarks}
    command.write_json(plan.output / "result.json", content)
    print(f"\n{plain_table(rows, COLUMNS, screen())}\n\n{made_with(plan, loaded)}")
    for remark in remarks:
        print(remark)
    if plan.record:
        print(f"bag:  {plan.output / 'bag'}")
    print(f"page: {plan.output / 'drive.html'}")
    if plan.animate:
        from iwm_sim.study.moving_picture import animate

        command.note_replaced(plan.animate)
        animate(
            run,
            plan.animate,
            f"{loaded.cycle.name}, friction {plan.friction:g}, idle drive {loaded.vehicle.idle_drive}, {plan.strategy}",
        )
        print(f"moving picture: {plan.animate}")
    return DONE if outcome.complete else FAILED, content


def made_with(plan: Plan, loaded: Loaded) -> str:
    """What the numbers depend on, in a line."""
    law = (plan.rate_hz, loaded.settings.decision_period_s, [loaded.policy_identity])
    return command.made_with(f"{plan.friction:g}", loaded.vehicle.idle_drive, *law)


def described(plan: Plan, loaded: Loaded, notes: Mapping[str, Any]) -> dict[str, Any]:
    """What the runs were made with, for page and JSON."""
    return {
        "vehicle": f"{loaded.vehicle.name} ({loaded.vehicle.hash})",
        "idle drive": loaded.vehicle.idle_drive,
        "cycle": f"{loaded.cycle.name} ({loaded.cycle.sha256[:16]})",
        "friction of the road": plan.friction,
        "friction assumed": plan.friction,
        "state of charge at the start": plan.soc,
        "strategy": plan.strategy,
        "policy": loaded.policy_identity,
        "control rate, Hz": plan.rate_hz,
        "time": "real" if plan.realtime else "lock-step",
        "duration of the run, s": round(notes["wall_s"], 1),
        "sets sent twice": notes["resent"],
        "command time-outs": notes["command_timeouts"],
        "recorded": plan.record,
    }
