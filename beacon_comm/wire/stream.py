"""One topic's messages, byte by byte as they come, to one stream of event batches.

    message's bytes ──► fields ──► frame, size, encoding, seq looked at ──► payload decoded ──► Decoded

*Order of packets.*  A step of seq by more than one tells of lost packets; the batch that follows says up to where the
stream is missing.  A packet of a seq up to ``MOST_LATE`` back whose stamp is not newer was overtaken by others: it is
passed over, like one that comes again.  A third one in a row is the beginning of a recording played again, or of a
driver started again.

Everything that can be wrong with a message is counted by kind in :attr:`EventStream.counts` and named in
:attr:`Decoded.problem`; nothing is raised for bad bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from beacon_comm.core.events import EventBatch
from beacon_comm.wire.cdr import ArrayPacket, Bytes, Packet, parse_event_array, parse_event_packet
from beacon_comm.wire.errors import WireError
from beacon_comm.wire.event_array import EventArrayDecoder
from beacon_comm.wire.evt3 import Evt3Decoder
from beacon_comm.wire.libcaer import LibcaerCmpDecoder, LibcaerDecoder
from beacon_comm.wire.mono import MonoDecoder
from beacon_comm.wire.reading import TALLY_KINDS, Continuity, PayloadDecoder, Reading

PACKET_TYPES = ('event_camera_msgs/msg/EventPacket', 'event_array_msgs/msg/EventArray')
"""The second is the first one's former name: the same bytes, no array of events."""
SUPPORTED_TYPES = (
    *PACKET_TYPES,
    'dvs_msgs/msg/EventArray',
    'prophesee_event_msgs/msg/EventArray',
    'dv_ros2_msgs/msg/EventArray',
)
ENCODINGS: Mapping[str, Callable[[], PayloadDecoder]] = {
    'evt3': Evt3Decoder,
    'libcaer_cmp': LibcaerCmpDecoder,
    'libcaer': LibcaerDecoder,
    'mono': MonoDecoder,
}
MAX_SIDE_PX = 1 << 12
"""No event sensor is larger; images of a size that a damaged message names are not to be made."""
MOST_LATE = 8
"""Packets by which one may come late."""
MOST_LOST = 1 << 20
"""Packets that one gap is counted as, at most."""
LATE_IN_A_ROW = 2
"""So many late packets in a row are late; more are a stream that begins anew."""

COUNTS: Mapping[str, str] = {
    'packets': 'messages handed in',
    'events': 'events given out',
    'empty_packets': 'messages read that hold no payload',
    'lost_packets': 'messages that seq tells are missing',
    'shed_packets': 'messages passed over undecoded because there was no time for them',
    'repeated_packets': 'messages that came twice: passed over',
    'overtaken_packets': 'messages that came after later ones: passed over',
    'restarts': 'sensor restarts: event time stepped back by more than 1 s',
    'resizes': 'changes of the sensor size',
    'bad_messages': 'messages whose bytes are not what the type says',
    'bad_sizes': f'messages with a sensor size outside 1 to {MAX_SIDE_PX} px',
    'unknown_encodings': 'messages in an encoding not known here',
    'big_endian_payloads': 'messages with is_bigendian set: not read',
    'refused_frames': 'messages of a second camera (another frame_id) on the topic',
    'odd_bytes': "bytes at a payload's end that are no whole word",
    'skipped_words': 'words of unknown code',
    'outside_events': 'events outside the sensor',
    'undecoded_events': 'events before time, row or vector base was known, or before a restart in their packet',
    'clamped_times': 'events whose time would step back; they got the time reached',
    'triggers_0': 'edges at a trigger input whose edge bit is 0',
    'triggers_1': 'edges at a trigger input whose edge bit is 1',
}
"""Kind -> meaning of what an EventStream counts."""


def is_event_array_type(name: str) -> bool:
    """Return True for message types that hold an array of events: any package's EventArray, but for the one
    that was EventPacket's former name."""
    return name.endswith('/msg/EventArray') and name not in PACKET_TYPES


class Decoded(NamedTuple):
    """What one message gave.

    Attributes:
        batch: its events and the stream's time after it; None if the message was not read (see ``problem``), or
            the stream's time is not known yet.
        stamp_ns: header.stamp (ns, host clock); 0 if the message was not read.
        frame_id: header.frame_id; '' if the bytes were not read.
        width, height: sensor size (px); 0 if the bytes were not read.
        first_event_ns: time of the batch's first event (ns, sensor clock); None without events.
        restarted: the sensor was restarted; the batch begins a new time.
        resized: the sensor's size differs from the message's before.
        lost_packets: messages missing before this one.
        problem: why the message was not read, as text with its names and values; None if it was read.
        problem_kind: the kind in ``EventStream.counts`` that the problem was counted under, or None.
    """

    batch: EventBatch | None
    stamp_ns: int
    frame_id: str
    width: int
    height: int
    first_event_ns: int | None = None
    restarted: bool = False
    resized: bool = False
    lost_packets: int = 0
    problem: str | None = None
    problem_kind: str | None = None


NOTHING = Decoded(None, 0, '', 0, 0)


class EventStream:
    """Reader of one event topic of one camera.

    Times of the batches are int64 ns of the sensor's clock and never step back, but where ``restarted`` is set.
    With evt3 they are unwrapped from 24 bits of µs and start below 2²⁴ µs at the first TIME_HIGH seen; in the
    other formats they are what the driver sends.

    Raises:
        WireError: a message type that is not an event message's.
    """

    def __init__(self, message_type: str) -> None:
        self._is_array = is_event_array_type(message_type)
        if not self._is_array and message_type not in PACKET_TYPES:
            raise WireError('type', f'{message_type}: not one of {", ".join(SUPPORTED_TYPES)}')
        self._counts = dict.fromkeys(COUNTS, 0)
        self._tally = np.zeros(len(TALLY_KINDS), np.int64)
        self._frame_id: str | None = None
        self._size: tuple[int, int] | None = None
        self._encoding = ''
        self._decoder: PayloadDecoder | None = None
        self._array_decoder = EventArrayDecoder()
        self._last: Packet | None = None
        self._late_in_a_row = 0
        self._skipped = 0  # messages passed over since the last one that was read
        self._missing = False  # until events come again

    @property
    def counts(self) -> Mapping[str, int]:
        """What was counted so far, kind -> number; the kinds and their meaning are in :data:`COUNTS`."""
        for place, kind in enumerate(TALLY_KINDS):
            self._counts[kind] = int(self._tally[place])
        return MappingProxyType(self._counts)

    def shed(self) -> None:
        """Pass a message over unread: what was in it is missing."""
        self._counts['packets'] += 1
        self._counts['shed_packets'] += 1
        self._skipped += 1
        self._missing = True

    def lost(self) -> None:
        """Hear that messages were lost, or could not be read; packets know better, by their seq."""
        self._missing |= self._is_array

    def push(self, cdr: Bytes) -> Decoded:
        """Decode one message's CDR bytes; whatever they hold, nothing is raised."""
        self._counts['packets'] += 1
        packet: Packet | ArrayPacket
        try:
            packet = parse_event_array(cdr) if self._is_array else parse_event_packet(cdr)
        except WireError as error:
            return self._problem(None, 'bad_messages', str(error))
        found = self._find_problem(packet)
        if found is not None:
            return self._problem(packet, *found)
        out_of_order = self._find_disorder(packet) if isinstance(packet, Packet) else None
        if out_of_order is not None:
            self._counts[out_of_order] += 1
            return Decoded(None, packet.stamp_ns, packet.frame_id, packet.width, packet.height)
        return self._read(packet)

    def _find_problem(self, packet: Packet | ArrayPacket) -> tuple[str, str] | None:
        """Return kind and text of what keeps a message from being read."""
        if not (0 < packet.width <= MAX_SIDE_PX and 0 < packet.height <= MAX_SIDE_PX):
            return 'bad_sizes', f'sensor of {packet.width} x {packet.height} px: sides must be 1 to {MAX_SIDE_PX}'
        if isinstance(packet, Packet):
            if packet.encoding not in ENCODINGS:
                return 'unknown_encodings', f'encoding {packet.encoding!r}: known are {", ".join(ENCODINGS)}'
            if packet.is_bigendian:
                return 'big_endian_payloads', f'payload of {packet.encoding} in big-endian words'
        if self._frame_id is not None and packet.frame_id != self._frame_id:
            return 'refused_frames', f'second camera {packet.frame_id!r} on the topic of {self._frame_id!r}'
        return None

    def _find_disorder(self, packet: Packet) -> str | None:
        """Return the kind of a packet that came twice or too late, None for one to be read."""
        last = self._last
        if last is None or last.seq is None or packet.seq is None or packet.encoding != last.encoding:
            return None
        if packet.seq == last.seq and packet.stamp_ns == last.stamp_ns and np.array_equal(packet.payload, last.payload):
            return 'repeated_packets'
        kind = None
        if last.seq - MOST_LATE <= packet.seq < last.seq and packet.stamp_ns <= last.stamp_ns:
            kind = 'overtaken_packets'
        if kind is not None and self._late_in_a_row == LATE_IN_A_ROW:
            kind = None
        self._late_in_a_row = 0 if kind is None else self._late_in_a_row + 1
        return kind

    def _problem(self, packet: Packet | ArrayPacket | None, kind: str, text: str) -> Decoded:
        self._counts[kind] += 1
        if kind != 'refused_frames':
            self.lost()
        if packet is None:
            return Decoded(None, 0, '', 0, 0, problem=text, problem_kind=kind)
        return Decoded(
            None, packet.stamp_ns, packet.frame_id, packet.width, packet.height, problem=text, problem_kind=kind
        )

    def _read(self, packet: Packet | ArrayPacket) -> Decoded:
        self._frame_id = packet.frame_id
        size = (packet.width, packet.height)
        resized = self._size is not None and size != self._size
        self._size = size
        lost = 0
        if isinstance(packet, Packet):
            lost, reading = self._read_packet(packet)
        else:
            reading = self._array_decoder.decode(packet, self._tally)
        batch = reading.batch
        if self._missing and batch is not None and not reading.restarted:
            batch = replace(batch, missing_until_ns=int(batch.t_ns[0]) if len(batch) else batch.t_end_ns)
        if reading.restarted or (batch is not None and len(batch)):
            self._missing = False
        events = 0 if batch is None else len(batch)
        counts = self._counts
        counts['events'] += events
        counts['empty_packets'] += len(packet.payload) == 0
        counts['lost_packets'] += lost
        counts['restarts'] += reading.restarted
        counts['resizes'] += resized
        counts['odd_bytes'] += reading.odd_bytes
        first_event_ns = int(batch.t_ns[0]) if batch is not None and events else None
        return Decoded(
            batch,
            packet.stamp_ns,
            packet.frame_id,
            *size,
            first_event_ns,
            reading.restarted,
            resized,
            lost,
        )

    def _read_packet(self, packet: Packet) -> tuple[int, Reading]:
        """Return the number of packets missing before this one, and its reading."""
        last, self._last = self._last, packet
        step = 0 if last is None or last.seq is None or packet.seq is None else packet.seq - last.seq
        elapsed_ns = 0 if last is None else packet.stamp_ns - last.stamp_ns
        lost = min(max(step - 1 - self._skipped, 0), MOST_LOST)  # more is a damaged seq
        gap = step > 1 or self._skipped > 0
        self._missing |= gap
        self._skipped = 0
        changed = self._decoder is not None and packet.encoding != self._encoding
        if self._decoder is None or changed:
            self._decoder = ENCODINGS[packet.encoding]()
            self._encoding = packet.encoding
        reading = self._decoder.decode(packet, Continuity(elapsed_ns, gap, step < 0), self._tally)
        if changed:
            # Another encoding counts time from elsewhere.
            reading = Reading(reading.batch, True, reading.odd_bytes)
        return lost, reading
