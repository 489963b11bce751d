# SPDX-License-Identifier: Apache-2.0
"""The process that compiles: how it is started, and what becomes of a node that gets nothing from it."""

from __future__ import annotations

import os
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

from iwm_power_manager.control.execution import plain_python
from iwm_power_manager.nodes.compiling import NICE, Compiling, law_status
from iwm_power_manager.ros.diagnostics import WARN


@pytest.fixture
def python(monkeypatch, tmp_path) -> Path:
    """A Python that says what it was started with, and fails."""
    fake = tmp_path / "python"
    fake.write_text(
        '#!/bin/sh\nwhile [ "$1" != -c ]; do given="$given $1"; shift; done\necho "given:$given" >&2\nexit 3\n'
    )
    fake.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(fake))
    return fake


def ended(compiling: Compiling) -> str:
    """The problem, once there is one."""
    for thread in threading.enumerate():
        if thread.name == "compiling":
            thread.join(60.0)
    assert compiling.ended
    return compiling.problem


@pytest.mark.parametrize(("level", "options"), [(0, ""), (1, " -O"), (2, " -O -O")])
def test_it_is_optimised_as_the_node_is_since_other_code_has_another_name_in_the_cache(
    python, monkeypatch, level, options
) -> None:
    monkeypatch.setattr(sys, "flags", SimpleNamespace(optimize=level))
    assert ended(Compiling({}, pytest.fail)) == f"the process that compiles ended with exit code 3: given:{options}"


@pytest.mark.parametrize("executable", ["", None, "/nowhere/python"])
def test_where_it_cannot_be_started_that_is_the_problem_and_no_error(monkeypatch, executable) -> None:
    monkeypatch.setattr(sys, "executable", executable)
    compiling = Compiling({}, pytest.fail)
    assert ended(compiling).startswith("no process can compile it: ")
    compiling.stop()
    status = law_status(plain_python(), compiling)
    assert (status.level, status.message.endswith(compiling.problem), status.values) == (WARN, True, {})


def test_where_no_thread_can_wait_for_it_it_is_ended(python, monkeypatch) -> None:
    def start(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", start)
    assert ended(Compiling({}, pytest.fail)) == "no process can compile it: can't start new thread"


@pytest.mark.parametrize("refused", ["", "sched_setscheduler"])
def test_it_prepares_as_the_node_does_and_gives_way_as_far_as_the_system_lets_it(
    monkeypatch, tmp_path, refused
) -> None:
    refuse = f"import os\ndef refuse(*_):\n    raise PermissionError\nos.{refused} = refuse\n" if refused else ""
    (tmp_path / "sitecustomize.py").write_text(refuse)
    nodes = tmp_path / "iwm_power_manager" / "nodes"
    nodes.mkdir(parents=True)
    for package in (nodes.parent, nodes):
        (package / "__init__.py").touch()
    prepare = "import os, sys\ndef prepare(values, at_once):\n    sys.exit(f'{values} {at_once} {os.nice(0)}')\n"
    (nodes / "preparation.py").write_text(prepare)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    nice = min(os.nice(0) + NICE, 19)
    said = f"the process that compiles ended with exit code 1: {{'rate_hz': 100.0, 'rule': [1.0]}} False {nice}"
    assert ended(Compiling({"rate_hz": 100.0, "rule": (1.0,)}, pytest.fail)) == said
