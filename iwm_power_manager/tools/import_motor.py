# SPDX-License-Identifier: Apache-2.0
"""Make a motor map of a table of another program: `import_motor --help`.

Exit codes: 0 written; 2 bad arguments or files; 130 interrupted.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from iwm_power_manager import __version__
from iwm_power_manager.command_line import refuse_without_effect
from iwm_power_manager.tables import SEPARATORS
from iwm_power_manager.tools import command
from iwm_power_manager.tools import options as given

if TYPE_CHECKING:
    from iwm_power_manager.motor_map import LossFit, MotorMap, Reach

_DESCRIPTION = """\
Make a motor map (CSV of speed_rad_s, torque_nm, efficiency) of a table of efficiencies or losses, and show what was
understood: the map as a picture (--plot), what it lacks of what the motor shall do (--peak-torque and so on), and how
well a loss polynomial meets it, as `extrapolate: loss_model` would use it.
"""
_EXAMPLES = """\
examples:
  Percent and rpm, one point in each row, seen as a picture:
    import_motor sheet.csv --percent --speed-unit rpm --output my_motor.csv --plot my_motor.png

  A matrix out of a spreadsheet, torques down, speeds across, decimal commas, behind a gear of 9 : 1:
    import_motor kennfeld.csv --layout matrix --down torque --decimal comma --gear 9 --output my_motor.csv

  Does it reach what the motor shall do?
    import_motor sheet.csv --peak-torque 200 --regeneration-torque 80 --max-power 7500 --top-speed 130 --output m.csv

Afterwards, in the vehicle file:   motor: {..., efficiency_map: my_motor.csv, mirror: true, extrapolate: loss_model}

exit codes: 0 written, 2 bad arguments or files, 130 interrupted
"""


def parser() -> argparse.ArgumentParser:
    """Arguments of the command."""
    result = command.described("import_motor", _DESCRIPTION, _EXAMPLES)
    result.add_argument("table", metavar="TABLE", help="lines that start with # are skipped")
    table = result.add_argument_group("the table")
    table.add_argument("--separator", choices=("auto", *SEPARATORS), default="auto", help="default: %(default)s")
    table.add_argument("--decimal", choices=("auto", "point", "comma"), default="auto", help="default: %(default)s")
    table.add_argument(
        "--layout",
        choices=("auto", "list", "matrix"),
        default="auto",
        help="list: speed, torque, value in each row, below a header (default: %(default)s)",
    )
    table.add_argument(
        "--down",
        choices=("auto", "speed", "torque"),
        default="auto",
        help="what goes down in a matrix (default: what its corner names first, else speed)",
    )
    table.add_argument("--speed-unit", choices=("auto", "rad/s", "rpm"), default="auto", help="default: %(default)s")
    table.add_argument(
        "--percent",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="efficiencies are in percent (default: if most are above 1.5)",
    )
    table.add_argument(
        "--quantity", choices=("efficiency", "loss"), default="efficiency", help="loss: in W (default: %(default)s)"
    )
    table.add_argument(
        "--gear",
        type=given.number(0.05, 50),
        default=1.0,
        metavar="RATIO",
        help="turns of the motor for one of the wheel: makes it a map of the wheel (default: 1; or leave it, and give "
        "the vehicle a `gear`)",
    )
    table.add_argument("--mirror", action="store_true", help="a map of one sign gets the other one, for what is shown")
    reach = result.add_argument_group("what the motor shall do, to see if the map reaches it")
    reach.add_argument("--peak-torque", type=given.number(0, 20e3), metavar="NM")
    reach.add_argument("--regeneration-torque", type=given.number(0, 20e3), metavar="NM")
    reach.add_argument("--max-power", type=given.number(0, 1e6), metavar="W")
    reach.add_argument("--top-speed", type=given.number(0, 20e3), metavar="RAD_S")
    output = result.add_argument_group("output")
    output.add_argument("--output", required=True, type=command.output_file, metavar="CSV", help="the map")
    output.add_argument(
        "--plot", type=command.picture, metavar="PICTURE", help="the map, with points and gaps, as .pdf, .png or .svg"
    )
    output.add_argument(
        "--json", type=command.output_file, metavar="FILE", help="what was understood, with the numbers"
    )
    output.add_argument("--quiet", action="store_true", help="print errors and warnings only")
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = parser().parse_args(arguments)
    options.quiet |= options.json == "-"  # nothing else in what another program is to read
    return command.ended("import_motor", lambda: _import(options))


def _import(options: argparse.Namespace) -> None:
    import numpy as np

    from iwm_power_manager.motor_import import map_text, read_points
    from iwm_power_manager.motor_map import fit_loss, map_of, mirrored, missing
    from iwm_power_manager.share import resolve

    refuse_without_effect(options, {"--percent": (options.quantity == "efficiency", "--quantity loss is in W")})
    points = read_points(
        resolve(options.table),
        layout=options.layout,
        down=options.down,
        separator=options.separator,
        decimal=options.decimal,
        speed_unit=options.speed_unit,
        percent=options.percent,
        quantity=options.quantity,
        gear=options.gear,
    )
    found = map_of(options.table, points.efficiency)
    if options.mirror:
        found = mirrored(options.table, found, True)
    fit = fit_loss(found)
    reach = _reach(options, found)
    lacking = missing(found, reach)
    known = int(np.count_nonzero(~np.isnan(found.loss_w)))
    numbers = {
        "package_version": __version__,
        "table": str(options.table),
        "said": points.said,
        "doubts": points.doubts,
        "speeds_radps": found.speed_radps,
        "torques_nm": found.torque_nm,
        "known_points": known,
        "best_efficiency": _best(points.efficiency),
        "loss_model": dict(zip("abcde", fit.coefficients, strict=True)),
        "loss_model_rms_error": fit.rms_error,
        "loss_model_worst_error": fit.worst_error,
        "lacks": lacking,
        "map": str(options.output),
    }
    command.write_result(options.output, map_text(points).encode())
    if not options.quiet:
        print(_text(options, found, fit, numbers))
    for line in (*points.doubts, *(f"it lacks {line}" for line in lacking)):
        print(f"import_motor: warning: {line}", file=sys.stderr)
    if options.plot:
        _draw(options, found, reach)
    if options.json:
        command.write_json(options.json, numbers)


def _best(efficiency: dict[tuple[float, float], float]) -> dict[str, float]:
    speed, torque = max(efficiency, key=lambda point: efficiency[point] if efficiency[point] > 0.0 else 0.0)
    return {"efficiency": efficiency[speed, torque], "speed_radps": speed, "torque_nm": torque}


def _reach(options: argparse.Namespace, found: MotorMap) -> Reach:
    """What the motor shall do; what is not named is what the map itself has."""
    from iwm_power_manager.motor_map import Reach

    torque = max(float(found.torque_nm[-1]), 0.0)
    braking = max(-float(found.torque_nm[0]), 0.0)
    return Reach(
        peak_torque_nm=torque if options.peak_torque is None else options.peak_torque,
        regeneration_torque_nm=braking if options.regeneration_torque is None else options.regeneration_torque,
        max_power_w=_map_power_w(found) if options.max_power is None else options.max_power,
        top_speed_radps=float(found.speed_radps[-1]) if options.top_speed is None else options.top_speed,
    )


def _map_power_w(found: MotorMap) -> float:
    """Largest power up to which the map has every point."""
    import numpy as np

    power = np.abs(np.outer(found.speed_radps, found.torque_nm))
    holes = power[np.isnan(found.loss_w) & (power > 0.0)]
    known = power[~np.isnan(found.loss_w)]
    return float(min(known.max(), np.nextafter(holes.min(), 0.0) if holes.size else np.inf))


def _text(options: argparse.Namespace, found: MotorMap, fit: LossFit, numbers: dict[str, Any]) -> str:
    best = numbers["best_efficiency"]
    return "\n".join(
        [
            *(f"{options.table}: {line}" for line in numbers["said"]),
            f"{found.speed_radps.size} speeds, {found.speed_radps[0]:g} to {found.speed_radps[-1]:.4g} rad/s; "
            f"{found.torque_nm.size} torques, {found.torque_nm[0]:g} to {found.torque_nm[-1]:.4g} N m; "
            f"{numbers['known_points']} points with a loss",
            f"best efficiency {best['efficiency']:.3f} at {best['speed_radps']:.4g} rad/s, {best['torque_nm']:.4g} N m",
            f"loss model: {fit}; it meets the efficiencies to {fit.rms_error:.3f} rms, {fit.worst_error:.3f} at most",
            f"{options.output}: written",
        ]
    )


def _limits(options: argparse.Namespace) -> str:
    """What the drawn limits are: the motor's, or as far as the table goes."""
    names = ("peak_torque", "regeneration_torque", "max_power", "top_speed")
    of_table = [name.replace("_", " ") for name in names if getattr(options, name) is None]
    return "limits of the motor" if not of_table else f"limits; outermost points of the table: {', '.join(of_table)}"


def _draw(options: argparse.Namespace, found: MotorMap, reach: Reach) -> None:
    import numpy as np
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 6.0), layout="constrained")
    axes = figure.subplots()
    speed, torque = np.meshgrid(found.speed_radps, found.torque_nm, indexing="ij")
    power = speed * torque
    with np.errstate(divide="ignore", invalid="ignore"):
        eta = np.where(power > 0.0, power / (power + found.loss_w), 1.0 + found.loss_w / power)
    shown = np.ma.masked_invalid(np.where(power == 0.0, np.nan, np.clip(eta, 0.0, 1.0)))
    if shown.count() > 3:
        levels = np.linspace(max(float(shown.min()), 0.3), min(float(shown.max()) + 0.01, 1.0), 12)
        if levels[-1] > levels[0]:
            picture = axes.contourf(speed, torque, shown, levels, cmap="viridis", extend="min")
            figure.colorbar(picture, label="efficiency", format="%.2f")
    known = ~np.isnan(found.loss_w)
    axes.plot(speed[known], torque[known], ".", color="black", markersize=2, label="points with a loss")
    line = np.linspace(0.0, max(reach.top_speed_radps, 1e-3), 200)
    axes.plot(line, reach.limit_nm(line, True), color="C3", label=_limits(options))
    axes.plot(line, -reach.limit_nm(line, False), color="C3")
    axes.set_xlabel("speed, rad/s")
    axes.set_ylabel("torque, N m (driving positive)")
    figure.legend(loc="outside lower center", ncols=2)
    command.write_picture(options.plot, figure)


if __name__ == "__main__":
    sys.exit(main())
