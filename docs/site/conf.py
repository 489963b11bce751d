# SPDX-License-Identifier: Apache-2.0
"""Sphinx: how the pages of this repository become a site; `scripts/docs_site` builds it."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(os.environ["IWM_ROOT"])
sys.path.insert(0, str(ROOT))

_manifest = ElementTree.parse(ROOT / "package.xml")  # noqa: S314
project = str(_manifest.findtext("name"))
author = str(_manifest.findtext("author"))
version = release = str(_manifest.findtext("version"))
copyright = author  # noqa: A001

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax"]
root_doc = "docs/site/index"
html_theme = "furo"
html_title = f"{project} {release}"
#: Formulas are drawn by the browser; without network they stand as they were written.
myst_heading_anchors = 4
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
#: Data that is long to print.
autodoc_default_options = {"no-value": True}
napoleon_google_docstring = False
napoleon_use_ivar = True
#: Code fences in the language they look like; a transcript is plain text.
highlight_language = "text"
#: A name that several modules use, such as Case, is linked to one of them.
suppress_warnings = ["ref.python", "misc.highlighting_failure"]


def as_rst(app, what, name, obj, options, lines) -> None:
    """Docstrings as Sphinx reads them: `code`, |x| for a magnitude, indented text for an example."""
    marked: list[str] = []
    for line in lines:
        if what == "module" and line.startswith("    ") and marked and marked[-1] == "" and not _within(marked):
            marked += ["::", ""]
        if not (what == "module" and line.startswith("    ")):
            parts = re.split(r"(``[^`]+``|`[^`]+`)", line)
            parts[::2] = [part.replace("|", "\\|") for part in parts[::2]]
            parts[1::2] = [f"``{part.strip('`')}``" for part in parts[1::2]]
            line = "".join(parts)
        marked.append(line)
    lines[:] = marked


def _within(lines: list[str]) -> bool:
    """Whether the last lines are of an example already."""
    text = [line for line in lines if line]
    return bool(text) and text[-1].startswith("    ")


def setup(app) -> None:
    """Register what is above."""
    app.connect("autodoc-process-docstring", as_rst, priority=1)
