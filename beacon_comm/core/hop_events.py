"""The events of one hop, sorted into bands of the sensor.

Pixels are numbered row by row with a stride that is a power of two, so that a number is taken apart by shifts, and
32,768 numbers on end are a *band*: whole rows, whose counts fit the processor's own cache.

    pixel   p = y stride + x            stride >= width, a power of two      band = p / 32,768
    code    uint32  [ p: 28 bits | not counted in the long, short window | routed | on ]

The order within a band is that of arrival.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

MAX_WIDTH = 1 << 12
MAX_HEIGHT = 1 << 16
BAND_SHIFT = 15
BAND_PIXELS = 1 << BAND_SHIFT
_SHORTEST_STRIDE_SHIFT = 6  # a row of the low pixels' bits is whole words of 64

ON, ROUTED = 1, 2
CODE_BITS = 4


@dataclass(frozen=True, slots=True)
class PixelGrid:
    """How the pixels of a sensor are numbered.

    Attributes:
        width, height: of the sensor (px).

    Raises:
        ValueError: a sensor that the words do not hold.
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
        return max(_SHORTEST_STRIDE_SHIFT, (self.width - 1).bit_length())

    @property
    def stride(self) -> int:
        """Pixel numbers a row."""
        return 1 << self.shift

    @property
    def bands(self) -> int:
        """Bands that hold the sensor's rows."""
        return (((self.height << self.shift) - 1) >> BAND_SHIFT) + 1

    @property
    def numbers(self) -> int:
        """Pixel numbers of all bands, those beyond the sensor's borders too."""
        return self.bands << BAND_SHIFT


@dataclass(frozen=True, slots=True)
class HopEvents:
    """The events of one hop, band by band.

    Attributes:
        code: pixel, flags and polarity, ``(n,)`` uint32; see the module's head.
        offset_ns: time since ``t_start_ns`` (ns), ``(n,)`` uint32.
        first: where each band's events begin, ``(bands + 1,)`` int64.
        t_start_ns: the hop's begin (ns, sensor clock).
    """

    code: NDArray[np.uint32]
    offset_ns: NDArray[np.uint32]
    first: NDArray[np.int64]
    t_start_ns: int

    def __len__(self) -> int:
        return len(self.code)

    @property
    def size_bytes(self) -> int:
        return int(self.code.nbytes + self.offset_ns.nbytes)


def no_events(bands: int) -> HopEvents:
    """Return a hop without events."""
    return HopEvents(np.empty(0, np.uint32), np.empty(0, np.uint32), np.zeros(bands + 1, np.int64), 0)


def sorted_by_band(
    code: NDArray[np.uint32], offset_ns: NDArray[np.uint32], in_band: NDArray[np.int64], t_start_ns: int
) -> HopEvents:
    """Sort gathered events.

    Args:
        code: see the module's head, ``(n,)`` uint32.
        offset_ns: time since the hop's begin (ns), ``(n,)`` uint32.
        in_band: how many of them are of each band, ``(bands,)`` int64.
        t_start_ns: the hop's begin (ns, sensor clock).
    """
    first = np.zeros(len(in_band) + 1, np.int64)
    np.cumsum(in_band, out=first[1:])
    sorted_code, sorted_ns = np.empty_like(code), np.empty_like(offset_ns)
    _sort(code, offset_ns, first[:-1].copy(), sorted_code, sorted_ns)
    return HopEvents(sorted_code, sorted_ns, first, t_start_ns)


@njit(cache=True, nogil=True)
def band_of(code):  # type: ignore[no-untyped-def]
    """Return the band of an event."""
    return code >> np.uint32(CODE_BITS + BAND_SHIFT)


@njit(cache=True, nogil=True)
def _sort(code, offset_ns, end, sorted_code, sorted_ns):  # type: ignore[no-untyped-def]
    """Put every event behind those of its band that came before; ``end`` is where each band goes on."""
    for i in range(len(code)):
        band = band_of(code[i])
        at = np.uint64(end[band])
        end[band] = at + np.uint64(1)
        sorted_code[at] = code[i]
        sorted_ns[at] = offset_ns[i]
