"""The SQLite storage of rosbag2, read as far as a damaged file allows.

    topics    id, name, type, …
    messages  id, topic_id → topics, timestamp (ns), data (CDR)
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path


def topics(path: Path) -> Iterator[tuple[str, str, int]]:
    """Yield ``(name, type, count)`` of each topic; where damage prevents counting, a count of 0.

    Raises:
        sqlite3.Error: no such database.
    """
    with closing(_connect(path)) as database:
        rows = database.execute('SELECT id, name, type FROM topics ORDER BY id').fetchall()
        try:
            counts = dict(database.execute('SELECT topic_id, COUNT(*) FROM messages GROUP BY topic_id'))
        except sqlite3.DatabaseError:
            counts = {}
        for key, name, message_type in rows:
            yield name, message_type, counts.get(key, 0)


def messages(path: Path, name: str, message_type: str) -> Iterator[tuple[int, bytes]]:
    """Yield ``(recorded_ns, content)`` of a topic's messages by recorded time.

    Raises:
        sqlite3.Error: the database is damaged from here on.
    """
    with closing(_connect(path)) as database:
        yield from database.execute(
            'SELECT timestamp, data FROM messages WHERE topic_id IN'
            ' (SELECT id FROM topics WHERE name = ? AND type = ?) ORDER BY timestamp',
            (name, message_type),
        )


def _connect(path: Path) -> sqlite3.Connection:
    # Immutable: SQLite then needs no write access to the folder.  Not with a write-ahead log beside the file,
    # which a recorder that was killed leaves: its messages would be passed over.
    mode = 'mode=ro' if path.with_name(path.name + '-wal').exists() else 'immutable=1'
    return sqlite3.connect(f'{path.absolute().as_uri()}?{mode}', uri=True)
