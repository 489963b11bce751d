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

from iwm_power_manager.mdp.sweep import GATED, Model, apply_policy, dot, expect_over_demand, improve
from iwm_power_manager.mdp.threads import over_ranges

_FORCING = 0.1
_MAX_KRYLOV_STEPS = 200


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
