# SPDX-License-Identifier: Apache-2.0
"""Small bags for the tests of this folder."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

from bags_helpers import float64, topic
from iwm_power_manager.bags.writer import BagWriter, WriterOptions


@pytest.fixture
def make_bag(tmp_path: Path) -> Callable[..., Path]:
    """Write a bag of Float64 messages: (topic, log time in ns, value)."""

    def make(
        messages: Iterable[tuple[str, int, float]],
        name: str = "bag",
        custom_data: dict[str, str] | None = None,
        **options: object,
    ) -> Path:
        numbers: dict[str, int] = {}
        with BagWriter(tmp_path / name, WriterOptions(**options), custom_data) as bag:  # type: ignore[arg-type]
            for sequence, (channel, time_ns, value) in enumerate(messages, 1):
                if channel not in numbers:
                    numbers[channel] = bag.add_topic(topic(channel))
                bag.write(numbers[channel], time_ns, float64(value), time_ns + 7, sequence)
        return tmp_path / name

    return make
