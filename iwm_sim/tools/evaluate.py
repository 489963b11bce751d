# SPDX-License-Identifier: Apache-2.0
"""Drive strategies over cycles and compare them: `evaluate --help`.

Exit codes: 0 done; 1 a scenario does not meet what it requires; 2 bad arguments or files; 130 interrupted.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from iwm_power_manager.command_line import refuse_without_effect
from iwm_power_manager.control import settings as law_settings
from iwm_power_manager.control.strategies import DEFAULT_STRATEGY, STRATEGIES, meaning
from iwm_power_manager.model.parameters import IDLE_DRIVES
from iwm_power_manager.tools.command import described, ended, output_file, picture
from iwm_power_manager.tools.options import add_setting, number, several, whole
from iwm_sim.study.names import DEFAULT_GRID, DEFAULT_POLICY, FIGURES, MAX_DT_S, NO_RESULTS, REFERENCE, TABLES, cores
from iwm_sim.study.variants import VARIANTS

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
    evaluate --figure 12 --plot figure_12.pdf
    evaluate --ablation                         (3 min)

  The battery's resistance as the paper estimates it (eq. 25), with the comparison plot:
    evaluate --fit-battery --plot battery.svg

  Every table and figure of the paper, and what beats them (3 min on two cores):
    evaluate --study runs/study

Vehicles, cycles and grids that come with the package are found by name. Results go to stdout, progress to stderr. An
option that has no effect on what is asked for is refused.

exit codes: 0 done, 1 a scenario does not meet what it requires, 2 bad arguments or files, 130 interrupted
"""

#: Settings of the law that are options.
LAW_OPTIONS = ("decision_period_s", "gate_mode", "gate_driving", "critical_slip", "switching_power_w")

#: What is done instead of single cases, and the options that mean something there.
_COMMON = {"--vehicle", "--policy", "--jobs", "--quiet"}
MODES = {
    "study": _COMMON | {"--study", "--update-doc"},
    "paper": _COMMON | {"--paper", "--cycle", "--idle-drive", "--json"},
    "figure": {"--figure", "--plot", "--json", "--vehicle", "--quiet"},
    "ablation": _COMMON | {"--ablation", "--json"},
    "frontier": {"--frontier", "--vehicle", "--idle-drive", "--cycle", "--friction", "--budgets"}
    | {"--json", "--quiet"},
    "unseen": {"--unseen", "--vehicle", "--idle-drive", "--seeds", "--cycles", "--cars", "--jobs", "--quiet"},
    "scenario": {"--scenario", "--strategy", "--idle-drive", "--json", "--quiet"},
    "fit_battery": {"--fit-battery", "--vehicle", "--quiet", "--plot", "--json", "--cycle", "--friction"}
    | {"--idle-drive", "--initial-soc"},
}


def parser() -> argparse.ArgumentParser:
    """Arguments of the command."""
    result = described("evaluate", _DESCRIPTION, _EXAMPLES)
    variants = {name: variant.meaning for name, variant in VARIANTS.items()}
    result.meanings = {name: meaning(name) for name in STRATEGIES} | variants
    _add_cases(result.add_argument_group("cases (all combinations are driven)"))
    _add_policies(result.add_argument_group("policies (sdp, sdp_lookahead; preview takes its budget from them)"))
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
        default=DEFAULT_POLICY,
        metavar="DIR|FILE",
        help="policy file, or folder of them; of a folder, the one for this car and the nearest friction is taken. "
        "What the package's own folder lacks is solved and kept in the user's cache (default: policies)",
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
        help="preview: price of moving all the power to the other axle (default: what keeps the policy's budget)",
    )
    group.add_argument(
        "--assumed-friction",
        type=number(0.05, 1.5),
        metavar="MU",
        help="friction the law is told (default: the road's)",
    )
    group.add_argument(
        "--friction-source",
        choices=("parameter", "estimated"),
        default="parameter",
        help="estimated: the law estimates the friction from friction_prior on, and its policy is picked by it, as in "
        "the node (default: it is told)",
    )


def _add_simulation(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--dt", type=number(1e-4, MAX_DT_S), default=0.01, metavar="S", help="control step (default: %(default)s)"
    )
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
        "--jobs", type=whole(1, 1024), default=cores(), metavar="N", help="processes (default: one for each core)"
    )


def _add_output(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--json",
        type=output_file,
        metavar="FILE",
        help="a row for each case, with settings and hashes; or what was asked for instead; - for standard output, "
        "with nothing else there",
    )
    group.add_argument("--save-series", metavar="DIR", help="a .npz for each case, with an array for each signal")
    group.add_argument("--quiet", action="store_true", help="no progress, no table; warnings stay")


def _add_modes(parent: argparse._ArgumentGroup) -> None:
    group = parent.add_mutually_exclusive_group()
    group.add_argument("--paper", choices=list(TABLES), metavar="TABLE", help="a table of the paper: 3, 4, 5 or 6")
    group.add_argument(
        "--figure", type=_figure, choices=FIGURES, metavar="N", help=f"a figure of the study: {', '.join(FIGURES)}"
    )
    group.add_argument(
        "--scenario", **several, metavar="NAME", help="real roads: files, or names of config/scenarios (see make roads)"
    )
    group.add_argument(
        "--frontier", metavar="DIR", help="saving against changes: ours over budgets, its rival over thresholds"
    )
    group.add_argument(
        "--unseen", metavar="DIR", help="the same at the default budget, on cycles and cars drawn from seeds"
    )
    group.add_argument("--ablation", action="store_true", help="what each choice of the paper's program costs")
    group.add_argument(
        "--fit-battery", action="store_true", help="fit the control model's battery to the plant (eq. 25, Fig. 7)"
    )
    group.add_argument("--study", metavar="DIR", help="all tables and figures of the paper, and beyond, into a folder")
    parent.add_argument(
        "--budgets", **several, type=number(0.1, 1e4), metavar="N", help="--frontier: changes a minute (1000: free)"
    )
    parent.add_argument("--seeds", type=whole(0, 10**9), default=1000, metavar="FIRST", help="--unseen: first seed")
    parent.add_argument("--cycles", type=whole(0, 10_000), default=200, metavar="N", help="--unseen: cycles drawn")
    parent.add_argument("--cars", type=whole(0, 10_000), default=20, metavar="N", help="--unseen: cars drawn")
    parent.add_argument("--plot", type=picture, metavar="PICTURE", help="--figure, --fit-battery: .pdf, .png or .svg")
    parent.add_argument(
        "--update-doc", metavar="MD", help="--study: also replace the generated part of this file (docs/study.md)"
    )


def _figure(text: str) -> str:
    if text in NO_RESULTS:
        raise argparse.ArgumentTypeError(f"figure {text} is {NO_RESULTS[text]}; there is nothing to compute")
    return text


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = parser().parse_args(arguments)
    options.quiet |= options.json == "-"  # nothing else in what another program is to read
    folder = options.study or options.frontier or options.unseen or options.save_series
    return ended("evaluate", lambda: _evaluate(options), folder, quiet=options.quiet)


def _evaluate(options: argparse.Namespace) -> int | None:
    mode = next((name for name in MODES if getattr(options, name)), "")
    refuse_without_effect(options, _useful_in(mode, options) if mode else _useful_in_cases(options))
    from iwm_sim.tools.evaluate_run import run

    return run(mode, options)


# --- options that would have no effect ------------------------------------------------------------------------------


_TABLES = f": {'; '.join(f'table {name} is of {", ".join(map(str, roads))}' for name, roads in TABLES.items())}"

#: Strategies that decide alike on every road.
_ON_ANY_ROAD = {REFERENCE, "instantaneous"}


def _useful_in(mode: str, options: argparse.Namespace) -> dict[str, tuple[object, str]]:
    """What changes anything of what is done instead of single cases."""
    heeded = MODES[mode] | FIGURES.get(options.figure, frozenset())
    what = f"not with --{mode.replace('_', '-')}{f' {options.figure}' if mode == 'figure' else ''}"
    useful: dict[str, tuple[object, str]] = {option: (option in heeded, what) for option in sorted(options.given)}
    if mode == "paper":
        useful["--friction"] = (False, what + _TABLES)
    return useful


def _useful_in_cases(options: argparse.Namespace) -> dict[str, tuple[object, str]]:
    """What changes anything of single cases, by their strategies."""
    strategies = set(options.strategy or [DEFAULT_STRATEGY])
    plain = strategies & set(STRATEGIES) - {REFERENCE}
    with_policy = {name for name in plain if STRATEGIES[name].needs_policy}
    budgeted = "preview" in plain and options.switching_cost is None
    told = with_policy if options.friction_source == "parameter" else set()
    gated = options.gate_mode != law_settings.GATE_MODE_OFF
    of_no_strategy = "no strategy here takes it"
    return {
        "--policy": (with_policy or budgeted, of_no_strategy),
        **dict.fromkeys(("--grid", "--no-solve"), (told or budgeted, of_no_strategy)),
        "--friction-source": (with_policy, of_no_strategy),
        "--assumed-friction": (strategies - _ON_ANY_ROAD - with_policy | told, of_no_strategy),
        "--decision-period": (plain, f"{of_no_strategy}; those of the paper decide every 0.1 s"),
        "--switching-power": ("instantaneous_slip" in plain, "it is for strategy instantaneous_slip"),
        "--switching-cost": ("preview" in plain, "it is for strategy preview"),
        **dict.fromkeys(("--gate-driving", "--critical-slip"), (gated, "--gate-mode off gates nothing")),
        "--seed": (any(options.noise), "there is no --noise"),
        "--plot": (False, "it is for --figure and --fit-battery"),
        "--update-doc": (False, "it is for --study"),
        "--budgets": (False, "it is for --frontier"),
        **dict.fromkeys(("--seeds", "--cycles", "--cars"), (False, "it is for --unseen")),
    }


if __name__ == "__main__":
    sys.exit(main())
