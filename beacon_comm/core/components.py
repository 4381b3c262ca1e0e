"""Connected components of high-index pixels: compiled, 64 pixels at a time, and only where there are some.

    low: I >= share * threshold ─► closed: low • square ─► runs ─► components, 8-connected ─► with a seed: I >= threshold

    bits      . 1 1 1 . . 1 . . 1 1 .       the rows of a pixel set, 64 pixels to a word: closing is shifts, ORs and ANDs
    runs        '-----'   '   '---'         what a row's words hold; a run joins the runs it touches in the row above

Components and their runs are in the order in which a reader meets them, row by row.

Why two thresholds: while a beacon is near the threshold some of its pixels are above and some below, and one
threshold breaks it into fragments.  Its pixels are all alike, so nearly all of them are above half of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from beacon_comm.core.hop_events import WORD_SHIFT, PixelGrid
from beacon_comm.core.index_image import Window, lowest_bit, pixel_counts
from beacon_comm.core.parameters import Parameters

# Columns of ComponentSet.sums.
AREA, SEEDS, COUNT, COUNT_X, COUNT_Y, COUNT_RR, LEFT, RIGHT, TOP, BOTTOM = range(10)

_ALL = np.uint64(0xFFFF_FFFF_FFFF_FFFF)
_NONE = np.uint64(0)


@dataclass(frozen=True, slots=True)
class ComponentSet:
    """The components of one window.

    Attributes:
        label: component of every pixel from 1 on, 0 for none, by pixel number, int32.
        run: pixels on end in a row, component after component: number of the first one, and of the one behind the
            last one, ``(r, 2)`` int32.
        first: where each component's runs begin in ``run``, ``(m + 1,)`` int64.
        sums: ``(m, 10)`` int64: area, pixels above the threshold, events n, Σ n x, Σ n y, Σ n (x² + y²),
            and the box left, right, top, bottom (inclusive).
        index: mean of I over the component's pixels, ``(m,)`` float64.
    """

    label: NDArray[np.int32]
    run: NDArray[np.int32]
    first: NDArray[np.int64]
    sums: NDArray[np.int64]
    index: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.index)


class ComponentFinder:
    """Finds the components of one window; keeps the images it works in.

    Args:
        parameters: ``index_offset``, ``closing_px``.
        grid: how the sensor's pixels are numbered.
    """

    def __init__(self, parameters: Parameters, grid: PixelGrid) -> None:
        self._grid = grid
        self._offset = parameters.index_offset
        self._closing_px = parameters.closing_px
        self._wide = np.zeros((grid.height, grid.words), np.uint64)
        self._closed = np.zeros((grid.height, grid.words), np.uint64)
        self._label = np.zeros(grid.numbers, np.int32)
        self._run = np.empty((0, 2), np.int32)

    def find(self, window: Window, threshold: float) -> ComponentSet:
        """Return the components of ``window``, with their pixels above a threshold; labels are valid until the next call."""
        paint(self._run, self._label, 0)
        bits = window.low
        if self._closing_px > 1:
            _close(bits, self._closing_px, self._grid.width, self._wide, self._closed)
            bits = self._closed
        self._run, first, sums, index = _find_components(
            bits, self._grid.width, self._grid.shift, window.planes, window.used, threshold, self._offset, self._label
        )
        return ComponentSet(self._label, self._run, first, sums, index)


@njit(cache=True, nogil=True)
def paint(run, image, value):  # type: ignore[no-untyped-def]
    """Set an image to ``value`` where there are runs."""
    for k in range(len(run)):
        for p in range(run[k, 0], run[k, 1]):
            image[p] = value


@njit(cache=True, nogil=True)
def _close(low, side, width, wide, closed):  # type: ignore[no-untyped-def]
    """Close the set with a square of ``side`` pixels; beyond the border counts as set when eroding.

    Row by row, then column by column; a row without a set pixel near it is passed over.
    """
    height, words = closed.shape
    before, after = side // 2, side - 1 - side // 2
    last = _ALL >> np.uint64(-width & 63)  # the pixels of a row's last word
    spread = np.empty(words, np.uint64)
    filled = _filled_rows(low)
    near = np.zeros(height, np.bool_)
    for y in range(height):
        if filled[y]:  # its pixels reach the rows y - before … y + after
            _widen(low[y], before, after, wide[y])
            wide[y, -1] &= last
            near[max(y - before, 0) : y + after + 1] = True
    for y in range(height):
        if near[y]:
            spread[:] = _NONE
            for other in range(max(y - after, 0), min(y + before, height - 1) + 1):
                if filled[other]:
                    for k in range(words):
                        spread[k] |= wide[other, k]
            _narrow(spread, before, after, last, closed[y])
        else:
            for k in range(words):
                closed[y, k] = _NONE
    for y in range(height):
        for k in range(words):
            wide[y, k] = closed[y, k]
    filled = _filled_rows(closed)
    for y in range(height):
        # It stays where the rows y - before … y + after, as they were, are set.
        if filled[y]:
            for other in range(max(y - before, 0), min(y + after, height - 1) + 1):
                for k in range(words):
                    closed[y, k] &= wide[other, k]


@njit(cache=True, nogil=True)
def _filled_rows(bits):  # type: ignore[no-untyped-def]
    """Return which rows have a set pixel; an array slice a row would take longer than looking."""
    filled = np.empty(len(bits), np.bool_)
    for y in range(len(bits)):
        some = _NONE
        for k in range(bits.shape[1]):
            some |= bits[y, k]
        filled[y] = some != _NONE
    return filled


@njit(cache=True, nogil=True)
def _widen(row, before, after, out):  # type: ignore[no-untyped-def]
    """Dilate a row: pixel x sets x - before … x + after."""
    for k in range(len(out)):
        out[k] = row[k]
    for step in range(1, before + 1):
        for k in range(len(out)):
            out[k] |= row[k] >> np.uint64(step)
            if k + 1 < len(out):
                out[k] |= row[k + 1] << np.uint64(64 - step)
    for step in range(1, after + 1):
        for k in range(len(out)):
            out[k] |= row[k] << np.uint64(step)
            if k:
                out[k] |= row[k - 1] >> np.uint64(64 - step)


@njit(cache=True, nogil=True)
def _narrow(row, before, after, last, out):  # type: ignore[no-untyped-def]
    """Erode a row, given as a copy: pixel x stays if x - before … x + after are set or beyond the border."""
    end = len(out) - 1
    row[end] |= ~last
    for k in range(len(out)):
        out[k] = row[k]
    for step in range(1, after + 1):
        for k in range(len(out)):
            right = row[k + 1] if k < end else _ALL
            out[k] &= row[k] >> np.uint64(step) | right << np.uint64(64 - step)
    for step in range(1, before + 1):
        for k in range(len(out)):
            left = row[k - 1] if k else _ALL
            out[k] &= row[k] << np.uint64(step) | left >> np.uint64(64 - step)
    out[end] &= last


@njit(cache=True, nogil=True)
def _find_runs(bits, width, shift):  # type: ignore[no-untyped-def]
    """List the runs of all rows, ``(r, 2)`` int32 as in ComponentSet, and where each row's begin, ``(height + 1,)``."""
    height, words = bits.shape
    row_first = np.zeros(height + 1, np.int64)
    filled = _filled_rows(bits)
    run = np.empty((1024, 2), np.int32)
    n = 0
    for y in range(height):
        row_first[y + 1] = n
        if not filled[y]:
            continue
        start = -1  # of a run that reaches the end of the word before
        for k in range(words):
            word = bits[y, k]
            if not word and start < 0:
                continue
            if n + 64 > len(run):
                run = np.concatenate((run, np.empty_like(run)))
            at = (y << shift) + (k << WORD_SHIFT)
            if start >= 0:
                if word == _ALL:
                    continue
                place = lowest_bit(~word)
                run[n, 0], run[n, 1] = start, at + place
                n += 1
                start = -1
                word &= ~((np.uint64(1) << np.uint64(place)) - np.uint64(1))
            while word:
                begin = lowest_bit(word)
                beyond = ~(word >> np.uint64(begin))  # zeros shifted in: set
                length = lowest_bit(beyond) if beyond else 64
                if begin + length >= 64:
                    start = at + begin
                    break
                run[n, 0], run[n, 1] = at + begin, at + begin + length
                n += 1
                word &= ~(((np.uint64(1) << np.uint64(length)) - np.uint64(1)) << np.uint64(begin))
        if start >= 0:
            run[n, 0], run[n, 1] = start, (y << shift) + width
            n += 1
        row_first[y + 1] = n
    return run[:n], row_first


@njit(cache=True, nogil=True)
def _root(parent, k):  # type: ignore[no-untyped-def]
    while parent[k] != k:
        parent[k] = parent[parent[k]]
        k = parent[k]
    return k


@njit(cache=True, nogil=True)
def _join_runs(run, row_first, stride):  # type: ignore[no-untyped-def]
    """Return each run's component, numbered as they are met, ``(r,)`` int32, and how many there are."""
    parent = np.arange(len(run))
    for y in range(1, len(row_first) - 1):
        above, end = row_first[y - 1], row_first[y]
        for k in range(end, row_first[y + 1]):
            left, right = run[k, 0] - stride - 1, run[k, 1] - stride + 1  # 8-connected: one more on either side
            while above < end and run[above, 1] <= left:
                above += 1
            other = above
            while other < end and run[other, 0] < right:
                a, b = _root(parent, other), _root(parent, k)
                parent[max(a, b)] = min(a, b)
                other += 1
    number = np.empty(len(run), np.int32)
    m = 0
    for k in range(len(run)):
        if parent[k] == k:
            number[k] = m
            m += 1
        else:
            number[k] = number[_root(parent, k)]
    return number, m


@njit(cache=True, nogil=True)
def _find_components(bits, width, shift, planes, used, threshold, offset, label):  # type: ignore[no-untyped-def]
    """Join the runs of a set, sum each component up, label its pixels; return runs, first, sums, index."""
    found, row_first = _find_runs(bits, width, shift)
    number, m = _join_runs(found, row_first, 1 << shift)
    first, sums, index = np.zeros(m + 1, np.int64), np.zeros((m, 10), np.int64), np.zeros(m)
    sums[:, LEFT], sums[:, TOP] = width, len(bits)
    for k in range(len(found)):
        c, start, stop = number[k], np.int64(found[k, 0]), np.int64(found[k, 1])
        y = start >> shift
        left, right = start - (y << shift), stop - 1 - (y << shift)
        n, x_sum, xx_sum, seeds, index[c] = _sum_run(y, left, right, planes, used, threshold, offset, index[c])
        sums[c, AREA] += stop - start
        sums[c, SEEDS] += seeds
        sums[c, COUNT] += n
        sums[c, COUNT_X] += x_sum
        sums[c, COUNT_Y] += n * y
        sums[c, COUNT_RR] += xx_sum + n * y * y
        sums[c, LEFT], sums[c, RIGHT] = min(sums[c, LEFT], left), max(sums[c, RIGHT], right)
        sums[c, TOP], sums[c, BOTTOM] = min(sums[c, TOP], y), max(sums[c, BOTTOM], y)
        first[c + 1] += 1
        for p in range(start, stop):
            label[p] = c + 1
    for c in range(m):
        first[c + 1] += first[c]
        index[c] /= sums[c, AREA]
    end = first.copy()
    run = np.empty_like(found)
    for k in range(len(found)):
        at = end[number[k]]
        end[number[k]] += 1
        run[at, 0], run[at, 1] = found[k, 0], found[k, 1]
    return run, first, sums, index


@njit(cache=True, nogil=True)
def _sum_run(y, left, right, planes, used, threshold, offset, index_sum):  # type: ignore[no-untyped-def]
    """Return n, Σ n x, Σ n x² and the seeds of a run, and its component's index sum with the run's."""
    n_sum = x_sum = xx_sum = np.int64(0)
    seeds = 0
    for x in range(left, right + 1):
        off, on = pixel_counts(planes, used, y, x)
        n, base = on + off, offset + abs(on - off)
        n_sum += n
        x_sum += n * x
        xx_sum += n * x * x
        seeds += n >= threshold * base
        index_sum += n / base
    return n_sum, x_sum, xx_sum, seeds, index_sum
