# SPDX-License-Identifier: Apache-2.0
"""Kernels: compiled when they are called, the same function from Python, from another kernel and over a pickle."""

from __future__ import annotations

import inspect
import pickle
import subprocess
import sys
from pathlib import Path

from iwm_power_manager import jit
from iwm_power_manager.grid import locate
from iwm_power_manager.jit import kernel, parallel_kernel

ROOT = Path(__file__).resolve().parents[1]


@kernel
def hypotenuse(a: float, b: float) -> float:
    """Length of the longest side."""
    return (a * a + b * b) ** 0.5


@parallel_kernel
def fill(out, b):
    for i in range(out.size):
        out[i] = hypotenuse(float(i), b)


def test_a_kernel_gives_the_same_from_python_and_inside_another_one(monkeypatch) -> None:
    import numpy as np

    out = np.empty(5)
    fill(out, 4.0)
    assert out.tolist() == [hypotenuse(float(i), 4.0) for i in range(5)]
    assert out[3] == 5.0


def test_a_kernel_keeps_its_name_text_and_signature() -> None:
    assert hypotenuse.__name__ == "hypotenuse"
    assert hypotenuse.__doc__ == "Length of the longest side."
    assert list(inspect.signature(hypotenuse).parameters) == ["a", "b"]


def test_a_kernel_travels_to_another_process_by_its_name() -> None:
    assert pickle.loads(pickle.dumps(locate)) is locate


def test_without_the_compiler_a_kernel_is_the_plain_function(monkeypatch) -> None:
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    assert jit.kernel(hypotenuse) is hypotenuse


def test_importing_kernels_imports_no_compiler() -> None:
    code = "import sys, iwm_power_manager.control.law, iwm_sim.closed_loop; sys.exit('numba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0
