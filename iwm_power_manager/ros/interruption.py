"""Ctrl-C and SIGTERM in a node that has to finish what it does before it ends."""

from __future__ import annotations

import signal


class Interruption:
    """Handler of SIGINT and SIGTERM: ends a start at once, and later only asks.

    Attributes
    ----------
    started : from now on nothing is interrupted: the node looks at `requested` between two callbacks
    requested : the node is to end
    """

    def __init__(self) -> None:
        self.started = False
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
