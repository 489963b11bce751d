# SPDX-License-Identifier: Apache-2.0
"""Pictures of solved policies: the demand's transition matrix, the convergence or the price, the policy itself."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from iwm_power_manager.files import check_number
from iwm_power_manager.mdp.demand import THIN_ROW_STEPS, DemandChain
from iwm_power_manager.policy import Policy
from iwm_power_manager.tools.command import write_picture


def draw_solution(policies: Sequence[Policy], path: Path | str) -> None:
    """Write a picture: transition matrix and convergence on top, one map of the front share per policy below."""
    columns = max(2, len(policies))
    figure = Figure(figsize=(5.0 * columns, 8.6), layout="constrained")
    grid = figure.add_gridspec(2, columns)
    draw_demand(figure.add_subplot(grid[0, : columns // 2]), policies[0].chain)
    # A solution for a price begins with the one before: what there is to see is the search for the price.
    draw = draw_prices if all(policy.trials for policy in policies) else draw_convergence
    draw(figure.add_subplot(grid[0, columns // 2 :]), policies)
    for column, policy in enumerate(policies):
        draw_share(figure.add_subplot(grid[1, column]), policy)
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


def draw_prices(axes: Axes, policies: Sequence[Policy]) -> None:
    """Changes a minute that each price of a change leaves, tried until the budget is met; the price taken is filled."""
    for i, policy in enumerate(policies):
        colour, taken = f"C{i}", policy.problem.switching_cost_j
        tried = sorted(policy.trials, key=lambda trial: trial.price_j)
        prices, changes = [trial.price_j for trial in tried], [trial.changes_per_min for trial in tried]
        axes.plot(prices, changes, "o-", color=colour, markerfacecolor="white")
        at = [trial.changes_per_min for trial in tried if trial.price_j == taken]
        label = f"friction {policy.friction:g}, certified to {policy.bound_j:.2g} J"
        axes.plot([taken] * len(at), at, "o", color=colour, label=label)
    budgets = sorted({policy.problem.changes_per_min for policy in policies})
    for budget in budgets:
        axes.axhline(budget, color="0.5", linestyle="--", label=f"budget of {budget:g} changes a minute")
    axes.set_xscale("log")
    axes.set(title="Price of a change of the share", xlabel="price, J", ylabel="changes, 1/min")
    axes.legend()


def share_map(
    policy: Policy, previous_share: float = 0.5, slip: float = 0.0
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """The front share over demand and speed, both slips and the previous share at their nearest grid points.

    Returns
    -------
    demand, W, (P,); speed, m/s, (V,); front share (P, V)
    """
    check_number("arguments", "previous_share", previous_share, 0.0, 1.0)
    check_number("arguments", "slip", slip, -1.0, 1.0)
    problem = policy.problem
    wanted = ((problem.slip_front, slip), (problem.slip_rear, slip), (problem.previous_shares, previous_share))
    at = [int(np.argmin(np.abs(axis - value))) for axis, value in wanted]
    return problem.power_w, problem.speed_mps, policy.front_share[:, :, at[0], at[1], at[2]]


def draw_share(axes: Axes, policy: Policy, previous_share: float = 0.5, slip: float = 0.0) -> None:
    """A picture of `share_map`."""
    power_w, speed_mps, share = share_map(policy, previous_share, slip)
    image = axes.pcolormesh(
        speed_mps, power_w / 1000.0, share, cmap="coolwarm", vmin=0.0, vmax=1.0, shading="nearest", rasterized=True
    )
    axes.figure.colorbar(image, ax=axes, label="Front share")
    before = f", previous share {previous_share:g}" if policy.problem.previous_share else ""
    title = f"Grid {policy.problem.name}, friction {policy.friction:g}, idle drive {policy.idle_drive}{before}"
    axes.set_title(title, fontsize="medium")
    axes.set(xlabel="Speed, m/s", ylabel="Power demand, kW")
