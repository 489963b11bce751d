# SPDX-License-Identifier: Apache-2.0
"""Values that stay in compiled code: the same from Python and from kernels, and nothing else is put in their place."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from iwm_power_manager.held import Held
from iwm_power_manager.jit import kernel

WITHOUT_COMPILER = {**os.environ, "NUMBA_DISABLE_JIT": "1"}


class Part(NamedTuple):
    flag: bool
    count: int
    pair: tuple[float, float]


class Whole(NamedTuple):
    part: Part
    curve: Any
    number: float


@kernel
def weighed(held, factor):
    whole = held.value
    return factor * whole.curve[-1] + whole.number + whole.part.count


@kernel
def counted(before, after):
    part = before.value
    after.value = Part(not part.flag, part.count + 1, (part.pair[1], part.pair[0] + 0.5))
    return part.count


def part_of(flag: bool = True, count: int = 3) -> Part:
    return Part(flag, count, (0.25, -1.5))


@pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="any value will do where nothing is compiled")
def test_a_value_of_other_types_is_refused_and_changes_nothing() -> None:
    held = Held(part_of())
    with pytest.raises(TypeError, match="Part of other types"):
        held.value = Part(True, 1.5, (0.0, 0.0))  # type: ignore[arg-type]
    assert held.value == part_of()


@given(st.booleans(), st.integers(-(2**62), 2**62), st.tuples(st.floats(), st.floats()))
def test_python_reads_what_it_put_there(flag, count, pair) -> None:
    held = Held(Part(flag, count, pair))
    assert repr(held.value) == repr(Part(flag, count, pair))


def test_a_kernel_reads_numbers_and_arrays_that_nobody_else_keeps() -> None:
    held = Held(Whole(part_of(), np.arange(50_000) / 2.0, 0.125))
    gc.collect()
    np.full(50_000, -1.0)
    assert weighed(held, 2.0) == 2.0 * 24_999.5 + 0.125 + 3


def test_a_kernel_writes_and_leaves_what_it_read() -> None:
    before, after = Held(part_of()), Held(part_of(count=0))
    assert counted(before, after) == 3
    assert before.value == part_of()
    assert after.value == Part(False, 4, (-1.5, 0.75))


def test_another_value_takes_its_place() -> None:
    held = Held(part_of())
    held.value = part_of(False, 9)
    assert held.value == part_of(False, 9)
    assert counted(held, held) == 9


def test_without_the_compiler_it_is_the_same() -> None:
    tests = ["-k", "kernel or another"]
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", __file__, *tests]
    if os.environ.get("NUMBA_DISABLE_JIT") != "1":
        done = subprocess.run(command, env=WITHOUT_COMPILER, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout
