# SPDX-License-Identifier: Apache-2.0
"""colcon and pip put every executable where its users look for it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
EXECUTABLES = sorted(
    entry.name for entry in metadata.distribution("iwm_power_manager").entry_points if entry.group == "console_scripts"
)


def run(*command: str | Path, cwd: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a command to its end with this Python's tools first on PATH."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    return subprocess.run(
        list(map(str, command)),
        cwd=cwd,
        env={**os.environ, "PATH": path, **environment},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        stdin=subprocess.DEVNULL,
    )


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with `src/iwm_power_manager`: the tracked files, as somebody gets them who clones the project."""
    folder = tmp_path_factory.mktemp("ws")
    source = folder / "src" / "iwm_power_manager"
    tracked = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in filter(None, tracked.split("\0")):
        if (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, source / name)
    return folder


@pytest.fixture(scope="module")
def install(workspace: Path) -> Path:
    """Prefix of the package as colcon installs it."""
    built = run("colcon", "build", "--event-handlers", "console_cohesion+", cwd=workspace)
    assert built.returncode == 0, built.stdout + built.stderr
    return workspace / "install" / "iwm_power_manager"


def test_colcon_takes_it_for_a_ros_package(workspace: Path) -> None:
    listed = run("colcon", "list", cwd=workspace)
    assert listed.stdout.split() == ["iwm_power_manager", "src/iwm_power_manager", "(ros.ament_python)"]


def test_colcon_puts_every_executable_where_ros2_run_looks(install: Path) -> None:
    assert sorted(path.name for path in (install / "lib" / "iwm_power_manager").iterdir()) == EXECUTABLES
    assert (install / "share" / "ament_index" / "resource_index" / "packages" / "iwm_power_manager").is_file()
    assert (install / "share" / "iwm_power_manager" / "package.xml").is_file()


@pytest.mark.parametrize("name", EXECUTABLES)
def test_an_executable_built_by_colcon_says_how_to_use_it(name: str, install: Path, tmp_path: Path) -> None:
    script = f'. "{install.parent}/local_setup.sh" && exec "{install}/lib/iwm_power_manager/{name}" --help'
    helped = run("sh", "-c", script, cwd=tmp_path, COLCON_CURRENT_PREFIX=str(install.parent))
    assert helped.returncode == 0, helped.stderr
    assert "usage" in helped.stdout.lower()
    assert "Traceback" not in helped.stderr


def test_colcon_installs_every_shared_file_and_the_installed_package_finds_it(install: Path, tmp_path: Path) -> None:
    shared = install / "share" / "iwm_power_manager"
    for folder in ("config", "launch", "policies"):
        tracked = subprocess.run(["git", "ls-files", folder], cwd=ROOT, capture_output=True, text=True, check=True)
        missing = [name for name in tracked.stdout.split() if (ROOT / name).is_file() and not (shared / name).is_file()]
        assert not missing
    library = next(install.glob("lib/python3*/site-packages"))
    code = "from iwm_power_manager import share; print(share.__file__); print(share.share_path('config/cycles'))"
    found = run(sys.executable, "-c", code, cwd=tmp_path, PYTHONPATH=str(library)).stdout.split()
    assert found == [str(library / "iwm_power_manager" / "share.py"), str(shared / "config" / "cycles")]


@pytest.mark.parametrize("name", EXECUTABLES)
def test_an_executable_installed_by_pip_says_how_to_use_it(name: str, tmp_path: Path) -> None:
    helped = run(Path(sys.executable).parent / name, "--help", cwd=tmp_path)
    assert helped.returncode == 0, helped.stderr
    assert "usage" in helped.stdout.lower()


def test_a_wheel_holds_the_shared_files_and_a_launcher_for_every_executable(workspace: Path, tmp_path: Path) -> None:
    source = workspace / "src" / "iwm_power_manager"
    wheel = run(
        sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", tmp_path, source,
        cwd=tmp_path,
    )  # fmt: skip
    assert wheel.returncode == 0, wheel.stderr
    prefix = tmp_path / "prefix"
    installed = run(
        sys.executable, "-m", "pip", "install", "--no-deps", "--ignore-installed", "--prefix", prefix,
        next(tmp_path.glob("*.whl")),
        cwd=tmp_path,
    )  # fmt: skip
    assert installed.returncode == 0, installed.stderr
    launchers = prefix / "lib" / "iwm_power_manager"
    assert sorted(path.name for path in launchers.iterdir()) == EXECUTABLES
    assert all(os.access(path, os.X_OK) for path in launchers.iterdir())
    assert (prefix / "share" / "iwm_power_manager" / "config" / "cycles" / "nycc.csv").is_file()
    # The launcher hands its arguments on to the script of the same name in bin/.
    script = prefix / "bin" / "demo"
    script.write_text('#!/bin/sh\nprintf "%s|" "$@"\n')
    assert run(launchers / "demo", "--name", "two words", cwd=tmp_path).stdout == "--name|two words|"
