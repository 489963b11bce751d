# SPDX-License-Identifier: Apache-2.0
"""Whether anybody obeys the power manager: a car that listens on another topic is told, who only watches is no car."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from member import Member

from iwm_power_manager.ros import messages

MOTORS, BRAKES = messages.WHEEL_TORQUE_COMMAND, messages.FRICTION_BRAKE_COMMAND


@pytest.fixture
def member() -> Any:
    made: list[Member] = []

    def make(name: str, namespace: str) -> Member:
        made.append(Member(name, namespace))
        return made[-1]

    yield make
    for one in made:
        one.close()


def test_commands_that_nobody_obeys_are_told_until_somebody_does(
    start_own: Callable[..., Any], member: Callable[[str, str], Member]
) -> None:
    """The car listens on `wheels/effort`, a recorder to everything."""
    pair = start_own(remaps={MOTORS: "motors/torque"})
    bench, running = pair.bench, pair.running
    namespace = bench.node.get_namespace()
    joints = messages.TOPIC_TYPES[MOTORS]
    member("watch_car", namespace).node.create_subscription(joints, "motors/torque", lambda _: None, 1)
    topic = f"{namespace}/motors/torque"
    told, over = f"nobody subscribes to {topic}: its commands move nothing", f"somebody subscribes to {topic} now"
    bench.drive(lambda: told in running.text(), "the warning")

    def says(words: str, level: bytes, count: str) -> bool:
        status = bench.status("command topics")
        values = {pair.key: pair.value for pair in status.values}
        return (status.message, status.level, values[f"{topic}: subscriptions"]) == (words, level, count)

    bench.drive(lambda: says(f"nobody subscribes to {topic}", DiagnosticStatus.WARN, "0"), "the status")
    member("car", namespace).node.create_subscription(joints, "motors/torque", lambda _: None, 1)
    bench.drive(lambda: over in running.text(), "that it is over")
    bench.drive(lambda: says("ok", DiagnosticStatus.OK, "1"), "the status that it is well")
    assert running.text().count(over) == 1
    assert f"{namespace}/{BRAKES}" not in running.text().split(told)[1]
