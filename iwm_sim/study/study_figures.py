# SPDX-License-Identifier: Apache-2.0
"""The figures of a study, with what they need beyond its numbers."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure

from iwm_power_manager.mdp.demand import DemandChain
from iwm_power_manager.model.parameters import VehicleParams
from iwm_power_manager.policy import Policy
from iwm_power_manager.tools.command import made_with
from iwm_sim.metrics import CRITICAL_SLIP
from iwm_sim.study import battery_fit, figures, sensitivity
from iwm_sim.study.cases import Result, Rule
from iwm_sim.study.frontier import OURS as STRATEGY
from iwm_sim.study.frontier import RIVAL, Frontier
from iwm_sim.study.labels import ED, GATE_OFF, OURS
from iwm_sim.study.study_tables import BATTERY, FRONTIER, PROGRAM, SENSITIVITY, TABLE_6, TABLES

FloatArray = npt.NDArray[np.float64]

#: Of all figures, and of the paper's eq. 23.
_IDLE = "idle drive none"
_DRIVEN = made_with("0.2", "none", 100.0)
#: Families of the frontier by strategy.
_FAMILIES = {
    RIVAL: f"{RIVAL}, thresholds",
    "instantaneous": "instantaneous",
    STRATEGY: "ours, budgets",
    "preview": "known in advance",
}
#: When Figures 14 and 15 look.
WINDOW_S = (345.0, 430.0)


class Material(NamedTuple):
    """What the figures need beyond the study's JSON.

    Attributes
    ----------
    battery, rule : fitted
    convergence : change of the policy and Bellman residual in each iteration
    window : series of the watched runs, by label
    chain : of the demand
    """

    battery: battery_fit.Fit
    rule: Rule
    convergence: tuple[FloatArray, FloatArray]
    window: dict[str, dict[str, FloatArray]]
    chain: DemandChain


class Drawn(NamedTuple):
    """A figure with the name of its file, and the section of the study it belongs to."""

    file: str
    title: str
    note: str
    figure: Figure
    section: str = ""

    @property
    def command(self) -> str:
        """What draws it alone."""
        number = re.match(r"figure_0?(\d+)", self.file)
        name = number[1] if number else {"transition_matrix": "transitions"}.get(self.file, self.file)
        return f"evaluate --figure {name} --plot {self.file}.pdf"

    def data(self) -> list[dict[str, Any]]:
        """What is drawn, as numbers: a mapping for each panel with its axes, curves and, of a map, its values.

        The values of a map lie between the edges `x` and `y`, a row for each step of `y`.
        """
        panels: list[dict[str, Any]] = []
        shown = [axes for axes in self.figure.axes if axes.get_label() != "<colorbar>"]
        for i, axes in enumerate(shown):
            maps = []
            for mesh in axes.collections:
                if isinstance(mesh, QuadMesh):
                    edges = np.asarray(mesh.get_coordinates())
                    maps.append({"x": edges[0, :, 0], "y": edges[:, 0, 1], "values": mesh.get_array()})
            curves = []
            for line in axes.lines:
                label = str(line.get_label())
                x, y = map(np.asarray, line.get_data())
                curves.append({"label": "" if label.startswith("_") else label, "x": x, "y": y})
            panels.append(
                {
                    "title": axes.get_title("left") or axes.get_title(),
                    "x": next(filter(None, (below.get_xlabel() for below in shown[i:])), ""),  # of the lowest, for all
                    "y": axes.get_ylabel(),
                    "curves": curves,
                    "maps": maps,
                }
            )
        return panels

    def captioned(self) -> Figure:
        """The figure with title and note above it, for where no page says them."""
        text = f"{self.title}\n{textwrap.fill(self.note, 88, break_on_hyphens=False)}"
        self.figure.suptitle(text, x=0.01, horizontalalignment="left", fontsize=8.0)
        return self.figure


def drawn(frontier: Frontier, material: Material, vehicle: VehicleParams) -> list[Drawn]:
    """All figures of a study."""
    return [
        battery_figure(material.battery),
        *depletion_figures(vehicle),
        *solver_figures(material.convergence, material.chain),
        rule_figure(material.rule),
        *window_figures(material.window),
        frontier_figure(frontier),
    ]


def battery_figure(fit: battery_fit.Fit) -> Drawn:
    """Figure 7."""
    return Drawn(
        "figure_07_battery",
        "Figure 7: plant and control model",
        f"Speed and state of charge, equal split, idle drive {fit.idle_drive}, control at 100 Hz; the control model "
        "has a static circuit, fitted.",
        figures.model_comparison(*fit.comparison),
        BATTERY,
    )


def depletion_figures(vehicle: VehicleParams) -> list[Drawn]:
    """Figures 8 to 10."""
    return [
        Drawn(
            "figure_08_speed",
            "Figure 8: depletion over the split, by speed",
            f"Demand {sensitivity.FIG_8_DEMAND_W / 1000:g} kW, both slips 0.01, {_IDLE}.",
            figures.depletion_over_split(sensitivity.figure_8(vehicle)),
            SENSITIVITY,
        ),
        Drawn(
            "figure_09_slip",
            "Figure 9: depletion over the split, by front slip",
            f"{sensitivity.FIG_9_SPEED_MPS:g} m/s, demand {sensitivity.FIG_9_DEMAND_W / 1000:g} kW at the wheels, rear "
            f"slip 0.01, {_IDLE}.",
            figures.depletion_over_split(sensitivity.figure_9(vehicle)),
            SENSITIVITY,
        ),
        Drawn(
            "figure_10_demand",
            "Figure 10: depletion over the split, by demand",
            f"{sensitivity.FIG_10_SPEED_MPS:g} m/s, both slips 0.01, {_IDLE}.",
            figures.depletion_over_split_panels(sensitivity.figure_10(vehicle)),
            SENSITIVITY,
        ),
    ]


def solver_figures(convergence: tuple[FloatArray, FloatArray], chain: DemandChain) -> list[Drawn]:
    """Figure 12, and the chain it was solved with."""
    return [
        Drawn(
            "figure_12_convergence",
            "Figure 12: policy iteration",
            f"The paper's problem, friction 0.9, {_IDLE}: change of the policy in each iteration, and the Bellman "
            "residual, which bounds the distance from the optimal cost-to-go.",
            figures.policy_convergence(*convergence),
            PROGRAM,
        ),
        Drawn(
            "transition_matrix",
            "Demand as a Markov chain",
            "Transition matrix of the paper's problem, a step of 0.1 s, from FTP-75, HWFET and NYCC.",
            figures.transition_matrix(chain),
            PROGRAM,
        ),
    ]


def rule_figure(rule: Rule) -> Drawn:
    """Figure 13."""
    demand = rule.power_demand_w
    line_w = np.linspace(demand.min(), demand.max(), 400)
    return Drawn(
        "figure_13_rule",
        "Figure 13: the generalized rule",
        f"Dynamic programming on FTP-75, {made_with('0.9', 'none', 100.0)}, and the line fitted to it.",
        figures.fitted_rule(demand, rule.front_share * demand, line_w, _rule_power(rule.coefficients, line_w)),
        TABLES,
    )


def window_figures(window: dict[str, dict[str, FloatArray]]) -> list[Drawn]:
    """Figures 14 and 15."""
    ed, ours, without = window[ED], window[OURS], window[GATE_OFF]
    time_s = ed["time_s"]
    powers = [
        figures.AxleRun(name, run["front_power_w"], run["rear_power_w"]) for name, run in (("ED", ed), ("ours", ours))
    ]
    slips = [
        figures.AxleRun(name, run["front_slip"], run["rear_slip"])
        for name, run in (("without", without), ("ours", ours))
    ]
    return [
        Drawn(
            "figure_14_powers",
            "Figure 14: powers of the axles",
            f"UDDS, {_DRIVEN}; ours decides every 0.02 s.",
            figures.axle_powers(time_s, powers),
            TABLE_6,
        ),
        Drawn(
            "figure_15_slips",
            "Figure 15: slips with and without skid avoidance",
            f"UDDS, {_DRIVEN}: the paper's SDP without skid avoidance, decided every 0.1 s, and ours, every 0.02 s.",
            figures.slips(time_s, slips, CRITICAL_SLIP),
            TABLE_6,
        ),
    ]


def frontier_figure(frontier: Frontier) -> Drawn:
    """Saving over changes of the share."""
    families: dict[str, tuple[list[float], list[float]]] = {}
    for point in sorted(frontier.points, key=lambda point: point.changes_per_min):
        if point.held and point.saving_percent is not None:
            changes, saving = families.setdefault(_FAMILIES[point.strategy], ([], []))
            changes.append(point.changes_per_min)
            saving.append(point.saving_percent)
    return Drawn(
        "frontier",
        "What a change of the share is worth",
        f"{frontier.label}, {frontier.made_with}: saving over changes of the share by more than 0.25.",
        figures.switching_frontier({name: families[name] for name in _FAMILIES.values() if name in families}),
        FRONTIER,
    )


def _rule_power(rule: Sequence[float], demand_w: FloatArray) -> FloatArray:
    """Front power of the rule, as the law applies it (the share stays within 0..1)."""
    line = np.where(demand_w > 0.0, rule[0] + rule[1] * demand_w, rule[2] + rule[3] * demand_w)
    return np.clip(line, np.minimum(demand_w, 0.0), np.maximum(demand_w, 0.0))


def convergence_of(policy: Policy) -> tuple[FloatArray, FloatArray]:
    """Change of the policy, and the Bellman residual (half its span), in each iteration."""
    change = np.array([iteration.policy_change for iteration in policy.iterations])
    bound = np.array([iteration.bound_j for iteration in policy.iterations])
    discount = policy.problem.discount
    return change, bound * (1.0 - discount) / discount


def window_of(results: Sequence[Result]) -> dict[str, dict[str, FloatArray]]:
    """Series of the watched runs, by label, inside the window (or all of it, where the cycle is shorter)."""
    made = {}
    for result in results:
        if result.series:
            time_s = result.series["time_s"]
            inside = (time_s >= WINDOW_S[0]) & (time_s <= WINDOW_S[1])
            keep = inside if inside.any() else np.ones(time_s.size, dtype=bool)
            made[result.case.name] = {name: values[keep] for name, values in result.series.items()}
    return made
