# SPDX-License-Identifier: Apache-2.0
"""The paper's strategy under names of its own: a strategy with the grid, the decision period and the gate it is for."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from iwm_power_manager.control.settings import GATE_MODES, Settings

if TYPE_CHECKING:
    from iwm_sim.study.cases import Case

#: The paper decides every 0.1 s.
PAPER_PERIOD_S = 0.1


def with_gate(settings: Settings, gate_mode: str) -> Settings:
    """Settings of the law with a skid avoidance by its name; `table2` is as printed."""
    settings = settings._replace(gate_mode=GATE_MODES[gate_mode])
    return settings._replace(gate_hysteresis=0.0, gate_driving=False) if gate_mode == "table2" else settings


class Variant(NamedTuple):
    """A strategy with what belongs to it.

    Attributes
    ----------
    meaning : in half a sentence
    strategy : name in `STRATEGIES`
    grid : preset of its policy
    gate_mode : skid avoidance; "" leaves it as it is
    """

    meaning: str
    strategy: str
    grid: str
    gate_mode: str = ""

    def settings(self, settings: Settings) -> Settings:
        """Settings of the law with this variant's in place."""
        settings = settings._replace(decision_period_s=PAPER_PERIOD_S)
        return with_gate(settings, self.gate_mode) if self.gate_mode else settings

    def case(self, base: Case, name: str, policy: str = "") -> Case:
        """A case driven with this variant, under its name."""
        return replace(base, strategy=self.strategy, label=name, policy=policy, settings=self.settings(base.settings))


VARIANTS = {
    "paper_sdp": Variant(
        "the paper's problem on its grid, decided every 0.1 s, under our slip limiter", "sdp", "paper"
    ),
    "paper_sdp_ungated": Variant(
        "the same, solved and driven without skid avoidance", "sdp", "paper_without_skid_avoidance", "off"
    ),
    "paper_sdp_table2": Variant("the same with skid avoidance as Table 2 prints it", "sdp", "paper", "table2"),
}
