# SPDX-License-Identifier: Apache-2.0
"""The solver's problem the slow way: every transition probability written into one dense matrix."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from iwm_power_manager.mdp.sweep import Model, list_cells


class Raw(NamedTuple):
    """A problem before it is packed.

    demand[G, P, P], cost[P, C, U], lower corner[P, C, U, 3], fraction[P, C, U, 3], gated[P, C]
    """

    discount: float
    demand: np.ndarray
    cell_shape: tuple[int, int, int]
    switching: np.ndarray
    cost: np.ndarray
    corner: np.ndarray
    fraction: np.ndarray
    gated: np.ndarray

    @property
    def tracked(self) -> bool:
        return self.switching.shape[0] > 1


def random_raw(rng, powers, cell_shape, controls, tracked, discount, gated=0.3, infeasible=0.2, scale=100.0) -> Raw:
    """A problem without any physics: it has only the structure the solver relies on."""
    cells = int(np.prod(cell_shape))
    groups = cell_shape[0] if rng.random() < 0.5 else 1
    demand = rng.random((groups, powers, powers)) * (rng.random((groups, powers, powers)) < 0.6)
    demand += 1e-3 * np.eye(powers)
    demand /= demand.sum(axis=2, keepdims=True)
    cost = rng.normal(size=(powers, cells, controls)) * scale
    forbidden = rng.random(cost.shape) < infeasible
    forbidden[..., 0] = False
    cost[forbidden] = np.inf
    corner = np.stack([rng.integers(0, max(n - 1, 1), size=cost.shape) for n in cell_shape], axis=-1)
    fraction = rng.random((*cost.shape, 3))
    # Some next states lie exactly on the grid, at either end of a cell.
    fraction[rng.random(fraction.shape) < 0.1] = 0.0
    fraction[rng.random(fraction.shape) < 0.1] = 1.0
    for axis, n in enumerate(cell_shape):
        if n == 1:
            fraction[..., axis] = 0.0
    switching = np.zeros((1, controls))
    if tracked:
        level = np.linspace(0.0, 1.0, controls)
        switching = 0.5 * scale * np.abs(level[:, None] - level[None, :])
    return Raw(discount, demand, cell_shape, switching, cost, corner, fraction, rng.random((powers, cells)) < gated)


def pack(raw: Raw) -> Model:
    """The solver's compact form, filled entry by entry. A gated state keeps the numbers of control 0."""
    powers, _, controls = raw.cost.shape
    free_start, free_cell = list_cells(~raw.gated)
    gated_start, gated_cell = list_cells(raw.gated)
    strides = (raw.cell_shape[1] * raw.cell_shape[2], raw.cell_shape[2], 1)
    cost = np.empty(free_cell.size * controls)
    corner = np.empty(cost.size, np.int32)
    fraction = np.empty((cost.size, 3))
    gated_cost = np.empty(gated_cell.size)
    gated_corner = np.empty(gated_cell.size, np.int32)
    gated_fraction = np.empty((gated_cell.size, 3))
    for p in range(powers):
        first, last = free_start[p], free_start[p + 1]
        for k in range(last - first):
            for u in range(controls):
                i = first * controls + u * (last - first) + k
                c = free_cell[first + k]
                cost[i] = raw.cost[p, c, u]
                corner[i] = raw.corner[p, c, u] @ strides
                fraction[i] = raw.fraction[p, c, u]
        for i in range(gated_start[p], gated_start[p + 1]):
            c = gated_cell[i]
            gated_cost[i] = raw.cost[p, c, 0]
            gated_corner[i] = raw.corner[p, c, 0] @ strides
            gated_fraction[i] = raw.fraction[p, c, 0]
    return Model(
        raw.discount, raw.demand, raw.cell_shape, raw.switching, free_start, free_cell, cost, corner, fraction,
        gated_start, gated_cell, gated_cost, gated_corner, gated_fraction,
    )  # fmt: skip


def dense(raw: Raw) -> tuple[np.ndarray, np.ndarray]:
    """Cost[X, U] (infinite where there is no such action) and probability[X, U, X] over states x = (p, s, c)."""
    powers, cells, controls = raw.cost.shape
    shares = raw.switching.shape[0]
    states = powers * shares * cells

    def index(p, s, c):
        return (p * shares + s) * cells + c

    cost = np.full((states, controls), np.inf)
    probability = np.zeros((states, controls, states))
    for p, s, c in itertools.product(range(powers), range(shares), range(cells)):
        x = index(p, s, c)
        gated = raw.gated[p, c]
        for u in [0] if gated else range(controls):
            cost[x, u] = raw.cost[p, c, u] + (0.0 if gated else raw.switching[s, u])
            next_share = s if gated or not raw.tracked else u
            for offsets in itertools.product((0, 1), repeat=3):
                weight = 1.0
                place = []
                for axis, offset in enumerate(offsets):
                    f = raw.fraction[p, c, u, axis]
                    weight *= f if offset else 1.0 - f
                    place.append(min(raw.corner[p, c, u, axis] + offset, raw.cell_shape[axis] - 1))
                next_cell = np.ravel_multi_index(place, raw.cell_shape)
                for q in range(powers):
                    group = place[0] if raw.demand.shape[0] > 1 else 0
                    probability[x, u, index(q, next_share, next_cell)] += weight * raw.demand[group, p, q]
    return cost, probability


def policy_iteration(cost: np.ndarray, probability: np.ndarray, discount: float) -> tuple[np.ndarray, np.ndarray]:
    """Howard's policy iteration with an exact linear solve: optimal cost-to-go and a policy."""
    states = cost.shape[0]
    rows = np.arange(states)
    policy = np.argmin(cost, axis=1)
    while True:
        value = np.linalg.solve(np.eye(states) - discount * probability[rows, policy], cost[rows, policy])
        action_value = cost + discount * probability @ value
        best = np.argmin(action_value, axis=1)
        better = action_value[rows, best] < action_value[rows, policy] - 1e-9
        if not better.any():
            return value, policy
        policy = np.where(better, best, policy)
