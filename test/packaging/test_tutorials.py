# SPDX-License-Identifier: Apache-2.0
"""The tutorials are notebooks, and every cell runs."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", ["your_car", "the_paper"])
def test_every_cell_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    jupytext = pytest.importorskip("jupytext")
    nbclient = pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    notebook = jupytext.read(ROOT / "docs" / "tutorial" / f"{name}.md")
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.delenv("MPLBACKEND", raising=False)  # a notebook's kernel chooses its own
    notebooks = tmp_path / "docs" / "tutorial"  # where `jupyter lab` runs what it opens there
    notebooks.mkdir(parents=True)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    client = nbclient.NotebookClient(
        notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": str(notebooks)}}
    )
    client.execute()
    assert not list(notebooks.iterdir())
    shown = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    pictures = [output.data["image/png"] for output in shown if "image/png" in output.get("data", {})]
    assert pictures
    assert max(map(len, pictures)) < 300_000
