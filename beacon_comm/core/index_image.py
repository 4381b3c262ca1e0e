"""Index images: how many and how balanced the events of each pixel are, in sliding windows.

The index of a pixel is (paper, section III, "Detection algorithm")

    I = n / (B + |Σσ|)        n: events in the window, Σσ: sum of their polarities, B > 0: offset

All windows lie on one grid of hops that is absolute in event time and end at the newest hop:

    hop        k-5     k-4     k-3     k-2     k-1      k
    ring      |events |events |events |events |events |
    long               '-------------------------------'     long_window_bits of the slowest bit rate
    short                              '---------------'     short_window_s

A window is kept as one count image, 64 pixels' OFF events, then their ON events, then the next 64 pixels
(:mod:`.hop_events` numbers them and counts each hop alike):

    counts  uint16  [off × 64 | on × 64 | off × 64 | …]        n = on + off, Σσ = on - off

A hop adds its counts and subtracts those of the hop that leaves, word by word of 64 pixels that has any, and looks there
for the pixels above the lower threshold (index_grow_share × index_threshold): its cost is that of the words with
events, whatever their number.  These pixels are one bit each, 64 to a word, as the next stage takes them.

A hop counts no more events of a pixel and polarity than any window of such hops can hold, and at most 255
(:func:`most_of_a_hop`).
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
from beacon_comm.core.hop_events import WORD_COUNTS, WORD_SHIFT, HopEvents, PixelGrid, no_events
from beacon_comm.core.parameters import MOST_WINDOW_HOPS, Parameters

_WORD = 1 << WORD_SHIFT
_GATHER = np.uint64(0x0102_0408_1020_4080)  # times eight bytes of 0 or 1: the upper byte has them as bits


@dataclass(slots=True)
class Window:
    """One sliding window.

    Attributes:
        hops: its length.
        counts: OFF, then ON events of every pixel, word by word, ``(words, 2, 64)`` uint16; see the module's head.
        low: whether a pixel is above the lower threshold, row by row, ``(height, stride / 64)`` uint64, bit x % 64 of
            word x / 64.
        events: events in the window.
    """

    hops: int
    counts: NDArray[np.uint16]
    low: NDArray[np.uint64]
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
        self.windows = [self._empty_window(hops) for hops in window_hops(parameters)]
        self._none = no_events()
        self._ring: deque[HopEvents] = deque([self._none] * self.windows[-1].hops, maxlen=self.windows[-1].hops)
        self._ring_bytes = 0
        self.overflow_events = 0

    def _empty_window(self, hops: int) -> Window:
        counts = np.zeros((self.grid.numbers >> WORD_SHIFT, 2, _WORD), np.uint16)
        low = np.zeros((self.grid.height, self.grid.stride >> WORD_SHIFT), np.uint64)
        return Window(hops, counts, low)

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
                leaving.words, leaving.counts, coming.words, coming.counts, self._low, self._offset,
                window.counts.reshape(-1), window.low.reshape(-1),
            )  # fmt: skip
            window.events += len(coming) - len(leaving)

    def index(self, window: Window) -> NDArray[np.float64]:
        """Return the index image of ``window``, ``(height, width)`` float64 (paper, section III)."""
        off, on = self.counts(window).astype(np.float64)
        index: NDArray[np.float64] = (on + off) / (self._offset + np.abs(on - off))
        return index

    def counts(self, window: Window) -> NDArray[np.uint16]:
        """Return the OFF, then the ON events of the sensor's pixels, ``(2, height, width)`` uint16."""
        rows = window.counts.reshape(self.grid.height, -1, 2, _WORD).transpose(2, 0, 1, 3)
        return rows.reshape(2, self.grid.height, -1)[:, :, : self.grid.width]

    def low_pixels(self, window: Window) -> NDArray[np.bool_]:
        """Return which pixels are above the lower threshold, ``(height, width)`` bool."""
        bits = np.unpackbits(window.low.astype('<u8').view(np.uint8), axis=1, bitorder='little')
        return bits[:, : self.grid.width].astype(np.bool_)


def whole_hops(window_s: float, hop_s: float) -> int:
    """Return the fewest hops that hold a window (s); a hair too much is not another hop."""
    return max(1, math.ceil(window_s / hop_s - 1e-6))


def window_hops(parameters: Parameters) -> tuple[int, ...]:
    """Return the lengths in hops of the short window, and of the long one if it is longer."""
    short = whole_hops(parameters.short_window_s, parameters.hop_s)
    long = whole_hops(parameters.long_window_bits * parameters.slowest_bit_s, parameters.hop_s)
    return (short, long) if long > short else (short,)


def most_of_a_hop(parameters: Parameters) -> int:
    """Return how many events of a pixel and polarity a hop counts: twice those of a whole window fit 16 bits."""
    return min(255, MOST_WINDOW_HOPS // window_hops(parameters)[-1])


def hop_length_ns(parameters: Parameters) -> int:
    """Return the spacing of the hop grid (ns)."""
    return round(parameters.hop_s * NS_PER_S)


@njit(cache=True, nogil=True)
def pixel_counts(counts, pixel):  # type: ignore[no-untyped-def]
    """Return how many OFF and ON events of a pixel a window's ``counts`` hold."""
    word, place = pixel >> WORD_SHIFT, pixel & (_WORD - 1)
    return np.int64(counts[word, 0, place]), np.int64(counts[word, 1, place])


@njit(cache=True, nogil=True)
def _slide(gone_words, gone, came_words, came, low, offset, counts, low_bits):  # type: ignore[no-untyped-def]
    """Take the counts that leave off and add those that come, word by word; find the low pixels of these words again."""
    fewest = min(max(1.0, np.ceil(low * offset)), 65535.0)
    is_low = np.empty(_WORD, np.uint8)
    eight = is_low.view(np.uint64)
    i, j = np.uint64(0), np.uint64(0)
    while i < len(gone_words) or j < len(came_words):
        goes = i < len(gone_words) and (j >= len(came_words) or gone_words[i] <= came_words[j])
        comes = j < len(came_words) and (i >= len(gone_words) or came_words[j] <= gone_words[i])
        word = np.uint64(came_words[j]) if comes else np.uint64(gone_words[i])
        at = word * np.uint64(WORD_COUNTS)
        if goes:
            for k in range(WORD_COUNTS):
                counts[at + np.uint64(k)] -= gone[i, k]
            i += np.uint64(1)
        if comes:
            for k in range(WORD_COUNTS):
                counts[at + np.uint64(k)] += came[j, k]
            j += np.uint64(1)
        found = np.uint64(0)
        if _most(counts, at) >= fewest:
            _find_low(counts, at, low, offset, is_low)
            for byte in range(8):
                found |= ((eight[byte] * _GATHER) >> np.uint64(56)) << np.uint64(8 * byte)
        low_bits[word] = found


@njit(cache=True, nogil=True)
def _most(counts, at):  # type: ignore[no-untyped-def]
    """Return the most events that a pixel of a word has."""
    most = np.uint16(0)
    for k in range(_WORD):
        most = max(most, np.uint16(counts[at + np.uint64(k)] + counts[at + np.uint64(_WORD + k)]))
    return most


@njit(cache=True, nogil=True)
def _find_low(counts, at, low, offset, is_low):  # type: ignore[no-untyped-def]
    """Tell of each of a word's 64 pixels whether it is above the lower threshold."""
    for k in range(_WORD):
        off, on = np.int32(counts[at + np.uint64(k)]), np.int32(counts[at + np.uint64(_WORD + k)])
        n, difference = off + on, abs(on - off)
        is_low[k] = (n > 0) & (n >= low * (offset + difference))
