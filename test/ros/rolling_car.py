# SPDX-License-Identifier: Apache-2.0
"""A car for the bench: a mass that obeys the torques of the power manager and shows its speed and its wheels'."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

from bench import PATIENCE_S, Bench
from geometry_msgs.msg import Point, PointStamped
from sensor_msgs.msg import JointState

from iwm_power_manager.ros import messages, qos

MASS_KG, RADIUS_M, LOAD_N = 820.0, 0.33, 450.0
#: As real motor controllers have it: torque ends when no command comes.
TIME_OUT_S = 0.1
_PERIOD_S = 0.01
#: How a signals file names the demand of a `SteppedCar`, which has a stamp: a Float64 is judged by the machine's clock.
STAMPED_DEMAND = "{topic: stamped_demand, type: geometry_msgs/msg/PointStamped, field: point.x"


class Heard(NamedTuple):
    """One command: torque over all wheels, N m, and when it was decided, sent and received, system ns."""

    torque_nm: float
    stamp_ns: int
    sent_ns: int
    received_ns: int


class RollingCar:
    """A car in a bench.

    Parameters
    ----------
    bench : whose topics it uses
    speed_mps : at the start; the road takes `LOAD_N`

    Attributes
    ----------
    motors, brakes : commands heard
    """

    def __init__(self, bench: Bench, speed_mps: float) -> None:
        self.bench = bench
        self.speed_mps = speed_mps
        self.motors: list[Heard] = []
        self.brakes: list[Heard] = []
        keep_all = qos.profile(lockstep=True)
        for topic, heard in (
            (messages.WHEEL_TORQUE_COMMAND, self.motors),
            (messages.FRICTION_BRAKE_COMMAND, self.brakes),
        ):
            bench.node.create_subscription(JointState, topic, self._noting(heard), keep_all)

    def _noting(self, heard: list[Heard]) -> Callable[[JointState, dict[str, int]], None]:
        def note(message: JointState, info: dict[str, int]) -> None:
            stamp = messages.stamp_to_ns(message.header.stamp)
            heard.append(Heard(sum(message.effort), stamp, info["source_timestamp"], info["received_timestamp"]))

        return note

    def situation(self) -> str:
        """What is known, for whoever waits in vain."""
        state = self.bench.states[-1] if self.bench.states else {}
        said = [f"{s.name}: {s.message}" for array in self.bench.diagnostics[-1:] for s in array.status]
        return f"{self.speed_mps:.2f} m/s; {self.motors[-1:]} {self.brakes[-1:]} {state} {said}"

    def force_n(self) -> float:
        """What the commands that are in force make of the road."""
        now_ns = time.time_ns()
        fresh = [
            h[-1].torque_nm for h in (self.motors, self.brakes) if h and now_ns - h[-1].received_ns < TIME_OUT_S * 1e9
        ]
        return sum(fresh) / RADIUS_M

    def roll(
        self,
        condition: Callable[[], Any],
        what: str,
        demand_w: Callable[[], float],
        beside: Callable[[], None] = lambda: None,
        patience_s: float = PATIENCE_S,
    ) -> Any:
        """Drive in real time, and show what the sensors see, until `condition` is true; returns what it returned.

        Parameters
        ----------
        condition, what : to wait for
        demand_w : power the driver asks for
        beside : called in each period, for whoever disturbs
        """
        began = due = time.monotonic()
        while not (found := condition()):
            now = time.monotonic()
            assert now - began < patience_s, f"waited in vain for {what}; {self.situation()}"
            if now >= due:
                self.speed_mps = max(self.speed_mps + (self.force_n() - LOAD_N) / MASS_KG * _PERIOD_S, 2.0)
                self.bench.send(speed=self.speed_mps, demand=demand_w())
                beside()
                due = max(due + _PERIOD_S, now)
            self.bench.executor.spin_once(timeout_sec=max(due - time.monotonic(), 0.0))
        return found


class SteppedCar(RollingCar):
    """The car in simulated time, which waits for each step: what it measures does not depend on the machine."""

    def __init__(self, bench: Bench, speed_mps: float) -> None:
        super().__init__(bench, speed_mps)
        self._demand = bench.node.create_publisher(PointStamped, "stamped_demand", qos.profile(lockstep=False))

    def force_n(self) -> float:
        """What the last commands make of the road."""
        return sum(heard[-1].torque_nm for heard in (self.motors, self.brakes) if heard) / RADIUS_M

    def roll(
        self,
        condition: Callable[[], Any],
        what: str,
        demand_w: Callable[[], float],
        beside: Callable[[], None] = lambda: None,
        patience_s: float = PATIENCE_S,
    ) -> Any:
        """As a `RollingCar` does, a period for each step that is answered."""
        bench, began = self.bench, time.monotonic()
        while not (found := condition()):
            assert time.monotonic() - began < patience_s, f"waited in vain for {what}; {self.situation()}"
            self.speed_mps = max(self.speed_mps + (self.force_n() - LOAD_N) / MASS_KG * _PERIOD_S, 2.0)
            bench.now_ns += int(_PERIOD_S * 1e9)
            stamp_ns = bench.send(speed=self.speed_mps, without=(messages.POWER_DEMAND,))
            demand = PointStamped(point=Point(x=demand_w()))
            demand.header.stamp = messages.ns_to_stamp(stamp_ns)
            self._demand.publish(demand)
            beside()
            bench.publish(messages.CLOCK, messages.clock_message(stamp_ns))
            until = time.monotonic() + (1.0 if bench.states else _PERIOD_S)  # one that is lost is not waited for
            while time.monotonic() < until and bench.state_stamps[-1:] < [stamp_ns]:
                bench.executor.spin_once(timeout_sec=until - time.monotonic())
        return found
