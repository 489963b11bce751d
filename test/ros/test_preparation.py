# SPDX-License-Identifier: Apache-2.0
"""What the power manager drives with at first: the compiled law where there is one or has to be, else plain Python."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from iwm_power_manager import compilation
from iwm_power_manager.control.execution import COMPILED
from iwm_power_manager.control.strategies import STRATEGIES
from iwm_power_manager.kernel_cache import Place, Store
from iwm_power_manager.nodes import power_manager_config as config
from iwm_power_manager.nodes import preparation
from iwm_power_manager.nodes.preparation import prepare


@pytest.fixture
def kept(monkeypatch, tmp_path) -> list[str]:
    """What the cache holds: nothing yet."""
    held: list[str] = []

    @contextmanager
    def kept_only() -> Iterator[None]:
        if held != ["advance"]:
            raise compilation.NotKeptError("advance", can_be_kept=not held)
        yield

    monkeypatch.setattr(compilation, "kept_only", kept_only)
    monkeypatch.setattr(compilation, "STORE", Store([Place(tmp_path)]))
    monkeypatch.setattr(preparation, "PYTHONS_PART", 1e6)  # fast enough, however busy the machine is
    return held


def test_with_the_law_in_the_cache_it_is_compiled(compiled_law) -> None:
    prepared = prepare(config.DEFAULTS)
    assert prepared.load is None
    assert prepared.controller.execution is COMPILED


def test_with_an_empty_cache_it_is_plain_python_until_it_is_loaded(compiled_law, kept) -> None:
    prepared = prepare(config.DEFAULTS)
    assert prepared.controller.execution.strategy == STRATEGIES["equal"].code
    assert prepared.load is not None
    with pytest.raises(compilation.NotKeptError):
        prepared.load()
    kept.append("advance")
    prepared.load()
    prepared.controller.run_by(COMPILED)
    assert prepared.controller.step(0, 0.01).command.motor_torque_nm == (0.0,) * 4


@pytest.mark.parametrize("why", ["lock-step", "the child process", "a slow machine", "no cache", "edited"])
def test_it_is_compiled_first_where_plain_python_will_not_do(compiled_law, kept, monkeypatch, tmp_path, why) -> None:
    if why == "a slow machine":
        monkeypatch.setattr(preparation, "PYTHONS_PART", 1e-6)
    if why == "no cache":
        (tmp_path / "file").touch()
        monkeypatch.setattr(compilation, "STORE", Store([Place(tmp_path / "file")], lambda _: None))
    if why == "edited":
        kept.append("of other sources")
    prepared = prepare(config.DEFAULTS | {"lockstep": why == "lock-step"}, at_once=why != "the child process")
    assert prepared.load is None
    assert prepared.controller.execution is COMPILED


def test_only_what_this_time_had_to_be_compiled_is_counted(compiled_law, monkeypatch) -> None:
    monkeypatch.setattr(compilation, "USES", [compilation.Use("a kernel", "a file", found=False, seconds=9.0)])
    assert prepare(config.DEFAULTS).compiled == 0


def test_a_wrong_signals_file_is_told_before_anything_is_compiled(kept, monkeypatch, tmp_path) -> None:
    monkeypatch.setattr(preparation, "COMPILED", None)
    wrong = Path(tmp_path / "signals.yaml")
    wrong.write_text("signals: {}\n")
    with pytest.raises(preparation.IwmError, match=r"signals\.yaml"):
        prepare(config.DEFAULTS | {"signals_file": str(wrong)})
