# SPDX-License-Identifier: Apache-2.0
"""The strategies, one file each: how much of the demand the front axle gets.

Every module here states one `STRATEGY`; this table finds them all. To add one, add a file (and its test): nothing else
names it. A strategy that lives elsewhere is registered with `register`, before the control law is imported.
"""

from __future__ import annotations

import importlib
import pkgutil
import sys

from iwm_power_manager.control.strategy import Strategy

#: The strategy that drives where nobody chose another.
DEFAULT_STRATEGY = "sdp_lookahead"

#: Strategies by name, in the order of their codes.
STRATEGIES: dict[str, Strategy] = {}

_sealed = False


def register(strategy: Strategy) -> None:
    """Add a strategy to the table.

    Raises
    ------
    ValueError
        Its name or code is taken, or it is too late: the control law has been built from the table.
    """
    for known in STRATEGIES.values():
        if strategy.name == known.name or strategy.code == known.code:
            raise ValueError(f"{strategy.name} ({strategy.code}): {known.name} has code {known.code}")
    if _sealed:
        raise ValueError(f"{strategy.name}: the control law is built already; register strategies before importing it")
    STRATEGIES[strategy.name] = strategy
    ordered = sorted(STRATEGIES.values(), key=lambda known: known.code)
    STRATEGIES.clear()
    STRATEGIES.update({known.name: known for known in ordered})


def seal() -> tuple[Strategy, ...]:
    """All strategies; from now on none can be added."""
    global _sealed
    _sealed = True
    return tuple(STRATEGIES.values())


def name_of(code: int) -> str:
    """Name of a strategy's code."""
    return next(strategy.name for strategy in STRATEGIES.values() if strategy.code == code)


def meaning(name: str) -> str:
    """What a strategy does, in half a sentence: the first line of its file, behind its name."""
    return (
        (sys.modules[STRATEGIES[name].choose.__module__].__doc__ or "")
        .partition("\n")[0]
        .partition(": ")[2]
        .rstrip(".")
    )


def drivable() -> tuple[str, ...]:
    """Names of the strategies a car can drive with: those that do not know the future."""
    return tuple(name for name, strategy in STRATEGIES.items() if not strategy.knows_future)


for _found in pkgutil.iter_modules(__path__):
    register(importlib.import_module(f"{__name__}.{_found.name}").STRATEGY)
