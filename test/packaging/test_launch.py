# SPDX-License-Identifier: Apache-2.0
"""The launch files say what their arguments are, and give nodes only parameters that they have.

Launch itself is not among the wheels this is tested with: stand-ins note what the files make of it.
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from iwm_power_manager.nodes import power_manager_config, recorder
from iwm_sim import simulator

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted((ROOT / "launch").glob("*.launch.py"))
SPECS = {
    "power_manager": power_manager_config.SPECS,
    "recorder": recorder.PARAMETERS,
    "simulator": simulator.PARAMETERS,
}
made: list[tuple[str, tuple[Any, ...], dict[str, Any]]] = []


class _StandIns(ModuleType):
    """A module that has a class of any name; what is made of it is noted."""

    __path__: list[str] = []  # noqa: RUF012 - makes it a package

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)

        def make(*args: Any, **kwargs: Any) -> Any:
            made.append((name, args, kwargs))
            return (name, args, tuple(kwargs.items()))

        return make


@pytest.fixture(params=FILES, ids=[path.name for path in FILES])
def description(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Any:
    for name in [
        "launch",
        "launch.actions",
        "launch.conditions",
        "launch.event_handlers",
        "launch.events",
        "launch.substitutions",
        "launch_ros",
        "launch_ros.actions",
        "launch_ros.event_handlers",
        "launch_ros.events",
        "launch_ros.events.lifecycle",
        "launch_ros.parameter_descriptions",
        "launch_ros.substitutions",
        "ament_index_python",
        "ament_index_python.packages",
    ]:
        monkeypatch.setitem(sys.modules, name, _StandIns(name))
    monkeypatch.setattr(sys.modules["ament_index_python.packages"], "get_package_share_directory", lambda _: str(ROOT))
    made.clear()
    spec = importlib.util.spec_from_file_location("launched", request.param)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.generate_launch_description()


def of(*kinds: str) -> list[tuple[tuple[Any, ...], dict[str, Any]]]:
    return [(args, kwargs) for name, args, kwargs in made if name in kinds]


def test_every_argument_is_declared_and_explained(description: Any) -> None:
    declared = {args[0]: kwargs for args, kwargs in of("DeclareLaunchArgument")}
    assert all(kwargs["description"].endswith(".") for kwargs in declared.values())
    used = {args[0] for args, _ in of("LaunchConfiguration")}
    assert used <= set(declared)


def test_nodes_get_parameters_that_they_have_and_files_that_exist(description: Any) -> None:
    nodes = [kwargs for _, kwargs in of("Node", "LifecycleNode")]
    assert nodes
    for node in nodes:
        known = {spec.name for spec in SPECS[node["executable"]]} | {"use_sim_time"}
        for given in node["parameters"]:
            if isinstance(given, dict):
                assert set(given) <= known
            elif isinstance(given, str):
                assert Path(given).is_file()
