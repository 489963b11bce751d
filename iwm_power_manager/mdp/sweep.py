# SPDX-License-Identifier: Apache-2.0
"""The discretised problem, and what is done with it in one sweep: the Bellman operator, a policy's, and its flow.

Every sum runs in a fixed order, whatever the number of threads: the same inputs give the same bits.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iwm_power_manager.jit import kernel, parallel_kernel

#: Actions whose values differ by less than this, J, are equally good: rounding must not choose between them.
TIE_J = 1e-6
#: Policy entry of a state where skid avoidance leaves no choice.
GATED = -1

_BLOCK = 1024


class Model(NamedTuple):
    """The discretised problem, stored by power demand p: all pairs of p lie together, control by control.

    With n = free_start[p + 1] - free_start[p], pair (p, k-th free cell, u) stands at free_start[p] * n_u + u * n + k.

    Attributes
    ----------
    discount : gamma
    demand : float64[G, P, P], transition matrix of the power demand, rows sum to 1: one for all speeds (G = 1), or one
        for each point of the speed axis, by the speed the step ends at
    cell_shape : points over (speed, slip front, slip rear); a cell's index is in C order
    switching_j : float64[S, U], cost of share s -> u; S = 1 where the previous share is no state
    free_start : int64[P + 1], first free cell of each power demand
    free_cell : int32[N], cell of each state with a choice
    free_cost : float64[N * U], J; infinite where the control is infeasible
    free_corner : int32[N * U], lower corner of the next cell
    free_fraction : float64[N * U, 3], place inside it, 0..1, over (speed, slip front, slip rear)
    gated_start, gated_cell, gated_cost, gated_corner, gated_fraction : the same for states with a single action
    """

    discount: float
    demand: NDArray[np.float64]
    cell_shape: tuple[int, int, int]
    switching_j: NDArray[np.float64]
    free_start: NDArray[np.int64]
    free_cell: NDArray[np.int32]
    free_cost: NDArray[np.float64]
    free_corner: NDArray[np.int32]
    free_fraction: NDArray[np.float64]
    gated_start: NDArray[np.int64]
    gated_cell: NDArray[np.int32]
    gated_cost: NDArray[np.float64]
    gated_corner: NDArray[np.int32]
    gated_fraction: NDArray[np.float64]

    @property
    def state_shape(self) -> tuple[int, int, int]:
        """Number of (power demands, previous shares, cells)."""
        return self.demand.shape[1], self.switching_j.shape[0], int(np.prod(self.cell_shape))


def list_cells(mask: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Start and cell list (see `Model`) of the states chosen by mask[P, C]."""
    start = np.zeros(mask.shape[0] + 1, dtype=np.int64)
    start[1:] = np.cumsum(mask.sum(axis=1))
    return start, np.nonzero(mask)[1].astype(np.int32)


@kernel
def corner_steps(cell_shape):
    """Index steps from a cell's lower corner to its neighbours; 0 along an axis of a single point."""
    n_v, n_f, n_r = cell_shape
    return (n_f * n_r if n_v > 1 else 0, n_r if n_f > 1 else 0, 1 if n_r > 1 else 0)


@kernel
def _interpolate(w, corner, step_v, step_f, step_r, a, b, c):
    if step_f == 0 and step_r == 0:
        return (1.0 - a) * w[corner] + a * w[corner + step_v]
    low = (1.0 - b) * ((1.0 - c) * w[corner] + c * w[corner + step_r]) + b * (
        (1.0 - c) * w[corner + step_f] + c * w[corner + step_f + step_r]
    )
    corner += step_v
    high = (1.0 - b) * ((1.0 - c) * w[corner] + c * w[corner + step_r]) + b * (
        (1.0 - c) * w[corner + step_f] + c * w[corner + step_f + step_r]
    )
    return (1.0 - a) * low + a * high


@parallel_kernel
def expect_over_demand(demand, cost, period, plane, first_column, last_column, out):
    """Compute out = demand @ cost in a range of columns; arrays [P, n]. Each sum runs in the order of the rows.

    Where demand[G, P, P] has a matrix for each speed, column i belongs to speed (i % period) // plane.
    """
    groups, powers, _ = demand.shape
    reached = np.empty(powers, np.int64)
    weight = np.empty((powers, groups))
    for p in range(powers):
        count = 0
        for q in range(powers):
            total = 0.0
            for g in range(groups):
                weight[q, g] = demand[g, p, q]
                total += weight[q, g]
            if total > 0.0:
                reached[count] = q
                count += 1
        for first in range(first_column, last_column, _BLOCK):
            last = min(first + _BLOCK, last_column)
            out[p, first:last] = 0.0
            if groups == 1:
                _add_rows(weight[:, 0], reached[:count], cost, first, last, out[p])
            else:
                _add_rows_by_speed(weight, reached[:count], cost, period, plane, first, last, out[p])


@kernel
def _add_rows(weight, rows, cost, first, last, out):
    """Add rows times their weights, four at a time: `out` is read and written a quarter as often."""
    whole = rows.size // 4 * 4
    for k in range(0, whole, 4):
        a, b, c, d = rows[k], rows[k + 1], rows[k + 2], rows[k + 3]
        of_a, of_b, of_c, of_d = weight[a], weight[b], weight[c], weight[d]
        for i in range(first, last):
            out[i] = (((out[i] + of_a * cost[a, i]) + of_b * cost[b, i]) + of_c * cost[c, i]) + of_d * cost[d, i]
    for k in range(whole, rows.size):
        of_a = weight[rows[k]]
        for i in range(first, last):
            out[i] += of_a * cost[rows[k], i]


@kernel
def _add_rows_by_speed(weight, rows, cost, period, plane, first, last, out):
    """As `_add_rows`, with the weight of each column's speed: a run of columns at a time."""
    i = first
    while i < last:
        place = i % period
        g = place // plane
        if plane > 1:
            end = min(i + plane - place % plane, last)
            _add_rows(weight[:, g], rows, cost, i, end, out)
            i = end
            continue
        end = min(i + period - place, last)
        whole = rows.size // 4 * 4
        for k in range(0, whole, 4):
            a, b, c, d = rows[k], rows[k + 1], rows[k + 2], rows[k + 3]
            for j in range(end - i):
                x = out[i + j] + weight[a, g + j] * cost[a, i + j]
                x = (x + weight[b, g + j] * cost[b, i + j]) + weight[c, g + j] * cost[c, i + j]
                out[i + j] = x + weight[d, g + j] * cost[d, i + j]
        for k in range(whole, rows.size):
            a = rows[k]
            for j in range(end - i):
                out[i + j] += weight[a, g + j] * cost[a, i + j]
        i = end


@parallel_kernel
def improve(model, w, first_power, last_power, out, policy):
    """The Bellman operator for a range of power demands: out = T J and its greedy policy, from w = demand @ J.

    Among controls that are equally good (to TIE_J), staying at the previous share wins; without one, the largest front
    share: braking in front is the stable choice.
    """
    n_u = model.switching_j.shape[1]
    n_s = model.switching_j.shape[0]
    tracked = n_s > 1
    step_v, step_f, step_r = corner_steps(model.cell_shape)
    gamma = model.discount
    for p in range(first_power, last_power):
        first = model.free_start[p]
        n = model.free_start[p + 1] - first
        value = np.empty((n_u, n))
        for u in range(n_u):
            ahead = w[p, u if tracked else 0]
            base = first * n_u + u * n
            for k in range(n):
                i = base + k
                value[u, k] = model.free_cost[i] + gamma * _interpolate(
                    ahead,
                    model.free_corner[i],
                    step_v,
                    step_f,
                    step_r,
                    model.free_fraction[i, 0],
                    model.free_fraction[i, 1],
                    model.free_fraction[i, 2],
                )
        best = np.empty(n)
        chosen_value = np.empty(n)
        chosen = np.empty(n, np.int16)
        for s in range(n_s):
            favourite = s if tracked else n_u - 1
            for k in range(n):
                best[k] = chosen_value[k] = value[favourite, k] + model.switching_j[s, favourite]
                chosen[k] = favourite
            for u in range(n_u - 1, -1, -1):
                price = model.switching_j[s, u]
                for k in range(n):
                    candidate = value[u, k] + price
                    best[k] = min(best[k], candidate)
                    if candidate < chosen_value[k] - TIE_J:
                        chosen_value[k] = candidate
                        chosen[k] = u
            for k in range(n):
                cell = model.free_cell[first + k]
                out[p, s, cell] = best[k]
                policy[p, s, cell] = chosen[k]
        _gated(model, w, 1.0, p, out)
        for i in range(model.gated_start[p], model.gated_start[p + 1]):
            for s in range(n_s):
                policy[p, s, model.gated_cell[i]] = GATED


@parallel_kernel
def apply_policy(model, w, policy, cost_factor, first_power, last_power, out):
    """Compute out = cost_factor * c_pi + gamma * P_pi J for a range of power demands, from w = demand @ J."""
    n_u = model.switching_j.shape[1]
    n_s = model.switching_j.shape[0]
    tracked = n_s > 1
    step_v, step_f, step_r = corner_steps(model.cell_shape)
    gamma = model.discount
    for p in range(first_power, last_power):
        first = model.free_start[p]
        n = model.free_start[p + 1] - first
        for s in range(n_s):
            for k in range(n):
                cell = model.free_cell[first + k]
                u = policy[p, s, cell]
                i = first * n_u + u * n + k
                out[p, s, cell] = cost_factor * (model.free_cost[i] + model.switching_j[s, u]) + gamma * _interpolate(
                    w[p, u if tracked else 0],
                    model.free_corner[i],
                    step_v,
                    step_f,
                    step_r,
                    model.free_fraction[i, 0],
                    model.free_fraction[i, 1],
                    model.free_fraction[i, 2],
                )
        _gated(model, w, cost_factor, p, out)


@kernel
def _gated(model, w, cost_factor, p, out):
    step_v, step_f, step_r = corner_steps(model.cell_shape)
    for s in range(model.switching_j.shape[0]):
        ahead = w[p, s]
        for i in range(model.gated_start[p], model.gated_start[p + 1]):
            out[p, s, model.gated_cell[i]] = cost_factor * model.gated_cost[i] + model.discount * _interpolate(
                ahead,
                model.gated_corner[i],
                step_v,
                step_f,
                step_r,
                model.gated_fraction[i, 0],
                model.gated_fraction[i, 1],
                model.gated_fraction[i, 2],
            )


@kernel
def flow(model, policy, mass, landed, out):
    """Move a distribution over the states one step on: out = mass @ P_pi, all arrays [P, S, C]; `landed` is scratch.

    A weight of the interpolation is the probability of that corner.
    """
    n_u = model.switching_j.shape[1]
    n_s = model.switching_j.shape[0]
    tracked = n_s > 1
    powers = mass.shape[0]
    cells = mass.shape[2]
    neighbour = corner_steps(model.cell_shape)
    landed[:] = 0.0
    for p in range(powers):
        first = model.free_start[p]
        n = model.free_start[p + 1] - first
        for s in range(n_s):
            for k in range(n):
                cell = model.free_cell[first + k]
                if mass[p, s, cell] > 0.0:
                    u = policy[p, s, cell]
                    i = first * n_u + u * n + k
                    target = u if tracked else 0
                    _scatter(
                        mass[p, s, cell], model.free_corner[i], neighbour, model.free_fraction[i], landed[p, target]
                    )
            for i in range(model.gated_start[p], model.gated_start[p + 1]):
                cell = model.gated_cell[i]
                _scatter(mass[p, s, cell], model.gated_corner[i], neighbour, model.gated_fraction[i], landed[p, s])
    plane = model.cell_shape[1] * model.cell_shape[2]
    out[:] = 0.0
    for p in range(powers):
        for q in range(powers):
            if np.sum(model.demand[:, p, q]) > 0.0:
                for s in range(n_s):
                    for c in range(cells):
                        group = c // plane if model.demand.shape[0] > 1 else 0
                        out[q, s, c] += model.demand[group, p, q] * landed[p, s, c]


@kernel
def _scatter(mass, corner, neighbour, fraction, landed):
    for a in range(2):
        for b in range(2):
            for c in range(2):
                weight = fraction[0] if a else 1.0 - fraction[0]
                weight *= fraction[1] if b else 1.0 - fraction[1]
                weight *= fraction[2] if c else 1.0 - fraction[2]
                if weight > 0.0:
                    landed[corner + a * neighbour[0] + b * neighbour[1] + c * neighbour[2]] += mass * weight


@kernel
def dot(a, b):
    """Scalar product of two vectors, summed in a fixed order: BLAS's depends on the number of threads."""
    total = 0.0
    for first in range(0, a.size, _BLOCK):
        # Four running sums keep the adder busy; blocks keep the rounding error small.
        s0 = s1 = s2 = s3 = 0.0
        last = min(first + _BLOCK, a.size)
        whole = first + (last - first) // 4 * 4
        for i in range(first, whole, 4):
            s0 += a[i] * b[i]
            s1 += a[i + 1] * b[i + 1]
            s2 += a[i + 2] * b[i + 2]
            s3 += a[i + 3] * b[i + 3]
        for i in range(whole, last):
            s0 += a[i] * b[i]
        total += (s0 + s1) + (s2 + s3)
    return total
