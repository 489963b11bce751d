# SPDX-License-Identifier: Apache-2.0
"""What the machine did: stalls of a processor, and waits of a process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from campaigns import soak
from campaigns.witness import Look, Stall, Witness, overlap_s

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


def test_what_was_withheld_counts_although_the_kernel_booked_it_as_used() -> None:
    witness = witness_of([])
    witness.looks = [Look(1.0, 7.0, 3, 1), Look(1.2, 7.2, 3, 1), Look(1.4, 7.3, 3, 1), Look(1.6, 7.5, 4, 1)]
    witness.withheld[0] = np.array([[0.9, 1.05], [1.1, 1.12], [1.25, 1.27], [1.45, 1.5]])
    assert witness.machine_s(1.0, 1.2) == pytest.approx(0.07)
    assert witness.machine_s(1.04, 1.11) == pytest.approx(0.02)
    assert witness.machine_s(1.2, 1.4) == pytest.approx(0.1)  # it was not given 0.1, and 0.02 may be a part of that
    assert witness.machine_s(1.4, 1.6) == 0.0  # it slept


def test_slow_work_is_told_and_not_deducted() -> None:
    witness = witness_of([])
    seconds = np.arange(100.0)
    witness.withheld[0] = np.column_stack([seconds, seconds + 0.1])
    witness.work_s[0] = np.where(seconds == 50.0, 240e-6, 10e-6)
    witness.looks = [Look(time_s, time_s, 0, 1) for time_s in seconds]
    assert witness.slowest_work_s(45.0, 55.0) == pytest.approx((240e-6, 10e-6))
    assert witness.slowest_work_s(51.0, 55.0) == pytest.approx((10e-6, 10e-6))
    assert witness.slowest_work_s(200.0, 201.0) == (0.0, 0.0)
    assert witness.machine_s(45.0, 55.0) == pytest.approx(1.0)
    late = soak.LateStep(10.0, 2.0, 0.0)
    assert "240 us (10 us usually)" in soak.slow_memory(witness, late, 40.5)
    assert soak.slow_memory(witness, late, 60.0) == ""


def test_a_stall_counts_only_if_it_woke_in_it() -> None:
    stalls = (Stall(1.05, 1.15), Stall(1.21, 1.55), Stall(1.61, 1.64))
    witness = witness_of([*stalls])
    asleep = [Look(1.0 + 0.1 * i, 7.0, 3, 0) for i in range(6)]
    witness.looks = [*asleep, Look(1.6, 7.01, 3, 1), Look(1.7, 7.11, 3, 1)]
    assert witness.machine_s(1.0, 1.7) == pytest.approx(0.34)  # the first was over while it slept, the last is booked
    assert witness.machine_s(1.3, 1.7) == pytest.approx(0.25)
    assert witness.machine_s(1.0, 1.5) == 0.0
    witness.stalls[0][1] = Stall(1.21, 1.4998)  # over for so short a time that it had yet to be woken
    assert witness.machine_s(1.0, 1.7) == pytest.approx(0.2898)
    witness.stalls[0][1] = stalls[1]
    witness.looks[6] = Look(1.6, 7.01, 4, 0)  # it woke and slept again
    assert witness.machine_s(1.0, 1.6) == pytest.approx(0.34)
    witness.looks = asleep
    assert witness.machine_s(1.0, 9.0) == pytest.approx(0.05 + 0.03)  # nobody looked after 1.5


#: Writes down from when to when it could not read the clock.
CLOCK_READER = """
import array, gc, os, signal, sys, time
os.sched_setaffinity(0, {int(sys.argv[1])})
gc.disable()
found, ended = array.array("d"), []
signal.signal(signal.SIGTERM, lambda *_: ended.append(1))
print("reading", flush=True)
last = time.time()
while not ended:
    now = time.time()
    if now - last > 1e-5:
        found.append(last)
        found.append(now)
    last = now
sys.stdout.buffer.write(found.tobytes())
"""


def test_while_the_witness_is_to_run_nothing_else_does() -> None:
    processor = max(os.sched_getaffinity(0))
    reader = subprocess.Popen([sys.executable, "-c", CLOCK_READER, str(processor)], stdout=subprocess.PIPE)
    assert reader.stdout is not None
    assert reader.stdout.readline() == b"reading\n"
    with Witness(reader.pid, {processor}) as witness:
        time.sleep(1.0)  # what is to be seen has to happen first
    reader.terminate()
    gaps = np.frombuffer(reader.communicate()[0]).reshape(-1, 2)
    withheld = witness.withheld[processor]
    if not witness.real_time:
        assert len(withheld) == 0  # it cannot know
        return
    assert len(withheld) > 1000
    lasted_s = withheld[:, 1] - withheld[:, 0]
    assert np.all(lasted_s > 0.0) and np.all(withheld[1:, 0] >= withheld[:-1, 1] - 1e-4)
    without_clock_s = sum(overlap_s(gaps, *span) for span in withheld)
    assert without_clock_s > 0.95 * lasted_s.sum()


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
