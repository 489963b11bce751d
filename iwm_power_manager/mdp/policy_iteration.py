# SPDX-License-Identifier: Apache-2.0
r"""Policy iteration (eq. 30, 31) that uses the problem's structure and stops on a certified bound.

The Markov decision process
---------------------------
A state is (power demand p, previous share s, cell c), where a cell is a grid point (speed, front slip, rear slip).
The demand is a Markov chain of its own; the next cell depends on (p, c, u) only; the next s is the control u. So

    q(p, c, u) = cost(p, c, u) + gamma * sum_k weight_k * W[p, u, corner_k],     W = demand @ J
    (T J)(p, s, c) = min_u  q(p, c, u) + switching(s, u)

with the 8 corners of the grid cell the next (speed, slips) falls into. The only arrays of the size of state times
control hold, per pair, a cost, the index of the lower corner and three fractions; no transition matrix is ever built,
and the previous share multiplies the size of J but not the number of costs. Where skid avoidance leaves no choice
(Table 2), a state has one action, which keeps s.

The algorithm
-------------
Inexact policy iteration: improve the policy by T (eq. 31), then solve its evaluation (eq. 30), the linear system
(I - gamma P_pi) J = c_pi, by BiCGSTAB without a matrix, only as accurately as the present distance to the optimum
deserves: to `forcing` times the Bellman residual. `forcing` is tightened whenever the residual fails to shrink, so that
the method falls back to exact policy iteration, which ends after finitely many policies.

The bound
---------
Let d = T J - J, lo = min d, hi = max d (over all states). Then, for every state (MacQueen 1966, Porteus 1971),

    T J + gamma / (1 - gamma) * lo  <=  J*  <=  T J + gamma / (1 - gamma) * hi

so the midpoint of both is within gamma / (1 - gamma) * (hi - lo) / 2 of the optimal cost-to-go J* in the max norm, and
the cost of the policy that is greedy for J exceeds J* by at most twice that. The iteration ends when this bound is
at most `tolerance_j`. The bound includes what rounding can do to T J: a few units in the last place of J for every
term of its sums, over (1 - gamma).

Every sum runs in a fixed order, whatever the number of threads: the same inputs give the same bits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iwm_power_manager.jit import kernel, parallel_kernel
from iwm_power_manager.mdp.threads import over_ranges

#: Actions whose values differ by less than this, J, are equally good: rounding must not choose between them.
TIE_J = 1e-6
#: Policy entry of a state where skid avoidance leaves no choice.
GATED = -1

_BLOCK = 1024
_FORCING = 0.1
_MAX_KRYLOV_STEPS = 200


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


class Iteration(NamedTuple):
    """One policy of the iteration, as printed and stored (the paper's Fig. 12).

    Attributes
    ----------
    number : 1 for the first policy
    evaluation_sweeps : applications of the transition operator so far
    bound_j : certified max-norm distance of the cost-to-go from the optimal one, J
    policy_change : Euclidean norm of the change of the front share over all states
    changed_states : number of states whose front share changed
    """

    number: int
    evaluation_sweeps: int
    bound_j: float
    policy_change: float
    changed_states: int


@dataclass(frozen=True, eq=False)
class Solution:
    """The solved problem.

    Attributes
    ----------
    cost_j : float64[P, S, C], cost-to-go, J, within `bound_j` of the optimum
    policy : int16[P, S, C], index of the control, or GATED
    bound_j : certified max-norm bound, J
    converged : whether bound_j <= tolerance_j
    iterations : one entry a policy
    """

    cost_j: NDArray[np.float64]
    policy: NDArray[np.int16]
    bound_j: float
    converged: bool
    iterations: tuple[Iteration, ...]


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


class _Operator:
    """demand @ J and the two operators on it, with the work array they share."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self.ahead = np.empty(model.state_shape)
        self.sweeps = 0

    def _expect(self, cost: NDArray[np.float64]) -> None:
        rows = cost.shape[0]
        flat, ahead = cost.reshape(rows, -1), self.ahead.reshape(rows, -1)
        cells = cost.shape[2]
        plane = self.model.cell_shape[1] * self.model.cell_shape[2]
        over_ranges(
            flat.shape[1],
            cost.size,
            lambda first, last: expect_over_demand(self.model.demand, flat, cells, plane, first, last, ahead),
        )
        self.sweeps += 1

    def improve(self, cost: NDArray[np.float64], out: NDArray[np.float64], policy: NDArray[np.int16]) -> None:
        self._expect(cost)
        over_ranges(
            cost.shape[0],
            self.model.free_cost.size,
            lambda first, last: improve(self.model, self.ahead, first, last, out, policy),
        )

    def evaluate(
        self, cost: NDArray[np.float64], policy: NDArray[np.int16], cost_factor: float, out: NDArray[np.float64]
    ) -> None:
        self._expect(cost)
        over_ranges(
            cost.shape[0],
            cost.size,
            lambda first, last: apply_policy(self.model, self.ahead, policy, cost_factor, first, last, out),
        )


def _settled(model: Model) -> tuple[Model, int] | None:
    """The problem with slip at rest: one cell for each speed, that of the least slip, and the place of its first one.

    None where slip is no state, or where the least slip leaves no choice.
    """
    speeds, front, rear = model.cell_shape
    if front * rear == 1:
        return None
    centre = front // 2 * rear + rear // 2
    n_u = model.switching_j.shape[1]
    cells = centre + front * rear * np.arange(speeds)
    rows, start = [], [0]
    for first, last in zip(model.free_start, model.free_start[1:], strict=False):
        place = np.searchsorted(model.free_cell[first:last], cells)
        if place[-1] >= last - first or np.any(model.free_cell[first:last][place] != cells):
            return None
        rows.append((first * n_u + np.arange(n_u)[:, None] * (last - first) + place).ravel())
        start.append(start[-1] + speeds)
    pairs = np.concatenate(rows)
    fraction = model.free_fraction[pairs].copy()
    fraction[:, 1:] = 0.0
    none = np.zeros(len(start), np.int64)
    return model._replace(
        cell_shape=(speeds, 1, 1),
        free_start=np.array(start),
        free_cell=np.tile(np.arange(speeds, dtype=np.int32), len(rows)),
        free_cost=np.zeros(pairs.size),
        free_corner=(model.free_corner[pairs] // (front * rear)).astype(np.int32),
        free_fraction=fraction,
        gated_start=none,
        gated_cell=none[:0].astype(np.int32),
        gated_cost=np.zeros(0),
        gated_corner=none[:0].astype(np.int32),
        gated_fraction=np.zeros((0, 3)),
    ), centre


class _Evaluation:
    """Solves (I - gamma P_pi) cost = c_pi, the evaluation of a policy.

    Slip settles within a step or two; what is slow is speed and demand. So most of an error is, after one sweep, the
    same for all slips, and the problem with slip at rest, which has a few hundredths of the states, takes it away
    (aggregation, Bertsekas and Castanon 1989). Where that stops to help, and where slip is no state, BiCGSTAB goes on.
    """

    def __init__(self, operator: _Operator) -> None:
        self._operator = operator
        settled = _settled(operator.model)
        self._coarse = _Operator(settled[0]) if settled else None
        self._centre = settled[1] if settled else 0

    def run(self, policy: NDArray[np.int16], cost: NDArray[np.float64], target: float) -> None:
        """Improve `cost` in place until the residual's max norm is <= target, as far as the arithmetic allows."""
        if self._coarse is None or not self._aggregate(self._coarse, policy, cost, target):
            _bicgstab(self._operator, policy, cost, target, None)

    def _aggregate(
        self, coarse: _Operator, policy: NDArray[np.int16], cost: NDArray[np.float64], target: float
    ) -> bool:
        """Alternate sweeps with the settled problem; whether that was enough."""
        plane = self._operator.model.cell_shape[1] * self._operator.model.cell_shape[2]
        chosen = np.ascontiguousarray(policy[:, :, self._centre :: plane])
        swept = np.empty_like(cost)
        before = np.inf
        while True:
            self._operator.evaluate(cost, policy, 1.0, swept)
            np.subtract(swept, cost, out=cost)
            now = float(np.max(np.abs(cost)))
            residual = np.ascontiguousarray(cost[:, :, self._centre :: plane])
            cost[:] = swept
            if now <= target or now > 0.7 * before:
                return now <= target
            before = now
            # A sweep has been made: what is left of the residual is one step old.
            left = np.empty_like(residual)
            coarse.evaluate(residual, chosen, 0.0, left)
            error = np.zeros_like(left)
            _bicgstab(coarse, chosen, error, 0.03 * float(np.max(np.abs(left))), left)
            by_speed = cost.reshape(*cost.shape[:2], -1, plane)
            by_speed += error[:, :, :, None]


def _bicgstab(
    operator: _Operator,
    policy: NDArray[np.int16],
    cost: NDArray[np.float64],
    target: float,
    right: NDArray[np.float64] | None,
) -> None:
    """Solve (I - gamma P_pi) cost = right in place, from the given start, until the residual's max norm is <= target.

    `right` is c_pi where it is None. BiCGSTAB (van der Vorst 1992), restarted where it stops, as long as a restart at
    least halves the true residual: below that lies the precision of the arithmetic.
    """
    residual = np.empty_like(cost)
    image = np.empty_like(cost)
    second = np.empty_like(cost)

    def true_residual() -> float:
        operator.evaluate(cost, policy, 1.0 if right is None else 0.0, residual)
        if right is not None:
            np.add(residual, right, out=residual)
        np.subtract(residual, cost, out=residual)
        return float(np.max(np.abs(residual)))

    def multiply(vector: NDArray[np.float64], out: NDArray[np.float64]) -> None:
        operator.evaluate(vector, policy, 0.0, out)
        np.subtract(vector, out, out=out)

    before = np.inf
    while target < (now := true_residual()) < 0.5 * before:
        before = now
        shadow = residual.copy()
        direction = residual.copy()
        rho = dot(shadow.ravel(), residual.ravel())
        for _ in range(_MAX_KRYLOV_STEPS):
            multiply(direction, image)
            denominator = dot(shadow.ravel(), image.ravel())
            if denominator == 0.0:
                break
            step = rho / denominator
            residual -= step * image
            multiply(residual, second)
            squared = dot(second.ravel(), second.ravel())
            omega = dot(second.ravel(), residual.ravel()) / squared if squared > 0.0 else 0.0
            cost += step * direction
            cost += omega * residual
            residual -= omega * second
            if float(np.max(np.abs(residual))) <= target:
                break
            rho_next = dot(shadow.ravel(), residual.ravel())
            if omega == 0.0 or rho == 0.0 or not np.isfinite(rho_next):
                break
            factor = rho_next / rho * (step / omega)
            direction -= omega * image
            direction *= factor
            direction += residual
            rho = rho_next


def _gated_mask(model: Model) -> NDArray[np.bool_]:
    """Mark the states with a single action: bool[P, S, C]."""
    powers, shares, cells = model.state_shape
    mask = np.zeros((powers, cells), dtype=np.bool_)
    mask[np.repeat(np.arange(powers), np.diff(model.gated_start)), model.gated_cell] = True
    return np.broadcast_to(mask[:, None, :], (powers, shares, cells))


def certified_bound(discount: float, difference: NDArray[np.float64]) -> tuple[float, float]:
    """Shift and max-norm bound (J) from the Bellman difference T J - J: J* = T J + shift, give or take the bound."""
    low, high = float(np.min(difference)), float(np.max(difference))
    factor = discount / (1.0 - discount)
    return factor * (low + high) / 2.0, factor * (high - low) / 2.0


def solve(
    model: Model,
    share: NDArray[np.float64],
    tolerance_j: float,
    max_iterations: int = 100,
    progress: Callable[[Iteration], None] | None = None,
    start_j: NDArray[np.float64] | None = None,
) -> Solution:
    """Solve the problem to a certified bound.

    Parameters
    ----------
    model : the discretised problem
    share : float64[U], front share of each control, for the norm of the policy's change
    tolerance_j : bound on the max-norm distance from the optimal cost-to-go, J
    max_iterations : policies to try at most
    progress : called after each policy
    start_j : float64[P, S, C], a cost-to-go to start from, such as that of a similar problem

    Returns
    -------
    Solution
        `converged` is False where max_iterations, or the precision of the arithmetic, ended the iteration first.
    """
    operator = _Operator(model)
    evaluation = _Evaluation(operator)
    cost = np.zeros(model.state_shape) if start_j is None else start_j.copy()
    improved = np.empty_like(cost)
    # What the first policy is compared with: equal split.
    policy = np.where(_gated_mask(model), np.int16(GATED), np.int16(np.argmin(np.abs(share - 0.5))))
    previous = np.empty_like(policy)
    history: list[Iteration] = []
    share_of = np.append(share, 0.0)  # the last entry serves GATED = -1
    residual_target = tolerance_j * (1.0 - model.discount) / model.discount if model.discount > 0.0 else np.inf
    rounding = (model.demand.shape[1] + 16) * float(np.finfo(np.float64).eps) / (1.0 - model.discount)
    forcing = _FORCING
    smallest = np.inf
    while True:
        previous[:] = policy
        operator.improve(cost, improved, policy)
        difference = np.subtract(improved, cost, out=cost)
        residual = float(np.max(np.abs(difference)))
        shift, bound = certified_bound(model.discount, difference)
        bound += rounding * float(np.max(np.abs(improved)))
        change = share_of[policy] - share_of[previous]
        history.append(
            Iteration(
                number=len(history) + 1,
                evaluation_sweeps=operator.sweeps,
                bound_j=bound,
                policy_change=float(np.sqrt(np.sum(change * change))),
                changed_states=int(np.count_nonzero(policy != previous)),
            )
        )
        if progress is not None:
            progress(history[-1])
        if bound <= tolerance_j or len(history) == max_iterations:
            break
        if bound > 0.9 * smallest:
            forcing *= 0.1
            if forcing < 1e-12:
                break
        smallest = min(smallest, bound)
        cost, improved = improved, cost
        cost += shift
        evaluation.run(policy, cost, max(forcing * residual, 0.1 * residual_target))
    improved += shift
    return Solution(improved, policy, bound, bound <= tolerance_j, tuple(history))
