# SPDX-License-Identifier: Apache-2.0
"""Workers on dask: the serial rows bit for bit, whoever dies, and none that computes other numbers."""

import os
import signal
import subprocess
import sys

import pytest

from iwm_power_manager.errors import ConfigError, IwmError
from iwm_sim.cluster import connected
from iwm_sim.fleet.run import Runner, batched, runner
from iwm_sim.fleet.store import Store
from iwm_sim.fleet.task import Drive, fingerprint


def begun(path, client, fleet):
    store = Store(path)
    return store, Runner(store, store.begin(fingerprint(), fleet.files), client, 0.0)


def test_two_workers_give_the_rows_of_the_serial_run_bit_for_bit(client, fleet, serial, tmp_path):
    store, running = begun(tmp_path / "study", client, fleet)
    heard, lines = [], []
    running.check_workers(lines.append)
    summary = running.run(Drive, fleet.drives, heard.append)
    assert (summary.tasks, summary.known, summary.batches, summary.workers) == (10, 0, 10, 2)
    assert sum(heard) == 10
    assert lines[0].startswith("2 workers, ")
    assert store.table(Drive).equals(serial.table(Drive))


def test_the_batches_of_a_killed_worker_are_done_by_another(client, fleet, serial, tmp_path):
    store, running = begun(tmp_path / "study", client, fleet)
    victims = []

    def kill_one(_):
        if (tmp_path / "study" / "rows").exists() and any((tmp_path / "study" / "rows").iterdir()) and not victims:
            victims.append(next(iter(client.run(os.getpid).values())))
            os.kill(victims[0], signal.SIGKILL)

    running.run(Drive, fleet.drives, kill_one)
    assert victims
    assert store.table(Drive).equals(serial.table(Drive))
    client.wait_for_workers(2)
    assert victims[0] not in client.run(os.getpid).values()


def test_a_worker_whose_mathematics_gives_other_bits_is_refused(client, fleet, serial, tmp_path):
    """The C library without its fused multiply-add stands for another processor."""
    _, running = begun(tmp_path / "study", client, fleet)
    client.wait_for_workers(2)
    command = [sys.executable, "-m", "distributed.cli.dask_worker", client.scheduler.address, "--no-dashboard"]
    environment = os.environ | {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-AVX512F,-AVX512VL,-FMA4"}
    other = subprocess.Popen([*command, "--no-nanny", "--name", "other"], env=environment, stderr=subprocess.DEVNULL)
    try:
        client.wait_for_workers(3, timeout=60)
        if len({theirs["numbers"] for theirs in client.run(fingerprint).values()}) == 1:
            pytest.skip("this processor has nothing the C library could go without")
        with pytest.raises(IwmError, match=r"worker tcp://.*: computes other numbers than this study: numbers "):
            running.check_workers(lambda _: None)
    finally:
        other.terminate()
        other.wait()


def test_an_address_where_nobody_answers_is_named(monkeypatch, fleet, tmp_path):
    monkeypatch.setattr("iwm_sim.cluster.ANSWER_S", 0.5)
    with pytest.raises(ConfigError, match=r"--scheduler: tcp://127\.0\.0\.1:1"), connected("tcp://127.0.0.1:1", 1):
        pass
    with pytest.raises(ConfigError, match="--scheduler: nowhere"), connected("nowhere://x", 1):
        pass


def test_batches_hold_so_many_seconds_of_neighbours_and_the_longest_come_first(fleet):
    one = fleet.drives[0].seconds
    batches = batched(fleet.drives, 3.5 * one)
    assert sorted(len(batch) for batch in batches) == [2, 4, 4]
    assert len(batches[0]) == 4
    assert {task for batch in batches for task in batch} == set(fleet.drives)
    assert batched([], 1.0) == []


def test_an_error_of_a_task_comes_out_as_it_was_raised(client, fleet, hill, tmp_path):
    copy = tmp_path / "gone.csv"
    copy.write_text(hill.read_text())
    from dataclasses import replace

    task = Drive(tuple(replace(case, cycle=str(copy)) for case in fleet.drives[0].cases))
    _, running = begun(tmp_path / "study", client, fleet)
    copy.unlink()
    with pytest.raises(ConfigError, match=r"gone.csv: cannot be read"):
        running.run(Drive, [task])


def test_a_study_can_join_a_scheduler_that_somebody_started(client, fleet, serial, tmp_path):
    store = Store(tmp_path / "study")
    with runner(store, fleet.files, client.scheduler.address, 1, 60.0) as running:
        running.check_workers(lambda _: None)
        assert running.run(Drive, fleet.drives).known == 0
    assert store.table(Drive).equals(serial.table(Drive))
