"""One file of a bag, whatever it is stored in: its topics and its messages, and what is wrong with it.

    .db3   SQLite                       .bag    ROS 1, its event messages turned into CDR
    .mcap  with or without its index    (likewise); a message compressed by itself begins with Zstandard's magic number
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from rosbags import rosbag1, rosbag2

from beacon_comm.recordings import db3, mcap_scan, ros1_scan
from beacon_comm.recordings.compression import decompress
from beacon_comm.recordings.mcap_scan import ScannedMessage
from beacon_comm.recordings.ros1 import event_message_to_cdr

_ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'  # no CDR message begins like this: its first byte is 0

Message = tuple[int, bytes]
"""Recorded time (ns) and CDR."""
Note = Callable[[Path, object], None]
"""Takes a file and what is wrong with it."""


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """A topic of a bag: its name, its message type (``package/msg/Name``), and how many messages it has."""

    name: str
    type: str
    count: int


@contextmanager
def _noting(file: Path, note: Note) -> Iterator[None]:
    # The readers below were not made for damaged files and raise whatever they stumble over.
    try:
        yield
    except Exception as error:
        note(file, error)


def file_topics(file: Path, note: Note) -> list[TopicInfo]:
    """Return the topics of one storage file; damage goes to ``note``."""
    found: list[TopicInfo] = []
    with _noting(file, note):
        if file.suffix == '.db3':
            found.extend(TopicInfo(*row) for row in db3.topics(file))
        elif file.suffix == '.bag':
            found.extend(_ros1_topics(file))
        else:
            found.extend(_mcap_topics(file))
    return found


def file_messages(file: Path, topic: TopicInfo, note: Note) -> Iterator[Message]:
    """Yield a topic's messages from one storage file by recorded time; damage goes to ``note`` and ends it."""
    with _noting(file, note):
        if file.suffix == '.db3':
            messages = db3.messages(file, topic.name, topic.type)
        elif file.suffix == '.bag':
            messages = _ros1_messages(file, topic)
        else:
            messages = _of_topic(mcap_scan.scan(file), topic)
        bad: ValueError | None = None
        for recorded_ns, content in messages:
            try:
                cdr = decompress('zstd', content) if content[:4] == _ZSTD_MAGIC else content
            except ValueError as error:
                bad = error
                continue
            yield recorded_ns, cdr
        if bad is not None:
            raise bad


def _ros1_topics(file: Path) -> Iterator[TopicInfo]:
    try:
        with rosbag1.Reader(file) as reader:  # quick, but needs the index
            found = [TopicInfo(c.topic, c.msgtype, c.msgcount) for c in reader.connections]
        yield from found
    except Exception:
        yield from _counted(ros1_scan.scan(file))


def _ros1_messages(file: Path, topic: TopicInfo) -> Iterator[Message]:
    bad = 0
    for recorded_ns, content in _of_topic(ros1_scan.scan(file), topic):
        try:
            cdr = event_message_to_cdr(content, topic.type)
        except (ValueError, struct.error):
            bad += 1
            continue
        yield recorded_ns, cdr
    if bad:
        raise ValueError(f'{bad} messages of {topic.name} are not what their type says')


def _mcap_topics(file: Path) -> Iterator[TopicInfo]:
    try:
        with rosbag2.Reader(file) as reader:  # quick, but needs an intact end and definitions in a known format
            found = [TopicInfo(c.topic, c.msgtype, c.msgcount) for c in reader.connections]
        yield from found
    except Exception:
        yield from _counted(mcap_scan.scan(file))


def _counted(messages: Iterator[ScannedMessage]) -> Iterator[TopicInfo]:
    """Yield the topics of a file that is read from its beginning; raise, behind them, what ended it."""
    counts: Counter[tuple[str, str]] = Counter()
    damage: ValueError | None = None
    try:
        counts.update((message.topic, message.type) for message in messages)
    except ValueError as error:
        damage = error
    yield from [TopicInfo(name, message_type, count) for (name, message_type), count in counts.items()]
    if damage is not None:
        raise damage


def _of_topic(messages: Iterator[ScannedMessage], topic: TopicInfo) -> Iterator[Message]:
    """Yield a topic's messages; raise at their end if there are fewer than were announced."""
    count = 0
    for message in messages:
        if (message.topic, message.type) == (topic.name, topic.type):
            yield message.recorded_ns, message.content
            count += 1
    if count < topic.count:
        raise ValueError(f'{topic.count} messages of {topic.name} announced, {count} found')
