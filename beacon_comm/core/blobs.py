"""Blobs: connected high-index pixels of either window, each observed by the newest hop's events.

    short window ─► components ─┐
                                ├─► one blob where they overlap ─► owner image ─► newest events of each
    long window ──► components ─┘

Of two components that overlap, the short window's is the blob; the long window's is when the short window sees but
a part of it: its other pixels are about as active now as those that the short window sees.  (What a moving blob
leaves behind in the long window is not active now; a slow beacon is, all over.)

The position is the mean of the newest hop's events at their mean time: the mean of a uniform motion over any set of
times is its position at their mean, so nothing lags behind.  Events on a blob's pixels are its own, events on no
blob's pixels belong to the nearest centre within extent × routing_extent_factor + routing_margin_px: they hold the
leading edge of a moving blob, whose pixels have not gathered enough events yet.  The extent is that of these events,
too, if they are spread less than all events on the blob's pixels, which a moving blob's trail stretches.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from beacon_comm.core.components import (
    AREA,
    BOTTOM,
    COUNT,
    COUNT_RR,
    COUNT_X,
    COUNT_Y,
    LEFT,
    RIGHT,
    SEEDS,
    TOP,
    ComponentFinder,
    ComponentSet,
    paint,
)  # fmt: skip
from beacon_comm.core.hop_events import CODE_BITS, NOTHING_NEAR, HopEvents, NearEvents, PixelGrid
from beacon_comm.core.index_image import IndexImages, Window, hop_length_ns, pixel_counts, window_hops
from beacon_comm.core.nearest import CELL_SHIFT, cells_along, cells_with_members, events_in, list_cells
from beacon_comm.core.parameters import Parameters

FRESH_EVENTS = 4  # fewer new events say nothing about the position …
FRESH_SHARE = 0.1  # … nor does less than this share of its mean: a held LED in front of a moving background
SPREAD_EVENTS = 30  # fewer events say nothing about the extent
AS_ACTIVE = 0.5  # share of the events a pixel that makes another pixel "about as active"


@dataclass(slots=True)
class Blob:
    """One blob at one hop.

    Attributes:
        x_px, y_px: centre (px; pixel centres are whole numbers), the mean of events around ``t_ns``.
        t_ns: time of the observation (ns): the mean time of the newest hop's events if it is fresh, else the
            middle of the window.
        extent_px: radius (px) of the uniform disc with the same spread of events, sqrt(2 (σx² + σy²)).
        index: mean of I over its pixels.
        event_count: events on its pixels in the window.
        area_px: its pixels.
        fresh_count: events of the newest hop.
        fresh: whether these are enough for an observation.
        window: which window it was seen in, 0: short.
    """

    x_px: float
    y_px: float
    t_ns: int
    extent_px: float
    index: float
    event_count: int
    area_px: int
    fresh_count: int
    fresh: bool
    window: int

    @property
    def variance_px2(self) -> float:
        """Variance of the centre (px²), one axis: that of the mean of events spread over a disc."""
        return self.extent_px**2 / (4.0 * max(1, self.fresh_count if self.fresh else self.event_count))

    def fills(self, share: float) -> bool:
        """Return whether its pixels are at least this share of the disc with the spread of its events, as far as that is known.

        A light does, even one that moves: its newest events are together.  Edges of a texture that touch one another do not.
        """
        return not self.fresh or self.fresh_count < SPREAD_EVENTS or self.area_px >= share * math.pi * self.extent_px**2


class BlobFinder:
    """Finds the blobs of one sensor.

    Args:
        parameters: those under "Detection", ``routing_extent_factor``, ``routing_margin_px``.
        sensor_size: width and height (px).

    Attributes:
        owner: for every pixel number, 1 + the number of the blob in the last :meth:`find`'s list that it is of,
            0 for none, -1 for a component that is too large, int32.
        box: of each of these blobs: left, right, top, bottom (px, inclusive), ``(m, 4)`` float64.
    """

    def __init__(self, parameters: Parameters, sensor_size: tuple[int, int]) -> None:
        self._parameters = parameters
        self._grid = PixelGrid(*sensor_size)
        self._hop_ns = hop_length_ns(parameters)
        self._length = np.array(window_hops(parameters))
        self._finders = [ComponentFinder(parameters, self._grid) for _ in range(2)]
        self._sets: list[ComponentSet] = []
        self.owner = np.zeros(self._grid.numbers, np.int32)
        self.box = np.empty((0, 4))

    def find(self, images: IndexImages, t_hop_ns: int, near: NearEvents = NOTHING_NEAR) -> list[Blob]:
        """Return the blobs at the hop that ends at ``t_hop_ns`` (ns).

        Args:
            images: at that hop.
            t_hop_ns: its end (ns).
            near: what is known of its events near tracks.
        """
        for components in self._sets:
            paint(components.run, self.owner, 0)
        self._sets, self.box = [], np.empty((0, 4))
        if images.empty:
            return []
        self._sets = [f.find(window, images.threshold) for f, window in zip(self._finders, images.windows, strict=False)]
        window, sums, index = self._choose(images.windows)
        if len(window) == 0:
            return []
        self.box = sums[:, LEFT : BOTTOM + 1].astype(np.float64)
        return self._observe(window, sums, index, images.newest, near, t_hop_ns)

    def _choose(self, windows: list[Window]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
        """Let the components that stand as blobs own their pixels; return of each its window, sums and index."""
        p = self._parameters
        short, long = self._sets[0], self._sets[-1]
        window, sums, index = _choose(
            (short.run, short.first, short.sums, short.index), (long.run, long.first, long.sums, long.index),
            len(self._sets) > 1, p.min_area_px, p.max_area_px, short.label, windows[0].planes, windows[0].used,
            self._grid.shift, self.owner,
        )  # fmt: skip
        return window, sums, index

    def _observe(
        self,
        window: NDArray[np.int64],
        sums: NDArray[np.int64],
        index: NDArray[np.float64],
        newest: HopEvents,
        near: NearEvents,
        t_hop_ns: int,
    ) -> list[Blob]:
        """Observe the components that stand; see the module's head.

        Args:
            window, sums, index: of each, as in :class:`Blob` and :class:`ComponentSet`.
            newest, near: the newest hop's events.
            t_hop_ns: its end (ns).
        """
        p = self._parameters
        seen = _observe(
            window, sums, self._length, newest.code, newest.offset_ns, near.events, near.cells,
            (self._grid.width, self._grid.height, self._grid.shift), p.routing_extent_factor, p.routing_margin_px, self._hop_ns,
            self.owner,
        )  # fmt: skip
        return [
            Blob(x, y, t_hop_ns - int(ago_ns), extent, i, of[COUNT], of[AREA], int(n), fresh > 0.0, w)
            for (x, y, ago_ns, extent, n, fresh), i, of, w in zip(
                seen.tolist(), index.tolist(), sums.tolist(), window.tolist(), strict=True
            )
        ]


@njit(cache=True, nogil=True)
def _choose(  # type: ignore[no-untyped-def]
    short, long, has_long, min_area, max_area, short_label, planes, used, shift, owner
):
    """Compile :meth:`BlobFinder._choose`; ``short``, ``long``: runs, their begins, sums and indices; ``planes``, ``used``: the
    short window's."""
    run, first, sums, index = short
    stands, long_stands = _fit(sums, min_area, max_area), np.zeros(0, np.bool_)
    if has_long:
        fits = _fit(long[2], min_area, max_area)
        long_stands = fits & _long_stands(long[0], long[1], fits, short_label, stands, planes, used, shift)
    count = stands.sum() + long_stands.sum()
    of, its_sums, its_index = np.empty(count, np.int64), np.empty((count, sums.shape[1]), np.int64), np.empty(count)
    blobs = 0
    for c in range(len(sums)):
        if stands[c]:
            of[blobs], its_sums[blobs], its_index[blobs] = 0, sums[c], index[c]
            blobs += 1
            paint(run[first[c] : first[c + 1]], owner, blobs)
        elif sums[c, AREA] > max_area:
            paint(run[first[c] : first[c + 1]], owner, -1)
    for c in range(len(long_stands)):
        if long_stands[c]:
            of[blobs], its_sums[blobs], its_index[blobs] = 1, long[2][c], long[3][c]
            blobs += 1
            paint(long[0][long[1][c] : long[1][c + 1]], owner, blobs)
    return of, its_sums, its_index


@njit(cache=True, nogil=True)
def _fit(sums, min_area, max_area):  # type: ignore[no-untyped-def]
    """Return which components have a seed and a size that blobs may have."""
    return (sums[:, SEEDS] > 0) & (sums[:, AREA] >= min_area) & (sums[:, AREA] <= max_area)


@njit(cache=True, nogil=True)
def _centre_and_extent(n, sum_x, sum_y, sum_rr):  # type: ignore[no-untyped-def]
    """Return centre and extent (px) of n events by their Σx, Σy, Σ(x² + y²)."""
    x, y = sum_x / n, sum_y / n
    # Coordinates below 2¹⁶: the difference of squares is good to 10⁻⁵ px².
    return x, y, np.sqrt(2.0 * max(sum_rr / n - x * x - y * y, 0.0))


@njit(cache=True, nogil=True)
def _observe(  # type: ignore[no-untyped-def]
    window, sums, length, code, offset_ns, near, near_cells, grid, factor, margin, hop_ns, owner
):
    """Return centre (px), time before the hop's end (ns), extent (px), newest events, whether these are fresh: ``(m, 6)``."""
    seen, circle, box = np.empty((len(sums), 6)), np.empty((len(sums), 3)), np.empty((len(sums), 4))
    for b in range(len(sums)):
        x, y, extent = _centre_and_extent(sums[b, COUNT], sums[b, COUNT_X], sums[b, COUNT_Y], sums[b, COUNT_RR])
        radius = extent * factor + margin
        circle[b, 0], circle[b, 1], circle[b, 2] = x, y, radius**2
        box[b, 0], box[b, 1] = min(sums[b, LEFT], x - radius), max(sums[b, RIGHT], x + radius)
        box[b, 2], box[b, 3] = min(sums[b, TOP], y - radius), max(sums[b, BOTTOM], y + radius)
        seen[b, 0], seen[b, 1], seen[b, 3] = x, y, extent
    width, height, shift = grid
    across, down = cells_along(width), cells_along(height)
    first, member = list_cells(box, width, height, across, down)
    wanted = cells_with_members(first)
    if _has_all(near_cells, wanted):
        code, offset_ns = near[0], near[1]
    else:
        events = events_in(wanted, across, code, shift)
        code, offset_ns = code[events], offset_ns[events]
    newest = _sum_newest(code, offset_ns, shift, across, first, member, circle, owner)
    for b in range(len(sums)):
        n, hops = newest[b, 0], length[window[b]]
        fresh = n >= max(FRESH_EVENTS, FRESH_SHARE * sums[b, COUNT] / hops)
        seen[b, 2], seen[b, 4], seen[b, 5] = hops * hop_ns // 2, n, fresh
        if fresh:
            x, y, spread = _centre_and_extent(n, newest[b, 1], newest[b, 2], newest[b, 3])
            seen[b, 0], seen[b, 1], seen[b, 2] = x, y, hop_ns - newest[b, 4] // n
            if n >= SPREAD_EVENTS:
                seen[b, 3] = min(seen[b, 3], spread)
    return seen


@njit(cache=True, nogil=True)
def _long_stands(run, first, fits, short_label, short_fits, planes, used, shift):  # type: ignore[no-untyped-def]
    """Return which components of the long window stand; the short ones they stand for stop standing.

    ``planes``, ``used``: of the short window.
    """
    stands = np.zeros(len(fits), np.bool_)
    for c in range(len(fits)):
        if not fits[c]:
            continue
        area_in = area_out = 0
        count_in = count_out = np.int64(0)
        for k in range(first[c], first[c + 1]):
            y = run[k, 0] >> shift
            for p in range(run[k, 0], run[k, 1]):
                off, on = pixel_counts(planes, used, y, p - (y << shift))
                n = off + on
                s = short_label[p] - 1
                if s >= 0 and short_fits[s]:
                    area_in += 1
                    count_in += n
                else:
                    area_out += 1
                    count_out += n
        partial = area_out > area_in and count_out * area_in >= AS_ACTIVE * count_in * area_out
        stands[c] = area_in == 0 or partial
    for c in range(len(fits)):
        if stands[c]:
            for k in range(first[c], first[c + 1]):
                for p in range(run[k, 0], run[k, 1]):
                    s = short_label[p] - 1
                    if s >= 0:
                        short_fits[s] = False
    return stands


@njit(cache=True, nogil=True)
def _has_all(cells, wanted):  # type: ignore[no-untyped-def]
    """Return whether all cells that are wanted are among these."""
    missing = np.uint8(len(cells) < len(wanted))
    for cell in range(min(len(cells), len(wanted))):
        missing |= wanted[cell] & ~cells[cell]
    return missing == 0


@njit(cache=True, nogil=True)
def _sum_newest(code, offset_ns, shift, cells_across, first, member, circle, owner):  # type: ignore[no-untyped-def]
    """Return n, Σx, Σy, Σ(x² + y²), Σ(t - hop's begin) of each blob's newest events, ``(m, 5)`` int64.

    The events: all that lie in cells with members, and perhaps others.
    """
    sums = np.zeros((len(circle), 5), np.int64)
    for event in range(len(code)):
        p = np.int64(code[event] >> np.uint32(CODE_BITS))
        y = p >> shift
        x = p - (y << shift)
        b = np.int64(owner[p]) - 1
        if b == -1:
            cell = np.uint64((y >> CELL_SHIFT) * cells_across + (x >> CELL_SHIFT))
            nearest2 = np.inf
            for k in range(np.uint64(first[cell]), np.uint64(first[cell + np.uint64(1)])):
                m = np.uint64(member[k])
                dx, dy = x - circle[m, 0], y - circle[m, 1]
                d2 = dx * dx + dy * dy
                if d2 <= circle[m, 2] and d2 < nearest2:
                    nearest2 = d2
                    b = np.int64(m)
        if b >= 0:
            sums[b, 0] += 1
            sums[b, 1] += x
            sums[b, 2] += y
            sums[b, 3] += x * x + y * y
            sums[b, 4] += offset_ns[event]
    return sums
