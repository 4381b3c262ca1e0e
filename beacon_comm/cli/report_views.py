"""What ``beacon_evaluate --report`` draws of a recording: it is read a second time for the events that are looked at.

::

    results of all receivers ──► subjects: one a beacon ──► when to look ──┐
    recording ──────────────────────────────────────────────────────────────┴─► events near it ──► signal, image
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from beacon_comm.cli.bag_pieces import BagPieces
from beacon_comm.cli.offline import Options, is_mat
from beacon_comm.cli.scene_truth import scene_time_ns, truth_beside
from beacon_comm.core.character import Character
from beacon_comm.core.events import NS_PER_S, EventBatch
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.evaluation.near_path import NearPath
from beacon_comm.evaluation.report import listed
from beacon_comm.evaluation.result import BeaconResult, PathPoint, RecordingResult
from beacon_comm.evaluation.scoring import Transmission
from beacon_comm.evaluation.views import (
    ImageView,
    PathView,
    SignalView,
    Stretch,
    choose_stretch,
    image_span_ns,
    sent_within,
    thin,
    trace_filter,
    view_image,
)
from beacon_comm.recordings.bags import open_recording
from beacon_comm.recordings.mat import read_mat
from beacon_comm.simulation.truth import SceneTruth

MOST_SIGNALS = 6
SAME_PLACE_PX = 8.0
PATH_STEP_NS = 2_000_000


@dataclass
class Subject:
    """One beacon, as all receivers saw it.

    Attributes:
        name: of the beacon.
        text: what it sent, None: not known.
        scores: transmissions by receiver.
        characters: by receiver, in order of time.
        path: where to look for its events; none: the recording has no pixels.
    """

    name: str
    text: str | None
    scores: dict[str, Sequence[Transmission]] = field(default_factory=dict)
    characters: dict[str, Sequence[Character]] = field(default_factory=dict)
    path: Sequence[PathPoint] = ()

    @property
    def wrong_share(self) -> float:
        """Share of wrong characters, of all receivers together; 0 without scores."""
        all_scores = [one for transmissions in self.scores.values() for one in transmissions]
        return sum(one.wrong for one in all_scores) / max(1, sum(one.characters for one in all_scores))


@dataclass(frozen=True)
class RecordingView:
    """What is drawn of one recording.

    Attributes:
        results: one a receiver.
        subjects: its beacons.
        signals: of some of them, those with most errors first.
        image: None for a recording without pixels.
    """

    results: Sequence[RecordingResult]
    subjects: Sequence[Subject]
    signals: Sequence[SignalView]
    image: ImageView | None


def view_recording(results: Sequence[RecordingResult], options: Options) -> RecordingView:
    """Return what is drawn of one recording.

    Args:
        results: of every receiver.
        options: with the parameters of the first receiver.

    Raises:
        BeaconCommError: the recording cannot be read again.
    """
    path = results[0].recording
    frame = CharacterFrame.from_parameters(options.parameters)
    scene = truth_beside(path) if results[0].scene is not None else None
    subjects = _subjects(results, options.truth)
    chosen = sorted(subjects, key=lambda subject: -subject.wrong_share)[:MOST_SIGNALS]
    wanted = [
        (subject, stretch)
        for subject in chosen
        if (stretch := choose_stretch(subject.scores, _any_characters(subject), frame)) is not None
    ]
    image = None
    if is_mat(path):
        events = [read_mat(path)] * len(wanted)
        events = [(t_ns - t_ns[0], polarity) for t_ns, polarity in events]
    else:
        events, image = _read_again(path, results, wanted, options, scene)
    signals = [
        _signal(subject, stretch, *seen, options, frame) for (subject, stretch), seen in zip(wanted, events, strict=True)
    ]
    return RecordingView(results, subjects, signals, image)


def _any_characters(subject: Subject) -> Sequence[Character]:
    return next((characters for characters in subject.characters.values() if characters), ())


def _subjects(results: Sequence[RecordingResult], text: str | None) -> list[Subject]:
    """Return the beacons: those of the truth, else those of the first receiver, found again in the others by place."""
    scenes = [(result.receiver, result.scene) for result in results if result.scene is not None]
    if scenes:
        subjects = [Subject(beacon.name, beacon.text) for beacon in scenes[0][1].beacons]
        for receiver, scene in scenes:
            for subject, beacon in zip(subjects, scene.beacons, strict=True):
                subject.scores[receiver] = beacon.transmissions
                subject.characters[receiver] = beacon.characters
        return subjects
    subjects = []
    for result in results:
        for track in listed(result):
            same = next((one for one in subjects if _same(one, result, track)), None)
            if same is None:
                name = 'beacon' if is_mat(result.recording) else f'track {track.track_id}'
                same = Subject(name, text, path=track.path)
                subjects.append(same)
            same.scores[result.receiver] = track.transmissions
            same.characters[result.receiver] = track.characters
    return subjects


def _same(subject: Subject, result: RecordingResult, beacon: BeaconResult) -> bool:
    """Whether a receiver's beacon is one that another receiver has found."""
    if result.receiver in subject.characters:
        return False
    if not subject.path or not beacon.path:
        return not subject.path and not beacon.path
    t_ns = np.array([point.t_ns for point in beacon.path], np.float64)
    own_ns = [point.t_ns for point in subject.path]
    inside = (t_ns >= own_ns[0]) & (t_ns <= own_ns[-1])
    if not inside.any():
        return False
    off_x = np.interp(t_ns, own_ns, [point.x_px for point in subject.path]) - [point.x_px for point in beacon.path]
    off_y = np.interp(t_ns, own_ns, [point.y_px for point in subject.path]) - [point.y_px for point in beacon.path]
    return float(np.median(np.hypot(off_x, off_y)[inside])) <= SAME_PLACE_PX


Signal = tuple[NDArray[np.int64], NDArray[np.int8]]


def _read_again(
    path: str,
    results: Sequence[RecordingResult],
    wanted: Sequence[tuple[Subject, Stretch]],
    options: Options,
    scene: SceneTruth | None,
) -> tuple[list[Signal], ImageView | None]:
    """Read a bag for the events near each subject in its stretch, and for the image."""
    instant_ns = _busiest_ns(results[0], options)
    parameters = options.parameters
    reach_ns = 2 * NS_PER_S if parameters.slowest_bit_s > 0.02 else NS_PER_S
    begin_ns = min([instant_ns - reach_ns, *(stretch.settling_ns for _, stretch in wanted)])
    end_ns = max([instant_ns + NS_PER_S // 10, *(stretch.end_ns for _, stretch in wanted)])
    near: list[NearPath] | None = None
    kept: list[EventBatch] = []
    span_ns: tuple[int, int] | None = None
    origin_ns, size = 0, (1, 1)
    with open_recording(path) as bag:
        for piece in BagPieces(path, bag, options.topic, (max(0, begin_ns), end_ns)):
            batch, origin_ns, size = piece.batch, piece.origin_ns, (piece.width, piece.height)
            if near is None:
                near = [_near(subject, stretch, options, scene, origin_ns) for subject, stretch in wanted]
                span_ns = image_span_ns(instant_ns + origin_ns, parameters)
            for one, (_, stretch) in zip(near, wanted, strict=True):
                a, b = np.searchsorted(batch.t_ns, np.array((stretch.settling_ns, stretch.end_ns)) + origin_ns)
                one.push(batch.slice(int(a), int(b), batch.t_end_ns), origin_ns)
            assert span_ns is not None
            a, b = np.searchsorted(batch.t_ns, span_ns)
            if b > a:
                kept.append(batch.slice(int(a), int(b), batch.t_end_ns))
    signals = [one.signal() for one in near or ()]
    found = [(signal.t_ns, signal.polarity) for signal in signals]
    if span_ns is None:
        return found or [(np.empty(0, np.int64), np.empty(0, np.int8))] * len(wanted), None
    events = _joined(kept, span_ns[1])
    index, blobs, window_s = view_image(events, size, span_ns[0], origin_ns, parameters)
    at_ns = span_ns[1] - origin_ns
    return found, ImageView(at_ns, window_s, index, blobs, _paths(results[0], scene, at_ns, origin_ns))


def _joined(batches: Sequence[EventBatch], t_end_ns: int) -> EventBatch:
    if not batches:
        none = np.empty(0, np.uint16)
        return EventBatch(none, none, np.empty(0, np.int8), np.empty(0, np.int64), t_end_ns)
    return EventBatch(
        np.concatenate([batch.x for batch in batches]),
        np.concatenate([batch.y for batch in batches]),
        np.concatenate([batch.polarity for batch in batches]),
        np.concatenate([batch.t_ns for batch in batches]),
        t_end_ns,
    )


def _near(subject: Subject, stretch: Stretch, options: Options, scene: SceneTruth | None, origin_ns: int) -> NearPath:
    """Return what collects a subject's events: along the true path, where that is known."""
    path = subject.path
    if scene is not None:
        beacon = next(one for one in scene.beacons if one.name == subject.name)
        t_ns = np.arange(stretch.settling_ns, stretch.end_ns + PATH_STEP_NS, PATH_STEP_NS)
        scene_ns = t_ns + scene_time_ns(scene, origin_ns)
        columns = (t_ns, *beacon.centre(scene_ns), beacon.radius_px(scene_ns))
        path = [PathPoint(int(t), float(x), float(y), float(radius)) for t, x, y, radius in zip(*columns, strict=True)]
    return NearPath(path, options.parameters.routing_extent_factor, options.parameters.routing_margin_px)


def _busiest_ns(result: RecordingResult, options: Options) -> int:
    """Return the instant with most confirmed tracks, the nearest to the recording's middle of those."""
    begin_ns = options.window_ns[0]
    middle_ns = begin_ns + result.duration_ns // 2
    confirmed: dict[int, int] = {}
    for beacon in result.beacons:
        for point in beacon.path:
            confirmed[point.t_ns] = confirmed.get(point.t_ns, 0) + point.confirmed
    if not confirmed:
        return middle_ns
    most = max(confirmed.values())
    return min((t for t, count in confirmed.items() if count == most), key=lambda t: abs(t - middle_ns))


def _paths(result: RecordingResult, scene: SceneTruth | None, at_ns: int, origin_ns: int) -> list[PathView]:
    views = []
    if scene is not None:
        shift_ns = scene_time_ns(scene, origin_ns)
        t_ns = np.linspace(shift_ns, shift_ns + result.duration_ns, 600).astype(np.int64)
        for beacon in scene.beacons:
            x, y = (np.where(beacon.visible(t_ns), value, np.nan) for value in beacon.centre(t_ns))
            views.append(PathView(beacon.name, x, y, True, True, None))
    for track in (*result.silent, *result.beacons):
        if not track.path:
            continue
        drawn = thin(track.path)
        nearest = min(track.path, key=lambda point: abs(point.t_ns - at_ns))
        there = abs(nearest.t_ns - at_ns) < NS_PER_S // 20
        views.append(
            PathView(
                str(track.track_id),
                np.array([point.x_px for point in drawn]),
                np.array([point.y_px for point in drawn]),
                track.confirmed_at_ns is not None,
                False,
                (nearest.x_px, nearest.y_px, nearest.extent_px) if there else None,
            )
        )
    return views


def _signal(
    subject: Subject,
    stretch: Stretch,
    t_ns: NDArray[np.int64],
    polarity: NDArray[np.int8],
    options: Options,
    frame: CharacterFrame,
) -> SignalView:
    a, b = np.searchsorted(t_ns, (stretch.settling_ns, stretch.end_ns))
    t_ns, polarity = t_ns[a:b], polarity[a:b]
    length_ns = frame.duration_ns(stretch.bit_rate_bps)
    until_ns = stretch.end_ns - 0.5 * length_ns
    transmissions: Iterable[Transmission] = next((scores for scores in subject.scores.values() if scores), ())
    return SignalView(
        subject.name,
        stretch,
        t_ns,
        polarity,
        trace_filter(t_ns, polarity, stretch, options.parameters),
        {
            receiver: [one for one in characters if stretch.begin_ns - 0.1 * length_ns <= one.t_ns < until_ns]
            for receiver, characters in subject.characters.items()
        },
        sent_within(list(transmissions), subject.text, stretch, frame) if subject.text else (),
    )
