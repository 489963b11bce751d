# SPDX-License-Identifier: Apache-2.0
"""Kernels as plain Python, through and through: slower by far, but there is nothing to compile."""

from __future__ import annotations

from types import CellType, FunctionType, ModuleType, SimpleNamespace
from typing import Any, TypeVar

from iwm_power_manager.jit import Kernel

T = TypeVar("T")

_MADE: dict[Any, Any] = {}
_NAMES: dict[int, dict[str, Any]] = {}


def interpreted(value: T) -> T:
    """A kernel as a function that calls nothing but plain Python; of tuples and modules likewise, all else as it is.

    It is a copy with names of its own, where each kernel is such a copy too. Kernels and whoever calls them compiled do
    not know of it, so that both ways can be gone in one process and at the same time.
    """
    found: Any = value
    if type(found) is tuple:
        found = tuple(map(interpreted, found))
    elif isinstance(found, ModuleType) and any(isinstance(item, Kernel) for item in vars(found).values()):
        found = SimpleNamespace(**_names(vars(found)))
    elif isinstance(found, Kernel):
        if found not in _MADE:
            function: Any = found.py_func
            cells = tuple(CellType(interpreted(cell.cell_contents)) for cell in function.__closure__ or ())
            names = _names(function.__globals__)
            _MADE[found] = FunctionType(function.__code__, names, function.__name__, function.__defaults__, cells)
        found = _MADE[found]
    return found


def _names(known: dict[str, Any]) -> dict[str, Any]:
    if id(known) not in _NAMES:
        made = _NAMES[id(known)] = dict(known)
        made.update((name, interpreted(value)) for name, value in known.items())
    return _NAMES[id(known)]
