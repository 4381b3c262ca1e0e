"""The events of one hop: a list of them, and how many each pixel has.

Pixels are numbered row by row with a stride that is a power of two, so that a number is taken apart by shifts; 64 of
them on end are a *word*, as in the images of one bit a pixel.

    pixel    p = y stride + x           stride >= width, a power of two       word x / 64 of row y
    code     uint32  [ p: 30 bits | routed | on ]                            in the order of arrival
    planes   uint64  row after row that has events: [ bit 0 of the OFF events | of the ON events | bit 1 of … ]

Counts are kept as *bit planes*: bit k of the counts of 64 pixels is one word.  As most pixels have few events, most planes
are empty, and what is left is small enough for the processor's caches; counts are added 64 at a time by their carries.
An image of them has the first four planes of all rows, then the next four: what is used lies together.

Events are counted as they arrive, so that the windows have planes to look at, not events.  A hop counts 255 events of a pixel
and polarity at most: one with more of both than that in a hop has the index of a balanced one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

MAX_WIDTH = 1 << 12
MAX_HEIGHT = 1 << 16
WORD_SHIFT = 6  # 64 pixels a word
HOP_PLANES = 8  # of a hop's counts
_BRANCHLESS = 2  # of them
GROUP_SHIFT = 2  # four planes of a row lie side by side
IN_GROUP = (1 << GROUP_SHIFT) - 1
_BLOCK = 1024  # events whose places are found together

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
        planes: bits of their pixels' counts, ``(k,)`` uint64; see the module's head.
        t_start_ns: the hop's begin (ns, sensor clock).
        room: events that there is room for where ``code`` and ``offset_ns`` stand.
    """

    code: NDArray[np.uint32]
    offset_ns: NDArray[np.uint32]
    rows: NDArray[np.int64]
    first: NDArray[np.int64]
    planes: NDArray[np.uint64]
    t_start_ns: int
    room: int

    def __len__(self) -> int:
        return len(self.code)

    @property
    def size_bytes(self) -> int:
        """What it takes; nothing without events."""
        counts = self.rows.nbytes + self.first.nbytes + self.planes.nbytes
        return counts + self.room * (self.code.itemsize + self.offset_ns.itemsize) if len(self) else 0


class NearEvents(NamedTuple):
    """Events of the newest hop that lie near tracks.

    Attributes:
        events: code, without flag, and offset of some events, in order, among them all that lie in ``cells``,
            ``(2, k)`` uint32.
        cells: whether each cell of :mod:`beacon_comm.core.nearest` is one of these, ``(cells,)`` uint8; empty: none is.
    """

    events: NDArray[np.uint32]
    cells: NDArray[np.uint8]


NOTHING_NEAR = NearEvents(np.empty((2, 0), np.uint32), np.empty(0, np.uint8))


def no_events() -> HopEvents:
    """Return a hop without events."""
    none = np.empty(0, np.uint32)
    counts = np.empty(0, np.int64), np.zeros(1, np.int64), np.empty(0, np.uint64)
    return HopEvents(none, none, *counts, 0, 0)


def empty_planes(grid: PixelGrid, planes: int) -> NDArray[np.uint64]:
    """Return an image of so many planes, or a few more, ``(groups, height, 4, 2, words)`` uint64; see the module's head."""
    groups = -(-planes // (1 << GROUP_SHIFT))
    return np.zeros((groups, grid.height, 1 << GROUP_SHIFT, 2, grid.words), np.uint64)


class HopCounts:
    """Counts the events of a hop as they arrive.

    Args:
        grid: how the sensor's pixels are numbered.
    """

    def __init__(self, grid: PixelGrid) -> None:
        self._shift = grid.shift
        self._planes = empty_planes(grid, HOP_PLANES)
        self._counted = np.zeros(grid.height, np.bool_)  # rows with events
        self._used = np.full(grid.height, _BRANCHLESS)  # planes of a row that may have bits

    def add(self, code: NDArray[np.uint32]) -> None:
        """Count events, ``(n,)`` uint32; see the module's head."""
        _count(code, self._shift, self._planes, self._counted, self._used)

    def take(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.uint64]]:
        """Return the rows that have events and their planes, see :class:`HopEvents`, and begin anew."""
        rows = np.flatnonzero(self._counted)
        self._counted[rows] = False
        return rows, *_take(rows, self._planes, self._used)


@njit(cache=True, nogil=True)
def _count(code, shift, images, counted, used):  # type: ignore[no-untyped-def]
    """Add one to the count of each event's pixel and polarity: to the first planes without a branch, then the few carries."""
    words, planes = images.shape[4], images.reshape(-1)
    step = np.uint64(2 * words)  # from a plane to the next one
    place, bit = np.empty(_BLOCK, np.uint32), np.empty(_BLOCK, np.uint64)
    carried, n = np.empty(len(code), np.uint32), np.uint64(0)  # unsigned, so that no place is taken to count from the end
    for start in range(0, len(code), _BLOCK):
        block = code[start : start + _BLOCK]
        _find_places(block, shift, words, place, bit)
        for i in range(len(block)):
            counted[_row_of(block[i], shift)] = True
            first = np.uint64(place[i])
            second = first + step
            carry = planes[first] & bit[i]
            planes[first] ^= bit[i]
            carried[n] = block[i]
            n += np.uint64((planes[second] & carry) != 0)
            planes[second] ^= carry
    for start in range(0, n, _BLOCK):
        block = carried[start : min(start + _BLOCK, n)]
        _find_places(block, shift, words, place, bit)
        for i in range(len(block)):
            y = _row_of(block[i], shift)
            x = (block[i] >> np.uint32(CODE_BITS)) & np.uint32((1 << shift) - 1)
            used[y] = max(used[y], _carry_on(images, y, block[i] & np.uint32(ON), x >> np.uint32(WORD_SHIFT), bit[i]))


@njit(cache=True, nogil=True)
def _row_of(code, shift):  # type: ignore[no-untyped-def]
    return code >> np.uint32(CODE_BITS + shift)


@njit(cache=True, nogil=True)
def _find_places(code, shift, words, place, bit):  # type: ignore[no-untyped-def]
    """Write the place of each code's word in the first plane, and its bit: all at once, where the compiler can."""
    row_size, columns = np.uint32((2 << GROUP_SHIFT) * words), np.uint32((1 << shift) - 1)
    for i in range(len(code)):
        x = (code[i] >> np.uint32(CODE_BITS)) & columns
        word = (code[i] & np.uint32(ON)) * np.uint32(words) + (x >> np.uint32(WORD_SHIFT))
        place[i] = _row_of(code[i], shift) * row_size + word
        bit[i] = np.uint64(1) << np.uint64(x & np.uint32((1 << WORD_SHIFT) - 1))


@njit(cache=True, nogil=True)
def _carry_on(images, y, polarity, word, bit):  # type: ignore[no-untyped-def]
    """Carry a bit into the planes behind those; return how many are used.  A count that is full stays so."""
    for plane in range(_BRANCHLESS, HOP_PLANES):
        held = images[plane >> GROUP_SHIFT, y, plane & IN_GROUP, polarity, word]
        images[plane >> GROUP_SHIFT, y, plane & IN_GROUP, polarity, word] = held ^ bit
        if not held & bit:
            return plane + 1
    for plane in range(HOP_PLANES):
        images[plane >> GROUP_SHIFT, y, plane & IN_GROUP, polarity, word] |= bit
    return HOP_PLANES


@njit(cache=True, nogil=True)
def _take(rows, images, used):  # type: ignore[no-untyped-def]
    """Move the planes of some rows, without the last ones if these are empty, to an array; return where each begins, and it."""
    height, width, planes = images.shape[1], 2 * images.shape[4], images.reshape(-1)
    first = np.zeros(len(rows) + 1, np.int64)
    for k in range(len(rows)):
        n = used[rows[k]]
        used[rows[k]] = _BRANCHLESS
        while n and not _has_bits(planes, plane_at(n - 1, rows[k], height, width), width):
            n -= 1
        first[k + 1] = first[k] + n * width
    taken = np.empty(first[-1], np.uint64)
    for k in range(len(rows)):
        to = np.uint64(first[k])
        for plane in range((first[k + 1] - first[k]) // width):
            at = plane_at(plane, rows[k], height, width)
            for i in range(np.uint64(width)):
                taken[to + i] = planes[at + i]
                planes[at + i] = 0
            to += np.uint64(width)
    return first, taken


@njit(cache=True, nogil=True)
def _has_bits(planes, at, width):  # type: ignore[no-untyped-def]
    some = np.uint64(0)
    for i in range(np.uint64(width)):
        some |= planes[at + i]
    return some != 0


@njit(cache=True, nogil=True)
def plane_at(plane, y, height, width):  # type: ignore[no-untyped-def]
    """Return the place of the first of a row's ``width`` words, OFF and ON, of a plane of an image, which is flat."""
    return np.uint64((((plane >> GROUP_SHIFT) * height + y) << GROUP_SHIFT | plane & IN_GROUP) * width)
