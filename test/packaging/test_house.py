# SPDX-License-Identifier: Apache-2.0
"""Rules of the house that no linter knows: short functions, and tests that know behaviour only."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
#: Lines a function may have.
LONGEST = 80
#: Names with an underscore that are no secret: of named tuples, and of the system.
PUBLIC = {"_asdict", "_exit", "_fields", "_make", "_replace"}


def sources(*folders: str) -> list[Path]:
    return sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))


@pytest.mark.parametrize("folder", ["iwm_power_manager", "iwm_sim", "campaigns"])
def test_no_function_is_longer_than_a_screen_or_two(folder) -> None:
    long = [
        f"{path.relative_to(ROOT)}:{node.lineno} {node.name}"
        for path in sources(folder)
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.end_lineno - node.lineno >= LONGEST
    ]
    assert not long


def private_names(tree: ast.AST) -> Iterator[str]:
    """Names of others with an underscore that a test reads, imports or replaces."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.Attribute) and not (isinstance(node.value, ast.Name) and node.value.id == "self"):
            yield node.attr
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", "") in ("setattr", "delattr"):
            yield from (arg.value for arg in node.args if isinstance(arg, ast.Constant) and isinstance(arg.value, str))


def test_no_test_knows_a_private_name() -> None:
    found = [
        f"{path.relative_to(ROOT)}: {name}"
        for path in sources("test")
        for name in private_names(ast.parse(path.read_text()))
        if name.startswith("_") and not name.startswith("__") and name not in PUBLIC
    ]
    assert not found


#: Words of ours for what the field has a name for: capacity, driver, assumed (docs/glossary.md).
OURS = {"room", "rooms", "foot", "told"}


def public_names(tree: ast.AST) -> Iterator[str]:
    """Names of functions and classes, their parameters and fields, without an underscore before them."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.arg):
            yield node.arg
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            yield node.target.id


@pytest.mark.parametrize("folder", ["iwm_power_manager", "iwm_sim"])
def test_names_use_the_words_of_the_field(folder) -> None:
    found = [
        f"{path.relative_to(ROOT)}: {name}"
        for path in sources(folder)
        for name in public_names(ast.parse(path.read_text()))
        if OURS & set(name.lower().split("_"))
    ]
    assert not found
