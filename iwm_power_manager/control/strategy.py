# SPDX-License-Identifier: Apache-2.0
"""What a strategy is: the one interface behind which the power split is decided."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from iwm_power_manager.control.budget import Used
from iwm_power_manager.control.persistence import Jitter


class Situation(NamedTuple):
    """What a strategy decides from.

    Attributes
    ----------
    power_demand_w : at the wheels, braking negative
    speed_mps : vehicle speed
    front_slip, rear_slip : filtered slip of the axles
    previous_share : front share of the decision before, 0..1
    changes_used : what is used of the budget of changes (`control.budget`)
    jitter : what is remembered of the demand (`control.persistence`)
    friction : peak friction coefficient to assume
    decisions : decisions taken so far in this run
    """

    power_demand_w: float
    speed_mps: float
    front_slip: float
    rear_slip: float
    previous_share: float
    changes_used: Used
    jitter: Jitter
    friction: float
    decisions: int


class Strategy(NamedTuple):
    """One strategy, as its file in `control/strategies` states it.

    Attributes
    ----------
    name : on every command line and in every parameter file
    code : number of it in `Settings`, in records and in bags; once given away it never changes
    choose : kernel (Situation, Settings, VehicleParams, PolicyTable) -> front share, 0..1
    needs_policy : it reads a solved policy
    knows_future : it plays what was planned with the whole cycle known: no car can drive with it
    decides_without_demand : it is asked even where there is no demand; the others keep the share then
    """

    name: str
    code: int
    choose: Callable[..., Any]
    needs_policy: bool = False
    knows_future: bool = False
    decides_without_demand: bool = False
