"""Index images: how many and how balanced the events of each pixel are, in sliding windows.

The index of a pixel is (paper, section III, "Detection algorithm")

    I = n / (B + |Σσ|)        n: events in the window, Σσ: sum of their polarities, B > 0: offset

All windows lie on one grid of hops that is absolute in event time and end at the newest hop:

    hop        k-5     k-4     k-3     k-2     k-1      k
    ring      |events |events |events |events |events |
    long               '-------------------------------'     long_window_bits of the slowest bit rate
    short                              '---------------'     short_window_s

A window is kept as bit planes of its pixels' counts (:mod:`.hop_events` numbers them and counts each hop alike):

    planes  uint64  row after row: [bit 0 of OFF | bit 0 of ON | … | bit 3 of ON]; then bits 4 to 7; …

    n = on + off, Σσ = on - off

A hop adds its counts and subtracts those of the hop that leaves (or that was done before), plane by plane until no carry is
left, a row at a time and only rows that have any.  There it looks for the pixels with as many events as the lower threshold
(index_grow_share × index_threshold) takes at least, again plane by plane, and only for these at I.  Those above the threshold
are one bit each, 64 to a word, as the next stage takes them.
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
from beacon_comm.core.hop_events import (
    GROUP_SHIFT,
    HOP_PLANES,
    IN_GROUP,
    WORD_SHIFT,
    HopEvents,
    PixelGrid,
    empty_planes,
    no_events,
    plane_at,
)
from beacon_comm.core.parameters import Parameters

_WORD = 1 << WORD_SHIFT
_DE_BRUIJN = np.uint64(0x03F7_9D71_B4CB_0A89)
_PLACES = np.empty(64, np.int64)
_PLACES[[(1 << k) * int(_DE_BRUIJN) % (1 << 64) >> 58 for k in range(64)]] = np.arange(64)
_ALL, _NONE = np.uint64(0xFFFF_FFFF_FFFF_FFFF), np.uint64(0)
_FEW_PIXELS = 8  # so many of a word are looked at one by one
_MOST_EVENTS = 1 << 40  # no window has more


@dataclass(slots=True)
class Window:
    """One sliding window.

    Attributes:
        hops: its length.
        planes: bits of the OFF, then of the ON events of every pixel, ``(groups, height, 4, 2, words)`` uint64; see the
            module's head.
        used: how many planes of a row may have bits, ``(height,)`` int64.
        low: whether a pixel is above the lower threshold, row by row, ``(height, words)`` uint64, bit x % 64 of word x / 64.
        events: events in the window.
        taken_off: whether the oldest hop, which leaves next, has been taken off ``planes`` and ``low`` (not ``events``).
    """

    hops: int
    planes: NDArray[np.uint64]
    used: NDArray[np.int64]
    low: NDArray[np.uint64]
    events: int = 0
    taken_off: bool = False


class IndexImages:
    """The detection windows of one sensor.

    Args:
        parameters: ``hop_s``, ``short_window_s``, ``long_window_bits``, ``bit_rates``, ``window_max_bytes``,
            ``index_offset``, ``index_threshold``, ``index_grow_share``.
        sensor_size: width and height (px).

    Attributes:
        grid: how pixels are numbered.
        threshold: what a blob has a pixel of; see :meth:`set_threshold`.
        windows: the short window, then the long one unless it is no longer than the short one.
        overflow_events: events dropped from the windows because the ring reached ``window_max_bytes``.
    """

    def __init__(self, parameters: Parameters, sensor_size: tuple[int, int]) -> None:
        self.grid = PixelGrid(*sensor_size)
        self._max_bytes = parameters.window_max_bytes
        self._offset = parameters.index_offset
        self._grow_share = parameters.index_grow_share
        self.threshold = parameters.index_threshold
        self.windows = [self._empty_window(hops) for hops in window_hops(parameters)]
        self._none = no_events()
        self._ring: deque[HopEvents] = deque([self._none] * self.windows[-1].hops, maxlen=self.windows[-1].hops)
        self._ring_bytes = 0
        self.overflow_events = 0

    def _empty_window(self, hops: int) -> Window:
        low = np.zeros((self.grid.height, self.grid.words), np.uint64)
        planes = empty_planes(self.grid, HOP_PLANES + hops.bit_length())
        return Window(hops, planes, np.zeros(self.grid.height, np.int64), low)

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

    @property
    def _low(self) -> float:
        """The lower threshold."""
        return self.threshold * self._grow_share

    def set_threshold(self, threshold: float) -> None:
        """Go on with another threshold: the pixels above the lower one are found again."""
        if threshold == self.threshold:
            return
        self.threshold = threshold
        for window in self.windows:
            _find_again(self._low, self._offset, window.planes, window.used, window.low)

    def push(self, events: HopEvents) -> None:
        """Move every window on by one hop that held ``events``."""
        for window in self.windows:
            leaving = self._ring[-window.hops]
            self._slide(window, self._none if window.taken_off else leaving, events)
            window.events += len(events) - len(leaving)
            window.taken_off = False
        self._ring_bytes += events.size_bytes - self._ring[0].size_bytes
        self._ring.append(events)
        if self._ring_bytes > self._max_bytes:
            self._drop_oldest()

    def take_off(self) -> bool:
        """Take what leaves a window next off it now, so that there is less to do at the next hop; one window a call.

        Its images are of one hop less until then.  Returns whether there was one left.
        """
        for window in self.windows:
            if not window.taken_off:
                self._slide(window, self._ring[-window.hops], self._none)
                window.taken_off = True
                return True
        return False

    def _drop_oldest(self) -> None:
        for k in range(len(self._ring) - 1):  # the newest hop always stays
            if self._ring_bytes <= self._max_bytes:
                return
            events = self._ring[k]
            for window in self.windows:
                if k >= len(self._ring) - window.hops:
                    self._slide(window, events, self._none)
                    window.events -= len(events)
            self._ring_bytes -= events.size_bytes
            self.overflow_events += len(events)
            self._ring[k] = self._none

    def _slide(self, window: Window, leaving: HopEvents, coming: HopEvents) -> None:
        if len(leaving) or len(coming):
            _slide(
                leaving.rows, leaving.first, leaving.planes, coming.rows, coming.first, coming.planes, self._low, self._offset,
                window.planes, window.used, window.low,
            )  # fmt: skip

    def index(self, window: Window) -> NDArray[np.float64]:
        """Return the index image of ``window``, ``(height, width)`` float64 (paper, section III)."""
        off, on = self.counts(window).astype(np.float64)
        index: NDArray[np.float64] = (on + off) / (self._offset + np.abs(on - off))
        return index

    def counts(self, window: Window) -> NDArray[np.int64]:
        """Return the OFF, then the ON events of the sensor's pixels, ``(2, height, width)`` int64."""
        planes = window.planes.transpose(0, 2, 3, 1, 4).reshape(-1, 2, self.grid.height, self.grid.words)
        bits = np.unpackbits(planes.astype('<u8').view(np.uint8), axis=-1, bitorder='little')[..., : self.grid.width]
        return np.tensordot(1 << np.arange(len(bits)), bits, (0, 0))

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


def hop_length_ns(parameters: Parameters) -> int:
    """Return the spacing of the hop grid (ns)."""
    return round(parameters.hop_s * NS_PER_S)


@njit(cache=True, nogil=True)
def lowest_bit(bits):  # type: ignore[no-untyped-def]
    """Return the place of the lowest set bit of a word that has one: 2ᵏ times a de Bruijn number begins with k's 6 bits."""
    return _PLACES[((bits & (~bits + np.uint64(1))) * _DE_BRUIJN) >> np.uint64(58)]


@njit(cache=True, nogil=True)
def _count_bits(bits):  # type: ignore[no-untyped-def]
    """Return how many bits of a word are set: by twos, fours and bytes, and the bytes summed up by a product."""
    bits -= (bits >> np.uint64(1)) & np.uint64(0x5555_5555_5555_5555)
    bits = (bits & np.uint64(0x3333_3333_3333_3333)) + ((bits >> np.uint64(2)) & np.uint64(0x3333_3333_3333_3333))
    bits = (bits + (bits >> np.uint64(4))) & np.uint64(0x0F0F_0F0F_0F0F_0F0F)
    return (bits * np.uint64(0x0101_0101_0101_0101)) >> np.uint64(56)


@njit(cache=True, nogil=True)
def pixel_counts(planes, used, y, x):  # type: ignore[no-untyped-def]
    """Return how many OFF and ON events of a pixel a window's ``planes`` hold."""
    word, place = x >> WORD_SHIFT, np.uint64(x & (_WORD - 1))
    off, on = _NONE, _NONE
    for plane in range(used[y]):
        row = planes[plane >> GROUP_SHIFT, y, plane & IN_GROUP]
        off |= ((row[0, word] >> place) & np.uint64(1)) << np.uint64(plane)
        on |= ((row[1, word] >> place) & np.uint64(1)) << np.uint64(plane)
    return np.int64(off), np.int64(on)


@njit(cache=True, nogil=True)
def _slide(  # type: ignore[no-untyped-def]
    gone_rows, gone_first, gone, came_rows, came_first, came, low, offset, planes, used, low_bits
):
    """Take the counts that leave off and add those that come, row by row; find the low pixels of these rows again."""
    fewest = _fewest(low, offset)
    height, words, flat = planes.shape[1], planes.shape[4], planes.reshape(-1)
    carry, many, changed = np.empty(2 * words, np.uint64), np.empty(words, np.uint64), np.empty(2 * words, np.uint64)
    counts, is_low = np.empty((2, _WORD), np.int64), np.empty(_WORD, np.uint64)
    i = j = 0
    while i < len(gone_rows) or j < len(came_rows):
        goes = i < len(gone_rows) and (j >= len(came_rows) or gone_rows[i] <= came_rows[j])
        comes = j < len(came_rows) and (i >= len(gone_rows) or came_rows[j] <= gone_rows[i])
        y = came_rows[j] if comes else gone_rows[i]
        changed[:] = _NONE
        if goes:
            _change(flat, y, height, gone, gone_first[i], gone_first[i + 1], _ALL, carry, changed)
            i += 1
        if comes:
            reached = _change(flat, y, height, came, came_first[j], came_first[j + 1], _NONE, carry, changed)
            used[y] = max(used[y], reached)
            j += 1
        used[y] = _find_many(flat, y, height, used[y], fewest, many, carry)
        some = _NONE
        for word in range(np.uint64(words)):
            pixels = changed[word] | changed[np.uint64(words) + word]
            low_bits[y, word] &= ~pixels
            many[word] &= pixels
            some |= many[word]
        if some:
            _find_low_row(y, many, low, offset, planes, used, low_bits, counts, is_low)


@njit(cache=True, nogil=True)
def _find_again(low, offset, planes, used, low_bits):  # type: ignore[no-untyped-def]
    """Find all low pixels again: the threshold has changed."""
    fewest = _fewest(low, offset)
    height, words, flat = planes.shape[1], planes.shape[4], planes.reshape(-1)
    carry, many = np.empty(2 * words, np.uint64), np.empty(words, np.uint64)
    counts, is_low = np.empty((2, _WORD), np.int64), np.empty(_WORD, np.uint64)
    for y in range(height):
        low_bits[y] = _NONE
        if used[y]:
            _find_many(flat, y, height, used[y], fewest, many, carry)
            _find_low_row(y, many, low, offset, planes, used, low_bits, counts, is_low)


@njit(cache=True, nogil=True)
def _fewest(low, offset):  # type: ignore[no-untyped-def]
    """Return how many events a low pixel has at least."""
    return np.int64(min(max(1.0, np.ceil(low * offset)), float(_MOST_EVENTS)))


@njit(cache=True, nogil=True)
def _find_low_row(y, many, low, offset, planes, used, low_bits, counts, is_low):  # type: ignore[no-untyped-def]
    """Find the low ones among those pixels of a row that have events enough; the last two arrays are worked in."""
    for word in range(len(many)):
        pixels = many[word]
        if pixels and _count_bits(pixels) > _FEW_PIXELS:  # all 64 at once
            _unpack(planes[:, y, :, :, word], used[y], counts)
            low_bits[y, word] = _find_low(counts, low, offset, is_low)
            continue
        while pixels:
            place = lowest_bit(pixels)
            off, on = pixel_counts(planes, used, y, (word << WORD_SHIFT) + place)
            low_bits[y, word] |= np.uint64(off + on >= low * (offset + abs(on - off))) << np.uint64(place)
            pixels &= pixels - np.uint64(1)


@njit(cache=True, nogil=True)
def _change(planes, y, height, by, start, stop, flip, carry, changed):  # type: ignore[no-untyped-def]
    """Add the counts ``by[start:stop]`` to a row's, or take them off: ``flip`` 0, or all bits; return how many planes changed,
    and gather which words.

    Both carry alike, but that a difference borrows where the bit that it is taken off is not set.
    """
    width = np.uint64(len(carry))
    for k in range(width):
        carry[k] = _NONE
    of, plane = np.uint64(start), 0
    while of < np.uint64(stop):
        at = plane_at(plane, y, height, len(carry))
        for k in range(width):
            held, other, more = planes[at + k], by[of + k], carry[k]
            planes[at + k] = held ^ other ^ more
            changed[k] |= other
            able = held ^ flip
            carry[k] = (able & other) | (more & (able ^ other))
        of += width
        plane += 1
    most = (len(planes) // (height * len(carry))) - 1  # the last plane, whatever should be carried on
    while plane <= most:
        some = _NONE
        for k in range(width):
            some |= carry[k]
        if not some:
            break
        at = plane_at(plane, y, height, len(carry))
        for k in range(width):
            held, more = planes[at + k], carry[k]
            planes[at + k] = held ^ more
            carry[k] = (held ^ flip) & more
        plane += 1
    return plane


@njit(cache=True, nogil=True)
def _find_many(planes, y, height, used, fewest, many, carry):  # type: ignore[no-untyped-def]
    """Find the pixels of a row that have so many events, one bit each; return how many planes have bits.

    From the lowest bit on: with those so far, a sum is as large as ``fewest`` if the next bit of both is the same and it was
    so before, or if its own is the greater one.
    """
    words = np.uint64(len(many))
    for k in range(words):
        many[k], carry[k] = _ALL, _NONE
    full = 0
    for plane in range(used):
        some = _NONE
        off_at = plane_at(plane, y, height, len(carry))
        on_at = off_at + words
        passed = np.uint64(((fewest >> plane) & 1) - 1)  # all bits where the next one of ``fewest`` is 0
        for k in range(words):
            off, on, more = planes[off_at + k], planes[on_at + k], carry[k]
            half = off ^ on
            bit = half ^ more
            some |= off | on
            carry[k] = (off & on) | (more & half)
            many[k] = (bit & passed) | (many[k] & (bit | passed))
        if some:
            full = plane + 1
    passed, beyond = np.uint64(((fewest >> used) & 1) - 1), fewest >> (used + 1)
    for k in range(words):  # one more plane, of carries alone
        many[k] = _NONE if beyond else (carry[k] & passed) | (many[k] & (carry[k] | passed))
    return full


@njit(cache=True, nogil=True)
def _unpack(planes, used, counts):  # type: ignore[no-untyped-def]
    """Write the OFF and ON events of a word's 64 pixels; ``planes``: its bits, ``(groups, 4, 2)``."""
    for polarity in range(2):
        for k in range(_WORD):
            counts[polarity, k] = 0
        for plane in range(used):
            bits = planes[plane >> GROUP_SHIFT, plane & IN_GROUP, polarity]
            for k in range(_WORD):
                counts[polarity, k] |= np.int64((bits >> np.uint64(k)) & np.uint64(1)) << plane


@njit(cache=True, nogil=True)
def _find_low(counts, low, offset, is_low):  # type: ignore[no-untyped-def]
    """Return which of a word's 64 pixels are above the lower threshold, one bit each."""
    for k in range(_WORD):
        off, on = counts[0, k], counts[1, k]
        n, difference = off + on, abs(on - off)
        is_low[k] = np.uint64((n > 0) & (n >= low * (offset + difference))) << np.uint64(k)
    found = _NONE
    for k in range(_WORD):
        found |= is_low[k]
    return found
