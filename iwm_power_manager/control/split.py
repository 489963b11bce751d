"""Power split: the strategy in use decides the front share. One entry, `decide`, for all of them.

Numba can neither call through a table nor keep on disk what closes over compiled functions. So the call of each
strategy is written out here, from the table: plain comparisons of a number, which cost a step nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from iwm_power_manager.control.strategies import seal
from iwm_power_manager.control.strategy import Strategy
from iwm_power_manager.jit import kernel

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
