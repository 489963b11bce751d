# SPDX-License-Identifier: Apache-2.0
"""With an empty kernel cache the node drives at once, goes over to the compiled law, and leaves no process behind."""

from __future__ import annotations

import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest
from bench import PATIENCE_S, Bench
from diagnostic_msgs.msg import DiagnosticStatus

from iwm_power_manager.control.strategies import STRATEGIES
from iwm_power_manager.nodes.compiling import NICE

ROOT = Path(__file__).resolve().parents[2]
EQUAL, CHOSEN = (STRATEGIES[name].code for name in ("equal", "sdp_lookahead"))


@pytest.fixture
def cold(start_own: Callable[..., Any], empty_cache: dict[str, str]) -> Any:
    """A power manager whose kernel cache is empty, with its bench; on a busy machine, too, it drives at once and on."""
    parameters = {"strategy": "sdp_lookahead", "policy_file": "policies", "rate_hz": 10.0, "missed_periods": 100}
    patient = {"own_gap_s": 60.0, "clock_stopped_s": 60.0, "command_oldest_s": 1.0}
    return start_own(parameters | patient, environment=empty_cache)


def child_of(pair: Any) -> psutil.Process:
    """The process that compiles, once there is one; stopped, so that it does not end before a test wants it to."""
    node = psutil.Process(pair.running.process.pid)
    child = pair.bench.spin_until(node.children, "a process that compiles", 3.0 * PATIENCE_S)[0]
    child.suspend()
    return child


def law(bench: Bench) -> tuple[bytes, str]:
    """Level and words of what is said of the law."""
    status = bench.status("law")
    return (status.level, status.message) if status else (b"", "")


def drives(bench: Bench) -> bool:
    return bench.mode() == 1 and bool(bench.torques) and any(bench.torques[-1].effort)


def test_it_drives_before_the_law_is_compiled_and_goes_over_without_a_break(cold) -> None:
    bench, child = cold.bench, child_of(cold)
    bench.drive(lambda: drives(bench) and law(bench)[0] == DiagnosticStatus.WARN, "torque and a report")
    assert "plain Python" in law(bench)[1]
    assert bench.last("setting.strategy") == EQUAL
    first = len(bench.states) - 1
    child.resume()
    lowest = min(psutil.Process(cold.running.process.pid).nice() + NICE, 19)
    bench.drive(lambda: child.nice() == lowest, "a process that gives way")
    assert Path(f"/proc/{child.pid}/oom_score_adj").read_text() == "1000\n"
    bench.drive(
        lambda: law(bench) == (DiagnosticStatus.OK, "compiled"), "the compiled law", patience_s=5.0 * PATIENCE_S
    )
    over = len(bench.states)
    bench.drive(lambda: len(bench.states) > over + 20, "steps of it")
    assert bench.last("setting.strategy") == CHOSEN
    driven = bench.states[first:]
    codes = [state["setting.strategy"] for state in driven]
    assert codes == sorted(codes, key=[EQUAL, CHOSEN].index), "it went over once"
    at = codes.index(CHOSEN)
    assert driven[at]["step"] > driven[at - 1]["step"], "the law forgot what was before"
    assert cold.running.text().count("law: compiled") == 1
    assert "Traceback" not in cold.running.text()
    child.wait(PATIENCE_S)


def test_where_the_child_process_is_killed_it_says_so_and_goes_on_without(cold) -> None:
    bench = cold.bench
    child_of(cold).kill()
    bench.drive(lambda: "ended by signal 9" in law(bench)[1], "what happened to the process that compiles")
    assert law(bench)[0] == DiagnosticStatus.WARN
    bench.drive(lambda: drives(bench), "torque")
    bench.drive(lambda: bench.frictions and sum(bench.frictions[-1].effort) < -1.0, "brakes", demand=-20000.0)
    assert cold.running.text().count("ended by signal 9") == 1
    assert bench.last("setting.strategy") == EQUAL


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_however_the_node_ends_the_child_process_ends_with_it(cold, sent) -> None:
    child = child_of(cold)
    cold.bench.drive(lambda: drives(cold.bench), "torque", patience_s=2.0 * PATIENCE_S)
    assert child.status() == psutil.STATUS_STOPPED
    child.resume()
    cold.running.stop(sent)
    child.wait(2.0 * PATIENCE_S)  # it gives way to whatever else runs


def test_for_how_long_it_has_been_compiling_is_said(cold) -> None:
    bench = cold.bench
    child_of(cold)  # which hangs
    said = bench.drive(lambda: [v for s in [bench.status("law")] if s for v in s.values if int(v.value) > 0], "seconds")
    assert [value.key for value in said] == ["compiling for, s"]


def test_where_no_process_can_be_started_it_drives_all_the_same(start_own, tmp_path, empty_cache) -> None:
    (tmp_path / "sitecustomize.py").write_text("import sys; sys.executable = ''")  # as in a program that embeds Python
    environment = empty_cache | {"PYTHONPATH": f"{tmp_path}:{ROOT}"}
    pair = start_own({"rate_hz": 10.0, "missed_periods": 100, "own_gap_s": 60.0}, environment=environment)
    bench = pair.bench
    bench.drive(lambda: drives(bench) and "no process can compile it: [Errno" in law(bench)[1], "torque and the reason")
    assert law(bench)[0] == DiagnosticStatus.WARN


def test_cleaned_up_it_compiles_no_more(cold) -> None:
    bench, child = cold.bench, child_of(cold)
    bench.spin_until(lambda: bench.lifecycle_state() == "active", "active")
    assert bench.change_state("deactivate")
    assert bench.change_state("cleanup")
    child.wait(PATIENCE_S)  # stopped as it is: it is ended, and does not end by itself
