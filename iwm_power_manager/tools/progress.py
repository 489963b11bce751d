# SPDX-License-Identifier: Apache-2.0
"""Progress of a command, on stderr."""

from __future__ import annotations

import sys
import threading
import time
from typing import Any

from tqdm import tqdm

from iwm_power_manager import jit

#: A log gets a line at each tenth, but none sooner than so long after the last; and one when nothing has moved so long.
_STEPS, _LEAST_S, _MOST_S = 10, 5.0, 30.0


class Bar(tqdm):  # type: ignore[type-arg]
    """A bar that is gone when it is done; in a log, which keeps what is drawn over, a plain line now and then.

    Parameters
    ----------
    total, unit, label : how much of what is to be done
    quiet : show nothing
    style : what `tqdm` takes
    """

    def __init__(self, total: float, unit: str, label: str = "", *, quiet: bool = False, **style: Any) -> None:
        self._in_log = not (quiet or sys.stderr.isatty())
        self._begun_s = self._said_s = time.monotonic()
        self._step = 0
        super().__init__(
            total=total, unit=unit, desc=label, file=sys.stderr, disable=quiet or self._in_log, leave=False, **style
        )
        self.desc, self.unit = label, unit

    def update(self, n: float | None = 1) -> bool | None:
        """So much more is done."""
        if not self._in_log:
            return super().update(n)
        self.n += n or 0
        self.refresh()
        return None

    def refresh(self, *args: Any, **kwargs: Any) -> None:
        """Show how far it is."""
        if not self._in_log:
            super().refresh(*args, **kwargs)
            return
        now_s, step = time.monotonic(), int(_STEPS * self.n / self.total) if self.total else 0
        if now_s >= self._said_s + (_LEAST_S if step > self._step else _MOST_S):
            self._said_s, self._step = now_s, step
            label = f"{self.desc}: " if self.desc else ""
            took = self.format_interval(now_s - self._begun_s)
            print(f"{label}{self.n:.0f} of {self.total:.0f} {self.unit} in {took}", file=sys.stderr, flush=True)


class _Compiling:
    """A bar for each kernel that is compiled, alive until the last of it is optimised."""

    def __init__(self) -> None:
        self._said = False
        self._bar, self._over = Bar(0, "", quiet=True), threading.Event()

    def begin(self, kernel: str, functions: int) -> None:
        """Show it; the first time, why there is something to wait for."""
        if not self._said:
            tqdm.write("compiling for this machine: a minute or some, once after an installation or update", sys.stderr)
        self._said = True
        self._bar, self._over = Bar(functions, "functions", f"compiling {kernel.split('.', 1)[-1]}"), threading.Event()
        threading.Thread(target=self._keep_alive, args=(self._bar, self._over), daemon=True).start()

    @staticmethod
    def _keep_alive(bar: Bar, over: threading.Event) -> None:
        while not over.wait(1.0):
            bar.refresh()

    def ready(self) -> None:
        """One more function."""
        self._bar.update()

    def end(self) -> None:
        """Take it away."""
        self._over.set()
        self._bar.close()


def show_compiling(*, quiet: bool = False) -> None:
    """Tell the user from now on what is compiled, and how far that is."""
    jit.watch = None if quiet else _Compiling()
