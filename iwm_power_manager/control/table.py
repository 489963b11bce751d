# SPDX-License-Identifier: Apache-2.0
"""A solved policy as the control law takes it: axes, shares and the expected cost of what follows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from iwm_power_manager.control.budget import ELASTICITY
from iwm_power_manager.model.decision import (
    ERROR_ABSOLUTE,
    POWER_ERROR_ROAD,
    SKID_BRAKING,
    SLIP_QUASI_STEADY,
    ProblemParams,
)


class PolicyTable(NamedTuple):
    """A policy as the control law takes it. Axes: P power, V speed, F slip front, R slip rear, S previous share.

    Attributes
    ----------
    power_w, speed_mps, slip_front, slip_rear, previous_share : axes; the last has one point if it is no state
    share : control levels, 0..1
    front_share : float64[P, V, F, R, S]
    expected_cost_j : float64[P, V, F, R, S], expected cost-to-go after a step: E[J(next demand, v, f, r, s) | P]
    discount : gamma
    switching_cost_j, switching_fixed_cost_j : price of a change of share: per unit, and of any change
    problem : what `step_cost_and_next` needs
    rule : coefficients of the `rule` strategy: P_f = rule[0] + rule[1] * P_dem driving, rule[2:4] braking
    schedule : front share of each decision, for the `preview` strategy
    changes_per_min : budget of changes of the share (`control.budget`); 0 is none
    dearer_cost_j : float64[D, P, V, F, R, S], `expected_cost_j` at the prices `control.budget.DEARER`; D = 0 without a
        budget
    elasticity : what a price that is higher by one in the logarithm takes from the changes, as a part of the budget
    """

    power_w: NDArray[np.float64]
    speed_mps: NDArray[np.float64]
    slip_front: NDArray[np.float64]
    slip_rear: NDArray[np.float64]
    previous_share: NDArray[np.float64]
    share: NDArray[np.float64]
    front_share: NDArray[np.float64]
    expected_cost_j: NDArray[np.float64]
    discount: float
    switching_cost_j: float
    switching_fixed_cost_j: float
    problem: ProblemParams
    rule: NDArray[np.float64]
    schedule: NDArray[np.float64]
    changes_per_min: float
    dearer_cost_j: NDArray[np.float64]
    elasticity: float


def empty_table(
    share: Sequence[float] | None = None, rule: Sequence[float] = (), schedule: Sequence[float] = ()
) -> PolicyTable:
    """A `PolicyTable` for strategies that need no solved policy: its tables hold equal split and no cost."""
    point = np.zeros(1)
    levels = np.arange(21) / 20.0 if share is None else np.ascontiguousarray(share, dtype=np.float64)
    return PolicyTable(
        power_w=point,
        speed_mps=point,
        slip_front=point,
        slip_rear=point,
        previous_share=point,
        share=levels,
        front_share=np.full((1, 1, 1, 1, 1), 0.5),
        expected_cost_j=np.zeros((1, 1, 1, 1, 1)),
        discount=0.0,
        switching_cost_j=0.0,
        switching_fixed_cost_j=0.0,
        problem=ProblemParams(
            dt_s=0.1,
            friction=0.9,
            alpha=0.0,
            power_error=POWER_ERROR_ROAD,
            error_norm=ERROR_ABSOLUTE,
            slip_model=SLIP_QUASI_STEADY,
            skid_avoidance=SKID_BRAKING,
            critical_slip=0.2,
        ),
        rule=as_vector(rule, 4),
        schedule=as_vector(schedule, 1),
        changes_per_min=0.0,
        dearer_cost_j=np.zeros((0, 1, 1, 1, 1, 1)),
        elasticity=ELASTICITY,
    )


def as_vector(values: Sequence[float], least: int) -> NDArray[np.float64]:
    """`values` as float64[:]; where there are none, equal split, long enough for the law to read."""
    if len(values):
        return np.ascontiguousarray(values, dtype=np.float64)
    return np.array([0.0, 0.5, 0.0, 0.5]) if least == 4 else np.full(least, 0.5)
