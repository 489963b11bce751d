"""Quality of service of the topics.

Real time follows Autoware's convention for commands and status: reliable, volatile, keep the last one; a control loop
wants the newest value, not a queue of old ones. In lock-step every message counts, so the queue is deep enough that
none can be overwritten while one side is busy.
"""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

REAL_TIME_DEPTH = 1
LOCKSTEP_DEPTH = 100

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
