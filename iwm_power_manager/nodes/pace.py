# SPDX-License-Identifier: Apache-2.0
"""The power manager's main loop: a control step when it is due, ahead of the executor, and all else after it.

An executor that wakes for a timer first goes through all that it serves, some 200 us, before it calls it. Those are
better spent after the step. The timer stays an ordinary one: in another executor the node steps as well.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from rclpy.executors import SingleThreadedExecutor
from rclpy.timer import Timer

from iwm_power_manager.exit_codes import DONE
from iwm_power_manager.ros import ending
from iwm_power_manager.ros.interruption import Interruption

if TYPE_CHECKING:
    from iwm_power_manager.nodes.power_manager_node import PowerManager

_NS_PER_S = 1_000_000_000


def wait(timer: Timer) -> bool:
    """Sleep until a timer of real time is due and take that call from it; False at once if that is long from now."""
    left_ns = timer.time_until_next_call()
    if left_ns is None or left_ns > timer.timer_period_ns:
        return False  # the system's clock was set back: services and watchdog must not wait for it to catch up
    time.sleep(max(left_ns, 0) / _NS_PER_S)
    with timer.handle:
        timer.handle.call_timer()
    return True


def spin(node: PowerManager, interruption: Interruption) -> None:
    """Step in time and serve callbacks, until a signal asks to end."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while not interruption.requested and not node.start_failed:
        try:
            # What else is ready follows each step; where there are none the executor waits.
            executor.spin_once(timeout_sec=0.0 if node.step_when_due() else None)
        except Exception as error:  # noqa: BLE001 - whatever it is, the motors must not be left with a command
            node.fail(f"{type(error).__name__}: {error}")
    with ending.deadline(DONE, ending.SHORT_S):  # the command is out at once; what DDS does after it may take for ever
        node.stop()
        executor.shutdown()
