# SPDX-License-Identifier: Apache-2.0
"""After `precompile`, every program finds what it calls compiled."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

#: What programs do first, each in a process of its own.
PROGRAMS = {
    "evaluate": """\
from iwm_sim.tools import evaluate
evaluate.main(["--cycle", CYCLE, "--friction", "0.9", "--strategy", "equal", "sdp_lookahead", "preview",
               "--jobs", "1"])
""",
    "solve_policy": """\
from iwm_power_manager.tools import solve_policy
solve_policy.main(["--vehicle", "jalalmaab_2015", "--cycle", CYCLE, "--friction", "0.9", "--grid", GRID,
                   "--output", OUTPUT, "--quiet"])
""",
    "solve_policy with a budget of changes": """\
from iwm_power_manager.files import atomic_write, read_text
from iwm_power_manager.tools import solve_policy
atomic_write(OUTPUT + ".yaml", (read_text(GRID) + "changes_per_min: 8\\n").encode())
solve_policy.main(["--vehicle", "jalalmaab_2015", "--cycle", CYCLE, "--friction", "0.9", "--grid", OUTPUT + ".yaml",
                   "--output", OUTPUT, "--quiet"])
""",
    "power_manager": """\
import rclpy
from iwm_power_manager.nodes.power_manager_node import PowerManager
rclpy.init()
node = PowerManager()
node.trigger_configure()
""",
    "simulator": """\
import rclpy
from iwm_sim.simulator import Simulator
rclpy.init()
Simulator()
""",
}  # fmt: skip


def used(code: str) -> dict[str, str]:
    """Every entry point that a piece of code needs: file and kernel."""
    listed = "\nfrom iwm_power_manager import compilation\nimport json\nprint(json.dumps(compilation.USES))"
    done = subprocess.run(
        [sys.executable, "-c", code + listed], capture_output=True, text=True, timeout=250, check=False, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr
    return {file: kernel for kernel, file, _, _ in json.loads(done.stdout.splitlines()[-1])}


@pytest.fixture(scope="module")
def compiled() -> dict[str, str]:
    return used("from iwm_sim.tools import precompile\nprecompile.main(['--quiet'])")


@pytest.mark.parametrize("name", PROGRAMS)
def test_a_program_needs_nothing_that_precompile_leaves_out(name, compiled, tmp_path, small_grid, hill) -> None:
    code = PROGRAMS[name]
    for word, path in (("CYCLE", hill), ("GRID", small_grid), ("OUTPUT", tmp_path / "policy.npz")):
        code = code.replace(word, repr(str(path)))
    needed = used(code)
    assert needed
    missing = {kernel for file, kernel in needed.items() if file not in compiled}
    assert not missing


def test_it_lists_what_it_compiled(capsys) -> None:
    from iwm_sim.tools import precompile

    assert precompile.main(["--quiet", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert "iwm_power_manager.control.repeat.advance" in {use["kernel"] for use in listed}
