"""Drive strategies over cycles and compare them: `evaluate --help`.

Exit codes: 0 done; 2 bad arguments or files; 130 interrupted.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from iwm_power_manager import __version__
from iwm_power_manager.control import settings as law_settings
from iwm_power_manager.control.strategies import DEFAULT_STRATEGY, STRATEGIES
from iwm_power_manager.errors import ConfigError, IwmError
from iwm_power_manager.files import atomic_write
from iwm_power_manager.model.parameters import IDLE_DRIVES
from iwm_power_manager.tools.options import add_setting, number, several, whole
from iwm_sim.closed_loop import COLUMNS as SIGNALS
from iwm_sim.study import ablation, battery_fit, cases, figures, paper, reproduce, single
from iwm_sim.study.cases import POLICY_STRATEGIES, REFERENCE, Case, Result, SensorNoise
from iwm_sim.study.driving import Progress, cores, drive_all, silent, tell, warm_up, with_rules
from iwm_sim.study.plan import Policies
from iwm_sim.study.policies import DEFAULT_GRID, PolicySource
from iwm_sim.study.rows import Row, rows_of
from iwm_sim.study.tables import plain_table, text_table
from iwm_sim.study.variants import VARIANTS

DONE, BAD_INPUT, INTERRUPTED = 0, 2, 130

DEFAULT_VEHICLE = "config/vehicles/jalalmaab_2015.yaml"

_DESCRIPTION = """\
Drive a car over drive cycles with several strategies for its front/rear power split, and compare what it took.

Driver, control law and plant run in one process, without ROS; the cases are spread over the cores. Every saving is
against equal split on the same road, which is always driven too. Energies are compared only between runs that covered
the same distance to 0.1 %. A trace counts as held if the speed stays within 2 mph of it inside a 1 s window (EPA).
"""

_EXAMPLES = """\
examples:
  Our policy beside equal split on a dry road:
    evaluate --cycle nycc --friction 0.9

  The paper's strategy beside ours and the bound; rows as JSON:
    evaluate --cycle ftp75 hwfet nycc udds --friction 0.9 0.5 0.2 --idle-drive none drag --json out.json \\
             --strategy paper_sdp sdp_lookahead preview

  Your own car, cycle (time_s,speed_mps[,grade]) and policies:
    evaluate --vehicle my_car.yaml --cycle my_commute.csv --policy my_policies/

  Icy road that the power manager takes for dry, with Table 2 as the paper prints it:
    evaluate --cycle udds --friction 0.2 --assumed-friction 0.9 --gate-mode table2 --no-gate-driving --strategy sdp

  A cell of the paper's Table 3, a figure of it, and why its program loses here:
    evaluate --paper 3 --cycle nycc --idle-drive none
    evaluate --figure 12 --plot figure_12.svg
    evaluate --ablation

  The battery's resistance as the paper estimates it (eq. 25), with the comparison plot:
    evaluate --fit-battery --plot battery.svg

  Every table and figure of the paper, and what beats them (half an hour on two cores):
    evaluate --study runs/study

Vehicles, cycles and grids that come with the package are found by name. Results go to stdout, progress to stderr. An
option that has no effect on what is asked for is refused.

exit codes: 0 done, 2 bad arguments or files, 130 interrupted
"""

#: Settings of the law that are options.
LAW_OPTIONS = ("decision_period_s", "gate_mode", "gate_driving", "critical_slip", "switching_power_w")

#: What is done instead of single cases, and the options that mean something there.
_COMMON = {"--vehicle", "--policy", "--jobs", "--quiet"}
MODES = {
    "study": _COMMON | {"--study", "--update-doc"},
    "paper": _COMMON | {"--paper", "--cycle", "--idle-drive"},
    "figure": _COMMON | {"--figure", "--plot"},
    "ablation": _COMMON | {"--ablation", "--json"},
    "fit_battery": {"--fit-battery", "--vehicle", "--quiet", "--plot", "--json", "--cycle", "--friction"}
    | {"--idle-drive", "--initial-soc"},
}


def parser() -> argparse.ArgumentParser:
    """Arguments of the command."""
    result = argparse.ArgumentParser(
        prog="evaluate",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    _add_cases(result.add_argument_group("cases (all combinations are driven)"))
    _add_policies(result.add_argument_group("policies (sdp, sdp_lookahead; preview takes its price from them)"))
    _add_law(result.add_argument_group("control law"))
    _add_simulation(result.add_argument_group("simulation"))
    _add_output(result.add_argument_group("output"))
    _add_modes(result.add_argument_group("instead of single cases"))
    return result


def _add_cases(group: argparse._ArgumentGroup) -> None:
    group.add_argument("--cycle", **several, metavar="CSV", help="drive cycles: file or name (nycc)")
    group.add_argument(
        "--friction",
        **several,
        type=number(0.05, 1.5),
        metavar="MU",
        help="peak friction coefficients of the road (default: 0.9)",
    )
    named = "; ".join(f"{name}: {variant.meaning}" for name, variant in VARIANTS.items())
    group.add_argument(
        "--strategy",
        **several,
        choices=[*STRATEGIES, *VARIANTS],
        metavar="NAME",
        help=f"{', '.join(STRATEGIES)} (default: {DEFAULT_STRATEGY}; equal is always driven beside); {named}",
    )
    group.add_argument(
        "--idle-drive",
        **several,
        choices=list(IDLE_DRIVES),
        metavar="NAME",
        help=f"what a motor at zero torque costs: {', '.join(IDLE_DRIVES)} (default: as the vehicle's file says)",
    )
    group.add_argument("--vehicle", default=DEFAULT_VEHICLE, metavar="YAML", help="car (default: jalalmaab_2015)")


def _add_policies(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--policy",
        default="policies",
        metavar="DIR|FILE",
        help="policy file, or folder of them; of a folder, the one for this car and the nearest friction is taken. "
        "What a folder lacks is solved and kept in the user's cache (default: policies)",
    )
    group.add_argument(
        "--grid",
        default="",
        metavar="NAME|FILE",
        help=f"only policies on this grid (default: any; what has to be solved is solved on {DEFAULT_GRID})",
    )
    group.add_argument("--no-solve", action="store_true", help="a missing policy is an error")


def _add_law(group: argparse._ArgumentGroup) -> None:
    for name in LAW_OPTIONS:
        add_setting(group, name)
    group.add_argument(
        "--switching-cost",
        type=number(0.0, 1e6),
        metavar="J",
        help="preview: price of moving all the power to the other axle (default: that of the policy in use)",
    )
    group.add_argument(
        "--assumed-friction",
        type=number(0.05, 1.5),
        metavar="MU",
        help="friction the law is told (default: the road's)",
    )


def _add_simulation(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--dt",
        type=number(1e-4, cases.MAX_DT_S),
        default=0.01,
        metavar="S",
        help="control step (default: %(default)s)",
    )
    group.add_argument("--substeps", type=whole(1, 100), default=1, metavar="N", help="plant steps in it")
    group.add_argument(
        "--initial-soc",
        type=number(0.05, 1.0),
        default=0.8,
        metavar="SOC",
        help="state of charge at the start, 0..1 (default: %(default)s)",
    )
    group.add_argument(
        "--noise",
        nargs=2,
        type=number(0.0, 10.0),
        default=[0.0, 0.0],
        metavar=("M/S", "RAD/S"),
        help="rms noise of speed and wheel speeds",
    )
    group.add_argument("--seed", type=whole(0, 2**32 - 1), default=1, metavar="N", help="of the noise")
    group.add_argument(
        "--jobs",
        type=whole(1, 1024),
        default=cores(),
        metavar="N",
        help="processes (default: one for each core)",
    )


def _add_output(group: argparse._ArgumentGroup) -> None:
    group.add_argument("--json", metavar="FILE", help="a row for each case, with its settings and hashes")
    group.add_argument("--save-series", metavar="DIR", help="a .npz for each case, with an array for each signal")
    group.add_argument("--quiet", action="store_true", help="no progress, no table")
    group.add_argument("--version", action="version", version=f"%(prog)s {__version__}")


def _add_modes(parent: argparse._ArgumentGroup) -> None:
    group = parent.add_mutually_exclusive_group()
    group.add_argument(
        "--paper", choices=list(single.TABLES), metavar="TABLE", help="a table of the paper: 3, 4, 5 or 6"
    )
    group.add_argument(
        "--figure", choices=single.FIGURES, metavar="N", help=f"a figure of the study: {', '.join(single.FIGURES)}"
    )
    group.add_argument("--ablation", action="store_true", help="what each choice of the paper's program costs")
    group.add_argument(
        "--fit-battery", action="store_true", help="fit the control model's battery to the plant (eq. 25, Fig. 7)"
    )
    group.add_argument("--study", metavar="DIR", help="all tables and figures of the paper, and beyond, into a folder")
    parent.add_argument("--plot", metavar="SVG|PNG", help="--figure, --fit-battery: the picture")
    parent.add_argument(
        "--update-doc", metavar="MD", help="--study: also replace the generated part of this file (docs/study.md)"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = parser().parse_args(arguments)
    try:
        mode = next((name for name in MODES if getattr(options, name)), "")
        refuse_useless(options, given_options(sys.argv[1:] if arguments is None else arguments), mode)
        _RUN[mode](options)
    except IwmError as error:
        print(f"evaluate: error: {error}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("evaluate: interrupted; nothing half-written is left", file=sys.stderr)
        return INTERRUPTED
    return DONE


# --- options that would have no effect ------------------------------------------------------------------------------


def given_options(arguments: Sequence[str]) -> set[str]:
    """Names of the options that a command line has; `--no-x` counts as `--x`."""
    names = {text.split("=", 1)[0] for text in arguments if text.startswith("--")}
    return {"--gate-driving" if name == "--no-gate-driving" else name for name in names}


def refuse_useless(options: argparse.Namespace, given: set[str], mode: str) -> None:
    """Refuse what would change nothing, instead of leaving it unsaid; `ConfigError`."""
    if mode:
        for option in sorted(given - MODES[mode]):
            raise ConfigError("arguments", option, f"has no effect with --{mode.replace('_', '-')}")
        return
    strategies = set(options.strategy or [DEFAULT_STRATEGY])
    plain = strategies & set(STRATEGIES) - {REFERENCE}
    with_policy = bool(plain & POLICY_STRATEGIES) or ("preview" in plain and options.switching_cost is None)
    useful = {
        "--policy": (with_policy, "no strategy here takes it"),
        "--grid": (with_policy, "no strategy here takes it"),
        "--decision-period": (bool(plain), "no strategy here takes it; those of the paper decide every 0.1 s"),
        "--switching-power": ("instantaneous_slip" in plain, "it is for strategy instantaneous_slip"),
        "--switching-cost": ("preview" in plain, "it is for strategy preview"),
        "--gate-driving": (options.gate_mode != law_settings.GATE_MODE_OFF, "--gate-mode off gates nothing"),
        "--seed": (any(options.noise), "there is no --noise"),
        "--plot": (False, "it is for --figure and --fit-battery"),
        "--update-doc": (False, "it is for --study"),
    }
    for option, (has_effect, reason) in useful.items():
        if option in given and not has_effect:
            raise ConfigError("arguments", option, f"has no effect: {reason}")


# --- cases ----------------------------------------------------------------------------------------------------------


def _evaluate(options: argparse.Namespace) -> None:
    if not options.cycle:
        raise ConfigError("arguments", "--cycle", "is missing", "one drive cycle or more, for instance nycc")
    started = time.perf_counter()
    say = silent if options.quiet else tell
    wanted = planned(options, say)
    with Progress(len(wanted), options.quiet) as progress:
        warm_up(wanted, say)
        wanted = with_rules(wanted, options.jobs)
        drive = _Saving(options.save_series) if options.save_series else cases.result
        results = drive_all(wanted, options.jobs, progress.update, drive)
    rows = rows_of(results)
    if not options.quiet:
        print(text_table(rows))
        for line in remarks(rows):
            print(line)
        say(f"{len(rows)} cases in {time.perf_counter() - started:.1f} s")
    if options.json:
        content = {"package_version": __version__, "rows": [row.to_json() for row in rows]}
        atomic_write(options.json, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())
        say(f"rows: {options.json}")


def planned(options: argparse.Namespace, say: Callable[[str], None]) -> list[Case]:
    """The cases of a command line, each checked, with their policies found or solved. Equal split is always there."""
    if options.save_series:
        _make_folder(options.save_series)
    strategies = list(dict.fromkeys([REFERENCE, *(options.strategy or [DEFAULT_STRATEGY])]))
    settings = _settings(options)
    result: list[tuple[str, Case]] = []
    for idle_drive in dict.fromkeys(options.idle_drive or [""]):
        vehicle = cases.vehicle_of(options.vehicle, idle_drive)
        for cycle in dict.fromkeys(options.cycle):
            for friction in dict.fromkeys(options.friction or [0.9]):
                base = Case(
                    cycle=cycle,
                    vehicle=options.vehicle,
                    idle_drive=vehicle.idle_drive,
                    friction=friction,
                    strategy=REFERENCE,
                    settings=settings,
                    dt_s=options.dt,
                    substeps=options.substeps,
                    soc=options.initial_soc,
                    assumed_friction=options.assumed_friction,
                    noise=SensorNoise(options.noise[0], options.noise[1], options.seed),
                )
                for name in strategies:
                    known = VARIANTS[name].case(base, name) if name in VARIANTS else None
                    result.append((name, known or dataclasses.replace(base, strategy=name)))
                    cases.check(result[-1][1])
    # Policies last: a wrong cycle must not be found after a minute of solving.
    source = PolicySource(options.policy, options.grid, not options.no_solve, say)

    @functools.cache
    def find(idle_drive: str, friction: float) -> str:
        return source.find(cases.vehicle_of(options.vehicle, idle_drive), friction)

    policies = Policies(options.vehicle, options.policy, say)
    return [_with_policy(name, case, options, find, policies) for name, case in result]


def _with_policy(
    name: str, case: Case, options: argparse.Namespace, find: Callable[[str, float], str], policies: Policies
) -> Case:
    if name in VARIANTS:
        return dataclasses.replace(case, policy=policies.of_variant(name, case.idle_drive, case.told_friction))
    if name in POLICY_STRATEGIES:
        return dataclasses.replace(case, policy=find(case.idle_drive, case.told_friction))
    if name != "preview":
        return case
    if options.switching_cost is None:
        case = cases.priced_as(case, find(case.idle_drive, case.told_friction))
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
    target = min(settings.slip_target, 0.75 * settings.critical_slip)  # the limiter works in front of the gate
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
        lines.append("lost: the car left the EPA tolerance by the m/s shown; its energy says little")
    if any(row.same_distance_as_equal is False for row in rows):
        lines.append("no saving: the distance differs from that of equal split by more than 0.1 %; compare Wh/km")
    with_policy = [row.made_with for row in rows if row.made_with["policy_friction"]]
    for told, solved_for in sorted({(made["assumed_friction"], made["policy_friction"]) for made in with_policy}):
        if told != solved_for:
            lines.append(f"friction {told:g} was driven with the policy for {solved_for:g}, the nearest there is")
    return lines


def _make_folder(path: str) -> None:
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(path, "", f"cannot be created: {error.strerror}", "a folder") from None


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
    say = silent if options.quiet else tell
    cycles = list(dict.fromkeys(options.cycle or paper.CYCLES))
    idle_drives = list(dict.fromkeys(options.idle_drive or ("none", "drag")))
    for cycle in cycles:
        cases.cycle_of(cycle)
    policies = Policies(options.vehicle, options.policy, say)
    for table in single.paper_table(options.paper, policies, cycles, idle_drives, options.jobs):
        print(f"{table.title or table.section}\n{plain_table(table.rows, table.columns)}\n")
    print(f"{table.note}\n{_policies_text(policies, options.paper, idle_drives)}")


def _policies_text(policies: Policies, table: str, idle_drives: Sequence[str]) -> str:
    """Which policies a table was driven with."""
    lines = ["control at 100 Hz; ours decides every 0.02 s, the paper's every 0.1 s; policies:"]
    names = ("paper_sdp_ungated", "paper_sdp_table2") if table == "6" else ("paper_sdp",)
    for friction in single.TABLES[table]:
        for idle_drive in idle_drives:
            used = {"ours": policies.ours(idle_drive, friction)}
            used |= {name: policies.of_variant(name, idle_drive, friction) for name in names}
            found = {name: cases.policy_of(path) for name, path in used.items()}
            text = ", ".join(f"{name}: {policy.problem.name} {policy.checksum[:8]}" for name, policy in found.items())
            lines.append(f"  friction {friction:g}, idle drive {idle_drive}: {text}")
    return "\n".join(lines)


def _figure(options: argparse.Namespace) -> None:
    if not options.plot:
        raise ConfigError("arguments", "--plot", "is missing", "a file that ends in .svg or .png")
    battery_fit.check_picture(options.plot)
    policies = Policies(options.vehicle, options.policy, silent if options.quiet else tell)
    drawn = single.figure(options.figure, policies, options.jobs)
    battery_fit.save_picture(drawn.figure, options.plot)
    if not options.quiet:
        print(f"{drawn.title}. {drawn.note}\npicture: {options.plot}")


def _ablation(options: argparse.Namespace) -> None:
    say = silent if options.quiet else tell
    with tempfile.TemporaryDirectory(prefix="iwm-ablation-") as folder:
        rows = ablation.ablation(Policies(options.vehicle, options.policy, say), Path(folder), options.jobs, say)
    if not options.quiet:
        print(plain_table(rows, ablation.columns(rows)))
    if options.json:
        content = {"package_version": __version__, "rows": [dataclasses.asdict(row) for row in rows]}
        atomic_write(options.json, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())


def _fit_battery(options: argparse.Namespace) -> None:
    if options.plot:
        battery_fit.check_picture(options.plot)
    fit = battery_fit.fit(
        options.vehicle,
        (options.idle_drive or [""])[0],
        options.cycle or battery_fit.CYCLES,
        (options.friction or [0.9])[0],
        options.initial_soc,
    )
    if not options.quiet:
        print(fit.text())
    if options.plot:
        battery_fit.save_picture(figures.model_comparison(*fit.comparison), options.plot)
        tell(f"picture: {options.plot}")
    if options.json:
        atomic_write(options.json, (json.dumps(fit.to_json(), indent=1, allow_nan=False) + "\n").encode())


_RUN = {
    "": _evaluate,
    "study": _study,
    "paper": _paper,
    "figure": _figure,
    "ablation": _ablation,
    "fit_battery": _fit_battery,
}


if __name__ == "__main__":
    sys.exit(main())
