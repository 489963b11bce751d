"""docs/interface.md says what the sources say."""

from __future__ import annotations

import importlib.util
from importlib.machinery import SourceFileLoader
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_topics_signals_and_parameters_are_documented_as_they_are() -> None:
    path = ROOT / "scripts" / "update_interface"
    loader = SourceFileLoader("update_interface", str(path))
    module = importlib.util.module_from_spec(importlib.util.spec_from_loader("update_interface", loader))
    loader.exec_module(module)
    page = (ROOT / "docs" / "interface.md").read_text()
    assert module.interface_page(page) == page, "run scripts/update_interface"
