# SPDX-License-Identifier: Apache-2.0
"""`instantaneous`: the split of least battery power now, blind to slip."""

from __future__ import annotations

from typing import TYPE_CHECKING

from iwm_power_manager.control.strategy import Situation, Strategy
from iwm_power_manager.control.table import PolicyTable
from iwm_power_manager.jit import kernel
from iwm_power_manager.model.parameters import VehicleParams
from iwm_power_manager.model.quasi_steady import axles_of, demand_force_n, split_outcome_w

if TYPE_CHECKING:
    from iwm_power_manager.control.settings import Settings

#: Price of a joule that is not delivered, in joules: high enough that delivering always comes first.
PRICE_OF_MISSING = 20.0

#: Power that tells two splits apart, W. Front-only and rear-only are nearly equal on equal motors: rounding must not
#: make them change places.
LEAST_DIFFERENCE_W = 1e-3


@kernel
def cheapest_share(
    situation: Situation,
    slip_aware: bool,
    switching_power_w: float,
    vehicle: VehicleParams,
    policy: PolicyTable,
) -> float:
    """Share on the policy's share axis (or the previous one) with the least battery power now."""
    previous = situation.previous_share
    friction = situation.friction
    force = demand_force_n(situation.power_demand_w, situation.speed_mps, friction, slip_aware, vehicle)
    speed = max(situation.speed_mps, vehicle.driver.power_speed_floor_mps)
    axles = axles_of(force, speed, friction, slip_aware, vehicle)
    power, missing, _ = split_outcome_w(axles, force, speed, previous, friction, slip_aware, False, vehicle)
    best = previous
    best_power = power + PRICE_OF_MISSING * missing * speed - LEAST_DIFFERENCE_W
    for k in range(policy.share.size):
        power, missing, _ = split_outcome_w(axles, force, speed, policy.share[k], friction, slip_aware, False, vehicle)
        power += PRICE_OF_MISSING * missing * speed + switching_power_w
        if power < best_power:
            best_power = power
            best = policy.share[k]
    return best


@kernel
def choose(situation: Situation, settings: Settings, vehicle: VehicleParams, policy: PolicyTable) -> float:
    """The cheapest share, as if no wheel ever slipped."""
    return cheapest_share(situation, False, 0.0, vehicle, policy)


STRATEGY = Strategy("instantaneous", 2, choose)
