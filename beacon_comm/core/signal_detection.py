"""Detection bypassed: one beacon's aggregated events without pixels, as in the paper's published recordings.

The whole signal is one track at pixel (0, 0).  It appears with its first event, is quiet in hops without events and
is lost after ``lost_after_s`` without any, as a track on the image is; the next event starts another one.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.event_buffer import EventBuffer, buffer_length_ns
from beacon_comm.core.events import NS_PER_S, EventBatch
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.routing import NOTHING_ROUTED, RoutedEvents, places
from beacon_comm.core.tracks import Track, TrackChanges


class WholeSignal:
    """Takes the place of :class:`beacon_comm.core.detection.Detector`: every event is of the one track.

    Args:
        parameters: ``lost_after_s`` and those of the buffer.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._lost_after_ns = round(parameters.lost_after_s * NS_PER_S)
        self._parameters = parameters
        self._buffer = self._new_buffer()
        self._tracks: dict[int, Track] = {}
        self._next_id = 1
        self._newest_ns: int | None = None  # newest event since the last hop

    @property
    def tracks(self) -> Mapping[int, Track]:
        """The one track by its label, or none."""
        return self._tracks

    @property
    def index_threshold(self) -> float:
        """0: there is no image."""
        return 0.0

    @property
    def idle(self) -> bool:
        """Whether nothing can change at coming hops without events."""
        return not self._tracks and self._newest_ns is None

    def route(self, segment: EventBatch) -> RoutedEvents:
        """Buffer the events; give them to the track, if there is one yet."""
        if len(segment) == 0:
            return NOTHING_ROUTED
        self._newest_ns = int(segment.t_ns[-1])
        self._buffer.append(segment.t_ns, segment.polarity)
        if not self._tracks:
            return NOTHING_ROUTED
        return RoutedEvents(places(list(self._tracks.values())), segment.t_ns, segment.polarity, np.array([len(segment)]))

    def hop(self, t_hop_ns: int) -> TrackChanges:
        """Begin, keep or lose the track at ``t_hop_ns`` (ns)."""
        self._buffer.trim(t_hop_ns)
        newest_ns, self._newest_ns = self._newest_ns, None
        if newest_ns is None:
            return self._miss(t_hop_ns)
        for track in self._tracks.values():
            track.last_seen_ns = track.t_ns = newest_ns
            track.quiet = False
        if self._tracks:
            return TrackChanges()
        track = Track(self._next_id, 0.0, 0.0, newest_ns, 0.0, 0.0, newest_ns, newest_ns)
        self._next_id += 1
        self._tracks[track.track_id] = track
        return TrackChanges(new=(track,))

    def disown(self, track_id: int) -> None:
        """Do nothing: a lost signal's label never comes back."""

    def exchange(self, track_id: int, other_id: int) -> None:
        """Do nothing: there are no two signals."""

    def backlog(self, track_id: int) -> tuple[NDArray[np.int64], NDArray[np.int8]]:
        """Return the buffered events: times (ns), ``(n,)`` int64, and ±1, ``(n,)`` int8."""
        return self._buffer.events()

    def rest(self) -> bool:
        """Do nothing, and say so."""
        return False

    def resize(self, sensor_size: tuple[int, int]) -> TrackChanges:
        """A signal has no pixels: as :meth:`reset`."""
        return self.reset()

    def reset(self) -> TrackChanges:
        """Go on after the sensor's clock was restarted: the track is lost, labels go on."""
        self._newest_ns = None
        return self._lose()

    def _miss(self, t_hop_ns: int) -> TrackChanges:
        for track in self._tracks.values():
            track.quiet = True
            if t_hop_ns - track.last_seen_ns >= self._lost_after_ns:
                return self._lose()
        return TrackChanges()

    def _lose(self) -> TrackChanges:
        """End the track and what is buffered of it, so that the next track reads nothing twice."""
        lost = tuple(self._tracks.values())
        self._tracks.clear()
        self._buffer = self._new_buffer()
        return TrackChanges(lost=lost)

    def _new_buffer(self) -> EventBuffer:
        return EventBuffer(buffer_length_ns(self._parameters), self._parameters.buffer_max_bytes)
