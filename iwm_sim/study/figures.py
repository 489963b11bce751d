# SPDX-License-Identifier: Apache-2.0
"""Builders of the paper's figures: arrays in, a matplotlib figure out.

Nothing here computes a result or touches a file. A figure suits the page (`report.Pictures`) and print alike. The style
holds while a figure is built and leaves matplotlib's own settings as they were.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, cast

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike

from iwm_power_manager.mdp.demand import DemandChain
from iwm_power_manager.tools.solver_figures import draw_demand
from iwm_sim.study.palette import COLOURS, INK

#: Narrow enough that its text stays readable when the page scales it to a phone.
WIDTH_IN = 5.2
BLUE, VERMILION, GREEN, PURPLE, OCHRE, SKY, GREY, BLACK = COLOURS

_STYLE: dict[str, Any] = {
    "font.family": "sans-serif",
    "font.size": 10.0,
    "axes.titlesize": 10.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.8,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": COLOURS[6],
    "grid.alpha": 0.25,
    "grid.linewidth": 0.6,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "lines.linewidth": 1.6,
    "legend.frameon": False,
    "legend.fontsize": 9.0,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
}


#: What the zoomed part of the frontier shows, percentage points below the best.
_ZOOM_POINTS = 0.25


class Curve(NamedTuple):
    """Battery depletion over the front axle's power.

    Attributes
    ----------
    label : what it was computed for
    front_power_w : (N,), the first and the last where one axle rests
    delta_soc_percent : (N,) depletion of one step, NaN where the split cannot be driven
    """

    label: str
    front_power_w: ArrayLike
    delta_soc_percent: ArrayLike


class AxleRun(NamedTuple):
    """What both axles did in one run: powers in W, or slips.

    Attributes
    ----------
    label : name of the run
    front, rear : (N,)
    """

    label: str
    front: ArrayLike
    rear: ArrayLike


def _styled[**P](build: Callable[P, Figure]) -> Callable[P, Figure]:
    @functools.wraps(build)
    def styled(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with mpl.rc_context(cast(Any, _STYLE)):
            return build(*args, **kwargs)

    return styled


@_styled
def model_comparison(
    time_s: ArrayLike,
    plant_speed_mps: ArrayLike,
    model_speed_mps: ArrayLike,
    plant_soc: ArrayLike,
    model_soc: ArrayLike,
) -> Figure:
    """Fig. 7: speed and state of charge (0..1) of the plant and of the control-oriented model, all (N,)."""
    figure, (speed, soc) = _axes(2, height_in=4.6)
    speed.plot(time_s, plant_speed_mps, color=BLUE, label="plant")
    speed.plot(time_s, model_speed_mps, color=VERMILION, linestyle="--", label="control model")
    speed.set_ylabel("Speed, m/s")
    soc.plot(time_s, 100.0 * np.asarray(plant_soc), color=BLUE, label="plant")
    soc.plot(time_s, 100.0 * np.asarray(model_soc), color=VERMILION, linestyle="--", label="control model")
    soc.set_ylabel("State of charge, %")
    soc.legend(loc="upper right")
    _time_axis(soc, time_s)
    return figure


def depletion_over_split(curves: Sequence[Curve], title: str = "") -> Figure:
    """Fig. 8 (a curve for each speed) and Fig. 9 (for each slip): depletion of a step over the front axle's power."""
    return depletion_over_split_panels([(title, curves)])


@_styled
def depletion_over_split_panels(panels: Sequence[tuple[str, Sequence[Curve]]]) -> Figure:
    """Fig. 10: the same for several demands, a titled panel each. The least depletion of a curve carries a dot.

    The ends of a curve, where one axle rests, are rings of their own: depletion jumps there.
    """
    figure, axes = _axes(len(panels), height_in=1.2 + 2.2 * len(panels), share_x=False)
    for axis, (title, curves) in zip(axes, panels, strict=True):
        for index, curve in enumerate(curves):
            power_kw = np.asarray(curve.front_power_w, dtype=np.float64) / 1000.0
            depletion = np.asarray(curve.delta_soc_percent, dtype=np.float64)
            axis.plot(power_kw[1:-1], depletion[1:-1], color=COLOURS[index % 6], label=curve.label)
            axis.plot(
                power_kw[[0, -1]], depletion[[0, -1]], "o", markersize=5, color=COLOURS[index % 6], fillstyle="none"
            )
            if np.isfinite(depletion).any():
                # A tie within a billionth is a tie: both of two symmetric optima are marked.
                least = np.nanmin(depletion)
                best = np.flatnonzero(depletion <= least + 1e-9 * abs(least))
                axis.plot(power_kw[best], depletion[best], "o", markersize=5, color=COLOURS[index % 6])
        axis.set_title(title)
        axis.set_ylabel("ΔSoC per step, %")
        # The same kind of number in every panel: no power of ten apart from the axis.
        axis.ticklabel_format(axis="y", style="plain", useOffset=False)
        if len(curves) > 1:
            axis.legend(ncols=min(3, len(curves)))
    axes[-1].set_xlabel("Power of the front axle, kW")
    return figure


@_styled
def policy_convergence(policy_change: ArrayLike, bellman_residual: ArrayLike | None = None) -> Figure:
    """Fig. 12: how policy iteration converges.

    Parameters
    ----------
    policy_change : (K,) norm over all states of the change of the front share in each iteration; zeros are drawn on
        the axis' floor
    bellman_residual : (K,) largest change of the cost-to-go, on an axis of its own; None leaves it out
    """
    change = np.asarray(policy_change, dtype=np.float64)
    iteration = np.arange(1, len(change) + 1)
    figure, axes = _axes(1 if bellman_residual is None else 2, height_in=3.2 if bellman_residual is None else 4.8)
    axes[0].plot(iteration, change, "o-", color=BLUE, markersize=4)
    # Linear below the smallest change: the last iteration changes nothing, and a log axis has no zero.
    positive = change[change > 0.0]
    axes[0].set_yscale("symlog", linthresh=float(positive.min()) if len(positive) else 1.0)
    axes[0].set_ylabel("Change of shares")
    if bellman_residual is not None:
        axes[1].semilogy(iteration, bellman_residual, "s-", color=VERMILION, markersize=4)
        axes[1].set_ylabel("Bellman residual, J")
    axes[-1].set_xlabel("Iteration")
    axes[-1].xaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


@_styled
def fitted_rule(
    power_demand_w: ArrayLike, front_power_w: ArrayLike, rule_demand_w: ArrayLike, rule_front_power_w: ArrayLike
) -> Figure:
    """Fig. 13: what dynamic programming chose, (N,) points, and the rule fitted to it, (M,) points of a line."""
    figure, (axis,) = _axes(1, height_in=3.6)
    demand_kw = np.asarray(power_demand_w, dtype=np.float64) / 1000.0
    axis.plot(
        demand_kw,
        np.asarray(front_power_w) / 1000.0,
        ".",
        markersize=3,
        alpha=0.35,
        color=BLUE,
        label="dynamic programming",
        # Thousands of points as vector would be megabytes.
        rasterized=True,
    )
    axis.plot(
        np.asarray(rule_demand_w) / 1000.0,
        np.asarray(rule_front_power_w) / 1000.0,
        color=VERMILION,
        linewidth=2.0,
        label="fitted rule",
    )
    ends = np.array([demand_kw.min(), demand_kw.max()])
    axis.plot(ends, 0.5 * ends, color=GREY, linestyle=":", label="equal distribution")
    axis.set_xlabel("Power demand, kW")
    axis.set_ylabel("Power of the front axle, kW")
    axis.legend(loc="upper left")
    return figure


@_styled
def axle_powers(time_s: ArrayLike, runs: Sequence[AxleRun]) -> Figure:
    """Fig. 14: front and rear power of strategies."""
    in_kw = [AxleRun(run.label, np.asarray(run.front) / 1000.0, np.asarray(run.rear) / 1000.0) for run in runs]
    figure, axes = _by_axle(time_s, in_kw, 4.6, COLOURS[:6], 1.3)
    axes[0].set_ylabel("Front power, kW")
    axes[1].set_ylabel("Rear power, kW")
    axes[0].legend(ncols=len(runs))
    return figure


@_styled
def slips(time_s: ArrayLike, runs: Sequence[AxleRun], critical_slip: float) -> Figure:
    """Fig. 15: slip of the front (a) and rear (b) axle, with the critical slip marked on both sides."""
    figure, axes = _by_axle(time_s, runs, 4.8, (VERMILION, BLUE, GREEN), 1.2)
    for axis, label in zip(axes, ("(a) Front slip", "(b) Rear slip"), strict=True):
        for level in (-critical_slip, critical_slip):
            axis.axhline(level, color=GREY, linestyle=":", linewidth=1.0)
        axis.set_ylabel(label)
    axes[0].legend(loc="lower left", ncols=len(runs))
    return figure


def _by_axle(
    time_s: ArrayLike, runs: Sequence[AxleRun], height_in: float, colours: Sequence[str], width: float
) -> tuple[Figure, list[Axes]]:
    """Front above rear, a line for each run."""
    figure, axes = _axes(2, height_in=height_in)
    for index, run in enumerate(runs):
        for axis, values in zip(axes, (run.front, run.rear), strict=True):
            axis.plot(time_s, values, color=colours[index % len(colours)], linewidth=width, label=run.label)
    _time_axis(axes[1], time_s)
    return figure, axes


@_styled
def transition_matrix(chain: DemandChain) -> Figure:
    """The demand's transition matrix over its grid of power."""
    figure, (axis,) = _axes(1, height_in=4.3)
    draw_demand(axis, chain)
    axis.set_title("")
    axis.set_aspect("equal")
    axis.grid(visible=False)
    return figure


@_styled
def switching_frontier(families: Mapping[str, tuple[Sequence[float], Sequence[float]]]) -> Figure:
    """Saving over changes of the front share a minute: for each strategy, (changes, saving in %) along its price.

    Above what matters, the last quarter of a point; below everything.
    """
    figure, axes = _axes(2, height_in=5.4, share_x=False)
    best = max((max(saving) for _, saving in families.values()), default=0.0)
    near: list[float] = []
    for index, (name, (changes, saving)) in enumerate(families.items()):
        for axis in axes:
            axis.plot(changes, saving, "os^Dv"[index % 5] + "-", color=COLOURS[index % 6], markersize=4, label=name)
        near += [x for x, y in zip(changes, saving, strict=True) if y > best - _ZOOM_POINTS]
    if near:
        axes[0].set_xlim(min(near) - 0.5, max(near) + 0.5)
        axes[0].set_ylim(best - _ZOOM_POINTS, best + 0.1 * _ZOOM_POINTS)
    for axis in axes:
        axis.set_ylabel("Saving, %")
    axes[1].set_xlabel("Changes of the front share, 1/min")
    axes[0].legend(loc="lower right")
    return figure


def _axes(rows: int, height_in: float, share_x: bool = True) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(WIDTH_IN, height_in), layout="constrained")
    axes = figure.subplots(rows, 1, sharex=share_x, squeeze=False)[:, 0]
    return figure, list(axes)


def _time_axis(axis: Axes, time_s: ArrayLike) -> None:
    axis.set_xlabel("Time, s")
    time = np.asarray(time_s, dtype=np.float64)
    axis.set_xlim(float(time.min()), float(time.max()))
