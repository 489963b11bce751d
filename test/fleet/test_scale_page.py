# SPDX-License-Identifier: Apache-2.0
"""docs/scale.md shows what was measured: its block is made of the stored numbers."""

import importlib.util
import json
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_the_page_shows_what_the_stored_measurement_says():
    spec = importlib.util.spec_from_file_location("fleet_benchmark", ROOT / "benchmarks" / "fleet.py")
    benchmark = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(benchmark)
    stored = json.loads((ROOT / "docs" / "scale.json").read_text())
    block = f"<!-- measured: benchmarks/fleet.py -->\n{benchmark.text(stored)}\n<!-- end -->"
    assert block in (ROOT / "docs" / "scale.md").read_text(), (
        "run: python benchmarks/fleet.py --json docs/scale.json --stored --page docs/scale.md"
    )
