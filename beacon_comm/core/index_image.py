"""Index images: how many and how balanced the events of each pixel are, in sliding windows.

The index of a pixel is (paper, section III, "Detection algorithm")

    I = n / (B + |Σσ|)        n: events in the window, Σσ: sum of their polarities, B > 0: offset

All windows lie on one grid of hops that is absolute in event time and end at the newest hop:

    hop        k-5     k-4     k-3     k-2     k-1      k
    ring      |events |events |events |events |events |
    long               '-------------------------------'     long_window_bits of the slowest bit rate
    short                              '---------------'     short_window_s

A window is kept as one count image, OFF events, then ON events, pixel after pixel (:mod:`.hop_events` numbers them):

    counts  uint16  [off … off | on … on]       n = on + off, Σσ = on - off

A hop adds its events and subtracts those of the hop that leaves, band by band, and looks in the bands that had any
for the pixels above the lower threshold (index_grow_share × index_threshold): its cost is that of the events that
come and go, until all bands have some.  These pixels are one bit each, 64 to a word, as the next stage takes them.

A count ends at 16,383: further events of that pixel and polarity are not counted, and flagged, so that they are not
subtracted either.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.hop_events import BAND_SHIFT, CODE_BITS, ON, HopEvents, PixelGrid, no_events
from beacon_comm.core.parameters import Parameters

MOST_COUNTED = (1 << 14) - 1
_NOT_COUNTED = 4  # flag of the short window; the long one's is the next bit
WORD_SHIFT = 6  # 64 pixels a word of bits
_WORD = 1 << WORD_SHIFT
_BAND_WORDS = 1 << (BAND_SHIFT - WORD_SHIFT)
_EACH = np.uint64(0x0001_0001_0001_0001)
_UPPER = np.uint64(0x8000_8000_8000_8000)
_GATHER = np.uint64(0x0102_0408_1020_4080)  # times eight bytes of 0 or 1: the upper byte has them as bits


@dataclass(slots=True)
class Window:
    """One sliding window.

    Attributes:
        hops: its length.
        counts: OFF, then ON events of every pixel, ``(2, numbers)`` uint16; see the module's head.
        low: whether a pixel is above the lower threshold, row by row, ``(rows, stride / 64)`` uint64, bit x % 64 of
            word x / 64; ``rows`` are those of all bands.
        flag: marks the events that are not counted in it.
        events: events in the window.
    """

    hops: int
    counts: NDArray[np.uint16]
    low: NDArray[np.uint64]
    flag: int
    events: int = 0


class IndexImages:
    """The detection windows of one sensor.

    Args:
        parameters: ``hop_s``, ``short_window_s``, ``long_window_bits``, ``bit_rates``, ``window_max_bytes``,
            ``index_offset``, ``index_threshold``, ``index_grow_share``.
        sensor_size: width and height (px).

    Attributes:
        grid: how pixels are numbered.
        windows: the short window, then the long one unless it is no longer than the short one.
        overflow_events: events dropped from the windows because the ring reached ``window_max_bytes``.
    """

    def __init__(self, parameters: Parameters, sensor_size: tuple[int, int]) -> None:
        self.grid = PixelGrid(*sensor_size)
        self._max_bytes = parameters.window_max_bytes
        self._offset = parameters.index_offset
        self._low = parameters.index_threshold * parameters.index_grow_share
        short = whole_hops(parameters.short_window_s, parameters.hop_s)
        long = whole_hops(parameters.long_window_bits * parameters.slowest_bit_s, parameters.hop_s)
        lengths = (short, long) if long > short else (short,)
        self.windows = [self._empty_window(hops, _NOT_COUNTED << k) for k, hops in enumerate(lengths)]
        self._none = no_events(self.grid.bands)
        self._ring: deque[HopEvents] = deque([self._none] * self.windows[-1].hops, maxlen=self.windows[-1].hops)
        self._ring_bytes = 0
        self.overflow_events = 0

    def _empty_window(self, hops: int, flag: int) -> Window:
        counts = np.zeros((2, self.grid.numbers), np.uint16)
        low = np.zeros((self.grid.numbers >> self.grid.shift, self.grid.stride >> WORD_SHIFT), np.uint64)
        return Window(hops, counts, low, flag)

    @property
    def empty(self) -> bool:
        """Whether no window holds any event."""
        return self.windows[-1].events == 0

    @property
    def newest(self) -> HopEvents:
        """The events of the newest hop."""
        return self._ring[-1]

    def hop_events(self, window: Window) -> Sequence[HopEvents]:
        """Return the hops in ``window``, oldest first."""
        return list(self._ring)[-window.hops :]

    def push(self, events: HopEvents) -> None:
        """Move every window on by one hop that held ``events``."""
        for window in self.windows:
            self._slide(window, self._ring[-window.hops], events)
        self._ring_bytes += events.size_bytes - self._ring[0].size_bytes
        self._ring.append(events)
        if self._ring_bytes > self._max_bytes:
            self._drop_oldest()

    def _drop_oldest(self) -> None:
        for k in range(len(self._ring) - 1):  # the newest hop always stays
            if self._ring_bytes <= self._max_bytes:
                return
            events = self._ring[k]
            for window in self.windows:
                if k >= len(self._ring) - window.hops:
                    self._slide(window, events, self._none)
            self._ring_bytes -= events.size_bytes
            self.overflow_events += len(events)
            self._ring[k] = self._none

    def _slide(self, window: Window, leaving: HopEvents, coming: HopEvents) -> None:
        if len(leaving) or len(coming):
            _slide(
                leaving.code, leaving.first, coming.code, coming.first, window.flag, self._low, self._offset,
                window.counts, window.counts.view(np.uint64), window.low.reshape(-1),
            )  # fmt: skip
            window.events += len(coming) - len(leaving)

    def index(self, window: Window) -> NDArray[np.float64]:
        """Return the index image of ``window``, ``(height, width)`` float64 (paper, section III)."""
        off, on = self.counts(window).astype(np.float64)
        index: NDArray[np.float64] = (on + off) / (self._offset + np.abs(on - off))
        return index

    def counts(self, window: Window) -> NDArray[np.uint16]:
        """Return the OFF, then the ON events of the sensor's pixels, ``(2, height, width)`` uint16."""
        rows = window.counts.reshape(2, -1, self.grid.stride)
        return rows[:, : self.grid.height, : self.grid.width]

    def low_pixels(self, window: Window) -> NDArray[np.bool_]:
        """Return which pixels are above the lower threshold, ``(height, width)`` bool."""
        bits = np.unpackbits(window.low.astype('<u8').view(np.uint8), axis=1, bitorder='little')
        return bits[: self.grid.height, : self.grid.width].astype(np.bool_)


def whole_hops(window_s: float, hop_s: float) -> int:
    """Return the fewest hops that hold a window (s); a hair too much is not another hop."""
    return max(1, math.ceil(window_s / hop_s - 1e-6))


def hop_length_ns(parameters: Parameters) -> int:
    """Return the spacing of the hop grid (ns)."""
    return round(parameters.hop_s * NS_PER_S)


@njit(cache=True, nogil=True)
def _slide(  # type: ignore[no-untyped-def]
    leaving, leaving_first, coming, coming_first, flag, low, offset, counts, packed, low_bits
):  # fmt: skip
    """Take the leaving events off the counts and add the coming ones, band by band; find the low pixels again.

    Of a band's words of 64 pixels those are looked at that had events, marked in ``touched``.
    """
    fewest = np.uint64(min(max(1.0, np.ceil(low * offset)), 2.0 * MOST_COUNTED + 1.0))
    numbers = np.uint64(counts.shape[1])
    flat, four = counts.ravel(), packed.ravel()
    is_low = np.empty(_WORD, np.uint8)
    eight = is_low.view(np.uint64)
    touched = np.zeros(_BAND_WORDS, np.uint8)
    for band in range(len(coming_first) - 1):
        gone = leaving[leaving_first[band] : leaving_first[band + 1]]
        came = coming[coming_first[band] : coming_first[band + 1]]
        if len(gone) == 0 and len(came) == 0:
            continue
        _subtract(gone, flag, flat, numbers, touched)
        _add(came, flag, flat, numbers, touched)
        for k in range(_BAND_WORDS):
            if touched[k]:
                touched[k] = 0
                word = np.uint64(band * _BAND_WORDS + k)
                found = np.uint64(0)
                if _has_candidate(four, numbers, word, fewest):
                    _find_low(flat, numbers, word, low, offset, is_low)
                    for byte in range(8):
                        found |= ((eight[byte] * _GATHER) >> np.uint64(56)) << np.uint64(8 * byte)
                low_bits[word] = found


@njit(cache=True, nogil=True)
def _place(code, numbers):  # type: ignore[no-untyped-def]
    """Return where an event is counted, in all the counts on end."""
    # Unsigned, so that no place is taken to count from the end.
    return np.uint64(code & ON) * numbers + np.uint64(code >> CODE_BITS)


@njit(cache=True, nogil=True)
def _word_of(code):  # type: ignore[no-untyped-def]
    """Return which word of its band an event is in."""
    return np.uint64(code >> (CODE_BITS + WORD_SHIFT)) & np.uint64(_BAND_WORDS - 1)


@njit(cache=True, nogil=True)
def _subtract(code, flag, counts, numbers, touched):  # type: ignore[no-untyped-def]
    """Take a band's events off the counts."""
    for i in range(len(code)):
        if not code[i] & flag:
            counts[_place(code[i], numbers)] -= np.uint16(1)
            touched[_word_of(code[i])] = 1


@njit(cache=True, nogil=True)
def _add(code, flag, counts, numbers, touched):  # type: ignore[no-untyped-def]
    """Count a band's events; flag those that a full count does not hold."""
    for i in range(len(code)):
        place = _place(code[i], numbers)
        touched[_word_of(code[i])] = 1
        if counts[place] < MOST_COUNTED:
            counts[place] += np.uint16(1)
        else:
            code[i] |= np.uint32(flag)


@njit(cache=True, nogil=True)
def _has_candidate(four, numbers, word, fewest):  # type: ignore[no-untyped-def]
    """Return whether any pixel of a word has the fewest events that a low pixel can have.

    Four pixels are looked at in one 64-bit number: their n is below 2¹⁵, and adding 2¹⁵ - fewest sets the upper bit
    of those with enough.
    """
    enough = (np.uint64(1 << 15) - fewest) * _EACH
    off = word << np.uint64(WORD_SHIFT - 2)
    on = off + (numbers >> np.uint64(2))
    some = np.uint64(0)
    for k in range(_WORD >> 2):
        some |= four[off + np.uint64(k)] + four[on + np.uint64(k)] + enough
    return some & _UPPER != np.uint64(0)


@njit(cache=True, nogil=True)
def _find_low(counts, numbers, word, low, offset, is_low):  # type: ignore[no-untyped-def]
    """Tell of each of a word's 64 pixels whether it is above the lower threshold."""
    at_off = word << np.uint64(WORD_SHIFT)
    at_on = at_off + numbers
    for k in range(_WORD):
        off, on = np.int32(counts[at_off + np.uint64(k)]), np.int32(counts[at_on + np.uint64(k)])
        n, difference = off + on, abs(on - off)
        is_low[k] = (n > 0) & (n >= low * (offset + difference))
