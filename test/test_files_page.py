# SPDX-License-Identifier: Apache-2.0
"""docs/files.md states the limits that the code has."""

from __future__ import annotations

import pytest

from iwm_power_manager import files
from iwm_power_manager.bags import limits
from iwm_power_manager.share import roots
from iwm_power_manager.signals import types

PAGE = (roots()[0] / "docs/files.md").read_text()


def size(value: int) -> str:
    for unit, scale in (("GiB", 2**30), ("MiB", 2**20), ("KiB", 2**10)):
        if value % scale == 0:
            return f"{value // scale} {unit}"
    return f"{value:,}"


@pytest.mark.parametrize(
    ("line", "value"),
    [
        ("a file that is read whole", size(files.MAX_FILE_BYTES)),
        ("CSV: cycles", size(files.MAX_TEXT_BYTES)),
        ("CSV: cycles", f"{files.MAX_LINE_LENGTH} characters a line"),
        ("CSV: cycles", f"{files.MAX_NUMBER_LENGTH} characters a number"),
        ("YAML: vehicles", size(files.MAX_YAML_BYTES)),
        ("YAML: vehicles", f"{files.MAX_YAML_NODES:,} nodes"),
        ("YAML: vehicles", f"{files.MAX_YAML_DEPTH} levels"),
        ("a chunk, or a compressed message", size(limits.MAX_CHUNK_BYTES)),
        ("a chunk, or a compressed message", f"{limits.MAX_RATIO} times"),
        ("a chunk, or a compressed message", size(limits.FREE_BYTES)),
        ("a compressed file", f"{limits.MAX_RATIO} times"),
        ("a chunk, or a compressed message", f"{limits.MAX_CHUNK_MESSAGES:,} messages"),
        ("messages that wait", size(limits.MAX_OVERLAP_BYTES)),
        ("records outside of chunks", f"{limits.MAX_RECORDS:,}; {limits.MAX_CHANNELS:,}"),
        ("`metadata.yaml`;", f"{size(limits.MAX_METADATA_BYTES)}; {size(limits.MAX_QOS_BYTES)}"),
        ("a message definition", size(types.MAX_TEXT_BYTES)),
        ("a message definition", f"{types.MAX_DEPTH} levels, {types.MAX_FIELDS:,} fields"),
        ("sqlite3", f"{limits.SQLITE_INSTRUCTIONS:,}"),
        ("sqlite3", f"{limits.SQLITE_INSTRUCTIONS_PER_BYTE} more for each byte"),
    ],
)
def test_a_limit_on_the_page_is_the_one_in_the_code(line: str, value: str) -> None:
    (row,) = [row for row in PAGE.splitlines() if row.startswith(f"| {line}")]
    assert value in row
