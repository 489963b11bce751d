# SPDX-License-Identifier: Apache-2.0
"""Bags from strangers: nothing runs, hangs, fills memory or the disk, or leads out of the bag; one line says why."""

from __future__ import annotations

import bz2
import os
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from mcap.records import Chunk

import foreign_bags as foreign
from iwm_power_manager.bags import limits
from iwm_power_manager.bags.mcap_source import MAGIC
from iwm_power_manager.bags.reader import BagReader
from iwm_power_manager.bags.recover import recover
from iwm_power_manager.errors import BagError

GIBIBYTE = 1024**3
#: For each of five kinds of files: 500 in all, and 20,000 in the nightly run.
EXAMPLES = min(settings().max_examples, 4000)


def written(chunk: Chunk) -> bytes:
    from mcap.data_stream import RecordBuilder

    builder = RecordBuilder()
    chunk.write(builder)
    return bytes(builder.end())


def contents(path: Path) -> tuple[int, list[str]]:
    with BagReader(path) as reader:
        count = sum(1 for _ in reader.messages())
        return count, reader.damage


def zeros(compression: str, size: int) -> bytes:
    """So many zeros, compressed."""
    if compression == "zstd":
        return zstandard.ZstdCompressor(level=1).compress(bytes(size))
    return bytes(lz4.frame.compress(bytes(size)))


def with_chunk(path: Path, compression: str, packed: bytes, stated: int) -> Path:
    """A file with one more chunk at its end."""
    foreign.write_mcap(path, foreign.drive(5))
    whole = path.read_bytes()
    chunk = Chunk(compression, packed, 2, 1, 0, stated)
    path.write_bytes(whole[: whole.index(b"\x0f\x04\0\0\0\0\0\0\0")] + written(chunk))
    return path


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
@pytest.mark.parametrize("stated", [100, 64 * 2**20, 2**62])
def test_a_chunk_that_unpacks_to_more_than_it_says_or_may_is_damage(
    tmp_path: Path, compression: str, stated: int
) -> None:
    path = with_chunk(tmp_path / "a.mcap", compression, zeros(compression, 64 * 2**20 + 1), stated)
    count, damage = contents(path)
    assert count == 15
    assert any("the chunk at byte" in line for line in damage)


def test_of_many_chunks_that_are_large_by_themselves_only_as_many_are_unpacked_as_the_file_may_hold(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "MAX_CHUNK_BYTES", 2**20)
    empty = foreign.message_records([(1, 1, b"")]) * 20_000
    packed = foreign.chunk(empty, "zstd", zstandard.compress(empty))
    path = foreign.write_records(tmp_path / "a.mcap", foreign.announced(), *[packed] * 200)
    count, damage = contents(path)
    assert 31 * count < 2**20 + limits.MAX_RATIO * path.stat().st_size < 31 * (count + 20_000)
    assert damage[0].endswith("is left out: those before it hold 1000 times what the file has")
    assert damage[-1].endswith("is damaged at more places")
    assert len(damage) == limits.MAX_NOTES + 1


def test_a_frame_that_says_gigabytes_allocates_none(tmp_path: Path) -> None:
    frame = b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", 2**40) + bytes(8)
    with pytest.raises(BagError):
        limits.decompress("zstd", frame)
    with pytest.raises(BagError):
        limits.decompress("zstd", frame, 2**30)


def test_a_compressed_file_is_unpacked_only_as_far_as_its_size_allows(tmp_path: Path) -> None:
    path = tmp_path / "a_0.mcap.zstd"
    compressor = zstandard.ZstdCompressor(level=3).compressobj()
    with path.open("wb") as sink:
        for _ in range(64):
            sink.write(compressor.compress(bytes(2**24)))
        sink.write(compressor.flush())
    assert path.stat().st_size * limits.MAX_RATIO < GIBIBYTE
    for read in (contents, recover):
        with pytest.raises(BagError, match=r"holds more than \d+ bytes, from \d+"):
            read(path)
    assert sorted(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    "name", ["/dev/zero", "../outside.mcap", "/etc/passwd", "a\0b", "x" * 5000, "link.mcap", "fifo"]
)
def test_the_paths_in_a_bag_stay_in_it_and_are_regular_files(tmp_path: Path, name: str) -> None:
    foreign.write_mcap(tmp_path / "outside.mcap", foreign.drive(5))
    folder = foreign.write_bag(tmp_path / "bag", foreign.drive(5))
    (folder / "a_0.mcap").unlink()
    (folder / "link.mcap").symlink_to("/dev/zero" if name == "/dev/zero" else tmp_path / "outside.mcap")
    os.mkfifo(folder / "fifo")
    foreign.write_metadata(folder, relative_file_paths=[name])
    for read in (contents, recover):
        with pytest.raises(BagError) as caught:
            read(folder)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("damaged", [False, True])
def test_recovery_writes_nothing_outside_of_the_bag(tmp_path: Path, damaged: bool) -> None:
    outside = tmp_path / "outside"
    outside.write_text("kept")
    folder = foreign.write_bag(tmp_path / "bag", foreign.drive(5))
    if damaged:
        os.truncate(folder / "a_0.mcap", 2000)
    for name in ("metadata.yaml", "a_0.mcap.recovering", "a_0.mcap.damaged"):
        (folder / name).unlink(missing_ok=True)
        (folder / name).symlink_to(outside)
    assert recover(folder).metadata_written
    assert outside.read_text() == "kept"
    assert not (folder / "metadata.yaml").is_symlink()


def test_a_pipe_in_the_place_of_the_metadata_holds_nothing_up(tmp_path: Path) -> None:
    folder = foreign.write_bag(tmp_path / "bag", foreign.drive(5))
    (folder / "metadata.yaml").unlink()
    os.mkfifo(folder / "metadata.yaml")
    assert contents(folder)[0] == 15
    assert recover(folder).metadata_written
    assert contents(folder) == (15, [])


def test_a_file_whose_name_is_no_text_is_left_out_with_one_line(tmp_path: Path) -> None:
    folder = foreign.write_bag(tmp_path / "bag", foreign.drive(5))
    os.rename(os.fsencode(folder / "a_0.mcap"), os.fsencode(folder) + b"/\xff.mcap")
    assert contents(folder)[0] == 15
    with pytest.raises(BagError, match=r"\\udcff\.mcap: its name is no UTF-8 text"):
        recover(folder)


def test_a_name_that_is_as_long_as_names_may_be_is_read(tmp_path: Path) -> None:
    path = foreign.write_mcap(tmp_path / ("x" * 250 + ".mcap"), foreign.drive(5))
    assert contents(path) == (15, [])
    assert recover(path).files[0].message_count == 15
    os.truncate(path, 2000)
    with pytest.raises(BagError, match="cannot be written: File name too long"):
        recover(path)


def test_rows_of_text_where_bytes_should_be_are_counted(tmp_path: Path) -> None:
    folder = foreign.write_sqlite(tmp_path / "bag", foreign.drive(10))
    with sqlite3.connect(folder / "a_0.db3") as database:
        database.execute("UPDATE messages SET data = CAST(x'ff00f1' AS TEXT) WHERE id = 5")
    database.close()
    count, damage = contents(folder)
    assert (count, damage) == (29, [f"{folder / 'a_0.db3'}: 1 row(s) hold no message of a known topic"])
    assert recover(folder).files[0].message_count == 29


def test_a_link_to_another_file_of_the_bag_is_not_the_same_messages_once_more(tmp_path: Path) -> None:
    folder = foreign.write_bag(tmp_path / "bag", foreign.drive(5))
    (folder / "a_1.mcap").symlink_to("a_0.mcap")
    assert [file.message_count for file in recover(folder).files] == [15]
    (folder / "metadata.yaml").unlink()
    assert contents(folder)[0] == 15


@pytest.mark.parametrize("kind", ["device", "fifo", "folder"])
def test_a_single_path_has_to_be_a_regular_file(tmp_path: Path, kind: str) -> None:
    path = Path("/dev/zero") if kind == "device" else tmp_path / "a.mcap"
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    with pytest.raises(BagError, match=r"is no regular file|holds no \.mcap"):
        contents(path)


def test_a_view_that_never_ends_is_not_asked(tmp_path: Path) -> None:
    endless = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i AS id, 1 AS topic_id"
    folder = foreign.write_sqlite(tmp_path / "bag", foreign.drive(5))
    with sqlite3.connect(folder / "a_0.db3") as database:
        database.execute("DROP TABLE messages")
        database.execute(f"CREATE VIEW messages AS {endless}, i AS timestamp, x'00010000' AS data FROM n")
    database.close()
    with pytest.raises(BagError, match="is no rosbag2 sqlite3 bag"):
        contents(folder)


@pytest.mark.parametrize(
    "change",
    [
        "ALTER TABLE topics ADD COLUMN note TEXT GENERATED ALWAYS AS (hex(zeroblob(100000000))) VIRTUAL",
        "ALTER TABLE messages ADD COLUMN more BLOB AS(zeroblob(100000000))",
    ],
)
def test_a_table_that_computes_its_content_is_not_asked(tmp_path: Path, change: str) -> None:
    folder = foreign.write_sqlite(tmp_path / "bag", foreign.drive(5))
    with sqlite3.connect(folder / "a_0.db3") as database:
        database.execute(change)
    database.close()
    with pytest.raises(BagError, match="is no rosbag2 sqlite3 bag"):
        contents(folder)


def test_rows_that_are_no_messages_are_counted_and_a_table_without_numbers_is_read(tmp_path: Path) -> None:
    folder = foreign.write_sqlite(tmp_path / "bag", foreign.drive(10))
    with sqlite3.connect(folder / "a_0.db3") as database:
        database.execute("CREATE TABLE rows AS SELECT topic_id, timestamp, data FROM messages")
        database.execute("DROP TABLE messages")
        database.execute("ALTER TABLE rows RENAME TO messages")
        database.execute("UPDATE messages SET timestamp = 'x' WHERE rowid = 3")
        database.execute("UPDATE messages SET timestamp = -7 WHERE rowid = 4")
        database.execute("UPDATE messages SET data = 'text' WHERE rowid = 5")
    database.close()
    count, damage = contents(folder)
    assert (count, damage) == (27, [f"{folder / 'a_0.db3'}: 3 row(s) hold no message of a known topic"])


def test_a_compressed_file_that_holds_nothing_says_why(tmp_path: Path) -> None:
    path = tmp_path / "a_0.mcap.zstd"
    path.write_bytes(foreign.write_mcap(tmp_path / "a.mcap", foreign.drive(5)).read_bytes())
    with pytest.raises(BagError, match=r"a_0\.mcap\.zstd: is damaged: zstd decompress error: Unknown frame"):
        contents(path)


def test_of_a_compressed_file_what_stands_before_damage_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a_0.mcap.zstd"
    whole = foreign.write_mcap(tmp_path / "a.mcap", foreign.drive(5)).read_bytes()
    path.write_bytes(zstandard.compress(whole) + b"garbage")
    count, (line,) = contents(path)
    assert count == 15
    assert "is damaged: zstd decompress error: Unknown frame" in line
    assert recover(path).files[0].message_count == 15


def test_a_file_compressed_with_lz4_is_read_and_recovered(tmp_path: Path) -> None:
    whole = foreign.write_mcap(tmp_path / "a.mcap", foreign.drive(5)).read_bytes()
    path = tmp_path / "bag" / "a_0.mcap.lz4"
    path.parent.mkdir()
    path.write_bytes(lz4.frame.compress(whole))
    assert contents(path) == contents(path.parent) == (15, [])
    assert recover(path.parent).files[0].kept == path.name
    assert contents(path.with_name("a_0.mcap")) == (15, [])


def test_a_chunk_compressed_with_anything_else_is_one_line(tmp_path: Path) -> None:
    records = foreign.message_records(foreign.drive(5))
    packed = foreign.chunk(records, "bz2", bz2.compress(records))
    count, (line,) = contents(foreign.write_records(tmp_path / "a.mcap", foreign.announced(), packed))
    assert count == 0
    assert line.endswith("is compressed with 'bz2'; known: zstd, lz4")


def test_a_compressed_file_whose_name_does_not_say_so_is_read_and_recovered(tmp_path: Path) -> None:
    whole = foreign.write_mcap(tmp_path / "a.mcap", foreign.drive(5)).read_bytes()
    path = tmp_path / "a_0.mcap"
    path.write_bytes(zstandard.compress(whole))
    assert contents(path) == (15, [])
    with BagReader(path) as reader:
        assert reader.notes == [f"{path}: is compressed, which its name does not say"]
    assert recover(path).files[0].message_count == 15
    assert contents(path) == (15, [])


@pytest.mark.parametrize("listed", ["bag\\a_0.mcap", "C:\\bags\\bag\\a_0.mcap", "bag/a_0.mcap", ".."])
def test_paths_of_other_systems_and_older_versions_lead_to_the_file(tmp_path: Path, listed: str) -> None:
    folder = foreign.write_bag(tmp_path / "bag", foreign.drive(5))
    foreign.write_metadata(folder, relative_file_paths=[listed])
    assert contents(folder) == (15, [])


def test_a_data_file_is_what_its_first_bytes_say(tmp_path: Path) -> None:
    folder = foreign.write_sqlite(tmp_path / "bag", foreign.drive(5))
    (folder / "a_0.db3").rename(tmp_path / "renamed.mcap")
    foreign.write_mcap(tmp_path / "a.mcap", foreign.drive(5)).rename(tmp_path / "renamed.db3")
    assert contents(tmp_path / "renamed.mcap") == contents(tmp_path / "renamed.db3") == (15, [])


def test_a_query_that_takes_too_long_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "SQLITE_INSTRUCTIONS", 0)
    monkeypatch.setattr(limits, "SQLITE_INSTRUCTIONS_PER_BYTE", 0)
    folder = foreign.write_sqlite(tmp_path / "bag", foreign.drive(20_000))
    try:
        _, damage = contents(folder)
    except BagError as error:
        damage = [str(error)]
    assert "interrupted" in damage[0].lower()


def test_a_topic_that_is_described_by_no_text_is_damage(tmp_path: Path) -> None:
    folder = foreign.write_sqlite(tmp_path / "bag", foreign.drive(5))
    with sqlite3.connect(folder / "a_0.db3") as database:
        database.execute("UPDATE topics SET serialization_format = NULL, type = x'ff' WHERE id = 1")
    database.close()
    count, damage = contents(folder)
    assert count == 15
    assert "described by something else than text" in damage[0]
    assert recover(folder).files[0].message_count == 15


@pytest.mark.parametrize("suffix", ["?mode=rwc", "#a", "%2e"])
def test_a_name_that_is_an_address_opens_the_file_and_no_other(tmp_path: Path, suffix: str) -> None:
    folder = foreign.write_sqlite(tmp_path / f"bag{suffix}", foreign.drive(5))
    count, _ = contents(folder)
    assert count == 15
    assert [path.name for path in tmp_path.iterdir()] == [folder.name]


def test_a_file_of_tens_of_thousands_of_channels_is_refused(tmp_path: Path) -> None:
    channels = [foreign.DEMAND._replace(topic=f"/t{i}", text="") for i in range(limits.MAX_CHANNELS + 1)]
    path = foreign.write_mcap(tmp_path / "a.mcap", [(1, i, b"x") for i in range(len(channels))], channels)
    path.write_bytes(path.read_bytes()[:-8])  # so that the data is read, and not the index
    _, damage = contents(path)
    assert any(f"holds more than {limits.MAX_CHANNELS} channels" in line for line in damage)


def test_messages_of_one_time_in_chunks_of_one_message_take_linear_time(tmp_path: Path) -> None:
    entries = [(foreign.START_NS, 1, b"\0\1\0\0" + struct.pack("<Q", i)) for i in range(3000)]
    path = foreign.write_mcap(tmp_path / "a.mcap", entries, chunk_bytes=1, compression="none")
    with BagReader(path) as reader:
        assert [message.data for message in reader.messages()] == [data for _, _, data in entries]


def test_chunks_that_all_overlap_and_do_not_fit_into_memory_are_read_in_the_order_of_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "MAX_OVERLAP_BYTES", 1000)
    entries = [(foreign.START_NS + (i * 7919) % 1000, 1, b"\0\1\0\0" + struct.pack("<Q", i)) for i in range(1000)]
    path = foreign.write_mcap(tmp_path / "a.mcap", entries, chunk_bytes=500)
    count, damage = contents(path)
    assert count == 1000
    assert "overlap in time" in damage[0]


def test_topic_names_that_steer_a_terminal_or_are_too_long_are_shown_escaped(tmp_path: Path) -> None:
    from iwm_power_manager.replay.recorded import read_signal

    channels = [foreign.DEMAND._replace(topic="/\x1b[2J\n" + "x" * 5000)]
    path = foreign.write_mcap(tmp_path / "a.mcap", [(1, 0, b"\0\1\0\0" + bytes(8))], channels)
    with pytest.raises(BagError) as caught:
        read_signal(path)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) <= 1000


class Seeds(dict[str, bytes]):
    """One small file of each kind, by its suffix; too long to be shown where a test fails."""

    def __repr__(self) -> str:
        return "seeds"


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> Seeds:
    folder = tmp_path_factory.mktemp("seeds")
    entries, log = foreign.drive(12), foreign.log_channel()
    entries += [(foreign.START_NS, 3, log[1])]
    channels = [*foreign.CHANNELS, log[0]]
    mcap = foreign.write_mcap(folder / "a.mcap", entries, channels, chunk_bytes=900)
    lz4_file = foreign.write_mcap(folder / "b.mcap", entries, channels, chunk_bytes=900, compression="lz4")
    database = foreign.write_sqlite(folder / "c", foreign.drive(3)) / "a_0.db3"
    metadata = (foreign.write_metadata(folder) / "metadata.yaml").read_bytes()
    return Seeds(
        {
            ".mcap": mcap.read_bytes(),
            ".lz4.mcap": lz4_file.read_bytes(),
            ".mcap.zstd": zstandard.compress(mcap.read_bytes()),
            ".db3": database.read_bytes(),
            "metadata.yaml": metadata,
        }
    )


@st.composite
def mutations(draw: st.DrawFn) -> Callable[[bytes], bytes]:
    """Bytes changed, taken out, doubled, or cut off, at up to four places."""
    steps = draw(
        st.lists(
            st.tuples(
                st.sampled_from(["set", "cut", "drop", "double", "number"]),
                st.floats(0.0, 1.0, exclude_max=True),
                st.integers(1, 64),
                st.sampled_from([0, 1, 0x7F, 0x80, 0xFF, 2**31 - 1, 2**32 - 1, 2**62, 2**64 - 1]),
            ),
            min_size=1,
            max_size=4,
        )
    )

    def mutate(content: bytes) -> bytes:
        for kind, place, length, value in steps:
            at = int(place * len(content))
            if kind == "set":
                content = content[:at] + bytes([value & 0xFF]) + content[at + 1 :]
            elif kind == "cut":
                content = content[:at]
            elif kind == "drop":
                content = content[:at] + content[at + length :]
            elif kind == "double":
                content = content[: at + length] + content[at:]
            else:
                content = content[:at] + struct.pack("<Q", value) + content[at + 8 :]
        return content

    return mutate


@pytest.mark.parametrize("suffix", [".mcap", ".lz4.mcap", ".mcap.zstd", ".db3", "metadata.yaml"])
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=EXAMPLES)
@given(mutate=mutations())
@example(mutate=lambda content: content[: len(content) // 2] + bytes(16) + content[len(content) // 2 :])
@example(mutate=lambda _: MAGIC)
@example(mutate=lambda _: b"rosbag2_bagfile_information: {version: !!bool maybe}")
@example(mutate=lambda _: b"rosbag2_bagfile_information: &a {custom_data: *a, relative_file_paths: [a.mcap]}")
@example(mutate=lambda _: b"a: &a [x,x]\nb: &b [*a,*a,*a,*a]\nc: &c [*b,*b,*b,*b]\nd: [*c,*c,*c]\n" + b"e: [" * 500)
def test_no_damaged_file_whatever_ends_in_anything_but_messages_or_one_line(
    tmp_path_factory: pytest.TempPathFactory, seeds: Seeds, suffix: str, mutate: Callable[[bytes], bytes]
) -> None:
    folder = tmp_path_factory.mktemp("bag")
    spoilt = mutate(seeds[suffix])
    (folder / "metadata.yaml").write_bytes(spoilt if suffix == "metadata.yaml" else seeds["metadata.yaml"])
    (folder / ("a_0.mcap" if suffix == "metadata.yaml" else f"a_0{suffix}")).write_bytes(
        seeds[".mcap"] if suffix == "metadata.yaml" else spoilt
    )
    said: list[str] = []
    try:
        with BagReader(folder) as reader:
            before = sum(message.topic in reader.topics for message in reader.messages())
            said += reader.damage
        said += recover(folder).lines()
        with BagReader(folder) as reader:
            said += ["less than before"] * (sum(1 for _ in reader.messages()) < before)
    except BagError as error:
        said.append(str(error))
    assert not any("less than before" in line or "Traceback" in line or len(line) > 2000 for line in said)


@pytest.mark.parametrize("column", ["id", "name", "type"])
def test_a_database_whose_topics_lack_a_column_is_refused(tmp_path: Path, column: str) -> None:
    path = foreign.write_sqlite(tmp_path / "bag", foreign.drive(3)) / "a_0.db3"
    with closing(sqlite3.connect(path)) as database:
        database.execute(f"ALTER TABLE topics RENAME COLUMN {column} TO other")
        database.commit()
    with pytest.raises(BagError, match=f"its topics have no '{column}'"):
        BagReader(path)
