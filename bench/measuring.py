"""Timing: processor time of this process, the best of several runs."""

from __future__ import annotations

import cProfile
import pstats
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from beacon_comm.core.parameters import Parameters
from beacon_comm.core.receiver import Detection, Receiver
from beacon_comm.wire.stream import EventStream

MetricTable = dict[str, float]


def best_s(run: Callable[[], object], repeats: int = 3) -> float:
    """Return the shortest processor time of ``repeats`` runs (s)."""
    times = []
    for _ in range(repeats):
        begun = time.process_time()
        run()
        times.append(time.process_time() - begun)
    return min(times)


def mev_per_s(events: int, seconds: float) -> float:
    """Return million events a second."""
    return events / seconds / 1e6


@dataclass(frozen=True, slots=True)
class ChainRun:
    """One run from bytes to characters.

    Attributes:
        events: that were read while it was timed.
        characters, tracks, confirmed, index_threshold: at its end.
        total_s: processor time of all of it (s).
        decode_s, detect_s, demodulate_s: the shares of it in wire, in detection, and in the candidate slots, as a steady clock
            has them: asking how much processor time was used would cost more than a stage here and there.
    """

    events: int
    characters: int
    tracks: int
    confirmed: int
    index_threshold: float
    total_s: float
    decode_s: float
    detect_s: float
    demodulate_s: float


class TimedDetection:
    """A detection that takes its own time."""

    def __init__(self, detection: Detection) -> None:
        self._detection = detection
        self.seconds = 0.0
        self.tracks = detection.tracks

    @property
    def index_threshold(self) -> float:
        """See Detection."""
        return self._detection.index_threshold

    @property
    def idle(self) -> bool:
        """See Detection."""
        return self._detection.idle

    def _timed(self, call: Callable, *arguments: object):  # type: ignore[no-untyped-def]
        begun = time.perf_counter()
        result = call(*arguments)
        self.seconds += time.perf_counter() - begun
        return result

    def route(self, segment):  # type: ignore[no-untyped-def]
        """See Detection."""
        return self._timed(self._detection.route, segment)

    def hop(self, t_hop_ns: int):  # type: ignore[no-untyped-def]
        """See Detection."""
        return self._timed(self._detection.hop, t_hop_ns)

    def backlog(self, track_id: int):  # type: ignore[no-untyped-def]
        """See Detection."""
        return self._timed(self._detection.backlog, track_id)


def run_chain(
    messages: Sequence[bytes],
    size: tuple[int, int],
    parameters: Parameters,
    make_detection: Callable[[Parameters, tuple[int, int]], Detection],
    timed_from: int = 0,
) -> ChainRun:
    """Push messages through a reader and a receiver, one after the other; those from ``timed_from`` on are timed."""
    stream = EventStream('event_camera_msgs/msg/EventPacket')
    detection = TimedDetection(make_detection(parameters, size))
    receiver = Receiver(parameters, size, detection=detection)  # type: ignore[arg-type]
    decode_s = 0.0
    characters = before = 0
    begun_s, begun_processor_s = time.perf_counter(), time.process_time()
    for k, cdr in enumerate(messages):
        if k == timed_from:
            detection.seconds, decode_s, before = 0.0, 0.0, stream.counts['events']
            begun_s, begun_processor_s = time.perf_counter(), time.process_time()
        begun = time.perf_counter()
        batch = stream.push(cdr).batch
        decode_s += time.perf_counter() - begun
        if batch is not None:
            characters += len(receiver.push(batch).characters)
    total_s = time.process_time() - begun_processor_s
    share = total_s / (time.perf_counter() - begun_s)
    decode_s, detect_s = decode_s * share, detection.seconds * share
    return ChainRun(
        stream.counts['events'] - before,
        characters,
        len(receiver.beacons()),
        len(receiver.confirmed),
        receiver.index_threshold,
        total_s,
        decode_s,
        detect_s,
        total_s - decode_s - detect_s,
    )


def module_ns(run: Callable[[], ChainRun]) -> dict[str, float]:
    """Return where a run's time goes: module -> ns an event, longest first; what is not of this package is 'other'."""
    profile = cProfile.Profile(time.process_time)
    done = profile.runcall(run)
    seconds: Counter[str] = Counter()
    for (file, _, _), (_, _, own_s, _, _) in pstats.Stats(profile).stats.items():  # type: ignore[attr-defined]
        path = Path(file)
        seconds[f'{path.parent.name}/{path.stem}' if 'beacon_comm' in path.parts else 'other'] += own_s
    return {module: own_s / done.events * 1e9 for module, own_s in seconds.most_common()}
