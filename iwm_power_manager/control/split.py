# SPDX-License-Identifier: Apache-2.0
"""Power split: the strategy in use decides the front share. One entry, `decide`, for all of them.

Numba can neither call through a table nor keep on disk what closes over compiled functions. So the call of each
strategy is written out here, from the table: plain comparisons of a number, which cost a step nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from iwm_power_manager.control.budget import leaked, spent
from iwm_power_manager.control.persistence import observed
from iwm_power_manager.control.settings import Settings
from iwm_power_manager.control.slew import approached
from iwm_power_manager.control.strategies import seal
from iwm_power_manager.control.strategy import Situation, Strategy
from iwm_power_manager.control.table import PolicyTable
from iwm_power_manager.control.types import Measurement, SplitMemory
from iwm_power_manager.jit import kernel
from iwm_power_manager.model.parameters import VehicleParams

#: A demand smaller than this is none, W: the split stays as it is.
LEAST_DEMAND_W = 1.0


def _dispatcher(strategies: tuple[Strategy, ...]) -> Callable[..., Any]:
    """`decide` over these strategies."""
    lines = ["def decide(situation, settings, vehicle, policy):"]
    for always in (True, False):
        for strategy in strategies:
            if strategy.decides_without_demand is always:
                lines.append(f"    if settings.strategy == {strategy.code}:")
                lines.append(f"        return choose_{strategy.code}(situation, settings, vehicle, policy)")
        if always:
            lines.append(f"    if abs(situation.power_demand_w) < {LEAST_DEMAND_W!r}:")
            lines.append("        return situation.previous_share")
    lines.append("    return 0.5")
    names: dict[str, Any] = {f"choose_{strategy.code}": strategy.choose for strategy in strategies}
    names["__name__"] = __name__
    # The file's own name makes numba keep the compiled function beside those of this module.
    exec(compile("\n".join(lines), __file__, "exec"), names)  # noqa: S102 - made of the table's numbers alone
    function: Callable[..., Any] = names["decide"]
    function.__doc__ = """Front share 0..1 the strategy in use chooses; equal split for a code that is none."""
    return function


#: Kernel (Situation, Settings, VehicleParams, PolicyTable) -> front share, 0..1.
decide = kernel(_dispatcher(seal()))


@kernel
def split(
    measurement: Measurement,
    speed_mps: float,
    front_slip: float,
    rear_slip: float,
    first: bool,
    memory: SplitMemory,
    settings: Settings,
    vehicle: VehicleParams,
    policy: PolicyTable,
) -> SplitMemory:
    """The split of this step: decided once a period, applied at a limited rate.

    Parameters
    ----------
    speed_mps, front_slip, rear_slip : of the car and its axles
    first : the first step of a run: what is decided is applied at once
    """
    decisions = memory.decisions
    age = memory.age_s + measurement.dt_s
    decided = memory.decided_share
    used = leaked(memory.changes_used, measurement.dt_s, policy.changes_per_min)
    jitter = observed(memory.jitter, measurement.power_demand_w, speed_mps, measurement.dt_s)
    # Half a step of slack: sums of 0.01 s must not delay every tenth decision by a step.
    if first or age >= settings.decision_period_s - 0.5 * measurement.dt_s:
        situation = Situation(
            power_demand_w=measurement.power_demand_w,
            speed_mps=speed_mps,
            front_slip=front_slip,
            rear_slip=rear_slip,
            previous_share=decided,
            changes_used=used,
            jitter=jitter,
            friction=measurement.friction,
            decisions=decisions,
        )
        decided = decide(situation, settings, vehicle, policy)
        if policy.changes_per_min > 0.0:
            used = spent(used, decided - memory.decided_share)
        decisions += 1
        age = 0.0
    if first:
        applied = decided
    else:
        applied = approached(memory.applied_share, decided, settings.share_rate_per_s * measurement.dt_s)
    return SplitMemory(
        decisions=decisions,
        age_s=age,
        decided_share=decided,
        applied_share=applied,
        changes_used=used,
        jitter=jitter,
    )
