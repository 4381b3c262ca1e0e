"""Events as messages: what a scene, merged or simulated, is published and written as.

A packet is stamped with the time of its first event (its own begin, if it has none): stamp = ``stamp_start_ns`` +
scene time.  It counts as recorded when its last event can have been: at its end.
"""

from __future__ import annotations

from beacon_comm.core.events import EventBatch
from beacon_comm.recordings.interfaces import PACKET_TYPE
from beacon_comm.recordings.storage import Message
from beacon_comm.wire.cdr import build_event_array, build_event_packet
from beacon_comm.wire.evt3_encoder import Evt3Encoder


class PacketMaker:
    """Makes the messages of one sensor's stream, in order.

    Args:
        width, height: the sensor's size (px).
        stamp_start_ns: ROS time at event time 0 (ns).
        frame_id: of the camera.
        message_type: ``EventPacket`` (evt3), or an ``EventArray``.
    """

    def __init__(
        self, width: int, height: int, stamp_start_ns: int, frame_id: str, message_type: str = PACKET_TYPE
    ) -> None:
        self._size = width, height
        self._stamp_start_ns = stamp_start_ns
        self._frame_id = frame_id
        self._encoder = Evt3Encoder(width, height) if message_type == PACKET_TYPE else None
        self._seq = 0

    def message(self, batch: EventBatch, begin_ns: int) -> Message:
        """Return ``(recorded_ns, cdr)`` of a batch that begins at ``begin_ns`` (event time)."""
        stamp_ns = self._stamp_start_ns + (int(batch.t_ns[0]) if len(batch) else begin_ns)
        if self._encoder is None:
            cdr = build_event_array(
                stamp_ns, self._frame_id, *self._size, batch.x, batch.y, batch.polarity, batch.t_ns
            )
        else:
            cdr = build_event_packet(
                stamp_ns=stamp_ns,
                frame_id=self._frame_id,
                width=self._size[0],
                height=self._size[1],
                seq=self._seq,
                time_base_ns=0,
                encoding='evt3',
                payload=self._encoder.encode(batch),
            )
        self._seq += 1
        return self._stamp_start_ns + batch.t_end_ns, cdr
