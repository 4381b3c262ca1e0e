"""Prophesee EVT 3.0: a stream of 16-bit little-endian words that set a state, and pixels that are read against it.

    code  15…12   11…0
    ADDR_Y      0 | s y y y y y y y y y y y   row of what follows (s: which of two sensors, not used)
    ADDR_X      2 | p x x x x x x x x x x x   one event
    VECT_BASE_X 3 | p x x x x x x x x x x x   first column and polarity of the vectors that follow
    VECT_12     4 | v v v v v v v v v v v v   an event in column base + i for every bit i; base moves on by 12
    VECT_8      5 | . . . . v v v v v v v v   the same with 8
    TIME_LOW    6 | t t t t t t t t t t t t   time, lower 12 bits (µs)
    TIME_HIGH   8 | t t t t t t t t t t t t   time, upper 12 bits (4096 µs); repeated every 16 µs or so
    EXT_TRIGGER A | i i i i . . . . . . . e   an edge at a trigger input
    OTHERS      E, CONTINUED 7, F             reports of the sensor: passed over
    any other                                 skipped and counted; 9 is padding on GigE cameras

State lasts from packet to packet: real packets begin anywhere in the stream, many with a pixel.

*Start.*  Nothing is decoded before a TIME_HIGH and a TIME_LOW after it: with the upper bits alone an event could be
given out up to 4 ms too early.  A pixel needs its ADDR_Y, a vector its VECT_BASE_X, too.  After missing packets the
same holds again, only the upper time bits are remembered.

*Lower bits.*  A TIME_HIGH that differs sets the lower bits to 0 until TIME_LOW comes, so that the time in between is
a lower bound.  With the old lower bits a TIME_HIGH that came too early by one would push time ahead by 4 ms.

*Unwrapping.*  24 bits of µs wrap every 16.777 s.  The unwrapped time starts at the first TIME_HIGH seen: it is below
2²⁴ µs, whatever the sensor's age.  TIME_HIGH may step back a little; only a large fall is a wrap:

    inside a packet                  a fall by up to 1 s is a step back, any other a wrap (1 packet: 1 to 10 ms)
    first TIME_HIGH of a packet      host time tells how far the sensor should have moved on.  Of the two times that
                                     the bits allow, the one nearer to that is taken.  A fall that is taken as a
                                     wrap but is more than 1 s off the host time, is a restart, and so is a fall
                                     by more than 1 s that is not taken as a wrap

Without host time (equal stamps) a fall by more than half the range is a wrap.

*Order.*  Times are given out as the running maximum: events behind a step back are clamped and counted, and what the
time words have reached is a time that no later event undercuts.
"""

from __future__ import annotations

from numba import njit
import numpy as np

from beacon_comm.core.events import EventBatch
from beacon_comm.wire.cdr import Packet
from beacon_comm.wire.reading import (
    CLAMPED,
    FALLING,
    OUTSIDE,
    RISING,
    SKIPPED,
    UNDECODED,
    Continuity,
    EventColumns,
    Reading,
    Tally,
    words_of,
)

ADDR_Y, ADDR_X, VECT_BASE_X, VECT_12, VECT_8 = 0, 2, 3, 4, 5
TIME_LOW, CONTINUED_4, TIME_HIGH, EXT_TRIGGER, OTHERS, CONTINUED_12 = 6, 7, 8, 10, 14, 15
PERIOD_US = 1 << 24
STEP_BACK_US = 1_000_000
"""Up to here a fall of TIME_HIGH is a step back, and a wrap may differ from host time."""
_VECTOR_MARGIN = 12
"""A vector writes all its columns and then counts those that are events: room behind the last one."""

# State from packet to packet.
_HIGH_US, _LOW_US, _TIMED, _ROW, _BASE, _POLARITY, _LATEST_US = range(7)
_STATE_SIZE = 7
_UNKNOWN = -1
_NO_ROW = 1 << 16
_NO_BASE = 1 << 40
# How a packet follows the one before, and what became of it.
_ELAPSED_US, _SEQ_FELL, _RESTARTED = range(3)


class Evt3Decoder:
    """Decoder of evt3 payloads."""

    def __init__(self) -> None:
        self._state = np.zeros(_STATE_SIZE, np.int64)
        self._link = np.zeros(3, np.int64)
        self._state[_HIGH_US] = self._state[_LATEST_US] = _UNKNOWN
        self._forget()

    def decode(self, packet: Packet, continuity: Continuity, tally: Tally) -> Reading:
        """Decode a packet; see the module's head."""
        if continuity.packets_missing or continuity.seq_fell:
            self._forget()
        words = words_of(packet.payload, np.uint16, 2)
        columns = EventColumns(_capacity(words))
        link = self._link
        link[_ELAPSED_US], link[_SEQ_FELL], link[_RESTARTED] = continuity.elapsed_ns // 1000, continuity.seq_fell, 0
        n = _decode(
            words,
            packet.width,
            packet.height,
            self._state,
            link,
            columns.x,
            columns.y,
            columns.polarity,
            columns.t_ns,
            tally,
        )
        restarted = bool(link[_RESTARTED])
        latest_us = int(self._state[_LATEST_US])
        batch: EventBatch | None = None
        if latest_us != _UNKNOWN:
            batch = columns.batch(n, latest_us * 1000)
        return Reading(batch, restarted, len(packet.payload) % 2)

    def _forget(self) -> None:
        """Forget what words set up, but for the upper time bits."""
        self._state[_TIMED] = 0
        self._state[_ROW] = _NO_ROW
        self._state[_BASE] = _NO_BASE


@njit(cache=True, nogil=True)
def _capacity(words):  # type: ignore[no-untyped-def]
    """Return how many events the words can hold at most, and the margin behind them."""
    single = 0
    vectors = 0
    for i in range(len(words)):
        code = words[i] >> 12
        single += code == ADDR_X
        vectors += (code == VECT_12) | (code == VECT_8)
    return single + 12 * vectors + _VECTOR_MARGIN


@njit(cache=True, nogil=True)
def _follow_high(last_us, high_us, inside_packet, elapsed_us, seq_fell):  # type: ignore[no-untyped-def]
    """Return the unwrapped time of a TIME_HIGH and whether it tells of a restart; see the module's head.

    ``last_us`` is the unwrapped time of the TIME_HIGH before, ``high_us`` the new one's bits (< 2²⁴).
    """
    forward_us = (high_us - last_us) % PERIOD_US
    back_us = PERIOD_US - forward_us
    fell = high_us < last_us % PERIOD_US
    if inside_packet:
        if back_us <= STEP_BACK_US:
            return last_us - back_us, False
        return last_us + forward_us, False
    nearer_back = forward_us - elapsed_us > back_us + elapsed_us
    off_us = abs(forward_us - elapsed_us)
    if nearer_back and (fell or back_us <= STEP_BACK_US):
        if back_us > STEP_BACK_US or seq_fell:
            return high_us, True
        return last_us - back_us, False
    if off_us > STEP_BACK_US and ((fell and elapsed_us > 0) or seq_fell):
        return high_us, True
    return last_us + forward_us, False


@njit(cache=True, nogil=True)
def _await_time(words, state, link, tally):  # type: ignore[no-untyped-def]
    """Go through words until TIME_HIGH and then TIME_LOW were seen; return the place of the word after it."""
    seen_high = False
    for i in range(len(words)):
        word = np.int64(words[i])
        code = word >> 12
        value = word & 0xFFF
        if code == TIME_HIGH:
            high_us = value << 12
            if state[_HIGH_US] == _UNKNOWN:
                state[_HIGH_US] = high_us
            else:
                time_us, restarted = _follow_high(
                    state[_HIGH_US], high_us, seen_high, link[_ELAPSED_US], link[_SEQ_FELL] != 0
                )
                state[_HIGH_US] = time_us
                if restarted:
                    link[_RESTARTED] = 1
                    state[_LATEST_US] = _UNKNOWN
            seen_high = True
            state[_LATEST_US] = max(state[_LATEST_US], state[_HIGH_US])
        elif code == TIME_LOW:
            if seen_high:
                state[_LOW_US] = value
                state[_TIMED] = 1
                state[_LATEST_US] = max(state[_LATEST_US], state[_HIGH_US] + value)
                return i + 1
        elif code == ADDR_Y:
            state[_ROW] = word & 0x7FF
        elif code == VECT_BASE_X:
            state[_BASE] = word & 0x7FF
            state[_POLARITY] = ((word >> 10) & 2) - 1
        elif code == ADDR_X:
            tally[UNDECODED] += 1
        elif code == VECT_12 or code == VECT_8:
            columns = 12 if code == VECT_12 else 8
            for column in range(columns):
                tally[UNDECODED] += (word >> column) & 1
            state[_BASE] += columns
        else:
            _count_other(code, word, tally)
    return len(words)


@njit(cache=True, nogil=True)
def _count_other(code, word, tally):  # type: ignore[no-untyped-def]
    if code == EXT_TRIGGER:
        tally[RISING if word & 1 else FALLING] += 1
    elif code != OTHERS and code != CONTINUED_4 and code != CONTINUED_12:
        tally[SKIPPED] += 1


@njit(cache=True, nogil=True)
def _decode(words, width, height, state, link, x, y, polarity, t_ns, tally):  # type: ignore[no-untyped-def]
    """Decode a packet's words into the columns; return the number of events."""
    start = 0
    inside_packet = False
    if state[_TIMED] == 0:
        start = _await_time(words, state, link, tally)
        inside_packet = True
    high_us = state[_HIGH_US]
    low_us = state[_LOW_US]
    row = state[_ROW]
    base = state[_BASE]
    sign = state[_POLARITY]
    latest_us = state[_LATEST_US]
    # A repeated TIME_HIGH, three words of ten, is passed over like OTHERS.
    same_high = np.int64(TIME_HIGH << 12) | ((high_us >> 12) & 0xFFF)
    n = 0
    clamped = 0
    i = start
    while i < len(words):
        word = np.int64(words[i])
        i += 1
        code = word >> 12
        if code == ADDR_X or code == ADDR_Y or code == TIME_LOW or word == same_high:
            # The words of a stream without vectors, without branches: each is written as if it were an event, and
            # kept if it is one.  Branches on the code would be mispredicted at every third word.
            row = word & 0x7FF if code == ADDR_Y else row
            low_us = word & 0xFFF if code == TIME_LOW else low_us
            now_us = high_us + low_us
            latest_us = max(latest_us, now_us)
            column = word & 0x7FF
            is_event = code == ADDR_X
            inside = (column < width) & (row < height)
            x[n] = column
            y[n] = row
            polarity[n] = ((word >> 10) & 2) - 1
            t_ns[n] = latest_us * 1000
            kept = is_event & inside
            clamped += kept & (now_us < latest_us)
            n += kept
            if is_event and not inside:
                tally[UNDECODED if row == _NO_ROW else OUTSIDE] += 1
        elif code == TIME_HIGH:
            time_us, restarted = _follow_high(
                high_us, (word & 0xFFF) << 12, inside_packet, link[_ELAPSED_US], link[_SEQ_FELL] != 0
            )
            inside_packet = True
            high_us = time_us
            low_us = 0
            same_high = word
            if restarted:
                # What came before belongs to the sensor's life before; so does the state.
                tally[UNDECODED] += n
                n = 0
                clamped = 0
                link[_RESTARTED] = 1
                state[_HIGH_US], state[_LATEST_US] = high_us, high_us
                state[_ROW], state[_BASE] = _NO_ROW, _NO_BASE
                i += _await_time(words[i - 1 :], state, link, tally) - 1
                high_us, low_us, row = state[_HIGH_US], state[_LOW_US], state[_ROW]
                base, sign, latest_us = state[_BASE], state[_POLARITY], state[_LATEST_US]
                same_high = np.int64(TIME_HIGH << 12) | ((high_us >> 12) & 0xFFF)
            latest_us = max(latest_us, high_us)
        elif code == VECT_12 or code == VECT_8:
            columns = 12 if code == VECT_12 else 8
            now_us = high_us + low_us
            before = n
            bits = 0
            for k in range(columns):
                bit = (word >> k) & 1
                x[n] = base + k
                y[n] = row
                polarity[n] = sign
                t_ns[n] = latest_us * 1000
                bits += bit
                n += bit & (base + k < width) & (row < height)
            clamped += (n - before) * (now_us < latest_us)
            if n - before < bits:
                known = row != _NO_ROW and base < _NO_BASE
                tally[OUTSIDE if known else UNDECODED] += bits - (n - before)
            base += columns
        elif code == VECT_BASE_X:
            base = word & 0x7FF
            sign = ((word >> 10) & 2) - 1
        else:
            _count_other(code, word, tally)
    state[_HIGH_US], state[_LOW_US], state[_ROW] = high_us, low_us, row
    state[_BASE], state[_POLARITY], state[_LATEST_US] = base, sign, latest_us
    tally[CLAMPED] += clamped
    return n
