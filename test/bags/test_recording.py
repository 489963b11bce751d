# SPDX-License-Identifier: Apache-2.0
"""The recording thread: nothing lost without being counted, whatever the disk does."""

from __future__ import annotations

import errno
import json
import os
import resource
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from bags_helpers import float64, topic
from disk_helpers import on_small_disk, private_folder
from iwm_power_manager.bags import recording as recording_module
from iwm_power_manager.bags.limits import MESSAGE_OVERHEAD_BYTES as SAMPLE_OVERHEAD_BYTES
from iwm_power_manager.bags.mcap_file import McapFile
from iwm_power_manager.bags.reader import BagReader
from iwm_power_manager.bags.recording import Recording, RecordingOptions
from iwm_power_manager.bags.recover import recover
from iwm_power_manager.bags.writer import Sample, WriterOptions
from iwm_power_manager.errors import BagError

SAMPLE_BYTES = SAMPLE_OVERHEAD_BYTES + len(float64(0.0))


def samples(first: int, count: int, number: int = 1) -> list[Sample]:
    return [(number, i * 1_000_000, float64(i), i, i + 1) for i in range(first, first + count)]


def values(path: Path) -> list[int]:
    with BagReader(path) as reader:
        found = [message.publish_time_ns for message in reader.messages()]
        assert reader.damage == []
    return found


def hold_the_writer(recording: Recording) -> threading.Event:
    """Block the writing thread until the event is set, as a slow disk would."""
    entered, release = threading.Event(), threading.Event()

    def block() -> None:
        entered.set()
        release.wait(30)

    threading.Thread(target=recording.call, args=(block,), daemon=True).start()
    assert entered.wait(30)
    return release


def test_all_that_is_put_is_written_in_order(tmp_path: Path) -> None:
    recording = Recording(tmp_path / "bag")
    recording.start()
    assert recording.add_topic(topic("/a")) == 1
    for i in range(100):
        recording.put(samples(i * 10, 10))
    recording.put([])
    recording.close()
    assert values(tmp_path / "bag") == list(range(1000))
    status = recording.status()
    assert (status.written, status.pending, status.queue_bytes) == (1000, 0, 0)


def test_messages_are_in_the_file_within_the_flush_period(tmp_path: Path) -> None:
    recording = Recording(tmp_path / "bag", RecordingOptions(flush_period_s=0.05))
    recording.start()
    recording.add_topic(topic("/a"))
    recording.put(samples(0, 10))
    flushed = threading.Event()
    while not flushed.wait(0.01):
        if recording.status().written == 10:
            flushed.set()
    with BagReader(tmp_path / "bag") as reader:  # the recording goes on
        assert sum(1 for _ in reader.messages()) == 10
    recording.close()


def test_a_full_queue_drops_the_newest_messages_counts_them_and_keeps_its_memory(tmp_path: Path) -> None:
    recording = Recording(tmp_path / "bag", RecordingOptions(queue_bytes=105 * SAMPLE_BYTES))
    recording.start()
    recording.add_topic(topic("/a"))
    release = hold_the_writer(recording)
    for i in range(20):
        recording.put(samples(i * 10, 10))
    status = recording.status()
    assert status.dropped_queue == 95
    assert status.queue_bytes == status.queue_peak_bytes == 105 * SAMPLE_BYTES
    release.set()
    recording.close()
    assert values(tmp_path / "bag") == list(range(105))
    assert recording.status().written == 105


def test_stop_and_start_make_a_bag_each(tmp_path: Path) -> None:
    recording = Recording(tmp_path / "bag", custom_data={"key": "value"})
    recording.add_topic(topic("/a"))
    recording.put(samples(0, 5))  # not recording yet
    assert recording.start() == tmp_path / "bag"
    recording.put(samples(5, 5))
    with pytest.raises(BagError, match="is being recorded already"):
        recording.start()
    assert recording.stop() == tmp_path / "bag"
    recording.put(samples(10, 5))
    with pytest.raises(BagError, match="nothing is being recorded"):
        recording.stop()
    assert recording.start() == tmp_path / "bag_1"
    recording.add_custom_data({"late": "yes"})
    recording.put(samples(15, 5))
    recording.close()
    recording.close()
    assert values(tmp_path / "bag") == list(range(5, 10))
    assert values(tmp_path / "bag_1") == list(range(15, 20))
    with BagReader(tmp_path / "bag_1") as reader:
        assert reader.custom_data == {"key": "value", "late": "yes"}
    with pytest.raises(BagError, match="closing"):
        recording.start()


def test_split_begins_a_new_file_and_loses_nothing(tmp_path: Path) -> None:
    recording = Recording(tmp_path / "bag")
    recording.start()
    recording.add_topic(topic("/a"))
    recording.put(samples(0, 7))
    recording.split()
    recording.put(samples(7, 3))
    recording.close()
    assert len(list((tmp_path / "bag").glob("*.mcap"))) == 2
    assert values(tmp_path / "bag") == list(range(10))
    assert recording.status().files == 2


def test_a_snapshot_holds_the_last_seconds_whether_a_bag_is_recorded_or_not(tmp_path: Path) -> None:
    recording = Recording(tmp_path / "bag", RecordingOptions(snapshot_s=0.5))
    recording.add_topic(topic("/a"))
    recording.put(samples(0, 1000))
    first = recording.snapshot()
    recording.put(samples(1000, 200))
    second = recording.snapshot()
    recording.close()
    assert (first.name, second.name) == ("bag_snapshot_1", "bag_snapshot_2")
    assert values(first) == list(range(499, 1000))
    assert values(second) == list(range(699, 1200))
    assert not (tmp_path / "bag").exists()


def test_the_snapshot_keeps_to_its_memory(tmp_path: Path) -> None:
    recording = Recording(tmp_path / "bag", RecordingOptions(snapshot_s=60.0, snapshot_bytes=50 * SAMPLE_BYTES))
    recording.add_topic(topic("/a"))
    recording.put(samples(0, 1000))
    assert values(recording.snapshot()) == list(range(950, 1000))
    recording.close()


def test_without_snapshot_memory_the_reason_is_given(tmp_path: Path) -> None:
    recording = Recording(tmp_path / "bag")
    with pytest.raises(BagError, match="set snapshot_s above 0"):
        recording.snapshot()
    recording.close()


def test_too_large_messages_are_counted_and_all_others_written(tmp_path: Path) -> None:
    recording = Recording(tmp_path / "bag", RecordingOptions(writer=WriterOptions(max_message_bytes=50)))
    recording.start()
    recording.add_topic(topic("/a"))
    batch = samples(0, 10)
    batch[3] = (1, 0, bytes(51), 0, 0)
    batch[9] = (1, 0, bytes(1000), 0, 0)
    recording.put(batch)
    recording.close()
    status = recording.status()
    assert (status.written, status.dropped_size, status.dropped_error) == (8, 2, 0)
    assert "1000 bytes was not written" in status.error
    assert len(values(tmp_path / "bag")) == 8


def test_a_full_disk_ends_the_recording_with_every_message_accounted_for(tmp_path: Path) -> None:
    recording = Recording(
        tmp_path / "bag", RecordingOptions(writer=WriterOptions(compression="none", chunk_bytes=4096), sync=False)
    )
    recording.start()
    recording.add_topic(topic("/a"))
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, before[1]))
    try:
        put = 0
        while not recording.failed.wait(0.001):
            recording.put(samples(put, 100))
            put += 100
        recording.put(samples(put, 50))
        recording.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    status = recording.status()
    assert status.state == "failed"
    assert "cannot be written: File too large" in status.error
    assert status.written + status.dropped_error == put + 50
    with BagReader(tmp_path / "bag") as reader:
        assert [message.publish_time_ns for message in reader.messages()] == list(range(status.written))
    recover(tmp_path / "bag")  # there was no room for an index
    assert values(tmp_path / "bag") == list(range(status.written))


#: Records until the disk is full; then reads, recovers elsewhere, makes room, and records again. Says what happened.
FULL_DISK_CHILD = """
import dataclasses, json, sys
from pathlib import Path
import shutil
from bags_helpers import float64, topic
from iwm_power_manager.bags.reader import BagReader
from iwm_power_manager.bags.recording import Recording, RecordingOptions
from iwm_power_manager.bags.recover import recover
from iwm_power_manager.bags.writer import Sample, WriterOptions

disk, elsewhere = Path(sys.argv[1]), Path(sys.argv[2])

def values(path):
    with BagReader(path) as reader:
        return [message.publish_time_ns for message in reader.messages()]

recording = Recording(
    disk / "bag", RecordingOptions(WriterOptions("none", chunk_bytes=4096, max_bytes=int(sys.argv[3])), 0.01)
)
recording.start()
recording.add_topic(topic("/a"))
put = 0
while not recording.failed.wait(0.0005):
    recording.put([(1, i, float64(i), i, i + 1) for i in range(put, put + 100)])
    put += 100
status = recording.call(recording.status)  # behind all that was put
read = values(disk / "bag")
shutil.copytree(disk / "bag", elsewhere)
recover(elsewhere)
try:
    recording.start()
    refused = ""
except Exception as error:
    refused = str(error)
shutil.rmtree(disk / "bag")
again = recording.start()
recording.put([(1, i, float64(i), i, i + 1) for i in range(5)])
recording.close()
status = dataclasses.asdict(status)
print(json.dumps({"put": put, "status": status, "read": read, "refused": refused, "again": values(again)}))
"""


@pytest.mark.parametrize("max_bytes", [0, 60_000], ids=["one file", "split files"])
def test_on_a_disk_that_fills_up_all_that_was_written_stays_readable(tmp_path: Path, max_bytes: int) -> None:
    disk, elsewhere = tmp_path / "disk", tmp_path / "copy"
    disk.mkdir()
    child = [sys.executable, "-c", FULL_DISK_CHILD, str(disk), str(elsewhere), str(max_bytes)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        on_small_disk(disk, "size=200k", child), capture_output=True, text=True, check=False, env=environment
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    status = found["status"]
    assert status["state"] == "failed"
    assert status["error"] == f"{disk / 'bag'}: cannot be written: No space left on device"
    assert found["read"] == list(range(status["written"]))
    assert status["written"] > 500
    assert status["written"] + status["dropped_error"] == found["put"]
    assert values(elsewhere) == found["read"]
    assert found["refused"] == f"{disk / 'bag_1'}: cannot be written: No space left on device"
    assert found["again"] == list(range(5))


def test_a_read_only_folder_fails_the_start_and_leaves_nothing(tmp_path: Path) -> None:
    with private_folder() as folder:
        folder.chmod(0o555)
        recording = Recording(folder / "new" / "bag")
        with pytest.raises(BagError, match="bag: cannot be created: Permission denied"):
            recording.start()
        assert list(folder.iterdir()) == []
        folder.chmod(0o755)
        assert recording.start() == folder / "new" / "bag"
        recording.close()


def test_a_folder_that_becomes_read_only_keeps_the_present_file_and_fails_at_the_next(tmp_path: Path) -> None:
    with private_folder() as folder:
        recording = Recording(folder / "bag", RecordingOptions(flush_period_s=0.01))
        recording.start()
        recording.add_topic(topic("/a"))
        recording.put(samples(0, 10))
        recording.call(lambda: None)
        (folder / "bag").chmod(0o555)
        recording.put(samples(10, 10))  # the open file takes them
        with pytest.raises(BagError, match="bag: cannot be written: Permission denied"):
            recording.split()
        recording.put(samples(20, 7))
        recording.close()
        status = recording.status()
        assert (status.state, status.written, status.dropped_error, status.files) == ("failed", 20, 7, 1)
        assert "Permission denied" in status.error
        with BagReader(folder / "bag") as reader:
            assert [message.publish_time_ns for message in reader.messages()] == list(range(20))
        (folder / "bag").chmod(0o755)
        report = recover(folder / "bag")
        assert (report.metadata_written, report.files[0].rebuilt) == (True, False)  # only its metadata was missing
        assert values(folder / "bag") == list(range(20))


def test_a_folder_that_is_read_only_at_the_end_costs_the_metadata_alone(tmp_path: Path) -> None:
    with private_folder() as folder:
        recording = Recording(folder / "bag")
        recording.start()
        recording.add_topic(topic("/a"))
        recording.put(samples(0, 10))
        recording.call(lambda: None)
        (folder / "bag").chmod(0o555)
        with pytest.raises(BagError, match=r"metadata\.yaml: cannot be written: Permission denied"):
            recording.stop()
        status = recording.status()
        assert (status.state, status.written, status.dropped_error) == ("failed", 10, 0)
        recording.close()
        (folder / "bag").chmod(0o755)
        recover(folder / "bag")
        assert values(folder / "bag") == list(range(10))


def test_after_a_failure_a_new_bag_can_be_started(tmp_path: Path) -> None:
    recording = Recording(tmp_path / "bag", RecordingOptions(flush_period_s=0.01))
    recording.start()
    recording.add_topic(topic("/a"))
    recording.put(samples(0, 10))
    shutil.rmtree(tmp_path / "bag")
    while not recording.failed.wait(0.001):
        recording.put(samples(0, 1))
    assert "removed while it was being written" in recording.status().error
    assert recording.start() == tmp_path / "bag_1"
    recording.put(samples(0, 4))
    recording.close()
    assert values(tmp_path / "bag_1") == [0, 1, 2, 3]


def test_a_folder_that_cannot_be_created_fails_the_start_only(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    recording = Recording(tmp_path / "file" / "bag")
    with pytest.raises(BagError, match="cannot be created"):
        recording.start()
    assert recording.status().state == "stopped"
    recording.close()


def test_a_fault_inside_the_writing_thread_is_a_failed_recording_not_a_silent_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("boom")

    recording = Recording(tmp_path / "bag")
    recording.start()
    recording.add_topic(topic("/a"))
    monkeypatch.setattr(recording_module.BagWriter, "write_all", broken)
    recording.put(samples(0, 1))
    assert recording.failed.wait(30)
    assert "boom" in recording.status().error
    recording.close()


def test_a_disk_error_while_closing_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(self: McapFile, data: bytes) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    recording = Recording(tmp_path / "bag", RecordingOptions(flush_period_s=60.0))
    recording.start()
    recording.add_topic(topic("/a"))
    recording.put(samples(0, 3))
    recording.call(lambda: None)  # all of that has reached the writer
    monkeypatch.setattr(McapFile, "append", full)
    with pytest.raises(BagError, match="No space left on device"):
        recording.close()
    assert recording.status().dropped_error == 3
