# SPDX-License-Identifier: Apache-2.0
"""A kernel is found again exactly if everything it was made from is the same, and no folder can end a program."""

from __future__ import annotations

import ast
import errno
import hashlib
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from disk_helpers import on_small_disk
from iwm_power_manager import kernel_cache
from iwm_power_manager.kernel_cache import KERNELS, Place, Store

ROOT = Path(__file__).resolve().parents[1]

# A car of one number: the module of the kernel, one whose kernel and constant it uses, one with nothing to do with it.
SOURCES = {
    "__init__.py": "",
    "law.py": """\
from typing import NamedTuple
from iwm_power_manager.jit import kernel
from toy.tyre import (  # two names, over lines
    GRIP,
    doubled,
)
@kernel
def step(state, x):
    return GRIP * doubled(x) + state.a - state.b
""",
    "tyre.py": """\
from iwm_power_manager.jit import kernel
GRIP = 10.0
@kernel
def doubled(x):
    return 2.0 * x
""",
    "state.py": """\
from typing import NamedTuple
class State(NamedTuple):
    a: float
    b: float
""",
    "soak.py": "import toy.law\n",
}

RUN = """\
import sys
import toy.state, toy.law, toy.soak
from iwm_power_manager import compilation
print(toy.law.step(toy.state.State(a=1.0, b=0.5), 3.0), *[use.found for use in compilation.USES])
"""


@pytest.fixture
def toy(tmp_path) -> Path:
    """Folder with the package `toy`."""
    folder = tmp_path / "checkout"
    (folder / "toy").mkdir(parents=True)
    for name, text in SOURCES.items():
        (folder / "toy" / name).write_text(text)
    return folder


def environment(path: Path, cache: Path) -> dict[str, str]:
    keep = {name: value for name, value in os.environ.items() if name not in ("NUMBA_CACHE_DIR", "NUMBA_DISABLE_JIT")}
    return {**keep, "PYTHONPATH": f"{path}{os.pathsep}{ROOT}", "IWM_CACHE_DIR": str(cache)}


SHOWN = "from iwm_power_manager.tools.progress import show_compiling; show_compiling()\n"


def run(path: Path, cache: Path, prefix: tuple[str, ...] = (), before: str = "", **variables: str) -> tuple[str, str]:
    """Call the toy's kernel in a process of its own: result and whether it was found, and what was said."""
    done = subprocess.run(
        [*prefix, sys.executable, "-B", "-c", before + RUN],
        env={**environment(path, cache), **variables}, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.strip(), done.stderr


def test_a_kernel_is_compiled_again_after_an_edit_to_what_it_imports_and_to_nothing_else(toy, tmp_path) -> None:
    cache = tmp_path / "cache"
    assert run(toy, cache) == ("60.5 False", "")
    assert run(toy, cache) == ("60.5 True", "")

    with (toy / "toy" / "soak.py").open("a") as file:
        file.write("# a comment\n")
    assert run(toy, cache)[0] == "60.5 True"

    source = toy / "toy" / "tyre.py"
    before = source.stat()
    source.write_text(source.read_text().replace("10.0", "20.0"))
    os.utime(source, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert run(toy, cache)[0] == "120.5 False"

    source.write_text(source.read_text().replace("20.0", "10.0"))
    assert run(toy, cache)[0] == "60.5 True"


def test_a_command_says_that_it_compiles_and_nothing_where_it_need_not(toy, tmp_path) -> None:
    result, said = run(toy, tmp_path / "cache", before=SHOWN)
    assert result == "60.5 False"
    assert said.splitlines()[0].startswith("compiling for this machine")
    assert run(toy, tmp_path / "cache", before=SHOWN) == ("60.5 True", "")


def test_fields_that_change_places_in_a_module_the_kernel_does_not_import_make_another_kernel(toy, tmp_path) -> None:
    assert run(toy, tmp_path / "cache")[0] == "60.5 False"
    state = toy / "toy" / "state.py"
    state.write_text("from typing import NamedTuple\nclass State(NamedTuple):\n    b: float\n    a: float\n")
    assert run(toy, tmp_path / "cache")[0] == "60.5 False"


def test_a_kernel_that_is_handed_in_while_the_program_runs_counts_with_its_sources(toy, tmp_path) -> None:
    (toy / "plugin.py").write_text("from iwm_power_manager.jit import kernel\n@kernel\ndef doubled(x):\n    return x\n")
    code = f"import toy.tyre, plugin; toy.tyre.doubled = plugin.doubled\n{RUN}"

    def result() -> str:
        command = [sys.executable, "-B", "-c", code]
        there = environment(toy, tmp_path / "cache")
        return subprocess.run(command, env=there, capture_output=True, text=True, check=True).stdout.strip()

    assert run(toy, tmp_path / "cache")[0] == "60.5 False"
    assert result() == "30.5 False"
    assert result() == "30.5 True"
    (toy / "plugin.py").write_text((toy / "plugin.py").read_text().replace("return x", "return 3 * x"))
    assert result() == "90.5 False"


def test_another_place_with_the_same_sources_finds_the_kernel_also_in_a_zip_archive(toy, tmp_path) -> None:
    cache = tmp_path / "cache"
    run(toy, cache)
    shutil.copytree(toy, tmp_path / "worktree")
    assert run(tmp_path / "worktree", cache) == ("60.5 True", "")
    archive = tmp_path / "toy.zip"
    with zipfile.ZipFile(archive, "w") as file:
        for name, text in SOURCES.items():
            file.writestr(f"toy/{name}", text)
    assert run(archive, cache) == ("60.5 True", "")
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as file:
        for name, text in SOURCES.items():
            file.writestr(f"toy/{name}", text.replace("10.0", "30.0"))
    assert run(tmp_path / "other.zip", cache)[0] == "180.5 False"


def test_a_source_edited_while_the_program_runs_is_not_taken_for_what_runs(toy, tmp_path) -> None:
    script = f"""\
import toy.state, toy.law
with open({str(toy / "toy" / "law.py")!r}, "a") as file:
    file.write("# edited\\n")
print(toy.law.step(toy.state.State(1.0, 0.5), 3.0))
"""
    done = subprocess.run(
        [sys.executable, "-B", "-c", script],
        env=environment(toy, tmp_path / "cache"), capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    assert done.stdout.strip() == "60.5"
    assert not list((tmp_path / "cache" / KERNELS).glob("toy.*"))


@pytest.mark.parametrize("whole", [False, True], ids=["cut off", "whole, but no kernel"])
@pytest.mark.parametrize("name", ["toy", "numba"])
def test_a_damaged_file_is_said_once_and_written_anew(name, whole, toy, tmp_path) -> None:
    run(toy, tmp_path / "cache")
    (file,) = (tmp_path / "cache" / KERNELS).glob(f"{name}.*")
    content = b"no kernel"
    file.write_bytes(hashlib.sha256(content).digest() + content if whole else file.read_bytes()[:-1])
    result, said = run(toy, tmp_path / "cache")
    assert result == f"60.5 {name != 'toy'}"
    assert said == f"kernel cache: {file.name} is damaged; compiling it again\n"
    assert run(toy, tmp_path / "cache") == ("60.5 True", "")


def test_where_the_folder_is_no_folder_numbas_takes_its_place(toy, tmp_path) -> None:
    blocked = tmp_path / "file"
    blocked.touch()
    result, said = run(toy, blocked / "cache", NUMBA_CACHE_DIR=str(tmp_path / "numba"))
    assert result == "60.5 False"
    assert said == f"kernel cache: {blocked / 'cache'} cannot be written: {os.strerror(errno.ENOTDIR)}\n"
    result, said = run(toy, blocked / "cache", NUMBA_CACHE_DIR=str(tmp_path / "numba"))
    assert (result, said) == ("60.5 True", "")


def test_on_a_full_disk_the_temporary_folder_takes_over(toy, tmp_path) -> None:
    full = tmp_path / "full"
    full.mkdir()
    (tmp_path / "tmp").mkdir()
    result, said = run(
        toy, full / "cache", tuple(on_small_disk(full, "size=8k", [])), TMPDIR=str(tmp_path / "tmp")
    )  # fmt: skip
    assert result == "60.5 False"
    assert said == f"kernel cache: {full / 'cache'} cannot be written: {os.strerror(errno.ENOSPC)}\n"
    assert run(toy, full / "cache", TMPDIR=str(tmp_path / "tmp"))[0] == "60.5 True"


def test_where_no_folder_takes_it_everything_runs_without(tmp_path) -> None:
    said: list[str] = []
    blocked = tmp_path / "file"
    blocked.touch()
    store = Store([Place(blocked / "a"), Place(blocked / "b")], said.append)
    for _ in range(2):
        store.save("kernel", b"content")
        assert store.load("kernel") is None
    assert [text.split(":")[0] for text in said] == [
        f"{blocked / 'a'} cannot be written", f"{blocked / 'b'} cannot be written", "no folder takes it",
    ]  # fmt: skip


def test_a_temporary_folder_that_others_may_write_is_neither_read_nor_written(tmp_path) -> None:
    said: list[str] = []
    shared = tmp_path / "shared"
    Store([Place(shared)]).save("kernel", b"planted")
    shared.chmod(0o777)
    store = Store([Place(shared, shared=True)], said.append)
    assert store.load("kernel") is None
    store.save("kernel", b"mine")
    assert said[0] == f"{shared} cannot be written: it is not this user's alone"
    shared.chmod(0o700)
    assert store.load("kernel") == b"planted"


def test_a_read_only_folder_that_was_filled_at_installation_is_read(tmp_path) -> None:
    Store([Place(tmp_path / "image")]).save("kernel", b"content")
    said: list[str] = []
    assert Store([Place(tmp_path / "image"), Place(tmp_path / "home")], said.append).load("kernel") == b"content"
    assert not said


def test_kernels_that_nobody_has_read_for_long_are_removed(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("IWM_CACHE_DIR", str(tmp_path))
    store = Store()
    store.save("old", b"1")
    store.save("new", b"2")
    os.utime(tmp_path / KERNELS / "old", (0, 0))
    assert kernel_cache.prune(3600.0) == 1
    assert [path.name for path in (tmp_path / KERNELS).iterdir()] == ["new"]


KEPT_ONLY = """
import toy.law, toy.state
from iwm_power_manager.compilation import NotKeptError, kept_only
try:
    with kept_only():
        toy.law.step(toy.state.State(a=1.0, b=0.5), 3.0)
except NotKeptError as error:
    print(error, end="; ")
"""


def test_where_only_kept_kernels_may_be_used_one_that_is_not_kept_is_an_error_and_not_compiled(toy, tmp_path) -> None:
    assert run(toy, tmp_path / "cache", before=KEPT_ONLY)[0] == "toy.law.step has not been compiled; 60.5 False"
    assert run(toy, tmp_path / "cache", before=KEPT_ONLY)[0] == "60.5 True"


EDITED = """
import pathlib, toy.law, toy.state
from iwm_power_manager.compilation import NotKeptError, USES, kept_only
path = pathlib.Path(toy.law.__file__)
path.write_text(path.read_text() + "# edited")
try:
    with kept_only():
        toy.law.step(toy.state.State(a=1.0, b=0.5), 3.0)
except NotKeptError as error:
    print(error, error.can_be_kept, len(USES), end="; ")
"""


def test_where_only_kept_kernels_may_be_used_one_that_nobody_can_keep_is_not_compiled_either(toy, tmp_path) -> None:
    run(toy, tmp_path / "cache")
    said = "toy.law.step has not been compiled: its sources have changed since this process was started False 0"
    assert run(toy, tmp_path / "cache", before=EDITED)[0] == f"{said}; 60.5 False"


def test_a_store_knows_whether_it_takes_anything(tmp_path) -> None:
    (tmp_path / "file").touch()
    refusing, taking = Place(tmp_path / "file"), Place(tmp_path / "folder")
    assert Store([refusing, taking], lambda _: None).takes()
    assert not Store([refusing], lambda _: None).takes()


def kernel_modules() -> list[str]:
    """Every module that holds a kernel."""
    return [
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for package in ("iwm_power_manager", "iwm_sim")
        for path in sorted((ROOT / package).rglob("*.py"))
        if "\n@kernel\n" in path.read_text() or "\n@parallel_kernel\n" in path.read_text()
    ]


def names_by_parser(source: str, package: str) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            module = ".".join([*above, *([node.module] if node.module else [])])
            found |= {module, *(f"{module}.{alias.name}" for alias in node.names)}
    return found


@pytest.mark.parametrize("path", sorted(ROOT.glob("iwm_*/**/*.py")), ids=lambda path: str(path.relative_to(ROOT)))
def test_no_import_is_overlooked(path) -> None:
    package = ".".join(path.relative_to(ROOT).parts[:-1])
    missed = names_by_parser(path.read_text(), package) - kernel_cache.imported_names(path.read_text(), package)
    assert not missed


def test_relative_imports_and_odd_layouts_are_read_too() -> None:
    source = "from . import a, b as c\nfrom ..x import (\n  y,  # why\n  z,\n)\nimport os, json as j\n"
    assert kernel_cache.imported_names(source, "p.q") == {
        "p.q", "p.q.a", "p.q.b", "p.x", "p.x.y", "p.x.z", "os", "json",
    }  # fmt: skip


@pytest.mark.parametrize("module", kernel_modules())
def test_no_kernel_depends_on_files_nodes_tools_or_campaigns(module) -> None:
    closure = kernel_cache.import_closure([module])
    assert module in closure
    edges = {"bags", "ros", "nodes", "tools", "replay", "signals", "study", "campaigns"} - {module.split(".")[1]}
    assert not [name for name in closure if not edges.isdisjoint(name.split(".")[1:2])]
