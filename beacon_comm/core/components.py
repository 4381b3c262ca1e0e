"""Connected components of high-index pixels: compiled, and only where there are events.

    low: I >= share * threshold ─► closed: low • square ─► components, 8-connected ─► with a seed: I >= threshold

A pixel set is a list of pixel numbers (y width + x) and an image of marks; only listed pixels are ever visited
and cleared again, so that an image that is dark but for a few blobs costs next to nothing.

Why two thresholds: while a beacon is near the threshold some of its pixels are above and some below, and one
threshold breaks it into fragments.  Its pixels are all alike, so nearly all of them are above half of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from beacon_comm.core.index_image import IndexImages, Window
from beacon_comm.core.parameters import Parameters

# Columns of ComponentSet.sums.
AREA, SEEDS, COUNT, COUNT_X, COUNT_Y, COUNT_RR, LEFT, RIGHT, TOP, BOTTOM = range(10)

# Marks of the morphological closing, one bit a step.
_SEEN, _WIDE, _DILATED, _NARROW, _CLOSED = 1, 2, 4, 8, 16


@dataclass(frozen=True, slots=True)
class ComponentSet:
    """The components of one window.

    Attributes:
        label: component of every pixel from 1 on, 0 for none, ``(height width,)`` int32.
        pixel: numbers of their pixels, component after component, int32.
        first: where each component's pixels begin in ``pixel``, ``(m + 1,)`` int64.
        sums: ``(m, 10)`` int64: area, pixels above the threshold, events n, Σ n x, Σ n y, Σ n (x² + y²),
            and the box left, right, top, bottom (inclusive).
        index: mean of I over the component's pixels, ``(m,)`` float64.
    """

    label: NDArray[np.int32]
    pixel: NDArray[np.int32]
    first: NDArray[np.int64]
    sums: NDArray[np.int64]
    index: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.index)

    def pixels_of(self, component: int) -> NDArray[np.int32]:
        """Return the pixel numbers of a component, counted from 0."""
        return self.pixel[self.first[component] : self.first[component + 1]]


class ComponentFinder:
    """Finds the components of one window; keeps the images it works in.

    Args:
        parameters: ``index_threshold``, ``index_offset``, ``closing_px``.
        sensor_size: width and height (px).
    """

    def __init__(self, parameters: Parameters, sensor_size: tuple[int, int]) -> None:
        self._width, self._height = sensor_size
        size = self._width * self._height
        self._threshold = parameters.index_threshold
        self._offset = parameters.index_offset
        self._closing_px = parameters.closing_px
        self._mark = np.zeros(size, np.uint8)
        self._label = np.zeros(size, np.int32)
        self._pixel = np.empty(size, np.int32)
        self._list = np.empty(size, np.int32)
        self._labelled = 0

    def find(self, images: IndexImages, window: Window) -> ComponentSet:
        """Return the components of ``window``, in the order in which their pixels were listed.

        The arrays of the result are valid until the next call.
        """
        self._label[self._pixel[: self._labelled]] = 0
        low = images.low_pixels(window)
        width, height, found = self._width, self._height, len(low)
        self._list[:found] = low
        self._mark[low] = _SEEN
        if self._closing_px > 1:
            found = _close(self._mark, self._list, self._pixel, found, width, height, self._closing_px)
        else:
            self._mark[low] = _CLOSED
        first, sums, index = _label_components(
            window.counts, width, height, self._threshold, self._offset, self._mark, self._list, found,
            self._label, self._pixel,
        )  # fmt: skip
        self._labelled = found
        return ComponentSet(self._label, self._pixel, first, sums, index)


@njit(cache=True, nogil=True)
def _close(mark, listed, spare, found, width, height, side):  # type: ignore[no-untyped-def]
    """Close the marked set with a square of ``side`` pixels; beyond the border counts as set when eroding.

    ``listed`` then holds the closed set, marked ``_CLOSED`` alone.  Row by row, then column by column.
    """
    before, after = side // 2, side - 1 - side // 2
    wide = 0
    for i in range(found):
        p = np.int64(listed[i])
        x = p - _row(p, width) * width
        for q in range(p - min(before, x), p + min(after, width - 1 - x) + 1):
            if not mark[q] & _WIDE:
                mark[q] |= _WIDE
                spare[wide] = q
                wide += 1
    dilated = 0
    for i in range(wide):
        p = np.int64(spare[i])
        y = _row(p, width)
        for q in range(p - min(before, y) * width, p + min(after, height - 1 - y) * width + 1, width):
            if not mark[q] & _DILATED:
                mark[q] |= _DILATED
                listed[dilated] = q
                dilated += 1
    for i in range(dilated):
        p = np.int64(listed[i])
        x = p - _row(p, width) * width
        common = _DILATED
        for q in range(p - min(before, x), p + min(after, width - 1 - x) + 1):
            common &= mark[q]
        if common:
            mark[p] |= _NARROW
    for i in range(dilated):
        p = np.int64(listed[i])
        if mark[p] & _NARROW:
            y = _row(p, width)
            common = _NARROW
            for q in range(p - min(before, y) * width, p + min(after, height - 1 - y) * width + 1, width):
                common &= mark[q]
            if common:
                mark[p] |= _CLOSED
    closed = 0
    for i in range(dilated):
        p = np.int64(listed[i])
        mark[p] &= _CLOSED
        if mark[p]:
            listed[closed] = p
            closed += 1
    return closed


@njit(cache=True, nogil=True)
def _row(p, width):  # type: ignore[no-untyped-def]
    """Return p // width; the division of unsigned 32-bit numbers is several times as fast as that of int64."""
    return np.int64(np.uint32(p) // np.uint32(width))


@njit(cache=True, nogil=True)
def _label_components(  # type: ignore[no-untyped-def]
    counts, width, height, threshold, offset, mark, listed, found, label, pixel
):
    """Label the marked pixels, gather them component by component in ``pixel``, sum up; clear the marks.

    ``pixel`` is also the queue of the flood: what is behind its end has been visited.
    """
    room = 256
    first, sums, index = np.zeros(room + 1, np.int64), np.zeros((room, 10), np.int64), np.zeros(room)
    m = 0
    end = 0
    for i in range(found):
        if not mark[listed[i]]:
            continue
        if m == room:
            room *= 2
            first = np.append(first, np.zeros(m, np.int64))
            sums = np.concatenate((sums, np.zeros((m, 10), np.int64)))
            index = np.append(index, np.zeros(m))
        mark[listed[i]] = 0
        pixel[end] = listed[i]
        at, end = end, end + 1
        seeds, n_sum, x_sum, y_sum, rr_sum, index_sum = 0, 0, 0, 0, 0, 0.0
        left, right, top, bottom = width, 0, height, 0
        while at < end:
            p = np.int64(pixel[at])
            at += 1
            label[p] = m + 1
            y = _row(p, width)
            x = p - y * width
            on, off = int(counts[2 * p + 1]), int(counts[2 * p])
            n, base = on + off, offset + abs(on - off)
            index_sum += n / base
            seeds += n >= threshold * base
            n_sum += n
            x_sum += n * x
            y_sum += n * y
            rr_sum += n * (x * x + y * y)
            left, right, top, bottom = min(left, x), max(right, x), min(top, y), max(bottom, y)
            for row in range(p - min(1, y) * width, p + min(1, height - 1 - y) * width + 1, width):
                for q in range(row - min(1, x), row + min(1, width - 1 - x) + 1):
                    if mark[q]:
                        mark[q] = 0
                        pixel[end] = q
                        end += 1
        s = sums[m]
        s[AREA], s[SEEDS], s[COUNT], s[COUNT_X], s[COUNT_Y] = end - first[m], seeds, n_sum, x_sum, y_sum
        s[COUNT_RR], s[LEFT], s[RIGHT], s[TOP], s[BOTTOM] = rr_sum, left, right, top, bottom
        index[m] = index_sum / s[AREA]
        m += 1
        first[m] = end
    return first[: m + 1], sums[:m], index[:m]
