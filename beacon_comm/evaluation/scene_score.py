"""What the receiver made of a scene, against the truth: characters, tracks, confirmations, positions, times.

::

    beacon's true path   ~~~~~~~~●~~~~~~~~          a track is *on* a beacon within its radius, 3 px at least
    track                ········×········          its characters are the beacon's, scored where they are known to be due
                                                    (a character's track may be twice as far off)
    first complete character ──┬─ lock: the first right character given out ──┬─ confirmed
                               └───────────────── times are counted from here ┘

Reports are the confirmed tracks, at the instants at which they are: what the receiver says is a beacon.  No report is a track
on a reflection of a beacon, nor one without events whose nearest beacon is hidden: it coasts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.character import Character
from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.evaluation.intervals import bootstrap_interval
from beacon_comm.evaluation.reliability import OUTSIDE, judged
from beacon_comm.evaluation.result import BeaconResult, PathPoint
from beacon_comm.evaluation.scene_truth import IGNORED_KINDS, Sight, TrueBeacon, dues, runs_in_sight
from beacon_comm.evaluation.scoring import Interval, Transmission, not_found, score, score_at, wilson_interval
from beacon_comm.evaluation.tracking import Instants, Matches, TrackingScore, block_counts, match, score_tracking

LEAST_GATE_PX = 3.0
# A character's track may be this many gates off its beacon.
CHARACTER_GATES = 2.0
BLOCK_NS = NS_PER_S // 2
# Below this speed (px/s) a lag cannot be told from any other error.
SLOWEST_LAG_PX_PER_S = 50.0
_SPEED_STEP_NS = 1_000_000

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Lock:
    """How the receiver came to read a beacon that came in sight.

    Attributes:
        begin_ns: when the first complete character in sight began (recording time, ns).
        lock_s: from there to the first right character being given out (s), None: none was.
        lost: complete characters before the one that was first read right, None: none was.
    """

    begin_ns: int
    lock_s: float | None
    lost: int | None


@dataclass(frozen=True, slots=True, eq=False)
class PositionScore:
    """How far confirmed tracks were from the true centre, at the instants at which they were on the beacon.

    Attributes:
        t_ns, error_px: of each instant, ``(n,)`` int64 and ``(n, 2)``: reported less true.
        rms_px, median_px, p95_px: of the distance.
        interval_px: 95 % interval of the rms; None: too short to tell.
        lag_s: how far the track is behind along its motion, over its speed (s); None where it hardly moved.
        speed_px_per_s: mean true speed.
        nees: mean of eᵀ P⁻¹ e / 2, 1 where the stated covariance P is true; None: none is stated.
        nees_interval: of it.
        bearing_rms_rad: of the angle to the true bearing, None without calibration.
        bearing_nees, bearing_nees_interval: as ``nees``, of azimuth and elevation.
    """

    t_ns: Ints
    error_px: Floats
    rms_px: float
    median_px: float
    p95_px: float
    interval_px: Interval | None
    lag_s: float | None
    speed_px_per_s: float
    nees: float | None
    nees_interval: Interval | None
    bearing_rms_rad: float | None
    bearing_nees: float | None
    bearing_nees_interval: Interval | None


@dataclass(frozen=True, slots=True, eq=False)
class BeaconScore:
    """What the receiver made of one beacon.

    Attributes:
        name, kind, text, bit_rate_bps: as the truth says; the rate may be None.
        tracks: labels of the tracks that were on it while confirmed, in order.
        seen_s: how long it was in sight (s).
        transmissions: scores of what it sent in sight, in order of time; empty: it is not known when it sent what.
        locks: for each stretch in sight that holds a complete character.
        confirm_s: from the first complete character to a track on it being confirmed (s), None: never, or not known.
        position: None: no confirmed track was on it.
        characters: decoded by tracks on it, in order of time.
        verdicts: of each of these 1 right, 0 wrong, -1 outside all that was sent in sight, ``(n,)`` int8.
    """

    name: str
    kind: str
    text: str | None
    bit_rate_bps: float | None
    tracks: tuple[int, ...]
    seen_s: float
    transmissions: tuple[Transmission, ...]
    locks: tuple[Lock, ...]
    confirm_s: float | None
    position: PositionScore | None
    characters: tuple[Character, ...] = field(repr=False)
    verdicts: NDArray[np.int8] = field(repr=False)

    @property
    def sent(self) -> Count:
        """Characters and bits of all that it sent in sight."""
        return Count.of(self.transmissions)


@dataclass(frozen=True, slots=True)
class Count:
    """Characters and bits, of one beacon or of many; see :mod:`.scoring` for what they are.

    Attributes:
        characters, wrong, missing, inserted, wrong_ok: as in :class:`~.scoring.Transmission`.
        bits, wrong_bits: likewise.
    """

    characters: int
    wrong: int
    missing: int
    inserted: int
    wrong_ok: int
    bits: int
    wrong_bits: int

    @classmethod
    def of(cls, transmissions: Sequence[Transmission]) -> Count:
        """Add up scores."""
        names = ('characters', 'wrong', 'missing', 'inserted', 'wrong_ok', 'bits', 'wrong_bits')
        return cls(*(sum(getattr(one, name) for one in transmissions) for name in names))

    @property
    def message_accuracy(self) -> float:
        """1 - wrong / characters, 0 at least; NaN without any."""
        return max(0.0, 1.0 - self.wrong / self.characters) if self.characters else math.nan

    @property
    def bit_accuracy(self) -> float:
        """1 - wrong bits / bits; NaN without any."""
        return 1.0 - self.wrong_bits / self.bits if self.bits else math.nan

    @property
    def message_interval(self) -> Interval:
        """95 % interval (Wilson), as if characters erred independently."""
        return wilson_interval(self.message_accuracy if self.characters else 0.0, self.characters)

    @property
    def bit_interval(self) -> Interval:
        """95 % interval (Wilson), as if bits erred independently."""
        return wilson_interval(self.bit_accuracy if self.bits else 0.0, self.bits)


@dataclass(frozen=True, slots=True)
class SceneScore:
    """What the receiver made of a scene.

    Attributes:
        beacons: in the order of the truth; reflections are not among them.
        confirmed: measures of the confirmed tracks.
        tracks: measures of all tracks, candidates too: what detection finds; its false positives are other blobs.
        mota_interval, motp_interval: 95 %, of the confirmed tracks, from stretches of half a second.
        false_confirmations: labels of tracks that were on no beacon when they were confirmed.
        on_reflections: labels of tracks that were on a reflection then.
        stray_characters: decoded by tracks on no beacon.
        double_characters: decoded by a second track on a beacon, where another one had read it already; not counted.
    """

    beacons: tuple[BeaconScore, ...]
    confirmed: TrackingScore
    tracks: TrackingScore
    mota_interval: Interval | None
    motp_interval: Interval | None
    false_confirmations: tuple[int, ...]
    on_reflections: tuple[int, ...]
    stray_characters: int
    double_characters: int

    @property
    def sent(self) -> Count:
        """Characters and bits of all beacons."""
        return Count.of([one for beacon in self.beacons for one in beacon.transmissions])


class _Truth:
    """True paths at the sampled instants; places of beacons as in ``beacons``."""

    def __init__(self, beacons: Sequence[TrueBeacon], t_ns: Ints, shift_ns: int) -> None:
        self.beacons = beacons
        self.shift_ns = shift_ns
        scene_ns = t_ns + shift_ns
        shape = (len(t_ns), len(beacons))
        self.centre = np.empty((*shape, 2))
        self.velocity = np.empty((*shape, 2))
        self.gate_px = np.empty(shape)
        self.visible = np.empty(shape, np.bool_)
        self.ignored = np.array([beacon.kind in IGNORED_KINDS for beacon in beacons], np.bool_)
        for b, beacon in enumerate(beacons):
            self.centre[:, b] = np.column_stack(beacon.centre(scene_ns))
            ahead, behind = (np.column_stack(beacon.centre(scene_ns + step)) for step in (_SPEED_STEP_NS, -_SPEED_STEP_NS))
            self.velocity[:, b] = (ahead - behind) * (NS_PER_S / 2.0 / _SPEED_STEP_NS)
            self.gate_px[:, b] = np.maximum(LEAST_GATE_PX, beacon.radius_px(scene_ns))
            self.visible[:, b] = beacon.visible(scene_ns)

    def nearest(self, x_px: Floats, y_px: Floats, t_ns: Ints, gates: float) -> Ints:
        """Return which beacon, hidden or not, each point is on within so many gates, -1: none, ``(n,)``."""
        best = np.full(len(t_ns), -1, np.int64)
        least = np.full(len(t_ns), gates)
        for b, beacon in enumerate(self.beacons):
            bx, by = beacon.centre(t_ns + self.shift_ns)
            gate = np.maximum(LEAST_GATE_PX, beacon.radius_px(t_ns + self.shift_ns))
            off = np.hypot(x_px - bx, y_px - by) / gate
            nearer = off <= least
            best[nearer], least[nearer] = b, off[nearer]
        return best


def score_scene(
    tracks: Sequence[BeaconResult],
    instants_ns: Ints,
    beacons: Sequence[TrueBeacon],
    shift_ns: int,
    span_ns: tuple[int, int],
    frame: CharacterFrame | None = None,
    text: str | None = None,
) -> SceneScore:
    """Score all tracks of a recording against the truth.

    Args:
        tracks: all of them, silent ones too; their paths are sampled at ``instants_ns``.
        instants_ns: recording time (ns), increasing, ``(T,)`` int64.
        beacons: the truth.
        shift_ns: scene time less recording time (ns).
        span_ns: begin and end of the recording (recording time, ns).
        frame: layout of a character; the default one if None.
        text: what a beacon sends of which the truth does not say.
    """
    frame = CharacterFrame() if frame is None else frame
    truth = _Truth(beacons, instants_ns, shift_ns)
    places = [int(b) for b in np.flatnonzero(~truth.ignored)]
    positions, confirmed, quiet, points = _sampled(tracks, instants_ns)
    reports = _reports(truth, positions, quiet)
    objects = np.where(truth.visible[..., None], truth.centre, np.nan)[:, places]
    gate_px = truth.gate_px[:, places]
    ever = confirmed.any(axis=0)
    claimed = Instants(objects, np.where(confirmed[..., None], reports, np.nan)[:, ever], gate_px)
    matches = match(claimed)
    labels = np.array([track.track_id for track in tracks], np.int64)[ever]
    claimed_points = [points[m] for m in np.flatnonzero(ever)]
    owned, stray, doubles = _characters_of(tracks, truth, frame)
    false, on_reflections, confirmed_ns = _confirmations(tracks, truth)
    scores = [
        _beacon_score(
            beacons[b],
            owned[b],
            Sight.of(beacons[b], span_ns, shift_ns),
            confirmed_ns.get(b),
            tuple(dict.fromkeys(int(labels[m]) for m in matches.track[:, place] if m >= 0)),
            _position(truth, b, instants_ns, matches.track[:, place], claimed_points),
            shift_ns,
            frame,
            text,
        )
        for place, b in enumerate(places)
    ]
    mota_interval, motp_interval = _tracking_intervals(claimed, matches, instants_ns)
    return SceneScore(
        tuple(scores),
        score_tracking(claimed, matches),
        score_tracking(Instants(objects, reports, gate_px)),
        mota_interval,
        motp_interval,
        false,
        on_reflections,
        stray,
        doubles,
    )


Points = list[PathPoint | None]


def _sampled(
    tracks: Sequence[BeaconResult], instants_ns: Ints
) -> tuple[Floats, NDArray[np.bool_], NDArray[np.bool_], list[Points]]:
    """Return where the tracks were ``(T, M, 2)``, whether confirmed and whether quiet ``(T, M)``, and the points."""
    row = {int(t): n for n, t in enumerate(instants_ns)}
    shape = (len(instants_ns), len(tracks))
    positions = np.full((*shape, 2), np.nan)
    confirmed, quiet = np.zeros(shape, np.bool_), np.zeros(shape, np.bool_)
    points: list[Points] = [[None] * len(instants_ns) for _ in tracks]
    for m, track in enumerate(tracks):
        for point in track.path:
            n = row.get(point.t_ns)
            if n is not None:
                positions[n, m] = point.x_px, point.y_px
                confirmed[n, m], quiet[n, m] = point.confirmed, point.quiet
                points[m][n] = point
    return positions, confirmed, quiet, points


def _reports(truth: _Truth, positions: Floats, quiet: NDArray[np.bool_]) -> Floats:
    """Return the positions without those that are no reports: on something ignored, or coasting behind what hides it."""
    kept = positions.copy()
    for m in range(positions.shape[1]):
        off = np.hypot(*np.moveaxis(truth.centre - positions[:, m, None], -1, 0))  # NaN where the track was not
        on = (off <= truth.gate_px) & truth.visible
        drop = on[:, truth.ignored].any(axis=1) & ~on[:, ~truth.ignored].any(axis=1)
        if off.shape[1]:
            nearest = np.argmin(np.where(np.isnan(off), np.inf, off), axis=1)
            drop |= quiet[:, m] & ~truth.visible[np.arange(len(off)), nearest]
        kept[drop, m] = np.nan
    return kept


def _at(track: BeaconResult, t_ns: Ints) -> tuple[Floats, Floats]:
    """Return where a track was (px); before and after its path it stood still."""
    times = np.array([point.t_ns for point in track.path], np.float64)
    return (
        np.interp(t_ns, times, [point.x_px for point in track.path]),
        np.interp(t_ns, times, [point.y_px for point in track.path]),
    )


Received = tuple[Character, int]
# A second track's character is another one if it is this far from all of the first's (characters).
ANOTHER = 0.75


def primary(tracks: Sequence[BeaconResult], frame: CharacterFrame) -> tuple[list[Received], int]:
    """Return what one beacon's tracks read, with the times it was given out at, each character once; and the number of doubles.

    The track with most characters goes first; of the others counts what lies where there is nothing yet.
    """
    kept: list[Received] = []
    doubles = 0
    for track in sorted(tracks, key=lambda one: -len(one.characters)):
        times = np.sort(np.array([character.t_ns for character, _ in kept], np.float64))
        received_ns = track.received_ns or tuple(character.t_ns for character in track.characters)
        for character, received in zip(track.characters, received_ns, strict=True):
            apart_ns = ANOTHER * frame.duration_ns(character.bit_rate_bps)
            place = int(np.searchsorted(times, character.t_ns))
            near = times[max(0, place - 1) : place + 1]
            if len(near) and np.abs(near - character.t_ns).min() < apart_ns:
                doubles += 1
            else:
                kept.append((character, received))
    kept.sort(key=lambda received: received[0].t_ns)
    return kept, doubles


def primary_characters(tracks: Sequence[BeaconResult], frame: CharacterFrame) -> list[Character]:
    """Return the characters of :func:`primary`, in order of time."""
    return [character for character, _ in primary(tracks, frame)[0]]


def _characters_of(
    tracks: Sequence[BeaconResult], truth: _Truth, frame: CharacterFrame
) -> tuple[list[list[Received]], int, int]:
    """Return each beacon's characters with the times they were given out at, how many are no beacon's, and how many doubles."""
    parts: list[list[BeaconResult]] = [[] for _ in truth.beacons]
    stray = doubles = 0
    for track in tracks:
        if not track.characters or not track.path:
            continue
        t_ns = np.array([character.t_ns for character in track.characters], np.int64)
        # A track's path begins where it was seen first; what was read back before that was there, too.
        t_ns = np.maximum(t_ns, track.path[0].t_ns)
        on = truth.nearest(*_at(track, t_ns), t_ns, CHARACTER_GATES)
        stray += int(np.count_nonzero(on < 0))
        for b in np.unique(on[on >= 0]):
            own = np.flatnonzero(on == b)
            received_ns = tuple(track.received_ns[n] for n in own) if track.received_ns else ()
            parts[b].append(replace(track, characters=tuple(track.characters[n] for n in own), received_ns=received_ns))
    owned = []
    for part in parts:
        received, twice = primary(part, frame)
        owned.append(received)
        doubles += twice
    return owned, stray, doubles


def _confirmations(
    tracks: Sequence[BeaconResult], truth: _Truth
) -> tuple[tuple[int, ...], tuple[int, ...], dict[int, int]]:
    """Return the tracks confirmed on nothing and on something ignored, and when each beacon was confirmed first (ns)."""
    false, ignored = [], []
    first: dict[int, int] = {}
    for track in tracks:
        if track.confirmed_seen_ns is None or not track.path:
            continue
        t_ns = np.array([track.confirmed_seen_ns], np.int64)
        b = int(truth.nearest(*_at(track, t_ns), t_ns, CHARACTER_GATES)[0])
        if b < 0:
            false.append(track.track_id)
        elif truth.ignored[b]:
            ignored.append(track.track_id)
        else:
            first[b] = min(first.get(b, track.confirmed_seen_ns), track.confirmed_seen_ns)
    return tuple(false), tuple(ignored), first


def _beacon_score(
    beacon: TrueBeacon,
    received: list[Received],
    sight: Sight,
    confirmed_ns: int | None,
    tracks: tuple[int, ...],
    position: PositionScore | None,
    shift_ns: int,
    frame: CharacterFrame,
    text: str | None,
) -> BeaconScore:
    characters = [character for character, _ in received]
    text = beacon.text or text or ''
    transmissions = score_at(characters, text, runs, frame) if (runs := runs_in_sight(beacon, sight, shift_ns, frame)) else ()
    if not runs and text and sight.visible.any():
        # It is not known when it sent: that is found in what was decoded, as for a recording without a truth beside it.
        seen_ns = (int(sight.t_ns[sight.visible][0]), int(sight.t_ns[sight.visible][-1]))
        runs = transmissions = score(characters, text, seen_ns, None, frame)
        if not runs and confirmed_ns is not None:
            transmissions = (not_found(text, frame),)
    verdicts = judged(characters, dues(runs, text, frame)) if runs else np.full(len(characters), OUTSIDE, np.int8)
    locks = _locks(received, verdicts, runs, sight, frame)
    step_s = float(sight.t_ns[1] - sight.t_ns[0]) / NS_PER_S if len(sight.t_ns) > 1 else 0.0
    return BeaconScore(
        name=beacon.name,
        kind=beacon.kind,
        text=text or None,
        bit_rate_bps=beacon.bit_rate_bps,
        tracks=tracks,
        seen_s=float(sight.visible.sum()) * step_s,
        transmissions=transmissions,
        locks=locks,
        confirm_s=None if confirmed_ns is None or not locks else (confirmed_ns - locks[0].begin_ns) / NS_PER_S,
        position=position,
        characters=tuple(characters),
        verdicts=verdicts,
    )


def _locks(
    received: list[Received],
    verdicts: NDArray[np.int8],
    runs: Sequence[Transmission],
    sight: Sight,
    frame: CharacterFrame,
) -> tuple[Lock, ...]:
    """Return how each stretch in sight was come to be read."""
    due_ns = [
        run.start_ns + k * frame.duration_ns(run.bit_rate_bps)
        for run in runs
        if run.start_ns is not None and run.bit_rate_bps is not None
        for k in range(run.first, run.first + run.characters)
    ]
    due = np.sort(np.array(due_ns, np.float64))
    right = [(character.t_ns, at) for (character, at), verdict in zip(received, verdicts, strict=True) if verdict == 1]
    locks = []
    for begin_ns, end_ns in sight.intervals_ns():
        inside = due[(due >= begin_ns) & (due < end_ns)]
        if not len(inside):
            continue
        spacing = float(np.median(np.diff(inside))) if len(inside) > 1 else 0.0
        read = [(t, at) for t, at in right if begin_ns - spacing / 2.0 <= t < end_ns]
        begin = float(inside[0])
        if not read:
            locks.append(Lock(round(begin), None, None))
            continue
        first_ns = min(t for t, _ in read)
        lost = int(np.searchsorted(inside, first_ns - spacing / 2.0))
        locks.append(Lock(round(begin), (min(at for _, at in read) - begin) / NS_PER_S, lost))
    return tuple(locks)


def _position(truth: _Truth, b: int, instants_ns: Ints, track: Ints, points: Sequence[Points]) -> PositionScore | None:
    """Return how near the matched tracks' points were."""
    rows = np.flatnonzero(track >= 0)
    on = [(n, point) for n in rows if (point := points[track[n]][n]) is not None]
    if not on:
        return None
    rows = np.array([n for n, _ in on], np.int64)
    t_ns = instants_ns[rows]
    error = np.array([(point.x_px, point.y_px) for _, point in on]) - truth.centre[rows, b]
    distance = np.hypot(error[:, 0], error[:, 1])
    velocity = truth.velocity[rows, b]
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    fast = speed >= SLOWEST_LAG_PX_PER_S
    lag_s = -float((error * velocity)[fast].sum() / (velocity[fast] ** 2).sum()) if fast.any() else None
    squares = _blocks(t_ns, distance**2)
    rms = bootstrap_interval(squares, lambda sums: np.sqrt(sums[:, 0] / sums[:, 1]))
    nees, nees_interval = _consistency(t_ns, error, [point.covariance_px2 for _, point in on])
    angles = _bearing_errors(truth.beacons[b], t_ns + truth.shift_ns, [point for _, point in on])
    bearing: tuple[float | None, Interval | None] = (None, None)
    if angles is not None:
        bearing = _consistency(t_ns, angles[1], [point.covariance_rad2 for _, point in on])
    return PositionScore(
        t_ns=t_ns,
        error_px=error,
        rms_px=float(np.sqrt(np.mean(distance**2))),
        median_px=float(np.median(distance)),
        p95_px=float(np.quantile(distance, 0.95)),
        interval_px=rms,
        lag_s=lag_s,
        speed_px_per_s=float(speed.mean()),
        nees=nees,
        nees_interval=nees_interval,
        bearing_rms_rad=None if angles is None else float(np.sqrt(np.mean(angles[0] ** 2))),
        bearing_nees=bearing[0],
        bearing_nees_interval=bearing[1],
    )


def _consistency(
    t_ns: Ints, error: Floats, covariances: Sequence[tuple[float, float, float] | None]
) -> tuple[float | None, Interval | None]:
    """Return the mean of the normalised errors squared over their expectation, and its interval; None: none is stated."""
    found = [(n, _nees(error[n], one)) for n, one in enumerate(covariances)]
    rows = [n for n, value in found if value is not None]
    values = np.array([value for _, value in found if value is not None], np.float64)
    if not rows:
        return None, None
    return float(values.mean()), bootstrap_interval(_blocks(t_ns[rows], values), lambda sums: sums[:, 0] / sums[:, 1])


def _nees(error: Floats, covariance: tuple[float, float, float] | None) -> float | None:
    """Return eᵀ P⁻¹ e over its expectation, 2 (Y. Bar-Shalom et al., 2001, section 5.4); P as xx, xy, yy."""
    if covariance is None:
        return None
    xx, xy, yy = covariance
    determinant = xx * yy - xy * xy
    if not determinant > 0.0:
        return None
    x, y = error
    return float((yy * x * x - 2.0 * xy * x * y + xx * y * y) / determinant) / 2.0


def _bearing_errors(
    beacon: TrueBeacon, scene_ns: Ints, points: Sequence[PathPoint]
) -> tuple[Floats, Floats] | None:
    """Return the angles between the bearings (rad) ``(n,)``, and the errors of azimuth and elevation (rad) ``(n, 2)``."""
    true = beacon.bearing(scene_ns)
    pairs = [(point.azimuth_rad, point.elevation_rad) for point in points]
    if true is None or any(a is None or e is None for a, e in pairs):
        return None
    azimuth, elevation = np.array(pairs, np.float64).T
    true_azimuth, true_elevation = (np.asarray(angle, np.float64) for angle in true)
    turned = (azimuth - true_azimuth + np.pi) % (2.0 * np.pi) - np.pi
    # The angle on the sphere, by haversines: exact for small ones.
    across = np.cos(elevation) * np.cos(true_elevation) * np.sin(turned / 2.0) ** 2
    angle = 2.0 * np.arcsin(np.sqrt(np.sin((elevation - true_elevation) / 2.0) ** 2 + across))
    return angle, np.column_stack((turned, elevation - true_elevation))


def _blocks(t_ns: Ints, values: Floats) -> Floats:
    """Return sum and number of the values of each half second, ``(n, 2)``."""
    if not len(t_ns):
        return np.empty((0, 2))
    _, block = np.unique(t_ns // BLOCK_NS, return_inverse=True)
    return np.column_stack((np.bincount(block, values), np.bincount(block))).astype(np.float64)


def _tracking_intervals(instants: Instants, matches: Matches, t_ns: Ints) -> tuple[Interval | None, Interval | None]:
    if len(t_ns) < 2:
        return None, None
    block = max(1, round(BLOCK_NS / float(np.median(np.diff(t_ns)))))
    counts = block_counts(instants, matches, block)
    return (
        bootstrap_interval(counts, lambda sums: 1.0 - sums[:, 1] / sums[:, 0]),
        bootstrap_interval(counts, lambda sums: sums[:, 3] / sums[:, 2]),
    )
