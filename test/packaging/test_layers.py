# SPDX-License-Identifier: Apache-2.0
"""What is imported when: the law without solver and files, `--help` without compiler, pictures and science."""

from __future__ import annotations

import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

from iwm_power_manager.kernel_cache import import_closure

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = {
    entry.name: entry.value.split(":")
    for entry in metadata.distribution("iwm_power_manager").entry_points
    if entry.group == "console_scripts"
}
#: Libraries whose import takes long and which no help text needs.
HEAVY = ("numba", "scipy", "matplotlib")

HELP = """\
import importlib, sys
sys.argv = [{name!r}, "--help"]
try:
    getattr(importlib.import_module({module!r}), {function!r})()
except SystemExit as ended:
    assert not ended.code
print(*[name for name in {heavy!r} if name in sys.modules], file=sys.stderr, sep=",", end="")
"""


def test_the_control_law_imports_neither_solver_nor_files_nor_ros() -> None:
    closure = import_closure(["iwm_power_manager.control.law"])
    outside = ("bags", "cycle", "files", "mdp", "nodes", "policy", "replay", "ros", "signals", "tools", "vehicle")
    assert not [name for name in closure if name.split(".")[1:2] and name.split(".")[1] in outside]


@pytest.mark.parametrize("name", sorted(SCRIPTS))
def test_help_needs_no_compiler_and_no_pictures(name) -> None:
    module, function = SCRIPTS[name]
    code = HELP.format(name=name, module=module, function=function, heavy=HEAVY)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert name in done.stdout or "usage" in done.stdout.lower()
    assert done.stderr == ""
