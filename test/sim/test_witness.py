"""What the machine did: stalls of a processor, and waits of a process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from array import array
from pathlib import Path

import pytest

from iwm_sim.witness import Stall, Witness

#: Wants the processor it is given all the time.
BUSY = "import os, sys; os.sched_setaffinity(0, {int(sys.argv[1])})\nwhile True: pass"


def witness_of(*stalls: list[Stall]) -> Witness:
    witness = Witness(0)
    witness.stalls = dict(enumerate(stalls))
    return witness


def test_what_stalls_took_is_what_lies_within() -> None:
    witness = witness_of([Stall(1.0, 1.2), Stall(2.0, 2.3), Stall(5.0, 6.0)])
    assert witness.machine_s(0.0, 1.0) == 0.0
    assert witness.machine_s(1.2, 2.0) == 0.0
    assert witness.machine_s(0.0, 9.0) == pytest.approx(1.5)
    assert witness.machine_s(1.1, 2.1) == pytest.approx(0.2)
    assert witness.machine_s(5.2, 5.5) == pytest.approx(0.3)


def test_processors_stand_still_at_the_same_time_and_do_not_add_up() -> None:
    assert witness_of([Stall(1.0, 1.2)], [Stall(1.1, 1.4)], []).machine_s(1.0, 2.0) == pytest.approx(0.3)


def test_a_wait_counts_when_it_is_longer_than_the_stalls() -> None:
    witness = witness_of([Stall(1.0, 1.2)])
    witness.times_s = array("d", [0.8, 0.9, 1.1, 1.3, 1.4])
    witness.waited_s = array("d", [7.0, 7.0, 7.25, 7.25, 7.5])
    assert witness.machine_s(0.95, 1.25) == pytest.approx(0.25)
    assert witness.machine_s(0.85, 1.05) == pytest.approx(0.25)
    assert witness.machine_s(1.15, 1.25) == pytest.approx(0.05)  # the stall's part
    assert witness.machine_s(1.35, 9.0) == pytest.approx(0.25)
    assert witness.machine_s(2.0, 9.0) == 0.0


@pytest.mark.skipif(not Path("/proc/self/schedstat").exists(), reason="the kernel does not tell how long tasks wait")
def test_it_sees_a_process_wait_for_its_processor() -> None:
    processor = str(min(os.sched_getaffinity(0)))
    watched, other = (subprocess.Popen([sys.executable, "-c", BUSY, processor]) for _ in range(2))
    witness = Witness(watched.pid)
    try:
        witness.start()
        deadline_s = time.monotonic() + 30.0
        while not witness.waited_s or witness.waited_s[-1] < 0.2:
            assert time.monotonic() < deadline_s
            time.sleep(0.01)
    finally:
        witness.stop()
        for process in (watched, other):
            process.kill()
            process.wait()
    assert witness.machine_s(witness.times_s[0], witness.times_s[-1]) >= 0.15
    assert "priority" in witness.summary()


def test_it_sees_that_nothing_runs() -> None:
    # Stopping a whole process is what a host does to a virtual machine.
    code = (
        "import sys, time; from iwm_sim.witness import Witness; witness = Witness(0); witness.start(); "
        "time.sleep(0.2); print('begun', flush=True); sys.stdin.readline(); time.sleep(0.05); witness.stop(); "
        "print(max(s.end_s - s.begin_s for stalls in witness.stalls.values() for s in stalls))"
    )
    process = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "begun\n"
    process.send_signal(signal.SIGSTOP)
    began_s = time.monotonic()
    time.sleep(0.3)
    lasted_s = time.monotonic() - began_s
    process.send_signal(signal.SIGCONT)
    longest_s = float(process.communicate("\n", timeout=30)[0])
    assert longest_s == pytest.approx(lasted_s, abs=0.1)
