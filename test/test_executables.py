# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C ends an installed command cleanly, however early it comes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from iwm_power_manager import executables
from iwm_sim import executables as sim_executables

ROOT = Path(__file__).resolve().parents[1]
NODES = ["power_manager", "recorder", "simulator"]
COMMANDS = [
    "demo", "evaluate", "fleet", "import_cycle", "import_motor", "learn_policy", "precompile", "replay", "solve_policy",
]  # fmt: skip

#: Stands in for a library whose import takes long.
SLOW = """\
import os, signal, time
signal.signal(signal.SIGUSR1, lambda *_: os.write(1, b"still importing\\n"))  # print() may be interrupted by itself
os.write(1, b"importing\\n")
try:
    while True:
        time.sleep(0.01)  # pause() would sleep on through a signal that came just before it
except BaseException as error:
    raise ImportError("half imported") from error
"""


#: A test run in a shell's background ignores SIGINT, and so would what it starts.
HEED_CTRL_C = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"


def start(name: str, library: str, folder: Path, setup: str = HEED_CTRL_C) -> subprocess.Popen[str]:
    """Start an executable as its launcher does, with a library that is still being imported."""
    (folder / f"{library}.py").write_text(SLOW)
    package = "iwm_power_manager" if hasattr(executables, name) else "iwm_sim"
    code = f"import sys; {setup}; from {package}.executables import {name}; sys.exit({name}())"
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)])},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "importing\n"
    return process


@pytest.mark.parametrize(
    ("name", "library", "code"),
    [(name, "rclpy", 0) for name in NODES] + [(name, "numpy", 130) for name in COMMANDS],
)
def test_ctrl_c_during_the_imports_ends_it_without_a_word(tmp_path, name, library, code) -> None:
    process = start(name, library, tmp_path)
    process.send_signal(signal.SIGINT)
    assert process.communicate(timeout=60) == ("", "")
    assert process.returncode == code


def test_where_ctrl_c_is_ignored_the_imports_ignore_it_too(tmp_path) -> None:
    process = start("demo", "numpy", tmp_path, "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)")
    process.send_signal(signal.SIGINT)
    process.send_signal(signal.SIGUSR1)
    assert process.stdout is not None
    assert process.stdout.readline() == "still importing\n"
    process.terminate()
    process.communicate(timeout=60)


@pytest.fixture
def heeding_ctrl_c():
    """SIGINT as Python has it by default, also where the tests run in a shell's background; SIGTERM as it was."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("heeding_ctrl_c")
def test_ctrl_c_that_main_does_not_deal_with_gives_the_exit_code(monkeypatch) -> None:
    def main() -> int:
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
        raise KeyboardInterrupt

    monkeypatch.setattr(executables.importlib, "import_module", lambda name: type(name, (), {"main": main}))
    assert executables.run("some.module", executables.INTERRUPTED) == 130


#: A command whose work is done, and an interpreter that takes its time to end.
SLOW_END = """\
import atexit, signal, sys, types
from iwm_power_manager import executables
def linger():
    signal.signal(signal.SIGUSR1, lambda *_: None)
    print("ending", flush=True)
    while signal.sigwait([signal.SIGUSR1]) != signal.SIGUSR1:
        pass
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGUSR1])
sys.modules["some_module"] = types.SimpleNamespace(main=lambda: 0)
atexit.register(linger)
sys.exit(executables.run("some_module", 0))
"""


def test_a_second_ctrl_c_while_the_interpreter_ends_is_no_crash() -> None:
    process = subprocess.Popen([sys.executable, "-c", SLOW_END], stdout=subprocess.PIPE, text=True, cwd=ROOT)
    assert process.stdout is not None
    assert process.stdout.readline() == "ending\n"
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1):
        process.send_signal(number)
    assert process.wait(60) == 0


@pytest.mark.parametrize("name", NODES + COMMANDS)
def test_every_executable_names_a_module_with_a_main(name) -> None:
    command = getattr(executables, name, None) or getattr(sim_executables, name)
    module, ended = command.args
    assert command.func is executables.power_manager.func, "one way to end, which is bounded"
    assert callable(executables.importlib.import_module(module).main)
    assert ended == (0 if name in NODES else 130)


def nobody_reading(code: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """A Python program whose standard output is a pipe that is closed at its other end."""
    read, write = os.pipe()
    os.close(read)
    try:
        command = [sys.executable, "-c", code, *arguments]
        return subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True, cwd=ROOT, check=False)
    finally:
        os.close(write)


@pytest.mark.parametrize("name", [*NODES, *COMMANDS, "set_parameter", "watch_car"])
def test_a_closed_pipe_ends_a_command_without_a_word(name) -> None:
    package = "iwm_power_manager" if hasattr(executables, name) else "iwm_sim"
    ended = nobody_reading(f"import sys; from {package}.executables import {name}; sys.exit({name}())", "--help")
    assert (ended.returncode, ended.stderr) == (0, "")


#: A command that prints far more than a pipe holds.
TALKATIVE = """\
import sys, types
from iwm_power_manager import executables
sys.modules["some_module"] = types.SimpleNamespace(main=lambda: print("line\\n" * 100_000))
sys.exit(executables.run("some_module", 130))
"""


def test_head_takes_a_line_and_nothing_else_is_said() -> None:
    script = '"$0" -c "$1" | head -1; echo "${PIPESTATUS[@]}"'
    command = ["bash", "-c", script, sys.executable, TALKATIVE]
    ended = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert (ended.stdout, ended.stderr) == ("line\n0 0\n", "")


def test_a_broken_pipe_to_something_else_is_no_end_of_the_output() -> None:
    program = TALKATIVE.replace('print("line\\n" * 100_000)', "(_ for _ in ()).throw(BrokenPipeError('a worker'))")
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT, check=False)
    assert ended.returncode == 1
    assert ended.stderr.endswith("BrokenPipeError: a worker\n")
