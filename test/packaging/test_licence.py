# SPDX-License-Identifier: Apache-2.0
"""Every source says under which licence it is."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_every_source_carries_the_licence_identifier() -> None:
    sources = sorted(
        path
        for folder in ("iwm_power_manager", "iwm_sim", "campaigns", "test", "benchmarks", "launch", "examples")
        for path in (ROOT / folder).rglob("*.py")
        if path.stat().st_size
    )
    assert len(sources) > 300
    without = [path for path in sources if "SPDX-License-Identifier: Apache-2.0" not in path.read_text()[:200]]
    assert not without
