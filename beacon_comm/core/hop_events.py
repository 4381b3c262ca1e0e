"""The events of one hop: a list of them, and how many each pixel has.

Pixels are numbered row by row with a stride that is a power of two, so that a number is taken apart by shifts; 64 of
them on end are a *word*, as in the images of one bit a pixel.

    pixel    p = y stride + x           stride >= width, a power of two       word x / 64 of row y
    code     uint32  [ p: 30 bits | routed | on ]                            in the order of arrival
    planes   uint64  row after row that has events: [ bit 0 of the OFF events | of the ON events | bit 1 of … ]

Counts are kept as *bit planes*: bit k of the counts of 64 pixels is one word.  As most pixels have few events, most planes
are empty, and what is left is small enough for the processor's caches; counts are added 64 at a time by their carries.

Events are counted as they arrive, so that the windows have planes to look at, not events.  A hop counts 255 events of a pixel
and polarity at most: one with more of both than that in a hop has the index of a balanced one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

MAX_WIDTH = 1 << 12
MAX_HEIGHT = 1 << 16
WORD_SHIFT = 6  # 64 pixels a word
HOP_PLANES = 8  # of a hop's counts
BRANCHLESS = 2  # of them

ON, ROUTED = 1, 2
CODE_BITS = 2


@dataclass(frozen=True, slots=True)
class PixelGrid:
    """How the pixels of a sensor are numbered.

    Attributes:
        width, height: of the sensor (px).

    Raises:
        ValueError: a sensor whose pixels a code does not hold.
    """

    width: int
    height: int

    def __post_init__(self) -> None:
        if not (0 < self.width <= MAX_WIDTH and 0 < self.height <= MAX_HEIGHT):
            size = (self.width, self.height)
            raise ValueError(f'sensor_size = {size}: must lie in [1, {MAX_WIDTH}] x [1, {MAX_HEIGHT}] px')

    @property
    def shift(self) -> int:
        """Binary logarithm of the stride."""
        return max(WORD_SHIFT, (self.width - 1).bit_length())

    @property
    def stride(self) -> int:
        """Pixel numbers a row."""
        return 1 << self.shift

    @property
    def words(self) -> int:
        """Words of a row that hold its pixels."""
        return ((self.width - 1) >> WORD_SHIFT) + 1

    @property
    def numbers(self) -> int:
        """Pixel numbers of all rows, those beyond the sensor's right border too."""
        return self.height << self.shift


@dataclass(frozen=True, slots=True)
class HopEvents:
    """The events of one hop.

    Attributes:
        code: pixel, flag and polarity, ``(n,)`` uint32; see the module's head.
        offset_ns: time since ``t_start_ns`` (ns), ``(n,)`` uint32.
        rows: the rows that have events, ascending, ``(m,)`` int64.
        first: where each row's planes begin in ``planes``, and the end of all, ``(m + 1,)`` int64.
        planes: bits of their pixels' counts, uint64; see the module's head.
        t_start_ns: the hop's begin (ns, sensor clock).
    """

    code: NDArray[np.uint32]
    offset_ns: NDArray[np.uint32]
    rows: NDArray[np.int64]
    first: NDArray[np.int64]
    planes: NDArray[np.uint64]
    t_start_ns: int

    def __len__(self) -> int:
        return len(self.code)

    @property
    def size_bytes(self) -> int:
        """What its arrays take; nothing without events."""
        columns = (self.code, self.offset_ns, self.rows, self.first, self.planes)
        return sum(column.nbytes for column in columns) if len(self) else 0


def no_events() -> HopEvents:
    """Return a hop without events."""
    none = np.empty(0, np.uint32)
    return HopEvents(none, none, np.empty(0, np.int64), np.zeros(1, np.int64), np.empty(0, np.uint64), 0)


class HopCounts:
    """Counts the events of a hop as they arrive.

    Args:
        grid: how the sensor's pixels are numbered.
    """

    def __init__(self, grid: PixelGrid) -> None:
        self._shift, self._words = grid.shift, grid.words
        self._planes = np.zeros((grid.height, HOP_PLANES, 2, grid.words), np.uint64)
        self._counted = np.zeros(grid.height, np.bool_)  # rows with events
        self._used = np.full(grid.height, BRANCHLESS)  # planes of a row that may have bits

    def add(self, code: NDArray[np.uint32]) -> None:
        """Count events, ``(n,)`` uint32; see the module's head."""
        _count(code, self._shift, self._words, self._planes.reshape(-1), self._counted, self._used)

    def take(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.uint64]]:
        """Return the rows that have events and their planes, see :class:`HopEvents`, and begin anew."""
        rows = np.flatnonzero(self._counted)
        self._counted[rows] = False
        first = _find_planes(rows, self._planes, self._used)
        planes = np.empty(first[-1], np.uint64)
        _take(rows, first, self._planes.reshape(len(self._planes), -1), planes)
        return rows, first, planes


@njit(cache=True, nogil=True)
def _count(code, shift, words, planes, counted, used):  # type: ignore[no-untyped-def]
    """Add one to the count of each event's pixel and polarity: to the first planes without a branch, then the few carries."""
    step = np.uint64(2 * words)  # from a plane to the next one
    carried, n = np.empty(len(code), np.uint32), np.uint64(0)  # unsigned, so that no place is taken to count from the end
    for i in range(len(code)):
        y, at, bit = _place(code[i], shift, words, step)
        counted[y] = True
        carry = planes[at] & bit
        planes[at] ^= bit
        at += step
        carried[n] = code[i]
        n += np.uint64((planes[at] & carry) != 0)
        planes[at] ^= carry
    for i in range(n):
        y, at, bit = _place(carried[i], shift, words, step)
        used[y] = max(used[y], _carry_on(planes, at, step, bit))


@njit(cache=True, nogil=True)
def _place(code, shift, words, step):  # type: ignore[no-untyped-def]
    """Return the row of a code, its word of the first plane, and its bit."""
    pixel = np.uint64(code >> np.uint32(CODE_BITS))
    y, x = pixel >> np.uint64(shift), pixel & np.uint64((1 << shift) - 1)
    at = y * np.uint64(HOP_PLANES) * step + np.uint64(code & np.uint32(ON)) * np.uint64(words) + (x >> np.uint64(WORD_SHIFT))
    return y, at, np.uint64(1) << (x & np.uint64((1 << WORD_SHIFT) - 1))


@njit(cache=True, nogil=True)
def _carry_on(planes, at, step, bit):  # type: ignore[no-untyped-def]
    """Carry a bit into the planes behind those; return how many are used.  A count that is full stays so."""
    for plane in range(BRANCHLESS, HOP_PLANES):
        place = at + np.uint64(plane) * step
        planes[place] ^= bit
        if planes[place] & bit:
            return plane + 1
    for plane in range(HOP_PLANES):
        planes[at + np.uint64(plane) * step] |= bit
    return HOP_PLANES


@njit(cache=True, nogil=True)
def _find_planes(rows, planes, used):  # type: ignore[no-untyped-def]
    """Return where the planes of some rows, without the empty ones behind the last, are to begin; forget how many are used."""
    first = np.zeros(len(rows) + 1, np.int64)
    for k in range(len(rows)):
        y = rows[k]
        n = used[y]
        while n and not planes[y, n - 1].any():
            n -= 1
        used[y] = BRANCHLESS
        first[k + 1] = first[k] + n * 2 * planes.shape[3]
    return first


@njit(cache=True, nogil=True)
def _take(rows, first, planes, taken):  # type: ignore[no-untyped-def]
    """Move the planes of some rows to ``taken``."""
    for k in range(len(rows)):
        start, size = first[k], first[k + 1] - first[k]
        row = planes[rows[k]]
        for i in range(size):
            taken[start + i] = row[i]
            row[i] = 0
