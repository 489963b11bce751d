# SPDX-License-Identifier: Apache-2.0
"""Names and numbers that the command line needs before anything is driven."""

from __future__ import annotations

import os

#: Every saving is against this one.
REFERENCE = "equal"

#: Grid of a policy that is solved because none was found.
DEFAULT_GRID = "coupled"

#: The largest control step of a case: beyond it, the law's time constants mean nothing.
MAX_DT_S = 0.1

#: Tables of the paper that can be driven alone, and their frictions.
TABLES = {"3": (0.9,), "4": (0.5,), "5": (0.2,), "6": (0.9, 0.5, 0.2)}

#: Figures that can be drawn alone.
FIGURES = ("7", "8", "9", "10", "12", "13", "14", "15", "transitions", "frontier")


def cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0))
