"""Encoding mono: one 64-bit little-endian word an event.

    63         62 … 48   47 … 32   31 … 0
    polarity   y         x         time after time_base (ns)
"""

from __future__ import annotations

import numpy as np
from numba import njit

from beacon_comm.wire.cdr import Packet
from beacon_comm.wire.reading import CLAMPED, OUTSIDE, Continuity, EventColumns, OffsetClock, Reading, Tally, words_of


class MonoDecoder:
    """Decoder of mono payloads; sensor time is time_base + offset."""

    def __init__(self) -> None:
        self._clock = OffsetClock()

    def decode(self, packet: Packet, continuity: Continuity, tally: Tally) -> Reading:
        """Decode a packet; an empty one moves time on to its time base."""
        # A payload is aligned to 4 bytes in its message, not to 8: the words are read as halves.
        halves = words_of(packet.payload, '<u4', 8)
        base_ns = packet.time_base_ns
        restarted = len(halves) > 0 and self._clock.follow(base_ns + int(halves[0]), continuity.seq_fell)
        columns = EventColumns(len(halves) // 2 + 1)
        n = _decode(
            halves,
            packet.width,
            packet.height,
            base_ns,
            self._clock.latest_ns,
            columns.x,
            columns.y,
            columns.polarity,
            columns.t_ns,
            tally,
        )
        return self._clock.read(columns, n, base_ns, restarted, len(packet.payload) % 8)


@njit(cache=True, nogil=True)
def _decode(halves, width, height, base_ns, latest_ns, x, y, polarity, t_ns, tally):  # type: ignore[no-untyped-def]
    """Decode the words, given as low and high halves; return the number of events."""
    n = 0
    for i in range(len(halves) // 2):
        low = np.int64(halves[2 * i])
        high = np.int64(halves[2 * i + 1])
        column = high & 0xFFFF
        row = (high >> 16) & 0x7FFF
        now_ns = base_ns + low
        kept = (column < width) & (row < height)
        latest_ns = max(latest_ns, now_ns) if kept else latest_ns
        x[n] = column
        y[n] = row
        polarity[n] = ((high >> 30) & 2) - 1
        t_ns[n] = latest_ns
        tally[CLAMPED] += kept & (now_ns < latest_ns)
        n += kept
    tally[OUTSIDE] += len(halves) // 2 - n
    return n
