# SPDX-License-Identifier: Apache-2.0
"""The launch files, run by launch itself: where ROS 2 is installed. The wheels have no launch, and PyPI has none.

There `launch` and `launch_ros` may be put on PYTHONPATH from their sources; see docs/install.md.
"""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip(
    "launch_ros.actions",
    reason="no launch_ros, which is no wheel: source a ROS 2 installation and call make test (CI does), or put the "
    "sources of launch and launch_ros on PYTHONPATH (docs/install.md)",
)

from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    IncludeLaunchDescription,
    OpaqueFunction,
    RegisterEventHandler,
    SetEnvironmentVariable,
    TimerAction,
)
from launch.event_handlers import OnProcessExit, OnProcessIO
from launch.events import Shutdown
from launch.launch_description_sources import PythonLaunchDescriptionSource

from launch import LaunchDescription, LaunchService

ROOT = Path(__file__).resolve().parents[2]
LAUNCH = ROOT / "launch"
PATIENCE_S = 240.0
MODULES = {
    "power_manager": "iwm_power_manager.nodes.power_manager",
    "recorder": "iwm_power_manager.nodes.recorder",
    "replay": "iwm_power_manager.tools.replay",
    "simulator": "iwm_sim.simulator",
}


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A prefix as colcon leaves it, of links into this checkout."""
    prefix = tmp_path_factory.mktemp("prefix")
    index = prefix / "share" / "ament_index" / "resource_index" / "packages"
    index.mkdir(parents=True)
    (index / "iwm_power_manager").touch()
    (prefix / "share" / "iwm_power_manager").symlink_to(ROOT)
    folder = prefix / "lib" / "iwm_power_manager"
    folder.mkdir(parents=True)
    for name, module in MODULES.items():
        script = folder / name
        script.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m {module} "$@"\n')
        script.chmod(0o755)
    return prefix


class Launched:
    """What came of a launch: what its processes said, and how they ended."""

    def __init__(self) -> None:
        self.text = ""
        self.codes: dict[str, int] = {}
        self.timed_out = False


@pytest.fixture
def launch(installed: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., Launched]:
    """Run a launch file until its processes have ended, or until one has said something: then it is shut down."""
    others = os.environ.get("AMENT_PREFIX_PATH", "")
    monkeypatch.setenv("AMENT_PREFIX_PATH", os.pathsep.join(filter(None, (str(installed), others))))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join((str(ROOT), os.environ.get("PYTHONPATH", ""))))
    monkeypatch.chdir(tmp_path)

    def run(file: str, /, until: str = "", **arguments: Any) -> Launched:
        found = Launched()
        service = LaunchService(argv=[])

        def heard(event: Any) -> Any:
            said = not until or until in found.text
            found.text += event.text.decode(errors="replace")
            return [shutdown("it was said")] if not said and until in found.text else None

        def ended(event: Any, _: Any) -> None:
            found.codes[event.process_name.rsplit("-", 1)[0]] = event.returncode

        def shutdown(reason: str) -> Any:
            return EmitEvent(event=Shutdown(reason=reason))

        def give_up(_: Any) -> Any:
            found.timed_out = True
            return [shutdown("it took too long")]

        service.include_launch_description(
            LaunchDescription(
                [
                    SetEnvironmentVariable("PYTHONUNBUFFERED", "1"),
                    RegisterEventHandler(OnProcessIO(on_stdout=heard, on_stderr=heard)),
                    RegisterEventHandler(OnProcessExit(on_exit=ended)),
                    TimerAction(period=PATIENCE_S, actions=[OpaqueFunction(function=give_up)]),
                    IncludeLaunchDescription(
                        PythonLaunchDescriptionSource(str(LAUNCH / file)),
                        launch_arguments=[(key, str(value)) for key, value in arguments.items()],
                    ),
                ]
            )
        )
        asyncio.set_event_loop(asyncio.new_event_loop())
        code = service.run(shutdown_when_idle=True)
        assert code == 0, found.text
        assert not found.timed_out, found.text
        return found

    return run


@pytest.mark.parametrize("path", sorted(LAUNCH.glob("*.launch.py")), ids=lambda path: path.name)
def test_every_argument_is_shown_with_its_meaning(path: Path, installed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(installed))
    description = PythonLaunchDescriptionSource(str(path)).try_get_launch_description_without_context()
    arguments = description.get_launch_arguments()
    assert arguments and all(isinstance(argument, DeclareLaunchArgument) for argument in arguments)
    assert all(argument.description.endswith(".") for argument in arguments)


@pytest.mark.parametrize("lifecycle", ["autostart", "managed"])
def test_the_power_manager_alone_becomes_active_and_ends_well(launch: Callable[..., Launched], lifecycle: str) -> None:
    found = launch(
        "power_manager.launch.py",
        until="waits for vehicle_speed",
        lifecycle=lifecycle,
        namespace=f"/launched_{os.getpid()}",
        name="splitter",
    )
    assert "active" in found.text
    assert "inactive: zero torque was commanded" in found.text
    assert "SIGTERM" not in found.text and "ERROR" not in found.text
    assert found.codes == {"power_manager": 0}


def test_a_closed_loop_is_driven_recorded_and_replayed(launch: Callable[..., Launched], tmp_path: Path) -> None:
    cycle = tmp_path / "short.csv"
    cycle.write_text("time_s,speed_mps\n0,0\n3,4\n5,4\n8,0\n")
    bag = tmp_path / "drive"
    domain = {"namespace": f"/driven_{os.getpid()}"}
    driven = launch("closed_loop.launch.py", cycle_file=cycle, lockstep="true", record="true", bag=bag, **domain)
    assert driven.codes == {"simulator": 0, "power_manager": 0, "recorder": 0}
    assert (bag / "metadata.yaml").is_file()
    replayed = launch("replay.launch.py", bag=bag, rate="4.0", **domain)
    assert replayed.codes == {"replay": 0, "power_manager": 0}
    assert "first torque" in replayed.text
