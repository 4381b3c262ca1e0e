"""Prophesee EVT 3.0: a stream of 16-bit little-endian words that set a state, and pixels that are read against it.

    code  15…12   11…0
    ADDR_Y      0 | s y y y y y y y y y y y   row of what follows (s: which of two sensors, not used)
    ADDR_X      2 | p x x x x x x x x x x x   one event
    VECT_BASE_X 3 | p x x x x x x x x x x x   first column and polarity of the vectors that follow
    VECT_12     4 | v v v v v v v v v v v v   an event in column base + i for every bit i; base moves on by 12
    VECT_8      5 | . . . . v v v v v v v v   the same with 8
    TIME_LOW    6 | t t t t t t t t t t t t   time, lower 12 bits (µs)
    TIME_HIGH   8 | t t t t t t t t t t t t   time, upper 12 bits (4096 µs); repeated every 16 µs or so
    EXT_TRIGGER A | i i i i . . . . . . . e   an edge at a trigger input; counted by the bit e
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

    inside a packet                  a fall by up to 1 s is a step back, any other a wrap (1 packet: 1 to 10 ms).  A sensor
                                     steps on by one; a word that leaps is believed until it is 16.777 s in all, then
                                     skipped: a few damaged words would make hours of the stream
    first TIME_HIGH of a packet      host time tells how far the sensor should have moved on.  Of the two times that
                                     the bits allow, the one nearer to that is taken.  It is a restart if that is a
                                     step back by more than 1 s, or a wrap that runs ahead of host time by more

Without host time (equal stamps) a fall by more than half the range is a wrap.  Where seq fell, too, any step back
and any difference from host time above 1 s is a restart.  After a restart all is as at the start.

*Order.*  Times are given out as the running maximum: events behind a step back are clamped and counted, and what the
time words have reached is a time that no later event undercuts.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from beacon_comm.core.events import EventBatch
from beacon_comm.wire.cdr import Packet
from beacon_comm.wire.reading import (
    CLAMPED,
    OUTSIDE,
    SKIPPED,
    TRIGGER_0,
    TRIGGER_1,
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
LEAP_US = 3 << 12
"""Inside a packet a TIME_HIGH that steps on by so much leaps."""
MOST_LEAPT_US = PERIOD_US
"""By no more do those of a packet leap in all."""
_VECTOR_MARGIN = 12
"""A vector writes all its columns and then counts those that are events: room behind the last one."""
_SIGN_SHIFT, _LATE_SHIFT = 12, 13
_COLUMNS = 1 << _SIGN_SHIFT
"""No sensor is wider than this."""
_COLUMN = _COLUMNS - 1

# State from packet to packet.
_HIGH_US, _LOW_US, _TIMED, _ROW, _BASE, _POLARITY, _LATEST_US = range(7)
_STATE_SIZE = 7
_UNKNOWN = -1
_NO_BITS, _HIGH_BITS, _ALL_BITS = range(3)
"""What of the time was seen since the start, or since packets were missing."""
_NO_ROW = 0xFFFF  # no sensor has it: such events are outside at first
_NO_BASE = 1 << 40
# How a packet follows the one before; whether it had a TIME_HIGH yet; whether that told of a restart; by how much its other
# ones have leapt, and how many were skipped for that.
_ELAPSED_US, _SEQ_FELL, _FOLLOWED, _RESTARTED, _LEAPT_US, _UNBELIEVED = range(6)
_LINK_SIZE = 6


class Evt3Decoder:
    """Decoder of evt3 payloads."""

    def __init__(self) -> None:
        self._state = np.zeros(_STATE_SIZE, np.int64)
        self._link = np.zeros(_LINK_SIZE, np.int64)
        self._state[_HIGH_US] = self._state[_LATEST_US] = _UNKNOWN
        self._forget()

    def decode(self, packet: Packet, continuity: Continuity, tally: Tally) -> Reading:
        """Decode a packet; see the module's head."""
        if continuity.packets_missing or continuity.seq_fell:
            self._forget()
        words = words_of(packet.payload, '<u2', 2)
        columns = EventColumns(_capacity(words))
        link = self._link
        link[_ELAPSED_US], link[_SEQ_FELL] = continuity.elapsed_ns // 1000, continuity.seq_fell
        link[_FOLLOWED:] = 0
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
        tally[SKIPPED] += link[_UNBELIEVED]
        restarted = bool(link[_RESTARTED])
        latest_us = int(self._state[_LATEST_US])
        batch: EventBatch | None = None
        if latest_us != _UNKNOWN:
            batch = columns.batch(n, latest_us * 1000)
        return Reading(batch, restarted, len(packet.payload) % 2)

    def _forget(self) -> None:
        """Forget what words set up, but for the upper time bits."""
        self._state[_TIMED] = _NO_BITS
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
def _follow_high(last_us, high_us, link):  # type: ignore[no-untyped-def]
    """Return the unwrapped time of a TIME_HIGH and whether it tells of a restart; see the module's head.

    ``last_us`` is the unwrapped time of the TIME_HIGH before, ``high_us`` the new one's bits (< 2²⁴).
    """
    forward_us = (high_us - last_us) % PERIOD_US
    back_us = PERIOD_US - forward_us
    if link[_FOLLOWED]:
        if back_us <= STEP_BACK_US:
            return last_us - back_us, False
        if forward_us >= LEAP_US:
            if link[_LEAPT_US] + forward_us > MOST_LEAPT_US:
                link[_UNBELIEVED] += 1
                return last_us, False
            link[_LEAPT_US] += forward_us
        return last_us + forward_us, False
    elapsed_us = link[_ELAPSED_US]
    seq_fell = link[_SEQ_FELL] != 0
    fell = high_us < last_us % PERIOD_US
    back_is_nearer = forward_us - elapsed_us >= back_us + elapsed_us
    if back_is_nearer and (fell or back_us <= STEP_BACK_US):
        if back_us > STEP_BACK_US or seq_fell:
            return high_us, True
        return last_us - back_us, False
    ahead_us = forward_us - elapsed_us
    if (fell and elapsed_us > 0 and ahead_us > STEP_BACK_US) or (seq_fell and abs(ahead_us) > STEP_BACK_US):
        return high_us, True
    return last_us + forward_us, False


@njit(cache=True, nogil=True)
def _start_anew(state, link):  # type: ignore[no-untyped-def]
    """Forget everything: the sensor was restarted."""
    state[_HIGH_US] = state[_LATEST_US] = _UNKNOWN
    state[_LOW_US], state[_TIMED] = 0, _NO_BITS
    state[_ROW], state[_BASE] = _NO_ROW, _NO_BASE
    link[_RESTARTED] = 1


@njit(cache=True, nogil=True)
def _await_time(words, start, state, link, tally):  # type: ignore[no-untyped-def]
    """Go on to the first TIME_LOW after a TIME_HIGH; return the place behind it, or the end."""
    for i in range(start, len(words)):
        word = np.int64(words[i])
        code = word >> 12
        if code == TIME_HIGH:
            high_us = (word & 0xFFF) << 12
            if state[_HIGH_US] != _UNKNOWN:
                high_us, restarted = _follow_high(state[_HIGH_US], high_us, link)
                if restarted:
                    _start_anew(state, link)
            link[_FOLLOWED] = 1
            state[_TIMED] = _HIGH_BITS
            state[_HIGH_US] = high_us
            state[_LATEST_US] = max(state[_LATEST_US], high_us)
        elif code == TIME_LOW:
            if state[_TIMED] == _HIGH_BITS:
                state[_LOW_US] = word & 0xFFF
                state[_TIMED] = _ALL_BITS
                state[_LATEST_US] = max(state[_LATEST_US], state[_HIGH_US] + state[_LOW_US])
                return i + 1
        elif code == ADDR_Y:
            state[_ROW] = word & 0x7FF
        elif code == VECT_BASE_X:
            state[_BASE] = word & 0x7FF
            state[_POLARITY] = ((word >> 10) & 2) - 1
        elif code == ADDR_X:
            tally[UNDECODED] += 1
        elif code in (VECT_12, VECT_8):
            columns = 12 if code == VECT_12 else 8
            state[_BASE] += columns
            for k in range(columns):
                tally[UNDECODED] += (word >> k) & 1
        else:
            _count_other(code, word, tally)
    return len(words)


@njit(cache=True, nogil=True)
def _count_other(code, word, tally):  # type: ignore[no-untyped-def]
    if code == EXT_TRIGGER:
        tally[TRIGGER_1 if word & 1 else TRIGGER_0] += 1
    elif code != OTHERS and code != CONTINUED_4 and code != CONTINUED_12:
        tally[SKIPPED] += 1


@njit(cache=True, nogil=True)
def _spread(word, columns, base, row, sign_bit, now_ns, late, x, y, t_ns, n, tally):  # type: ignore[no-untyped-def]
    """List a vector's events behind the first ``n``; return the new number."""
    if base + columns > _COLUMNS:  # no sensor has them: count what is set beyond
        beyond = max(_COLUMNS - base, 0)
        kind = OUTSIDE if row != _NO_ROW and base < _NO_BASE else UNDECODED
        for k in range(beyond, columns):
            tally[kind] += (word >> k) & 1
        columns = beyond
    for k in range(columns):
        x[n] = (base + k) | sign_bit | late
        y[n] = row
        t_ns[n] = now_ns
        n += np.uint64((word >> k) & 1)
    return n


@njit(cache=True, nogil=True)
def _settle(n, width, height, x, y, polarity, t_ns, tally):  # type: ignore[no-untyped-def]
    """Take the listed events' columns apart and drop those outside the sensor; return how many stay."""
    inside = late = 0
    for k in range(n):
        listed = np.int32(x[k])
        kept = ((listed & _COLUMN) < width) & (y[k] < height)
        inside += kept
        late += kept & (listed >> _LATE_SHIFT)
        polarity[k] = ((listed >> (_SIGN_SHIFT - 1)) & 2) - 1
        x[k] = listed & _COLUMN
    tally[CLAMPED] += late
    if inside == n:
        return inside
    stay = 0
    for k in range(n):
        if x[k] < width and y[k] < height:
            x[stay], y[stay], polarity[stay], t_ns[stay] = x[k], y[k], polarity[k], t_ns[k]
            stay += 1
        else:
            tally[UNDECODED if y[k] == _NO_ROW else OUTSIDE] += 1
    return stay


@njit(cache=True, nogil=True)
def _decode(words, width, height, state, link, x, y, polarity, t_ns, tally):  # type: ignore[no-untyped-def]
    """Decode a packet's words into the columns; return the number of events.

    First the events are listed as the words have them, with the row and the time that hold: a handful of operations a
    word.  What can be done to all at once comes after that (:func:`_settle`).  Until then a place of ``x`` holds

        13    late: time has stepped back      12    sign      11…0    column
    """
    i = _await_time(words, 0, state, link, tally) if state[_TIMED] != _ALL_BITS else 0
    high_us, low_us, latest_us = state[_HIGH_US], state[_LOW_US], state[_LATEST_US]
    row, base, sign = np.uint16(state[_ROW]), state[_BASE], state[_POLARITY]
    late = np.int64(high_us + low_us < latest_us) << _LATE_SHIFT
    now_ns = latest_us * 1000
    same_high = TIME_HIGH << 12 | ((high_us >> 12) & 0xFFF)
    n = np.uint64(0)  # unsigned, so that no place is taken to count from the end
    at, end = np.uint64(i), np.uint64(len(words))
    while at < end:
        word = np.int64(words[at])
        at += np.uint64(1)
        code = word >> 12
        if code == ADDR_X:
            x[n] = (word & 0x7FF) | ((word & 0x800) << (_SIGN_SHIFT - 11)) | late
            y[n] = row
            t_ns[n] = now_ns
            n += np.uint64(1)
        elif code == ADDR_Y:
            row = np.uint16(word & 0x7FF)
        elif code == TIME_LOW:
            low_us = word & 0xFFF
            late = np.int64(high_us + low_us < latest_us) << _LATE_SHIFT
            latest_us = max(latest_us, high_us + low_us)
            now_ns = latest_us * 1000
        elif word == same_high:
            link[_FOLLOWED] = 1
        elif code == TIME_HIGH:
            new_us, restarted = _follow_high(high_us, (word & 0xFFF) << 12, link)
            link[_FOLLOWED] = 1
            if restarted:
                # What came before belongs to the sensor's life before; so does the state.
                before = _settle(n, width, height, x, y, polarity, t_ns, tally)
                tally[UNDECODED] += before
                n = np.uint64(0)
                _start_anew(state, link)
                at = np.uint64(_await_time(words, np.int64(at) - 1, state, link, tally))
                high_us, low_us, latest_us = state[_HIGH_US], state[_LOW_US], state[_LATEST_US]
                row, base, sign = np.uint16(state[_ROW]), state[_BASE], state[_POLARITY]
            elif new_us != high_us:  # else it is not believed
                high_us, low_us = new_us, np.int64(0)
            late = np.int64(high_us + low_us < latest_us) << _LATE_SHIFT
            latest_us = max(latest_us, high_us + low_us)
            now_ns = latest_us * 1000
            same_high = TIME_HIGH << 12 | ((high_us >> 12) & 0xFFF)
        elif code in (VECT_12, VECT_8):
            columns = 12 if code == VECT_12 else 8
            sign_bit = np.int64(sign > 0) << _SIGN_SHIFT
            n = _spread(word, columns, base, row, sign_bit, now_ns, late, x, y, t_ns, n, tally)
            base += columns
        elif code == VECT_BASE_X:
            base = word & 0x7FF
            sign = ((word >> 10) & 2) - 1
        else:
            _count_other(code, word, tally)
    state[_HIGH_US], state[_LOW_US], state[_LATEST_US] = high_us, low_us, latest_us
    state[_ROW], state[_BASE], state[_POLARITY] = row, base, sign
    return _settle(n, width, height, x, y, polarity, t_ns, tally)
