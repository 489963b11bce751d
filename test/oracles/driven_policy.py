# SPDX-License-Identifier: Apache-2.0
"""A policy driven: next demands and grid points drawn at random, and what its controls really cost added up.

The mean has to meet the cost-to-go within its statistical error.
"""

from __future__ import annotations

import numpy as np

from iwm_power_manager.jit import kernel
from iwm_power_manager.mdp.sweep import corner_steps


@kernel
def _draw(weights, x):
    total = 0.0
    for i in range(weights.size - 1):
        total += weights[i]
        if x < total:
            return i
    return weights.size - 1


@kernel
def _simulate(model, policy, power, share, cell, steps, random, totals):
    n_u = model.switching_j.shape[1]
    tracked = model.switching_j.shape[0] > 1
    neighbour = corner_steps(model.cell_shape)
    for run in range(totals.size):
        p, s, c = power, share, cell
        factor = 1.0
        total = 0.0
        for _ in range(steps):
            u = policy[p, s, c]
            if u >= 0:
                first = model.free_start[p]
                n = model.free_start[p + 1] - first
                k = np.searchsorted(model.free_cell[first : first + n], c)
                i = first * n_u + u * n + k
                total += factor * (model.free_cost[i] + model.switching_j[s, u])
                c = model.free_corner[i]
                fraction = model.free_fraction[i]
                if tracked:
                    s = u
            else:
                first = model.gated_start[p]
                i = first + np.searchsorted(model.gated_cell[first : model.gated_start[p + 1]], c)
                total += factor * model.gated_cost[i]
                c = model.gated_corner[i]
                fraction = model.gated_fraction[i]
            # A weight of the interpolation is the probability of that corner.
            for axis in range(3):
                if random.random() < fraction[axis]:
                    c += neighbour[axis]
            group = c // (model.cell_shape[1] * model.cell_shape[2]) if model.demand.shape[0] > 1 else 0
            p = _draw(model.demand[group, p], random.random())
            factor *= model.discount
        totals[run] = total


def simulated_cost(model, policy, state, steps, runs, seed=0):
    """Mean discounted cost of driving a policy from a state, and its standard error, J.

    Parameters
    ----------
    policy : int16[P, S, C], as in `Solution`
    state : indices (power demand, previous share, cell)
    steps : length of a run; discount**steps should be negligible
    runs : number of runs, 2 or more
    """
    totals = np.empty(runs)
    _simulate(model, policy, *state, steps, np.random.default_rng(seed), totals)
    return float(np.mean(totals)), float(np.std(totals, ddof=1) / np.sqrt(runs))
