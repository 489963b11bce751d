# SPDX-License-Identifier: Apache-2.0
"""The price of a change from a budget of changes: the multiplier of the constrained problem.

The user says how many changes of the split a minute are right; what a change must be worth then follows from the car,
the road and the way of driving. The constrained problem

    minimise the cost of driving, subject to  (changes a minute under the policy)  <=  budget

has, for a price lambda on every change, the policy that is greedy for J_lambda; the rate of changes under it, in the
stationary distribution of the states it visits, does not rise with lambda. So the multiplier is found by bracketing and
bisection in log(lambda): each trial solves the priced problem (from the previous trial's cost-to-go) and follows the
distribution of the states, step by step of the chain, until it is stationary.

The search starts at what a free choice of the share gains over one horizon, and does not go below what it gains in one
step: a car that never needs its budget is not to change for nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iwm_power_manager.control.budget import DEARER, ELASTICITY, changes_counted
from iwm_power_manager.mdp.policy_iteration import Solution, solve
from iwm_power_manager.mdp.problem import price_matrix
from iwm_power_manager.mdp.sweep import GATED, Model, flow

#: The rate may miss the budget by this part.
RATE_TOLERANCE = 0.03
#: The distribution of the states is stationary where a step moves no more of it than this.
_STILL = 3e-5
_MOST_STEPS = 3000
_MOST_TRIALS = 14
_FIRST_FACTOR = 4.0
#: Where prices tried say less or more than this, the rate jumps between them.
_ELASTICITY_RANGE = (0.1, 1.0)


class Trial(NamedTuple):
    """One price tried: J for a whole change, and the changes a minute under its policy."""

    price_j: float
    changes_per_min: float


class Found(NamedTuple):
    """The price that keeps the budget, the solution at it, and how it was found."""

    price_j: float
    solution: Solution
    trials: tuple[Trial, ...]


def elasticity_of(trials: Sequence[Trial], price_j: float, changes_per_min: float) -> float:
    """What a price that is higher by one in the logarithm takes from the changes, as a part of the budget.

    The mean from the price to the first of `DEARER`, linear in the logarithm between the trials around.

    Parameters
    ----------
    trials : in any order; where none is dearer than the price, `control.budget.ELASTICITY` stands
    price_j : the multiplier, J for a whole change
    changes_per_min : the budget
    """
    dearest_j = max((trial.price_j for trial in trials), default=0.0)
    if changes_per_min <= 0.0 or dearest_j <= price_j:
        return ELASTICITY
    tried_j, rates = np.array(sorted(trials)).T
    dearer_j = min(DEARER[0] * price_j, dearest_j)
    first, last = np.interp(np.log([price_j, dearer_j]), np.log(tried_j), rates)
    return float(np.clip((first - last) / (changes_per_min * math.log(dearer_j / price_j)), *_ELASTICITY_RANGE))


def counted(share: NDArray[np.float64]) -> NDArray[np.float64]:
    """float64[S, U]: what a change from a share (rows) to another (columns) counts as."""
    return np.array([[changes_counted(u - s) for u in share] for s in share])


class Occupancy:
    """The distribution of the states under a policy; it goes on from where the last policy left it.

    Parameters
    ----------
    model : the discretised problem, with the previous share as a state
    dt_s : length of a step
    share : control levels
    """

    def __init__(self, model: Model, dt_s: float, share: NDArray[np.float64]) -> None:
        self._model = model
        self._counted = counted(share)
        self._per_min = 60.0 / dt_s
        self._mass = np.full(model.state_shape, 1.0 / float(np.prod(model.state_shape)))
        self._scratch = np.empty_like(self._mass)
        self._next = np.empty_like(self._mass)

    def settle(self, policy: NDArray[np.int16]) -> None:
        """Follow a policy until its distribution is stationary."""
        for _ in range(_MOST_STEPS):
            flow(self._model, policy, self._mass, self._scratch, self._next)
            moved = float(np.abs(self._next - self._mass).sum())
            self._mass, self._next = self._next, self._mass
            if moved < _STILL:
                break

    def changes_per_min(self, policy: NDArray[np.int16]) -> float:
        """Changes a minute of a policy in the present distribution."""
        shares = np.arange(self._mass.shape[1])[None, :, None]
        stays = np.where(policy == GATED, shares, policy)
        return float((self._mass * self._counted[shares, stays]).sum()) * self._per_min

    def gain_of_choice_j(self) -> float:
        """What the cheapest share saves in a step against the middle one, J, in the mean over the distribution."""
        model = self._model
        n_u = model.switching_j.shape[1]
        total = 0.0
        for p in range(self._mass.shape[0]):
            first, last = int(model.free_start[p]), int(model.free_start[p + 1])
            cost = model.free_cost[first * n_u : last * n_u].reshape(n_u, last - first)
            weight = self._mass[p][:, model.free_cell[first:last]].sum(axis=0)
            middle = np.where(np.isfinite(cost[n_u // 2]), cost[n_u // 2], cost.min(axis=0))
            total += float(((middle - cost.min(axis=0)) * weight).sum())
        return total


def find_price(
    model: Model,
    share: NDArray[np.float64],
    dt_s: float,
    changes_per_min: float,
    tolerance_j: float,
    tried: Callable[[Trial], None] = lambda _: None,
) -> Found:
    """The price of a change that keeps the budget.

    Parameters
    ----------
    model : the problem without a price: `switching_j` is replaced by the price times `price_matrix`
    share : control levels, also the axis of the previous share
    dt_s : length of a step
    changes_per_min : the budget
    tolerance_j : of each solution
    tried : hears of every trial
    """
    occupancy = Occupancy(model, dt_s, share)
    change = price_matrix(share)
    stay = np.broadcast_to(np.arange(share.size, dtype=np.int16)[None, :, None], model.state_shape)
    occupancy.settle(np.ascontiguousarray(stay))
    step_gain = occupancy.gain_of_choice_j()
    least = max(step_gain, 1e-9)
    trials: list[Trial] = []
    start: NDArray[np.float64] | None = None

    def attempt(price_j: float) -> tuple[Solution, float]:
        nonlocal start
        solution = solve(model._replace(switching_j=price_j * change), share, tolerance_j, start_j=start)
        start = solution.cost_j
        occupancy.settle(solution.policy)
        rate = occupancy.changes_per_min(solution.policy)
        trials.append(Trial(price_j, rate))
        tried(trials[-1])
        return solution, rate

    low = high = 0.0  # prices with too many changes, and with few enough
    price = least / (1.0 - model.discount)
    factor = _FIRST_FACTOR
    while True:
        solution, rate = attempt(price)
        close = abs(rate - changes_per_min) <= RATE_TOLERANCE * changes_per_min
        if close or len(trials) >= _MOST_TRIALS or (rate <= changes_per_min and price <= least):
            return Found(price, solution, tuple(trials))
        if rate > changes_per_min:
            low = price
        else:
            high = price
        if low > 0.0 and high > 0.0:
            if high / low < 1.01:  # the rate jumps here
                return Found(price, solution, tuple(trials))
            price = math.sqrt(low * high)
        else:
            price = max(price * factor, least) if rate > changes_per_min else max(price / factor, least)
