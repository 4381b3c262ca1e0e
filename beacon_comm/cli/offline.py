"""The receiver over a recording, as fast as it goes: no ROS, no clock but the events'.

    bag  ──► BagPieces ──► cut every 20 ms ──► Receiver ───────► Collector ──► beacons ──► scores ◄── truth beside it
    .mat ──► read_mat ───► cut every 100 ms ─► SignalReceiver ──►

With a scene's truth the stream is cut every 3 ms, so that it is known when something was given out, and the tracks are sampled
every 9 ms, so that every phase of the hops of 10 ms occurs.

All times of the results are recording time: ns since the recording's first event.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from beacon_comm.cli.bag_pieces import BagPieces
from beacon_comm.cli.collector import Collector
from beacon_comm.cli.progress import progress
from beacon_comm.cli.scene_truth import scored_scene, truth_beside
from beacon_comm.core.bearing import CameraModel
from beacon_comm.core.errors import RecordingError
from beacon_comm.core.events import NS_PER_S, EventBatch
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.receiver import Receiver, SignalReceiver
from beacon_comm.evaluation.held import Signal
from beacon_comm.evaluation.near_path import NearPath
from beacon_comm.evaluation.result import BeaconResult, RecordingResult
from beacon_comm.evaluation.scoring import Transmission, not_found, score
from beacon_comm.recordings.bags import open_recording
from beacon_comm.recordings.mat import read_mat
from beacon_comm.simulation.truth import SceneTruth

SAMPLE_NS = 20_000_000
SCENE_STEP_NS = 3_000_000
SCENE_SAMPLE_NS = 3 * SCENE_STEP_NS
MAT_BATCH_NS = 100_000_000
LONGEST_SAMPLED_NS = 60 * NS_PER_S


@dataclass(frozen=True, slots=True)
class Options:
    """What to evaluate, and how.

    Attributes:
        parameters: the receiver's.
        truth: text that was sent, None: no scores.
        camera: calibration, None: pixels only.
        topic: event topic of a bag, None: the only one.
        start_s, duration_s: part of the recording, from its first event (s); duration None: to its end.
        scene_truth: whether to score a bag against the scene's truth where it lies beside it.
    """

    parameters: Parameters
    truth: str | None = None
    camera: CameraModel | None = None
    topic: str | None = None
    start_s: float = 0.0
    duration_s: float | None = None
    scene_truth: bool = True

    @property
    def window_ns(self) -> tuple[int, int | None]:
        """Begin and end of the part, recording time (ns)."""
        begin_ns = round(self.start_s * NS_PER_S)
        return begin_ns, None if self.duration_s is None else begin_ns + round(self.duration_s * NS_PER_S)


def evaluate_recording(path: str, options: Options) -> RecordingResult:
    """Run the receiver over one recording and score what it decodes.

    Raises:
        BeaconCommError: nothing of it can be read, or the truth cannot be framed.
    """
    if is_mat(path):
        return _evaluate_mat(path, options)
    scene = truth_beside(path) if options.scene_truth else None
    if scene is not None and scene.camera is not None and options.camera is None:
        options = replace(options, camera=scene.camera.calibration())
    with open_recording(path) as bag:
        return _evaluate_bag(path, BagPieces(path, bag, options.topic, options.window_ns), options, scene)


def is_mat(path: str) -> bool:
    """Whether a recording is a MATLAB file, by its name."""
    return path.lower().endswith('.mat')


def _evaluate_mat(path: str, options: Options) -> RecordingResult:
    """Evaluate a .mat file: it has no pixels, so detection is bypassed, and it is one beacon."""
    t_ns, polarity = read_mat(path)
    t_ns = t_ns - t_ns[0]
    begin_ns, end_ns = options.window_ns
    part = slice(*np.searchsorted(t_ns, (begin_ns, t_ns[-1] + 1 if end_ns is None else end_ns)))
    t_ns, polarity = t_ns[part], polarity[part]
    if not len(t_ns):
        raise RecordingError(f'{path}: no events in the part asked for, from {options.start_s:g} s on')
    begun_s = time.perf_counter()
    beacon = receive_signal(t_ns, polarity, options.parameters, path)
    processing_s = time.perf_counter() - begun_s
    last_ns = int(t_ns[-1])
    if options.truth is not None:
        transmissions = _scores(beacon, options, (begin_ns, last_ns), Signal(t_ns, polarity))
        if not transmissions:
            transmissions = (not_found(options.truth, CharacterFrame.from_parameters(options.parameters)),)
        beacon = replace(beacon, transmissions=transmissions)
    return RecordingResult(
        recording=path,
        receiver=options.parameters.receiver,
        events=len(t_ns),
        duration_ns=last_ns - int(t_ns[0]),
        processing_s=processing_s,
        lost_packets=0,
        skipped_words=0,
        beacons=(beacon,),
        silent_tracks=0,
        truth=options.truth,
    )


def receive_signal(
    t_ns: NDArray[np.int64], polarity: NDArray[np.int8], parameters: Parameters, title: str | None = None
) -> BeaconResult:
    """Run the receiver over one beacon's events, in pieces of 100 ms.

    Args:
        t_ns: times (ns), non-decreasing, ``(n,)`` int64; ``n`` at least 1.
        polarity: +1 or -1, ``(n,)`` int8.
        parameters: the receiver's.
        title: of the progress bar; None: there is none.
    """
    receiver = SignalReceiver(parameters)
    collector = Collector()
    last_ns = int(t_ns[-1])
    cuts_ns = range(int(t_ns[0]) + MAT_BATCH_NS, last_ns, MAT_BATCH_NS)
    cuts: Iterable[int] = itertools.chain(cuts_ns, [last_ns])
    if title is not None:
        cuts = progress(cuts, title, len(cuts_ns) + 1)
    start = 0
    for cut_ns in cuts:
        stop = len(t_ns) if cut_ns == last_ns else int(np.searchsorted(t_ns, cut_ns))
        collector.take(receiver.push_signal(t_ns[start:stop], polarity[start:stop], cut_ns), receiver)
        start = stop
    collector.take(receiver.flush(), receiver)
    collector.sample(receiver)
    return collector.whole_signal()


def _evaluate_bag(path: str, pieces: BagPieces, options: Options, scene: SceneTruth | None) -> RecordingResult:
    collector = Collector()
    begun_s = time.perf_counter()
    step_ns, sample_ns = (SAMPLE_NS, SAMPLE_NS) if scene is None else (SCENE_STEP_NS, SCENE_SAMPLE_NS)
    events, end_ns, size = _receive(pieces, collector, options, step_ns, sample_ns)
    processing_s = time.perf_counter() - begun_s
    if end_ns is None:
        raise RecordingError(pieces.problem or f'{path}: no events in the part asked for')
    begin_ns = options.window_ns[0]
    beacons, silent = collector.beacons()
    if options.truth is not None:
        beacons = _scored_beacons(beacons, pieces, options, (begin_ns, end_ns))
    scored = None if scene is None else scored_scene(
        scene,
        (*beacons, *silent),
        collector.instants_ns,
        collector.origin_ns,
        (begin_ns, end_ns),
        CharacterFrame.from_parameters(options.parameters),
        options.truth,
    )
    return RecordingResult(
        recording=path,
        receiver=options.parameters.receiver,
        events=events,
        duration_ns=end_ns - begin_ns,
        processing_s=processing_s,
        lost_packets=pieces.counts['lost_packets'],
        skipped_words=pieces.counts['skipped_words'],
        beacons=beacons,
        silent_tracks=len(silent),
        problem=pieces.problem,
        scene=scored,
        width=size[0],
        height=size[1],
        silent=silent,
        truth=options.truth,
    )


def _receive(
    pieces: BagPieces, collector: Collector, options: Options, step_ns: int, sample_ns: int
) -> tuple[int, int | None, tuple[int, int]]:
    """Push a bag through a receiver, cut at every step, and sample the tracks.

    Returns:
        The number of events, the end (recording time, ns), None without any, and the sensor's size (px).
    """
    receiver: Receiver | None = None
    events = 0
    size = (0, 0)
    reached_ns: int | None = None
    end_ns: int | None = None
    for piece in pieces:
        size = (piece.width, piece.height)
        if receiver is None:
            if options.camera is not None:
                options.camera.check_size(size)
            receiver = Receiver(options.parameters, size, options.camera)
        elif piece.restarted:
            collector.take(receiver.reset(), receiver)
            reached_ns = None
        if piece.resized:
            collector.take(receiver.resize(size), receiver)
        collector.origin_ns = piece.origin_ns
        for batch in cut_batch(piece.batch, step_ns, reached_ns):
            collector.take(receiver.push(batch), receiver)
            if batch.t_end_ns % sample_ns == 0:
                collector.sample(receiver)
        events += len(piece.batch)
        reached_ns = piece.batch.t_end_ns
        end_ns = reached_ns - piece.origin_ns
    if receiver is not None:
        collector.take(receiver.flush(), receiver)
        collector.sample(receiver)
    return events, end_ns, size


def cut_batch(batch: EventBatch, grid_ns: int, reached_ns: int | None) -> Iterator[EventBatch]:
    """Cut a batch at multiples of ``grid_ns`` of the sensor's time, from ``reached_ns`` (None: its first event) on.

    A missing stretch stays whole: live, it is told of at once, too.
    """
    if reached_ns is None:
        reached_ns = int(batch.t_ns[0]) if len(batch) else batch.t_end_ns
    if batch.missing_until_ns is not None:
        reached_ns = max(reached_ns, batch.missing_until_ns)
    # A leap in time is not followed step by step.
    reached_ns = max(reached_ns, batch.t_end_ns - LONGEST_SAMPLED_NS)
    start = 0
    for cut_ns in range((reached_ns // grid_ns + 1) * grid_ns, batch.t_end_ns, grid_ns):
        stop = int(np.searchsorted(batch.t_ns, cut_ns))
        yield batch.slice(start, stop, cut_ns)
        start = stop
    yield batch.slice(start, len(batch), batch.t_end_ns)


def _scores(
    beacon: BeaconResult, options: Options, span_ns: tuple[int, int], signal: Signal | None
) -> tuple[Transmission, ...]:
    frame = CharacterFrame.from_parameters(options.parameters)
    return score(beacon.characters, options.truth or '', span_ns, signal, frame)


def _scored_beacons(
    beacons: tuple[BeaconResult, ...], pieces: BagPieces, options: Options, span_ns: tuple[int, int]
) -> tuple[BeaconResult, ...]:
    """Score the beacons of a bag.

    Where a score begins or ends with missing characters, the beacon may not have been there: the bag is read again
    for the events around its path, which tell.
    """
    scored = [_scores(beacon, options, span_ns, None) for beacon in beacons]
    doubtful = {
        place: NearPath(beacon.path, options.parameters.routing_extent_factor, options.parameters.routing_margin_px)
        for place, (beacon, transmissions) in enumerate(zip(beacons, scored, strict=True))
        if beacon.path and any(transmission.open_ended for transmission in transmissions)
    }
    if doubtful:
        problem = pieces.problem
        for piece in pieces:
            for near in doubtful.values():
                near.push(piece.batch, piece.origin_ns)
        pieces.problem = problem
    for place, near in doubtful.items():
        scored[place] = _scores(beacons[place], options, span_ns, near.signal())
    frame = CharacterFrame.from_parameters(options.parameters)
    for place, beacon in enumerate(beacons):
        if not scored[place] and beacon.confirmed_at_ns is not None:
            scored[place] = (not_found(options.truth or '', frame),)
    return tuple(
        replace(beacon, transmissions=transmissions) for beacon, transmissions in zip(beacons, scored, strict=True)
    )
