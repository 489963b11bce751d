# SPDX-License-Identifier: Apache-2.0
"""Values that stay in the compiled code's own form from call to call.

A car is a hundred numbers, and so is what the law remembers. Making numbers of Python objects and objects of numbers
takes many times longer than a step of the law, and the objects make the garbage collector run. A kernel that is given
a `Held` reads and writes `held.value` like a field.
"""

from __future__ import annotations

from typing import Any, cast

from iwm_power_manager.jit import Kernel, kernel


class Held[Value]:
    """One value, for Python and for kernels; whatever takes its place has to be of the same types.

    Parameters
    ----------
    value : nested tuples of numbers and arrays; of the arrays only the address is held, and that they are not freed

    Raises
    ------
    TypeError
        A value of other types was to take its place.
    """

    def __init__(self, value: Value) -> None:
        if isinstance(_put, Kernel):
            from iwm_power_manager import held_type

            self._numba_type_ = held_type.of(value)
            self._buffer, self.address = held_type.memory_for(self._numba_type_)
        self.value = value

    @property
    def value(self) -> Value:
        """What it holds, as Python objects."""
        return cast("Value", _get(self)) if isinstance(_get, Kernel) else self._source

    @value.setter
    def value(self, value: Value) -> None:
        if isinstance(_put, Kernel):
            from iwm_power_manager import held_type

            if held_type.of(value) != self._numba_type_:
                raise TypeError(f"{type(value).__name__} of other types than {self._numba_type_}")
            _put(self, value)
        self._source = value


@kernel
def _put(held: Any, value: Any) -> None:
    held.value = value


@kernel
def _get(held: Any) -> Any:
    return held.value
