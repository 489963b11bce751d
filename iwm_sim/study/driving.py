# SPDX-License-Identifier: Apache-2.0
"""Driving many cases at once, on all cores."""

from __future__ import annotations

import dataclasses
import functools
import sys
from collections.abc import Callable, Sequence
from typing import Any

from tqdm import tqdm

from iwm_power_manager.tools.progress import Bar
from iwm_sim.cluster import on_all_cores
from iwm_sim.study import cases
from iwm_sim.study.cases import POLICY_STRATEGIES, Case, Result

#: How long a strategy takes beside equal split.
_WEIGHTS = {"equal": 1.0, "rule": 1.0, "sdp": 1.5, "instantaneous": 2.0, "preview": 4.0}
_OTHER_WEIGHT = 3.0
_SECONDS_PER_STEP = 1e-6
#: Of work: a process takes two seconds to come up, with what it imports.
_WORTH_A_PROCESS_S = 5.0

#: Long enough to run through every kernel of a drive.
_WARM_UP_S = 0.1


def warm_up(wanted: Sequence[Case]) -> None:
    """Compile in this process what the workers will then find in the cache, instead of each compiling the same."""
    seen = set()
    for case in wanted:
        kind = (case.strategy in POLICY_STRATEGIES, case.strategy == "preview")
        if kind not in seen:
            seen.add(kind)
            cases.drive(case, _WARM_UP_S)


def with_rules(wanted: Sequence[Case], jobs: int) -> list[Case]:
    """The cases, with strategy `rule`'s lines fitted where they are still missing, once for each car and road."""
    keys = {_rule_key(case): case for case in wanted if case.strategy == "rule" and not case.rule}
    rules = dict(zip(keys, on_all_cores(cases.fitted_rule, list(keys.values()), jobs), strict=True))
    return [
        dataclasses.replace(case, rule=rules[_rule_key(case)].coefficients)
        if _rule_key(case) in rules and not case.rule
        else case
        for case in wanted
    ]


def _rule_key(case: Case) -> tuple[Any, ...] | None:
    if case.strategy != "rule":
        return None
    return case.vehicle, case.idle_drive, case.car, case.law_friction, case.dt_s, case.soc


def drive_all(
    wanted: Sequence[Case],
    jobs: int,
    done: Callable[[Result], None] = lambda _: None,
    drive: Callable[[Case], Result] = cases.result,
) -> list[Result]:
    """Results of the cases, in their order; driven longest first, for the cores to finish together."""
    seconds = [seconds_of(case) for case in wanted]
    order = sorted(range(len(wanted)), key=lambda index: -seconds[index])
    jobs = min(jobs, round(sum(seconds) / _WORTH_A_PROCESS_S))
    made = on_all_cores(drive, [wanted[index] for index in order], jobs, done)
    return [result for _, result in sorted(zip(order, made, strict=True), key=lambda pair: pair[0])]


def seconds_of(case: Case) -> float:
    """About how long a processor needs for a case: steps, times what its strategy takes beside equal split."""
    steps = _duration_s(case.cycle) / case.dt_s
    return _SECONDS_PER_STEP * steps * _WEIGHTS.get(case.strategy, _OTHER_WEIGHT)


@functools.cache
def _duration_s(cycle: str) -> float:
    """Kept for more cycles than `cases` keeps: a study asks for each of its tasks, and drawing one takes 3 ms."""
    return cases.cycle_of(cycle).duration_s


class Progress(Bar):
    """A bar over cases."""

    def __init__(self, total: int, quiet: bool) -> None:
        super().__init__(total, "cases", quiet=quiet)

    def done(self, result: Result) -> None:
        """One more is done."""
        case = result.case
        self.set_postfix_str(f"{cases.cycle_of(case.cycle).name} {case.friction:g} {case.name}", refresh=False)
        self.update()


def tell(line: str) -> None:
    """Say something beside a bar."""
    tqdm.write(line, file=sys.stderr)


def silent(_: str) -> None:
    """Say nothing."""
