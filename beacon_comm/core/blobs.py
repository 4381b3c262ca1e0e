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
)  # fmt: skip
from beacon_comm.core.index_image import HopEvents, IndexImages, Window, hop_length_ns
from beacon_comm.core.nearest import CELL_SHIFT, cell_lists, cells_along
from beacon_comm.core.parameters import Parameters

_FRESH_EVENTS = 4  # fewer new events say nothing about the position …
_SPREAD_EVENTS = 30  # … and fewer nothing about the extent
_MOMENTS = [COUNT, COUNT_X, COUNT_Y, COUNT_RR]
_AS_ACTIVE = 0.5  # share of the events a pixel that makes another pixel "about as active"


@dataclass(frozen=True, slots=True)
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
    window: int

    @property
    def fresh(self) -> bool:
        """Whether the newest hop held enough events of it for an observation."""
        return self.fresh_count >= _FRESH_EVENTS

    @property
    def variance_px2(self) -> float:
        """Variance of the centre (px²), one axis: that of the mean of events spread over a disc."""
        return self.extent_px**2 / (4.0 * max(1, self.fresh_count if self.fresh else self.event_count))


@dataclass(frozen=True, slots=True)
class _Seen:
    """A component that stands as a blob."""

    window: int
    component: int
    x_px: float
    y_px: float
    extent_px: float


class BlobFinder:
    """Finds the blobs of one sensor.

    Args:
        parameters: those under "Detection", ``routing_extent_factor``, ``routing_margin_px``.
        sensor_size: width and height (px).

    Attributes:
        owner: for every pixel, 1 + the number of the blob in the last :meth:`find`'s list that it is of,
            0 for none, -1 for a component that is too large, ``(height width,)`` int32.
    """

    def __init__(self, parameters: Parameters, sensor_size: tuple[int, int]) -> None:
        self._parameters = parameters
        self._size = sensor_size
        self._hop_ns = hop_length_ns(parameters)
        self._finders = [ComponentFinder(parameters, sensor_size) for _ in range(2)]
        self.owner = np.zeros(sensor_size[0] * sensor_size[1], np.int32)
        self._owned: list[NDArray[np.int32]] = []

    def find(self, images: IndexImages, t_hop_ns: int) -> list[Blob]:
        """Return the blobs at the hop that ends at ``t_hop_ns`` (ns)."""
        for pixels in self._owned:
            self.owner[pixels] = 0
        self._owned = []
        if images.empty:
            return []
        sets = [finder.find(window) for finder, window in zip(self._finders, images.windows, strict=False)]
        seen = self._choose(sets, images.windows)
        if not seen:
            return []
        for number, blob in enumerate(seen, 1):
            self._own(sets[blob.window].pixels_of(blob.component), number)
        sums = self._observe(seen, sets, images.newest, t_hop_ns - self._hop_ns)
        return [
            self._blob(blob, sets[blob.window], sums[k], t_hop_ns, images.windows[blob.window].hops)
            for k, blob in enumerate(seen)
        ]

    def _choose(self, sets: list[ComponentSet], windows: list[Window]) -> list[_Seen]:
        """Return the components that stand as blobs: the short window's first."""
        standing = [self._fits(components) for components in sets]
        for component in np.flatnonzero(sets[0].sums[:, AREA] > self._parameters.max_area_px):
            self._own(sets[0].pixels_of(int(component)), -1)
        if len(sets) > 1:
            stands = _long_stands(
                sets[1].pixel, sets[1].first, standing[1], sets[0].label, standing[0], windows[0].counts
            )
            standing[1] &= stands
        return [
            _Seen(w, int(c), *_centre_and_extent(*(int(v) for v in sets[w].sums[c, _MOMENTS])))
            for w in range(len(sets))
            for c in np.flatnonzero(standing[w])
        ]

    def _fits(self, components: ComponentSet) -> NDArray[np.bool_]:
        area = components.sums[:, AREA]
        p = self._parameters
        fits: NDArray[np.bool_] = (
            (components.sums[:, SEEDS] > 0) & (area >= p.min_area_px) & (area <= p.max_area_px)
        )
        return fits

    def _own(self, pixels: NDArray[np.int32], number: int) -> None:
        pixels = pixels.copy()
        self.owner[pixels] = number
        self._owned.append(pixels)

    def _observe(
        self, seen: list[_Seen], sets: list[ComponentSet], newest: HopEvents, t_start_ns: int
    ) -> NDArray[np.int64]:
        """Return for each blob the number of the newest events and the sums of their x, y, t - start, x² + y²."""
        p = self._parameters
        width, height = self._size
        circle = np.array([(blob.x_px, blob.y_px, blob.extent_px) for blob in seen])
        circle[:, 2] = circle[:, 2] * p.routing_extent_factor + p.routing_margin_px
        box = np.array([sets[b.window].sums[b.component, [LEFT, RIGHT, TOP, BOTTOM]] for b in seen], np.float64)
        box[:, 0] = np.minimum(box[:, 0], circle[:, 0] - circle[:, 2])
        box[:, 1] = np.maximum(box[:, 1], circle[:, 0] + circle[:, 2])
        box[:, 2] = np.minimum(box[:, 2], circle[:, 1] - circle[:, 2])
        box[:, 3] = np.maximum(box[:, 3], circle[:, 1] + circle[:, 2])
        first, member = cell_lists(box, width, height)
        sums: NDArray[np.int64] = _sum_newest(
            newest.word, newest.t_ns, t_start_ns, width, cells_along(width), first, member, circle, self.owner
        )
        return sums

    def _blob(
        self, seen: _Seen, components: ComponentSet, sums: NDArray[np.int64], t_hop_ns: int, hops: int
    ) -> Blob:
        c = seen.component
        x, y, extent, t = seen.x_px, seen.y_px, seen.extent_px, t_hop_ns - hops * self._hop_ns // 2
        n, sum_x, sum_y, sum_t, sum_rr = (int(value) for value in sums)
        if n >= _FRESH_EVENTS:
            x, y, spread = _centre_and_extent(n, sum_x, sum_y, sum_rr)
            extent = min(extent, spread) if n >= _SPREAD_EVENTS else extent
            t = t_hop_ns - self._hop_ns + sum_t // n
        count, area = int(components.sums[c, COUNT]), int(components.sums[c, AREA])
        return Blob(x, y, t, extent, float(components.index[c]), count, area, n, seen.window)


def _centre_and_extent(n: int, sum_x: int, sum_y: int, sum_rr: int) -> tuple[float, float, float]:
    """Return the centre and the extent (px) of n events by their Σx, Σy, Σ(x² + y²)."""
    # Exact until the division: the sums are whole numbers, their difference may be small against them.
    spread2 = (n * sum_rr - sum_x**2 - sum_y**2) / n**2
    return sum_x / n, sum_y / n, math.sqrt(2.0 * spread2)


@njit(cache=True, nogil=True)
def _long_stands(pixel, first, fits, short_label, short_fits, short_counts):  # type: ignore[no-untyped-def]
    """Return which components of the long window stand; the short ones they stand for stop standing."""
    stands = np.zeros(len(fits), np.bool_)
    for c in range(len(fits)):
        if not fits[c]:
            continue
        area_in = area_out = count_in = count_out = 0
        for k in range(first[c], first[c + 1]):
            p = pixel[k]
            n = int(short_counts[2 * p] + short_counts[2 * p + 1])
            s = short_label[p] - 1
            if s >= 0 and short_fits[s]:
                area_in += 1
                count_in += n
            else:
                area_out += 1
                count_out += n
        partial = area_out > area_in and count_out * area_in >= _AS_ACTIVE * count_in * area_out
        stands[c] = area_in == 0 or partial
    for c in range(len(fits)):
        if stands[c]:
            for k in range(first[c], first[c + 1]):
                s = short_label[pixel[k]] - 1
                if s >= 0:
                    short_fits[s] = False
    return stands


@njit(cache=True, nogil=True)
def _sum_newest(  # type: ignore[no-untyped-def]
    word, t_ns, t_start_ns, width, cells_across, first, member, circle, owner
):
    """Sum up the newest events of each blob: ``(m, 5)`` int64 of n, Σx, Σy, Σ(t - t_start), Σ(x² + y²)."""
    sums = np.zeros((len(circle), 5), np.int64)
    for i in range(len(word)):
        x = np.int64((word[i] >> 2) & 0x3FFF)
        y = np.int64(word[i] >> 16)
        cell = (y >> CELL_SHIFT) * cells_across + (x >> CELL_SHIFT)
        if first[cell] == first[cell + 1]:
            continue
        b = np.int64(owner[y * width + x]) - 1
        if b == -1:
            nearest2 = np.inf
            for k in range(first[cell], first[cell + 1]):
                m = member[k]
                d2 = (x - circle[m, 0]) ** 2 + (y - circle[m, 1]) ** 2
                if d2 <= circle[m, 2] ** 2 and d2 < nearest2:
                    nearest2 = d2
                    b = m
        if b >= 0:
            sums[b, 0] += 1
            sums[b, 1] += x
            sums[b, 2] += y
            sums[b, 3] += t_ns[i] - t_start_ns
            sums[b, 4] += x * x + y * y
    return sums
