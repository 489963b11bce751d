# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C and SIGTERM in a program that has to finish what it does before it ends."""

from __future__ import annotations

import signal
import time

#: Longest sleep after which the flag is looked at.
_LOOK_S = 0.05


class Interruption:
    """Handler of SIGINT and SIGTERM: ends a start at once, and later only asks.

    Not a `threading.Event`: the handler runs in the main thread, between any two of its instructions, and an event that
    is set while its `wait` holds the inner lock waits for itself for ever.

    Parameters
    ----------
    started : there is no start to be ended

    Attributes
    ----------
    started : from now on nothing is interrupted: the program looks at `requested` when it suits
    requested : the program is to end
    """

    def __init__(self, *, started: bool = False) -> None:
        self.started = started
        self.requested = False

    def install(self) -> None:
        """Take over both signals; to be called from the main thread."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self)

    def __call__(self, _number: int, _frame: object) -> None:
        """Serve a signal; `KeyboardInterrupt` at the first one of a start, none while that is cleaned up."""
        first = not self.requested
        self.requested = True
        if first and not self.started:
            raise KeyboardInterrupt

    def wait(self, timeout_s: float) -> bool:
        """Sleep for so long, or until shortly after the program was asked to end; whether it was."""
        until_s = time.monotonic() + timeout_s
        while not self.requested and (left_s := until_s - time.monotonic()) > 0.0:
            time.sleep(min(left_s, _LOOK_S))
        return self.requested
