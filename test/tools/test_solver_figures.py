# SPDX-License-Identifier: Apache-2.0
"""What `solve_policy --plot` draws."""

import dataclasses

import numpy as np
import pytest
from matplotlib.figure import Figure

from iwm_power_manager.policy import load_policy
from iwm_power_manager.share import share_path
from iwm_power_manager.tools import solver_figures
from iwm_sim import api


@pytest.fixture(scope="module")
def policies():
    return [load_policy(share_path(f"policies/jalalmaab_2015_drag_coupled_mu0{mu}.npz")) for mu in (90, 50)]


def drawn(policies, monkeypatch):
    figures = []
    monkeypatch.setattr(solver_figures, "write_picture", lambda _, figure: figures.append(figure))
    solver_figures.draw_solution(policies, "a.png")
    return {axes.get_title(): axes for axes in figures[0].axes}


def test_a_share_map_is_the_same_picture_in_the_tool_and_in_python(policies, monkeypatch):
    policy = policies[0]
    (title,) = (title for title in drawn(policies, monkeypatch) if "friction 0.9" in title)
    ours, theirs = drawn(policies, monkeypatch)[title], api.plot_share(policy).axes[0]
    for name in ("get_xlabel", "get_ylabel", "get_xlim", "get_ylim", "get_title"):
        assert getattr(ours, name)() == getattr(theirs, name)(), name
    assert (theirs.get_xlabel(), theirs.get_ylabel()) == ("Speed, m/s", "Power demand, kW")
    np.testing.assert_array_equal(ours.collections[0].get_array(), theirs.collections[0].get_array())
    assert theirs.get_ylim()[0] < -0.001 * policy.problem.power_w.max()


def test_of_policies_with_a_budget_the_search_for_the_price_is_shown_not_a_single_iteration(policies, monkeypatch):
    panel = drawn(policies, monkeypatch)["Price of a change of the share"]
    lines = [line for line in panel.lines if len(line.get_xdata()) > 2]
    assert [sorted(line.get_xdata()) for line in lines] == [sorted(t.price_j for t in p.trials) for p in policies]
    taken = [float(line.get_xdata()[0]) for line in panel.lines if len(line.get_xdata()) == 1]
    assert taken == [policy.problem.switching_cost_j for policy in policies]


def test_without_a_budget_every_policy_of_the_iteration_has_its_bound(policies, monkeypatch):
    free = [dataclasses.replace(policy, trials=()) for policy in policies]
    panel = drawn(free, monkeypatch)["Policy iteration"]
    assert [len(line.get_xdata()) for line in panel.lines] == [len(policy.iterations) for policy in free]


def test_a_share_beyond_its_range_is_refused(policies):
    with pytest.raises(Exception, match="previous_share: -1 is out of range; allowed: 0 to 1"):
        solver_figures.draw_share(Figure().subplots(), policies[0], previous_share=-1)
