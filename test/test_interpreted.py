# SPDX-License-Identifier: Apache-2.0
"""Kernels as plain Python: nothing of them is compiled, not even what they call by another name."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from iwm_power_manager import grid
from iwm_power_manager.grid import locate
from iwm_power_manager.held import Held
from iwm_power_manager.interpreted import interpreted
from iwm_power_manager.jit import Kernel, kernel

ROOT = Path(__file__).resolve().parents[1]
OFFSET = 0.5


@kernel
def tripled(a: float, times: int = 3) -> float:
    return times * a + OFFSET


@kernel
def by_module(axis, x):
    return grid.locate(axis, x)[1] + tripled(x)


def made(inner):
    @kernel
    def outer(x):
        return inner(x) + 1.0

    return outer


def test_it_gives_what_the_kernel_gives() -> None:
    axis = np.array([0.0, 1.0, 4.0])
    assert interpreted(by_module)(axis, 2.5) == by_module(axis, 2.5) == 0.5 + 8.0
    assert interpreted(tripled)(2.0, times=2) == 4.5
    assert interpreted(made(tripled))(1.0) == 4.5


def test_there_is_one_copy_of_a_kernel_and_the_kernel_stays_one() -> None:
    assert interpreted(locate) is interpreted(locate)
    assert interpreted((locate, 3)) == (interpreted(locate), 3)
    assert interpreted(interpreted(locate)) is interpreted(locate)
    assert interpreted(math_like := SimpleNamespace(pi=3.0)) is math_like
    assert isinstance(grid.locate, Kernel | type(interpreted(locate)))


def test_a_kernel_that_works_on_held_values_takes_whatever_has_a_value() -> None:
    @kernel
    def doubled(held):
        held.value = 2.0 * held.value

    held, plain = Held(1.5), SimpleNamespace(value=1.5)
    doubled(held)
    interpreted(doubled)(plain)
    assert held.value == plain.value == 3.0


def test_the_law_as_plain_python_needs_no_compiler() -> None:
    code = """
import sys
from iwm_power_manager.control.execution import plain_python
from iwm_power_manager.control.settings import default_settings
from iwm_power_manager.control.table import empty_table
from iwm_power_manager.control.types import Measurement, initial_state
from iwm_power_manager.share import resolve
from iwm_power_manager.vehicle import load_vehicle
law = plain_python()
before, after, car = map(law.hold, (initial_state(), None, load_vehicle(resolve("jalalmaab_2015")).params))
m = Measurement(5.0, (15.0,) * 4, 3000.0, 0.01, 0.9, 1e4, 1e4, 0.5)
law.advance(m, before, after, default_settings("sdp_lookahead"), car, empty_table())
print(after.value.steps, law.faults, "numba" in sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["1", "[]", "False"], done.stderr
