"""Bags: rosbag2 folders, bare .db3 and .mcap files, ROS 1 .bag files; messages come out as raw CDR.

    folder ── metadata.yaml (order of the files; may be missing or wrong) ── name_0.mcap[.zstd], name_1.mcap …

No message is deserialised and no embedded definition is parsed: real bags carry definitions that no parser takes
and metadata without a storage identifier, and none of that stands in the way of the bytes.  Compression shows in the
content: a file's suffix .zstd, a message's first four bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePath
import re
import shutil
import sys
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any

from rosbags import rosbag1, rosbag2
from rosbags.interfaces import Connection
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
import yaml

from beacon_comm.core.errors import RecordingError
from beacon_comm.recordings import mcap_scan
from beacon_comm.recordings.interfaces import definition_text, definitions, is_event_type
from beacon_comm.recordings.ros1 import event_message_to_cdr

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

STORAGE_SUFFIXES = ('.mcap', '.db3')
BAG_SUFFIXES = (*STORAGE_SUFFIXES, '.bag', '.zstd')
_ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'  # no CDR message begins like this: its first byte is 0

Message = tuple[int, bytes]


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """A topic of a bag: its name, its message type (``package/msg/Name``), and how many messages it has."""

    name: str
    type: str
    count: int


class Bag:
    """An opened recording; made by :func:`open_recording`, a context manager.

    Attributes:
        path: the recording.
        damage: what is known to be unreadable so far, one line each; empty for a sound bag.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.damage: list[str] = []
        self._scratch: TemporaryDirectory[str] | None = None
        self._files = [self._plain_file(file) for file in self._storage_files()]
        self._topics: dict[str, TopicInfo] = {}
        try:
            for file in self._files:
                for topic in _file_topics(file, self._note):
                    known = self._topics.get(topic.name, TopicInfo(topic.name, topic.type, 0))
                    self._topics[topic.name] = TopicInfo(topic.name, known.type, known.count + topic.count)
            if not self._topics and self.damage:
                raise RecordingError(self.damage[0])
        except BaseException:
            self.close()
            raise

    def topics(self) -> list[TopicInfo]:
        """Return the topics, in the order of their names."""
        return sorted(self._topics.values(), key=lambda topic: topic.name)

    def event_topic(self, name: str | None = None) -> TopicInfo:
        """Return the topic called ``name``, or without a name the only one that has events.

        Raises:
            RecordingError: no such topic, none, or several; the text lists what the bag holds.
        """
        listing = ', '.join(f'{t.name} ({t.type}, {t.count})' for t in self.topics()) or 'nothing'
        if name is not None:
            topic = self._topics.get(name)
            if topic is None or not is_event_type(topic.type):
                raise RecordingError(f'{self.path}: no event topic {name} (the bag holds {listing})')
            return topic
        candidates = [topic for topic in self.topics() if is_event_type(topic.type)]
        if len(candidates) > 1:
            candidates = [topic for topic in candidates if topic.count] or candidates
        if len(candidates) != 1:
            problem = 'several event topics, choose one' if candidates else 'no event topic'
            raise RecordingError(f'{self.path}: {problem} (the bag holds {listing})')
        return candidates[0]

    def messages(self, topic: TopicInfo | str) -> Iterator[Message]:
        """Yield ``(recorded_ns, cdr)`` of a topic's messages, ordered by recorded time within each file.

        Raises:
            RecordingError: at the end, after everything that could be read, if something could not.
        """
        info = topic if isinstance(topic, TopicInfo) else self._topics[topic]
        for file in self._files:
            yield from _file_messages(file, info, self._note)
        if self.damage:
            raise RecordingError('; '.join(self.damage))

    def close(self) -> None:
        """Remove what was unpacked."""
        if self._scratch is not None:
            self._scratch.cleanup()
            self._scratch = None

    def __enter__(self) -> Bag:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _note(self, file: Path, reason: object) -> None:
        shown = self.path / file.name if self.path.is_dir() else self.path
        line = f'{shown}: {str(reason).strip() or type(reason).__name__}'
        if line not in self.damage:
            self.damage.append(line)

    def _storage_files(self) -> list[Path]:
        if not self.path.exists():
            raise RecordingError(f'{self.path}: no such file or folder')
        if self.path.is_file():
            if self.path.suffix not in BAG_SUFFIXES:
                raise RecordingError(f'{self.path}: not a bag ({", ".join(BAG_SUFFIXES)} or a rosbag2 folder)')
            return [self.path]
        listed = _listed_files(self.path)
        present = [file for file in listed if file.is_file()]
        if present:
            for file in listed:
                if file not in present:
                    self._note(file, 'listed in metadata.yaml, but missing')
            return present
        found = [
            file for file in self.path.iterdir() if PurePath(file.name.removesuffix('.zstd')).suffix in STORAGE_SUFFIXES
        ]
        if not found:
            raise RecordingError(f'{self.path}: no .mcap or .db3 file in this folder')
        return sorted(found, key=_natural)

    def _plain_file(self, file: Path) -> Path:
        """Return the file itself, or the unpacked copy of a compressed one (as far as it can be unpacked)."""
        if file.suffix != '.zstd':
            return file
        if self._scratch is None:
            self._scratch = TemporaryDirectory(prefix='beacon_comm_')
        plain = Path(self._scratch.name, file.stem)
        try:
            with zstd.open(file, 'rb') as packed, plain.open('wb') as unpacked:
                shutil.copyfileobj(packed, unpacked)
        except (zstd.ZstdError, EOFError, OSError) as error:
            self._note(file, error)
        return plain


def open_recording(path: str | Path) -> Bag:
    """Open a bag: a rosbag2 folder, a .mcap or .db3 file (also .zstd of one), or a ROS 1 .bag.

    Raises:
        RecordingError: there is nothing readable; the text names the file and the reason.
    """
    return Bag(Path(path))


def _listed_files(folder: Path) -> list[Path]:
    try:
        metadata = yaml.safe_load((folder / 'metadata.yaml').read_text())
        names = metadata['rosbag2_bagfile_information']['relative_file_paths']
        # Old bags list names with their folder in front.
        return [folder / PurePath(name).name for name in names]
    except (OSError, UnicodeDecodeError, yaml.YAMLError, KeyError, TypeError):
        return []


def _natural(path: Path) -> list[tuple[int, str]]:
    """Sort name_2 before name_10."""
    return [(int(part), '') if part.isdigit() else (-1, part) for part in re.split(r'(\d+)', path.name)]


Note = Callable[[Path, object], None]


@contextmanager
def _noting(file: Path, note: Note) -> Iterator[None]:
    # The readers below were not made for damaged files and raise whatever they stumble over.
    try:
        yield
    except Exception as error:
        note(file, error)


def _reader(file: Path) -> Any:
    return rosbag1.Reader(file) if file.suffix == '.bag' else rosbag2.Reader(file)


def _file_topics(file: Path, note: Note) -> list[TopicInfo]:
    try:
        with _reader(file) as reader:
            return [TopicInfo(c.topic, c.msgtype, c.msgcount) for c in reader.connections]
    except Exception as error:
        if file.suffix != '.mcap':
            note(file, error)
            return []
    counts: dict[tuple[str, str], int] = {}
    with _noting(file, note):
        for message in mcap_scan.scan(file):
            key = (message.topic, message.type)
            counts[key] = counts.get(key, 0) + 1
    return [TopicInfo(name, message_type, count) for (name, message_type), count in counts.items()]


def _file_messages(file: Path, topic: TopicInfo, note: Note) -> Iterator[Message]:
    count = 0
    try:
        with _reader(file) as reader:
            wanted = [c for c in reader.connections if c.topic == topic.name and c.msgtype == topic.type]
            if not wanted:
                return
            for _, recorded_ns, content in reader.messages(wanted):
                if file.suffix == '.bag':
                    content = event_message_to_cdr(content, topic.type)
                yield recorded_ns, _plain(content)
                count += 1
        return
    except Exception as error:
        if file.suffix != '.mcap' or count:
            note(file, f'damaged after {count} messages of {topic.name}: {error}')
            return
    with _noting(file, note):
        for message in mcap_scan.scan(file):
            if (message.topic, message.type) == (topic.name, topic.type):
                yield message.recorded_ns, _plain(message.content)


def _plain(content: bytes) -> bytes:
    return zstd.decompress(content) if content[:4] == _ZSTD_MAGIC else bytes(content)


class BagWriter:
    """Writes a rosbag2 folder (mcap, metadata version 8, which every ROS 2 reads); a context manager.

    An error inside the ``with`` block leaves a bag without index, which :func:`open_recording` still reads.
    """

    def __init__(self, folder: str | Path) -> None:
        """Prepare ``folder``, which must not exist yet.

        Raises:
            RecordingError: it exists, or cannot be made.
        """
        self.folder = Path(folder)
        if self.folder.exists():
            raise RecordingError(f'{folder}: exists already, nothing is overwritten')
        self._writer = rosbag2.Writer(self.folder, version=8, storage_plugin=rosbag2.StoragePlugin.MCAP)
        # Left empty it would be written as null, which older rosbag2 refuses.
        self._writer.set_custom_data('written_by', 'beacon_comm')
        self._connections: dict[str, Connection] = {}
        try:
            self._writer.open()
        except OSError as error:
            raise RecordingError(f'{folder}: cannot be made ({error.strerror})') from error

    def add_topic(self, name: str, message_type: str) -> None:
        """Declare a topic of an event message type.

        Raises:
            RecordingError: not an event message, so its definition is not known.
        """
        if not is_event_type(message_type):
            raise RecordingError(f'{self.folder}: no definition of {message_type} at hand, it cannot be written')
        store = get_typestore(Stores.EMPTY)
        for type_name, text in definitions(message_type).items():
            if type_name not in store.types:
                store.register(get_types_from_msg(text, type_name))
        self._connections[name] = self._writer.add_connection(
            name, message_type, msgdef=definition_text(message_type), rihs01=store.hash_rihs01(message_type)
        )

    def write(self, topic: str, recorded_ns: int, cdr: bytes) -> None:
        """Append one message.

        Raises:
            RecordingError: the disk refused it.
        """
        try:
            self._writer.write(self._connections[topic], recorded_ns, cdr)
        except OSError as error:
            raise RecordingError(f'{self.folder}: cannot be written ({error.strerror})') from error

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.__exit__(kind, error, trace)
