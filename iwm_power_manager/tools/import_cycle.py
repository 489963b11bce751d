# SPDX-License-Identifier: Apache-2.0
"""Make a drive cycle of a logged drive: `import_cycle --help`.

Exit codes: 0 written; 2 bad arguments or files; 130 interrupted.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from iwm_power_manager import __version__
from iwm_power_manager.tables import SEPARATORS
from iwm_power_manager.tools import command
from iwm_power_manager.tools import options as given
from iwm_power_manager.trace_units import SPEED_UNITS, TIME_UNITS

if TYPE_CHECKING:
    from iwm_power_manager.cycle import Cycle
    from iwm_power_manager.cycle_import import Log

_DESCRIPTION = """\
Make a drive cycle (CSV of time_s, speed_mps[, grade]) of a drive that something else has logged.

Separator, decimal commas, columns and units are found out and said; every one of them can be named. Rows without a
value and times that do not rise are left out and counted. A gap longer than --max-gap has to be bridged or cut by
choice. Noise costs a simulated driver energy that no driver spends: --smooth removes it, and what that does to the
energy at the wheels is shown, for the car named by --vehicle.
"""
_EXAMPLES = """\
examples:
  A log in km/h at 10 Hz, units from the names of its columns, with a picture of what was understood:
    import_cycle drive.csv --output trip.csv --plot trip.png

  Semicolons and decimal commas, a tunnel in the middle left out, smoothed over half a second:
    import_cycle fahrt.csv --time Zeit --speed "v [km/h]" --gaps cut --smooth 0.5 --output trip.csv

  Time as a clock, speed in mph, one sample a second:
    import_cycle log.txt --time-unit clock --speed-unit mph --rate 1 --output trip.csv

exit codes: 0 written, 2 bad arguments or files, 130 interrupted
"""


#: A distance of two samples beyond so many times the usual one is a gap.
_MISSED = 1.5
#: A cycle of which more than this part was bridged is warned of.
_INVENTED = 0.1


def parser() -> argparse.ArgumentParser:
    """Arguments of the command."""
    result = command.described("import_cycle", _DESCRIPTION, _EXAMPLES)
    result.add_argument("log", metavar="LOG", help="table with a header line; lines that start with # are skipped")
    table = result.add_argument_group("the table")
    table.add_argument("--separator", choices=("auto", *SEPARATORS), default="auto", help="default: %(default)s")
    table.add_argument("--decimal", choices=("auto", "point", "comma"), default="auto", help="default: %(default)s")
    table.add_argument("--time", default="", metavar="COLUMN", help="default: the first whose name looks like time")
    table.add_argument("--speed", default="", metavar="COLUMN", help="default: the first whose name looks like speed")
    table.add_argument(
        "--grade",
        default="",
        metavar="COLUMN",
        help="rise over run; default: one that is called grade, else level road",
    )
    table.add_argument(
        "--time-unit",
        choices=("auto", "clock", "min:s", *TIME_UNITS),
        default="auto",
        help="clock: dates, or hours:minutes[:seconds]; min:s: [hours:]minutes:seconds (default: %(default)s)",
    )
    table.add_argument("--speed-unit", choices=("auto", *SPEED_UNITS), default="auto", help="default: %(default)s")
    drive = result.add_argument_group("the drive")
    drive.add_argument(
        "--gaps",
        choices=("refuse", "bridge", "cut"),
        default="refuse",
        help="longer gaps: bridge by a straight line, or cut their time out and join the pieces (default: %(default)s)",
    )
    drive.add_argument(
        "--max-gap",
        type=given.number(0.01, 3600),
        default=3.0,
        metavar="S",
        help="shorter ones are bridged (default: 3)",
    )
    drive.add_argument(
        "--smooth",
        type=given.number(0, 60),
        default=0.0,
        metavar="S",
        help="standard deviation of a bell-shaped mean (default: 0, none)",
    )
    drive.add_argument(
        "--rate", type=given.number(0.01, 1000), default=0.0, metavar="HZ", help="default: the samples of the log"
    )
    drive.add_argument(
        "--vehicle",
        default="jalalmaab_2015",
        metavar="CAR",
        help="whose energy is shown, and who has to follow (default: %(default)s)",
    )
    drive.add_argument("--friction", type=given.number(0.01, 2), default=0.9, metavar="MU", help="default: %(default)s")
    output = result.add_argument_group("output")
    output.add_argument("--output", required=True, type=command.output_file, metavar="CSV", help="the cycle")
    output.add_argument("--plot", type=command.picture, metavar="PICTURE", help="log and cycle as .pdf, .png or .svg")
    output.add_argument(
        "--json", type=command.output_file, metavar="FILE", help="what was understood, with the numbers"
    )
    output.add_argument("--quiet", action="store_true", help="print errors and warnings only")
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = parser().parse_args(arguments)
    options.quiet |= options.json == "-"  # nothing else in what another program is to read
    return command.ended("import_cycle", lambda: _import(options))


def _import(options: argparse.Namespace) -> None:
    from iwm_power_manager.cycle_import import cycle_text, read_log, to_cycle
    from iwm_power_manager.model.feasible import trace_warnings
    from iwm_power_manager.share import resolve
    from iwm_power_manager.vehicle import load_vehicle

    vehicle = load_vehicle(resolve(options.vehicle))
    log = read_log(
        resolve(options.log),
        time=options.time,
        speed=options.speed,
        grade=options.grade,
        time_unit=options.time_unit,
        speed_unit=options.speed_unit,
        separator=options.separator,
        decimal=options.decimal,
    )
    cycle = to_cycle(log, options.gaps, options.max_gap, options.smooth, options.rate)
    raw = to_cycle(log, options.gaps, options.max_gap, 0.0, 0.0)
    numbers = _numbers(options, log, cycle, raw, vehicle)
    command.write_result(options.output, cycle_text(cycle, bool(options.grade or cycle.grade.any())).encode())
    if not options.quiet:
        print(_text(options, log, numbers))
    invented_m = log.across_gaps_m(options.max_gap) if options.gaps == "bridge" else 0.0
    warnings = [f"{vehicle.name}: {warning}" for warning in trace_warnings(cycle, vehicle.params, options.friction)]
    if invented_m > _INVENTED * cycle.distance_m:
        share = f"{invented_m / 1000.0:.2f} of {cycle.distance_m / 1000.0:.2f} km"
        warnings.append(f"{share} are straight lines over gaps that nobody drove: --gaps cut leaves them out")
    for warning in warnings:
        print(f"import_cycle: warning: {warning}", file=sys.stderr)
    if options.plot:
        _draw(options, log, raw, cycle)
    if options.json:
        command.write_json(options.json, numbers)


def _numbers(options: argparse.Namespace, log: Log, cycle: Cycle, raw: Cycle, vehicle: Any) -> dict[str, Any]:
    import numpy as np

    from iwm_power_manager.model.feasible import traction_wh_per_km

    change = np.interp(cycle.time_s, raw.time_s, raw.speed_mps) - cycle.speed_mps
    return {
        "package_version": __version__,
        "log": str(options.log),
        "said": log.said,
        "speed_unit": log.speed_unit,
        "time_unit": log.time_unit,
        "samples": int(log.time_s.size),
        "step_s": log.step_s,
        "noise_mps": log.noise_mps(),
        "gaps": [{"start_s": start, "length_s": length} for start, length in log.gaps(options.max_gap)],
        "gaps_were": options.gaps,
        "smooth_s": options.smooth,
        "smoothing_moved_mps_rms": math.sqrt(float(np.mean(change * change))),
        "vehicle": vehicle.name,
        "traction_wh_per_km_before": traction_wh_per_km(raw, vehicle.params),
        "traction_wh_per_km": traction_wh_per_km(cycle, vehicle.params),
        "cycle": str(options.output),
        "points": int(cycle.time_s.size),
        "duration_s": cycle.duration_s,
        "distance_m": cycle.distance_m,
        "top_speed_mps": float(cycle.speed_mps.max()),
    }


def _text(options: argparse.Namespace, log: Log, numbers: dict[str, Any]) -> str:
    lines = [f"{options.log}: {line}" for line in log.said]
    noise = numbers["noise_mps"] * 3.6
    lines.append(f"{numbers['samples']} samples, {log.step_s:.4g} s apart, noise about {noise:.2f} km/h rms")
    for gap in numbers["gaps"]:
        done = {"bridge": "bridged by a straight line", "cut": "cut out"}[options.gaps]
        lines.append(f"gap of {gap['length_s']:.4g} s from {gap['start_s']:.6g} s {done}")
    short = [length for _, length in log.gaps(_MISSED * log.step_s) if length <= options.max_gap]
    if short:
        lines.append(f"{len(short)} gap{'s' * (len(short) > 1)} of up to {max(short):.4g} s bridged (--max-gap)")
    before, after = numbers["traction_wh_per_km_before"], numbers["traction_wh_per_km"]
    effect = f"energy at the wheels of {numbers['vehicle']}: {after:.1f} Wh/km"
    if options.smooth or options.rate:
        effect += f"; {before:.1f} as logged ({100.0 * (after / before - 1.0):+.1f} %)" if before else ""
        effect += f"; the speed moved by {3.6 * numbers['smoothing_moved_mps_rms']:.2f} km/h rms"
    elif noise > 0.03:
        effect += f"; part of it is noise: --smooth {max(5 * log.step_s, 0.5):.2g} shows how much"
    lines.append(effect)
    lines.append(
        f"{options.output}: {numbers['points']} points, {numbers['duration_s']:.1f} s, "
        f"{numbers['distance_m'] / 1000.0:.3f} km, up to {3.6 * numbers['top_speed_mps']:.1f} km/h"
    )
    return "\n".join(lines)


def _draw(options: argparse.Namespace, log: Log, raw: Cycle, cycle: Cycle) -> None:
    import numpy as np
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 6.0), layout="constrained")
    whole, part = figure.subplots(2, 1)
    # The hardest minute is where a wrong unit or too much smoothing shows.
    steepest = int(abs(cycle.speed_mps[1:] - cycle.speed_mps[:-1]).argmax())
    middle = float(cycle.time_s[steepest])
    # Where the log has no sample, no line of the log; its samples are those of the raw cycle, gaps cut out or not.
    gaps = log.gaps_after(_MISSED * log.step_s)
    after = np.array(gaps, dtype=int) + 1
    logged = [np.insert(values, after, np.nan) for values in (raw.time_s, 3.6 * raw.speed_mps)]
    for axes in (whole, part):
        axes.plot(*logged, color="0.6", linewidth=2.5, label=f"log ({log.speed_unit})")
        axes.plot(cycle.time_s, 3.6 * cycle.speed_mps, color="C0", linewidth=1.0, label="cycle")
        axes.set_ylabel("speed, km/h")
        axes.grid(alpha=0.3)
    part.set_xlim(max(middle - 30.0, 0.0), min(middle + 30.0, float(cycle.time_s[-1])))
    part.set_xlabel("time, s")
    part.set_title("the minute around the hardest change of speed", fontsize="medium")
    cut = set(log.gaps_after(options.max_gap)) if options.gaps == "cut" else set()
    for label, colour, found in (("bridged", "C3", [i for i in gaps if i not in cut]), ("cut out", "C4", sorted(cut))):
        spans = [(raw.time_s[i], raw.time_s[i + 1] - raw.time_s[i]) for i in found]
        for axes in (whole, part) if spans else ():
            area = axes.get_xaxis_transform()
            axes.broken_barh(spans, (0.0, 1.0), transform=area, color=colour, alpha=0.2, label=label)
    whole.legend(loc="upper right")
    whole.set_title(f"{options.log}: {cycle.duration_s:.0f} s, {cycle.distance_m / 1000.0:.2f} km")
    command.write_picture(options.plot, figure)


if __name__ == "__main__":
    sys.exit(main())
