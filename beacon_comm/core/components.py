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
        x = listed[i] % width
        row = listed[i] - x
        for p in range(row + max(x - before, 0), row + min(x + after, width - 1) + 1):
            if not mark[p] & _WIDE:
                mark[p] |= _WIDE
                spare[wide] = p
                wide += 1
    dilated = 0
    for i in range(wide):
        y = spare[i] // width
        for row in range(max(y - before, 0), min(y + after, height - 1) + 1):
            p = spare[i] + (row - y) * width
            if not mark[p] & _DILATED:
                mark[p] |= _DILATED
                listed[dilated] = p
                dilated += 1
    for i in range(dilated):
        x = listed[i] % width
        row = listed[i] - x
        inside = True
        for p in range(row + max(x - before, 0), row + min(x + after, width - 1) + 1):
            inside &= (mark[p] & _DILATED) != 0
        if inside:
            mark[listed[i]] |= _NARROW
    for i in range(dilated):
        y = listed[i] // width
        inside = (mark[listed[i]] & _NARROW) != 0
        if inside:
            for row in range(max(y - before, 0), min(y + after, height - 1) + 1):
                inside &= (mark[listed[i] + (row - y) * width] & _NARROW) != 0
        if inside:
            mark[listed[i]] |= _CLOSED
    closed = 0
    for i in range(dilated):
        p = listed[i]
        mark[p] &= _CLOSED
        if mark[p]:
            listed[closed] = p
            closed += 1
    return closed


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
        if label[listed[i]]:
            continue
        if m == room:
            room *= 2
            first = np.append(first, np.zeros(m, np.int64))
            sums = np.concatenate((sums, np.zeros((m, 10), np.int64)))
            index = np.append(index, np.zeros(m))
        label[listed[i]] = m + 1
        pixel[end] = listed[i]
        at, end = end, end + 1
        s = sums[m]
        s[LEFT], s[TOP] = width, height
        while at < end:
            p = pixel[at]
            at += 1
            mark[p] = 0
            x, y = p % width, p // width
            n = np.int64(counts[2 * p] + counts[2 * p + 1])
            balance = abs(np.int64(counts[2 * p + 1] - counts[2 * p]))
            index[m] += n / (offset + balance)
            s[AREA] += 1
            s[SEEDS] += n >= threshold * (offset + balance)
            s[COUNT] += n
            s[COUNT_X] += n * x
            s[COUNT_Y] += n * y
            s[COUNT_RR] += n * (x * x + y * y)
            s[LEFT], s[RIGHT] = min(s[LEFT], x), max(s[RIGHT], x)
            s[TOP], s[BOTTOM] = min(s[TOP], y), max(s[BOTTOM], y)
            for row in range(max(y - 1, 0), min(y + 1, height - 1) + 1):
                for q in range(row * width + max(x - 1, 0), row * width + min(x + 1, width - 1) + 1):
                    if mark[q] and not label[q]:
                        label[q] = m + 1
                        pixel[end] = q
                        end += 1
        index[m] /= s[AREA]
        m += 1
        first[m] = end
    return first[: m + 1], sums[:m], index[:m]
