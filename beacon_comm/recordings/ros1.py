"""Event messages of ROS 1 bags, turned into the CDR that everything else reads.

ROS 1 packs little endian without padding, its Header begins with a uint32 seq, and its strings carry no zero byte:

    seq | sec nanosec | n frame_id | height width | seq64 time_base64 | n encoding | bigendian | n payload   (packet)
    seq | sec nanosec | n frame_id | height width | n (x16 y16 sec nanosec polarity8)…                       (array)

CDR aligns every field to its size, counted from the end of the 4-byte encapsulation header.
"""

from __future__ import annotations

import struct

import numpy as np

from beacon_comm.recordings.interfaces import is_event_type
from beacon_comm.wire.stream import is_event_array_type

_EVENT_ROS1 = np.dtype([('x', '<u2'), ('y', '<u2'), ('sec', '<u4'), ('nanosec', '<u4'), ('polarity', 'u1')])
# An event of the CDR array, seen from its y: x comes in the two bytes before the next 16-byte step.
_EVENT_CDR = np.dtype(
    {
        'names': ['y', 'sec', 'nanosec', 'polarity', 'next_x'],
        'formats': ['<u2', '<u4', '<u4', 'u1', '<u2'],
        'offsets': [0, 4, 8, 12, 14],
        'itemsize': 16,
    }
)


class _Ros1:
    """Takes fields off ROS 1 bytes one after the other."""

    def __init__(self, raw: bytes | memoryview) -> None:
        self._raw = memoryview(raw)
        self._at = 0

    def take(self, layout: str) -> tuple[int, ...]:
        """Return the next fields by a :mod:`struct` layout."""
        fields = struct.unpack_from('<' + layout, self._raw, self._at)
        self._at += struct.calcsize('<' + layout)
        return fields

    def take_bytes(self, count: int) -> bytes:
        """Return the next ``count`` bytes."""
        if self._at + count > len(self._raw):
            raise ValueError(f'{count} bytes announced, {len(self._raw) - self._at} left')
        self._at += count
        return bytes(self._raw[self._at - count : self._at])


class _Cdr:
    """Appends fields to little-endian CDR."""

    def __init__(self) -> None:
        self._bytes = bytearray(b'\x00\x01\x00\x00')

    def put(self, kind: str, value: int) -> None:
        """Append one field of a :mod:`struct` kind, aligned to its size."""
        size = struct.calcsize('<' + kind)
        self._bytes += bytes(-(len(self._bytes) - 4) % size)
        self._bytes += struct.pack('<' + kind, value)

    def put_string(self, text: bytes) -> None:
        """Append a string: its length with the zero byte, the text, the zero byte."""
        self.put('I', len(text) + 1)
        self._bytes += text + b'\x00'

    def put_sequence(self, count: int, content: bytes) -> None:
        """Append a sequence: its count of elements and their bytes."""
        self.put('I', count)
        self._bytes += content

    def finished(self) -> bytes:
        """Return the message."""
        return bytes(self._bytes)


def event_message_to_cdr(raw: bytes | memoryview, message_type: str) -> bytes:
    """Return a ROS 1 event message as CDR of the same type.

    Raises:
        ValueError, struct.error: the bytes are not such a message.
        KeyError: not an event message.
    """
    if not is_event_type(message_type):
        raise KeyError(message_type)
    source, cdr = _Ros1(raw), _Cdr()
    _, sec, nanosec, length = source.take('IIII')
    cdr.put('I', sec)
    cdr.put('I', nanosec)
    cdr.put_string(source.take_bytes(length))
    for value in source.take('II'):  # height, width
        cdr.put('I', value)
    if is_event_array_type(message_type):
        (count,) = source.take('I')
        cdr.put_sequence(count, _events_to_cdr(source.take_bytes(count * _EVENT_ROS1.itemsize), count))
        return cdr.finished()
    for value in source.take('QQ'):  # seq, time_base
        cdr.put('Q', value)
    (length,) = source.take('I')
    cdr.put_string(source.take_bytes(length))
    (is_bigendian,) = source.take('B')
    cdr.put('B', is_bigendian)
    (length,) = source.take('I')
    cdr.put_sequence(length, source.take_bytes(length))
    return cdr.finished()


def _events_to_cdr(packed: bytes, count: int) -> bytes:
    if count == 0:
        return b''
    events = np.frombuffer(packed, _EVENT_ROS1, count)
    out = np.zeros(count, _EVENT_CDR)
    out['y'], out['sec'], out['nanosec'] = events['y'], events['sec'], events['nanosec']
    out['polarity'] = events['polarity']
    out['next_x'][:-1] = events['x'][1:]
    # Only the first event is drawn otherwise: nothing needs to be aligned before it, so x stands at 0 and y at 2.
    return struct.pack('<HH', events['x'][0], events['y'][0]) + out.tobytes()[4 : 16 * count - 3]
