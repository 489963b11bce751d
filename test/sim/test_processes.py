# SPDX-License-Identifier: Apache-2.0
"""Children that are started, watched and stopped together; real processes, none of them ours to keep."""

import os
import subprocess
import sys
import time

import pytest

from iwm_sim.processes import ChildError, Children

OBEDIENT = """
import signal, sys, time
signal.signal(signal.SIGINT, lambda *_: sys.exit(0))
print("ready", flush=True)
while True:
    time.sleep(0.01)
"""
STUBBORN = """
import signal, time
signal.signal(signal.SIGINT, signal.SIG_IGN)
signal.signal(signal.SIGTERM, signal.SIG_IGN)
print("ready", flush=True)
while True:
    time.sleep(0.01)
"""


def python(code):
    return [sys.executable, "-c", code]


def wait_for(condition):
    end = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def ready(child):
    wait_for(lambda: "ready" in child.log.read_text())
    return child


def test_an_interrupted_child_ends_and_its_output_stays(tmp_path):
    with Children(os.environ, tmp_path) as children:
        child = ready(children.start("node", python(OBEDIENT)))
        child.interrupt()
        assert not child.running
    assert (tmp_path / "node.log").read_text() == "ready\n"


def test_leaving_ends_every_child(tmp_path):
    with Children(os.environ, tmp_path) as children:
        started = [ready(children.start(name, python(OBEDIENT))) for name in ("first node", "second node")]
    assert not any(child.running for child in started)
    assert (tmp_path / "first_node.log").exists()


def test_leaving_by_an_error_ends_them_too_and_keeps_the_error(tmp_path):
    with pytest.raises(ZeroDivisionError), Children(os.environ, tmp_path) as children:
        child = ready(children.start("node", python(OBEDIENT)))
        raise ZeroDivisionError
    assert not child.running


def test_a_child_that_fails_is_reported_with_its_last_lines(tmp_path):
    with Children(os.environ, tmp_path) as children:
        child = children.start("node", python("print('why'); raise SystemExit(3)"))
        child.process.wait()
        with pytest.raises(ChildError, match="the node ended with exit code 3") as caught:
            child.check()
    assert caught.value.last_lines == ["why"]


def test_a_child_that_is_killed_is_reported_by_signal(tmp_path):
    with Children(os.environ, tmp_path) as children:
        child = ready(children.start("node", python(OBEDIENT)))
        child.process.kill()
        child.process.wait()
        with pytest.raises(ChildError, match="the node was killed by SIGKILL"):
            child.check()


def test_a_child_that_ends_well_but_too_early_is_an_error_where_it_must_run(tmp_path):
    with Children(os.environ, tmp_path) as children:
        child = children.start("node", python("pass"))
        child.process.wait()
        child.check()
        with pytest.raises(ChildError, match="the node ended too early"):
            child.check_running()


def test_a_child_that_will_not_end_is_ended(tmp_path, monkeypatch):
    monkeypatch.setattr("iwm_sim.processes.ASK_S", 0.2)
    with Children(os.environ, tmp_path) as children:
        child = ready(children.start("node", python(STUBBORN)))
        with pytest.raises(ChildError, match=r"the node did not end within 0\.1 s"):
            child.interrupt(patience_s=0.1)
        assert not child.running


def test_standard_output_can_go_to_a_pipe_while_errors_go_to_the_log(tmp_path):
    with Children(os.environ, tmp_path) as children:
        code = "import sys; print('out'); print('err', file=sys.stderr)"
        child = children.start("node", python(code), stdout=subprocess.PIPE)
        assert child.process.stdout.read() == b"out\n"
        child.process.wait()
        child.process.stdout.close()
    assert (tmp_path / "node.log").read_text() == "err\n"
