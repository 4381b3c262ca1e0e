"""Detection: events in, tracks and their events out (paper, section III, "Detection algorithm").

    events ──► routing ──► the tracks' buffers ──► candidate slots
                 │  ▲
           hop   ▼  │ aim
           index images ──► blobs ──► tracks
                 ▲                      │ new ones
                 └── threshold ◄── clutter

Routing in a hop interval depends on nothing but the tracks at the last hop, and everything else happens at hops, so
any batching of the same events gives the same tracks and the same routed events.  What nobody waits for at a hop, the upkeep of
the buffers above all, is done between it and the next one, as soon as it is asked for or there is time (:meth:`Detector.rest`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from beacon_comm.core.blobs import Blob, BlobFinder
from beacon_comm.core.clutter import Clutter
from beacon_comm.core.event_buffer import EventBuffer, buffer_length_ns
from beacon_comm.core.events import EventBatch
from beacon_comm.core.following import FollowingRouter
from beacon_comm.core.hop_events import CODE_BITS, ON, ROUTED
from beacon_comm.core.index_image import IndexImages, hop_length_ns
from beacon_comm.core.motion_tracks import MotionTracker
from beacon_comm.core.nearest import cell_lists, cells_along, cells_with_members, events_in
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.routing import NOTHING_ROUTED, RoutedEvents, Router
from beacon_comm.core.tracks import Track, TrackChanges, Tracker


@dataclass(frozen=True, slots=True)
class _Untidied:
    """What a hop leaves to be done with the tracks' buffers: nobody waits for it.

    Attributes:
        routed: what was routed in the hop interval.
        exchanged: the tracks that went on where the other one is.
        blobs, changes: of the hop.
        t_hop_ns: the hop's time (ns).
    """

    routed: list[RoutedEvents]
    exchanged: list[tuple[int, int]]
    blobs: list[Blob]
    changes: TrackChanges
    t_hop_ns: int


@dataclass(slots=True)
class DetectionStats:
    """What detection has counted since it was made.

    Attributes:
        hops: hops that were looked at.
        events, routed_events: events taken, and those of them that were routed to a track.
        outside_events: events beyond the sensor's borders.
        blobs: blobs of the last hop.
        waiting_blobs: blobs of the last hop that got no track because ``max_tracks`` are kept, or too many began.
        new_tracks, lost_tracks: tracks that began and ended.
        window_overflow_events: events dropped from the windows (``window_max_bytes``).
        buffer_overflow_events: events dropped from buffers (``buffer_max_bytes``).
    """

    hops: int = 0
    events: int = 0
    routed_events: int = 0
    outside_events: int = 0
    blobs: int = 0
    waiting_blobs: int = 0
    new_tracks: int = 0
    lost_tracks: int = 0
    window_overflow_events: int = 0
    buffer_overflow_events: int = 0


class Detector:
    """Finds and follows blobs on one sensor and hands out their events.

    Args:
        parameters: those under "Detection" and "Tracks".
        sensor_size: width and height (px).
    """

    def __init__(self, parameters: Parameters, sensor_size: tuple[int, int]) -> None:
        self._parameters = parameters
        self._hop_ns = hop_length_ns(parameters)
        self._buffer_ns = buffer_length_ns(parameters)
        self._follows = parameters.tracker == 'motion'
        self._tracker = MotionTracker(parameters, sensor_size) if self._follows else Tracker(parameters, sensor_size)
        self._buffers: dict[int, EventBuffer] = {}
        self._routed: list[RoutedEvents] = []  # since the last hop
        self._untidied: _Untidied | None = None
        self._stats = DetectionStats()
        self._outside_before = self._overflow_before = 0
        self._start(sensor_size)

    def _start(self, sensor_size: tuple[int, int]) -> None:
        self._sensor_size = sensor_size
        self._images = IndexImages(self._parameters, sensor_size)
        self._blobs = BlobFinder(self._parameters, sensor_size)
        make_router = FollowingRouter if self._follows else Router
        self._router: Router = make_router(self._parameters, sensor_size)
        self._clutter = Clutter(self._parameters)
        self._heed_clutter()
        self._t_hop_ns: int | None = None  # the last point of the hop grid
        self._early = TrackChanges()  # changes at hops that route() had to catch up with
        self._to_exchange: list[tuple[int, int]] = []

    @property
    def tracks(self) -> Mapping[int, Track]:
        """All tracks by label, oldest first, as the events so far have them."""
        self._router.settle()
        return self._tracker.tracks

    @property
    def idle(self) -> bool:
        """Whether nothing can change at coming hops without events: no track, and no event in any window."""
        return not self._tracker.tracks and self._images.empty and not self._router.gathered

    @property
    def index_threshold(self) -> float:
        """The index threshold now; clutter raises it."""
        return self._clutter.threshold

    @property
    def stats(self) -> DetectionStats:
        """What has been counted so far."""
        self._tidy()
        self._stats.outside_events = self._outside_before + self._router.outside_events
        self._stats.window_overflow_events = self._overflow_before + self._images.overflow_events
        return self._stats

    def route(self, segment: EventBatch) -> RoutedEvents:
        """Route the events of one hop interval, or of a part of it, by the tracks at the last hop.

        Returns:
            The events of each track that got any; they get into the tracks' buffers, too.
        """
        if len(segment) == 0:
            return NOTHING_ROUTED
        t_hop_ns = int(segment.t_ns[0]) // self._hop_ns * self._hop_ns
        if self._t_hop_ns is None:
            self._t_hop_ns = t_hop_ns
            self._router.aim((), t_hop_ns)
        elif t_hop_ns > self._t_hop_ns:
            self._early = self.hop(t_hop_ns)
        routed = self._router.route(segment)
        self._stats.events += len(segment)
        self._stats.routed_events += routed.count
        if routed.count:
            self._routed.append(routed)
        return routed

    def hop(self, t_hop_ns: int) -> TrackChanges:
        """Close the hop interval that ends at ``t_hop_ns`` (ns), a point of the grid; catch up with those before.

        Returns:
            The tracks that are new and lost since the last call.
        """
        if self._t_hop_ns is None:
            self._t_hop_ns = t_hop_ns - self._hop_ns
        new, lost = list(self._early.new), list(self._early.lost)
        self._early = TrackChanges()
        while self._t_hop_ns < t_hop_ns:
            self._t_hop_ns = t_hop_ns if self.idle else self._t_hop_ns + self._hop_ns
            changes = self._step(self._t_hop_ns)
            new += changes.new
            lost += changes.lost
        return TrackChanges(tuple(new), tuple(lost), waiting=self._stats.waiting_blobs)

    def disown(self, track_id: int) -> None:
        """Let a track go on under a label of its own from the next hop on."""
        self._tracker.disown(track_id)

    def exchange(self, track_id: int, other_id: int) -> None:
        """Let two tracks go on where the other one is, from the next hop on."""
        self._to_exchange.append((track_id, other_id))

    def backlog(self, track_id: int) -> tuple[NDArray[np.int64], NDArray[np.int8]]:
        """Return the buffered events of a track: times (ns), ``(n,)`` int64, and ±1, ``(n,)`` int8.

        What is routed to it after this call follows on without a gap.

        Raises:
            KeyError: no such track.
        """
        self._tidy()
        self._fill_buffers(self._routed)
        self._routed = []
        return self._buffers[track_id].events()

    def rest(self) -> bool:
        """Do a piece of what no event waits for, while none is there; return whether there was anything to do.

        When it is done, or whether, makes no difference to what is found: the next hop does what is left.
        """
        if self._untidied is None:
            return self._images.take_off()
        self._tidy()
        return True

    def resize(self, sensor_size: tuple[int, int]) -> TrackChanges:
        """Go on with another sensor size ``(width, height)`` (px): all tracks are lost, labels go on."""
        self._tidy()
        self._outside_before += self._router.outside_events
        self._overflow_before += self._images.overflow_events
        changes = TrackChanges(lost=self._early.lost + self._tracker.clear(sensor_size).lost)
        self._stats.lost_tracks += len(changes.lost) - len(self._early.lost)
        self._buffers.clear()
        self._routed = []
        self._start(sensor_size)
        return changes

    def reset(self) -> TrackChanges:
        """Go on after the sensor's clock was restarted: all tracks are lost, labels go on."""
        return self.resize(self._sensor_size)

    def _step(self, t_hop_ns: int) -> TrackChanges:
        """Take one hop; the paper's detection, one call a stage."""
        self._tidy()
        routed, self._routed = self._routed, []
        self._images.push(self._router.close())
        exchanged = self._exchange()
        blobs = self._blobs.find(self._images, t_hop_ns, self._router.near)
        changes = self._tracker.update(blobs, t_hop_ns)
        self._router.aim(tuple(self._tracker.tracks.values()), t_hop_ns)
        self._clutter.count(len(changes.new_blobs), self._tracker.count_read(), t_hop_ns)
        self._heed_clutter()
        self._untidied = _Untidied(routed, exchanged, blobs, changes, t_hop_ns)
        self._stats.hops += 1
        self._stats.blobs = len(blobs)
        self._stats.waiting_blobs = changes.waiting
        self._stats.new_tracks += len(changes.new)
        self._stats.lost_tracks += len(changes.lost)
        return changes

    def _heed_clutter(self) -> None:
        """Let the tracks that began set the threshold of the hops to come."""
        self._tracker.heed(self._clutter)
        self._images.set_threshold(self._clutter.threshold)

    def _exchange(self) -> list[tuple[int, int]]:
        """Exchange the tracks that are to be; return them."""
        tracks, asked_for = self._tracker.tracks, self._to_exchange
        exchanged = [(one, other) for one, other in asked_for if one in tracks and other in tracks]
        for one, other in exchanged:
            self._tracker.exchange(one, other)
        self._to_exchange = []
        return exchanged

    def _tidy(self) -> None:
        """Bring the tracks' buffers up to the last hop."""
        if self._untidied is None:
            return
        hop, self._untidied = self._untidied, None
        self._fill_buffers(hop.routed)
        for one, other in hop.exchanged:
            self._buffers[one], self._buffers[other] = self._buffers[other], self._buffers[one]
        for old, new in hop.changes.renamed:
            self._buffers[new] = self._buffers[old]
        for track in hop.changes.lost:
            del self._buffers[track.track_id]
        if hop.changes.new_blobs:
            self._begin_buffers(hop.blobs, hop.changes)
        for buffer in self._buffers.values():
            self._stats.buffer_overflow_events += buffer.trim(hop.t_hop_ns)

    def _fill_buffers(self, parts: list[RoutedEvents]) -> None:
        """Hand the tracks' buffers what was routed."""
        if parts:
            for track_id, part in RoutedEvents.joined(parts).by_track():
                self._buffers[track_id].append(part.t_ns, part.polarity)

    def _begin_buffers(self, blobs: list[Blob], changes: TrackChanges) -> None:
        """Begin each new track's buffer with the events on its blob's pixels that are in the blob's window."""
        begun = dict(zip(changes.new_blobs, changes.new, strict=False))  # behind them: the renamed ones
        for track in begun.values():
            self._buffers[track.track_id] = EventBuffer(self._buffer_ns, self._parameters.buffer_max_bytes)
        grid = self._images.grid
        for w, window in enumerate(self._images.windows):
            wanted = np.zeros(len(blobs) + 1, np.bool_)
            wanted[[b + 1 for b in begun if blobs[b].window == w]] = True
            if not wanted.any():
                continue
            first, _ = cell_lists(self._blobs.box[wanted[1:]], grid.width, grid.height)
            cells, across = cells_with_members(first), cells_along(grid.width)
            parts = [
                _events_on(
                    events_in(cells, across, events.code, grid.shift),
                    events.code, events.offset_ns, events.t_start_ns, self._blobs.owner, wanted,
                )  # fmt: skip
                for events in self._images.hop_events(window)
                if len(events)
            ]
            number, t_ns, polarity = (np.concatenate(column) for column in zip(*parts, strict=True))
            order = np.lexsort((t_ns, number))
            ends = np.cumsum(np.bincount(number, minlength=len(wanted)))
            for b in np.flatnonzero(wanted):
                of = order[ends[b - 1] : ends[b]]
                self._buffers[begun[int(b) - 1].track_id].append(t_ns[of], polarity[of])


@njit(cache=True, nogil=True)
def _events_on(index, code, offset_ns, t_start_ns, owner, wanted):  # type: ignore[no-untyped-def]
    """Return blob number, time and polarity of those events of ``index`` that no track got and that lie on a wanted blob."""
    number = np.empty(len(index), np.int32)
    t_ns = np.empty(len(index), np.int64)
    polarity = np.empty(len(index), np.int8)
    n = 0
    for i in index:
        c = np.int64(code[i])
        b = owner[c >> CODE_BITS]
        if b > 0 and wanted[b] and not c & ROUTED:
            number[n] = b
            t_ns[n] = t_start_ns + np.int64(offset_ns[i])
            polarity[n] = 1 if c & ON else -1
            n += 1
    return number[:n], t_ns[:n], polarity[:n]
