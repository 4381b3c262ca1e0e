"""Runs every compiled kernel once on made-up beacons, so that the first real packet does not wait for the compiler.

::

    . . . . . . . . . . . . . .      320 x 16 pixels; two 5 x 5 blocks fire +1 at every rise of their line and -1 at every fall;
    . . o o o o o . . o o o o o      the second one comes later, the first one runs past it in the end; packets are missing
             ───────────►            once, and both fall silent
"""

from __future__ import annotations

import numpy as np

from beacon_comm.compiling.cache import save_one_at_a_time
from beacon_comm.core import motion
from beacon_comm.core.events import NS_PER_S, EventBatch
from beacon_comm.core.framing import CharacterFrame, transitions
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.receiver import Receiver, SignalReceiver
from beacon_comm.wire.cdr import build_event_array, build_event_packet
from beacon_comm.wire.evt3_encoder import Evt3Encoder
from beacon_comm.wire.stream import PACKET_TYPES, EventStream

WIDTH, HEIGHT = 320, 16
LEFT = (30, 60)
SPEED_PX_PER_S = 1000
PACKETS, MISSING = 24, 16
SILENCE_NS = NS_PER_S // 2
ARRAY_TYPE = 'dvs_msgs/msg/EventArray'
ENCODINGS = ('libcaer_cmp', 'libcaer', 'mono')


def synthetic_beacons(parameters: Parameters, seconds: float = 0.6, beacons: int = len(LEFT)) -> EventBatch:
    """Return events of one or two beacons that send at the fastest listed rate, from 1 s on the sensor's clock."""
    bit_rate_bps = max(parameters.bit_rates)
    frame = CharacterFrame.from_parameters(parameters)
    count = max(3, round(seconds * bit_rate_bps / frame.length))
    bits = frame.encode_bits(('Warm up ' * (count // 8 + 1))[:count])
    edges_ns, levels = transitions(bits, bit_rate_bps, NS_PER_S)
    column, row = (grid.ravel() for grid in np.meshgrid(np.arange(5), np.arange(5, 10)))
    parts = []
    for k in range(beacons):
        late_ns = round(0.5 * k * frame.length * NS_PER_S / bit_rate_bps)  # by half a character
        kept = edges_ns >= edges_ns[len(edges_ns) * k // 3]
        t_ns = np.repeat(edges_ns[kept] + late_ns, len(row))
        moving_ns = np.maximum(t_ns - t_ns[2 * len(t_ns) // 3], 0) * (k == 0)
        left = np.minimum(LEFT[k] + SPEED_PX_PER_S * moving_ns // NS_PER_S, WIDTH - 5)
        edges = int(kept.sum())
        parts.append((np.tile(column, edges) + left, np.tile(row, edges), np.repeat(levels[kept] > 0, len(row)), t_ns))
    x, y, rises, t_ns = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    order = np.argsort(t_ns, kind='stable')
    return EventBatch(
        x[order].astype(np.uint16),
        y[order].astype(np.uint16),
        np.where(rises[order], 1, -1).astype(np.int8),
        t_ns[order].astype(np.int64),
        int(t_ns.max()) + NS_PER_S // 10,
    )


def warm_up(parameters: Parameters, pixels: bool = True) -> None:
    """Push synthetic beacons through the reader of every encoding and through a receiver of its own.

    What a receiver comes to depends on its parameters: at 20 bit/s nothing is read within a second.  So one with the default
    rates and windows follows, which comes to everything; its beacons are clutter already.

    Args:
        parameters: the receiver's.
        pixels: False: for signals without pixels only, which need neither readers nor detection.
    """
    save_one_at_a_time()
    some = Parameters(receiver=parameters.receiver, tracker=parameters.tracker, new_tracks_burst=0)
    rehearse = _rehearse if pixels else _rehearse_signal
    for rehearsed in dict.fromkeys((parameters, some)):
        rehearse(rehearsed)
    if not pixels:
        return
    motion.observe(np.ones(motion.WIDTH), 0.0, 0.0, 0.0, 1.0)  # else for a blob that mostly lies outside its track's circle
    events = synthetic_beacons(some)
    for encoding in ENCODINGS:
        EventStream(PACKET_TYPES[0]).push(_packet(encoding, bytes(64), 0))
    few = events.slice(0, 3, events.t_end_ns)
    EventStream(ARRAY_TYPE).push(
        build_event_array(NS_PER_S, 'warm_up', WIDTH, HEIGHT, few.x, few.y, few.polarity, few.t_ns)
    )


def _rehearse(parameters: Parameters) -> None:
    events = synthetic_beacons(parameters)
    receiver = Receiver(parameters, (WIDTH, HEIGHT))
    stream, encoder = EventStream(PACKET_TYPES[0]), Evt3Encoder(WIDTH, HEIGHT)
    cuts = np.linspace(0, len(events), PACKETS + 1).astype(int)
    for sequence, (start, stop) in enumerate(zip(cuts[:-1], cuts[1:], strict=True)):
        if sequence == MISSING:
            continue
        end_ns = events.t_end_ns if stop == len(events) else int(events.t_ns[stop])
        batch = stream.push(_packet('evt3', encoder.encode(events.slice(start, stop, end_ns)), sequence)).batch
        if batch is not None:
            receiver.push(batch)
        receiver.rest()
    receiver.push(EventBatch.empty(events.t_end_ns + SILENCE_NS))
    receiver.beacons()
    receiver.flush()


def _rehearse_signal(parameters: Parameters) -> None:
    receiver = SignalReceiver(parameters)
    receiver.push(synthetic_beacons(parameters, beacons=1))
    receiver.flush()


def _packet(encoding: str, payload: bytes, sequence: int) -> bytes:
    return build_event_packet(
        stamp_ns=NS_PER_S,
        frame_id='warm_up',
        width=WIDTH,
        height=HEIGHT,
        seq=sequence,
        time_base_ns=0,
        encoding=encoding,
        payload=payload,
    )
