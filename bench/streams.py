"""Streams to measure with: a real background as dense as wanted, with the real beacons in it.

    bag              |grid moving over 346 x 260 px|            571,000 events a second
    side by side     |bag|bag|bag|bag|                          until the sensor is full, each begun elsewhere in the bag
                     |bag|bag|bag|bag|
    faster           the bag's clock runs as fast as the wanted rate needs: a grid that moves faster
    over and over    |bag, bag, …|bag, bag, …|                  for as long as wanted
    beacons          · ·· ··· · ·· ·· · ··· ·                   the recordings at 30 m, in their own time
    packets          |  1 ms |  1 ms |  1 ms |…                 in any of the encodings
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.events import NS_PER_S, EventBatch
from beacon_comm.recordings.bags import open_recording
from beacon_comm.recordings.disc import Disc
from beacon_comm.recordings.mat import read_mat
from beacon_comm.wire.cdr import (
    EVENT_STRIDE_BYTES,
    build_event_array,
    build_event_packet,
    parse_event_array,
    parse_event_packet,
)
from beacon_comm.wire.evt3 import TIME_HIGH
from beacon_comm.wire.evt3_encoder import Evt3Encoder
from beacon_comm.wire.stream import EventStream

BAG, WORDS_BAG = 'libcaer_grid', 'evt3_static'
BAG_SIZE = {BAG: (346, 260), WORDS_BAG: (640, 480)}
RECORDINGS = (('3125hz_30m.mat', 1.0), ('504hz_30m.mat', 12.2))  # and where their text is under way (s)
LOOP_NS = 1_024_000_000
"""Length of a stream that can be repeated: whole packets, and whole steps of evt3's upper time bits (4096 µs)."""
LOOP_CHARACTERS = ((291, 3123.8), (47, 503.9))
"""Of each recording so many characters, at its bit rate (bit/s), fill a loop, stretched by less than 0.3 %."""
BITS = 11
START_NS = NS_PER_S
RADIUS_PX = 4.0
PACKET_NS = 1_000_000


@dataclass(frozen=True, slots=True)
class Stream:
    """What a camera sent.

    Attributes:
        width, height: the sensor's size (px).
        batches: its events, one batch a packet.
    """

    width: int
    height: int
    batches: list[EventBatch]

    @property
    def events(self) -> int:
        """Return how many events it has."""
        return sum(map(len, self.batches))

    @property
    def seconds(self) -> float:
        """Return its length (s)."""
        return (self.batches[-1].t_end_ns - START_NS) / NS_PER_S


def bag_events(path: Path) -> EventBatch:
    """Return all events of a bag in one batch."""
    with open_recording(path) as bag:
        topic = bag.event_topic()
        stream = EventStream(topic.type)
        decoded = [stream.push(cdr).batch for _, cdr in bag.messages(topic)]
    batches = [batch for batch in decoded if batch is not None]
    x, y, polarity, t_ns = (
        np.concatenate([getattr(batch, name) for batch in batches]) for name in ('x', 'y', 'polarity', 't_ns')
    )
    return EventBatch(x, y, polarity, t_ns, batches[-1].t_end_ns)


def tiled(
    once: EventBatch, bag_size: tuple[int, int], size: tuple[int, int], events_per_s: float | None, duration_ns: int
) -> EventBatch:
    """Return the bag's events side by side all over the sensor and over and over, from time 0 on.

    Args:
        once: the bag's events.
        bag_size: width and height of its sensor (px).
        size: width and height of the sensor to fill (px).
        events_per_s: how many there are to be; None: at the bag's own pace.
        duration_ns: until when (ns).
    """
    width, height = size
    corners = [(left, top) for left in range(0, width, bag_size[0]) for top in range(0, height, bag_size[1])]
    inside = [(once.x + left < width) & (once.y + top < height) for left, top in corners]
    period_ns = length_ns = int(once.t_ns[-1] - once.t_ns[0]) + 1000
    if events_per_s is not None:
        period_ns = round(sum(int(which.sum()) for which in inside) / events_per_s * NS_PER_S)
    faster = period_ns / length_ns
    parts = []
    for k, ((left, top), which) in enumerate(zip(corners, inside, strict=True)):
        t_ns = ((once.t_ns - once.t_ns[0])[which] * faster).astype(np.int64) + k * period_ns // len(corners)
        parts.append((once.x[which] + left, once.y[which] + top, once.polarity[which], t_ns % period_ns))
    x, y, polarity, t_ns = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(t_ns, kind='stable')
    count = -(-duration_ns // period_ns)
    t_all = (t_ns[order] + period_ns * np.arange(count)[:, None]).ravel()
    n = int(np.searchsorted(t_all, duration_ns))
    x, y, polarity = (np.tile(column[order], count)[:n] for column in (x, y, polarity))
    return EventBatch(x.astype(np.uint16), y.astype(np.uint16), polarity, t_all[:n], duration_ns)


def looped(t_ns: NDArray[np.int64], polarity: NDArray[np.int8], start_s: float, duration_ns: int) -> EventBatch:
    """Return a recording's beacon from ``start_s`` on, over and over if it is too short; pixels are all 0."""
    t_ns = t_ns - t_ns[0] - round(start_s * NS_PER_S)
    first = int(np.searchsorted(t_ns, 0))
    t_ns, polarity = t_ns[first:], polarity[first:]
    period_ns = int(t_ns[-1]) + 1000
    count = -(-duration_ns // period_ns)
    t_all = (t_ns + period_ns * np.arange(count)[:, None]).ravel()
    n = int(np.searchsorted(t_all, duration_ns))
    pixel = np.zeros(n, np.uint16)
    return EventBatch(pixel, pixel, np.tile(polarity, count)[:n], t_all[:n], duration_ns)


def seamless(t_ns: NDArray[np.int64], polarity: NDArray[np.int8], start_s: float, characters: int, rate: float) -> EventBatch:
    """Return whole characters of a recording from ``start_s`` on, which can be sent round and round; pixels are all 0.

    Args:
        t_ns, polarity: the recording (ns, ±1).
        start_s: where to begin (s).
        characters: how many.
        rate: their bit rate (bit/s).
    """
    begin_ns = t_ns[0] + round(start_s * NS_PER_S)
    length_ns = characters * BITS / rate * NS_PER_S
    first, stop = np.searchsorted(t_ns, [begin_ns, begin_ns + length_ns])
    looped_ns = ((t_ns[first:stop] - begin_ns) * (LOOP_NS / length_ns)).astype(np.int64)
    pixel = np.zeros(stop - first, np.uint16)
    return EventBatch(pixel, pixel, polarity[first:stop], np.minimum(looped_ns, LOOP_NS - 1), LOOP_NS)


def beacons(
    folder: Path, size: tuple[int, int], count: int, duration_ns: int, repeatable: bool = False
) -> list[EventBatch]:
    """Return ``count`` beacons on a grid, the two recordings by turns, each begun elsewhere in its text."""
    across = int(np.ceil(np.sqrt(count * size[0] / size[1])))
    down = -(-count // across)
    recordings = [(*read_mat(folder / name), start_s) for name, start_s in RECORDINGS]
    placed = []
    for k in range(count):
        t_ns, polarity, start_s = recordings[k % len(recordings)]
        start_s += 0.02 * (k // len(recordings))
        if repeatable:
            events = seamless(t_ns, polarity, start_s, *LOOP_CHARACTERS[k % len(recordings)])
        else:
            events = looped(t_ns, polarity, start_s, duration_ns)
        x = size[0] * (k % across + 0.5) / across
        y = size[1] * (k // across + 0.5) / down
        xs, ys = Disc(x, y, RADIUS_PX, 0.0, 0.0, *size).pixels(events.t_ns, [1, k])
        placed.append(EventBatch(xs, ys, events.polarity, events.t_ns, duration_ns))
    return placed


def make_stream(
    folder: Path,
    size: tuple[int, int],
    events_per_s: float | None,
    duration_s: float,
    beacon_count: int = 2,
    packet_ns: int = PACKET_NS,
    repeatable: bool = False,
    bag: str = BAG,
) -> Stream:
    """Return a background with beacons in it, cut into packets.

    Args:
        folder: of the recordings.
        size: width and height (px).
        events_per_s: of the background; None: at its bag's own pace.
        duration_s: length of the stream (s).
        beacon_count: how many.
        packet_ns: length of a packet (ns).
        repeatable: it can be sent round and round without a break in what the beacons say; only of :data:`LOOP_NS`.
        bag: of the background.
    """
    duration_ns = round(duration_s * NS_PER_S)
    parts = beacons(folder, size, beacon_count, duration_ns, repeatable)
    if events_per_s != 0.0:
        parts.insert(0, tiled(bag_events(folder / bag), BAG_SIZE[bag], size, events_per_s, duration_ns))
    t_ns = np.concatenate([part.t_ns for part in parts]) // 1000 * 1000 + START_NS
    order = np.argsort(t_ns, kind='stable')
    t_ns = t_ns[order]
    x, y, polarity = (np.concatenate([getattr(part, name) for part in parts])[order] for name in ('x', 'y', 'polarity'))
    ends_ns = np.arange(START_NS + packet_ns, START_NS + duration_ns + 1, packet_ns)
    stops = np.searchsorted(t_ns, ends_ns)
    starts = [0, *stops[:-1]]
    batches = [
        EventBatch(x[a:b], y[a:b], polarity[a:b], t_ns[a:b], int(end_ns))
        for a, b, end_ns in zip(starts, stops, ends_ns, strict=True)
    ]
    return Stream(*size, batches)


def messages(stream: Stream, encoding: str) -> Iterator[bytes]:
    """Yield the stream's messages (CDR bytes): EventPackets of an encoding, or EventArrays for ``event_array``."""
    encoder = Evt3Encoder(stream.width, stream.height)
    for seq, batch in enumerate(stream.batches):
        begin_ns = int(batch.t_ns[0]) if len(batch) else batch.t_end_ns
        head = (begin_ns, 'camera', stream.width, stream.height)
        if encoding == 'event_array':
            yield build_event_array(*head, batch.x, batch.y, batch.polarity, batch.t_ns)
        elif encoding == 'evt3':
            yield build_event_packet(*head, seq, 0, encoding, encoder.encode(batch))
        else:
            base_ns = begin_ns // 1000 * 1000
            yield build_event_packet(*head, seq, base_ns, encoding, _PAYLOADS[encoding](batch, batch.t_ns - base_ns))


def _mono(batch: EventBatch, dt_ns: NDArray[np.int64]) -> bytes:
    on = (batch.polarity > 0).astype('<u8') << np.uint64(63)
    words = on | batch.y.astype('<u8') << np.uint64(48) | batch.x.astype('<u8') << np.uint64(32) | dt_ns.astype('<u8')
    return words.tobytes()


def _libcaer(batch: EventBatch, dt_ns: NDArray[np.int64]) -> bytes:
    pixel = batch.x.astype('<u4') << 17 | batch.y.astype('<u4') << 2 | (batch.polarity > 0).astype('<u4') << 1 | 1
    return np.column_stack((pixel, (dt_ns // 1000).astype('<u4'))).tobytes()


def _libcaer_cmp(batch: EventBatch, dt_ns: NDArray[np.int64]) -> bytes:
    """Return ADDR_X, ADDR_Y for each event, behind its time words where the time is a new one."""
    t_us = dt_ns // 1000
    new = np.diff(t_us, prepend=-1) > 0
    high = np.diff(t_us >> 12, prepend=-1) > 0
    words = np.empty((len(t_us), 4), '<u2')
    words[:, 0], words[:, 1] = (t_us >> 12) & 0xFFF, 1 << 12 | (t_us & 0xFFF)
    words[:, 2], words[:, 3] = 2 << 12 | batch.x, 3 << 12 | (batch.polarity > 0).astype(np.uint16) << 11 | batch.y
    return words[np.column_stack((high, new, new | True, new | True))].tobytes()


_PAYLOADS = {'mono': _mono, 'libcaer': _libcaer, 'libcaer_cmp': _libcaer_cmp}


class Repeated:
    """A stream's messages round and round: their times go on, and so do the numbers of the packets."""

    def __init__(self, stream: Stream, encoding: str) -> None:
        self.events = np.array([len(batch) for batch in stream.batches])
        self._size = (stream.width, stream.height)
        self._encoding = encoding
        self._packet_ns = LOOP_NS // len(stream.batches)
        self._cdrs = [bytearray(cdr) for cdr in messages(stream, encoding)]
        self._rounds = 0
        if encoding == 'evt3':
            self._payloads = [parse_event_packet(cdr).payload.view('<u2') for cdr in self._cdrs]
            self._highs = [np.flatnonzero(words >> 12 == TIME_HIGH) for words in self._payloads]

    def __iter__(self) -> Iterator[bytes]:
        while True:
            for k in range(len(self._cdrs)):
                yield self._packet(k) if self._encoding == 'evt3' else bytes(self._cdrs[k])
                self._go_on(k)
            self._rounds += 1

    def _packet(self, k: int) -> bytes:
        seq = self._rounds * len(self._cdrs) + k
        stamp_ns = START_NS + seq * self._packet_ns
        return build_event_packet(stamp_ns, 'camera', *self._size, seq, 0, 'evt3', self._payloads[k])

    def _go_on(self, k: int) -> None:
        """Move a message's times on by a round."""
        if self._encoding == 'evt3':
            words, at = self._payloads[k], self._highs[k]
            words[at] = TIME_HIGH << 12 | (words[at] + LOOP_NS // 4_096_000) & 0xFFF
            return
        cdr = self._cdrs[k]
        _go_on(np.frombuffer(cdr, '<u4', 2, 4))
        events = parse_event_array(cdr)
        if events.event_count:
            body = len(cdr) - len(events.payload)
            _go_on(np.frombuffer(cdr, '<u4', (len(cdr) - body) // 4, body)[1:])


def _go_on(words: np.ndarray) -> None:
    """Move seconds and nanoseconds, which stand in the first two of every four words, on by a round."""
    every = EVENT_STRIDE_BYTES // 4
    seconds, nanoseconds = words[0::every], words[1::every]
    nanoseconds += LOOP_NS % NS_PER_S
    carry = nanoseconds >= NS_PER_S
    nanoseconds -= carry * np.uint32(NS_PER_S)
    seconds += carry + np.uint32(LOOP_NS // NS_PER_S)


def real_words(folder: Path, total_bytes: int, packet_bytes: int | None = None) -> tuple[list[bytes], tuple[int, int]]:
    """Return the payloads of the real evt3 bag over and over, and its sensor's size (px).

    Nothing but the upper time bits is changed, so that time goes on from one round to the next.

    Args:
        folder: of the recordings.
        total_bytes: how much to return (byte).
        packet_bytes: length of a payload (byte); None: as the driver cut them.
    """
    with open_recording(folder / WORDS_BAG) as bag:
        packets = [parse_event_packet(cdr) for _, cdr in bag.messages(bag.event_topic())]
    words = np.concatenate([packet.payload.view('<u2') for packet in packets])
    lengths = [len(packet.payload) // 2 for packet in packets]
    is_high = words >> 12 == TIME_HIGH
    highs = words[is_high].astype(np.int64) & 0xFFF
    unwrapped = highs + 4096 * np.cumsum(np.diff(highs, prepend=highs[0]) < -2048)
    round_highs = int(unwrapped[-1] - unwrapped[0]) + 1
    rounds = []
    for k in range(-(-total_bytes // (2 * len(words)))):
        shifted = words.copy()
        shifted[is_high] = TIME_HIGH << 12 | (highs + k * round_highs) & 0xFFF
        rounds.append(shifted)
    if packet_bytes is None:
        cuts = np.cumsum(lengths)[:-1]
        payloads = [part.tobytes() for one in rounds for part in np.split(one, cuts)]
    else:
        every = np.concatenate(rounds).tobytes()
        payloads = [every[start : start + packet_bytes] for start in range(0, len(every), packet_bytes)]
    return payloads, (packets[0].width, packets[0].height)
