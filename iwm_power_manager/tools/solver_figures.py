# SPDX-License-Identifier: Apache-2.0
"""Picture of solved policies: the demand's transition matrix, the convergence, and the policy itself."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from iwm_power_manager.mdp.demand import THIN_ROW_STEPS, DemandChain
from iwm_power_manager.policy import Policy
from iwm_power_manager.tools.command import write_picture


def draw_solution(policies: Sequence[Policy], path: Path | str) -> None:
    """Write a PNG: transition matrix and convergence on top, one map of the front share per policy below."""
    columns = max(2, len(policies))
    figure = Figure(figsize=(5.0 * columns, 8.6), layout="constrained")
    grid = figure.add_gridspec(2, columns)
    draw_demand(figure.add_subplot(grid[0, : columns // 2]), policies[0].chain)
    draw_convergence(figure.add_subplot(grid[0, columns // 2 :]), policies)
    for column, policy in enumerate(policies):
        draw_policy(figure.add_subplot(grid[1, column]), policy)
    write_picture(path, figure)


def draw_demand(axes: Axes, chain: DemandChain) -> None:
    """Transition matrix of the power demand on a logarithmic scale; rows with little data are marked."""
    power = chain.power_w / 1000.0
    image = axes.pcolormesh(
        power,
        power,
        np.ma.masked_less_equal(chain.probability, 0.0),
        norm=LogNorm(1e-4, 1.0),
        shading="nearest",
        cmap="cividis",
        # Thousands of cells as vector would be megabytes.
        rasterized=True,
    )
    axes.figure.colorbar(image, ax=axes, label="probability")
    for rows, marker, label in (
        (chain.row_steps == 0.0, "x", "no data"),
        ((chain.row_steps > 0.0) & (chain.row_steps < THIN_ROW_STEPS), "_", f"fewer than {THIN_ROW_STEPS:g} steps"),
    ):
        if rows.any():
            axes.plot(np.full(rows.sum(), power[0]), power[rows], marker, color="tab:red", label=label, clip_on=False)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="lower right")
    axes.set(title="Power demand: one step", xlabel="next demand, kW", ylabel="demand, kW")


def draw_convergence(axes: Axes, policies: Sequence[Policy]) -> None:
    """Norm of the policy's change (the paper's Fig. 12) and the certified bound over the iterations."""
    right = axes.twinx()
    for i, policy in enumerate(policies):
        numbers = [iteration.number for iteration in policy.iterations]
        colour = f"C{i}"
        changes = [iteration.policy_change for iteration in policy.iterations]
        bounds = [iteration.bound_j for iteration in policy.iterations]
        axes.plot(numbers, changes, "o-", color=colour, label=f"friction {policy.friction:g}")
        right.plot(numbers, bounds, "--", color=colour)
    right.set_yscale("log")
    right.set_ylabel("certified bound, J (dashed)")
    axes.set(title="Policy iteration", xlabel="policy", ylabel="norm of the change of the front share")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.legend()


def draw_policy(axes: Axes, policy: Policy) -> None:
    """Front share over demand and speed, at no slip and coming from equal split."""
    problem = policy.problem

    def nearest(axis: NDArray[np.float64], value: float) -> int:
        return int(np.argmin(np.abs(axis - value)))

    front, rear = nearest(problem.slip_front, 0.0), nearest(problem.slip_rear, 0.0)
    previous = nearest(problem.previous_shares, 0.5)
    share = policy.front_share[:, :, front, rear, previous]
    image = axes.pcolormesh(
        problem.power_w / 1000.0, problem.speed_mps, share.T, vmin=0.0, vmax=1.0, shading="nearest", cmap="coolwarm"
    )
    axes.figure.colorbar(image, ax=axes, label="front share")
    axes.set(
        title=f"Front share, friction {policy.friction:g}, idle_drive {policy.idle_drive}",
        xlabel="demand, kW",
        ylabel="speed, m/s",
    )
