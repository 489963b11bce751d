# SPDX-License-Identifier: Apache-2.0
"""What the pages say can be done: links lead somewhere, commands and their options exist, and the site builds."""

from __future__ import annotations

import functools
import os
import re
import shlex
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted(
    [
        *ROOT.glob("*.md"),
        *(ROOT / "docs").rglob("*.md"),
        *(ROOT / "config").rglob("*.md"),
        *ROOT.glob("examples/*/*.md"),
    ]
)
BIN = Path(sys.executable).parent
COMMANDS = {
    entry.name for entry in metadata.distribution("iwm_power_manager").entry_points if entry.group == "console_scripts"
}
FENCE = re.compile(r"^```.*?^```", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"\]\((?!https?:|mailto:)([^)\s#]*)(#[^)\s]+)?\)")


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as GitHub and MyST make them."""
    headings = re.findall(r"^#+ +(.+?) *$", FENCE.sub("", page.read_text(encoding="utf-8")), re.MULTILINE)
    plain = [re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).lower() for heading in headings]
    return {"#" + re.sub(r"[^\w\- ]", "", heading).replace(" ", "-") for heading in plain}


def broken_links(page: Path) -> list[str]:
    broken = []
    for path, anchor in LINK.findall(FENCE.sub("", page.read_text(encoding="utf-8"))):
        target = (page.parent / path).resolve() if path else page
        if not target.exists() or (anchor and target.suffix == ".md" and anchor not in anchors(target)):
            broken.append(path + anchor)
    return broken


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_link_leads_somewhere(page: Path) -> None:
    assert not broken_links(page)


def test_make_help_says_of_every_target_how_long_it_takes() -> None:
    targets = re.findall(r"^[a-z-]+:.*## (.*)$", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert len(targets) > 15
    assert not [text for text in targets if not re.search(r"\((?:.*\b(?:min|hours?|seconds|minutes)\b.*)\)$", text)]


def test_a_broken_link_is_found(tmp_path: Path) -> None:
    (tmp_path / "other.md").write_text("# Its `heading`, with signs\n")
    page = tmp_path / "page.md"
    page.write_text(
        "[a](other.md#its-heading-with-signs) [b](nowhere.md) [c](other.md#no) [d](#e) [f](https://x.org)\n"
    )
    assert broken_links(page) == ["nowhere.md", "other.md#no", "#e"]


@functools.cache
def help_of(command: str) -> str:
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.run([BIN / command, "--help"], env=environment, capture_output=True, text=True, check=True).stdout


def calls(text: str) -> list[list[str]]:
    """Commands of this package that a page shows, in code blocks and in single backticks, split into words."""
    blocks = FENCE.findall(text)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    lines += re.findall(r"`([^`]+)`", FENCE.sub("", text))
    found = []
    for line in lines:
        try:
            words = shlex.split(line.removeprefix("$ "), comments=True)
        except ValueError:  # no shell
            continue
        words = words[3:] if words[:3] == ["ros2", "run", "iwm_power_manager"] else words
        if words and words[0].removeprefix(".venv/bin/") in COMMANDS:
            found.append([words[0].removeprefix(".venv/bin/"), *words[1:]])
    return found


def unknown_words(words: list[str]) -> list[str]:
    """Options and parameters of a call that its command's help does not know."""
    known = help_of(words[0])
    ros = words.index("--ros-args") if "--ros-args" in words else len(words)
    end = next((at for at, word in enumerate(words) if word in ("|", ">", ">>", "&&", "||", "&", ";")), len(words))
    options = [word.split("=")[0] for word in words[1 : min(ros, end)] if word.startswith("--")]
    parameters = [
        word.split(":=")[0] for flag, word in zip(words[ros:], words[ros + 1 :], strict=False) if flag == "-p"
    ]
    unknown = [option for option in options if not re.search(rf"(?<![\w-]){option}(?![\w-])", known)]
    own = ("use_sim_time",)
    return unknown + [each for each in parameters if each not in own and not re.search(rf"^  {each} = ", known, re.M)]


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_command_of_a_page_knows_its_options(page: Path) -> None:
    wrong = {" ".join(words): unknown_words(words) for words in calls(page.read_text(encoding="utf-8"))}
    assert not {call: unknown for call, unknown in wrong.items() if unknown}


def test_an_option_that_is_not_there_is_found() -> None:
    text = (
        "`evaluate --cycle nycc --fly`\n```\n$ power_manager --ros-args -p friction:=0.5 -p no_such:=1\nls --x\n```\n"
    )
    assert [unknown_words(words) for words in calls(text)] == [["no_such"], ["--fly"]]


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_help_teaches_examples_and_exit_codes(name: str) -> None:
    assert "exit codes: 0" in help_of(name)
    assert name == "precompile" or "examples:\n" in help_of(name)


@pytest.mark.timeout(900)
@pytest.mark.parametrize("parts", [["--pages"], pytest.param([], marks=pytest.mark.nightly)], ids=["pages", "all"])
def test_the_site_builds_without_a_warning(parts: list[str], tmp_path: Path) -> None:
    pytest.importorskip("sphinx")
    pytest.importorskip("furo")
    built = subprocess.run(
        [sys.executable, ROOT / "scripts" / "docs_site", "--output", tmp_path, *parts], capture_output=True, text=True
    )
    assert built.returncode == 0, built.stderr
    assert (tmp_path / "html" / "docs" / "site" / "index.html").is_file()
    said = (tmp_path / "source" / "docs" / "site" / "commands.md").read_text()
    assert all(f"## {name}\n\n```text\nusage: {name} " in said for name in COMMANDS)
