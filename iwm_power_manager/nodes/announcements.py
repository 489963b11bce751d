# SPDX-License-Identifier: Apache-2.0
"""What the power manager says in its log: a line for each step on its way, and one for each change of its mode."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from typing import Any

from iwm_power_manager.control.controller import Controller
from iwm_power_manager.control.inputs import WheelVerdict
from iwm_power_manager.control.monitor import BATTERY, DEMAND, FRICTION, SPEED, WHEELS
from iwm_power_manager.control.supervision import MODE_DEGRADED, MODE_NORMAL, MODE_WAITING, STALE_NAMES
from iwm_power_manager.nodes.neighbours import nobody_obeys
from iwm_power_manager.nodes.preparation import SLOW_S, Prepared
from iwm_power_manager.ros.diagnostics import OK, Status
from iwm_power_manager.signals import mapping

#: What the node waits for is said again after this time, and that nobody obeys it after the longer one.
REPEAT_S, SELDOM_S = 5.0, 30.0
#: A car that starts or dies changes what is there several times within this time.
SETTLED_S = 0.9

#: Which of the controller's inputs a signal is.
_INPUTS = (
    {"speed": SPEED, "wheel_speed": WHEELS, "friction": FRICTION}
    | dict.fromkeys((*mapping.DEMANDS, *mapping.PEDALS), DEMAND)
    | dict.fromkeys(mapping.BATTERY, BATTERY)
)


def input_topics(signals: mapping.SignalMapping) -> dict[str, tuple[str, ...]]:
    """Topics of each of the controller's inputs."""
    found: dict[str, dict[str, None]] = {}
    for signal, sources in signals.sources.items():
        if signal in _INPUTS:
            found.setdefault(_INPUTS[signal], {}).update(dict.fromkeys(source.topic for source in sources))
    return {name: tuple(topics) for name, topics in found.items()}


def silent_topics(
    topics: Sequence[str], trouble: Mapping[str, str], now_ns: int, heard_ns: Mapping[str, int]
) -> tuple[tuple[str, ...], str]:
    """Of the topics of an input those that are missing, and what is known of why (`Announcements.stepped`).

    Without a known reason they are those that are silent for more than half as long as the one silent longest.
    """
    ages_ns = {topic: now_ns - heard_ns.get(topic, 0) for topic in topics}
    silent = tuple(topic for topic in topics if topic in trouble)
    silent = silent or tuple(topic for topic, age_ns in ages_ns.items() if 2 * age_ns > max(ages_ns.values()))
    return silent, "; ".join(dict.fromkeys(trouble[topic] for topic in silent if topic in trouble))


class Announcements:
    """Speaks on a node's logger, each thing once.

    Parameters
    ----------
    logger : of the node
    """

    def __init__(self, logger: Any) -> None:
        self._logger = logger
        self._said: dict[str, float] = {}
        self._problems: set[str] = set()
        self._found_s: dict[str, float] = {}
        self._odd_pedals: set[str] = set()
        self._values: Mapping[str, Any] = {}
        self._law = ""
        self._heard_ns: Mapping[str, int] = {}
        self.activated()

    def activated(self) -> None:
        """Forget the modes of before."""
        self._mode = MODE_WAITING
        self._told: int | None = None  # bits of the inputs whose absence has been told
        self._was_degraded = False
        self._torque_seen = False
        self._late_s: dict[str, float] = {}
        self._unobeyed: set[str] = set()  # topics of which that has been told
        self._said.clear()
        self._said["waiting"] = time.monotonic() - REPEAT_S + 1.0  # inputs get a second to come before
        self._said["commands"] = time.monotonic() - SELDOM_S + 1.0

    def preparing(self, elapsed_s: float) -> None:
        """Tell that it takes long, again and again."""
        if elapsed_s > SLOW_S and self._due("preparing"):
            self._logger.info(f"preparing for {elapsed_s:.0f} s so far; minutes only where precompile was not run")

    def prepared(self, prepared: Prepared) -> None:
        """Tell what was loaded."""
        vehicle, policies = prepared.vehicle, prepared.policies
        self._values = prepared.values
        if prepared.elapsed_s > SLOW_S or prepared.compiled:
            self._logger.info(f"prepared in {prepared.elapsed_s:.1f} s, {prepared.compiled or 'no'} kernels compiled")
        self._logger.info(f"vehicle {vehicle.name} ({vehicle.hash[:12]}); {policies.description()}")
        if policies.fallback_reason:
            self._logger.warning(
                f"runs equal split instead of {prepared.values['strategy']}: {policies.fallback_reason}"
            )
        for kind, sinks in prepared.mapping.commands.items():
            if not sinks:
                self._logger.warning(
                    f"{kind} goes nowhere ({prepared.mapping.path}): the motors regenerate, another system has to brake"
                )

    def law(self, status: Status) -> None:
        """Tell how the law is run, whenever that changes."""
        if status.message != self._law:
            self._law = status.message
            self._say(f"law: {status.message}", status.level != OK)

    def interface(self, topics: Mapping[str, tuple[str, ...]], commands: list[str], rate: str) -> None:
        """Tell the topics the node listens to and commands on."""
        inputs = "; ".join(f"{name} from {', '.join(found)}" for name, found in topics.items())
        self._logger.info(f"configured, {rate}: {inputs}; commands to {', '.join(commands)}")

    def started_over(self, reason: str) -> None:
        """Tell why a run began anew by itself."""
        self._mode = MODE_WAITING
        self._said["waiting"] = time.monotonic() - REPEAT_S + 1.0
        if self._due(reason):
            self._logger.warning(f"{reason}: it starts over, as after activation")

    def commands(self, unobeyed: list[str]) -> None:
        """Tell now and then which topics of commands nobody subscribes to, and once that somebody does."""
        if found := sorted(self._unobeyed.difference(unobeyed)):
            self._logger.info(f"somebody subscribes to {', '.join(found)} now")
        self._unobeyed.intersection_update(unobeyed)
        if unobeyed and self._due("commands", SELDOM_S):
            self._logger.warning(f"{nobody_obeys(unobeyed)}: its commands move nothing")
            self._unobeyed.update(unobeyed)

    def pedals(self, remarks: Mapping[str, tuple[bool, str]]) -> None:
        """Tell once what is odd about each pedal, and warn of what is sure (`Assembly.remarks`)."""
        for pedal in remarks.keys() - self._odd_pedals:
            sure, text = remarks[pedal]
            self._say(text, sure)
        self._odd_pedals |= remarks.keys()

    def problems(self, found: list[str]) -> None:
        """Tell what is wrong with other endpoints, each line once it has stood for a moment, and that it is over."""
        now = time.monotonic()
        self._found_s = {line: self._found_s.get(line, now) for line in found}
        for line, since_s in self._found_s.items():
            if line not in self._problems and now - since_s >= SETTLED_S:
                self._logger.warning(line)
                self._problems.add(line)
        for line in sorted(self._problems.difference(found)):
            self._logger.info(f"over: {line}")
        self._problems.intersection_update(found)

    def stepped(
        self,
        controller: Controller,
        topics: Mapping[str, tuple[str, ...]],
        trouble: Mapping[str, str],
        wheel_names: Sequence[str],
        now_ns: int,
        heard_ns: Mapping[str, int],
    ) -> None:
        """Tell what has changed since the last call, while active.

        Parameters
        ----------
        controller : with its monitor
        topics : of each input
        trouble : why a topic is not heard, or not well, by topic
        wheel_names : the wheels in their order
        now_ns : the node's clock
        heard_ns : when the last message came on each topic, by that clock
        """
        self._heard_ns = heard_ns
        mode, stale = controller.supervision.mode, controller.supervision.stale
        if mode == MODE_WAITING and self._due("waiting"):
            waits = self._missing(controller, topics, trouble, ~0, now_ns)
            if waits:
                self._logger.info(f"waits for {waits}")
        if mode in (MODE_NORMAL, MODE_WAITING):
            self._told = None
        if mode == MODE_DEGRADED and (self._told is None or stale & ~self._told):
            self._told = stale | (self._told or 0)  # each once until all is well: flapping must not fill the log
            missing = self._missing(controller, topics, trouble, stale, now_ns) or self._was_late()
            self._logger.warning(f"degraded, motor torque fades: {missing}")
        elif mode == MODE_NORMAL and mode != self._mode:
            self._logger.info(f"{'recovered' if self._was_degraded else 'all inputs are there'}: normal operation")
        if mode == MODE_NORMAL:
            self._late_s.clear()
            if not self._torque_seen and controller.command and any(controller.command.motor_torque_nm):
                self._torque_seen = True
                self._logger.info(f"first torque: {sum(controller.command.motor_torque_nm):.1f} N m over all wheels")
            self._lost_wheels(controller, wheel_names)
        self._was_degraded |= mode == MODE_DEGRADED
        self._mode = mode

    def late(self, stale: int, ages_s: Sequence[float]) -> None:
        """Remember how old the inputs were in a step that missed some of them."""
        for (bit, name), age_s in zip(STALE_NAMES.items(), ages_s, strict=True):
            if stale & bit:
                self._late_s[name] = age_s

    def _was_late(self) -> str:
        """What there is to say of inputs that are back already."""
        missed = self._values.get("missed_periods")
        return ", ".join(
            f"{name} had not come yet"
            if math.isinf(age_s)
            else f"{name} was {age_s:.3f} s old (input_period_s {self._values[f'input_period_s.{name}']:g}, "
            f"missed_periods {missed})"
            for name, age_s in self._late_s.items()
        )

    def _lost_wheels(self, controller: Controller, wheel_names: Sequence[str]) -> None:
        for name, verdict in zip(wheel_names, controller.monitor.verdicts, strict=True):
            if verdict is not WheelVerdict.GOOD and self._due(f"wheel {name}"):
                found = verdict.name.lower().replace("_", " ")
                self._logger.warning(f"wheel {name} is not believed ({found}): goes on with the others")

    def _missing(
        self,
        controller: Controller,
        topics: Mapping[str, tuple[str, ...]],
        trouble: Mapping[str, str],
        stale: int,
        now_ns: int,
    ) -> str:
        parts = []
        for bit, name in STALE_NAMES.items():
            tally = controller.monitor.tallies[name]
            found = topics.get(name, ())
            came = stale == ~0 and tally.accepted_ns is not None and not trouble.keys() & found
            if came or not stale & bit:
                continue
            silent, reason = silent_topics(found, trouble, now_ns, self._heard_ns)
            if not reason and tally.why():
                reason = f"{tally.in_a_row[tally.violation]} messages refused, {tally.why()}"
                found = () if name == DEMAND and tally.described() else found  # which says on what topic
            elif not reason and tally.received:
                age_s = tally.age_s(now_ns)
                reason = "none since it started over" if math.isinf(age_s) else f"none for {age_s:.2f} s"
            where = ", ".join(topic for topic in found and (silent or found) if topic != name)
            parts.append(f"{name}" + (f" on {where}" if where else "") + (f" ({reason})" if reason else ""))
        return ", ".join(parts)

    def _say(self, text: str, is_warning: bool) -> None:
        if is_warning:  # each in a line of its own: a line that logs at one level may not log at another one
            self._logger.warning(text)
        else:
            self._logger.info(text)

    def _due(self, what: str, every_s: float = REPEAT_S) -> bool:
        now = time.monotonic()
        if now - self._said.get(what, -math.inf) < every_s:
            return False
        self._said[what] = now
        return True
