"""Writing a bag of event messages: rosbag2, mcap, with the messages' definition embedded."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType

from rosbags import rosbag2
from rosbags.interfaces import Connection
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from beacon_comm.core.errors import RecordingError
from beacon_comm.recordings.interfaces import definition_text, definitions, is_event_type


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
