# SPDX-License-Identifier: Apache-2.0
"""Leaving DDS: a process that has done its work ends, in time and with its exit code."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time

import pytest
from bench import Bench, arguments
from rclpy.duration import Duration
from rclpy.publisher import Publisher

from iwm_power_manager.ros import ending, realtime

#: Sleeps in C with the interpreter's lock in hand, as a destructor of Fast DDS may.
STUCK = """
import ctypes, sys
from iwm_power_manager.ros import ending
with ending.bounded({code}, 0.3):
    ctypes.PyDLL(None).pause()
"""

#: The same at the interpreter's end.
STUCK_AT_EXIT = """
import atexit, ctypes, sys
from iwm_power_manager.ros import ending
atexit.register(ctypes.PyDLL(None).pause)
sys.exit(ending.at_exit({code}))
"""

#: Runs a node's `main` and tells which threads of DDS it leaves to the interpreter's end.
REMAINS = """
import importlib, os, sys
code = importlib.import_module(sys.argv.pop(1)).main()
names = [open(f"/proc/self/task/{thread}/comm").read().strip() for thread in os.listdir("/proc/self/task")]
print("exit code", code)
print("left", [name for name in names if name.startswith("dds.") and name != "dds.shm.wdog"])
"""


def run(code: str, *args: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code, *args], capture_output=True, text=True, timeout=60, check=False)


@pytest.mark.parametrize("code", [0, 1])
def test_a_destructor_that_never_returns_does_not_keep_the_process(code) -> None:
    for program in (STUCK, STUCK_AT_EXIT):
        ended = run(program.format(code=code))
        assert (ended.returncode, ended.stdout, ended.stderr) == (code, "", "")


#: A command that has used DDS and leaves a thread behind that never ends.
LEAVES_A_THREAD = """
import sys, threading, types
from iwm_power_manager import executables
from iwm_power_manager.ros import ending
def main():
    threading.Thread(target=threading.Event().wait).start()
    return 3
sys.modules["some_module"] = types.SimpleNamespace(main=main)
sys.exit(executables.power_manager.func("some_module", 0))
"""


def test_a_thread_that_never_ends_does_not_keep_a_command() -> None:
    ended = run(LEAVES_A_THREAD)
    assert (ended.returncode, ended.stdout, ended.stderr) == (3, "", "")


#: Goes on for longer than leaving may take: nothing to wait for, it is the timer that must not come.
GOES_ON = """
import sys, time
from iwm_power_manager.ros import ending
with ending.bounded(9, 1.5):
    pass
time.sleep(2.0)
sys.exit(3)
"""

WRONG = """
from iwm_power_manager.ros import ending
with ending.bounded(9):
    raise ZeroDivisionError
"""


def test_who_has_left_in_time_goes_on() -> None:
    assert run(GOES_ON).returncode == 3


def test_what_went_wrong_is_not_hidden() -> None:
    ended = run(WRONG)
    assert ended.returncode == 1 and "ZeroDivisionError" in ended.stderr


def test_all_threads_share_a_processor_until_dds_is_left() -> None:
    end = threading.Event()
    other = threading.Thread(target=end.wait)
    other.start()
    assert other.native_id is not None
    threads = [threading.get_native_id(), other.native_id]
    before = [os.sched_getaffinity(thread) for thread in threads]
    try:
        with ending.one_processor():
            chosen = [os.sched_getaffinity(thread) for thread in threads]
        assert [os.sched_getaffinity(thread) for thread in threads] == before
    finally:
        end.set()
        other.join()
    assert len(chosen[0]) == 1
    assert chosen[0] == chosen[1]
    assert chosen[0] <= before[0]


def test_a_thread_that_may_not_be_moved_stays(monkeypatch) -> None:
    def refuse(_thread: int, _processors: set[int]) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setaffinity", refuse)
    with ending.one_processor():
        pass


def test_leaving_is_not_done_at_a_priority_over_others(monkeypatch) -> None:
    asked = {}
    monkeypatch.setattr(os, "sched_setscheduler", lambda thread, policy, param: asked.update({thread: (policy, param)}))
    before = set(os.listdir("/proc/self/task"))
    realtime.give_up_priority()
    assert asked[threading.get_native_id()] == (os.SCHED_OTHER, os.sched_param(0))
    # A thread of another test may end or begin meanwhile.
    assert before & set(os.listdir("/proc/self/task")) <= set(map(str, asked))


PRIORITY = """
import os
from iwm_power_manager.ros import ending
asked = []
os.sched_setscheduler = lambda thread, policy, _: asked.append(policy)
with ending.bounded(9):
    print(asked != [] and set(asked) == {os.SCHED_OTHER}, len(os.sched_getaffinity(0)))
"""


def test_priority_is_given_up_and_processors_shared_before_dds_is_left() -> None:
    assert run(PRIORITY).stdout == "True 1\n"


@pytest.mark.parametrize(
    ("module", "parameters", "code"),
    [
        ("iwm_power_manager.nodes.power_manager", {"policy_file": ""}, 2),  # there is a node, it does not start
        ("iwm_power_manager.nodes.power_manager", {"rate_hz": 1e6}, 2),  # there is half a node
        ("iwm_power_manager.nodes.recorder", {"output": "/proc/nowhere/bag"}, 2),
        ("iwm_sim.simulator", {"cycle_file": "/nowhere.csv"}, 2),
    ],
)
def test_a_node_that_cannot_start_leaves_no_dds_to_the_end_of_the_interpreter(module, parameters, code) -> None:
    ended = run(REMAINS, module, *arguments(parameters))
    assert ended.stdout == f"exit code {code}\nleft []\n", ended.stderr


def test_a_node_that_has_run_leaves_no_dds_to_the_end_of_the_interpreter(compiled_law) -> None:
    namespace = f"/ending_{os.getpid()}"
    bench = Bench(namespace=namespace)
    given = arguments({"policy_file": "", "strategy": "equal"}, {"__ns": namespace})
    node = "iwm_power_manager.nodes.power_manager"
    process = subprocess.Popen([sys.executable, "-c", REMAINS, node, *given], stdout=subprocess.PIPE, text=True)
    try:
        bench.spin_until(lambda: bench.torques, "a command")
    finally:
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=60)
        bench.close()
    assert output == "exit code 0\nleft []\n"


#: A node whose middleware never lets go of it.
HELD_FAST = """
import ctypes, sys
import rclpy
from iwm_power_manager.nodes import power_manager
from iwm_power_manager.ros import ending
assert 2 * ending.SHORT_S + ending.LIMIT_S < 5.0, "launch gives a node 5 s"
rclpy.try_shutdown = lambda *_, **__: ctypes.PyDLL(None).pause()
sys.exit(power_manager.main())
"""


def test_a_node_that_dds_does_not_let_go_ends_before_launch_loses_patience(compiled_law) -> None:
    """Launch waits 5 s before it prints errors and sends the next signal; a busy machine may take longer."""
    namespace = f"/held_fast_{os.getpid()}"
    bench = Bench(namespace=namespace)
    given = arguments({"policy_file": "", "strategy": "equal"}, {"__ns": namespace})
    process = subprocess.Popen([sys.executable, "-c", HELD_FAST, *given])
    try:
        bench.connect()
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60.0) == 0
    finally:
        process.kill()
        process.wait()
        bench.close()


def test_those_who_do_not_answer_are_waited_for_together(node, monkeypatch) -> None:
    """Cars with a topic for each motor and brake have eight, and what the node still has to write comes after."""
    waited_s: list[float] = []

    def wait(_: Publisher, timeout: Duration) -> bool:
        waited_s.append(timeout.nanoseconds * 1e-9)
        time.sleep(waited_s[-1])
        return False

    monkeypatch.setattr(Publisher, "wait_for_all_acked", wait)
    assert node.start()
    node.stop()
    assert len(waited_s) == 2
    assert sum(waited_s) <= 0.2


#: The same, however long leaving may take, while it compiles.
COMPILING = """
import ctypes, sys, threading
import rclpy
from iwm_power_manager.nodes import power_manager, preparation
from iwm_power_manager.ros import ending
ending.LIMIT_S = 600.0
preparation.prepare = lambda _: print("compiling", flush=True) or threading.Event().wait()
rclpy.try_shutdown = lambda *_, **__: ctypes.PyDLL(None).pause()
sys.exit(power_manager.main())
"""


def test_a_node_that_compiles_owes_nothing_and_is_not_waited_for_long() -> None:
    given = arguments({"policy_file": "", "strategy": "equal"}, {"__ns": f"/compiling_{os.getpid()}"})
    process = subprocess.Popen([sys.executable, "-c", COMPILING, *given], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None and process.stdout.readline() == "compiling\n"
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=60.0) == 0
    finally:
        process.kill()
        process.communicate()
