# SPDX-License-Identifier: Apache-2.0
"""Names and numbers that the command line needs before anything is driven."""

from __future__ import annotations

import os

#: Every saving is against this one.
REFERENCE = "equal"

#: The package's own folder of policies.
DEFAULT_POLICY = "policies"

#: Grid of a policy that is solved because none was found.
DEFAULT_GRID = "coupled"

#: The largest control step of a case: beyond it, the law's time constants mean nothing.
MAX_DT_S = 0.1

#: Tables of the paper that can be driven alone, and their frictions.
TABLES = {"3": (0.9,), "4": (0.5,), "5": (0.2,), "6": (0.9, 0.5, 0.2)}

#: Figures that can be drawn alone, each with the options that it heeds beside those of all.
FIGURES: dict[str, frozenset[str]] = {
    **dict.fromkeys(("7", "8", "9", "10", "12"), frozenset()),
    "13": frozenset({"--jobs"}),
    **dict.fromkeys(("14", "15"), frozenset({"--policy", "--jobs"})),
    **dict.fromkeys(("transitions", "frontier"), frozenset()),
}

#: Figures of the paper that show no result, and what they show.
NO_RESULTS = {
    "1": "a sketch of such a car",
    "2": "a picture of a motor's parts",
    "3": "a sketch of the forces on a car",
    "4": "the tyre's formula (docs/model.md)",
    "5": "motor maps that the paper took from another program and does not print as numbers",
    "6": "a circuit diagram",
    "11": "a flow chart of policy iteration (docs/solver.md)",
}


def cores() -> int:
    """Cores this process may use."""
    return len(os.sched_getaffinity(0))
