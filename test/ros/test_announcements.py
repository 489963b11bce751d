# SPDX-License-Identifier: Apache-2.0
"""What the log says, from plain numbers."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
import rclpy.logging

from iwm_power_manager.control.inputs import Violation
from iwm_power_manager.control.monitor import DEMAND, Tally
from iwm_power_manager.control.supervision import (
    MODE_DEGRADED,
    STALE_BATTERY,
    STALE_DEMAND,
    STALE_NAMES,
    STALE_SPEED,
    Supervision,
)
from iwm_power_manager.nodes.announcements import Announcements
from iwm_power_manager.ros.diagnostics import OK, WARN, Status

VALUES = {"missed_periods": 3, **{f"input_period_s.{name}": 0.01 for name in STALE_NAMES.values()}}


class Log:
    def __init__(self) -> None:
        self.lines: list[str] = []

    def info(self, text: str) -> None:
        self.lines.append(text)

    warning = info


@pytest.fixture
def log() -> Log:
    return Log()


def prepared(elapsed_s: float, compiled: int) -> Any:
    return SimpleNamespace(
        values=VALUES,
        vehicle=SimpleNamespace(name="car", hash="0" * 64),
        policies=SimpleNamespace(description=lambda: "no policy", fallback_reason=""),
        mapping=SimpleNamespace(commands={}),
        elapsed_s=elapsed_s,
        compiled=compiled,
    )


def test_an_input_that_is_back_already_is_named_with_its_age_and_its_limit(log: Log) -> None:
    says = Announcements(log)
    says.prepared(prepared(1.0, 0))
    says.late(STALE_SPEED | STALE_BATTERY, (0.052, 0.01, 0.01, math.inf))
    controller: Any = SimpleNamespace(
        supervision=Supervision(mode=MODE_DEGRADED),
        monitor=SimpleNamespace(tallies={name: Tally() for name in STALE_NAMES.values()}),
        command=None,
    )
    says.stepped(controller, {}, {}, (), 0, {})
    assert log.lines[-1] == (
        "degraded, motor torque fades: vehicle_speed was 0.052 s old (input_period_s 0.01, missed_periods 3), "
        "battery_state had not come yet"
    )


def test_inputs_that_come_and_go_while_it_is_degraded_do_not_fill_the_log(log: Log) -> None:
    says = Announcements(log)
    says.prepared(prepared(1.0, 0))
    before = len(log.lines)
    tallies = {name: Tally() for name in STALE_NAMES.values()}
    for i in range(100):
        controller: Any = SimpleNamespace(
            supervision=Supervision(mode=MODE_DEGRADED, stale=(STALE_SPEED, STALE_BATTERY)[i % 2]),
            monitor=SimpleNamespace(tallies=tallies),
            command=None,
        )
        says.stepped(controller, {}, {}, (), 0, {})
    names = ("vehicle_speed", "battery_state")
    assert log.lines[before:] == [f"degraded, motor torque fades: {name}" for name in names]


@pytest.mark.parametrize(("compiled", "words"), [(0, "no kernels compiled"), (7, "7 kernels compiled")])
def test_a_slow_start_says_whether_it_compiled(log: Log, compiled: int, words: str) -> None:
    says = Announcements(log)
    says.preparing(4.0)
    says.prepared(prepared(4.2, compiled))
    assert log.lines[:2] == [
        "preparing for 4 s so far; minutes only where precompile was not run",
        f"prepared in 4.2 s, {words}",
    ]


def test_an_odd_pedal_is_told_once_and_warned_of_where_it_is_sure(log: Log) -> None:
    says = Announcements(log)
    warnings: list[str] = []
    log.warning = warnings.append  # type: ignore[method-assign]
    for shown in ("0.2 %", "0.3 %"):
        says.pedals({"brake_pedal": (True, f"brake {shown}"), "accelerator_pedal": (False, f"accelerator {shown}")})
    assert (log.lines, warnings) == (["accelerator 0.2 %"], ["brake 0.2 %"])


def test_of_two_pedals_the_log_names_the_silent_one(log: Log) -> None:
    says = Announcements(log)
    says.prepared(prepared(1.0, 0))
    tallies = {name: Tally() for name in STALE_NAMES.values()}
    tallies[DEMAND].note(Violation.NONE, 960_000_000)
    controller: Any = SimpleNamespace(
        supervision=Supervision(mode=MODE_DEGRADED, stale=STALE_DEMAND),
        monitor=SimpleNamespace(tallies=tallies),
        command=None,
    )
    heard_ns = {"/accelerator": 990_000_000, "/brake": 960_000_000}
    says.stepped(controller, {DEMAND: tuple(heard_ns)}, {}, (), 1_000_000_000, heard_ns)
    assert log.lines[-1] == "degraded, motor torque fades: power_demand on /brake (none for 0.04 s)"


def test_refused_messages_are_counted_by_their_reason_and_a_described_one_names_its_topic_itself(log: Log) -> None:
    says = Announcements(log)
    says.prepared(prepared(1.0, 0))
    tallies = {name: Tally() for name in STALE_NAMES.values()}
    tallies[DEMAND].describe = lambda: "accelerator_pedal 300 % on accelerator; allowed: 0 to 100"
    before = (Violation.OUT_OF_RANGE, Violation.NONE)  # which is over
    for violation in (*before, Violation.LATE, Violation.LATE, Violation.NOT_FINITE, Violation.OUT_OF_RANGE):
        tallies[DEMAND].note(violation, 0)
    controller: Any = SimpleNamespace(
        supervision=Supervision(mode=MODE_DEGRADED, stale=STALE_DEMAND),
        monitor=SimpleNamespace(tallies=tallies),
        command=None,
    )
    says.stepped(controller, {DEMAND: ("/accelerator", "/brake")}, {}, (), 0, {})
    assert log.lines[-1] == (
        "degraded, motor torque fades: power_demand (1 messages refused, "
        "out of range: accelerator_pedal 300 % on accelerator; allowed: 0 to 100)"
    )


def test_commands_that_nobody_obeys_are_told_seldom_and_once_that_somebody_does(
    log: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = 1000.0
    monkeypatch.setattr("time.monotonic", lambda: now_s)
    says = Announcements(log)
    for second in range(40):
        now_s = 1000.0 + second
        says.commands(["/motors", "/brakes"])
    line = "nobody subscribes to /motors, /brakes: its commands move nothing"
    assert log.lines == [line, line]
    for _ in range(3):
        says.commands(["/brakes"])
    assert log.lines[2:] == ["somebody subscribes to /motors now"]


def test_who_obeys_within_a_moment_of_activation_is_no_news(log: Log) -> None:
    says = Announcements(log)
    says.commands(["/motors"])
    says.commands([])
    assert log.lines == []


def test_the_log_of_ros_takes_warnings_and_remarks_on_the_same_thing() -> None:
    says = Announcements(rclpy.logging.get_logger("announcements"))
    says.pedals({"brake_pedal": (True, "surely in %"), "accelerator_pedal": (False, "perhaps in %")})
    says.law(Status("law", WARN, "plain Python", {}))
    says.law(Status("law", OK, "compiled", {}))


def test_how_the_law_is_run_is_told_when_it_changes(log: Log) -> None:
    says = Announcements(log)
    for message in ("plain Python", "plain Python", "compiled", "compiled"):
        says.law(Status("law", OK, message, {}))
    assert log.lines == ["law: plain Python", "law: compiled"]
