# SPDX-License-Identifier: Apache-2.0
"""The one numba decorator of the project.

A kernel is compiled when it is first called, so importing one costs nothing and `--help` never waits for a compiler.
It is compiled in two ways. Called by another kernel, it is only code to be linked into that one. Called from Python, it
becomes an entry point: with the wrapper that turns Python objects into numbers, and kept on disk (`kernel_cache`). Most
kernels are never called from Python, and the wrappers around the car's many numbers take longer to compile than the
kernels.

Arithmetic stays IEEE (no `fastmath`), so that the same step gives the same bits whether it is called from Python or
inlined into a loop.
"""

from __future__ import annotations

import functools
import os
import threading
import time
from collections.abc import Callable
from typing import Any, TypeVar

F = TypeVar("F", bound=Callable[..., Any])

#: Before the first kernel was imported: sources that changed later are not those that run. File systems stamp a change
#: with a clock that lags by up to a tick.
STARTED_NS = time.time_ns() - 20_000_000

_BUILDING = threading.RLock()

#: What shows the user what is being compiled: `begin(kernel, functions)`, then `ready()` for each of them, and `end()`.
watch: Any = None


class Kernel:
    """A function that numba compiles when it is needed.

    Attributes
    ----------
    py_func : the function in plain Python
    releases_lock : it runs without the interpreter's lock
    """

    def __init__(self, function: Callable[..., Any], releases_lock: bool) -> None:
        functools.update_wrapper(self, function)
        self.py_func = function
        self.releases_lock = releases_lock
        self._entry: Callable[..., Any] | None = None
        self._part: Any = None

    def __call__(self, *args: Any, **options: Any) -> Any:
        """Run the compiled function."""
        return (self._entry or self.entry())(*args, **options)

    def entry(self) -> Callable[..., Any]:
        """The function as Python calls it: numba's dispatcher."""
        with _BUILDING:
            if self._entry is None:
                from iwm_power_manager import compilation

                self._entry = compilation.entry_point(self)
        return self._entry

    @property
    def _numba_type_(self) -> Any:
        """What numba takes it for inside another kernel."""
        with _BUILDING:
            if self._part is None:
                from iwm_power_manager import compilation

                self._part = compilation.part(self)
        return self._part._numba_type_

    def __reduce__(self) -> str:
        """Pickled by its name, like any function."""
        return str(self.py_func.__qualname__)

    def __repr__(self) -> str:
        """Its full name."""
        return f"<kernel {self.py_func.__module__}.{self.py_func.__qualname__}>"


def _kernel(function: F, releases_lock: bool) -> F:
    if os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0"):
        return function
    return Kernel(function, releases_lock)  # type: ignore[return-value]


def kernel(function: F) -> F:
    """Compile `function` with numba when it is called, kept on disk for exactly these sources."""
    return _kernel(function, releases_lock=False)


def parallel_kernel(function: F) -> F:
    """As `kernel`, but it runs without the interpreter's lock: threads can work on separate parts of its output.

    Not for the control law, which would have to wait for the lock after every step.
    """
    return _kernel(function, releases_lock=True)
