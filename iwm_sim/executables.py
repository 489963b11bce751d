# SPDX-License-Identifier: Apache-2.0
"""What the installed commands of this package run; see `iwm_power_manager.executables`."""

from __future__ import annotations

from functools import partial

from iwm_power_manager.executables import run
from iwm_power_manager.exit_codes import DONE, INTERRUPTED

demo = partial(run, "iwm_sim.tools.demo", INTERRUPTED)
evaluate = partial(run, "iwm_sim.tools.evaluate", INTERRUPTED)
fleet = partial(run, "iwm_sim.tools.fleet", INTERRUPTED)
learn_policy = partial(run, "iwm_sim.tools.learn", INTERRUPTED)
precompile = partial(run, "iwm_sim.tools.precompile", INTERRUPTED)
simulator = partial(run, "iwm_sim.simulator", DONE)
