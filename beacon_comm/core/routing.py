"""Routing: every event to at most one track.

An event is of the nearest track whose circle holds it; circle and track are predicted to the event's own time:

    distance(event, centre(t)) <= extent × routing_extent_factor + routing_margin_px

The tracks as they stood at the last hop decide until the next one.  Centres move on a straight line in between.
The routed events are sorted by track, stably, into one array:

    t_ns, polarity   [ events of track a | of track b | … ]        each in order of time

Hundreds of tracks may have a few events each in a packet: nothing is done for each of them but what somebody asks for.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from beacon_comm.core.events import EventBatch
from beacon_comm.core.hop_events import CODE_BITS, NOTHING_NEAR, ROUTED, HopCounts, HopEvents, NearEvents, PixelGrid
from beacon_comm.core.index_image import hop_length_ns
from beacon_comm.core.nearest import CELL_SHIFT, cell_lists, cells_along, cells_with_members
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.tracks import Track, positions_at

_FIRST_ROOM, _MORE_ROOM = 4096, 1.25
_HANDED_OVER = 0.75  # a room that is filled by this share is handed over as it is, else what is in it


class Routed(NamedTuple):
    """Events of one track.

    Attributes:
        t_ns: sensor time (ns), ``(n,)`` int64.
        polarity: ±1, ``(n,)`` int8.
    """

    t_ns: NDArray[np.int64]
    polarity: NDArray[np.int8]


class RoutedEvents(Mapping[int, Routed]):
    """The events of each track that got any, by its label.

    Args:
        place: of each track by its label, in order.
        t_ns, polarity: sorted by track, as in :class:`Routed`.
        stops: where each track's events end, ``(tracks,)`` int64.
    """

    __slots__ = ('_place', '_polarity', '_stops', '_t_ns')

    def __init__(
        self, place: Mapping[int, int], t_ns: NDArray[np.int64], polarity: NDArray[np.int8], stops: NDArray[np.int64]
    ) -> None:
        self._place = place
        self._t_ns = t_ns
        self._polarity = polarity
        self._stops = stops

    @classmethod
    def of(cls, parts: Mapping[int, Routed]) -> RoutedEvents:
        """Return what was routed to each track, which may be nothing."""
        stops = np.cumsum([len(part.t_ns) for part in parts.values()], dtype=np.int64)
        t_ns = np.concatenate([np.empty(0, np.int64), *(part.t_ns for part in parts.values())])
        polarity = np.concatenate([np.empty(0, np.int8), *(part.polarity for part in parts.values())])
        return cls({track_id: k for k, track_id in enumerate(parts)}, t_ns, polarity, stops)

    @classmethod
    def joined(cls, parts: Sequence[RoutedEvents]) -> RoutedEvents:
        """Return what was routed in some parts of a hop interval, one after the other; at least one."""
        if len(parts) == 1:
            return parts[0]
        t_ns = np.concatenate([part._t_ns for part in parts])
        polarity = np.concatenate([part._polarity for part in parts])
        return cls(parts[0]._place, *_join(np.array([part._stops for part in parts]), t_ns, polarity))

    @property
    def count(self) -> int:
        """How many events there are."""
        return len(self._t_ns)

    def of_track(self, track_id: int) -> Routed | None:
        """Return the events of a track, None if it got none."""
        k = self._place.get(track_id)
        if k is None:
            return None
        start, stop = self._stops[k - 1] if k else 0, self._stops[k]
        return Routed(self._t_ns[start:stop], self._polarity[start:stop]) if start < stop else None

    def __getitem__(self, track_id: int) -> Routed:
        routed = self.of_track(track_id)
        if routed is None:
            raise KeyError(track_id)
        return routed

    def __iter__(self) -> Iterator[int]:
        return (track_id for track_id, _ in self.by_track())

    def __len__(self) -> int:
        return int(np.count_nonzero(np.diff(self._stops, prepend=0)))

    def by_track(self) -> Iterator[tuple[int, Routed]]:
        """Yield what :meth:`items` does; that would look every label up."""
        start = 0
        for track_id, stop in zip(self._place, self._stops.tolist(), strict=True):
            if stop > start:
                yield track_id, Routed(self._t_ns[start:stop], self._polarity[start:stop])
            start = stop


NOTHING_ROUTED = RoutedEvents.of({})


def places(tracks: Sequence[Track]) -> dict[int, int]:
    """Return the place of each track by its label."""
    return {track.track_id: k for k, track in enumerate(tracks)}


class Router:
    """Routes the events of a hop interval, and gathers them for the detection windows.

    Args:
        parameters: ``routing_extent_factor``, ``routing_margin_px``, ``hop_s``.
        sensor_size: width and height (px).

    Attributes:
        outside_events: events beyond the sensor's borders, which are dropped.
    """

    def __init__(self, parameters: Parameters, sensor_size: tuple[int, int]) -> None:
        self._grid = PixelGrid(*sensor_size)
        self._hop_ns = hop_length_ns(parameters)
        self._factor, self._margin = parameters.routing_extent_factor, parameters.routing_margin_px
        self._code, self._offset_ns = np.empty(_FIRST_ROOM, np.uint32), np.empty(_FIRST_ROOM, np.uint32)
        self._index, self._owner = np.empty(_FIRST_ROOM, np.int32), np.empty(_FIRST_ROOM, np.int32)
        self._counts = HopCounts(self._grid)
        self._gathered = 0
        self.outside_events = 0
        self.aim((), 0)

    @property
    def gathered(self) -> int:
        """Events of the hop interval so far."""
        return self._gathered

    def aim(self, tracks: Sequence[Track], t_hop_ns: int) -> None:
        """Route by ``tracks`` in the hop interval that begins at ``t_hop_ns`` (ns)."""
        self._place = places(tracks)
        self._t_hop_ns = t_hop_ns
        now, then = positions_at(tracks, t_hop_ns), positions_at(tracks, t_hop_ns + self._hop_ns)
        radius = np.array([track.extent_px for track in tracks]) * self._factor + self._margin
        circle = np.column_stack((now, (then - now) / self._hop_ns, radius**2))
        low, high = np.minimum(now, then) - radius[:, None], np.maximum(now, then) + radius[:, None]
        box = np.column_stack((low[:, 0], high[:, 0], low[:, 1], high[:, 1]))
        self._circle = circle
        self._first, self._member = cell_lists(box, self._grid.width, self._grid.height)

    def route(self, segment: EventBatch) -> RoutedEvents:
        """Return the events of each track that got any, in order of the tracks' labels."""
        if len(segment) == 0:
            return NOTHING_ROUTED
        start = self._gathered
        if not self._pack(segment):
            segment = self._on_sensor(segment)
            self._pack(segment)
        n = len(segment)
        code = self._code[start : start + n]
        routed = self._own(segment, code) if self._place else NOTHING_ROUTED
        kept = self._keep(start, n)
        self._counts.add(code[:kept])
        self._gathered += kept
        return routed

    def _pack(self, segment: EventBatch) -> bool:
        """Write the segment's codes and times behind those gathered; return whether all of it lies on the sensor."""
        n, start, grid = len(segment), self._gathered, self._grid
        if start + n > len(self._code):
            self._make_room(n)
        outside = _pack(
            segment.x, segment.y, segment.polarity, segment.t_ns, grid.width, grid.height, grid.shift, self._t_hop_ns,
            self._code[start : start + n], self._offset_ns[start : start + n],
        )  # fmt: skip
        return not outside

    def _keep(self, start: int, n: int) -> int:
        """Return how many of the ``n`` events from ``start`` on are left for the windows."""
        return n

    def settle(self) -> None:
        """Tell the tracks what the events since the last hop say about them."""

    def _on_sensor(self, segment: EventBatch) -> EventBatch:
        """Return the segment without the events beyond the sensor's borders."""
        kept = (segment.x < self._grid.width) & (segment.y < self._grid.height)
        self.outside_events += len(kept) - int(np.count_nonzero(kept))
        return EventBatch(
            segment.x[kept], segment.y[kept], segment.polarity[kept], segment.t_ns[kept], segment.t_end_ns
        )

    def _own(self, segment: EventBatch, code: NDArray[np.uint32]) -> RoutedEvents:
        """Return each track's events, and flag them in ``code``."""
        count = np.zeros(len(self._place), np.int64)
        routed = self._find_owners(segment, code, count)
        if routed == 0:
            return NOTHING_ROUTED
        t_ns, polarity = np.empty(routed, np.int64), np.empty(routed, np.int8)
        _sort(self._index[:routed], self._owner, segment.t_ns, segment.polarity, count, t_ns, polarity)
        return RoutedEvents(self._place, t_ns, polarity, count)

    def _find_owners(self, segment: EventBatch, code: NDArray[np.uint32], count: NDArray[np.int64]) -> int:
        """List the events that are of a track, with their tracks; return how many."""
        return int(
            _find_owners(
                segment.x, segment.y, segment.t_ns, self._t_hop_ns, self._circle, self._first, self._member,
                cells_along(self._grid.width), self._index, self._owner, code, count,
            )
        )  # fmt: skip

    def close(self) -> HopEvents:
        """Return the events gathered in the hop interval, and begin the next one."""
        n, self._gathered = self._gathered, 0
        code, offset_ns, room = self._code[:n], self._offset_ns[:n], len(self._code)
        if n < _HANDED_OVER * len(self._code):
            code, offset_ns, room = code.copy(), offset_ns.copy(), n
        else:
            self._code, self._offset_ns = np.empty_like(self._code), np.empty_like(self._offset_ns)
        return HopEvents(code, offset_ns, *self._counts.take(), self._t_hop_ns, room)

    @property
    def near(self) -> NearEvents:
        """The events of the hop that lie near tracks; views that stay as they are until the next hop's are routed."""
        return NOTHING_NEAR

    def _make_room(self, n: int) -> None:
        room = math.ceil(_MORE_ROOM * (self._gathered + n))
        code, offset_ns, kept = self._code, self._offset_ns, self._gathered
        self._code, self._offset_ns = np.empty(room, np.uint32), np.empty(room, np.uint32)
        self._index, self._owner = np.empty(room, np.int32), np.empty(room, np.int32)
        self._code[:kept], self._offset_ns[:kept] = code[:kept], offset_ns[:kept]


@njit(cache=True, nogil=True)
def _pack(x, y, polarity, t_ns, width, height, shift, t_hop_ns, code, offset_ns):  # type: ignore[no-untyped-def]
    """Write each event's code, and its time since the hop's begin; return how many lie beyond the sensor's borders."""
    outside = 0
    for i in range(len(x)):
        outside += (x[i] >= width) | (y[i] >= height)
        pixel = (np.uint32(y[i]) << np.uint32(shift)) | np.uint32(x[i])
        code[i] = (pixel << np.uint32(CODE_BITS)) | np.uint32(polarity[i] > 0)
        offset_ns[i] = t_ns[i] - t_hop_ns
    return outside


@njit(cache=True, nogil=True)
def _find_owners(  # type: ignore[no-untyped-def]
    x, y, t_ns, t_hop_ns, circle, first, member, cells_across, index, owner, code, count
):
    """List the events that are of a track, with their tracks, and count them by track; return how many.

    First those that lie in a cell with a circle, then of these the nearest circle that holds each; the first of equals.
    """
    has_circle = cells_with_members(first)
    near = np.uint64(0)  # unsigned, so that no place is taken to count from the end
    for i in range(len(x)):
        index[near] = i
        near += np.uint64(has_circle[cell_of(x[i], y[i], cells_across)])
    routed = np.uint64(0)
    for j in range(near):
        e = np.uint64(index[j])
        cell = cell_of(x[e], y[e], cells_across)
        ex, ey, dt_ns = np.int64(x[e]), np.int64(y[e]), t_ns[e] - t_hop_ns
        nearest2 = np.inf
        best = np.int64(-1)
        for at in range(np.uint64(first[cell]), np.uint64(first[cell + np.uint64(1)])):
            k = np.uint64(member[at])
            dx = ex - (circle[k, 0] + circle[k, 2] * dt_ns)
            dy = ey - (circle[k, 1] + circle[k, 3] * dt_ns)
            d2 = dx * dx + dy * dy
            if d2 <= circle[k, 4] and d2 < nearest2:
                nearest2 = d2
                best = np.int64(k)
        if best >= 0:
            code[e] |= np.uint32(ROUTED)
            index[routed] = e
            owner[routed] = best
            count[best] += 1
            routed += np.uint64(1)
    return np.int64(routed)


@njit(cache=True, nogil=True)
def cell_of(x, y, cells_across):  # type: ignore[no-untyped-def]
    """Return the cell of a pixel; see :mod:`.nearest`."""
    return np.uint64(y >> CELL_SHIFT) * np.uint64(cells_across) + np.uint64(x >> CELL_SHIFT)


@njit(cache=True, nogil=True)
def _sort(index, owner, t_ns, polarity, end, sorted_t_ns, sorted_polarity):  # type: ignore[no-untyped-def]
    """Sort the routed events by track; ``end`` begins as how many each has, and ends as where they end."""
    begin = 0
    for k in range(len(end)):
        count = end[k]
        end[k] = begin
        begin += count
    for i in range(len(index)):
        at = end[owner[i]]
        end[owner[i]] = at + 1
        sorted_t_ns[at] = t_ns[index[i]]
        sorted_polarity[at] = polarity[index[i]]


@njit(cache=True, nogil=True)
def _join(stops, t_ns, polarity):  # type: ignore[no-untyped-def]
    """Return the events of some parts, each sorted by track, all sorted by track, and where each track's end.

    ``stops``: of each part and track, ``(parts, tracks)``.
    """
    sorted_t_ns, sorted_polarity = np.empty_like(t_ns), np.empty_like(polarity)
    ends = np.empty(stops.shape[1], np.int64)
    at = np.uint64(0)  # unsigned, so that no place is taken to count from the end
    for k in range(stops.shape[1]):
        before = 0  # events of the parts before
        for part in range(len(stops)):
            start = stops[part, k - 1] if k else 0
            for i in range(np.uint64(before + start), np.uint64(before + stops[part, k])):
                sorted_t_ns[at], sorted_polarity[at] = t_ns[i], polarity[i]
                at += np.uint64(1)
            before += stops[part, -1]
        ends[k] = at
    return sorted_t_ns, sorted_polarity, ends
