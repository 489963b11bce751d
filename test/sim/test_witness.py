"""What the machine did: stalls of a processor, and waits of a process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from iwm_sim.witness import Look, Stall, Witness

#: Wants the processor it is given all the time.
BUSY = "import os, sys; os.sched_setaffinity(0, {int(sys.argv[1])})\nwhile True: pass"


def waited_s(pid: int) -> float:
    return int(Path(f"/proc/{pid}/schedstat").read_text().split()[1]) / 1e9


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


def test_what_a_process_that_wanted_to_run_was_not_given_counts() -> None:
    witness = witness_of([Stall(0.4, 0.6), Stall(1.1, 1.2)])
    # Asleep until 1.0, then it wants to run until it sleeps again between 1.4 and 1.5, and was given 0.05 s.
    witness.looks = [
        Look(0.5, 7.0, 3, 0),
        Look(1.0, 7.0, 3, 1),
        Look(1.2, 7.02, 3, 1),
        Look(1.4, 7.05, 3, 1),
        Look(1.5, 7.08, 4, 0),
        Look(2.0, 7.08, 4, 0),
    ]
    assert witness.machine_s(1.0, 1.4) == pytest.approx(0.35)  # the stall at 1.1 is in it
    assert witness.machine_s(0.5, 1.4) == pytest.approx(0.45)
    assert witness.machine_s(0.0, 9.0) == pytest.approx(0.2 + 0.35)
    assert witness.machine_s(1.1, 1.2) == pytest.approx(0.09)
    assert witness.machine_s(1.4, 9.0) == 0.0  # it slept at some time: only stalls count
    witness.looks = witness.looks[3:]
    assert witness.machine_s(0.0, 9.0) == pytest.approx(0.3)


def test_time_it_used_itself_is_not_the_machines() -> None:
    witness = witness_of([])
    witness.looks = [Look(1.0, 7.0, 3, 1), Look(1.2, 7.2, 3, 1), Look(1.3, 7.31, 3, 1)]
    assert witness.machine_s(1.0, 1.3) == 0.0


@pytest.mark.skipif(not Path("/proc/self/schedstat").exists(), reason="the kernel does not tell how long tasks wait")
def test_it_sees_a_process_wait_for_its_processor() -> None:
    processor = str(min(os.sched_getaffinity(0)))
    watched, other = (subprocess.Popen([sys.executable, "-c", BUSY, processor]) for _ in range(2))
    try:
        with Witness(watched.pid) as witness:
            before_s = waited_s(watched.pid)
            deadline_s = time.monotonic() + 30.0
            while waited_s(watched.pid) < before_s + 0.2:
                assert time.monotonic() < deadline_s
                time.sleep(0.01)
    finally:
        for process in (watched, other):
            process.kill()
            process.wait()
    lasted_s = witness.looks[-1].time_s - witness.looks[0].time_s
    used_s = witness.looks[-1].used_s - witness.looks[0].used_s
    taken_s = witness.machine_s(witness.looks[0].time_s, witness.looks[-1].time_s)
    assert taken_s >= 0.15 and taken_s == pytest.approx(lasted_s - used_s, abs=0.05)
    assert "priority" in witness.summary()


def test_it_sees_that_nothing_runs() -> None:
    processor = max(os.sched_getaffinity(0))
    with Witness(os.getpid(), {processor}) as witness:
        watching = witness.processes[0]
        # Stopping what runs on a processor is what a host does to a virtual machine.
        began_s = time.time()
        watching.send_signal(signal.SIGSTOP)
        time.sleep(0.3)
        watching.send_signal(signal.SIGCONT)
        ended_s = time.time()
    assert witness.stalls.keys() == {processor}
    assert witness.machine_s(began_s, ended_s) >= 0.25
    assert max(stall.end_s - stall.begin_s for stall in witness.stalls[processor]) < ended_s - began_s + 0.1
    assert "stood still" in witness.summary()


def test_it_watches_where_it_is_told_and_ends_with_whom_it_watches_for() -> None:
    processor = max(os.sched_getaffinity(0))
    with Witness(os.getpid(), {processor}) as witness:
        watching, asking = witness.processes
        assert os.sched_getaffinity(watching.pid) == {processor}
        assert os.sched_getaffinity(asking.pid) == os.sched_getaffinity(0)
        if witness.real_time:
            assert os.sched_getscheduler(watching.pid) == os.SCHED_FIFO
    assert [process.returncode for process in witness.processes] == [0, 0]
    times_s = [look.time_s for look in witness.looks]
    assert times_s and times_s == sorted(times_s)
