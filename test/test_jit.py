# SPDX-License-Identifier: Apache-2.0
"""Kernels: compiled when they are called, the same function from Python, from another kernel and over a pickle."""

from __future__ import annotations

import gc
import inspect
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

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


@kernel
def with_a_function_inside(a: float) -> float:
    def doubled(b: float) -> float:
        return 2.0 * b

    return doubled(a)


def test_a_kernel_may_hold_a_function() -> None:
    assert with_a_function_inside(3.0) == 6.0


@kernel
def handed_back(axes):
    return axes


@kernel
def first_of(axes) -> float:
    return handed_back(axes)[0][0]


def test_a_kernel_that_returns_arrays_to_another_one_is_refused() -> None:
    # References are not counted between kernels: nobody would own them.
    with pytest.raises(Exception, match="returns arrays to another kernel"):
        first_of((np.ones(2), np.ones(3)))


def test_python_still_owns_its_arrays_after_a_kernel() -> None:
    axes = (np.arange(1000.0), np.ones(3))
    counts = [sys.getrefcount(axis) for axis in axes]
    for _ in range(100):
        assert handed_back(axes)[0][-1] == 999.0
    gc.collect()
    assert [sys.getrefcount(axis) for axis in axes] == counts
