# SPDX-License-Identifier: Apache-2.0
"""Nodes over real DDS: every test run has a domain of its own, every test a namespace."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parent))

import member
from bench import Bench, Running, arguments
from member import domain

from iwm_power_manager.ros import ending

MODULE = "iwm_power_manager.nodes.power_manager"
#: Runs without a policy file, which is all most tests need.
EQUAL = {"strategy": "equal", "policy_file": ""}


class Pair:
    """A power manager and a bench in one namespace."""

    count = 0

    def __init__(
        self,
        folder: Path,
        parameters: dict[str, Any],
        *,
        sim_time: bool = False,
        environment: dict[str, str] | None = None,
        remaps: dict[str, str] | None = None,
    ) -> None:
        Pair.count += 1
        namespace = f"/test_{os.getpid()}_{Pair.count}"
        self.bench = Bench(lockstep=bool(parameters.get("lockstep")), namespace=namespace, sim_time=sim_time)
        names = {"__ns": namespace, "/diagnostics": f"{namespace}/diagnostics", "/clock": f"{namespace}/clock"}
        given = {name.replace("{namespace}", namespace): value for name, value in parameters.items()}
        self.arguments = arguments({**EQUAL, **given, "use_sim_time": sim_time}, names | (remaps or {}))
        # The node as it is shipped, which shares no memory; only the bench announces itself more often than usual.
        self._environment = {"FASTRTPS_DEFAULT_PROFILES_FILE": "", **(environment or {})}
        self._folder = folder
        self.running = self.start()

    def start(self) -> Running:
        """Start the node (again)."""
        self.running = Running(MODULE, self.arguments, domain(), self._folder, self._environment)
        return self.running

    def close(self) -> None:
        """End both."""
        self.bench.close()
        self.running.process.kill()
        self.running.process.wait()


@pytest.fixture(scope="session", autouse=True)
def _leaves_dds_last() -> Iterator[None]:
    # A `main` that is called here leaves DDS; the test run, with far more garbage than a node, is not to end with it.
    ending.LIMIT_S = ending.SHORT_S = 600.0
    yield
    member.leave()


@pytest.fixture(scope="session")
def compiled_law() -> None:
    """Compile the law once, before processes are started that have to answer in time."""
    from iwm_power_manager.control.repeat import advance
    from iwm_power_manager.control.settings import default_settings
    from iwm_power_manager.control.table import empty_table
    from iwm_power_manager.control.types import Measurement, initial_state
    from iwm_power_manager.held import Held
    from iwm_power_manager.share import resolve
    from iwm_power_manager.vehicle import load_vehicle

    vehicle = Held(load_vehicle(resolve("config/vehicles/jalalmaab_2015.yaml")).params)
    before, after = Held(initial_state()), Held(initial_state())
    measurement = Measurement(1.0, (3.0, 3.0, 3.0, 3.0), 1.0, 0.01, 0.9, 1.0, 1.0, 0.5)
    advance(measurement, before, after, default_settings("equal"), vehicle, empty_table())


@pytest.fixture
def empty_cache(tmp_path: Path) -> dict[str, str]:
    """Environment in which a node finds no kernel, in none of the folders where it looks."""
    (tmp_path / "tmp").mkdir()
    return {"IWM_CACHE_DIR": str(tmp_path / "cache"), "NUMBA_CACHE_DIR": "", "TMPDIR": str(tmp_path / "tmp")}


def _pairs(folders: pytest.TempPathFactory) -> Iterator[Callable[..., Pair]]:
    pairs: list[Pair] = []

    def start(parameters: dict[str, Any] | None = None, **options: Any) -> Pair:
        pairs.append(Pair(folders.mktemp("node"), parameters or {}, **options))
        return pairs[-1]

    yield start
    for pair in pairs:
        pair.close()


@pytest.fixture(scope="module")
def start_pair(tmp_path_factory: pytest.TempPathFactory, compiled_law: None) -> Iterator[Callable[..., Pair]]:
    """Start a power manager with parameters; all end with the module."""
    yield from _pairs(tmp_path_factory)


@pytest.fixture
def start_own(tmp_path_factory: pytest.TempPathFactory, compiled_law: None) -> Iterator[Callable[..., Pair]]:
    """The same for one test, with which they end."""
    yield from _pairs(tmp_path_factory)


@pytest.fixture(scope="module")
def ros(compiled_law: None) -> Iterator[None]:
    """ROS in this process, for a power manager that nobody else on the domain hears."""
    import rclpy

    parameters = {**EQUAL, "autostart": False}
    rclpy.init(args=arguments(parameters, {"__ns": "/here", "/diagnostics": "/here/diagnostics"}))
    anchor = member.anchor()
    yield
    anchor.destroy_node()
    rclpy.shutdown()


@pytest.fixture
def node(ros: None) -> Iterator[Any]:
    """A power manager in this process, unconfigured; whoever asks for it serves it."""
    from iwm_power_manager.nodes.power_manager_node import PowerManager

    node = PowerManager()
    yield node
    node.stop()
    node.destroy_node()
