"""Drive strategies over cycles and compare them: `evaluate --help`.

Exit codes: 0 done; 2 bad arguments or files; 130 interrupted.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from tqdm import tqdm

from iwm_power_manager import __version__
from iwm_power_manager.control import settings as law_settings
from iwm_power_manager.control.strategies import DEFAULT_STRATEGY, STRATEGIES
from iwm_power_manager.errors import ConfigError, IwmError
from iwm_power_manager.files import atomic_write
from iwm_power_manager.model.parameters import IDLE_DRIVES
from iwm_power_manager.tools.options import add_setting, number, whole
from iwm_sim.closed_loop import COLUMNS as SIGNALS
from iwm_sim.study import battery_fit, cases, reproduce
from iwm_sim.study.cases import POLICY_STRATEGIES, REFERENCE, Case, Result, SensorNoise
from iwm_sim.study.driving import Progress, cores, drive_all, warm_up, with_rules
from iwm_sim.study.policies import DEFAULT_GRID, PolicySource
from iwm_sim.study.rows import Row, rows_of
from iwm_sim.study.tables import text_table

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
  A table of two strategies on a dry road:
    evaluate --cycle nycc --friction 0.9 --strategy equal sdp

  All strategies on three roads, both readings of what an idle motor costs; rows as JSON:
    evaluate --cycle ftp75 hwfet nycc udds --friction 0.9 0.5 0.2 --idle-drive none drag --json out.json \\
             --strategy equal rule instantaneous instantaneous_slip sdp sdp_lookahead preview

  Your own car, cycle (time_s,speed_mps[,grade]) and policies:
    evaluate --vehicle my_car.yaml --cycle my_commute.csv --policy my_policies/ --strategy sdp_lookahead

  Icy road that the power manager takes for dry, with Table 2 as the paper prints it:
    evaluate --cycle udds --friction 0.2 --assumed-friction 0.9 --gate-mode table2 --no-gate-driving --strategy sdp

  The battery's resistance as the paper estimates it (eq. 25), with the comparison plot:
    evaluate --fit-battery --plot battery.svg

  Every table and figure of the paper, and what beats them:
    evaluate --study runs/study

Vehicles, cycles and grids that come with the package are found by name. Results go to stdout, progress to stderr.

exit codes: 0 done, 2 bad arguments or files, 130 interrupted
"""


def parser() -> argparse.ArgumentParser:
    """Arguments of the command."""
    result = argparse.ArgumentParser(
        prog="evaluate",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    what = result.add_argument_group("cases (all combinations are driven)")
    what.add_argument("--cycle", nargs="+", default=[], metavar="CSV", help="drive cycles: file or name (nycc)")
    what.add_argument(
        "--friction",
        nargs="+",
        type=number(0.05, 1.5),
        default=[0.9],
        metavar="MU",
        help="peak friction coefficients of the road (default: 0.9)",
    )
    what.add_argument(
        "--strategy",
        nargs="+",
        choices=list(STRATEGIES),
        default=[DEFAULT_STRATEGY],
        metavar="NAME",
        help=f"{', '.join(STRATEGIES)} (default: {DEFAULT_STRATEGY}); equal is always driven beside",
    )
    what.add_argument(
        "--idle-drive",
        nargs="+",
        choices=list(IDLE_DRIVES),
        default=[""],
        metavar="NAME",
        help=f"what a motor at zero torque costs: {', '.join(IDLE_DRIVES)} (default: as the vehicle's file says)",
    )
    what.add_argument("--vehicle", default=DEFAULT_VEHICLE, metavar="YAML", help="car (default: jalalmaab_2015)")

    policy = result.add_argument_group("policies (sdp, sdp_lookahead)")
    policy.add_argument(
        "--policy",
        default="policies",
        metavar="DIR|FILE",
        help="policy file, or folder of them; of a folder, the one for this car and the nearest friction is taken. "
        "What a folder lacks is solved and kept in the user's cache (default: policies)",
    )
    policy.add_argument(
        "--grid",
        default=DEFAULT_GRID,
        metavar="NAME|FILE",
        help="grid of a policy that has to be solved (default: %(default)s)",
    )
    policy.add_argument("--no-solve", action="store_true", help="a missing policy is an error")

    law = result.add_argument_group("control law")
    for name in ("gate_mode", "gate_driving", "critical_slip", "switching_power_w"):
        add_setting(law, name)
    law.add_argument(
        "--switching-cost",
        type=number(0.0, 1e6),
        metavar="J",
        help="preview: price of moving all the power to the other axle (default: that of the policy in use)",
    )
    law.add_argument(
        "--assumed-friction",
        type=number(0.05, 1.5),
        metavar="MU",
        help="friction the law is told (default: the road's)",
    )

    run = result.add_argument_group("simulation")
    run.add_argument(
        "--dt",
        type=number(1e-4, cases.MAX_DT_S),
        default=0.01,
        metavar="S",
        help="control step (default: %(default)s)",
    )
    run.add_argument("--substeps", type=whole(1, 100), default=1, metavar="N", help="plant steps in it")
    run.add_argument(
        "--initial-soc",
        type=number(0.05, 1.0),
        default=0.8,
        metavar="SOC",
        help="state of charge at the start, 0..1 (default: %(default)s)",
    )
    run.add_argument(
        "--noise",
        nargs=2,
        type=number(0.0, 10.0),
        default=[0.0, 0.0],
        metavar=("M/S", "RAD/S"),
        help="rms noise of speed and wheel speeds",
    )
    run.add_argument("--seed", type=whole(0, 2**32 - 1), default=1, metavar="N", help="of the noise")
    run.add_argument(
        "--jobs",
        type=whole(1, 1024),
        default=cores(),
        metavar="N",
        help="processes (default: one for each core)",
    )

    output = result.add_argument_group("output")
    output.add_argument("--json", metavar="FILE", help="a row for each case, with its settings and hashes")
    output.add_argument("--save-series", metavar="DIR", help="a .npz for each case, with an array for each signal")
    output.add_argument("--quiet", action="store_true", help="no progress, no table")
    output.add_argument("--version", action="version", version=f"%(prog)s {__version__}")

    other = result.add_argument_group("instead of single cases")
    other.add_argument(
        "--fit-battery", action="store_true", help="fit the control model's battery to the plant (eq. 25, Fig. 7)"
    )
    other.add_argument("--plot", metavar="SVG|PNG", help="--fit-battery: the comparison as a picture")
    other.add_argument("--study", metavar="DIR", help="all tables and figures of the paper, and beyond, into a folder")
    other.add_argument(
        "--update-doc", metavar="MD", help="--study: also replace the generated part of this file (docs/study.md)"
    )
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = parser().parse_args(arguments)
    try:
        if options.study:
            reproduce.study(
                Path(options.study),
                vehicle=options.vehicle,
                policy=options.policy,
                jobs=options.jobs,
                quiet=options.quiet,
                document=Path(options.update_doc) if options.update_doc else None,
            )
        elif options.fit_battery:
            _fit_battery(options)
        else:
            _evaluate(options)
    except IwmError as error:
        print(f"evaluate: error: {error}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("evaluate: interrupted; nothing half-written is left", file=sys.stderr)
        return INTERRUPTED
    return DONE


# --- cases ----------------------------------------------------------------------------------------------------------


def _evaluate(options: argparse.Namespace) -> None:
    if not options.cycle:
        raise ConfigError("arguments", "--cycle", "is missing", "one drive cycle or more, for instance nycc")
    started = time.perf_counter()
    say = _silent if options.quiet else _say
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
    strategies = list(dict.fromkeys([REFERENCE, *options.strategy]))
    source = PolicySource(options.policy, options.grid, not options.no_solve, say)
    settings = _settings(options)
    result = []
    for idle_drive in dict.fromkeys(options.idle_drive):
        vehicle = cases.vehicle_of(options.vehicle, idle_drive)
        for cycle in dict.fromkeys(options.cycle):
            for friction in dict.fromkeys(options.friction):
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
                of_road = [dataclasses.replace(base, strategy=strategy) for strategy in strategies]
                for case in of_road:
                    cases.check(case)
                result += of_road
    # Policies last: a wrong cycle must not be found after a minute of solving.
    policies: dict[tuple[str, float], str] = {}
    complete = []
    for case in result:
        key = (case.idle_drive, case.told_friction)
        needs = case.strategy in POLICY_STRATEGIES or (case.strategy == "preview" and options.switching_cost is None)
        if needs and key not in policies:
            policies[key] = source.find(cases.vehicle_of(case.vehicle, case.idle_drive), case.told_friction)
        complete.append(_with_policy(case, policies.get(key, ""), options.switching_cost))
    return complete


def _with_policy(case: Case, policy: str, switching_cost_j: float | None) -> Case:
    if case.strategy in POLICY_STRATEGIES:
        return dataclasses.replace(case, policy=policy)
    if case.strategy != "preview":
        return case
    if switching_cost_j is not None:
        return dataclasses.replace(case, switching_cost_j=switching_cost_j)
    problem = cases.policy_of(policy).problem
    return dataclasses.replace(
        case, switching_cost_j=problem.switching_cost_j, switching_fixed_cost_j=problem.switching_fixed_cost_j
    )


def _settings(options: argparse.Namespace) -> law_settings.Settings:
    given = {name: value for name, value in vars(options).items() if name in law_settings.TABLE and name != "strategy"}
    settings = law_settings.DEFAULTS._replace(**given)
    if settings.gate_mode == law_settings.GATE_MODE_TABLE2:
        settings = settings._replace(gate_hysteresis=0.0)  # as printed
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


# --- battery --------------------------------------------------------------------------------------------------------


def _fit_battery(options: argparse.Namespace) -> None:
    if options.plot:
        battery_fit.check_picture(options.plot)
    fit = battery_fit.fit(
        options.vehicle,
        options.idle_drive[0],
        options.cycle or battery_fit.CYCLES,
        options.friction[0],
        options.initial_soc,
    )
    if not options.quiet:
        print(fit.text())
    if options.plot:
        battery_fit.save_picture(fit, options.plot)
        _say(f"picture: {options.plot}")
    if options.json:
        atomic_write(options.json, (json.dumps(fit.to_json(), indent=1, allow_nan=False) + "\n").encode())


def _say(line: str) -> None:
    tqdm.write(line, file=sys.stderr)


def _silent(_: str) -> None:
    pass


if __name__ == "__main__":
    sys.exit(main())
