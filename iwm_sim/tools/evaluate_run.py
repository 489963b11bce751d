# SPDX-License-Identifier: Apache-2.0
"""What `evaluate` does with its options; imported when they are known, so that `--help` needs none of it."""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import tempfile
import textwrap
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from iwm_power_manager import __version__
from iwm_power_manager.control import settings as law_settings
from iwm_power_manager.control.strategies import DEFAULT_STRATEGY, drivable
from iwm_power_manager.cycle import Cycle
from iwm_power_manager.errors import ConfigError
from iwm_power_manager.exit_codes import DONE, FAILED
from iwm_power_manager.files import atomic_write, friction_in_name, make_folder
from iwm_power_manager.tools.command import PICTURES, doubts, made_with, write_json, write_picture
from iwm_power_manager.tools.progress import Bar
from iwm_sim.closed_loop import COLUMNS as SIGNALS
from iwm_sim.cluster import on_all_cores
from iwm_sim.road_report import text as road_text
from iwm_sim.road_run import check_scenario
from iwm_sim.scenario import load_scenario
from iwm_sim.study import ablation, battery_fit, cases, frontier, frontier_figure, paper, reproduce, single, unseen
from iwm_sim.study.cases import POLICY_STRATEGIES, Case, Result, SensorNoise
from iwm_sim.study.driving import Progress, drive_all, silent, tell, warm_up, with_rules
from iwm_sim.study.names import REFERENCE
from iwm_sim.study.plan import Policies
from iwm_sim.study.rows import Row, rows_of
from iwm_sim.study.study_figures import battery_figure
from iwm_sim.study.study_tables import ABLATION_NOTE, TABLES
from iwm_sim.study.tables import plain_table, screen, text_table
from iwm_sim.study.variants import VARIANTS
from iwm_sim.tools.precompile import compile_for_a_drive


def run(mode: str, options: argparse.Namespace) -> int | None:
    """Do what is asked for; `mode` is a key of `evaluate.MODES`, or "" for single cases. Returns an exit code."""
    options.say = silent if options.quiet else tell
    cycles = _distinct(options.cycle or ())
    if mode and cycles:
        _tell_doubts(doubts(cases.vehicle_of(options.vehicle, ""), cycles, options.friction or []))
    return _RUN[mode](options)


# --- cases ----------------------------------------------------------------------------------------------------------


def _evaluate(options: argparse.Namespace) -> None:
    if not options.cycle:
        raise ConfigError("arguments", "--cycle", "is missing", "one drive cycle or more, for instance nycc")
    started = time.perf_counter()
    wanted = planned(options)
    _tell_doubts(_doubts(wanted))
    with Progress(len(wanted), options.quiet) as progress:
        warm_up(wanted)
        wanted = with_rules(wanted, options.jobs)
        drive = _Saving(options.save_series) if options.save_series else cases.result
        results = drive_all(wanted, options.jobs, progress.done, drive)
    rows = rows_of(results)
    if not options.quiet:
        print(text_table(rows, screen()))
        for line in remarks(rows):
            print(line)
        options.say(f"{len(rows)} cases in {time.perf_counter() - started:.1f} s")
    if options.json:
        write_json(options.json, {"package_version": __version__, "rows": rows})
        options.say(f"rows: {options.json}")


def _distinct(names: Sequence[str]) -> list[Cycle]:
    """The cycles of these names; refused, where results of two would have one name."""
    known: dict[str, Cycle] = {}
    for cycle in map(cases.cycle_of, names):
        other = known.setdefault(cycle.name, cycle)
        if other.sha256 != cycle.sha256:
            problem = f"{other.source} and {cycle.source} are both called {cycle.name}"
            raise ConfigError("arguments", "--cycle", problem, "files of different names")
    return list(known.values())


def _tell_doubts(lines: Sequence[str]) -> None:
    for line in lines:
        tell(f"evaluate: {line}")


def _doubts(wanted: Sequence[Case]) -> list[str]:
    """What a reader should know of the cars and cycles before they are driven, each once."""
    lines: list[str] = []
    for case in wanted:
        vehicle = cases.vehicle_of(case.vehicle, case.idle_drive, case.car)
        lines += doubts(vehicle, [cases.cycle_of(case.cycle)], [case.friction])
    return list(dict.fromkeys(lines))


def planned(options: argparse.Namespace) -> list[Case]:
    """The cases of a command line, each checked, with their policies found or solved. Equal split is always there."""
    if options.save_series:
        make_folder(options.save_series)
    strategies = list(dict.fromkeys([REFERENCE, *(options.strategy or [DEFAULT_STRATEGY])]))
    settings = _settings(options)
    result: list[tuple[str, Case]] = []
    for idle_drive, cycle, friction, name in itertools.product(
        options.idle_drive or [""], options.cycle, options.friction or [0.9], strategies
    ):
        base = Case(
            cycle=cycle,
            vehicle=options.vehicle,
            idle_drive=cases.vehicle_of(options.vehicle, idle_drive).idle_drive,
            friction=friction,
            strategy=REFERENCE,
            settings=settings,
            dt_s=options.dt,
            soc=options.initial_soc,
            assumed_friction=options.assumed_friction,
            noise=SensorNoise(options.noise[0], options.noise[1], options.seed),
        )
        known = VARIANTS[name].case(base, name) if name in VARIANTS else None
        result.append((name, known or dataclasses.replace(base, strategy=name)))
        cases.check(result[-1][1])
    # Policies last: a wrong cycle must not be found after a minute of solving.
    policies = Policies(options.vehicle, options.policy, options.say, options.grid, not options.no_solve)
    return [_with_policy(name, case, options, policies) for name, case in dict.fromkeys(result)]


def _with_policy(name: str, case: Case, options: argparse.Namespace, policies: Policies) -> Case:
    if name in VARIANTS:
        return dataclasses.replace(case, policy=policies.of_variant(name, case.idle_drive, case.law_friction))
    if name in POLICY_STRATEGIES and options.friction_source == "estimated":
        return dataclasses.replace(case, policies=options.policy, label=f"{name}, friction estimated")
    if name in POLICY_STRATEGIES:
        return dataclasses.replace(case, policy=policies.ours(case.idle_drive, case.law_friction))
    if name != "preview":
        return case
    if options.switching_cost is None:
        case = cases.priced_as(case, policies.ours(case.idle_drive, case.law_friction))
    else:
        case = dataclasses.replace(case, switching_cost_j=options.switching_cost)
    return dataclasses.replace(case, label=f"preview, {case.price_text}")


def _settings(options: argparse.Namespace) -> law_settings.Settings:
    given = {name: value for name, value in vars(options).items() if name in law_settings.TABLE and name != "strategy"}
    settings = law_settings.DEFAULTS._replace(**given)
    if settings.gate_mode == law_settings.GATE_MODE_TABLE2:
        settings = settings._replace(gate_hysteresis=0.0)  # as printed
    if (
        settings.decision_period_s < options.dt
        and settings.decision_period_s != law_settings.DEFAULTS.decision_period_s
    ):
        raise ConfigError(
            "arguments",
            "--decision-period",
            f"{settings.decision_period_s:g} s is shorter than the control step",
            f"at least --dt {options.dt:g} s",
        )
    target = settings.slip_target
    if target >= settings.critical_slip:  # of a gate set closer than usual; the limiter works in front of it
        target = 0.75 * settings.critical_slip
    settings = settings._replace(slip_target=target, decision_period_s=max(settings.decision_period_s, options.dt))
    problem = law_settings.check_together(settings._asdict())
    if problem:
        raise ConfigError("arguments", *problem.split(": ", 1))
    return settings


class _Saving:
    """Drives a case and writes its series; an object, because workers can be sent no closure."""

    def __init__(self, folder: str) -> None:
        self._folder = folder

    def __call__(self, case: Case) -> Result:
        made = cases.result(dataclasses.replace(case, keep=SIGNALS))
        cases.save_series(self._folder, made)
        return Result(case, made.metrics, {})


def remarks(rows: Sequence[Row]) -> list[str]:
    """Sentences below the table, about what its marks mean."""
    lines = []
    if not all(row.metrics.trace_held for row in rows):
        lines.append("lost: the car left the EPA tolerance by the m/s shown; its energy is no saving")
    if any(row.same_distance_as_equal is False for row in rows):
        lines.append("no saving: the distance differs from that of equal split by more than 0.1 %; compare Wh/km")
    with_policy = [row.made_with for row in rows if row.made_with["policy_friction"]]
    for told, solved_for in sorted({(made["assumed_friction"], made["policy_friction"]) for made in with_policy}):
        if told != solved_for:
            lines.append(f"friction {told:g} was driven with the policy for {solved_for:g}, the nearest there is")
    return lines


def _only[Value](option: str, values: Sequence[Value], default: Value) -> Value:
    """The value of an option that may be given several times, but not here."""
    if len(values) > 1:
        raise ConfigError("arguments", option, f"has {len(values)} values", "one here")
    return values[0] if values else default


# --- instead of cases -----------------------------------------------------------------------------------------------


def _study(options: argparse.Namespace) -> None:
    reproduce.study(
        Path(options.study),
        vehicle=options.vehicle,
        policy=options.policy,
        jobs=options.jobs,
        quiet=options.quiet,
        document=Path(options.update_doc) if options.update_doc else None,
    )


def _paper(options: argparse.Namespace) -> None:
    cycles = list(dict.fromkeys(options.cycle or paper.CYCLES))
    idle_drives = list(dict.fromkeys(options.idle_drive or ("none", "drag")))
    names = [cases.cycle_of(cycle).name for cycle in cycles]
    policies = Policies(options.vehicle, options.policy, options.say)
    tables = single.paper_table(options.paper, policies, cycles, idle_drives, options.jobs, options.quiet)
    if not options.quiet:
        for table in tables:
            title = table.title if table.section == TABLES else f"{table.section}: {table.title}"
            print(f"{title}\n{plain_table(table.rows, table.columns, screen())}\n")
        print(f"{textwrap.fill(table.note, screen())}\n{_policies_text(policies)}")
    if options.json:
        rows = [row for table in tables for cell in table.rows for row in cell.values()]
        printed = paper.as_printed(int(options.paper), names)
        content = {"package_version": __version__, "table": options.paper, "printed": printed, "rows": rows}
        write_json(options.json, content)


def _policies_text(policies: Policies) -> str:
    """Which policies a result was made with."""
    lines = ["control at 100 Hz; ours decides every 0.02 s, the paper's every 0.1 s; policies:"]
    for (name, idle_drive, friction), path in policies.used.items():
        policy = cases.policy_of(path)
        lines.append(f"  {name}, idle drive {idle_drive}, friction {friction:g}: {policy.identity}")
    return "\n".join(lines)


def _figure(options: argparse.Namespace) -> None:
    if not (options.plot or options.json):
        allowed = f"a file that ends in {', '.join(PICTURES)}, or --json"
        raise ConfigError("arguments", "--plot", "is missing", allowed)
    policies = Policies(options.vehicle, options.policy, options.say)
    drawn = single.figure(options.figure, policies, options.jobs)
    panels = drawn.data()
    if options.plot:
        write_picture(options.plot, drawn.captioned())
    if not options.quiet:
        print(f"{drawn.title}. {drawn.note}" + (f"\npicture: {options.plot}" if options.plot else ""))
        if policies.used:
            print(_policies_text(policies))
    if options.json:
        about = {"package_version": __version__, "title": drawn.title, "note": drawn.note}
        write_json(options.json, about | {"panels": panels})


def _ablation(options: argparse.Namespace) -> None:
    policies = Policies(options.vehicle, options.policy, options.say)
    with tempfile.TemporaryDirectory(prefix="iwm-ablation-") as folder:
        rows = ablation.ablation(policies, Path(folder), options.jobs, options.say, quiet=options.quiet)
    if not options.quiet:
        note = textwrap.fill(ABLATION_NOTE, screen())
        print(f"{plain_table(rows, ablation.columns(rows), screen())}\n{note}\n{_policies_text(policies)}")
    if options.json:
        write_json(options.json, {"package_version": __version__, "rows": rows})


def _fit_battery(options: argparse.Namespace) -> None:
    friction = _only("--friction", options.friction, 0.9)
    fit = battery_fit.fit(
        options.vehicle,
        _only("--idle-drive", options.idle_drive, ""),
        options.cycle or battery_fit.CYCLES,
        friction,
        options.initial_soc,
    )
    if not options.quiet:
        print(f"{fit.text()}\nequal split, {made_with(f'{friction:g}', fit.idle_drive, 100.0)}")
    if options.plot:
        write_picture(options.plot, battery_figure(fit).captioned())
        tell(f"picture: {options.plot}")
    if options.json:
        write_json(options.json, fit)


def _scenario(options: argparse.Namespace) -> int:
    """Each scenario with each strategy: what comes out, beside what is required; `FAILED` where that is not met."""
    idle_drive = _only("--idle-drive", options.idle_drive, "") or None
    scenarios = [load_scenario(name, idle_drive) for name in dict.fromkeys(options.scenario)]
    strategies = list(dict.fromkeys(options.strategy or [DEFAULT_STRATEGY]))
    for strategy in strategies:
        if strategy not in drivable():
            raise ConfigError("arguments", "--strategy", f"{strategy} drives no scenario", ", ".join(drivable()))
    _tell_doubts([f"warning: {scenario.cycle.gap}" for scenario in scenarios if scenario.cycle and scenario.cycle.gap])
    rows = []
    for scenario in scenarios:
        for strategy in strategies:
            result = check_scenario(scenario, law_settings.default_settings(strategy))
            if not options.quiet:
                law = law_settings.default_settings(strategy)
                how = made_with("of its roads", scenario.vehicle.idle_drive, 100.0, law.decision_period_s)
                print(f"{strategy}, {scenario.vehicle.name}, {how}, policies of the folder policies")
                print(road_text(result), flush=True)
            made = {"scenario": scenario.name, "strategy": strategy, "passed": result.passed}
            rows.append(made | {"values": result.values})
    if options.json:
        write_json(options.json, rows)
    return DONE if all(row["passed"] for row in rows) else FAILED


def _frontier(options: argparse.Namespace) -> None:
    if not options.cycle:
        raise ConfigError("arguments", "--cycle", "is missing", "one drive cycle or more, for instance nycc")
    folder = make_folder(options.frontier)
    found = []
    for idle_drive in options.idle_drive or [""]:
        vehicle = cases.vehicle_of(options.vehicle, idle_drive)
        for name in options.cycle:
            cycle = cases.cycle_of(name)
            for friction in options.friction or [0.9]:
                place = frontier.Place(f"{vehicle.name} on {cycle.name}", vehicle, cycle, friction)
                found.append(unseen.budgets_of(place, options.budgets or frontier.BUDGETS_PER_MIN))
                name = f"{vehicle.name}_{vehicle.idle_drive}_{cycle.name}_{friction_in_name(friction)}"
                picture = folder / f"{name.replace('/', '_')}.svg"
                frontier_figure.draw_frontier(found[-1], picture)
                if not options.quiet:
                    _show_frontier(found[-1], picture)
    for path in filter(None, (folder / "frontier.json", options.json)):
        write_json(path, unseen.to_json(found))


def _show_frontier(made: frontier.Frontier, picture: Path) -> None:
    print(f"{made.label}, {made.made_with}\n{plain_table(made.points, frontier.POINT_COLUMNS, screen())}")
    print("moves: sum of all moves, 1 being all the power; preview: the bound, the whole drive known in advance")
    print(f"picture: {picture}\n")


def _unseen(options: argparse.Namespace) -> None:
    folder = make_folder(options.unseen)
    idle_drive = _only("--idle-drive", options.idle_drive, "")
    wanted = unseen.cells(options.vehicle, idle_drive, options.seeds, options.cycles, options.cars)
    if not wanted:
        raise ConfigError("arguments", "--unseen", "has neither cycles nor cars", "--cycles or --cars")
    started = time.perf_counter()
    options.say(f"{len(wanted)} cells from seed {options.seeds} on; policies for cars of their own are solved first")
    compile_for_a_drive()
    with Bar(len(wanted), "cells", quiet=options.quiet) as bar:
        made = on_all_cores(unseen.drive_cell, wanted, options.jobs, lambda _: bar.update())
    write_json(folder / "unseen.json", unseen.to_json(made))
    frontier_figure.draw_margins(made, folder / "margins.svg")
    text = unseen.report(made)
    atomic_write(folder / "unseen.txt", (text + "\n").encode())
    if not options.quiet:
        took_min = (time.perf_counter() - started) / 60.0
        print(f"{text}\nin {took_min:.0f} min: {folder}/unseen.json, margins.svg, unseen.txt")


_RUN: Mapping[str, Callable[[argparse.Namespace], int | None]] = {
    "frontier": _frontier,
    "unseen": _unseen,
    "": _evaluate,
    "study": _study,
    "paper": _paper,
    "figure": _figure,
    "ablation": _ablation,
    "fit_battery": _fit_battery,
    "scenario": _scenario,
}
