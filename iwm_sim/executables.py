# SPDX-License-Identifier: Apache-2.0
"""What the installed commands of this package run; see `iwm_power_manager.executables`."""

from __future__ import annotations

from iwm_power_manager.executables import INTERRUPTED, NODE_ENDED, run


def demo() -> int:
    """Command `demo`."""
    return run("iwm_sim.tools.demo", INTERRUPTED)


def evaluate() -> int:
    """Command `evaluate`."""
    return run("iwm_sim.tools.evaluate", INTERRUPTED)


def learn_policy() -> int:
    """Command `learn_policy`."""
    return run("iwm_sim.tools.learn", INTERRUPTED)


def precompile() -> int:
    """Command `precompile`."""
    return run("iwm_sim.tools.precompile", INTERRUPTED)


def simulator() -> int:
    """Node `simulator`."""
    return run("iwm_sim.simulator", NODE_ENDED)
