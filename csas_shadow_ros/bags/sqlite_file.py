"""Read one sqlite3 storage file of rosbag2, including a killed recorder's leftovers beside it.

Format: https://github.com/ros2/rosbag2/tree/jazzy/rosbag2_storage_sqlite3. Only plain tables are read: a view
or a computed column can make any number of messages out of nothing.
"""

from __future__ import annotations

import contextlib
import sqlite3
from array import array
from collections.abc import Callable, Iterator
from pathlib import Path
from urllib.parse import quote

from csas_shadow_ros.core.errors import BagError

from .storage import RawMessage, Segment, TopicType, open_regular

SQLITE_MAGIC = b"SQLite format 3\0"
#: Columns that are read, by table.
_COLUMNS = {
    "topics": ("id", "name", "type", "serialization_format"),
    "messages": ("topic_id", "timestamp", "data"),
}
_ONE = "SELECT data FROM messages WHERE rowid=?"


class SqliteFile:
    """Reads one ``.db3`` file.

    Parameters
    ----------
    path : Path
        The file.
    complain : callable
        Called with one line for each damage, as it is met.
    name : str, optional
        What it is called in messages; the file's name by default.

    Raises
    ------
    BagError
        If it cannot be opened or is no recording.
    """

    def __init__(self, path: Path, complain: Callable[[str], None], name: str | None = None) -> None:
        self.path = path
        self.name = name or path.name
        self._complain = complain
        self.channels: dict[int, TopicType] = {}
        self.counts: dict[int, int] = {}
        self.compressions: set[str] = set()
        self.complete = True
        #: sqlite3 keeps none of what it stores.
        self.has_checksums = False
        #: By topic: time and row of each message, in time order.
        self._rows: dict[int, tuple[array[int], array[int]]] = {}
        self._wal = path.with_name(f"{path.name}-wal")
        self._killed = self._wal.exists() and self._wal.stat().st_size > 0
        if self._killed:
            self.complete = False
            complain(f"{self.name}: its recorder was killed; reading what it committed, {self._wal.name} too")
        open_regular(path).close()
        try:
            with contextlib.closing(self._connect()) as connection:
                self._learn(connection)
        except (sqlite3.Error, ValueError, TypeError, OverflowError) as error:
            raise BagError(f"cannot read {path}: {error}") from error

    def _connect(self) -> sqlite3.Connection:
        # What is not finished lies in the -wal file, which `immutable` passes over. Without locks and with
        # its index in memory, the database is read without a trace beside it, from read-only folders too.
        how = "mode=ro&vfs=unix-none" if self._killed else "immutable=1"
        address = f"file:{quote(str(self.path.absolute()))}?{how}"
        connection = sqlite3.connect(address, uri=True, isolation_level=None)
        # Text that is damaged is not worth an exception of its own.
        connection.text_factory = lambda data: data.decode(errors="replace")
        connection.execute("PRAGMA trusted_schema=OFF")
        if self._killed:
            connection.execute("PRAGMA locking_mode=EXCLUSIVE")
        return connection

    def _learn(self, connection: sqlite3.Connection) -> None:
        for table, columns in _COLUMNS.items():
            row = connection.execute("SELECT type, sql FROM sqlite_master WHERE name=?", (table,)).fetchone()
            if row is None:
                raise ValueError(f"it has no table {table!r}; expected a rosbag2 recording")
            if row[0] != "table" or not str(row[1]).upper().startswith("CREATE TABLE"):
                raise ValueError(f"{table!r} is not a plain table; expected a rosbag2 recording")
            known = {r[1]: r[6] for r in connection.execute(f"PRAGMA table_xinfo({table})")}
            if lacking := [c for c in columns if known.get(c) != 0]:
                raise ValueError(
                    f"{table!r} has no plain column {lacking[0]!r}; expected a rosbag2 recording"
                )
        for number, topic, type_name, encoding in connection.execute(
            "SELECT id, name, type, serialization_format FROM topics NOT INDEXED"
        ):
            if not isinstance(number, int):
                raise ValueError(f"a topic's id is {number!r}; expected an integer")
            self.channels[number] = TopicType(str(topic), str(type_name), str(encoding))
        found: dict[int, list[tuple[int, int]]] = {}
        strangers = 0
        try:
            for row, number, when in self._rising(connection):
                if number in self.channels and isinstance(when, int):
                    found.setdefault(number, []).append((when, row))
                else:
                    strangers += 1
        except sqlite3.Error as error:
            self.complete = False
            count = sum(map(len, found.values()))
            self._complain(f"{self.name}: {error}; {count} messages recovered")
        if strangers:
            self._complain(f"{self.name}: {strangers} messages are of no known topic or time; they are lost")
        for number, rows in found.items():
            rows.sort()
            self._rows[number] = (array("q", (t for t, _ in rows)), array("q", (r for _, r in rows)))
            self.counts[number] = len(rows)

    @staticmethod
    def _rising(connection: sqlite3.Connection) -> Iterator[tuple[int, int, int]]:
        """Iterate row, topic and time of all messages, from the table itself: an index can miss some."""
        last: int | None = None
        for row, number, when in connection.execute(
            "SELECT rowid, topic_id, timestamp FROM messages NOT INDEXED"
        ):
            # A damaged tree can lead in circles; a sound one has rising rows.
            if last is not None and row <= last:
                raise sqlite3.DatabaseError(f"row {row} comes after row {last}")
            last = row
            yield row, number, when

    def segments(self, wanted: Callable[[TopicType], bool]) -> list[Segment]:
        """Return the positions of the wanted channels' messages: one segment per file."""
        chosen = [i for i, c in self.channels.items() if i in self._rows and wanted(c)]
        if not chosen:
            return []
        return [(min(self._rows[i][0][0] for i in chosen), lambda: self._messages(chosen))]

    def _messages(self, chosen: list[int]) -> Iterator[RawMessage]:
        rows = sorted((t, r, i) for i in chosen for t, r in zip(*self._rows[i], strict=True))
        try:
            with contextlib.closing(self._connect()) as connection:
                for when, row, number in rows:
                    try:
                        (data,) = connection.execute(_ONE, (row,)).fetchone()
                        if not isinstance(data, bytes):
                            raise TypeError("it holds no bytes")
                    except (sqlite3.Error, TypeError, MemoryError) as error:
                        self._complain(f"{self.name}: row {row} is damaged ({error}); its message is lost")
                        continue
                    yield RawMessage(number, when, memoryview(data))
        except sqlite3.Error as error:
            self._complain(f"{self.name}: {error}; what follows is lost")
