"""Events of an EventArray, read where they stand in the message.

CDR aligns every field to its size, so that an Event is 13 bytes and its successor begins at the 14th.  From the
array's first byte, which is aligned to 4, row k of 16 bytes holds

    byte   0      2          4            8             12         14
    k = 0  x₀     y₀         sec₀         nanosec₀      polarity₀  x₁
    k > 0  yₖ     (padding)  secₖ         nanosecₖ      polarityₖ  xₖ₊₁

and the array ends with the last event's polarity.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from beacon_comm.core.events import NS_PER_S
from beacon_comm.wire.cdr import ArrayPacket
from beacon_comm.wire.reading import CLAMPED, NO_TIME, OUTSIDE, EventColumns, OffsetClock, Reading, Tally, words_of


class EventArrayDecoder:
    """Decoder of EventArrays; sensor time is the events' own (``ts``)."""

    def __init__(self) -> None:
        self._clock = OffsetClock()

    def decode(self, packet: ArrayPacket, tally: Tally) -> Reading:
        """Decode an array.  An empty one moves nothing on: its stamp need not be of the events' clock."""
        restarted = False
        if packet.event_count:
            first_ns = _seconds(packet.payload, 4) * NS_PER_S + int.from_bytes(packet.payload[8:12], 'little')
            restarted = self._clock.follow(first_ns, False)
        columns = EventColumns(packet.event_count + 1)
        n = _decode(
            words_of(packet.payload, 'u1', 1),
            packet.event_count,
            packet.width,
            packet.height,
            self._clock.latest_ns,
            columns.x,
            columns.y,
            columns.polarity,
            columns.t_ns,
            tally,
        )
        return self._clock.read(columns, n, NO_TIME, restarted, 0)


def _seconds(payload: NDArray[np.uint8], at: int) -> int:
    return int.from_bytes(payload[at : at + 4], 'little', signed=True)


@njit(cache=True, nogil=True)
def _u16(b, at):  # type: ignore[no-untyped-def]
    return np.int64(b[at]) | np.int64(b[at + 1]) << 8


@njit(cache=True, nogil=True)
def _u32(b, at):  # type: ignore[no-untyped-def]
    return np.int64(b[at]) | np.int64(b[at + 1]) << 8 | np.int64(b[at + 2]) << 16 | np.int64(b[at + 3]) << 24


@njit(cache=True, nogil=True)
def _decode(b, count, width, height, latest_ns, x, y, polarity, t_ns, tally):  # type: ignore[no-untyped-def]
    """Decode ``count`` events from the bytes ``b``; return how many lie on the sensor."""
    n = 0
    for k in range(count):
        at = 16 * k
        column = _u16(b, at - 2 if k else 0)
        row = _u16(b, at if k else 2)
        sec = _u32(b, at + 4)
        sec -= (sec >> 31) << 32
        now_ns = sec * 1_000_000_000 + _u32(b, at + 8)
        kept = (column < width) & (row < height)
        latest_ns = max(latest_ns, now_ns) if kept else latest_ns
        x[n] = column
        y[n] = row
        polarity[n] = 1 if b[at + 12] else -1
        t_ns[n] = latest_ns
        tally[CLAMPED] += kept & (now_ns < latest_ns)
        n += kept
    tally[OUTSIDE] += count - n
    return n
