# SPDX-License-Identifier: Apache-2.0
"""A drive as a moving picture (GIF): the car from above with the torque of each wheel, the split, speed over time."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch, Rectangle
from PIL import Image

from iwm_power_manager import files
from iwm_power_manager.errors import ConfigError
from iwm_sim.closed_loop import Run
from iwm_sim.study.palette import COLOURS, INK

BLUE, VERMILION, GREEN, _, OCHRE, _, GREY, _ = COLOURS
#: Frames a second of the picture, and how much faster than the drive it goes.
FRAMES_PER_S, TIMES_FASTER = 10, 3.0
#: What is shown of a drive, at most, s.
LONGEST_S = 80.0

_SIZE_IN, _DPI, _PALETTE = (8.0, 4.0), 84, 48
#: Wheels in the picture, m from the middle of the car, x to its right and y ahead; order front left to rear right.
_WHEELS = ((-0.8, 1.3), (0.8, 1.3), (-0.8, -1.3), (0.8, -1.3))
_BAR_M = 1.8
#: Step of the applied share that counts as a part of a change.
_CHANGE = 0.05
_ROAD_PERIOD_M = 6.0


class _Scene(NamedTuple):
    """What changes from frame to frame."""

    figure: Figure
    dashes: list[Rectangle]
    motors: list[Rectangle]
    brakes: list[Rectangle]
    torques: list[Any]
    share: Rectangle
    words: Any
    cursors: list[Any]
    largest_nm: float


def animate(run: Run, path: Path, title: str) -> None:
    """Write a drive as a GIF: its part in which the split changes most often.

    Parameters
    ----------
    run : the drive
    path : file to write, .gif
    title : what is driven

    Raises
    ------
    ConfigError
        The file is no .gif, or cannot be written.
    """
    if path.suffix != ".gif":
        raise ConfigError(path, "", "cannot hold a moving picture", "a file that ends with .gif")
    part_s = _liveliest(run)
    steps = np.searchsorted(run["time_s"], np.arange(*part_s, TIMES_FASTER / FRAMES_PER_S))
    scene = _scene(run, title, part_s)
    frames = [_frame(scene, run, int(at)) for at in steps]
    # One palette for all: what does not move is the same bytes in every frame, and is stored once. It is that of the
    # frame with most regeneration, whose green no other colour has.
    palette = frames[int(np.argmin(run["front_motor_nm"][steps]))].quantize(_PALETTE, dither=Image.Dither.NONE)
    first, *others = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    stored = io.BytesIO()
    first.save(stored, "GIF", save_all=True, append_images=others, duration=1000 // FRAMES_PER_S, loop=0)
    files.atomic_write(path, stored.getvalue())


def _frame(scene: _Scene, run: Run, at: int) -> Image.Image:
    _show(scene, run, at)
    drawn = io.BytesIO()
    scene.figure.savefig(drawn, format="rgba", dpi=_DPI)
    width, height = (int(_DPI * inches) for inches in _SIZE_IN)
    return Image.frombytes("RGBA", (width, height), drawn.getvalue()).convert("RGB")


def _liveliest(run: Run) -> tuple[float, float]:
    """The part of a drive with the most changes of the split, as its first and last second."""
    time_s = run["time_s"]
    changed_s = time_s[1:][np.abs(np.diff(run["front_share"])) > _CHANGE]
    starts = np.arange(time_s[0], max(time_s[0], time_s[-1] - LONGEST_S) + 1.0, 5.0)
    counts = [np.count_nonzero((changed_s >= start) & (changed_s < start + LONGEST_S)) for start in starts]
    first = float(starts[int(np.argmax(counts))])
    return first, min(first + LONGEST_S, float(time_s[-1]))


def _scene(run: Run, title: str, part_s: tuple[float, float]) -> _Scene:
    figure = Figure(figsize=_SIZE_IN)
    figure.suptitle(title, x=0.02, y=0.975, ha="left", fontsize=10.5, color=INK)
    road = figure.add_axes((0.0, 0.0, 0.38, 0.93))
    road.set(xlim=(-2.6, 2.6), ylim=(-3.25, 3.05), aspect="equal")
    road.axis("off")
    dashes, motors, brakes, torques = _car(road)
    words = figure.text(0.44, 0.90, "", fontsize=10, color=INK, family="monospace", va="center")
    cursors = _charts(figure, run, part_s)
    share = _share_bar(road)
    largest_nm = max(1.0, float(np.abs([run["front_motor_nm"], run["rear_motor_nm"]]).max()))
    return _Scene(figure, dashes, motors, brakes, torques, share, words, cursors, largest_nm)


def _charts(figure: Figure, run: Run, part_s: tuple[float, float]) -> list[Any]:
    """Speed, split and torques over time; returns the lines that stand at the time shown."""
    shown = (run["time_s"] >= part_s[0]) & (run["time_s"] <= part_s[1])
    time_s = run["time_s"][shown]
    lines = {
        "km/h": [("cycle", GREY, 3.6 * run["trace_mps"]), ("car", BLUE, 3.6 * run["speed_mps"])],
        "front, %": [("", OCHRE, 100.0 * run["front_share"])],
        "N m each": [("front motors", BLUE, run["front_motor_nm"]), ("rear motors", VERMILION, run["rear_motor_nm"])],
    }
    cursors = []
    places = ((0.595, 0.20), (0.43, 0.105), (0.115, 0.25))
    for (unit, series), (bottom, height) in zip(lines.items(), places, strict=True):
        axes = figure.add_axes((0.47, bottom, 0.51, height))
        for label, colour, values in series:
            axes.plot(time_s, values[shown], color=colour, lw=1.2, label=label)
        axes.set_ylabel(unit, fontsize=8.5)
        axes.yaxis.set_label_coords(-0.105, 0.5)
        axes.set_xlim(*part_s)
        axes.tick_params(labelsize=8, labelbottom=unit == "N m each")
        axes.spines[["top", "right"]].set_visible(False)
        if len(series) > 1:
            axes.legend(loc="lower left", bbox_to_anchor=(0, 0.97), fontsize=8, frameon=False, ncols=2, borderaxespad=0)
        axes.margins(y=0.12)
        cursors.append(axes.axvline(part_s[0], color=INK, lw=0.9))
    axes.set_xlabel("s", fontsize=8.5, labelpad=0)
    return cursors


def _car(road: Axes) -> tuple[list[Rectangle], list[Rectangle], list[Rectangle], list[Any]]:
    """Draw road and car; returns what moves: the road's dashes, bars of motors and brakes, their numbers."""
    road.add_patch(Rectangle((-2.6, -3.3), 5.2, 6.6, color="#eef0f2", zorder=0))
    dashes = [Rectangle((x, 0.0), 0.07, 2.4, color="white", zorder=1) for x in (-2.45, 2.38) for _ in range(3)]
    for dash in dashes:
        road.add_patch(dash)
    body = FancyBboxPatch(
        (-0.62, -2.0), 1.24, 3.9, boxstyle="round,pad=0.12,rounding_size=0.45", fc="white", ec=INK, lw=1.2, zorder=3
    )
    road.add_patch(body)
    road.add_patch(Rectangle((-0.48, 0.35), 0.96, 0.45, fc="#cfd5db", ec="none", zorder=4))
    motors, brakes, torques = [], [], []
    for x, y in _WHEELS:
        side = -1 if x < 0 else 1
        road.add_patch(Rectangle((x - 0.14, y - 0.4), 0.28, 0.8, color=INK, zorder=5))
        road.plot([x + side * 0.3] * 2, [y - _BAR_M / 2, y + _BAR_M / 2], color=GREY, lw=0.6, zorder=2)
        motors.append(Rectangle((x + side * 0.42 - 0.12, y), 0.24, 0.0, zorder=5))
        brakes.append(Rectangle((x + side * 0.74 - 0.12, y), 0.24, 0.0, color=GREY, zorder=5))
        torques.append(road.text(x + side * 0.6, y - 1.12, "", ha="center", fontsize=8.5, color=INK, zorder=6))
        for bar in (motors[-1], brakes[-1]):
            road.add_patch(bar)
    road.text(0, -3.12, "driving", color=BLUE, fontsize=8.5, ha="right", va="center")
    road.text(0.12, -3.12, "regenerating", color=GREEN, fontsize=8.5, ha="left", va="center")
    return dashes, motors, brakes, torques


def _share_bar(road: Axes) -> Rectangle:
    """The split as a bar along the car: what is filled goes to the front."""
    road.add_patch(Rectangle((-0.11, -1.75), 0.22, 1.75, fc="#f2d3bf", ec=INK, lw=0.8, zorder=5))
    share = Rectangle((-0.11, -1.75), 0.22, 0.0, fc=BLUE, ec="none", zorder=6)
    road.add_patch(share)
    return share


def _show(scene: _Scene, run: Run, at: int) -> None:
    """Move everything to a step of the drive."""
    offset = run["distance_m"][at] % _ROAD_PERIOD_M
    for number, dash in enumerate(scene.dashes):
        dash.set_y(-4.6 - offset + (number % 3) * _ROAD_PERIOD_M / 2 + _ROAD_PERIOD_M / 2)
    for wheel in range(4):
        axle = "front" if wheel < 2 else "rear"
        motor, friction = run[f"{axle}_motor_nm"][at], run[f"{axle}_friction_nm"][at]
        scene.motors[wheel].set_height(_BAR_M / 2 * motor / scene.largest_nm)
        scene.motors[wheel].set_color(BLUE if motor >= 0.0 else GREEN)
        scene.brakes[wheel].set_height(-_BAR_M / 2 * min(1.0, abs(friction) / scene.largest_nm))
        scene.torques[wheel].set_text(f"{motor + 0.0:.0f} N m")
    share = float(run["front_share"][at])
    scene.share.set_height(1.75 * share)
    scene.words.set_text(
        f"{3.6 * run['speed_mps'][at]:3.0f} km/h   {run['power_demand_w'][at] / 1000.0:+5.1f} kW   "
        f"front {100.0 * share:3.0f} %"
    )
    for cursor in scene.cursors:
        cursor.set_xdata([run["time_s"][at]] * 2)
