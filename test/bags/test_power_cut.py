# SPDX-License-Identifier: Apache-2.0
"""A power cut: kill -9 leaves the kernel to finish the job, a power cut leaves what the disk had been told to keep."""

from __future__ import annotations

import os
import random
import shutil
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

from bags_helpers import float64, topic
from iwm_power_manager.bags import mcap_file
from iwm_power_manager.bags.reader import BagReader
from iwm_power_manager.bags.recording import Recording, RecordingOptions
from iwm_power_manager.bags.recover import recover
from iwm_power_manager.bags.writer import WriterOptions
from iwm_power_manager.errors import BagError

PAGE_BYTES = 4096


class Event(NamedTuple):
    """What became known to the disk, or only to the kernel, and when."""

    time_ns: int
    kind: str  # "written" | "synced", of a file up to `size`; "names" of a folder
    path: str
    size: int
    names: tuple[str, ...] = ()


class Journal:
    """Notes every write and every sync of this process, and takes `delay_s` for each sync of a file."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, delay_s: float) -> None:
        self.events: list[Event] = []
        fsync, fdatasync, append = os.fsync, os.fdatasync, mcap_file.McapFile.append

        def synced(sync: Callable[[int], None], descriptor: int) -> None:
            path = os.readlink(f"/proc/self/fd/{descriptor}")
            if os.path.isdir(path):
                names = tuple(os.listdir(path))
                sync(descriptor)
                self._note("names", path, 0, names)
                return
            size = os.fstat(descriptor).st_size  # what is written meanwhile may or may not be synced with it
            time.sleep(delay_s)
            sync(descriptor)
            self._note("synced", path, size)

        def appended(file: mcap_file.McapFile, data: bytes) -> None:
            append(file, data)
            self._note("written", str(file.path), file.size_bytes)

        monkeypatch.setattr(os, "fsync", lambda descriptor: synced(fsync, descriptor))
        monkeypatch.setattr(os, "fdatasync", lambda descriptor: synced(fdatasync, descriptor))
        monkeypatch.setattr(mcap_file.McapFile, "append", appended)

    def _note(self, kind: str, path: str, size: int, names: tuple[str, ...] = ()) -> None:
        self.events.append(Event(time.monotonic_ns(), kind, path, size, names))

    def after_power_cut(self, bag: Path, at_ns: int, target: Path, draw: random.Random) -> bool:
        """What is found in place of `bag` after a cut: synced bytes, and of the later ones any page or none.

        Returns whether the folder itself is there.
        """
        past = [event for event in self.events if event.time_ns <= at_ns]
        if not any(
            event.kind == "names" and event.path == str(bag.parent) and bag.name in event.names for event in past
        ):
            return False
        target.mkdir()
        named = {name for event in past if event.kind == "names" and event.path == str(bag) for name in event.names}
        for name in sorted(named):
            path = str(bag / name)
            synced = max((e.size for e in past if e.kind == "synced" and e.path == path), default=0)
            written = max((e.size for e in past if e.kind == "written" and e.path == path), default=0)
            content = bytearray((bag / name).read_bytes()[: max(synced, written)])
            for start in range(synced - synced % PAGE_BYTES, len(content), PAGE_BYTES):
                if draw.random() < 0.5:
                    start = max(start, synced)
                    page = content[start : start + PAGE_BYTES - start % PAGE_BYTES]
                    content[start : start + len(page)] = bytes(len(page))
            length = draw.choice((len(content), draw.randint(synced, len(content))))
            (target / name).write_bytes(content[:length])
        return True


def record(path: Path, options: RecordingOptions, seconds: float) -> dict[int, int]:
    """Record 1 message a millisecond; returns the time (ns) each number was handed over."""
    recording = Recording(path, options, {"key": "value"})
    recording.start()
    number = recording.add_topic(topic("/a"))
    given: dict[int, int] = {}
    start = time.monotonic()
    pause = threading.Event()
    while (elapsed := time.monotonic() - start) < seconds:
        now = time.monotonic_ns()
        fresh = range(len(given), int(elapsed * 1000))
        given.update(dict.fromkeys(fresh, now))
        recording.put([(number, now, float64(i), i, i + 1) for i in fresh])
        pause.wait(0.005)
    recording.close()
    return given


def cut_and_recover(journal: Journal, bag: Path, given: dict[int, int], cuts: int, folder: Path) -> float:
    """Cut the power at random moments; returns the largest loss in seconds. What is found must be what was given."""
    draw = random.Random(20150603)
    first, last = journal.events[0].time_ns, journal.events[-1].time_ns
    largest = 0.0
    for cut in range(cuts):
        at_ns = draw.randint(first, last)
        target = folder / f"cut{cut}"
        kept: list[int] = []
        if journal.after_power_cut(bag, at_ns, target, draw):
            try:
                recover(target)
                with BagReader(target) as reader:
                    for message in reader.messages():
                        assert message.data == float64(message.publish_time_ns)
                        kept.append(message.publish_time_ns)
                    assert reader.damage == []
            except BagError as error:  # not even the head of the first file is there
                assert "nothing to recover" in str(error) or "holds no .mcap or .db3 file" in str(error)  # noqa: PT017
        assert kept == sorted(set(kept))
        missing = given.keys() - set(kept)
        lost_s = max((at_ns - given[number] for number in missing if given[number] <= at_ns), default=0) * 1e-9
        assert lost_s < 1.0, f"cut {cut} after {(at_ns - first) * 1e-9:.3f} s lost {lost_s:.3f} s"
        largest = max(largest, lost_s)
        shutil.rmtree(target, ignore_errors=True)
    return largest


@pytest.mark.parametrize(
    ("compression", "max_duration_s", "disk_s"), [("none", 0.0, 0.0), ("zstd", 0.4, 0.05)], ids=["fast", "slow, split"]
)
def test_a_power_cut_at_any_moment_costs_less_than_the_last_second(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, compression: str, max_duration_s: float, disk_s: float
) -> None:
    journal = Journal(monkeypatch, disk_s)
    options = RecordingOptions(WriterOptions(compression, max_duration_ns=int(max_duration_s * 1e9)))
    given = record(tmp_path / "bag", options, seconds=1.6)
    monkeypatch.undo()
    largest_s = cut_and_recover(journal, tmp_path / "bag", given, 60, tmp_path)
    assert largest_s > 0.0  # the cuts did cut


def test_without_sync_a_power_cut_would_cost_everything_which_is_why_it_is_the_default(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert RecordingOptions().sync
    journal = Journal(monkeypatch, 0.0)
    record(tmp_path / "bag", RecordingOptions(sync=False), seconds=0.6)
    monkeypatch.undo()
    end_ns = max(e.time_ns for e in journal.events if e.kind == "written")
    synced = [e for e in journal.events if e.kind == "synced" and e.path.endswith(".mcap")]
    assert all(event.time_ns >= end_ns for event in synced)  # only when the bag was closed


def test_how_far_the_disk_is_behind_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stuck, entered = threading.Event(), threading.Event()
    fdatasync = os.fdatasync

    def slow(descriptor: int) -> None:
        entered.set()
        assert stuck.wait(30)
        fdatasync(descriptor)

    monkeypatch.setattr(os, "fdatasync", slow)
    recording = Recording(tmp_path / "bag", RecordingOptions(flush_period_s=0.01))
    assert recording.status().disk_behind_s == 0.0
    recording.start()
    number = recording.add_topic(topic("/a"))
    recording.put([(number, 1, float64(0.0), 0, 1)])
    assert entered.wait(30)
    before = recording.status().disk_behind_s
    assert recording.status().disk_behind_s > before > 0.0
    stuck.set()
    pause = threading.Event()
    while recording.status().disk_behind_s >= before:
        pause.wait(0.001)
    recording.close()
    assert recording.status().disk_behind_s == 0.0
