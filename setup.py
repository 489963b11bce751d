# SPDX-License-Identifier: Apache-2.0
"""Build description, read alike by colcon (`ros.ament_python`) and by pip. Name and version stand in package.xml."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

# After setuptools, which replaces the standard library's missing distutils.
from distutils.command.install_data import install_data  # isort: skip

ROOT = Path(__file__).resolve().parent
MANIFEST = ElementTree.parse(ROOT / "package.xml").getroot()
NAME = str(MANIFEST.findtext("name"))

EXECUTABLES = {
    "demo": "iwm_sim.executables:demo",
    "evaluate": "iwm_sim.executables:evaluate",
    "fleet": "iwm_sim.executables:fleet",
    "import_cycle": "iwm_power_manager.executables:import_cycle",
    "import_motor": "iwm_power_manager.executables:import_motor",
    "learn_policy": "iwm_sim.executables:learn_policy",
    "power_manager": "iwm_power_manager.executables:power_manager",
    "precompile": "iwm_sim.executables:precompile",
    "recorder": "iwm_power_manager.executables:recorder",
    "replay": "iwm_power_manager.executables:replay",
    "set_parameter": "iwm_power_manager.executables:set_parameter",
    "simulator": "iwm_sim.executables:simulator",
    "solve_policy": "iwm_power_manager.executables:solve_policy",
    "watch_car": "iwm_power_manager.executables:watch_car",
}


def shared_files() -> list[tuple[str, list[str]]]:
    """What goes to share/, folder by folder, with the two files that make this a ROS package."""
    files = [
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml", "LICENSE"]),
    ]
    for top in ("config", "launch", "policies"):
        for folder, _, names in sorted(os.walk(top)):
            sources = [f"{folder}/{name}" for name in sorted(names) if not name.startswith(".")]
            if sources and not folder.endswith("__pycache__"):
                files.append((f"share/{NAME}/{folder}", sources))
    return files


class InstallData(install_data):
    """Adds, for pip, what colcon makes by itself: the executables where `ros2 run` looks for them."""

    def run(self) -> None:
        """Copy the data files and, into a wheel, write a launcher for every executable."""
        super().run()
        if self.distribution.get_command_obj("bdist_wheel", create=False) is None:
            return
        folder = Path(self.install_dir) / "lib" / NAME
        folder.mkdir(parents=True, exist_ok=True)
        for name in EXECUTABLES:
            launcher = folder / name
            launcher.write_text(f'#!/bin/sh\nexec "$(dirname -- "$0")/../../bin/{name}" "$@"\n')
            launcher.chmod(0o755)
            self.outfiles.append(str(launcher))


setup(
    name=NAME,
    version=MANIFEST.findtext("version"),
    description="Stochastic power management for cars with in-wheel motors, as ROS 2 nodes and offline tools",
    long_description=(ROOT / "README.md").read_text(encoding="utf-8") if (ROOT / "README.md").exists() else "",
    long_description_content_type="text/markdown",
    author=MANIFEST.findtext("author"),
    author_email=MANIFEST.find("author").get("email"),
    maintainer=MANIFEST.findtext("maintainer"),
    maintainer_email=MANIFEST.find("maintainer").get("email"),
    project_urls={link.get("type"): link.text for link in MANIFEST.iter("url")},
    license=MANIFEST.findtext("license"),
    python_requires=">=3.12",
    packages=find_packages(include=["iwm_power_manager*", "iwm_sim*"]),
    package_data={"iwm_power_manager": ["py.typed"], "iwm_sim": ["py.typed"], "iwm_sim.study": ["assets/*"]},
    data_files=shared_files(),
    install_requires=[
        "jinja2",
        "distributed",
        "lz4",
        "matplotlib",
        "mcap",
        "numba",
        "numpy",
        "pillow",
        "pyyaml",
        "rosbags",
        "scipy",
        "tqdm",
        "zstandard",
    ],
    extras_require={
        # Only where no ROS 2 Jazzy is installed: the same rclpy and Fast DDS as wheels.
        "ros": ["ros-jazzy-common-interfaces", "ros-jazzy-rclpy[fastrtps]"],
        "test": ["pytest"],
        # A DataFrame of a drive (`iwm_sim.api`).
        "frame": ["pandas"],
        # The rows of `fleet`.
        "fleet": ["pyarrow"],
        # The page of `watch_car`.
        "watch": ["bokeh"],
    },
    zip_safe=False,
    entry_points={"console_scripts": [f"{name} = {target}" for name, target in EXECUTABLES.items()]},
    cmdclass={"install_data": InstallData},
    # The first line of a script cannot hold a path with a space; then PATH has to lead to the Python.
    options={"build_scripts": {"executable": "/usr/bin/env python3"}} if " " in sys.executable else {},
)
