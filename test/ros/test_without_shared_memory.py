# SPDX-License-Identifier: Apache-2.0
"""The Fast DDS profile of docs/safety.md, duty 7: a node that shares no memory still hears nodes that do."""

from __future__ import annotations

import os
from pathlib import Path

from bench import Bench, Running, arguments

from campaigns import soak


def test_it_drives_and_is_heard_without_shared_memory(tmp_path: Path, compiled_law: None) -> None:
    domain, namespace = int(os.environ["ROS_DOMAIN_ID"]), f"/without_shared_memory_{os.getpid()}"
    # The bench runs with LOCALHOST, as all tests do, and has shared memory.
    bench = Bench(domain, namespace=namespace)
    args = arguments(
        {"strategy": "equal", "policy_file": ""}, {"__ns": namespace, "/diagnostics": f"{namespace}/diagnostics"}
    )
    running = Running("iwm_power_manager.nodes.power_manager", args, domain, tmp_path, soak.without_shared_memory({}))
    try:
        bench.connect()
        bench.drive(lambda: bench.states and bench.states[-1]["mode"] == 1.0, "the normal mode")
        assert not soak.shares_memory(running.process.pid)
        assert soak.shares_memory(os.getpid())
        assert running.stop() == 0, running.text()
    finally:
        bench.close()
        running.process.kill()
        running.process.wait()
    assert not soak.shares_memory(running.process.pid)  # it has ended
