# SPDX-License-Identifier: Apache-2.0
"""`scripts/setup_venv`, which every target of `make` runs first."""

from __future__ import annotations

import os
import re
import select
import shutil
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
GROUPS = ("build", "base", "ros", "test", "dev", "docs")
#: Holds the other end of a pipe open as long as it runs.
LASTS = "exec 3> {pipe}; echo $$ >&3; exec sleep 600"
#: Stands for Python, and makes an environment with itself in it.
PYTHON = """\
#!/bin/bash
case "$*" in
  *"-m venv"*) mkdir -p "${{@: -1}}/bin"; cp "$0" "${{@: -1}}/bin/python"
    cp {precompile} "${{@: -1}}/bin/precompile" ;;
  *base_prefix*) echo /usr ;;
  *"-m pip"*) {pip} ;;
esac
"""


@pytest.fixture
def checkout(tmp_path: Path) -> Callable[[str], subprocess.Popen[bytes]]:
    """Start the set-up of a checkout of which one step lasts, with all else stood in for."""

    def start(lasting: str) -> subprocess.Popen[bytes]:
        (tmp_path / "scripts").mkdir()
        (tmp_path / "requirements").mkdir()
        shutil.copy(ROOT / "scripts" / "setup_venv", tmp_path / "scripts")
        for name in ("setup.py", "setup.cfg", "package.xml", *(f"requirements/{group}.txt" for group in GROUPS)):
            (tmp_path / name).touch()
        lasts = LASTS.format(pipe=tmp_path / "pipe")
        os.mkfifo(tmp_path / "pipe")
        programs = {
            "precompile": f"#!/bin/bash\n{lasts if lasting == 'precompile' else 'true'}\n",
            "python": PYTHON.format(precompile=tmp_path / "precompile", pip=lasts if lasting == "pip" else "true"),
        }
        for name, text in programs.items():
            (tmp_path / name).write_text(text)
            (tmp_path / name).chmod(0o755)
        environment = {
            key: value for key, value in os.environ.items() if key not in ("ROS_DISTRO", "AMENT_PREFIX_PATH")
        }
        return subprocess.Popen(
            [tmp_path / "scripts" / "setup_venv", "run"],
            env=environment | {"PYTHON": str(tmp_path / "python")},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )

    return start


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
@pytest.mark.parametrize("lasting", ["pip", "precompile"])
def test_a_signal_to_it_ends_what_it_has_started_too(checkout, tmp_path: Path, lasting: str, number: int) -> None:
    """As from `make`, which passes SIGTERM on to this script alone."""
    process = checkout(lasting)
    with (tmp_path / "pipe").open() as pipe:
        child = int(pipe.readline())
        process.send_signal(number)
        ended, _, _ = select.select([pipe], [], [], 30.0)
        try:
            assert ended, f"{lasting} runs on"
            assert pipe.read() == ""
            assert process.wait(30) == 128 + number
        finally:
            if not ended:
                os.kill(child, signal.SIGKILL)
            process.terminate()
            process.communicate()


def test_no_shell_stands_between_make_and_what_lasts() -> None:
    recipes = [line for line in (ROOT / "Makefile").read_text(encoding="utf-8").splitlines() if line.startswith("\t")]
    assert not [line for line in recipes if re.search(r"\b(do|done|while)\b", line)]


def test_it_ends_well_and_a_second_time_at_once(checkout, tmp_path: Path) -> None:
    output, _ = checkout("nothing").communicate(timeout=60)
    assert b"setup: done" in output
    again = subprocess.run(
        [tmp_path / "scripts" / "setup_venv", "run"],
        env=os.environ | {"PYTHON": str(tmp_path / "python")},
        capture_output=True,
        check=True,
    )
    assert not again.stdout
