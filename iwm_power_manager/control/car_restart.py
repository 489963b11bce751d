# SPDX-License-Identifier: Apache-2.0
"""Whether the car itself was started over while nobody looked: a bench, a simulator, a bag.

The law does not believe five speeds that suddenly stand: a control unit that died shows zeros, too, and so do wheels
that are locked. That is right as long as messages come. But where `vehicle_speed` and the wheels stayed away (or the
clock was set back), and all of them stand when they are back, and nobody asks to brake, the motion before is over:
without brakes the wheels of a moving car turn, on the smoothest ice after a tenth of a second. No single sensor that is
wrong can make it so.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from iwm_power_manager.control.motion import DOUBT_SPEED
from iwm_power_manager.control.motion_vote import STANDING_MPS
from iwm_power_manager.control.supervision import STALE_SPEED, STALE_WHEELS

if TYPE_CHECKING:
    from iwm_power_manager.control.controller import Controller

#: Longer than messages are held up on their way; long enough for brakes to let go and for wheels to turn.
AWAY_S, STANDS_S = 0.5, 1.0
_ALL = 2 * DOUBT_SPEED - 1
_NS_PER_S = 1e9


class CarRestart:
    """Watches for it.

    Attributes
    ----------
    found : the run that knows another motion should begin anew
    """

    def __init__(self) -> None:
        self.found = False
        self._away = False
        self._stands_since_ns: int | None = None

    def look(self, controller: Controller, now_ns: int) -> None:
        """Look at what the controller knows after a step."""
        monitor, command, stale = controller.monitor, controller.command, controller.supervision.stale
        if stale & STALE_SPEED and stale & STALE_WHEELS:
            self._away |= min(monitor.ages_s(now_ns)[:2]) > AWAY_S
        elif command is None or command.doubted == 0:
            self._away = False
        stands = (
            self._away
            and command is not None
            and command.doubted == _ALL
            and stale == controller.wheels_lost == 0
            and monitor.demand_w >= 0.0
            and max(map(abs, monitor.shown_mps)) <= STANDING_MPS
        )
        if not stands:
            self._stands_since_ns = None
        elif self._stands_since_ns is None:
            self._stands_since_ns = now_ns
        else:
            self.found = now_ns - self._stands_since_ns >= STANDS_S * _NS_PER_S
