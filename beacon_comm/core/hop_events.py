"""The events of one hop: a list of them, and how many each pixel has.

Pixels are numbered row by row with a stride that is a power of two, so that a number is taken apart by shifts; 64 of
them on end are a *word*, as in the images of one bit a pixel.

    pixel    p = y stride + x           stride >= width, a power of two       word = p / 64
    code     uint32  [ p: 30 bits | routed | on ]                            in the order of arrival
    counts   uint8   word after word that has events: 64 pixels' OFF events, then their ON events

Events are counted as they arrive, so that the windows have words to look at, not events.  A hop counts no more than so
many events of a pixel and polarity, 255 at most: one with more of both than that in a hop has the index of a balanced one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

MAX_WIDTH = 1 << 12
MAX_HEIGHT = 1 << 16
WORD_SHIFT = 6  # 64 pixels a word
WORD_COUNTS = 2 << WORD_SHIFT  # OFF and ON of each

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
    def numbers(self) -> int:
        """Pixel numbers of all rows, those beyond the sensor's right border too."""
        return self.height << self.shift


@dataclass(frozen=True, slots=True)
class HopEvents:
    """The events of one hop.

    Attributes:
        code: pixel, flag and polarity, ``(n,)`` uint32; see the module's head.
        offset_ns: time since ``t_start_ns`` (ns), ``(n,)`` uint32.
        words: the words that have events, ascending, ``(m,)`` int64.
        counts: their pixels' OFF and ON events, ``(m, 128)`` uint8.
        t_start_ns: the hop's begin (ns, sensor clock).
    """

    code: NDArray[np.uint32]
    offset_ns: NDArray[np.uint32]
    words: NDArray[np.int64]
    counts: NDArray[np.uint8]
    t_start_ns: int

    def __len__(self) -> int:
        return len(self.code)

    @property
    def size_bytes(self) -> int:
        return int(self.code.nbytes + self.offset_ns.nbytes + self.words.nbytes + self.counts.nbytes)


def no_events() -> HopEvents:
    """Return a hop without events."""
    return HopEvents(
        np.empty(0, np.uint32), np.empty(0, np.uint32), np.empty(0, np.int64), np.empty((0, WORD_COUNTS), np.uint8), 0
    )


class HopCounts:
    """Counts the events of a hop as they arrive.

    Args:
        grid: how the sensor's pixels are numbered.
        most: events of a pixel and polarity that a hop counts, 1 to 255.
    """

    def __init__(self, grid: PixelGrid, most: int) -> None:
        words = grid.numbers >> WORD_SHIFT
        self._counts = np.zeros((words, WORD_COUNTS), np.uint8)
        self._touched = np.zeros(words, np.uint8)
        self._most = np.uint8(most)

    def add(self, code: NDArray[np.uint32]) -> None:
        """Count events, ``(n,)`` uint32; see the module's head."""
        _count(code, self._counts.reshape(-1), self._touched, self._most)

    def take(self) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
        """Return the words that have events and their counts, see :class:`HopEvents`, and begin anew."""
        words = np.flatnonzero(self._touched)
        counts = np.empty((len(words), WORD_COUNTS), np.uint8)
        _take(words, self._counts.view(np.uint64), self._touched, counts.view(np.uint64))
        return words, counts


@njit(cache=True, nogil=True)
def _count(code, counts, touched, most):  # type: ignore[no-untyped-def]
    for i in range(len(code)):
        pixel = np.uint64(code[i] >> np.uint32(CODE_BITS))  # unsigned, so that no place is taken to count from the end
        word = pixel >> np.uint64(WORD_SHIFT)
        at = (word << np.uint64(WORD_SHIFT + 1)) | (np.uint64(code[i] & np.uint32(ON)) << np.uint64(WORD_SHIFT))
        at |= pixel & np.uint64((1 << WORD_SHIFT) - 1)
        counts[at] += np.uint8(counts[at] < most)
        touched[word] = 1


@njit(cache=True, nogil=True)
def _take(words, counts, touched, taken):  # type: ignore[no-untyped-def]
    """Move the counts of some words, eight a number, to ``taken``."""
    for k in range(len(words)):
        word = np.uint64(words[k])
        touched[word] = 0
        for i in range(counts.shape[1]):
            taken[k, i] = counts[word, i]
            counts[word, i] = 0
