"""Detection, the paper's section III, in plain numpy: routing, index images, components, blobs.

Every stage has the interface of the compiled one, whose place it takes in :class:`ReferenceDetector`; nothing is kept
from hop to hop but the events themselves.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.blobs import AS_ACTIVE, FRESH_EVENTS, FRESH_SHARE, SPREAD_EVENTS, Blob, BlobFinder
from beacon_comm.core.components import AREA, COUNT, COUNT_RR, COUNT_X, COUNT_Y, SEEDS
from beacon_comm.core.detection import Detector
from beacon_comm.core.errors import ParameterError
from beacon_comm.core.event_buffer import EventBuffer
from beacon_comm.core.events import EventBatch
from beacon_comm.core.hop_events import NOTHING_NEAR, NearEvents
from beacon_comm.core.index_image import hop_length_ns, window_hops
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.routing import Routed, RoutedEvents
from beacon_comm.core.tracks import Track, TrackChanges, positions_at


@dataclass(frozen=True, slots=True)
class ReferenceEvents:
    """Events of one hop: column, row, whether it is a rise, time (ns), whether a track got it; ``(n,)`` each."""

    x: NDArray[np.int64]
    y: NDArray[np.int64]
    on: NDArray[np.bool_]
    t_ns: NDArray[np.int64]
    routed: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.x)


def _joined(parts: Sequence[ReferenceEvents]) -> ReferenceEvents:
    empty = np.empty(0, np.int64)
    parts = [*parts, ReferenceEvents(empty, empty, empty > 0, empty, empty > 0)]
    return ReferenceEvents(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in ('x', 'y', 'on', 't_ns', 'routed'))
    )


class ReferenceRouter:
    """Every event to the nearest track whose circle holds it: one track after the other, all events at once."""

    near = NOTHING_NEAR

    def __init__(self, parameters: Parameters, sensor_size: tuple[int, int]) -> None:
        self._parameters = parameters
        self._size = sensor_size
        self._hop_ns = hop_length_ns(parameters)
        self._parts: list[ReferenceEvents] = []
        self.outside_events = 0
        self.aim((), 0)

    @property
    def gathered(self) -> int:
        """Events of the hop interval so far."""
        return sum(map(len, self._parts))

    def aim(self, tracks: Sequence[Track], t_hop_ns: int) -> None:
        """Route by ``tracks`` in the hop interval that begins at ``t_hop_ns`` (ns)."""
        p = self._parameters
        self._t_hop_ns = t_hop_ns
        self._track_ids = [track.track_id for track in tracks]
        now, then = positions_at(tracks, t_hop_ns), positions_at(tracks, t_hop_ns + self._hop_ns)
        self._centre, self._speed = now, (then - now) / self._hop_ns
        self._radius = np.array([track.extent_px for track in tracks]) * p.routing_extent_factor + p.routing_margin_px

    def route(self, segment: EventBatch) -> RoutedEvents:
        """Return the events of each track that got any, in order of the tracks' labels."""
        inside = (segment.x < self._size[0]) & (segment.y < self._size[1])
        self.outside_events += int((~inside).sum())
        x, y = segment.x[inside].astype(np.int64), segment.y[inside].astype(np.int64)
        t_ns, polarity = segment.t_ns[inside], segment.polarity[inside]
        owner, nearest2 = np.full(len(x), -1), np.full(len(x), np.inf)
        dt_ns = t_ns - self._t_hop_ns
        for k in range(len(self._track_ids)):
            dx = x - (self._centre[k, 0] + self._speed[k, 0] * dt_ns)
            dy = y - (self._centre[k, 1] + self._speed[k, 1] * dt_ns)
            distance2 = dx * dx + dy * dy
            nearer = (distance2 <= self._radius[k] ** 2) & (distance2 < nearest2)
            owner[nearer], nearest2[nearer] = k, distance2[nearer]
        self._parts.append(ReferenceEvents(x, y, polarity > 0, t_ns, owner >= 0))
        return RoutedEvents.of(
            {track_id: Routed(t_ns[owner == k], polarity[owner == k]) for k, track_id in enumerate(self._track_ids)}
        )

    def settle(self) -> None:
        """Tracks stay as they were at the last hop."""

    def close(self) -> ReferenceEvents:
        """Return the events gathered in the hop interval, and begin the next one."""
        events, self._parts = _joined(self._parts), []
        return events


@dataclass(slots=True)
class ReferenceWindow:
    """One sliding window: its length in hops, and the OFF and ON events of every pixel, ``(2, height, width)``."""

    hops: int
    counts: NDArray[np.int64]


class ReferenceImages:
    """The index images, each counted from scratch at every hop."""

    def __init__(self, parameters: Parameters, sensor_size: tuple[int, int]) -> None:
        self._size = sensor_size
        self.threshold = parameters.index_threshold
        nothing = np.zeros((2, *sensor_size[::-1]), np.int64)
        self.windows = [ReferenceWindow(hops, nothing) for hops in window_hops(parameters)]
        self._ring = deque([_joined([])] * self.windows[-1].hops, maxlen=self.windows[-1].hops)
        self.overflow_events = 0

    @property
    def empty(self) -> bool:
        """Whether no window holds any event."""
        return not any(map(len, self._ring))

    @property
    def newest(self) -> ReferenceEvents:
        """The events of the newest hop."""
        return self._ring[-1]

    def hop_events(self, window: ReferenceWindow) -> Sequence[ReferenceEvents]:
        """Return the hops in ``window``, oldest first."""
        return list(self._ring)[-window.hops :]

    def push(self, events: ReferenceEvents) -> None:
        """Move every window on by one hop that held ``events``."""
        self._ring.append(events)
        width, height = self._size
        for window in self.windows:
            seen = _joined(self.hop_events(window))
            place = (seen.on * height + seen.y) * width + seen.x
            window.counts = np.bincount(place, minlength=2 * height * width).reshape(2, height, width)

    def set_threshold(self, threshold: float) -> None:
        """Go on with another threshold."""
        self.threshold = threshold

    def take_off(self) -> bool:
        """Do nothing ahead of time, and say so."""
        return False


@dataclass(frozen=True, slots=True)
class ReferenceComponents:
    """Components of one window: label of each pixel, 0 for none, sums and mean index as in a ComponentSet."""

    label: NDArray[np.int64]
    sums: NDArray[np.int64]
    index: NDArray[np.float64]


def find_components(counts: NDArray[np.int64], threshold: float, parameters: Parameters) -> ReferenceComponents:
    """Return the components of an image of counts; see :mod:`beacon_comm.core.components`."""
    off, on = counts
    n, base = off + on, parameters.index_offset + np.abs(on - off)
    low = (n > 0) & (n >= threshold * parameters.index_grow_share * base)
    closed = _closed(low, parameters.closing_px)
    _, label = cv2.connectedComponents(closed.astype(np.uint8), connectivity=8)
    numbers, met_at = np.unique(label, return_index=True)
    order = np.zeros(len(numbers), np.int64)  # in the order in which a reader meets them
    order[np.argsort(np.where(numbers == 0, -1, met_at))] = np.arange(len(numbers))
    label = (order if numbers[0] == 0 else order + 1)[np.searchsorted(numbers, label)]
    y, x = np.nonzero(label)
    c, m = label[y, x] - 1, int(label.max())
    n, base = n[y, x], base[y, x]
    box = np.empty((m, 4), np.int64)
    for k, (extreme, values) in enumerate(((np.minimum, x), (np.maximum, x), (np.minimum, y), (np.maximum, y))):
        box[:, k] = max(label.shape) if extreme is np.minimum else 0
        extreme.at(box[:, k], c, values)
    weights = (np.ones_like(n), n >= threshold * base, n, n * x, n * y, n * (x * x + y * y))
    sums = [np.bincount(c, weight, m).astype(np.int64) for weight in weights]
    index = np.bincount(c, n / base, m) / sums[AREA]
    return ReferenceComponents(label, np.column_stack((*sums, box)), index)


def _closed(low: NDArray[np.bool_], side: int) -> NDArray[np.bool_]:
    """Close with a square: every pixel sets the ones around it; it stays where all around it are set then."""
    before, after = side // 2, side - 1 - side // 2
    height, width = low.shape
    ground = np.pad(low, side)
    dilated = np.zeros_like(low)
    for dy in range(-before, after + 1):
        for dx in range(-before, after + 1):
            dilated |= ground[side - dy : side - dy + height, side - dx : side - dx + width]
    ground = np.pad(dilated, side, constant_values=True)
    closed = np.ones_like(low)
    for dy in range(-before, after + 1):
        for dx in range(-before, after + 1):
            closed &= ground[side + dy : side + dy + height, side + dx : side + dx + width]
    return closed


class ReferenceBlobFinder(BlobFinder):
    """The blobs of two windows; what follows from the sums is in numpy there already."""

    def __init__(self, parameters: Parameters, sensor_size: tuple[int, int]) -> None:
        super().__init__(parameters, sensor_size)
        self.owner: NDArray[np.int64] = np.zeros(sensor_size[::-1], np.int64)  # type: ignore[assignment]
        self._t_start_ns = 0

    def find(  # type: ignore[override]
        self, images: ReferenceImages, t_hop_ns: int, near: NearEvents = NOTHING_NEAR
    ) -> list[Blob]:
        """Return the blobs at the hop that ends at ``t_hop_ns`` (ns); all of its events are looked at, whatever is near."""
        self._t_start_ns = t_hop_ns - self._hop_ns
        p = self._parameters
        self.owner = np.zeros_like(self.owner)
        if images.empty:
            return []
        sets = [find_components(window.counts, images.threshold, p) for window in images.windows]
        stands = [
            (s.sums[:, SEEDS] > 0) & (s.sums[:, AREA] >= p.min_area_px) & (s.sums[:, AREA] <= p.max_area_px)
            for s in sets
        ]
        if len(sets) > 1:
            self._let_stand(sets, stands, images.windows[0].counts.sum(axis=0))
        short = sets[0]
        self.owner[np.append(False, short.sums[:, AREA] > p.max_area_px)[short.label]] = -1
        standing = [np.flatnonzero(which) for which in stands]
        number = 0
        for s, chosen in zip(sets, standing, strict=True):
            for c in chosen:
                number += 1
                self.owner[s.label == c + 1] = number
        if not number:
            return []
        window = np.repeat(np.arange(len(sets)), [len(chosen) for chosen in standing])
        sums = np.concatenate([s.sums[c] for s, c in zip(sets, standing, strict=True)])
        index = np.concatenate([s.index[c] for s, c in zip(sets, standing, strict=True)])
        return self._observe(window, sums, index, images.newest, t_hop_ns)

    def _let_stand(
        self, sets: list[ReferenceComponents], stands: list[NDArray[np.bool_]], short_n: NDArray[np.int64]
    ) -> None:
        """Let one component stand where both windows have one; ``short_n``: events of the short window."""
        short, long = sets
        inside = long.label > 0
        c, m = long.label[inside] - 1, len(long.index)
        within, n = np.append(False, stands[0])[short.label][inside], short_n[inside]
        area_in, area_out = np.bincount(c, within, m), np.bincount(c, ~within, m)
        count_in, count_out = np.bincount(c, within * n, m), np.bincount(c, ~within * n, m)
        partial = (area_out > area_in) & (count_out * area_in >= AS_ACTIVE * count_in * area_out)
        stands[1] &= (area_in == 0) | partial
        covered = np.append(False, stands[1])[long.label]
        stands[0][short.label[covered & (short.label > 0)] - 1] = False

    def _observe(  # type: ignore[override]
        self,
        window: NDArray[np.int64],
        sums: NDArray[np.int64],
        index: NDArray[np.float64],
        newest: ReferenceEvents,
        t_hop_ns: int,
    ) -> list[Blob]:
        length = self._length[window]
        x, y, extent = _centre_and_extent(*(sums[:, k] for k in (COUNT, COUNT_X, COUNT_Y, COUNT_RR)))
        n, sum_x, sum_y, sum_rr, sum_t = self._sum_newest(x, y, extent, newest).T
        new_x, new_y, spread = _centre_and_extent(np.maximum(n, 1), sum_x, sum_y, sum_rr)
        fresh = n >= np.maximum(FRESH_EVENTS, FRESH_SHARE * sums[:, COUNT] / length)
        new_t = t_hop_ns - self._hop_ns + sum_t // np.maximum(n, 1)
        t_ns = np.where(fresh, new_t, t_hop_ns - length * self._hop_ns // 2)
        x, y = np.where(fresh, new_x, x), np.where(fresh, new_y, y)
        extent = np.where(fresh & (n >= SPREAD_EVENTS), np.minimum(extent, spread), extent)
        columns = (x, y, t_ns, extent, index, sums[:, COUNT], sums[:, AREA], n, fresh, window)
        return [Blob(*row) for row in zip(*(column.tolist() for column in columns), strict=True)]

    def _sum_newest(self, x: NDArray, y: NDArray, extent: NDArray, newest: ReferenceEvents) -> NDArray[np.int64]:
        """Return n, Σx, Σy, Σ(x² + y²), Σ(t - hop's begin) of each blob's newest events, ``(m, 5)``."""
        p = self._parameters
        owner = self.owner[newest.y, newest.x] - 1
        free = np.flatnonzero(owner == -1)
        nearest2 = np.full(len(free), np.inf)
        radius = extent * p.routing_extent_factor + p.routing_margin_px
        for k in range(len(x)):
            distance2 = (newest.x[free] - x[k]) ** 2 + (newest.y[free] - y[k]) ** 2
            nearer = (distance2 <= radius[k] ** 2) & (distance2 < nearest2)
            owner[free[nearer]], nearest2[nearer] = k, distance2[nearer]
        of = owner >= 0
        ex, ey, dt_ns = newest.x[of], newest.y[of], newest.t_ns[of] - self._t_start_ns
        weights = (np.ones_like(ex), ex, ey, ex * ex + ey * ey, dt_ns)
        return np.column_stack([np.bincount(owner[of], weight, len(x)).astype(np.int64) for weight in weights])


def _centre_and_extent(n: NDArray, sum_x: NDArray, sum_y: NDArray, sum_rr: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Return centres and extents (px) of n events by their Σx, Σy, Σ(x² + y²), all ``(m,)``."""
    x, y = sum_x / n, sum_y / n
    return x, y, np.sqrt(2.0 * np.maximum(sum_rr / n - x * x - y * y, 0.0))


class ReferenceDetector(Detector):
    """The detector with every stage in plain numpy; for ``tracker: nearest`` only.

    Raises:
        ParameterError: another tracker.
    """

    def __init__(self, parameters: Parameters, sensor_size: tuple[int, int]) -> None:
        if parameters.tracker != 'nearest':
            raise ParameterError(f"tracker = {parameters.tracker!r}: the reference chain has 'nearest' only")
        super().__init__(parameters, sensor_size)

    def _start(self, sensor_size: tuple[int, int]) -> None:
        super()._start(sensor_size)
        p = self._parameters
        self._images: ReferenceImages = ReferenceImages(p, sensor_size)  # type: ignore[assignment]
        self._blobs: ReferenceBlobFinder = ReferenceBlobFinder(p, sensor_size)
        self._router: ReferenceRouter = ReferenceRouter(p, sensor_size)  # type: ignore[assignment]

    def _begin_buffers(self, blobs: list[Blob], changes: TrackChanges) -> None:
        """Begin each new track's buffer with the events on its blob's pixels that are in the blob's window."""
        for b, track in zip(changes.new_blobs, changes.new, strict=True):
            buffer = self._buffers[track.track_id] = EventBuffer(self._buffer_ns, self._parameters.buffer_max_bytes)
            seen = _joined(self._images.hop_events(self._images.windows[blobs[b].window]))
            of = np.flatnonzero((self._blobs.owner[seen.y, seen.x] == b + 1) & ~seen.routed)
            of = of[np.argsort(seen.t_ns[of], kind='stable')]
            buffer.append(seen.t_ns[of], np.where(seen.on[of], 1, -1).astype(np.int8))
