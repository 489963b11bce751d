# SPDX-License-Identifier: Apache-2.0
"""What the installed commands of this package run; see `iwm_power_manager.executables`."""

from __future__ import annotations

from functools import partial

from iwm_power_manager.executables import leave
from iwm_power_manager.exit_codes import DONE, INTERRUPTED

demo = partial(leave, "iwm_sim.tools.demo", INTERRUPTED)
evaluate = partial(leave, "iwm_sim.tools.evaluate", INTERRUPTED)
fleet = partial(leave, "iwm_sim.tools.fleet", INTERRUPTED)
learn_policy = partial(leave, "iwm_sim.tools.learn", INTERRUPTED)
precompile = partial(leave, "iwm_sim.tools.precompile", INTERRUPTED)
simulator = partial(leave, "iwm_sim.simulator", DONE)
