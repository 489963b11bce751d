# SPDX-License-Identifier: Apache-2.0
"""Messages of one rosbag2 sqlite3 file: by rosbags where it is whole, row by row where it is damaged.

rosbags refuses a database whose end is missing. Neither side may run what the file defines: it is opened read-only and
immutable, and a bound on sqlite's own instructions ends a query that does not.
"""

from __future__ import annotations

import re
import sqlite3
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

from iwm_power_manager.bags.limits import SQLITE_INSTRUCTIONS, SQLITE_INSTRUCTIONS_PER_BYTE, regular_file
from iwm_power_manager.bags.mcap_records import ChunkMessage
from iwm_power_manager.bags.metadata import Qos, Topic
from iwm_power_manager.errors import BagError

_STEP = 100_000


class SqliteSource:
    """A rosbag2 sqlite3 file. Attributes as those of `mcap_source.McapSource`, where a topic's id is its channel."""

    def __init__(self, path: Path, stack: ExitStack) -> None:
        self.path = path
        self.damage: list[str] = []
        self.counts: Counter[int] = Counter()
        self.start_ns = self.end_ns = 0
        self.indexed = True
        self._topics: dict[int, Topic] = {}
        self._reader: Any = None
        self._database: sqlite3.Connection | None = None
        size = regular_file(path)
        self._steps = (SQLITE_INSTRUCTIONS + SQLITE_INSTRUCTIONS_PER_BYTE * size) // _STEP
        try:
            self._open_whole(stack)
        except Exception as error:  # noqa: BLE001 - apsw's errors, and whatever rosbags makes of other people's tables
            self._open_damaged(stack, _one_line(error))

    def topics(self) -> dict[int, Topic]:
        """The topic of each id."""
        return self._topics

    def topic_counts(self) -> Counter[str]:
        """Messages by topic."""
        found: Counter[str] = Counter()
        for number, topic in self._topics.items():
            found[topic.name] += self.counts[number]
        return found

    def information(self) -> dict[str, Any]:
        """Nothing is kept inside that `metadata.yaml` does not say."""
        return {}

    def custom_data(self) -> dict[str, str]:
        """There is none in these files."""
        return {}

    def messages(self) -> Iterator[ChunkMessage]:
        """All messages in the order of their log times, of a damaged file in the order of recording."""
        delivered = bad = 0
        try:
            for number, log_time, data in self._rows():
                if number in self._topics and isinstance(log_time, int) and log_time >= 0 and isinstance(data, bytes):
                    delivered += 1
                    yield ChunkMessage(log_time, number, data, log_time, 0, 0)
                else:
                    bad += 1
        except GeneratorExit:
            raise
        except Exception as error:  # noqa: BLE001 - see above
            self.damage.append(f"readable up to message {delivered}: {_one_line(error)}")
        if bad:
            self.damage.append(f"{bad} row(s) hold no message of a known topic")

    def _rows(self) -> Iterator[tuple[Any, Any, Any]]:
        if self._reader is not None:
            for connection, log_time, data in self._reader.messages(self._reader.connections):
                yield connection.id, log_time, data
        elif self._database is not None:
            yield from self._database.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY id")

    def _open_whole(self, stack: ExitStack) -> None:
        from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

        if re.search(r"[?#%]", str(self.path)):
            raise BagError("its name means something else in the address rosbags makes of it")
        with _bounded(self._steps):
            reader = Sqlite3Reader(self.path)
            reader.open()
        stack.callback(reader.close)
        for found in reader.connections:
            ext: Any = found.ext
            encoding = "" if found.msgdef.format.name == "NONE" else f"ros2{found.msgdef.format.name.lower()}"
            profiles = tuple(Qos.of_rosbags(profile) for profile in ext.offered_qos_profiles)
            texts = (found.topic, found.msgtype, found.msgdef.data, found.digest or "", ext.serialization_format)
            if not isinstance(found.id, int) or not all(isinstance(text, str) for text in texts):
                raise BagError("a topic is described by something else than text")
            name, msgtype, definition, digest, serialization = texts
            self._topics[found.id] = Topic(name, msgtype, definition, digest, profiles, encoding, serialization)
            self.counts[found.id] = found.msgcount
        if reader.metadata.message_count:
            self.start_ns, self.end_ns = reader.metadata.start_time, reader.metadata.end_time - 1
        self._reader = reader

    def _open_damaged(self, stack: ExitStack, reason: str) -> None:
        self._topics.clear()
        self.counts.clear()
        left = self._steps

        def out_of_steps() -> bool:
            nonlocal left
            left -= 1
            return left < 0

        try:
            address = f"{self.path.resolve().as_uri()}?mode=ro&immutable=1"
            database = stack.enter_context(closing(sqlite3.connect(address, uri=True)))
            database.set_progress_handler(out_of_steps, _STEP)
            database.execute("PRAGMA trusted_schema = OFF")
            # A truncated file is refused as a whole, unless one says that one knows.
            database.execute("PRAGMA writable_schema = ON")
            kinds = dict(database.execute("SELECT name, type FROM sqlite_master WHERE name IN ('topics', 'messages')"))
            if kinds != {"topics": "table", "messages": "table"}:
                raise BagError(f"{self.path}: is no rosbag2 sqlite3 bag: {reason}")
            self._read_topics(database)
        except (sqlite3.Error, ValueError) as error:
            raise BagError(f"{self.path}: is no readable sqlite3 bag: {_one_line(error)}") from None
        self.damage.append(f"is damaged: {reason}")
        self.indexed = False
        self._database = database
        try:
            for number, count, start, end in database.execute(
                "SELECT topic_id, count(*), min(timestamp), max(timestamp) FROM messages GROUP BY topic_id"
            ):
                self.counts[number] = int(count)
                self.start_ns = min(self.start_ns or start, start)
                self.end_ns = max(self.end_ns, end)
        except (sqlite3.Error, TypeError, ValueError):
            self.counts.clear()

    def _read_topics(self, database: sqlite3.Connection) -> None:
        texts: dict[str, tuple[str, str]] = {}
        try:
            for name, encoding, text in database.execute(
                "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            ):
                texts[str(name)] = (str(encoding), str(text))
        except sqlite3.Error:
            pass  # bags older than Iron carry no definitions
        for number, name, msgtype in database.execute("SELECT id, name, type FROM topics"):
            encoding, text = texts.get(str(msgtype), ("", ""))
            self._topics[number] = Topic(str(name), str(msgtype), text, "", (), encoding)


@contextmanager
def _bounded(steps: int) -> Iterator[None]:
    """Connections that apsw opens meanwhile give up after so many steps."""
    import apsw

    def bound(connection: apsw.Connection) -> None:
        left = steps

        def out_of_steps() -> bool:
            nonlocal left
            left -= 1
            return left < 0

        connection.set_progress_handler(out_of_steps, _STEP)

    apsw.connection_hooks.append(bound)
    try:
        yield
    finally:
        apsw.connection_hooks.remove(bound)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
