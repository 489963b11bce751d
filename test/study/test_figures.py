# SPDX-License-Identifier: Apache-2.0
"""The figure builders: what is drawn is what was given, with units on every axis and the style left as it was."""

import matplotlib as mpl
import numpy as np
import pytest

from iwm_sim.study import figures as f
from iwm_sim.study.cases import Case, Result
from iwm_sim.study.study_figures import WINDOW_S, window_of
from study_fixtures import CHAIN

TIME = np.arange(0.0, 100.0, 0.5)
WAVE = np.sin(TIME)
BOWL = f.Curve("10 m/s", np.linspace(0.0, 10e3, 11), (np.linspace(0.0, 10e3, 11) - 3e3) ** 2)


def built():
    """Every figure of the paper, small."""
    return {
        "fig7": f.model_comparison(TIME, WAVE, WAVE + 0.1, 0.9 - TIME / 1e4, 0.9 - TIME / 1.1e4),
        "fig8": f.depletion_over_split([BOWL, BOWL._replace(label="20 m/s")]),
        "fig10": f.depletion_over_split_panels([("(a) 1 kW", [BOWL]), ("(b) 5 kW", [BOWL])]),
        "fig12": f.policy_convergence([300.0, 20.0, 0.0], [1.0, 1e-3, 1e-9]),
        "fig13": f.fitted_rule(1e3 * WAVE, 600.0 * WAVE, [-1e3, 1e3], [-600.0, 600.0]),
        "fig14": f.axle_powers(TIME, [f.AxleRun("sdp", 1e3 * WAVE, 2e3 * WAVE)]),
        "fig15": f.slips(TIME, [f.AxleRun("with", WAVE, WAVE), f.AxleRun("without", WAVE, WAVE)], 0.2),
        "transitions": f.transition_matrix(CHAIN),
        "frontier": f.switching_frontier({"ours": ([4.0, 6.0], [2.3, 2.45]), "preview": ([0.0, 7.0], [0.0, 2.47])}),
    }


@pytest.fixture(scope="module")
def figures():
    return built()


def test_every_number_axis_is_labelled_with_its_unit(figures):
    unitless = {"Iteration", "Change of shares", "(a) Front slip", "(b) Rear slip", "probability", ""}
    for name, figure in figures.items():
        labels = [axis.get_ylabel() for axis in figure.axes] + [axis.get_xlabel() for axis in figure.axes]
        assert figure.axes[0].get_ylabel(), name
        for label in labels:
            assert label in unitless or ", " in label, f"{name}: {label!r} has no unit"


def test_building_leaves_matplotlibs_own_settings_alone():
    before = dict(mpl.rcParams)
    built()
    assert dict(mpl.rcParams) == before


def test_the_least_depletion_carries_the_dot(figures):
    dot = figures["fig8"].axes[0].lines[2]
    assert list(dot.get_xdata()) == [3.0]


def test_both_of_two_symmetric_optima_are_marked():
    power = np.linspace(0.0, 10.0, 11)
    double = f.Curve("", power, ((power - 2.0) * (power - 8.0)) ** 2)
    dots = f.depletion_over_split([double]).axes[0].lines[2]
    assert len(dots.get_xdata()) == 2


def test_a_split_that_cannot_be_driven_is_a_gap_without_a_dot():
    nothing = f.Curve("", [0.0, 1.0], [np.nan, np.nan])
    assert len(f.depletion_over_split([nothing]).axes[0].lines) == 2


def test_the_ends_where_an_axle_rests_are_rings_and_no_part_of_the_line():
    jumps = f.Curve("", [0.0, 1e-6, 500.0, 999.0, 1000.0], [1.0, 3.0, 2.0, 3.0, 1.0])
    line, rings, dots = f.depletion_over_split([jumps]).axes[0].lines
    assert list(line.get_ydata()) == [3.0, 2.0, 3.0]
    assert list(rings.get_xdata()) == list(dots.get_xdata()) == [0.0, 1.0]


def test_powers_are_drawn_in_kilowatts(figures):
    front, rear = (axis.lines[0] for axis in figures["fig14"].axes)
    assert list(front.get_xdata()) == list(TIME)
    np.testing.assert_allclose(front.get_ydata(), WAVE)
    np.testing.assert_allclose(rear.get_ydata(), 2.0 * WAVE)


def test_the_watched_runs_are_cut_to_the_window_or_shown_whole_where_they_end_before_it():
    def seen(time_s):
        case = Case("nycc", "jalalmaab_2015", "none", 0.9, "equal", keep=("time_s",))
        return window_of([Result(case, None, {"time_s": time_s}), Result(case, None, {})])["equal"]["time_s"]

    first, last = WINDOW_S
    assert list(seen(np.array([0.0, first, last, last + 1.0]))) == [first, last]
    assert list(seen(TIME)) == list(TIME)


def test_the_last_policy_iteration_may_change_nothing(figures):
    line = figures["fig12"].axes[0].lines[0]
    assert line.get_ydata()[-1] == 0.0
    assert figures["fig12"].axes[0].get_yscale() == "symlog"


def test_demand_classes_stand_in_the_middle_of_their_cells(figures):
    edges = figures["transitions"].axes[0].collections[0].get_coordinates()[0, :, 0]
    np.testing.assert_allclose(edges, [-0.5, 0.5, 1.5])


def test_the_frontier_is_zoomed_to_what_matters_and_shows_all_below(figures):
    near, all_of_it = figures["frontier"].axes
    assert near.get_ylim()[0] == pytest.approx(2.22)
    assert near.get_xlim()[0] > 3.0
    assert all_of_it.get_ylim()[0] < 0.0
