# SPDX-License-Identifier: Apache-2.0
"""package.xml, setup.py and the sources say the same thing about the package."""

from __future__ import annotations

import ast
import importlib
import re
import runpy
import subprocess
import sys
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml
from catkin_pkg.package import Package, parse_package

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = sorted(
    (entry.name, entry.value)
    for entry in metadata.distribution("iwm_power_manager").entry_points
    if entry.group == "console_scripts"
)

#: Python modules that come with ROS under the name of their package.
ROS_MODULES = {
    "ament_index_python", "builtin_interfaces", "diagnostic_msgs", "geometry_msgs", "launch", "launch_ros",
    "lifecycle_msgs", "nav_msgs", "rcl_interfaces", "rclpy", "rosgraph_msgs", "sensor_msgs", "std_msgs", "std_srvs",
}  # fmt: skip
#: Other imports, and the rosdep key that brings them.
ROSDEP_KEYS = {
    "bokeh": "python3-bokeh-pip",
    "jinja2": "python3-jinja2",
    "llvmlite": "python3-numba",
    "lz4": "python3-rosbags-pip",
    "matplotlib": "python3-matplotlib",
    "mcap": "mcap-ros2-support",
    "numba": "python3-numba",
    "PIL": "python3-pil",
    "numpy": "python3-numpy",
    "rosbags": "python3-rosbags-pip",
    "scipy": "python3-scipy",
    "tqdm": "python3-tqdm",
    "yaml": "python3-yaml",
    "zstandard": "python3-rosbags-pip",
}
#: Used where they are installed; without them, one line says what to install.
OPTIONAL = {"dask", "distributed", "pandas", "pyarrow"}
#: What pip calls a module of another name, or what brings it: of llvmlite numba demands a version of its own.
DISTRIBUTIONS = {"PIL": "pillow", "llvmlite": "numba", "yaml": "pyyaml"}

#: Parts that know numbers and files only: usable, and tested, where no ROS is.
ROS_FREE = [
    "bags", "control", "cycle.py", "errors.py", "files.py", "grid.py", "jit.py", "kernel_cache.py",
    "compilation.py", "mdp", "model", "policy.py", "replay", "share.py", "signals", "vehicle.py",
]  # fmt: skip


@pytest.fixture(scope="module")
def manifest() -> Package:
    warnings: list[str] = []
    package = parse_package(ROOT / "package.xml", warnings=warnings)
    assert not warnings
    return package


def sources(*folders: str) -> list[Path]:
    """Python files below `folders` (or those files themselves), from the root of the checkout."""
    found = [path for folder in folders for path in sorted((ROOT / folder).rglob("*.py"))]
    return found + [ROOT / name for name in folders if name.endswith(".py") and (ROOT / name).is_file()]


def imports_of(path: Path) -> Iterator[str]:
    """Absolute names of all modules that a file imports, also inside functions."""
    package = path.relative_to(ROOT).with_suffix("").parts[:-1]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else ()
            yield ".".join((*above, *(node.module or "").split("."))).strip(".")


def third_party() -> set[str]:
    tops = {name.split(".")[0] for path in sources("iwm_power_manager", "iwm_sim") for name in imports_of(path)}
    return {top for top in tops - OPTIONAL if top not in sys.stdlib_module_names and not top.startswith("iwm_")}


def test_the_manifest_is_valid_and_names_ament_python(manifest: Package) -> None:
    manifest.validate()
    assert manifest.name == "iwm_power_manager"
    assert manifest.get_build_type() == "ament_python"
    assert manifest.licenses == ["Apache-2.0"]
    assert "Apache License" in (ROOT / "LICENSE").read_text(encoding="utf-8")


def test_the_version_is_the_same_everywhere(manifest: Package) -> None:
    assert importlib.import_module("iwm_power_manager").__version__ == manifest.version
    assert metadata.version("iwm_power_manager") == manifest.version
    assert re.search(rf"^(Forthcoming|{re.escape(manifest.version)} )", (ROOT / "CHANGELOG.rst").read_text(), re.M)


def test_the_citation_says_what_the_manifest_says() -> None:
    module = runpy.run_path(str(ROOT / "scripts" / "update_citation"))
    citation, manifest = (ROOT / "CITATION.cff").read_text(), ElementTree.parse(ROOT / "package.xml").getroot()
    assert module["updated"](citation, manifest) == citation, "run: scripts/update_citation"
    for kind in ("repository", "website"):
        ElementTree.SubElement(manifest, "url", type=kind).text = f"https://{kind}.example"
    published = module["updated"](citation, manifest)
    assert module["updated"](published, manifest) == published
    content = yaml.safe_load(published)
    assert (content["url"], content["repository-code"]) == ("https://website.example", "https://repository.example")
    assert content["authors"] == yaml.safe_load(citation)["authors"]


def test_the_manifest_names_every_ros_package_and_library_that_is_imported(manifest: Package) -> None:
    imported = third_party() | {"ament_index_python", "launch", "launch_ros"}
    unknown = imported - ROS_MODULES - set(ROSDEP_KEYS)
    assert not unknown, f"say in this test which rosdep key brings {unknown}"
    needed = {ROSDEP_KEYS.get(name, name) for name in imported}
    assert needed <= {dependency.name for dependency in manifest.exec_depends}


def test_pip_gets_every_library_that_is_imported() -> None:
    required = {re.split(r"[^\w-]", text)[0].lower() for text in metadata.requires("iwm_power_manager") or ()}
    assert {DISTRIBUTIONS.get(name, name) for name in third_party() - ROS_MODULES} <= required


@pytest.mark.parametrize(("name", "target"), SCRIPTS, ids=[name for name, _ in SCRIPTS])
def test_every_executable_has_its_main(name: str, target: str) -> None:
    module, function = target.split(":")
    assert callable(getattr(importlib.import_module(module), function))


def test_the_power_manager_never_imports_the_simulator() -> None:
    guilty = {
        str(path.relative_to(ROOT)): name
        for path in sources("iwm_power_manager")
        for name in imports_of(path)
        if name.split(".")[0] == "iwm_sim"
    }
    assert not guilty


def test_model_solver_and_control_law_import_no_ros() -> None:
    guilty = {
        str(path.relative_to(ROOT)): name
        for path in sources(*(f"iwm_power_manager/{part}" for part in ROS_FREE))
        for name in imports_of(path)
        if name.split(".")[0] in ROS_MODULES or name.startswith(("iwm_power_manager.ros", "iwm_power_manager.nodes"))
    }
    assert not guilty


def test_no_tracked_file_names_a_place_on_the_machine_it_was_written_on() -> None:
    tracked = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    home = re.compile(rb"(?<![\w.])/(home|root|Users|work)/\w")
    guilty = [
        name
        for name in tracked.split("\0")
        if name and (ROOT / name).is_file() and home.search((ROOT / name).read_bytes())
    ]
    assert not guilty


@pytest.mark.parametrize("group", ["build", "base", "ros", "test", "dev"])
def test_every_pinned_package_has_the_hashes_of_its_files(group: str) -> None:
    text = (ROOT / "requirements" / f"{group}.txt").read_text().replace("\\\n", " ")
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    assert lines
    for line in lines:
        assert re.fullmatch(r"[\w.-]+==\S+( ;.*?)?( +--hash=sha256:[0-9a-f]{64})+\s*", line), line[:80]
