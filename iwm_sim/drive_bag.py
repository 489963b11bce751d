# SPDX-License-Identifier: Apache-2.0
"""What a bag of a drive holds: is everything there that was published, and what did the power manager decide."""

from __future__ import annotations

import dataclasses
import struct
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from iwm_power_manager.bags.reader import BagReader
from iwm_power_manager.errors import BagError
from iwm_power_manager.signals.types import standard_types
from iwm_sim.closed_loop import COLUMNS, Run
from iwm_sim.drive import LAW_COLUMNS

SPEED = "vehicle_speed"
STATE = "power_manager/state"
COMMANDS = ("wheel_torque_command", "friction_brake_command")

#: A message with a header begins, after four bytes of CDR encapsulation, with its stamp.
_STAMP = struct.Struct("<iI")
_STAMP_OFFSET = 4
_NS_PER_S = 1_000_000_000


class DriveBag(NamedTuple):
    """Contents of a bag.

    Attributes
    ----------
    counts : messages by topic, without a leading slash
    stamps_ns : stamps of speed, commands and state by topic, in order
    decisions : (steps, len(LAW_COLUMNS)) what the law decided, a row for each state message
    """

    counts: dict[str, int]
    stamps_ns: dict[str, list[int]]
    decisions: np.ndarray


def read_drive_bag(path: Path) -> DriveBag:
    """Read a whole bag of a drive recorded at the root namespace.

    Raises
    ------
    BagError
        It cannot be read, is damaged, or its state messages lack a signal.
    """
    counts: Counter[str] = Counter()
    stamps: dict[str, list[int]] = {topic: [] for topic in (SPEED, *COMMANDS, STATE)}
    decisions = []
    signals = np.zeros(0, dtype=np.intp)
    size = 0
    with BagReader(path) as bag:
        for message in bag.messages():
            topic = message.topic.lstrip("/")
            counts[topic] += 1
            if topic not in stamps:
                continue
            seconds, nanoseconds = _STAMP.unpack_from(message.data, _STAMP_OFFSET)
            stamps[topic].append(seconds * _NS_PER_S + nanoseconds)
            if topic == STATE:
                if not size:
                    signals, size = _layout(path, bag.topics[message.topic].type, message.data)
                decisions.append(_positions(message.data, size)[signals])
        if problems := [*bag.damage, *bag.notes]:
            raise BagError(problems[0])
    return DriveBag(dict(counts), stamps, np.array(decisions).reshape(-1, len(LAW_COLUMNS)))


def problems(bag: DriveBag, published: Mapping[str, int], stamps_ns: list[int]) -> list[str]:
    """What is missing in a bag, a line each.

    Parameters
    ----------
    published : what the simulator has published, by topic
    stamps_ns : stamps it has had an answer to
    """
    lines = [
        f"{topic}: {count} published, {bag.counts.get(topic.lstrip('/'), 0)} recorded"
        for topic, count in published.items()
        if bag.counts.get(topic.lstrip("/"), 0) != count
    ]
    for topic in (*COMMANDS, STATE):
        missing = set(stamps_ns) - set(bag.stamps_ns[topic])
        if missing:
            lines.append(f"{topic}: {len(missing)} of {len(stamps_ns)} steps are not recorded")
    return lines


def with_decisions(run: Run, bag: DriveBag) -> Run:
    """The run with what the law had decided by the stamp of each step; before the first state that is nothing (NaN)."""
    steps = np.unique(np.array(bag.stamps_ns[SPEED], dtype=np.int64))
    if len(steps) != len(run.series):
        return run
    at = np.searchsorted(np.array(bag.stamps_ns[STATE], dtype=np.int64), steps, "right") - 1
    series = run.series.copy()
    known = at >= 0
    for column, name in enumerate(LAW_COLUMNS):
        series[known, COLUMNS.index(name)] = bag.decisions[at[known], column]
    return dataclasses.replace(run, series=series)


def _layout(path: Path, kind: str, data: bytes) -> tuple[np.ndarray, int]:
    """Places of the law's columns among the signals, and the number of signals; the same for every message of a bag."""
    message: Any = standard_types().deserialize_cdr(data, kind)
    names = list(message.name)
    missing = [name for name in LAW_COLUMNS if name not in names]
    if missing:
        raise BagError(f"{path}: {STATE} lacks {', '.join(missing)}")
    if not np.array_equal(_positions(data, len(names)), message.position, equal_nan=True):
        raise BagError(f"{path}: {STATE} carries more than named numbers")
    return np.array([names.index(name) for name in LAW_COLUMNS]), len(names)


def _positions(data: bytes, size: int) -> np.ndarray:
    """Field `position` of a JointState of which the two fields behind it are empty: two lengths of four bytes.

    Decoding the names of every message as well would take most of the time.
    """
    return np.frombuffer(data, "<f8", size, len(data) - 8 - 8 * size)
