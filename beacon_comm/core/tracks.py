"""Tracks: blobs followed from hop to hop under a label that is never given again.

    blobs of a hop ──► nearest pairs first, within the gate ──► matched:   the filter takes the observation
                                                           ├──► no blob:   quiet, position predicted, then lost
                                                           └──► no track:  a new one, strongest blob first

In clutter (:mod:`.clutter`) a hop begins no more than so many tracks, and one whose bit rate nobody knows yet is lost sooner;
where many begin, none has a turn before it has been seen for 0.1 s.
Where ``max_tracks`` are kept, tracks make room for further blobs: first those that are quiet, the longest unseen first, then
those that have had a turn in vain, the last one first, since its next turn is farthest away.  A track with a demodulator
never does, nor one in sight that waits for its first turn.  Where a track was that had its turn, a blob has no first turn
again: it comes after all others, by the time of that turn, here and in the slots' queue, so that lamps do not take turns among
themselves.

The filter is a Kalman filter of constant velocity, both axes alike.  An observation is the mean of n events of a
disc of radius R, so its variance is R² / 4n an axis: a dim blob moves a track little, a bright one at once.
A prediction goes on at constant velocity for a moment and then fades, so that it stays within bounds:

    distance(dt) = v s(dt),   s = dt for dt <= 0.1 s,   0.1 s + 1 s (1 - exp(-(dt - 0.1 s) / 1 s)) after
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numba import njit
from numpy.typing import NDArray

from beacon_comm.core.blobs import Blob
from beacon_comm.core.clutter import Clutter
from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.parameters import Parameters

STEADY_S = 0.1  # a prediction goes on unchanged for this long …
FADE_S = 1.0  # … and then fades with this time constant
_ACCELERATION = 400.0  # white acceleration of the filter (px²/s³): 2 px/s more uncertain after 10 ms
FIRST_SPEED_PX_PER_S = 200.0  # standard deviation of an unknown velocity
_KNOWN_AFTER_NS = 100_000_000  # a velocity seen for less long is not gone on with
FLOOR_PX = 0.05  # an observation is never better than this
SURPRISE = 16.0  # an innovation of more than 4 standard deviations is a manoeuvre
_SAME_RATE = 0.02  # the same beacon's bit rates differ by less
_NEVER = -(1 << 63)
_CLUTTER_NS = 100_000_000  # in clutter, what has been seen for less long has no turn, and what is unseen for so long is lost
Covariance = tuple[tuple[float, float], tuple[float, float]]
"""((xx, xy), (xy, yy))."""
EXTENT_RISE, EXTENT_FALL = 0.5, 0.05  # an extent grows at once and shrinks slowly


@dataclass(slots=True)
class Track:
    """One followed blob.

    Attributes:
        track_id: label, never given twice.
        x_px, y_px: centre (px) at ``t_ns``.
        t_ns: time (ns) of the state.
        extent_px: radius of the blob.
        index: the index I of its last blob.
        first_seen_ns, last_seen_ns: times (ns) of its first and its last observation.
        vx_px_per_s, vy_px_per_s: image velocity (px/s).
        quiet: no blob at the last hop; the position is predicted.
        matched_ns: the last hop (ns) that had a blob of it.
        held: a demodulator listens to it.
        tentative: many began with it, and it has not been seen for long: no demodulator is to listen to it yet.
        read: its bit rate was known at a hop.
        tried_ns: when (ns) its last turn at a demodulator ended, or that of the track that made room there; None: there was
            none, or it has it now.
        covered_since_ns: since when (ns) an older track has had the blob it lies in, None: it lies in none.
        bit_rate_bps: the last settled bit rate (bit/s), None: never one.
        claimed_bps: the bit rate (bit/s) of the lost track whose label it has taken, as long as its own is not known.
        variance: of position (px²), of position and velocity (px²/s), of velocity (px²/s²), one axis.
        noise: white acceleration (px²/s³) that the variance grows by.
    """

    WHERE: ClassVar[tuple[str, ...]] = (
        'x_px', 'y_px', 'vx_px_per_s', 'vy_px_per_s', 't_ns', 'extent_px', 'index', 'last_seen_ns', 'matched_ns', 'quiet',
        'covered_since_ns', 'variance', 'noise',
    )  # fmt: skip
    """The fields that say where something is, not what."""

    track_id: int
    x_px: float
    y_px: float
    t_ns: int
    extent_px: float
    index: float
    first_seen_ns: int
    last_seen_ns: int
    vx_px_per_s: float = 0.0
    vy_px_per_s: float = 0.0
    quiet: bool = False
    matched_ns: int = 0
    held: bool = False
    tentative: bool = False
    read: bool = False
    tried_ns: int | None = None
    covered_since_ns: int | None = None
    bit_rate_bps: float | None = None
    claimed_bps: float | None = None
    variance: tuple[float, float, float] = field(default=(1.0, 0.0, FIRST_SPEED_PX_PER_S**2))
    noise: float = _ACCELERATION

    @property
    def known_bps(self) -> float | None:
        """The bit rate (bit/s) of what its label stands for, None: nobody has read that yet."""
        return self.bit_rate_bps if self.claimed_bps is None else self.claimed_bps

    def position_at(self, t_ns: int) -> tuple[float, float]:
        """Return the predicted centre (px) at ``t_ns`` (ns)."""
        s = fading_s((t_ns - self.t_ns) / NS_PER_S)
        return self.x_px + self.vx_px_per_s * s, self.y_px + self.vy_px_per_s * s

    def variance_at(self, t_ns: int) -> float:
        """Return the variance of the predicted centre (px²), one axis, at ``t_ns`` (ns)."""
        dt = max(0, t_ns - self.t_ns) / NS_PER_S
        pp, pv, vv = self.variance
        return pp + dt * (2 * pv + dt * (vv + self.noise * dt / 3))

    def light_at(self, t_ns: int) -> tuple[float, float]:
        """Return the predicted centre of the light (px) at ``t_ns`` (ns): the same as the events'."""
        return self.position_at(t_ns)

    def covariance_at(self, t_ns: int) -> Covariance | None:
        """Return the covariance of that (px²); None: unknown."""
        return None

    def observe(self, x_px: float, y_px: float, t_ns: int, variance_px2: float) -> None:
        """Take an observation at ``t_ns``; one that is older than the state counts as of the state's time."""
        t_ns = max(t_ns, self.t_ns)
        dt = (t_ns - self.t_ns) / NS_PER_S
        x, y = self.position_at(t_ns)
        dx, dy = x_px - x, y_px - y
        pp, pv, vv = self.variance
        q = _ACCELERATION
        pp, pv, vv = pp + dt * (2 * pv + dt * (vv + q * dt / 3)), pv + dt * (vv + q * dt / 2), vv + q * dt
        surprise = dx * dx + dy * dy
        if dt > 0 and surprise > SURPRISE * (pp + variance_px2):
            vv += surprise / dt**2
            pv += surprise / dt
            pp += surprise
        gain = pp + variance_px2
        kp, kv = pp / gain, pv / gain
        self.x_px, self.y_px, self.t_ns = x + kp * dx, y + kp * dy, t_ns
        self.vx_px_per_s += kv * dx
        self.vy_px_per_s += kv * dy
        self.variance = (1 - kp) * pp, (1 - kp) * pv, vv - kv * pv

    def fall_quiet(self) -> None:
        """Go on by prediction; of the velocity only what is certain is kept, so that a still blob stays."""
        kept = self.certain_share()
        self.vx_px_per_s *= kept
        self.vy_px_per_s *= kept
        self.quiet = True

    def certain_share(self) -> float:
        """Return which share of the velocity is certain."""
        speed2 = self.vx_px_per_s**2 + self.vy_px_per_s**2
        return max(0.0, 1.0 - 8.0 * self.variance[2] / speed2) if speed2 > 0 and self.has_known_velocity else 0.0

    @property
    def has_known_velocity(self) -> bool:
        """Whether it has been seen for long enough for its velocity to be gone on with."""
        return self.last_seen_ns - self.first_seen_ns >= _KNOWN_AFTER_NS

    def stop(self, x_px: float, y_px: float, t_ns: int) -> None:
        """Wait at a place from ``t_ns`` (ns) on."""
        self.x_px, self.y_px, self.t_ns = x_px, y_px, t_ns
        self.vx_px_per_s = self.vy_px_per_s = 0.0


@dataclass(frozen=True, slots=True)
class TrackChanges:
    """What a hop changed.

    Attributes:
        new: tracks that began.
        lost: tracks that ended, unseen for too long, merged or in favour of others, as they were.
        new_blobs: for each new track, which of the hop's blobs it began with.
        waiting: blobs that got no track because ``max_tracks`` are kept, or too many began.
        renamed: new tracks that go on with another's events under a label of their own: that one's label, their own.
    """

    new: tuple[Track, ...] = ()
    lost: tuple[Track, ...] = ()
    new_blobs: tuple[int, ...] = ()
    waiting: int = 0
    renamed: tuple[tuple[int, int], ...] = ()


class Tracker:
    """Keeps the tracks.

    Args:
        parameters: those under "Tracks".
        sensor_size: width and height (px); a prediction ends at the sensor's border.
    """

    def __init__(self, parameters: Parameters, sensor_size: tuple[int, int]) -> None:
        self._parameters = parameters
        self._sensor_size = sensor_size
        self._lost_after_ns = round(parameters.lost_after_s * NS_PER_S)
        self._merge_after_ns = round(parameters.merge_after_s * NS_PER_S)
        self._tracks: dict[int, Track] = {}
        self._next_id = 1
        self._threshold = parameters.index_threshold
        self._most_new = parameters.max_tracks
        # Where tracks made room that had had a turn: x, y, radius (px), and when (ns) that ended.
        self._tried_places: deque[tuple[float, float, float, int]] = deque(maxlen=parameters.max_tracks)

    @property
    def tracks(self) -> Mapping[int, Track]:
        """All tracks by label, oldest first."""
        return self._tracks

    def update(self, blobs: Sequence[Blob], t_hop_ns: int) -> TrackChanges:
        """Associate the blobs of the hop that ends at ``t_hop_ns`` (ns)."""
        if not blobs and not self._tracks:
            return TrackChanges()
        tracks = list(self._tracks.values())
        centre = positions_at(tracks, t_hop_ns)
        blob_of, track_of = self._associate(tracks, centre, blobs, t_hop_ns)
        covering = _covering(centre, blobs, blob_of, track_of)
        for i, track in enumerate(tracks):
            if blob_of[i] >= 0:
                _take(track, blobs[blob_of[i]], t_hop_ns)
            else:
                _miss(track, covering[i] >= 0, t_hop_ns)
                self._keep_on_sensor(track, t_hop_ns)
        lost = tuple(track for track in tracks if self._ended(track, t_hop_ns))
        for track in lost:
            del self._tracks[track.track_id]
        left = self._unfollowed(tracks, blobs, track_of, t_hop_ns)
        return self._begin(left, blobs, lost, t_hop_ns)

    def _begin(
        self, left: list[tuple[int, int]], blobs: Sequence[Blob], lost: tuple[Track, ...], t_hop_ns: int
    ) -> TrackChanges:
        """Begin tracks with the blobs that are left, as far as there is room."""
        waiting, left = max(0, len(left) - self._most_new), left[: self._most_new]
        evicted = self._make_room(left)
        room = max(0, self._parameters.max_tracks - len(self._tracks))
        new = tuple(self._new_track(blobs[j], t_hop_ns, tried_ns) for tried_ns, j in left[:room])
        return TrackChanges(new, lost + evicted, tuple(j for _, j in left[:room]), waiting + len(left) - len(new))

    def heed(self, clutter: Clutter) -> None:
        """Go on with what clutter asks for: the threshold, how many tracks may begin, and whether they are tentative."""
        self._threshold, self._most_new = clutter.threshold, clutter.most_new
        for track in self._tracks.values():
            seen_ns = track.last_seen_ns - track.first_seen_ns
            track.tentative = clutter.crowded and track.known_bps is None and seen_ns < _CLUTTER_NS

    def count_read(self) -> int:
        """Return of how many tracks the bit rate has become known since it was asked for last."""
        read = [track for track in self._tracks.values() if track.known_bps is not None and not track.read]
        for track in read:
            track.read = True
        return len(read)

    def exchange(self, track_id: int, other_id: int) -> None:
        """Let two tracks go on where the other one is."""
        one, other = self._tracks[track_id], self._tracks[other_id]
        for name in one.WHERE:
            mine, its = getattr(one, name), getattr(other, name)
            setattr(one, name, its)
            setattr(other, name, mine)

    def disown(self, track_id: int) -> None:
        """Take a label from a track that is not what it was given it for."""

    def clear(self, sensor_size: tuple[int, int]) -> TrackChanges:
        """Lose every track and go on with a sensor size; labels go on."""
        self._sensor_size = sensor_size
        self._tried_places.clear()
        lost = tuple(self._tracks.values())
        self._tracks.clear()
        return TrackChanges(lost=lost)

    def _associate(
        self, tracks: list[Track], centre: NDArray[np.float64], blobs: Sequence[Blob], t_hop_ns: int
    ) -> tuple[list[int], list[int]]:
        """Return each track's blob and each blob's track, -1 for none: globally nearest pairs first."""
        blob_of, track_of = [-1] * len(tracks), [-1] * len(blobs)
        first, second, distance2 = self._gated(tracks, centre, blobs, t_hop_ns)
        for k in np.lexsort((second, first, distance2)):
            i, j = int(first[k]), int(second[k])
            if blob_of[i] < 0 and track_of[j] < 0:
                blob_of[i], track_of[j] = j, i
        return blob_of, track_of

    def _gated(
        self, tracks: Sequence[Track], centre: NDArray[np.float64], blobs: Sequence[Blob], t_hop_ns: int
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
        """Return the pairs of track and blob within the track's gate, and their squared distances (px²), ``(n,)`` each."""
        if not tracks or not blobs:
            return np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0)
        state = np.array(
            [
                (x, y, track.vx_px_per_s, track.vy_px_per_s, self._gate_px(track, t_hop_ns))
                for track, (x, y) in zip(tracks, centre.tolist(), strict=True)
            ]
        )
        seen = np.array(
            [(blob.x_px, blob.y_px, (t_hop_ns - blob.t_ns) / NS_PER_S, self._is_light(blob)) for blob in blobs], np.float64
        )
        first, second, distance2 = _pairs(state, seen)
        return first, second, distance2

    def _gate_px(self, track: Track, t_hop_ns: int) -> float:
        p = self._parameters
        gate_px = p.association_gate_px + p.gate_growth_px_per_s * (t_hop_ns - track.matched_ns) / NS_PER_S
        # The centre of a large blob is uncertain by a share of its size.
        return max(min(p.max_gate_px, gate_px), track.extent_px)

    def _keep_on_sensor(self, track: Track, t_hop_ns: int) -> None:
        """Let an unseen track wait at the border where it left: it cannot be seen beyond."""
        x, y = track.position_at(t_hop_ns)
        kept = min(max(x, 0.0), self._sensor_size[0] - 1.0), min(max(y, 0.0), self._sensor_size[1] - 1.0)
        if kept != (x, y):
            track.stop(*kept, t_hop_ns)

    def _ended(self, track: Track, t_hop_ns: int) -> bool:
        lost_after_ns = self._lost_after_ns
        if self._may_be_clutter(track):
            lost_after_ns = min(_CLUTTER_NS, lost_after_ns)
        if track.quiet and t_hop_ns - track.last_seen_ns >= lost_after_ns:
            return True
        since = track.covered_since_ns
        return since is not None and t_hop_ns - since >= self._merge_after_ns

    def _may_be_clutter(self, track: Track) -> bool:
        """Return whether there is clutter, and nothing says that a track is not of it."""
        return self._threshold > self._parameters.index_threshold and track.known_bps is None

    def _unfollowed(
        self,
        tracks: Sequence[Track],
        blobs: Sequence[Blob],
        track_of: list[int],
        t_hop_ns: int,
    ) -> list[tuple[int, int]]:
        """Return the blobs that are to begin tracks, the first one first, each behind the time (ns) of the turn that was had
        there, ``_NEVER`` without one; pieces of a followed blob are not among them."""
        left = [j for j in range(len(blobs)) if track_of[j] < 0 and self._may_begin(blobs[j])]
        seen = [track for track in tracks if not track.quiet]
        if left and seen:
            circle = np.column_stack((positions_at(seen, t_hop_ns), [track.extent_px for track in seen]))
            piece_of = _circle_of(np.array([(blobs[j].x_px, blobs[j].y_px) for j in left]), circle)
            left = [j for j, i in zip(left, piece_of, strict=True) if i < 0]
        tried_ns = self._tried_there(left, blobs)
        return sorted(
            zip(tried_ns, left, strict=True), key=lambda entry: (entry[0], -blobs[entry[1]].index, -blobs[entry[1]].event_count)
        )

    def _tried_there(self, left: list[int], blobs: Sequence[Blob]) -> list[int]:
        if not left or not self._tried_places:
            return [_NEVER] * len(left)
        centres = np.array([(blobs[j].x_px, blobs[j].y_px) for j in left])
        circles = np.array([place[:3] for place in self._tried_places])
        return [self._tried_places[k][3] if k >= 0 else _NEVER for k in _circle_of(centres, circles)]

    def _make_room(self, left: list[tuple[int, int]]) -> tuple[Track, ...]:
        """End tracks in favour of the blobs that are left over; see the module's head."""
        room = max(0, self._parameters.max_tracks - len(self._tracks))
        if len(left) <= room:
            return ()
        unheld = [track for track in self._tracks.values() if not track.held]
        quiet = sorted((track for track in unheld if track.quiet), key=lambda track: track.last_seen_ns)
        tried = sorted(
            ((track.tried_ns, track) for track in unheld if track.tried_ns is not None and not track.quiet),
            key=lambda entry: (-entry[0], entry[1].track_id),
        )
        ended = []
        for blob_tried_ns, _ in left[room:]:
            if quiet:
                ended.append(quiet.pop(0))
            elif tried and tried[0][0] > blob_tried_ns:
                ended.append(tried.pop(0)[1])
            else:
                break
        for track in ended:
            del self._tracks[track.track_id]
            if track.tried_ns is not None:
                self._tried_places.append((track.x_px, track.y_px, max(track.extent_px, 1.0), track.tried_ns))
        return tuple(ended)

    def _may_begin(self, blob: Blob) -> bool:
        """Return whether a track may begin with a blob."""
        return self._is_light(blob)

    def _is_light(self, blob: Blob) -> bool:
        """Return whether a blob may be a light at all."""
        return True

    def _new_track(self, blob: Blob, t_hop_ns: int, tried_ns: int) -> Track:
        track = self._make(self._next_id, blob, t_hop_ns, None if tried_ns == _NEVER else tried_ns)
        self._tracks[track.track_id] = track
        self._next_id += 1
        return track

    def _make(self, track_id: int, blob: Blob, t_hop_ns: int, tried_ns: int | None) -> Track:
        variance = (blob.variance_px2 + FLOOR_PX**2, 0.0, FIRST_SPEED_PX_PER_S**2)
        return Track(
            track_id, blob.x_px, blob.y_px, blob.t_ns, blob.extent_px, blob.index, blob.t_ns, blob.t_ns,
            matched_ns=t_hop_ns, tried_ns=tried_ns, variance=variance,
        )  # fmt: skip


def is_same_rate(one_bps: float, other_bps: float) -> bool:
    """Return whether two bit rates (bit/s) may be one beacon's."""
    return abs(one_bps / other_bps - 1.0) <= _SAME_RATE


def positions_at(tracks: Sequence[Track], t_ns: int) -> NDArray[np.float64]:
    """Return the predicted centres (px) of tracks at ``t_ns`` (ns), ``(n, 2)`` float64."""
    return np.array([track.position_at(t_ns) for track in tracks]).reshape(-1, 2)


def _take(track: Track, blob: Blob, t_hop_ns: int) -> None:
    """Let a track take its blob; one without new events is seen, but tells nothing new about the position."""
    if blob.fresh:
        track.observe(blob.x_px, blob.y_px, blob.t_ns, blob.variance_px2 + FLOOR_PX**2)
        track.last_seen_ns = blob.t_ns
    gain = EXTENT_RISE if blob.extent_px > track.extent_px else EXTENT_FALL
    track.extent_px += gain * (blob.extent_px - track.extent_px)
    track.index = blob.index
    track.quiet = False
    track.matched_ns = t_hop_ns
    track.covered_since_ns = None


def _miss(track: Track, covered: bool, t_hop_ns: int) -> None:
    if not track.quiet:
        track.fall_quiet()
    if not covered:
        track.covered_since_ns = None
    elif track.covered_since_ns is None:
        track.covered_since_ns = t_hop_ns


def _covering(
    centre: NDArray[np.float64], blobs: Sequence[Blob], blob_of: list[int], track_of: list[int]
) -> list[int]:
    """Return for each track without a blob the followed one it lies in, -1 for none.

    An older track takes such a blob over from a younger one: of tracks that merge the older goes on.
    """
    covering = [-1] * len(centre)
    followed = [j for j in range(len(blobs)) if track_of[j] >= 0]
    if not followed or all(j >= 0 for j in blob_of):
        return covering
    circle = np.array([(blobs[j].x_px, blobs[j].y_px, blobs[j].extent_px) for j in followed])
    within = _circle_of(centre, circle)
    lone = deque(i for i in range(len(centre)) if blob_of[i] < 0 and within[i] >= 0)
    while lone:  # oldest first; a younger track that loses its blob joins the end
        i = lone.popleft()
        if within[i] < 0:
            continue
        j = followed[within[i]]
        if track_of[j] > i:
            younger = track_of[j]
            blob_of[younger], blob_of[i], track_of[j] = -1, j, i
            lone.append(younger)
        else:
            covering[i] = j
    return covering


def fading_s(dt_s: float) -> float:
    """Return s(dt), see the module's head."""
    if dt_s <= STEADY_S:
        return dt_s
    return STEADY_S + FADE_S * (1.0 - math.exp((STEADY_S - dt_s) / FADE_S))


@njit(cache=True, nogil=True)
def _pairs(state, seen):  # type: ignore[no-untyped-def]
    """List the pairs of track and light within the track's gate, and their squared distances.

    ``state``: x, y at the hop, velocity, gate; ``seen``: x, y, age of the blob (s), whether it may be a light.
    """
    first, second, distance2 = [], [], []
    for i in range(len(state)):
        for j in range(len(seen)):
            dx = seen[j, 0] - (state[i, 0] - state[i, 2] * seen[j, 2])
            dy = seen[j, 1] - (state[i, 1] - state[i, 3] * seen[j, 2])
            d2 = dx * dx + dy * dy
            if seen[j, 3] and d2 <= state[i, 4] ** 2:
                first.append(i)
                second.append(j)
                distance2.append(d2)
    return np.array(first, np.int64), np.array(second, np.int64), np.array(distance2)


@njit(cache=True, nogil=True)
def _circle_of(point, circle):  # type: ignore[no-untyped-def]
    """Return for each point the circle (x, y, radius) it lies deepest in, -1 for none, ``(n,)`` int64."""
    found = np.full(len(point), -1, np.int64)
    for i in range(len(point)):
        deepest = 0.0
        for j in range(len(circle)):
            depth = circle[j, 2] - np.hypot(point[i, 0] - circle[j, 0], point[i, 1] - circle[j, 1])
            if depth > deepest:
                found[i], deepest = j, depth
    return found
