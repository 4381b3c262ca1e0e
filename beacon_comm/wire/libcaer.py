"""The two encodings of the libcaer driver (iniVation DVXplorer, DAVIS).

*libcaer*: 64 bits an event, two little-endian 32-bit numbers:

    31 … 17   16 … 2   1          0        | 31 … 0
    x         y        polarity   valid    | time after time_base (µs), 31 bits; rolls over at most once a packet

The driver does not set the valid bit reliably, so it is not looked at.

*libcaer_cmp*: 16-bit little-endian words as in EVT3, but column by column:

    TIME_HIGH   0 | t t t t t t t t t t t t   time after time_base, upper 12 bits (4096 µs)
    TIME_LOW    1 | t t t t t t t t t t t t   lower 12 bits (µs)
    ADDR_X      2 | . x x x x x x x x x x x   column of what follows
    ADDR_Y      3 | p y y y y y y y y y y y   one event
    VECT_BASE_Y 4 | p y y y y y y y y y y y   first row and polarity of the vectors that follow
    VECT_8      5 | . . . . v v v v v v v v   an event in row base + i for every bit i; base moves on by 8
    any other                                 skipped and counted

Time starts anew at time_base in every packet; the column and the vector's base last until packets are missing.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from beacon_comm.wire.cdr import Packet
from beacon_comm.wire.reading import (
    CLAMPED,
    NO_TIME,
    OUTSIDE,
    SKIPPED,
    UNDECODED,
    Continuity,
    EventColumns,
    OffsetClock,
    Reading,
    Tally,
    words_of,
)

TIME_HIGH, TIME_LOW, ADDR_X, ADDR_Y, VECT_BASE_Y, VECT_8 = range(6)
ROLLOVER_NS = (1 << 31) * 1000
_VECTOR_MARGIN = 8
_COLUMN, _BASE, _POLARITY = range(3)
_NO_COLUMN = 1 << 16
_NO_BASE = 1 << 40


class LibcaerDecoder:
    """Decoder of libcaer payloads; sensor time is time_base + offset."""

    def __init__(self) -> None:
        self._clock = OffsetClock()

    def decode(self, packet: Packet, continuity: Continuity, tally: Tally) -> Reading:
        """Decode a packet.  The time base is far behind the events, so that an empty packet moves nothing on."""
        halves = words_of(packet.payload, '<u4', 8)
        base_ns = packet.time_base_ns
        first_us = int(halves[1]) & 0x7FFF_FFFF if len(halves) else 0
        restarted = len(halves) > 0 and self._clock.follow(base_ns + first_us * 1000, continuity.seq_fell)
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
        return self._clock.read(columns, n, NO_TIME, restarted, len(packet.payload) % 8)


class LibcaerCmpDecoder:
    """Decoder of libcaer_cmp payloads; sensor time is time_base + offset."""

    def __init__(self) -> None:
        self._clock = OffsetClock()
        self._state = np.zeros(3, np.int64)
        self._forget()

    def decode(self, packet: Packet, continuity: Continuity, tally: Tally) -> Reading:
        """Decode a packet; its time base, then its time words, move time on."""
        restarted = self._clock.follow(packet.time_base_ns, continuity.seq_fell)
        if continuity.packets_missing or continuity.seq_fell or restarted:
            self._forget()
        words = words_of(packet.payload, '<u2', 2)
        columns = EventColumns(_capacity(words))
        n, latest_ns = _decode_cmp(
            words,
            packet.width,
            packet.height,
            packet.time_base_ns,
            self._clock.latest_ns,
            self._state,
            columns.x,
            columns.y,
            columns.polarity,
            columns.t_ns,
            tally,
        )
        return self._clock.read(columns, n, latest_ns, restarted, len(packet.payload) % 2)

    def _forget(self) -> None:
        self._state[_COLUMN] = _NO_COLUMN
        self._state[_BASE] = _NO_BASE


@njit(cache=True, nogil=True)
def _decode(halves, width, height, base_ns, latest_ns, x, y, polarity, t_ns, tally):  # type: ignore[no-untyped-def]
    """Decode libcaer events, given as halves; return the number of events."""
    n = 0
    before_us = np.int64(0)
    for i in range(len(halves) // 2):
        pixel = np.int64(halves[2 * i])
        now_us = np.int64(halves[2 * i + 1]) & 0x7FFF_FFFF
        # A fall by most of the 31 bits is the roll-over; a small one is disorder.
        if before_us - now_us > 1 << 30:
            base_ns += ROLLOVER_NS
        before_us = now_us
        now_ns = base_ns + now_us * 1000
        column = pixel >> 17
        row = (pixel >> 2) & 0x7FFF
        kept = (column < width) & (row < height)
        latest_ns = max(latest_ns, now_ns) if kept else latest_ns
        x[n] = column
        y[n] = row
        polarity[n] = (pixel & 2) - 1
        t_ns[n] = latest_ns
        tally[CLAMPED] += kept & (now_ns < latest_ns)
        n += kept
    tally[OUTSIDE] += len(halves) // 2 - n
    return n


@njit(cache=True, nogil=True)
def _capacity(words):  # type: ignore[no-untyped-def]
    """Return how many events the words can hold at most, and the margin behind them."""
    single = 0
    vectors = 0
    for i in range(len(words)):
        code = words[i] >> 12
        single += code == ADDR_Y
        vectors += code == VECT_8
    return single + 8 * vectors + _VECTOR_MARGIN


@njit(cache=True, nogil=True)
def _decode_cmp(  # type: ignore[no-untyped-def]
    words, width, height, base_ns, latest_ns, state, x, y, polarity, t_ns, tally
):
    """Decode libcaer_cmp words; return the number of events and the latest time (ns)."""
    high_us = np.int64(0)
    low_us = np.int64(0)
    column, base, sign = state[_COLUMN], state[_BASE], state[_POLARITY]
    latest_ns = max(latest_ns, base_ns)
    now_ns = base_ns
    n = np.int64(0)
    for i in range(len(words)):
        word = np.int64(words[i])
        code = word >> 12
        if code == ADDR_Y:
            row = word & 0x7FF
            x[n] = column
            y[n] = row
            polarity[n] = ((word >> 10) & 2) - 1
            t_ns[n] = latest_ns
            if (column < width) & (row < height):
                n += 1
                tally[CLAMPED] += now_ns < latest_ns
            else:
                tally[UNDECODED if column == _NO_COLUMN else OUTSIDE] += 1
        elif code == ADDR_X:
            column = word & 0x7FF
        elif code in (TIME_LOW, TIME_HIGH):
            if code == TIME_LOW:
                low_us = word & 0xFFF
            else:
                # As in EVT3: until TIME_LOW comes, the time is a lower bound.
                low_us = low_us if (word & 0xFFF) << 12 == high_us else np.int64(0)
                high_us = (word & 0xFFF) << 12
            now_ns = base_ns + (high_us + low_us) * 1000
            latest_ns = max(latest_ns, now_ns)
        elif code == VECT_BASE_Y:
            base = word & 0x7FF
            sign = ((word >> 10) & 2) - 1
        elif code == VECT_8:
            before = n
            bits = np.int64(0)
            for k in range(8):
                bit = (word >> k) & 1
                x[n] = column
                y[n] = base + k
                polarity[n] = sign
                t_ns[n] = latest_ns
                bits += bit
                n += bit & (column < width) & (base + k < height)
            tally[CLAMPED] += (n - before) * (now_ns < latest_ns)
            if n - before < bits:
                known = column != _NO_COLUMN and base < _NO_BASE
                tally[OUTSIDE if known else UNDECODED] += bits - (n - before)
            base += 8
        else:
            tally[SKIPPED] += 1
    state[_COLUMN], state[_BASE], state[_POLARITY] = column, base, sign
    return n, latest_ns
