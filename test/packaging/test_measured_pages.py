# SPDX-License-Identifier: Apache-2.0
"""docs/performance.md and docs/scale.md show what was measured: their blocks are made of the stored numbers."""

import importlib.util
import json
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    ("program", "page", "function"), [("performance", "performance", "table"), ("fleet", "scale", "text")]
)
def test_the_page_shows_what_the_stored_measurement_says(program, page, function):
    path = ROOT / "benchmarks" / f"{program}.py"
    spec = importlib.util.spec_from_file_location(f"{program}_benchmark", path)
    benchmark = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(benchmark)
    stored = json.loads((ROOT / "docs" / f"{page}.json").read_text())
    block = f"<!-- measured: benchmarks/{program}.py -->\n{getattr(benchmark, function)(stored)}\n<!-- end -->"
    assert block in (ROOT / "docs" / f"{page}.md").read_text(), f"docs/{page}.md is not of docs/{page}.json"
