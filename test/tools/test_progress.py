# SPDX-License-Identifier: Apache-2.0
"""Progress on stderr."""

import io
import time

import pytest

from iwm_power_manager import jit
from iwm_power_manager.tools.progress import Bar, show_compiling


class _Screen(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def clock(monkeypatch):
    """Seconds that pass only when the test says so."""
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    return now


def test_a_log_gets_plain_lines_at_coarse_steps(clock, capsys):
    with Bar(40, "cases", "driving") as bar:
        for _ in range(40):
            clock[0] += 4.0
            bar.update()
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "driving: 4 of 40 cases in 00:16"
    assert lines[-1] == "driving: 40 of 40 cases in 02:40"
    assert len(lines) == 10


def test_a_log_gets_nothing_of_what_is_done_at_once(clock, capsys):
    with Bar(3, "cases") as bar:
        for _ in range(3):
            bar.set_postfix_str("nycc")
            bar.update()
    assert capsys.readouterr().err == ""


def test_a_log_that_has_heard_nothing_for_long_gets_a_line_all_the_same(clock, capsys):
    with Bar(40, "cases", "driving") as bar:
        for _ in range(7):
            clock[0] += 10.0
            bar.refresh()
    assert capsys.readouterr().err.splitlines() == [
        "driving: 0 of 40 cases in 00:30",
        "driving: 0 of 40 cases in 01:00",
    ]


def test_compiling_shows_how_many_functions_are_ready(clock, capsys):
    show_compiling()
    for kernel in ("iwm_power_manager.control.law.step", "iwm_sim.plant.advance"):
        jit.watch.begin(kernel, 4)
        for _ in range(4):
            clock[0] += 6.0
            jit.watch.ready()
        jit.watch.end()
    said = capsys.readouterr().err.splitlines()
    assert sum(line.startswith("compiling for this machine") for line in said) == 1
    assert "compiling control.law.step: 1 of 4 functions in 00:06" in said
    assert said[-1] == "compiling plant.advance: 4 of 4 functions in 00:24"
    show_compiling(quiet=True)
    assert jit.watch is None


def test_a_screen_gets_a_bar_that_is_gone_in_the_end(monkeypatch):
    screen = _Screen()
    monkeypatch.setattr("sys.stderr", screen)
    with Bar(2, "cases", "driving") as bar:
        bar.update(2)
        bar.refresh()
    assert "driving: 100%" in screen.getvalue()
    assert screen.getvalue().endswith("\r")


def test_quiet_is_quiet_on_a_screen_and_in_a_log(monkeypatch, clock, capsys):
    for stream in (_Screen(), io.StringIO()):
        monkeypatch.setattr("sys.stderr", stream)
        with Bar(2, "cases", quiet=True) as bar:
            clock[0] += 60.0
            bar.update(2)
        assert stream.getvalue() == ""
