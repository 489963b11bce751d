# SPDX-License-Identifier: Apache-2.0
"""The test process's own place in DDS: Fast DDS is not asked to take a participant away while others come and go."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from member import Member


def threads_of_dds() -> set[str]:
    """Those that Fast DDS has named, which live as long as their participant."""
    found = set()
    for task in Path("/proc/self/task").iterdir():
        with suppress(OSError):  # it has just ended
            if (task / "comm").read_text().startswith("dds."):
                found.add(task.name)
    return found


def test_a_member_that_leaves_takes_no_participant_with_it() -> None:
    first = Member("first")
    before = threads_of_dds()
    assert before
    first.close()
    second = Member("second")
    second.close()
    assert threads_of_dds() >= before
