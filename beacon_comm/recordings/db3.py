"""The SQLite storage of rosbag2, read as far as a damaged file allows.

    topics    id, name, type, …
    messages  id, topic_id → topics, timestamp (ns), data (CDR)

A file that is cut short, or has pages that are not SQLite's, is read in the order of ids once the order of time cannot be
had: what lies on a bad page is stepped over.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

_TOPICS = 'SELECT id, name, type FROM topics ORDER BY id'
_MESSAGES = 'SELECT id, timestamp, data FROM messages WHERE topic_id IN ({})'
_BY_TIME = _MESSAGES + ' ORDER BY timestamp'
_BY_ID = _MESSAGES + ' AND id > ? ORDER BY id'
_LAST_ID = 1 << 40
_IDS_OF_A_PAGE = 64  # a bad page may hold so many


def topics(path: Path) -> Iterator[tuple[str, str, int]]:
    """Yield ``(name, type, count)`` of each topic; where damage prevents counting, a count of 0.

    Raises:
        sqlite3.Error: no such database.
    """
    with closing(_connect(path)) as database:
        rows = [row for row in database.execute(_TOPICS) if isinstance(row[1], str) and isinstance(row[2], str)]
        try:
            counts = dict(database.execute('SELECT topic_id, COUNT(*) FROM messages GROUP BY topic_id'))
        except sqlite3.DatabaseError:
            counts = {}
        for key, name, message_type in rows:
            yield name, message_type, counts.get(key, 0)


def messages(path: Path, name: str, message_type: str) -> Iterator[tuple[int, bytes]]:
    """Yield ``(recorded_ns, content)`` of a topic's messages by recorded time.

    Raises:
        sqlite3.Error: at the end, after everything that could be read, if something could not.
    """
    with closing(_connect(path)) as database:
        keys = [key for (key, *topic) in database.execute(_TOPICS) if topic == [name, message_type]]
        wanted = ','.join(str(int(key)) for key in keys)
        reached_ns, given = -(1 << 63), set[int]()  # by their times; the ids of the last one
        try:
            for key, recorded_ns, content in database.execute(_BY_TIME.format(wanted)):
                if not _is_message(recorded_ns, content):
                    raise sqlite3.DatabaseError(f'{type(content).__name__} in the place of a message')
                if recorded_ns > reached_ns:
                    reached_ns = recorded_ns
                    given.clear()
                given.add(key)
                yield recorded_ns, content
        except sqlite3.Error as error:
            for key, recorded_ns, content in _salvage(database, wanted):
                if recorded_ns >= reached_ns and key not in given:
                    yield recorded_ns, content
            raise error


def _salvage(database: sqlite3.Connection, wanted: str) -> Iterator[tuple[int, int, bytes]]:
    """Yield ``(id, recorded_ns, content)`` by id, stepping over what cannot be read."""
    reached, step = -(1 << 63), 0
    while reached + step < _LAST_ID:
        try:
            for key, recorded_ns, content in database.execute(_BY_ID.format(wanted), (reached + step,)):
                reached, step = key, 0
                if _is_message(recorded_ns, content):
                    yield key, recorded_ns, content
            return
        except sqlite3.DatabaseError:
            reached = max(reached, 0)
            step = step + 1 if step < _IDS_OF_A_PAGE else 2 * step


def _is_message(recorded_ns: object, content: object) -> bool:
    # SQLite holds values of any type in any column.
    return isinstance(recorded_ns, int) and isinstance(content, bytes)


def _connect(path: Path) -> sqlite3.Connection:
    # Immutable: SQLite then needs no write access to the folder.  Not with a write-ahead log beside the file,
    # which a recorder that was killed leaves: its messages would be passed over.
    mode = 'mode=ro' if path.with_name(path.name + '-wal').exists() else 'immutable=1'
    database = sqlite3.connect(f'{path.absolute().as_uri()}?{mode}', uri=True)
    # A file that is shorter than its head says is then read as far as it goes, and not refused altogether.
    database.execute('PRAGMA writable_schema = ON')
    database.text_factory = lambda text: text.decode('utf-8', 'replace')
    return database
