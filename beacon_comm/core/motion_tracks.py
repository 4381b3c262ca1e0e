"""Tracks that move on with their own events, between hops (:mod:`.following`); blobs begin them and bring them back.

    at a hop    own events, as many as usual       ──► seen, wherever the blobs are
                a blob of its own                  ──► seen; where its own events were fewer: there it is
                neither                            ──► quiet: predicted, and what comes within its circle moves it again
                a fresh blob of no track           ──► a new track, or one that was lost near there (``reacquire_s``)

The paper's index of a track is that of a pixel moved along: its events over the area that they are spread over, its own at
least, in windows that forget like the detection's short and long one, so that a fast one has an index, too.  Where nothing is
but noise, a circle is the larger the less is known of a track: over its own area alone, noise would keep it for ever.

Edges that pass over a beacon may drag its track away.  One whose velocity has jumped remembers for a while where it was
before (:class:`Steady`): if something is seen where it would be by now, and nobody else's, that is it.

A label comes back only to what is where the lost track may be; when its bit rate is known and is another one, it goes on
under a label of its own (:meth:`MotionTracker.disown`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from beacon_comm.core import motion
from beacon_comm.core.association import assign
from beacon_comm.core.blobs import SPREAD_EVENTS, Blob
from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.index_image import window_hops
from beacon_comm.core.motion import (
    AGAIN,
    EXTENT,
    HIDDEN,
    HOP_OFF,
    HOP_ON,
    HOP_RR,
    LAST,
    LONG_OFF,
    LONG_ON,
    NOISE,
    SHORT_OFF,
    SHORT_ON,
    TRUST,
    USUAL,
    T,
    X,
)  # fmt: skip
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.tracks import (
    EXTENT_FALL,
    EXTENT_RISE,
    FIRST_SPEED_PX_PER_S,
    FLOOR_PX,
    SURPRISE,
    Covariance,
    Track,
    TrackChanges,
    Tracker,
    is_same_rate,
    positions_at,
)

_FEWEST_EVENTS = 4
_SEEN_SHARE = 0.1  # of the usual events of a hop: fewer are the background's
_EXTENT_MOVED = 0.2
_LEAST_EXTENT_PX = 0.5
_USUAL_GAIN = 0.1
_HIDDEN_SHARE = 0.5  # of its radius a track moves in a hop before its events are hidden from the windows
_HIDDEN_AFTER_HOPS = 2
_SAME_EXTENTS = 1.1  # two tracks of one blob are half a disc's centroids apart: 0.85 radii
_MERGE_UNREAD_S = 0.03  # a double that nobody has read yet has nothing to lose: before both are read …
_NEW_S = 0.2  # … if it was a double soon after it began: what comes by later is another light
# What is told of the error, calibrated on simulated scenes (docs/tracking.py, the part "errors").  Errors to the other side
# cancel for longer than one observation (the filter takes them to be independent, the part of the variance that does not
# cancel is larger); a prediction is better than the likely modes' accelerations say, the slower the better, where it is one
# from the last events to the next ones.
_CANCEL, _LEAST_SHARE, _VARIANCE_FACTOR = 8.0, 0.1, 2.8
_GROWTH_FACTOR, _GROWTH_SPEED_PX_PER_S, _LEAST_GROWTH_SHARE = 1.2, 1000.0, 0.01
_JUMP_PX_PER_S, _JUMP_SHARE = 300.0, 0.3  # a velocity jumps by more than so much and this share of it …
_JUMPED_S = 0.1  # … and what was before is remembered for so long
_LIKE_EXTENT = 4.0  # what is so many times as large is something else
_GRAIN_PX = 0.022  # a spot's centroid is off by so much because its pixels differ
_GRAIN_SPEED_PX_PER_S = 50.0  # at this speed half of that is averaged out: a pixel in the filter's memory
_LATENCY_SHARE = 0.25  # of the latency is its standard deviation


class Steady(NamedTuple):
    """Where a track was when its velocity was last steady: centre (px), velocity (px/s) and radius (px) at a time (ns)."""

    x_px: float
    y_px: float
    vx_px_per_s: float
    vy_px_per_s: float
    extent_px: float
    t_ns: int

    def position_at(self, t_ns: int) -> tuple[float, float]:
        """Return where it would be at ``t_ns`` (ns)."""
        dt = (t_ns - self.t_ns) / NS_PER_S
        return self.x_px + self.vx_px_per_s * dt, self.y_px + self.vy_px_per_s * dt

    @classmethod
    def of(cls, track: Track, t_ns: int) -> Steady:
        """Return where a track is at ``t_ns`` (ns)."""
        return cls(*track.position_at(t_ns), track.vx_px_per_s, track.vy_px_per_s, track.extent_px, t_ns)

    def fits(self, track: Track) -> bool:
        """Return whether a track moves much like it, and is of about its size."""
        if track.extent_px > _LIKE_EXTENT * self.extent_px:
            return False
        jump = math.hypot(track.vx_px_per_s - self.vx_px_per_s, track.vy_px_per_s - self.vy_px_per_s)
        return jump <= _JUMP_PX_PER_S + _JUMP_SHARE * math.hypot(self.vx_px_per_s, self.vy_px_per_s)


def _may_be_same(one: Track, other: Track) -> bool:
    """Return whether two tracks may be of one beacon: not if both bit rates are known, and are different."""
    rate_bps, other_bps = one.bit_rate_bps, other.bit_rate_bps
    return rate_bps is None or other_bps is None or is_same_rate(other_bps, rate_bps)


@dataclass(slots=True)
class MotionTrack(Track):
    """A track with a motion filter.

    Attributes:
        steady: where it was at the last hop, or before its velocity jumped; None: it has not been read.
        row: its state, see :mod:`.motion`.
        origin_ns: the hop that the row's times count from (ns).
        latency_s: of the sensor (s): how much later than the light an event is.
    """

    WHERE: ClassVar[tuple[str, ...]] = (*Track.WHERE, 'row', 'origin_ns', 'steady')

    row: NDArray[np.float64] = field(default_factory=lambda: np.zeros(motion.WIDTH))
    origin_ns: int = 0
    latency_s: float = 0.0
    steady: Steady | None = None

    def settle(self) -> None:
        """Take the row's state over."""
        x, y, vx, vy, pp, pv, vv, noise = self.row[X : NOISE + 1].tolist()
        self.x_px, self.y_px, self.vx_px_per_s, self.vy_px_per_s = x, y, vx, vy
        self.t_ns = self.origin_ns + round(float(self.row[T]) * NS_PER_S)
        self.variance, self.noise = (pp, pv, vv), noise

    def light_at(self, t_ns: int) -> tuple[float, float]:
        """Return the predicted centre of the light (px) at ``t_ns`` (ns): its events come from where it was a latency ago."""
        x, y = self.position_at(t_ns)
        return x + self.vx_px_per_s * self.latency_s, y + self.vy_px_per_s * self.latency_s

    def covariance_at(self, t_ns: int) -> Covariance:
        """Return the covariance of that (px²).

        It is the filter's likely modes', corrected for errors of observations that are no white noise, as the filter takes them
        to be; what a spot's pixels differ by (in rest the same for all time, in motion averaged out); and the latency's
        uncertainty along the way.
        """
        vx, vy = self.vx_px_per_s, self.vy_px_per_s
        speed = math.hypot(vx, vy)
        share = max(1.0 + _CANCEL * min(float(self.row[AGAIN]), 0.0), _LEAST_SHARE)
        variance, growth = motion.likely_variance(self.row, max(0, t_ns - self.t_ns) / NS_PER_S)
        followed = not self.quiet and self.has_known_velocity
        slow = max(_GROWTH_FACTOR * speed / (speed + _GROWTH_SPEED_PX_PER_S), _LEAST_GROWTH_SHARE)
        both = _VARIANCE_FACTOR * share * variance + (slow if followed else 1.0) * growth
        both += _GRAIN_PX**2 / (1.0 + speed / _GRAIN_SPEED_PX_PER_S)
        along = (_LATENCY_SHARE * self.latency_s) ** 2
        cross = along * vx * vy
        return (both + along * vx * vx, cross), (cross, both + along * vy * vy)

    def begin(self, x_px: float, y_px: float, t_ns: int, variance_px2: float, speed_variance: float) -> None:
        """Be at a place at ``t_ns`` (ns), at an unknown velocity."""
        motion.begin(self.row, (t_ns - self.origin_ns) / NS_PER_S, x_px, y_px, 0.0, 0.0, variance_px2, speed_variance)
        self.settle()

    def observe(self, x_px: float, y_px: float, t_ns: int, variance_px2: float) -> None:
        """Take an observation at ``t_ns``; one that is older than the state counts as of the state's time."""
        t_ns = max(t_ns, self.t_ns)
        x, y = self.position_at(t_ns)
        if (x_px - x) ** 2 + (y_px - y) ** 2 > SURPRISE * (self.variance_at(t_ns) + variance_px2):
            speed2 = self.vx_px_per_s**2 + self.vy_px_per_s**2
            self.begin(x_px, y_px, t_ns, variance_px2, FIRST_SPEED_PX_PER_S**2 + speed2)
            return
        motion.observe(self.row, (t_ns - self.origin_ns) / NS_PER_S, x_px - x, y_px - y, variance_px2)
        self.settle()

    def fall_quiet(self) -> None:
        """Go on by prediction; of the velocity only what is certain is kept, so that a still blob stays."""
        motion.brake(self.row, self.certain_share())
        self.settle()
        self.quiet = True

    def jumped(self, t_hop_ns: int) -> Steady | None:
        """Return the state before its velocity jumped, not long before ``t_hop_ns`` (ns), None: it has not."""
        before = self.steady
        if before is None or t_hop_ns - before.t_ns >= _JUMPED_S * NS_PER_S:
            return None
        return None if before.fits(self) else before

    def return_to(self, x_px: float, y_px: float, t_ns: int, variance_px2: float, before: Steady) -> None:
        """Be at a place again at ``t_ns`` (ns), with the velocity and the size from before the jump."""
        vx, vy = before.vx_px_per_s, before.vy_px_per_s
        motion.begin(self.row, (t_ns - self.origin_ns) / NS_PER_S, x_px, y_px, vx, vy, variance_px2, _JUMP_PX_PER_S**2)
        self.settle()
        self.extent_px = before.extent_px
        self.steady = Steady.of(self, t_ns)

    def stop(self, x_px: float, y_px: float, t_ns: int) -> None:
        """Wait at a place from ``t_ns`` (ns) on."""
        self.begin(x_px, y_px, t_ns, self.variance[0], self.variance[2])


class MotionTracker(Tracker):
    """Keeps tracks that move on with their own events."""

    def __init__(self, parameters: Parameters, sensor_size: tuple[int, int]) -> None:
        super().__init__(parameters, sensor_size)
        hops = window_hops(parameters)
        self._forget = np.array([1.0 - 1.0 / hops[0], 1.0 - 1.0 / hops[-1]])
        self._reacquire_ns = round(parameters.reacquire_s * NS_PER_S)
        self._merge_unread_ns = round(min(_MERGE_UNREAD_S, parameters.merge_after_s) * NS_PER_S)
        self._remembered: dict[int, MotionTrack] = {}
        self._disowned: list[int] = []

    def update(self, blobs: Sequence[Blob], t_hop_ns: int) -> TrackChanges:
        """Associate the blobs of the hop that ends at ``t_hop_ns`` (ns)."""
        if not blobs and not self._tracks:
            return TrackChanges()
        tracks: list[MotionTrack] = list(self._tracks.values())  # type: ignore[arg-type]
        blob_of, track_of = self._matched(tracks, blobs, t_hop_ns)
        rows = np.array([track.row for track in tracks]) if tracks else np.empty((0, motion.WIDTH))
        evidence = _evidence(rows, self._forget, self._parameters.index_offset).tolist()
        hop_s = self._parameters.hop_s
        for i, track in enumerate(tracks):
            track.row[SHORT_ON : LONG_OFF + 1] = rows[i, SHORT_ON : LONG_OFF + 1]
            own, index, spread = evidence[i]
            least_index = self._index_threshold(track) * self._parameters.index_grow_share
            seen = own >= max(_FEWEST_EVENTS, _SEEN_SHARE * float(rows[i, USUAL]) * hop_s) and index >= least_index
            if blob_of[i] >= 0 or seen:
                blob = blobs[blob_of[i]] if blob_of[i] >= 0 else None
                self._see(track, blob, t_hop_ns, own, index, spread, seen)
            else:
                if not track.quiet:
                    track.fall_quiet()
                self._keep_on_sensor(track, t_hop_ns)
                track.row[HIDDEN] = 0.0
        self._find_doubles(tracks, t_hop_ns)
        lost = tuple(track for track in tracks if self._ended(track, t_hop_ns))
        for track in lost:
            del self._tracks[track.track_id]
        self._remember(lost, t_hop_ns)
        left = self._return(tracks, blobs, self._unfollowed(tracks, blobs, track_of, t_hop_ns), t_hop_ns)
        return self._rename(self._begin(left, blobs, lost, t_hop_ns))

    def _index_threshold(self, track: MotionTrack) -> float:
        """Return the threshold for a track: what sends at a known bit rate is no clutter."""
        return self._threshold if self._may_be_clutter(track) else self._parameters.index_threshold

    def clear(self, sensor_size: tuple[int, int]) -> TrackChanges:
        """Lose every track and go on with a sensor size; labels go on."""
        self._remembered.clear()
        self._disowned.clear()
        return super().clear(sensor_size)

    def disown(self, track_id: int) -> None:
        """Let what has taken a lost track's label, and sends at another rate, go on under a label of its own."""
        self._disowned.append(track_id)

    def _rename(self, changes: TrackChanges) -> TrackChanges:
        """Give the disowned tracks labels of their own."""
        old, new = [], []
        for track_id in self._disowned:
            track = self._tracks.pop(track_id, None)
            if track is not None:
                old.append(track)
                new.append(replace(track, track_id=self._next_id, claimed_bps=None, held=False, tried_ns=None))
                self._tracks[self._next_id] = new[-1]
                self._next_id += 1
        self._disowned.clear()
        if not old:
            return changes
        renamed = tuple((a.track_id, b.track_id) for a, b in zip(old, new, strict=True))
        return replace(changes, new=changes.new + tuple(new), lost=changes.lost + tuple(old), renamed=renamed)

    def _remember(self, lost: Sequence[Track], t_hop_ns: int) -> None:
        """Remember the tracks that were lost out of sight and whose rate is known, for ``reacquire_s``."""
        for track_id, track in list(self._remembered.items()):
            if t_hop_ns - track.last_seen_ns >= self._reacquire_ns:
                del self._remembered[track_id]
        for one in lost:
            if isinstance(one, MotionTrack) and one.known_bps is not None and one.covered_since_ns is None:
                self._remembered[one.track_id] = replace(one, bit_rate_bps=one.known_bps, row=one.row.copy())

    def _new_track(self, blob: Blob, t_hop_ns: int, tried_ns: int) -> Track:
        old = self._recognised(blob, t_hop_ns)
        if old is None:
            return super()._new_track(blob, t_hop_ns, tried_ns)
        del self._remembered[old.track_id]
        track: Track = self._make(old.track_id, blob, t_hop_ns, None)
        track.claimed_bps = old.bit_rate_bps
        self._tracks[track.track_id] = track
        for track_id in sorted(self._tracks):  # oldest first again
            self._tracks[track_id] = self._tracks.pop(track_id)
        return track

    def _recognised(self, blob: Blob, t_hop_ns: int) -> MotionTrack | None:
        """Return the remembered track that a blob is likeliest to be, within the gates."""
        p = self._parameters
        best, least = None, math.inf
        for track in self._remembered.values():
            x, y = track.position_at(blob.t_ns)
            distance = math.hypot(blob.x_px - x, blob.y_px - y)
            deviation = math.sqrt(track.variance_at(blob.t_ns))
            if distance <= min(p.max_gate_px, p.association_gate_px + 3.0 * deviation) and distance / (1.0 + deviation) < least:
                best, least = track, distance / (1.0 + deviation)
        return best if best is not None and t_hop_ns - best.last_seen_ns < self._reacquire_ns else None

    def _see(
        self, track: MotionTrack, blob: Blob | None, t_hop_ns: int, own: float, index: float, spread: float, seen: bool
    ) -> None:
        """Let a track be seen, by its blob or by its own events."""
        hop_s = self._parameters.hop_s
        hop_ns = round(hop_s * NS_PER_S)
        extent = track.extent_px
        if blob is not None:
            if blob.fresh and own < 0.5 * blob.fresh_count and track.row[HIDDEN] == 0.0:
                track.observe(blob.x_px, blob.y_px, blob.t_ns, blob.variance_px2 + FLOOR_PX**2)
                track.last_seen_ns = max(track.last_seen_ns, blob.t_ns)
            track.index = blob.index
            extent = blob.extent_px
        else:
            track.index = index
        if seen:
            track.last_seen_ns = track.origin_ns + round(float(track.row[LAST]) * NS_PER_S)
            track.row[USUAL] += _USUAL_GAIN * (own / hop_s - track.row[USUAL])
        rise = EXTENT_RISE if track.bit_rate_bps is None else EXTENT_FALL  # what is read grows as it comes nearer, no faster
        gain = rise if extent > track.extent_px else EXTENT_FALL
        if seen and own >= SPREAD_EVENTS and spread < extent:
            extent = spread
            gain = rise if extent > track.extent_px else _EXTENT_MOVED
        track.extent_px = max(_LEAST_EXTENT_PX, track.extent_px + gain * (extent - track.extent_px))
        track.quiet = False
        track.matched_ns = t_hop_ns
        speed = math.hypot(track.vx_px_per_s, track.vy_px_per_s)
        old = t_hop_ns - track.first_seen_ns >= _HIDDEN_AFTER_HOPS * hop_ns
        track.row[HIDDEN] = float(seen and old and speed * hop_s > _HIDDEN_SHARE * track.extent_px)

    def _matched(
        self, tracks: list[MotionTrack], blobs: Sequence[Blob], t_hop_ns: int
    ) -> tuple[list[int], list[int]]:
        """Return each track's blob and each blob's track, -1 for none: the likeliest assignment within the gates."""
        blob_of, track_of = [-1] * len(tracks), [-1] * len(blobs)
        first, second, distance2 = self._gated(tracks, positions_at(tracks, t_hop_ns), blobs, t_hop_ns)

        def costs() -> NDArray[np.float64]:
            variance = np.array([track.variance_at(t_hop_ns) for track in tracks])
            seen = np.array([blob.variance_px2 + 1.0 for blob in blobs])
            both = variance[first] + seen[second]
            return distance2 / both + 2.0 * np.log(both)  # of a normal density: what may be anywhere is hardly just here

        for i, j in assign(first, second, costs, (len(tracks), len(blobs))):
            blob_of[i], track_of[j] = j, i
        return blob_of, track_of

    def _ended(self, track: Track, t_hop_ns: int) -> bool:
        if super()._ended(track, t_hop_ns):
            return True
        since = track.covered_since_ns
        if since is None or track.known_bps is not None:
            return False
        return since - track.first_seen_ns < _NEW_S * NS_PER_S and t_hop_ns - since >= self._merge_unread_ns

    def _find_doubles(self, tracks: list[MotionTrack], t_hop_ns: int) -> None:
        """Find the tracks that another one has the events of, or that share its blob, and since when.

        Of two that are read, or of two that are not, the younger is the double; else the one that is not.
        """
        state = np.array([(*t.position_at(t_hop_ns), t.extent_px, t.quiet) for t in tracks]).reshape(-1, 4)
        near = _near(state)
        if not near.any():
            for track in tracks:
                track.covered_since_ns = None
            return
        some = near.any(axis=1)
        quiet = state[:, 3] > 0.0
        unread = np.array([track.known_bps is None for track in tracks])
        for i, track in enumerate(tracks):
            if not some[i]:
                track.covered_since_ns = None
                continue
            rivals = np.flatnonzero(near[i] & ~quiet)
            covered = bool(np.any((unread[rivals] < unread[i]) | ((unread[rivals] == unread[i]) & (rivals < i))))
            younger = np.flatnonzero(near[i, i + 1 :] & quiet[i] & ~quiet[i + 1 :]) + i + 1
            same = [k for k in younger if _may_be_same(track, tracks[k])]
            if not covered and same:
                self._take_over(track, tracks[same[0]])
                quiet[i] = False
            if not covered:
                track.covered_since_ns = None
            elif track.covered_since_ns is None:
                track.covered_since_ns = t_hop_ns

    def _return(
        self, tracks: list[MotionTrack], blobs: Sequence[Blob], left: list[tuple[int, int]], t_hop_ns: int
    ) -> list[tuple[int, int]]:
        """Let tracks that were dragged away return to a blob that is left over where they would be; return the other blobs."""
        for track in tracks:
            if track.bit_rate_bps is None or track.track_id not in self._tracks:
                continue
            before = track.jumped(t_hop_ns)
            if before is not None:
                taken = self._return_one(track, before, tracks, blobs, left, t_hop_ns)
                left = [entry for entry in left if entry is not taken]
            elif not track.quiet:
                track.steady = Steady.of(track, t_hop_ns)
        return left

    def _return_one(
        self, track: MotionTrack, before: Steady, tracks: list[MotionTrack], blobs: Sequence[Blob],
        left: list[tuple[int, int]], t_hop_ns: int,
    ) -> tuple[int, int] | None:  # fmt: skip
        """Let a track go on in what is where it would be; return the blob that is now its own, if it is one that was left."""
        gate = self._parameters.association_gate_px
        for entry in left:
            blob = blobs[entry[1]]
            if math.dist(before.position_at(blob.t_ns), (blob.x_px, blob.y_px)) <= gate:
                track.return_to(blob.x_px, blob.y_px, blob.t_ns, blob.variance_px2 + FLOOR_PX**2, before)
                return entry
        x, y = before.position_at(t_hop_ns)
        for other in tracks:
            if other.track_id not in self._tracks or other.quiet or other.bit_rate_bps is not None:
                continue
            reach = min(other.extent_px, before.extent_px) + gate
            if math.dist((x, y), other.position_at(t_hop_ns)) <= reach and before.fits(other):
                self.exchange(track.track_id, other.track_id)
                track.steady, other.steady = Steady.of(track, t_hop_ns), None
                return None
        if track.quiet and 0.0 <= x < self._sensor_size[0] and 0.0 <= y < self._sensor_size[1]:
            track.return_to(x, y, t_hop_ns, gate**2, before)  # what dragged it away is gone
        return None

    def _take_over(self, older: MotionTrack, younger: MotionTrack) -> None:
        """Let a quiet track go on where a younger one is."""
        older.row[:] = younger.row
        older.settle()
        older.extent_px, older.index = younger.extent_px, younger.index
        older.last_seen_ns, older.matched_ns, older.quiet = younger.last_seen_ns, younger.matched_ns, False

    def _may_begin(self, blob: Blob) -> bool:
        return blob.fresh and super()._may_begin(blob)

    def _is_light(self, blob: Blob) -> bool:
        return blob.fills(self._parameters.min_fill)

    def _make(self, track_id: int, blob: Blob, t_hop_ns: int, tried_ns: int | None) -> Track:
        extent_px = max(_LEAST_EXTENT_PX, blob.extent_px)  # that of a single pixel is 0
        track = MotionTrack(
            track_id, blob.x_px, blob.y_px, blob.t_ns, extent_px, blob.index, blob.t_ns, blob.t_ns,
            matched_ns=t_hop_ns, tried_ns=tried_ns, origin_ns=t_hop_ns, latency_s=self._parameters.event_latency_s,
        )  # fmt: skip
        track.begin(blob.x_px, blob.y_px, blob.t_ns, blob.variance_px2 + FLOOR_PX**2, FIRST_SPEED_PX_PER_S**2)
        track.row[TRUST] = 1.0
        track.row[USUAL] = blob.fresh_count / self._parameters.hop_s
        return track


@njit(cache=True, nogil=True)
def _evidence(rows, forget, offset):  # type: ignore[no-untyped-def]
    """Move the tracks' sums on by a hop; return each one's events of the hop, its index and the spread of the events as an
    extent (px), ``(n, 3)``."""
    found = np.empty((len(rows), 3))
    for i in range(len(rows)):
        row = rows[i]
        own = row[HOP_ON] + row[HOP_OFF]
        spread = np.sqrt(2.0 * row[HOP_RR] / max(own, 1.0))
        area = np.pi * max(row[EXTENT], spread, 1.0) ** 2
        index = 0.0
        for k, on, off in ((0, SHORT_ON, SHORT_OFF), (1, LONG_ON, LONG_OFF)):
            row[on] = row[on] * forget[k] + row[HOP_ON]
            row[off] = row[off] * forget[k] + row[HOP_OFF]
            index = max(index, (row[on] + row[off]) / (offset * area + abs(row[on] - row[off])))
        found[i, 0], found[i, 1], found[i, 2] = own, index, spread
    return found


@njit(cache=True, nogil=True)
def _near(state):  # type: ignore[no-untyped-def]
    """Return of each track which others it may be one light with, ``(n, n)`` bool.

    ``state``: x, y, extent, whether it is quiet.
    """
    n = len(state)
    near = np.zeros((n, n), np.bool_)
    for i in range(n):
        for j in range(n):
            if i != j:
                distance = np.hypot(state[i, 0] - state[j, 0], state[i, 1] - state[j, 1])
                same = distance < _SAME_EXTENTS * min(state[i, 2], state[j, 2])
                within = distance < state[j, 2] and state[i, 3] > 0.0 and state[j, 3] == 0.0
                near[i, j] = same or within
    return near
