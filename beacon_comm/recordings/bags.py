"""Bags: rosbag2 folders, bare .db3 and .mcap files, ROS 1 .bag files; messages come out as raw CDR.

    folder ── metadata.yaml (order of the files; may be missing or wrong) ── name_0.mcap[.zstd], name_1.mcap …

No message is deserialised and no embedded definition is parsed: real bags carry definitions that no parser takes
and metadata without a storage identifier, and none of that stands in the way of the bytes.  Compression shows in the
content: a file's suffix .zstd, a message's first four bytes.
"""

from __future__ import annotations

import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory

from beacon_comm.core.errors import RecordingError
from beacon_comm.core.yaml_text import load_yaml
from beacon_comm.recordings.interfaces import is_event_type
from beacon_comm.recordings.storage import Message, TopicInfo, file_messages, file_topics

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

STORAGE_SUFFIXES = ('.mcap', '.db3')
BAG_SUFFIXES = (*STORAGE_SUFFIXES, '.bag', '.zstd')


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
        self._file_topics: list[list[TopicInfo]] = []
        self._topics: dict[str, TopicInfo] = {}
        try:
            for file in self._files:
                self._file_topics.append(file_topics(file, self._note))
                for topic in self._file_topics[-1]:
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
        for file, topics in zip(self._files, self._file_topics, strict=True):
            for part in topics:
                if (part.name, part.type) == (info.name, info.type):
                    yield from file_messages(file, part, self._note)
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
        if not self.path.is_dir():
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
        metadata = load_yaml((folder / 'metadata.yaml').read_text())
        names = metadata['rosbag2_bagfile_information']['relative_file_paths']
        # Old bags list names with their folder in front.
        return [folder / PurePath(name).name for name in names]
    except (OSError, ValueError, KeyError, TypeError):
        return []


def _natural(path: Path) -> list[tuple[int, str]]:
    """Sort name_2 before name_10."""
    return [(int(part), '') if part.isdigit() else (-1, part) for part in re.split(r'(\d+)', path.name)]
