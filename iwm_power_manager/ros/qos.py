# SPDX-License-Identifier: Apache-2.0
"""Quality of service of the topics.

Real time follows Autoware's convention for commands and status: reliable, volatile, keep the last one; a control loop
wants the newest value, not a queue of old ones. Inputs are asked for best effort, which both kinds of publishers meet.
Commands offer a deadline and liveliness, so that who obeys them can have DDS tell when they stay away, and a lifespan:
DDS drops what comes later, at a subscriber that asks for it (Fast DDS) or at all of them (CycloneDDS). In lock-step
every message counts, so the queue is deep enough that none can be overwritten while one side is busy.
"""

from __future__ import annotations

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, HistoryPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy

REAL_TIME_DEPTH = 1
#: Three seconds of 600 steps: a recorder on a busy machine may be that far behind the loop it records.
LOCKSTEP_DEPTH = 2000
#: Of an input: a second publisher as fast as the car's must not push the car's own messages out.
INPUT_DEPTH = 4

RELIABILITIES = {"reliable": ReliabilityPolicy.RELIABLE, "best_effort": ReliabilityPolicy.BEST_EFFORT}


def profile(*, lockstep: bool, depth: int = 0, reliability: str = "reliable") -> QoSProfile:
    """Profile of a command, status or input topic.

    Parameters
    ----------
    lockstep : every message counts, not only the newest
    depth : messages kept; 0 chooses 1 in real time and `LOCKSTEP_DEPTH` in lock-step
    reliability : "reliable" or "best_effort" (to meet a publisher that offers no more)
    """
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth or (LOCKSTEP_DEPTH if lockstep else REAL_TIME_DEPTH),
        reliability=RELIABILITIES[reliability],
        durability=DurabilityPolicy.VOLATILE,
    )


#: Control periods after which a command is overdue, after which DDS drops it, and after which its node counts as dead.
DEADLINE_PERIODS, LIFESPAN_PERIODS, LEASE_PERIODS = 3.0, 5.0, 10.0


def command_profile(period_s: float | None) -> QoSProfile:
    """Profile of a command topic: reliable, with a deadline, a lifespan and the liveliness of its own writes.

    Parameters
    ----------
    period_s : control period; None in lock-step, where a command may take any time
    """
    if period_s is None:
        return profile(lockstep=True)
    found = profile(lockstep=False)
    found.deadline = Duration(seconds=DEADLINE_PERIODS * period_s)
    found.lifespan = Duration(seconds=LIFESPAN_PERIODS * period_s)
    found.liveliness = LivelinessPolicy.MANUAL_BY_TOPIC
    found.liveliness_lease_duration = Duration(seconds=LEASE_PERIODS * period_s)
    return found
