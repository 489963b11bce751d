# SPDX-License-Identifier: Apache-2.0
"""docs/architecture.md lists the modules that are there, with what they say of themselves."""

from __future__ import annotations

import importlib.machinery
import importlib.util
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_the_module_map_is_the_one_the_sources_give() -> None:
    loader = importlib.machinery.SourceFileLoader("update_architecture", str(ROOT / "scripts" / "update_architecture"))
    spec = importlib.util.spec_from_loader(loader.name, loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    loader.exec_module(module)
    text = module.PAGE.read_text()
    assert module.page(text) == text, "run .venv/bin/python scripts/update_architecture"
    assert "iwm_power_manager/control/law.py" in text
