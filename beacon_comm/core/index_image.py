"""Index images: how many and how balanced the events of each pixel are, in sliding windows.

The index of a pixel is (paper, section III, "Detection algorithm")

    I = n / (B + |Σσ|)        n: events in the window, Σσ: sum of their polarities, B > 0: offset

All windows lie on one grid of hops that is absolute in event time and end at the newest hop:

    hop        k-5     k-4     k-3     k-2     k-1      k
    ring      |events |events |events |events |events |
    long               '-------------------------------'     long_window_bits of the slowest bit rate
    short                              '---------------'     short_window_s

A window is kept as one count image, ON and OFF events apart, flat, pixel after pixel:

    counts  int32   [on off | on off | on off | …]   index 2 (y width + x) + on      n = on + off, Σσ = on - off

A hop adds its events and subtracts those of the hop that leaves: its cost is that of the events that come and go.
A pixel's index changes with its events alone, so these also tell which pixels have come above the lower threshold
(index_grow_share × index_threshold): they are listed, and no image is ever searched.  An event in the ring is

    word    uint32  [ y: 16 bits | x: 14 bits | routed | on ]      and its time, int64 ns
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
from beacon_comm.core.parameters import Parameters

MAX_WIDTH = 1 << 14
MAX_HEIGHT = 1 << 16


@dataclass(frozen=True, slots=True)
class HopEvents:
    """The events of one hop, in order of time.

    Attributes:
        word: packed pixel, routed flag and polarity, ``(n,)`` uint32; see the module's head.
        t_ns: sensor time (ns), ``(n,)`` int64.
    """

    word: NDArray[np.uint32]
    t_ns: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.word)

    @property
    def size_bytes(self) -> int:
        return int(self.word.nbytes + self.t_ns.nbytes)


NO_EVENTS = HopEvents(np.empty(0, np.uint32), np.empty(0, np.int64))


@dataclass(slots=True)
class Window:
    """One sliding window.

    Attributes:
        hops: its length.
        counts: ON and OFF events of every pixel, ``(2 height width,)`` int32; see the module's head.
        mark: whether a pixel is listed, ``(height width,)`` uint8.
        pixel: numbers y width + x of the listed pixels, ``(height width,)`` int32, the first ``listed`` are valid;
            every pixel above the lower threshold is among them.
        listed: how many.
        events: events in the window.
    """

    hops: int
    counts: NDArray[np.int32]
    mark: NDArray[np.uint8]
    pixel: NDArray[np.int32]
    listed: int = 0
    events: int = 0


class IndexImages:
    """The detection windows of one sensor.

    Args:
        parameters: ``hop_s``, ``short_window_s``, ``long_window_bits``, ``bit_rates``, ``window_max_bytes``,
            ``index_offset``, ``index_threshold``, ``index_grow_share``.
        sensor_size: width and height (px).

    Attributes:
        windows: the short window, then the long one unless it is no longer than the short one.
        overflow_events: events dropped from the windows because the ring reached ``window_max_bytes``.
    """

    def __init__(self, parameters: Parameters, sensor_size: tuple[int, int]) -> None:
        self.width, self.height = sensor_size
        if not (0 < self.width <= MAX_WIDTH and 0 < self.height <= MAX_HEIGHT):
            raise ValueError(f'sensor_size = {sensor_size}: must lie in [1, {MAX_WIDTH}] x [1, {MAX_HEIGHT}] px')
        self._max_bytes = parameters.window_max_bytes
        self._offset = parameters.index_offset
        self._low = parameters.index_threshold * parameters.index_grow_share
        short = whole_hops(parameters.short_window_s, parameters.hop_s)
        long = whole_hops(parameters.long_window_bits * parameters.slowest_bit_s, parameters.hop_s)
        self.windows = [self._empty_window(hops) for hops in ((short, long) if long > short else (short,))]
        self._ring: deque[HopEvents] = deque([NO_EVENTS] * self.windows[-1].hops, maxlen=self.windows[-1].hops)
        self._ring_bytes = 0
        self.overflow_events = 0

    def _empty_window(self, hops: int) -> Window:
        size = self.width * self.height
        return Window(hops, np.zeros(2 * size, np.int32), np.zeros(size, np.uint8), np.empty(size, np.int32))

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
            leaving = self._ring[-window.hops]
            self._count(window, leaving, -1)
            self._count(window, events, 1)
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
                    self._count(window, events, -1)
            self._ring_bytes -= events.size_bytes
            self.overflow_events += len(events)
            self._ring[k] = NO_EVENTS

    def _count(self, window: Window, events: HopEvents, sign: int) -> None:
        if len(events):
            window.listed = _count(
                events.word, sign, self.width, self._low, self._offset,
                window.counts, window.mark, window.pixel, window.listed,
            )  # fmt: skip
            window.events += sign * len(events)

    def low_pixels(self, window: Window) -> NDArray[np.int32]:
        """Return the numbers y width + x of the pixels above the lower threshold, each once, ``(n,)`` int32."""
        window.listed = _still_above(
            window.counts, self._low, self._offset, window.mark, window.pixel, window.listed
        )
        return window.pixel[: window.listed]

    def index(self, window: Window) -> NDArray[np.float64]:
        """Return the index image of ``window``, ``(height, width)`` float64 (paper, section III)."""
        on = window.counts[1::2].astype(np.float64).reshape(self.height, self.width)
        off = window.counts[::2].astype(np.float64).reshape(self.height, self.width)
        index: NDArray[np.float64] = (on + off) / (self._offset + np.abs(on - off))
        return index


def whole_hops(window_s: float, hop_s: float) -> int:
    """Return the fewest hops that hold a window (s); a hair too much is not another hop."""
    return max(1, math.ceil(window_s / hop_s - 1e-6))


def hop_length_ns(parameters: Parameters) -> int:
    """Return the spacing of the hop grid (ns)."""
    return round(parameters.hop_s * NS_PER_S)


@njit(cache=True, nogil=True)
def _count(word, sign, width, low, offset, counts, mark, pixel, listed):  # type: ignore[no-untyped-def]
    """Add ``sign`` to each event's count, list the pixels that are above the lower threshold then.

    A subtraction can bring a pixel above it, too: when it takes from the polarity there is more of.
    """
    fewest = max(1.0, np.ceil(low * offset))
    for i in range(len(word)):
        x = np.int64((word[i] >> 2) & 0x3FFF)
        p = np.int64(word[i] >> 16) * width + x
        counts[2 * p + np.int64(word[i] & 1)] += sign
        n = counts[2 * p] + counts[2 * p + 1]
        if n >= fewest and not mark[p] and n >= low * (offset + abs(counts[2 * p + 1] - counts[2 * p])):
            mark[p] = 1
            pixel[listed] = p
            listed += 1
    return listed


@njit(cache=True, nogil=True)
def _still_above(counts, low, offset, mark, pixel, listed):  # type: ignore[no-untyped-def]
    """Strike the pixels off the list that are no longer above the lower threshold; return how many stay."""
    stay = 0
    for i in range(listed):
        p = pixel[i]
        n = counts[2 * p] + counts[2 * p + 1]
        if n > 0 and n >= low * (offset + abs(counts[2 * p + 1] - counts[2 * p])):
            pixel[stay] = p
            stay += 1
        else:
            mark[p] = 0
    return stay
