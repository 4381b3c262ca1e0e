"""Runs every compiled kernel once on a made-up beacon, so that the first real packet does not wait for the compiler.

::

    . . . . . . . . .      16 x 16 pixels; a 5 x 5 block fires +1 at every rise of the line and -1 at every fall
    . . o o o o o . .
"""

from __future__ import annotations

import numpy as np

from beacon_comm.compiling.cache import save_one_at_a_time
from beacon_comm.core.events import NS_PER_S, EventBatch
from beacon_comm.core.framing import CharacterFrame, transitions
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.receiver import Receiver, SignalReceiver
from beacon_comm.wire.cdr import build_event_array, build_event_packet
from beacon_comm.wire.evt3_encoder import Evt3Encoder
from beacon_comm.wire.stream import PACKET_TYPES, EventStream

SIZE = 16
PACKETS = 8
ARRAY_TYPE = 'dvs_msgs/msg/EventArray'
ENCODINGS = ('libcaer_cmp', 'libcaer', 'mono')


def synthetic_beacon(parameters: Parameters, seconds: float = 0.6) -> EventBatch:
    """Return events of a beacon that sends at the fastest listed rate, from 1 s on the sensor's clock."""
    bit_rate_bps = max(parameters.bit_rates)
    frame = CharacterFrame.from_parameters(parameters)
    count = max(3, round(seconds * bit_rate_bps / frame.length))
    bits = frame.encode_bits(('Warm up ' * (count // 8 + 1))[:count])
    edges_ns, levels = transitions(bits, bit_rate_bps, NS_PER_S)
    x, y = (grid.ravel() for grid in np.meshgrid(np.arange(5, 10), np.arange(5, 10)))
    pixels = len(x)
    return EventBatch(
        np.tile(x, len(edges_ns)).astype(np.uint16),
        np.tile(y, len(edges_ns)).astype(np.uint16),
        np.repeat(np.where(levels > 0, 1, -1), pixels).astype(np.int8),
        np.repeat(edges_ns, pixels).astype(np.int64),
        int(edges_ns[-1]) + NS_PER_S // 10,
    )


def warm_up(parameters: Parameters, pixels: bool = True) -> None:
    """Push a synthetic beacon through the reader of every encoding and through a receiver of its own.

    Args:
        parameters: the receiver's.
        pixels: False: for signals without pixels only, which need neither readers nor detection.
    """
    save_one_at_a_time()
    events = synthetic_beacon(parameters)
    if not pixels:
        signal_receiver = SignalReceiver(parameters)
        signal_receiver.push(events)
        signal_receiver.flush()
        return
    receiver = Receiver(parameters, (SIZE, SIZE))
    stream, encoder = EventStream(PACKET_TYPES[0]), Evt3Encoder(SIZE, SIZE)
    cuts = np.linspace(0, len(events), PACKETS + 1).astype(int)
    for sequence, (start, stop) in enumerate(zip(cuts[:-1], cuts[1:], strict=True)):
        end_ns = events.t_end_ns if stop == len(events) else int(events.t_ns[stop])
        part = events.slice(start, stop, end_ns)
        stream.push(_packet('evt3', encoder.encode(part), sequence))
        receiver.push(part)
    receiver.flush()
    receiver.beacons()
    for encoding in ENCODINGS:
        EventStream(PACKET_TYPES[0]).push(_packet(encoding, bytes(64), 0))
    few = events.slice(0, 3, events.t_end_ns)
    EventStream(ARRAY_TYPE).push(
        build_event_array(NS_PER_S, 'warm_up', SIZE, SIZE, few.x, few.y, few.polarity, few.t_ns)
    )


def _packet(encoding: str, payload: bytes, sequence: int) -> bytes:
    return build_event_packet(
        stamp_ns=NS_PER_S,
        frame_id='warm_up',
        width=SIZE,
        height=SIZE,
        seq=sequence,
        time_base_ns=0,
        encoding=encoding,
        payload=payload,
    )
