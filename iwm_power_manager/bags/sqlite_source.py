# SPDX-License-Identifier: Apache-2.0
"""Messages of one rosbag2 sqlite3 file: by rosbags where it is whole, row by row where it is damaged.

rosbags refuses a database whose end is missing, asks for as much time as a query wants, and makes an address of the
file's name (`Sqlite3Reader` in
https://gitlab.com/ternaris/rosbags/-/blob/master/src/rosbags/rosbag2/storage_sqlite3.py). So the file is looked at
first: read-only and immutable; what it defines may not run, and a bound on sqlite's own instructions ends a query that
does not.
"""

from __future__ import annotations

import re
import sqlite3
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from typing import Any

import apsw
from mcap.records import Header
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

from iwm_power_manager.bags import limits
from iwm_power_manager.bags.mcap_source import ChannelMessage
from iwm_power_manager.bags.metadata import Topic, parse_qos
from iwm_power_manager.errors import BagError

_STEP = 100_000
#: What holds content and does not compute it: no views, no virtual tables (no page), no generated columns (hidden).
_TABLES = """
    SELECT name FROM sqlite_master AS found WHERE type = 'table' AND rootpage > 0
    AND NOT EXISTS (SELECT 1 FROM pragma_table_xinfo(found.name) WHERE hidden <> 0)
"""
_BY_TIME = "SELECT topic_id, timestamp, data FROM messages ORDER BY timestamp, rowid"
_AS_RECORDED = "SELECT topic_id, timestamp, data FROM messages ORDER BY rowid"
#: Times are whole numbers of nanoseconds, or the same with a decimal point.
_TIMED = "typeof(timestamp) IN ('integer', 'real') AND timestamp BETWEEN 0 AND 9223372036854775807"
_COUNTS = f"""
    SELECT topic_id, count(*), min(timestamp), max(timestamp), total(typeof(data) <> 'blob')
    FROM messages WHERE {_TIMED} GROUP BY topic_id
"""  # noqa: S608 - constants
#: Whether any time goes back, which takes a tenth of the time of asking topic by topic.
_GOES_BACK = f"""
    SELECT 1 FROM messages AS one JOIN messages AS next ON next.rowid = one.rowid + 1
    WHERE next.timestamp < one.timestamp - {limits.SET_BACK_NS} LIMIT 1
"""  # noqa: S608 - constants
_SET_BACK = f"""
    SELECT 1 FROM (
        SELECT timestamp - lag(timestamp) OVER (PARTITION BY topic_id ORDER BY rowid) AS step
        FROM messages WHERE {_TIMED}
    ) WHERE step < -{limits.SET_BACK_NS} LIMIT 1
"""  # noqa: S608 - constants


class SqliteSource:
    """A rosbag2 sqlite3 file. Attributes as those of `mcap_source.McapSource`, where a topic's id is its channel."""

    def __init__(self, path: Path, stack: ExitStack) -> None:
        self.path = path
        self.damage: list[str] = []
        self.counts: Counter[int] = Counter()
        self.start_ns = self.end_ns = 0
        self.header = Header(profile="ros2", library="")
        self.custom_data: dict[str, str] = {}  # there is none in these files
        self._topics: dict[int, Topic] = {}
        self._plain = True  # the data is bytes in each row: rosbags fails at others
        self._steps = (
            limits.SQLITE_INSTRUCTIONS + limits.SQLITE_INSTRUCTIONS_PER_BYTE * limits.regular_file(path)
        ) // _STEP
        try:
            address = f"{path.resolve().as_uri()}?mode=ro&immutable=1"
            self._database = stack.enter_context(closing(sqlite3.connect(address, uri=True)))
            self._database.row_factory = sqlite3.Row
            self._database.text_factory = lambda text: text.decode("utf-8", "replace")
            self._database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, limits.MAX_CHUNK_BYTES)
            self._database.set_progress_handler(self._out_of_steps, _STEP)
            self._database.execute("PRAGMA trusted_schema = OFF")
            # A truncated file is refused as a whole, unless one says that one knows.
            self._database.execute("PRAGMA writable_schema = ON")
            tables = {name for (name,) in self._database.execute(_TABLES)}
            if not tables >= {"topics", "messages"}:
                raise BagError(f"{path}: is no rosbag2 sqlite3 bag")
            self._definitions = self._read_definitions() if "message_definitions" in tables else {}
            self._read_topics()
        except (sqlite3.Error, ValueError, OverflowError, MemoryError) as error:
            raise BagError(f"{path}: is no readable sqlite3 bag: {_one_line(error)}") from None
        except KeyError as error:
            raise BagError(f"{path}: is no rosbag2 sqlite3 bag: its topics have no {error}") from None
        self.set_back = False
        self._count()
        self._reader = self._rosbags_reader(stack) if self._plain and not (self.damage or self.set_back) else None

    def topics(self) -> dict[int, Topic]:
        """The topic of each id."""
        return self._topics

    def messages(self) -> Iterator[ChannelMessage]:
        """All messages in the order of log times, or of recording: of a damaged file, or if the clock was set back."""
        bad = 0
        try:
            for number, log_time, data in self._rows():
                timed = type(log_time) in (int, float) and 0 <= log_time < 2**63
                if timed and type(data) is bytes and type(number) is int:
                    yield (time_ns := int(log_time)), number, data, time_ns, 0
                else:
                    bad += 1
        except (sqlite3.Error, apsw.Error, OverflowError, MemoryError) as error:
            self.note(f"is not readable to its end: {_one_line(error)}")
        if bad:
            self.note(f"{bad} row(s) hold no message of a known topic")

    def _rows(self) -> Iterator[tuple[Any, Any, Any]]:
        if self._reader is not None:
            for connection, log_time, data in self._reader.messages(self._reader.connections):
                yield connection.id, log_time, data
        else:
            yield from self._database.execute(_AS_RECORDED if self.damage or self.set_back else _BY_TIME)

    def _rosbags_reader(self, stack: ExitStack) -> Sqlite3Reader | None:
        """The reader of rosbags, if it takes this file: its queries end after so many instructions, too."""
        if re.search(r"[?#%]", str(self.path)):
            return None
        reader = Sqlite3Reader(self.path)
        bound = partial(apsw.Connection.set_progress_handler, callable=self._out_of_steps, nsteps=_STEP)
        apsw.connection_hooks.append(bound)
        try:
            reader.open()
        except Exception:  # noqa: BLE001 - whatever it makes of other people's tables
            return None
        finally:
            apsw.connection_hooks.remove(bound)
        stack.callback(reader.close)
        return reader

    def _out_of_steps(self) -> bool:
        self._steps -= 1
        return self._steps < 0

    def _read_definitions(self) -> dict[str, tuple[str, str]]:
        """Encoding and text by type; bags older than Iron carry none."""
        try:
            rows = self._database.execute(
                "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            )
            return {_text(name): (_text(encoding), _text(text)) for name, encoding, text in rows}
        except sqlite3.Error as error:
            self.note(f"has no readable definitions: {_one_line(error)}")
            return {}

    def _read_topics(self) -> None:
        for row in self._database.execute("SELECT * FROM topics"):
            found = {"serialization_format": "cdr", **dict(zip(row.keys(), row, strict=True))}
            described = [found[key] for key in ("name", "type", "serialization_format")]
            if not all(isinstance(text, str) for text in described):
                self.note(f"topic {found['id']} is described by something else than text")
            name, msgtype, serialization = map(str, described)
            encoding, text = self._definitions.get(msgtype, ("", ""))
            type_hash, qos = (str(found.get(key) or "") for key in ("type_description_hash", "offered_qos_profiles"))
            self._topics[found["id"]] = Topic(name, msgtype, text, type_hash, parse_qos(qos), encoding, serialization)

    def _count(self) -> None:
        """Messages by topic, if the file is whole: each page of it is looked at."""
        try:
            pages = self._database.execute("SELECT page_size * page_count FROM pragma_page_size, pragma_page_count")
            if pages.fetchone()[0] > limits.regular_file(self.path):
                self.note("ends within its last page: what stood there is lost")
            (problem,) = self._database.execute("PRAGMA quick_check(1)").fetchone()
            if problem != "ok":
                self.note(f"is damaged: {' '.join(problem.split())}")
            for number, count, start_ns, end_ns, odd in self._database.execute(_COUNTS):
                self._plain = self._plain and not odd and number in self._topics
                self.start_ns = min(self.start_ns, int(start_ns)) if self.counts else int(start_ns)
                self.end_ns = max(self.end_ns, int(end_ns))
                self.counts[number] = count
            self.set_back = all(self._database.execute(query).fetchone() for query in (_GOES_BACK, _SET_BACK))
        except sqlite3.Error as error:
            self.note(f"is damaged: {_one_line(error)}")
            self.counts.clear()

    def note(self, line: str) -> None:
        """Add a line to the damage."""
        if line not in self.damage:
            self.damage.append(line)


def _text(cell: Any) -> str:
    """Text of a cell, which some write as bytes."""
    return cell.decode(errors="replace") if isinstance(cell, bytes) else str(cell or "")


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
