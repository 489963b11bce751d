# SPDX-License-Identifier: Apache-2.0
"""A certificate that does not trust the solver: the Bellman residual of a solution.

T contracts by gamma, so any cost-to-go, however it was found, is within max |T J - J| / (1 - gamma) of the optimal one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from iwm_power_manager.mdp.sweep import Model, expect_over_demand, improve


def bellman_residual_j(model: Model, cost_j: NDArray[np.float64]) -> float:
    """Max norm of T J - J, J. Over 1 - gamma it is a bound on the distance of J from the optimal cost-to-go.

    Parameters
    ----------
    model : the discretised problem
    cost_j : float64[P, S, C]
    """
    rows = cost_j.shape[0]
    ahead = np.empty_like(cost_j)
    flat = np.ascontiguousarray(cost_j).reshape(rows, -1)
    plane = model.cell_shape[1] * model.cell_shape[2]
    expect_over_demand(model.demand, flat, cost_j.shape[2], plane, 0, flat.shape[1], ahead.reshape(rows, -1))
    improved = np.empty_like(cost_j)
    improve(model, ahead, 0, rows, improved, np.empty(cost_j.shape, dtype=np.int16))
    return float(np.max(np.abs(improved - cost_j)))


def bellman_bound(model: Model, cost_j: NDArray[np.float64]) -> float:
    """Certified max-norm distance of a cost-to-go float64[P, S, C] from the optimal one, J."""
    return bellman_residual_j(model, cost_j) / (1.0 - model.discount)
