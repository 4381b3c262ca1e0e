"""CDR bytes of event messages, as a ROS 2 subscription or a bag hands them out.

Four bytes of encapsulation (00 01 and two bytes of options: plain CDR, little endian), then the fields; every
alignment counts from behind these four bytes.

    EventPacket                               EventArray
    int32   header.stamp.sec                  int32   header.stamp.sec
    uint32  header.stamp.nanosec              uint32  header.stamp.nanosec
    string  header.frame_id                   string  header.frame_id
    uint32  height                            uint32  height
    uint32  width                             uint32  width
    uint64  seq                               Event[] events: uint16 x, uint16 y,
    uint64  time_base (ns)                                    int32 sec, uint32 nanosec, bool polarity
    string  encoding
    bool    is_bigendian
    uint8[] events: the payload

A string is a uint32 length that counts the closing zero, then the bytes; it ends at the first zero.  No length is trusted
before it is held against the bytes that are there.  Payloads are views of the caller's bytes, not copies.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.events import NS_PER_S
from beacon_comm.wire.errors import WireError

CDR_LITTLE_ENDIAN = b'\x00\x01'
ENCAPSULATION = CDR_LITTLE_ENDIAN + b'\x00\x00'
EVENT_STRIDE_BYTES = 16
LAST_EVENT_BYTES = 13
"""An Event is 13 bytes; the next one's x follows after one byte of padding, two before the stride's boundary."""
MAX_TIME_BASE_NS = 1 << 62
MOST_TEXT_BYTES = 256

_STAMP = struct.Struct('<iI')
_STAMP_AND_LENGTH = struct.Struct('<iII')
_SIZE = struct.Struct('<II')
_SEQ_AND_BASE = struct.Struct('<QQ')
_UINT32 = struct.Struct('<I')

Bytes = bytes | bytearray | memoryview


class Packet(NamedTuple):
    """An EventPacket without its encoding undone.

    Attributes:
        stamp_ns: header.stamp, the host's clock (ns).
        frame_id: header.frame_id.
        width, height: sensor size (px), as the message has it.
        seq: number of the packet, or None where the message has none.
        time_base_ns: start of the payload's time offsets (ns, sensor clock); 0 with evt3.
        encoding: name of the payload's encoding.
        is_bigendian: the payload's words have their high byte first.
        payload: encoded events, ``(n,)`` uint8, a view of the message's bytes.
    """

    stamp_ns: int
    frame_id: str
    width: int
    height: int
    seq: int | None
    time_base_ns: int
    encoding: str
    is_bigendian: bool
    payload: NDArray[np.uint8]


class ArrayPacket(NamedTuple):
    """An EventArray with its events still as bytes.

    Attributes:
        stamp_ns, frame_id, width, height: as in :class:`Packet`.
        event_count: events in the array.
        payload: bytes from the first event's first on, ``(n,)`` uint8, a view; see :mod:`.event_array`.
    """

    stamp_ns: int
    frame_id: str
    width: int
    height: int
    event_count: int
    payload: NDArray[np.uint8]


def parse_event_packet(cdr: Bytes) -> Packet:
    """Read an EventPacket (or its predecessor, ``event_array_msgs/msg/EventArray``: the same bytes).

    Raises:
        WireError: the bytes are too short for what they announce, not little-endian CDR, a text is too long, or the time
            base is beyond 2⁶² ns.
    """
    view = _contents(cdr)
    stamp_ns, frame_id, height, width, at = _header_and_size(view)
    at = (at + 7) & ~7
    _need(view, at + _SEQ_AND_BASE.size, 'seq and time_base')
    seq, time_base_ns = _SEQ_AND_BASE.unpack_from(view, at)
    if time_base_ns > MAX_TIME_BASE_NS:
        raise WireError('time_base', f'time_base = {time_base_ns}: beyond {MAX_TIME_BASE_NS} ns')
    at += _SEQ_AND_BASE.size
    _need(view, at + 4, 'encoding')
    (length,) = _UINT32.unpack_from(view, at)
    encoding, at = _string(view, at + 4, length, 'encoding')
    _need(view, at + 1, 'is_bigendian')
    is_bigendian = view[at] != 0
    at = (at + 1 + 3) & ~3
    _need(view, at + 4, 'events')
    (length,) = _UINT32.unpack_from(view, at)
    at += 4
    _need(view, at + length, 'events')
    payload = np.frombuffer(view, np.uint8, length, at)
    return Packet(stamp_ns, frame_id, width, height, seq, time_base_ns, encoding, is_bigendian, payload)


def parse_event_array(cdr: Bytes) -> ArrayPacket:
    """Read an EventArray of the shape of ``dvs_msgs/msg/EventArray``.

    Raises:
        WireError: the bytes are too short for what they announce, not little-endian CDR, or a text is too long.
    """
    view = _contents(cdr)
    stamp_ns, frame_id, height, width, at = _header_and_size(view)
    _need(view, at + 4, 'events')
    (count,) = _UINT32.unpack_from(view, at)
    at += 4
    length = EVENT_STRIDE_BYTES * (count - 1) + LAST_EVENT_BYTES if count else 0
    _need(view, at + length, 'events')
    return ArrayPacket(stamp_ns, frame_id, width, height, count, np.frombuffer(view, np.uint8, length, at))


def build_event_packet(
    stamp_ns: int,
    frame_id: str,
    width: int,
    height: int,
    seq: int,
    time_base_ns: int,
    encoding: str,
    payload: Bytes | NDArray[np.uint8],
) -> bytes:
    """Return the CDR bytes of an EventPacket with a little-endian payload."""
    data = _start(stamp_ns, frame_id, width, height)
    data += bytes(-len(data) % 8)
    data += _SEQ_AND_BASE.pack(seq, time_base_ns)
    data += _packed_string(encoding) + b'\x00'
    data += bytes(-len(data) % 4)
    body = payload.tobytes() if isinstance(payload, np.ndarray) else bytes(payload)
    return ENCAPSULATION + bytes(data) + _UINT32.pack(len(body)) + body


def build_event_array(
    stamp_ns: int,
    frame_id: str,
    width: int,
    height: int,
    x: NDArray[np.uint16],
    y: NDArray[np.uint16],
    polarity: NDArray[np.int8],
    t_ns: NDArray[np.int64],
) -> bytes:
    """Return the CDR bytes of an EventArray of the events given; arrays ``(n,)`` as in an ``EventBatch``."""
    data = _start(stamp_ns, frame_id, width, height) + _UINT32.pack(len(x))
    # Row k holds y … polarity of event k, and x of event k + 1; event 0 has its x and y where row 0 has its y.
    row = np.dtype(
        {
            'names': ['y', 'sec', 'nanosec', 'polarity', 'next_x'],
            'formats': ['<u2', '<i4', '<u4', 'u1', '<u2'],
            'offsets': [0, 4, 8, 12, 14],
            'itemsize': EVENT_STRIDE_BYTES,
        }
    )
    rows = np.zeros(len(x), row)
    rows['y'], rows['sec'], rows['nanosec'] = y, t_ns // NS_PER_S, t_ns % NS_PER_S
    rows['polarity'] = polarity > 0
    rows['next_x'][:-1] = x[1:]
    body = bytearray(rows.tobytes())
    if len(x):
        struct.pack_into('<HH', body, 0, int(x[0]), int(y[0]))
        del body[len(body) - EVENT_STRIDE_BYTES + LAST_EVENT_BYTES :]
    return ENCAPSULATION + bytes(data + body)


def packed_header(sec: int, nanosec: int, frame_id: str) -> bytearray:
    """Return the fields of a ``std_msgs/Header``, which a message begins with, behind the encapsulation."""
    return bytearray(_STAMP.pack(sec, nanosec) + _packed_string(frame_id))


def _contents(cdr: Bytes) -> memoryview:
    """Return what stands behind the encapsulation."""
    view = memoryview(cdr).cast('B') if not isinstance(cdr, bytes) else memoryview(cdr)
    if len(view) < len(ENCAPSULATION):
        raise WireError('truncated', f'{len(view)} bytes: shorter than the encapsulation')
    if view[:2] != CDR_LITTLE_ENDIAN:
        raise WireError('encapsulation', f'encapsulation {bytes(view[:2]).hex()}: not little-endian CDR (0001)')
    return view[len(ENCAPSULATION) :]


def _header_and_size(view: memoryview) -> tuple[int, str, int, int, int]:
    """Return stamp (ns), frame, height, width, and the place of what follows."""
    _need(view, _STAMP_AND_LENGTH.size, 'header')
    sec, nanosec, length = _STAMP_AND_LENGTH.unpack_from(view, 0)
    frame_id, at = _string(view, _STAMP_AND_LENGTH.size, length, 'frame_id')
    at = (at + 3) & ~3
    _need(view, at + _SIZE.size, 'height and width')
    height, width = _SIZE.unpack_from(view, at)
    return sec * NS_PER_S + nanosec, frame_id, height, width, at + _SIZE.size


def _string(view: memoryview, at: int, length: int, name: str) -> tuple[str, int]:
    _need(view, at + length, name)
    if length > MOST_TEXT_BYTES:
        raise WireError('text', f'{name} of {length} bytes: {MOST_TEXT_BYTES} at most')
    return bytes(view[at : at + length]).partition(b'\x00')[0].decode('utf-8', 'replace'), at + length


def _need(view: memoryview, end: int, name: str) -> None:
    if end > len(view):
        raise WireError('truncated', f'{name} ends at byte {end}, the message has {len(view)}')


def _packed_string(text: str) -> bytes:
    encoded = text.encode() + b'\x00'
    return _UINT32.pack(len(encoded)) + encoded


def _start(stamp_ns: int, frame_id: str, width: int, height: int) -> bytearray:
    """Return the fields up to width, without the encapsulation."""
    data = packed_header(*divmod(stamp_ns, NS_PER_S), frame_id)
    data += bytes(-len(data) % 4)
    return data + _SIZE.pack(height, width)
