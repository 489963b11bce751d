# SPDX-License-Identifier: Apache-2.0
"""`make test` with a choice of tests: its two runs of pytest, as they stand in the Makefile."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    ("chosen", "ends_well"),
    [
        ("test/test_files_page.py", True),  # keeps no time
        ("test/sim/test_processes.py", True),  # keeps it
        ("test/test_files_page.py test/sim/test_processes.py -k no_test_is_called_this", False),
    ],
)
def test_one_of_its_runs_may_have_no_test_but_not_both(chosen: str, ends_well: bool, tmp_path: Path) -> None:
    recipe = re.search(r"^test:.*\n((?:\t.*\n)+)", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert recipe
    commands = recipe[1].replace("\t@", "").replace("$(BIN)/python", sys.executable)
    commands = commands.replace("$(PYTEST_ARGS)", f"-n 1 -o cache_dir={tmp_path} {chosen}")
    codes = [subprocess.run(line, shell=True, cwd=ROOT, check=False).returncode for line in commands.splitlines()]
    assert len(codes) == 2
    assert (codes == [0, 0]) is ends_well
    assert codes[0] == 0  # or make would not come to the second
