# SPDX-License-Identifier: Apache-2.0
"""Somebody publishes an input beside the car: it is told, the brakes stay, and the car's own messages come back."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from bench import Bench
from diagnostic_msgs.msg import DiagnosticStatus
from rolling_car import RADIUS_M, STAMPED_DEMAND, RollingCar, SteppedCar

from iwm_power_manager.control.thresholds import Thresholds
from iwm_power_manager.ros import messages, qos
from iwm_power_manager.share import share_path

T = Thresholds()
BRAKE_W = -20e3
#: What a walk comes to, and how fast it goes: at the limit of what is believed of a car.
RATE_MPS2 = 0.9 * T.speed_rate_mps2
#: What docs/safety.md allows a wrong sensor, and the steps it takes until the car obeys.
LOST_S = 0.3 + 0.05
#: The part of the braking asked for that counts as braking.
ENOUGH = 0.85


class Intruder:
    """A second publisher of an input.

    Parameters
    ----------
    bench : whose node it borrows
    topic, make : of the input, and the message it sends each time, of the present stamp and the time since it began
    """

    def __init__(self, bench: Bench, topic: str, make: Callable[[int, float], Any]) -> None:
        self._bench, self._make = bench, make
        self.publisher = bench.node.create_publisher(messages.TOPIC_TYPES[topic], topic, qos.profile(lockstep=False))
        self._began_ns = bench.stamp()

    def since_s(self) -> float:
        """Time since it began, of the bench's clock."""
        return (self._bench.stamp() - self._began_ns) * 1e-9

    def __call__(self) -> None:
        self.publisher.publish(self._make(self._bench.stamp(), self.since_s()))


@pytest.fixture
def car(start_pair: Any) -> RollingCar:
    pair = start_pair()
    pair.bench.connect()
    pair.bench.running = pair.running
    found = RollingCar(pair.bench, 25.0)
    found.roll(lambda: pair.bench.mode() == 1, "normal operation", lambda: 2000.0)
    return found


@pytest.fixture
def stepped(start_pair: Any, tmp_path: Path) -> SteppedCar:
    signals = tmp_path / "signals.yaml"
    standard = share_path("config/signals/standard.yaml").read_text()
    before, after = "{topic: power_demand, type: std_msgs/msg/Float64, field: data", STAMPED_DEMAND
    assert before in standard
    signals.write_text(standard.replace(before, after))
    pair = start_pair({"signals_file": signals, "clock_stopped_s": 10.0}, sim_time=True)
    found = SteppedCar(pair.bench, 25.0)
    found.roll(lambda: pair.bench.mode() == 1, "normal operation", lambda: 2000.0)
    return found


def braking_share(car: RollingCar) -> float:
    """Braking torque that is commanded, as part of what is asked for at the speed the car has."""
    if not (car.motors and car.brakes):
        return 0.0  # the car has not heard a command yet
    commanded = car.motors[-1].torque_nm + car.brakes[-1].torque_nm
    return commanded / (BRAKE_W / car.speed_mps * RADIUS_M)


def lost_s(car: RollingCar, intruder: Intruder, note: Callable[[float], None] = lambda _: None) -> float:
    """Longest time without 85 % of the braking asked for, while the intruder is there."""
    longest_s, began_s = 0.0, 0.0

    def beside() -> None:
        nonlocal longest_s, began_s
        intruder()
        now_s = intruder.since_s()
        if braking_share(car) >= ENOUGH:
            began_s = now_s
        longest_s = max(longest_s, now_s - began_s)
        note(now_s)

    car.roll(lambda: intruder.since_s() > 2.5, "a while", lambda: BRAKE_W, beside)
    return longest_s


def test_a_second_publisher_is_told_in_log_and_diagnostics_for_every_input(car: RollingCar) -> None:
    bench = car.bench
    inputs = (messages.VEHICLE_SPEED, messages.WHEEL_STATES, messages.POWER_DEMAND, messages.BATTERY_STATE)
    others = [
        bench.node.create_publisher(messages.TOPIC_TYPES[topic], topic, qos.profile(lockstep=False))
        for topic in (*inputs, messages.ROAD_FRICTION)
    ]

    name = bench.node.get_fully_qualified_name()

    def told() -> bool:
        status = bench.status("input topics")
        return (
            status is not None
            and status.message.endswith(f"have 2 publishers each: {name}, {name}")
            and all(p.topic_name in status.message for p in others)
        )

    car.roll(told, "the warning", lambda: 0.0)
    assert bench.status("input topics").level == DiagnosticStatus.WARN

    def said(what: str) -> list[str]:
        return [line for line in Path(bench.running.output).read_text().splitlines() if what in line]

    car.roll(lambda: said("have 2 publishers each"), "the line in the log", lambda: 0.0)
    (line,) = said("have 2 publishers each")
    assert all(publisher.topic_name in line for publisher in others)
    for publisher in others:
        bench.node.destroy_publisher(publisher)
    car.roll(lambda: not bench.status("input topics") or bench.diagnostics.clear(), "quiet again", lambda: 0.0)
    car.roll(lambda: said(": over: "), "the line that says so", lambda: 0.0)


@pytest.mark.parametrize("ahead_s", [0.0, 0.015], ids=["", "stamped ahead"])
@pytest.mark.parametrize("sign", [-1.0, 1.0], ids=["down", "up"])
def test_a_speed_that_walks_away_takes_no_brakes_and_is_not_believed_for_ever(
    stepped: SteppedCar, sign: float, ahead_s: float
) -> None:
    car, bench = stepped, stepped.bench

    def make(stamp_ns: int, since_s: float) -> Any:
        speed = min(max(car.speed_mps + sign * RATE_MPS2 * since_s, 0.0), 50.0)
        return messages.vehicle_speed_message(stamp_ns + int(ahead_s * 1e9), speed)

    car.roll(lambda: braking_share(car) >= ENOUGH, "the brakes", lambda: BRAKE_W)
    believed: list[tuple[float, bool]] = []

    def note(since_s: float) -> None:
        believed.append((since_s, abs(bench.last("speed_mps") - car.speed_mps) < 1.5))

    assert lost_s(car, Intruder(bench, messages.VEHICLE_SPEED, make), note) <= LOST_S
    # The walk is out of what is believed after 0.3 s; the car's own messages have to be back within rival_s, and stay.
    late = [good for since_s, good in believed if since_s > 1.5]
    assert sum(late) > 0.9 * len(late)


@pytest.mark.parametrize(
    ("topic", "make"),
    [
        (
            messages.WHEEL_STATES,
            lambda stamp, since: messages.wheel_states_message(
                stamp, messages.WHEEL_NAMES, (max(70.0 - 60.0 * since, 0.0),) * 4, (0.0,) * 4
            ),
        ),
        (
            messages.BATTERY_STATE,
            lambda stamp, since: messages.battery_state_message(
                stamp, soc=min(0.5 + 0.25 * since, 1.0), voltage_v=237.0, discharge_current_a=0.0, temperature_c=25.0
            ),
        ),
    ],
    ids=["wheels", "battery"],
)
def test_no_second_publisher_of_a_sensor_takes_the_brakes(stepped: SteppedCar, topic: str, make: Any) -> None:
    stepped.roll(lambda: braking_share(stepped) >= ENOUGH, "the brakes", lambda: BRAKE_W)
    assert lost_s(stepped, Intruder(stepped.bench, topic, make)) <= LOST_S
