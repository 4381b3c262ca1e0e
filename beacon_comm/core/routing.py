"""Routing: every event to at most one track.

An event is of the nearest track whose circle holds it; circle and track are predicted to the event's own time:

    distance(event, centre(t)) <= extent × routing_extent_factor + routing_margin_px

The tracks as they stood at the last hop decide until the next one.  Centres move on a straight line in between.
The routed events are sorted by track, stably, into one array:

    t_ns, polarity   [ events of track a | of track b | … ]        each in order of time
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from beacon_comm.core.events import EventBatch
from beacon_comm.core.index_image import HopEvents, hop_length_ns
from beacon_comm.core.nearest import CELL_SHIFT, cell_lists, cells_along
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.tracks import Track, positions_at

_FIRST_ROOM = 4096


@dataclass(frozen=True, slots=True)
class Routed:
    """Events of one track.

    Attributes:
        track_id: its label.
        t_ns: sensor time (ns), ``(n,)`` int64.
        polarity: ±1, ``(n,)`` int8.
    """

    track_id: int
    t_ns: NDArray[np.int64]
    polarity: NDArray[np.int8]


class Router:
    """Routes the events of a hop interval, and gathers them for the detection windows.

    Args:
        parameters: ``routing_extent_factor``, ``routing_margin_px``, ``hop_s``.
        sensor_size: width and height (px).

    Attributes:
        outside_events: events beyond the sensor's borders, which are dropped.
    """

    def __init__(self, parameters: Parameters, sensor_size: tuple[int, int]) -> None:
        self._width, self._height = sensor_size
        self._hop_ns = hop_length_ns(parameters)
        self._factor, self._margin = parameters.routing_extent_factor, parameters.routing_margin_px
        self._word = np.empty(_FIRST_ROOM, np.uint32)
        self._t_ns = np.empty(_FIRST_ROOM, np.int64)
        self._gathered = 0
        self.outside_events = 0
        self.aim((), 0)

    @property
    def gathered(self) -> int:
        """Events of the hop interval so far."""
        return self._gathered

    def aim(self, tracks: Sequence[Track], t_hop_ns: int) -> None:
        """Route by ``tracks`` in the hop interval that begins at ``t_hop_ns`` (ns)."""
        self._track_ids = [track.track_id for track in tracks]
        self._t_hop_ns = t_hop_ns
        now, then = positions_at(tracks, t_hop_ns), positions_at(tracks, t_hop_ns + self._hop_ns)
        radius = np.array([track.extent_px for track in tracks]) * self._factor + self._margin
        circle = np.column_stack((now, (then - now) / self._hop_ns, radius))
        low, high = np.minimum(now, then) - radius[:, None], np.maximum(now, then) + radius[:, None]
        box = np.column_stack((low[:, 0], high[:, 0], low[:, 1], high[:, 1]))
        self._circle = circle
        self._first, self._member = cell_lists(box, self._width, self._height)

    def route(self, segment: EventBatch) -> list[Routed]:
        """Return the events of each track that got any, in order of the tracks' labels."""
        n = len(segment)
        if n == 0:
            return []
        if self._gathered + n > len(self._word):
            self._make_room(n)
        owner = np.empty(n, np.int32)
        first = np.zeros(len(self._track_ids) + 2, np.int64)
        kept = _route(
            segment.x, segment.y, segment.polarity, segment.t_ns, self._width, self._height, self._t_hop_ns,
            self._circle, self._first, self._member, cells_along(self._width),
            self._word[self._gathered :], self._t_ns[self._gathered :], owner, first,
        )  # fmt: skip
        self._gathered += kept
        self.outside_events += n - kept
        if first[-1] == 0:
            return []
        t_ns, polarity = np.empty(first[-1], np.int64), np.empty(first[-1], np.int8)
        _sort(owner, segment.t_ns, segment.polarity, first, t_ns, polarity)
        ends = first.tolist()  # after sorting: where each track's events end
        return [
            Routed(track_id, t_ns[start:stop], polarity[start:stop])
            for track_id, start, stop in zip(self._track_ids, [0, *ends], ends, strict=False)
            if stop > start
        ]

    def close(self) -> HopEvents:
        """Return the events gathered in the hop interval, and begin the next one."""
        n, self._gathered = self._gathered, 0
        return HopEvents(self._word[:n].copy(), self._t_ns[:n].copy())

    def _make_room(self, n: int) -> None:
        room = 2 * (self._gathered + n)
        word, t_ns, kept = self._word, self._t_ns, self._gathered
        self._word, self._t_ns = np.empty(room, np.uint32), np.empty(room, np.int64)
        self._word[:kept], self._t_ns[:kept] = word[:kept], t_ns[:kept]


@njit(cache=True, nogil=True)
def _route(  # type: ignore[no-untyped-def]
    x, y, polarity, t_ns, width, height, t_hop_ns, circle, first, member, cells_across,
    word, gathered_t_ns, owner, count,
):  # fmt: skip
    """Find each event's track, -1 for none; gather it; count the events of track k in ``count[k + 1]``.

    ``count[-1]`` is the number of all routed events.  Returns how many events lie on the sensor.
    """
    kept = 0
    for i in range(len(t_ns)):
        ex, ey = np.int64(x[i]), np.int64(y[i])
        best = -1
        if ex < width and ey < height:
            cell = (ey >> CELL_SHIFT) * cells_across + (ex >> CELL_SHIFT)
            nearest2 = np.inf
            for j in range(first[cell], first[cell + 1]):
                k = member[j]
                dt = t_ns[i] - t_hop_ns
                dx = ex - (circle[k, 0] + circle[k, 2] * dt)
                dy = ey - (circle[k, 1] + circle[k, 3] * dt)
                d2 = dx * dx + dy * dy
                if d2 <= circle[k, 4] ** 2 and d2 < nearest2:
                    nearest2 = d2
                    best = k
            routed = np.uint32(2) if best >= 0 else np.uint32(0)
            on = np.uint32(1) if polarity[i] > 0 else np.uint32(0)
            word[kept] = np.uint32((ey << 16) | (ex << 2)) | routed | on
            gathered_t_ns[kept] = t_ns[i]
            kept += 1
        owner[i] = best
        if best >= 0:
            count[best + 1] += 1
            count[-1] += 1
    return kept


@njit(cache=True, nogil=True)
def _sort(owner, t_ns, polarity, first, sorted_t_ns, sorted_polarity):  # type: ignore[no-untyped-def]
    """Sort the routed events by track; ``first`` begins as counts and ends as where each track's events end."""
    for k in range(1, len(first) - 1):
        first[k] += first[k - 1]
    for i in range(len(owner)):
        k = owner[i]
        if k >= 0:
            sorted_t_ns[first[k]] = t_ns[i]
            sorted_polarity[first[k]] = polarity[i]
            first[k] += 1
