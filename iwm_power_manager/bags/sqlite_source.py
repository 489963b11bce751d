# SPDX-License-Identifier: Apache-2.0
"""Messages of one rosbag2 sqlite3 file, whole or damaged, in pieces as those of an MCAP file are.

rosbags refuses a database whose end is missing, asks for as much time as a query wants, and makes an address of the
file's name (`Sqlite3Reader` in
https://gitlab.com/ternaris/rosbags/-/blob/master/src/rosbags/rosbag2/storage_sqlite3.py). Here the file is opened
read-only and immutable, what it defines may not run, and a query that does not end is ended: by a bound on sqlite's own
instructions.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import Any

from iwm_power_manager.bags import limits
from iwm_power_manager.bags.mcap_source import ChannelMessage, Piece, Source
from iwm_power_manager.bags.metadata import Topic, parse_qos
from iwm_power_manager.errors import BagError

_STEP = 100_000
#: What holds content and does not compute it: no views, no virtual tables (no page), no generated columns (hidden).
_TABLES = """
    SELECT name FROM sqlite_master AS found WHERE type = 'table' AND rootpage > 0
    AND NOT EXISTS (SELECT 1 FROM pragma_table_xinfo(found.name) WHERE hidden <> 0)
"""
#: Messages are bytes of a topic at a time: a whole number of nanoseconds, or the same with a decimal point.
_ROWS = """
    SELECT rowid, topic_id, CAST(timestamp AS INTEGER), {} FROM messages
    WHERE typeof(topic_id) = 'integer' AND typeof(data) = 'blob' AND typeof(timestamp) IN ('integer', 'real')
    AND +timestamp BETWEEN 0 AND 9223372036854775807 AND rowid BETWEEN ? AND ? ORDER BY rowid
"""
_FIRST, _LAST = -(2**63), 2**63 - 1
#: Messages are read in pieces of about this size.
_PIECE_BYTES = 1024 * 1024
_ERRORS = (sqlite3.Error, OverflowError, MemoryError)


class SqliteSource(Source):
    """A rosbag2 sqlite3 file, where a topic's id is its channel; a piece is a range of rows."""

    def __init__(self, path: Path, stack: ExitStack) -> None:
        super().__init__(path)
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
        except (*_ERRORS, ValueError) as error:
            raise BagError(f"{path}: is no readable sqlite3 bag: {_one_line(error)}") from None
        except KeyError as error:
            raise BagError(f"{path}: is no rosbag2 sqlite3 bag: its topics have no {error}") from None
        self._survey()

    def unpack(self, piece: Piece) -> list[ChannelMessage]:
        """Messages of a range of rows up to one that cannot be read."""
        return [(log_time, number, data, log_time, 0) for _, number, log_time, data in self._rows("data", *piece.place)]

    def _rows(self, what: str, first: int, last: int) -> Iterator[tuple[int, int, int, Any]]:
        """Number, topic, time and something else of rows in a range, as far as they can be read."""
        query, row = _ROWS.format(what), (first - 1,)
        try:
            for row in self._database.execute(query, (first, last)):
                yield row
        except _ERRORS as error:
            self.note(f"is not readable to its end: {_one_line(error)}")
            with suppress(*_ERRORS):  # a cursor is a row ahead, and has lost it with the error
                yield from self._database.execute(f"{query} LIMIT 1", (row[0] + 1, last))

    def _out_of_steps(self) -> bool:
        self._steps -= 1
        return self._steps < 0

    def _read_definitions(self) -> dict[str, tuple[str, str]]:
        """Encoding and text by type; bags older than Iron carry none."""
        try:
            names = ("topic_type", "encoding", "encoded_message_definition")  # which some write as bytes
            columns = ", ".join(f"coalesce(CAST({name} AS TEXT), '')" for name in names)
            rows = self._database.execute(f"SELECT {columns} FROM message_definitions")  # noqa: S608 - constants
            return {name: (encoding, text) for name, encoding, text in rows}
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
            self.topics[found["id"]] = Topic(name, msgtype, text, type_hash, parse_qos(qos), encoding, serialization)

    def _survey(self) -> None:
        """Look at each page, and divide the messages into pieces."""
        try:
            pages = self._database.execute("SELECT page_size * page_count FROM pragma_page_size, pragma_page_count")
            if pages.fetchone()[0] > limits.regular_file(self.path):
                self.note("ends within its last page: what stood there is lost")
            (problem,) = self._database.execute("PRAGMA quick_check(1)").fetchone()
            if problem != "ok":
                self.note(f"is damaged: {' '.join(problem.split())}")
            (rows,) = self._database.execute("SELECT count(*) FROM messages").fetchone()
        except _ERRORS as error:
            self.note(f"is damaged: {_one_line(error)}")
            rows = 0
        size = _PIECE_BYTES
        for row, number, log_time, length in self._rows("length(data)", _FIRST, _LAST):
            self.counts[number] += 1
            self._follow(number, log_time)
            first, start_ns, end_ns = row if self.pieces else _FIRST, log_time, log_time
            if size < _PIECE_BYTES:
                start_ns, end_ns, _, (first, _) = self.pieces.pop()
            else:
                size = 0
            size += length
            self.pieces.append(Piece(min(start_ns, log_time), max(end_ns, log_time), self, (first, row)))
        if self.pieces:  # rows that damage has put out of their order stand beyond what they say
            self.pieces[-1] = self.pieces[-1]._replace(place=(first, _LAST))
        if rows > self.counts.total():
            self.note(f"{rows - self.counts.total()} row(s) hold no message of a known topic")


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
