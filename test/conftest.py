# SPDX-License-Identifier: Apache-2.0
"""What all tests share: an own DDS domain on this machine only, logs that leave no trace, Hypothesis profiles."""

from __future__ import annotations

import fcntl
import os
import random
import signal
import tempfile
from pathlib import Path
from typing import IO

import pytest
from hypothesis import HealthCheck, Phase, settings

ROOT = Path(__file__).resolve().parents[1]
#: Files whose tests have bounds on the clock, send signals at chosen moments, watch what the machine does, wait for a
#: process of low priority, or send single messages between processes that have just found each other.
_KEEP_TIME = (
    *(f"/bags/test_{name}.py" for name in ("power_cut", "recording", "recover")),
    *(f"/campaigns/test_{name}.py" for name in ("faults", "witness")),
    *(f"/ros/test_{name}.py" for name in ("ending", "interruption", "realtime", "replay_publish", "spinning")),
    *(f"/ros/test_power_manager_{name}.py" for name in ("cold", "held_up", "inputs", "pace", "time")),
    *("/ros/test_power_manager_second_publisher.py", "/sim/test_processes.py", "/tools/test_watch_car.py"),
    *(f"/ros/test_{name}.py" for name in ("connect", "examples", "interface_page", "neighbours", "recorder_node")),
    *(f"/ros/test_power_manager_{name}.py" for name in ("demand_log", "errors", "hostile", "lifecycle", "names")),
    "/ros/test_without_shared_memory.py",
)

#: In pytest's cache: the run of all other tests, which comes first, had none.
_NONE_OF_THE_OTHERS = "make_test/none_of_the_others"

# Continuous integration repeats the same examples: a change is judged by what it changes, not by luck.
settings.register_profile("default", deadline=None, suppress_health_check=[HealthCheck.too_slow], derandomize=True)
settings.register_profile("nightly", settings.get_profile("default"), max_examples=20_000, derandomize=False)
# A mutation run wants the first counterexample at once, not the smallest one.
settings.register_profile(
    "mutation",
    settings.get_profile("default"),
    max_examples=100,
    derandomize=True,
    database=None,
    phases=(Phase.explicit, Phase.generate),
)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "default"))


def _claim_domain() -> tuple[int, IO[str]]:
    """Find a DDS domain that no other test run on this machine has claimed; it is free again when the file closes."""
    folder = Path(tempfile.gettempdir()) / f"iwm_power_manager-domains-{os.getuid()}"
    folder.mkdir(exist_ok=True)
    # Above 101 the ports of a domain reach into those that Linux hands out to clients.
    for domain in random.sample(range(1, 102), 101):
        claim = (folder / str(domain)).open("w")
        try:
            fcntl.flock(claim, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            claim.close()
            continue
        return domain, claim
    raise RuntimeError("every DDS domain from 1 to 101 is claimed by a test run")


def pytest_configure(config: pytest.Config) -> None:
    """Set the environment before any module is imported; child processes inherit it."""
    # What runs in a script's background, or under nohup, is born deaf to these, and so would be what tests interrupt.
    for number, handler in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
        if signal.getsignal(number) == signal.SIG_IGN:
            signal.signal(number, handler)
    os.environ.pop("COLUMNS", None)  # xdist has one: tables are as wide as where no terminal is
    domain, claim = _claim_domain()
    logs = tempfile.TemporaryDirectory(prefix="iwm-ros-log-")
    config.add_cleanup(claim.close)
    config.add_cleanup(logs.cleanup)
    os.environ.update(
        ROS_DOMAIN_ID=str(domain),
        ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST",
        ROS_LOG_DIR=logs.name,
        MPLBACKEND="Agg",
        FASTRTPS_DEFAULT_PROFILES_FILE=str(Path(__file__).with_name("quick_discovery.xml")),
    )


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what keeps time: these tests have the cores for themselves; others wait for what has to happen."""
    for item in items:
        if item.path.as_posix().endswith(_KEEP_TIME):
            item.add_marker(pytest.mark.processes)


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    """`make test` runs the others and these in turn: with `-k` one of both may have none, but not both."""
    chosen, cache = session.config.option.markexpr, getattr(session.config, "cache", None)
    if "processes" not in chosen or cache is None or hasattr(session.config, "workerinput"):
        return
    none, of_the_others = exitstatus == pytest.ExitCode.NO_TESTS_COLLECTED, "not processes" in chosen
    if none and (of_the_others or not cache.get(_NONE_OF_THE_OTHERS, False)):
        session.exitstatus = pytest.ExitCode.OK
    if of_the_others:
        cache.set(_NONE_OF_THE_OTHERS, none)
