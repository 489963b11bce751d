# SPDX-License-Identifier: Apache-2.0
"""Driving many cases at once, on all cores."""

from __future__ import annotations

import dataclasses
import functools
import multiprocessing
import signal
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import Any, TypeVar

from tqdm import tqdm

from iwm_power_manager import kernel_cache
from iwm_sim.study import cases
from iwm_sim.study.cases import POLICY_STRATEGIES, Case, Result

Item = TypeVar("Item")
Made = TypeVar("Made")

#: How long a strategy takes beside equal split.
_WEIGHTS = {"equal": 1.0, "rule": 1.0, "sdp": 1.5, "instantaneous": 2.0, "preview": 4.0}
_OTHER_WEIGHT = 3.0

#: Long enough to run through every kernel of a drive.
_WARM_UP_S = 0.1


def on_all_cores(
    function: Callable[[Item], Made], items: Sequence[Item], jobs: int, done: Callable[[Made], object] = lambda _: None
) -> list[Made]:
    """`[function(item) for item in items]`, on `jobs` processes; `done` hears of each as it is ready.

    Parameters
    ----------
    function : can be pickled, as can the items
    items : the longest first gives the least idle time at the end
    jobs : processes; 1 stays in this one
    """
    made: dict[int, Made] = {}
    workers = min(jobs, len(items))
    if workers <= 1:
        for index, item in enumerate(items):
            made[index] = function(item)
            done(made[index])
        return list(made.values())
    # Not forked: a fork copies the locks of threads, but not the threads that would release them.
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _leave_interrupts_to_the_parent)
    try:
        futures = {pool.submit(function, item): index for index, item in enumerate(items)}
        for future in as_completed(futures):
            index = futures[future]
            made[index] = future.result()
            done(made[index])
    except BaseException:
        for process in list((pool._processes or {}).values()):
            process.terminate()
        # The pool's own thread collects what was ended; a second collector would race with it.
        pool.shutdown(wait=True, cancel_futures=True)
        raise
    pool.shutdown()
    return [made[index] for index in range(len(items))]


def _leave_interrupts_to_the_parent() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def warm_up(wanted: Sequence[Case], say: Callable[[str], None]) -> None:
    """Compile in this process what the workers will then find in the cache, instead of each compiling the same."""
    if kernel_cache.is_empty():
        say("compiling the model; this is done once and takes a minute")
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
    return case.vehicle, case.idle_drive, case.car, case.told_friction, case.dt_s, case.substeps, case.soc


def drive_all(
    wanted: Sequence[Case],
    jobs: int,
    done: Callable[[Result], None] = lambda _: None,
    drive: Callable[[Case], Result] = cases.result,
) -> list[Result]:
    """Results of the cases, in their order; driven longest first, for the cores to finish together."""
    order = sorted(range(len(wanted)), key=lambda index: -effort(wanted[index]))
    made = on_all_cores(drive, [wanted[index] for index in order], jobs, done)
    return [result for _, result in sorted(zip(order, made, strict=True), key=lambda pair: pair[0])]


def effort(case: Case) -> float:
    """How long a case takes beside others: plant steps, times what its strategy takes beside equal split."""
    steps = _duration_s(case.cycle) / case.dt_s * case.substeps
    return steps * _WEIGHTS.get(case.strategy, _OTHER_WEIGHT)


@functools.cache
def _duration_s(cycle: str) -> float:
    """Kept for more cycles than `cases` keeps: a study asks for each of its tasks, and drawing one takes 3 ms."""
    return cases.cycle_of(cycle).duration_s


def progress_of(total: int, unit: str, quiet: bool) -> tqdm[Any]:
    """A bar on stderr that is gone when it is done."""
    return tqdm(total=total, unit=unit, file=sys.stderr, disable=quiet, leave=False)


class Progress:
    """A bar over cases."""

    def __init__(self, total: int, quiet: bool) -> None:
        self._bar = progress_of(total, "case", quiet)

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def update(self, result: Result) -> None:
        """One more is done."""
        case = result.case
        self._bar.set_postfix_str(f"{cases.cycle_of(case.cycle).name} {case.friction:g} {case.name}")
        self._bar.update()


def tell(line: str) -> None:
    """Say something beside a bar."""
    tqdm.write(line, file=sys.stderr)


def silent(_: str) -> None:
    """Say nothing."""
