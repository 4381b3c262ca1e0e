"""The truth of a scene, found beside its bag, as the evaluation takes it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beacon_comm.core.events import NS_PER_S
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.evaluation.result import BeaconResult
from beacon_comm.evaluation.scene_score import SceneScore, score_scene
from beacon_comm.evaluation.scene_truth import IGNORED_KINDS, TrueBeacon
from beacon_comm.recordings.truth import TRUTH_NAME, read_truth
from beacon_comm.simulation.truth import DistractorTruth, SceneTruth

# EVT3's clock begins anew after 2²⁴ µs: a reader knows scene time but for whole turns of it.
_TURN_NS = (1 << 24) * 1000


@dataclass(frozen=True, slots=True)
class IgnoredBlob:
    """A reflection as a beacon of which nothing is asked; it is never hidden."""

    blob: DistractorTruth
    text: str | None = None
    bit_rate_bps: float | None = None

    @property
    def name(self) -> str:
        return self.blob.name

    @property
    def kind(self) -> str:
        return self.blob.kind

    @property
    def sendings_ns(self) -> NDArray[np.int64]:
        return np.empty(0, np.int64)

    @property
    def characters_ns(self) -> NDArray[np.int64]:
        return np.empty(0, np.int64)

    def centre(self, t_ns: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return self.blob.trajectory.at(t_ns)

    def visible(self, t_ns: ArrayLike) -> NDArray[np.bool_]:
        return np.ones(np.shape(t_ns), np.bool_)

    def radius_px(self, t_ns: ArrayLike) -> NDArray[np.float64]:
        return np.zeros(np.shape(t_ns))

    def bearing(self, t_ns: ArrayLike) -> None:
        return None


def truth_beside(recording: str) -> SceneTruth | None:
    """Return the truth in a bag's folder, or in that of its file; None where there is none.

    Raises:
        RecordingError: there is one that cannot be read.
    """
    path = Path(recording)
    folder = path if path.is_dir() else path.parent
    return read_truth(folder) if (folder / TRUTH_NAME).is_file() else None


def scored_scene(
    truth: SceneTruth,
    tracks: tuple[BeaconResult, ...],
    instants_ns: NDArray[np.int64],
    origin_ns: int,
    span_ns: tuple[int, int],
    frame: CharacterFrame,
    text: str | None,
) -> SceneScore:
    """Score what a receiver made of a bag.

    Args:
        truth: of the scene.
        tracks: all of them.
        instants_ns: when their paths were sampled (recording time, ns).
        origin_ns: sensor time at recording time 0 (ns).
        span_ns: begin and end of what was evaluated (recording time, ns).
        frame: layout of a character.
        text: what beacons send of which the truth does not say; None: nothing is known.

    Raises:
        FramingError: a text of the truth that the frame cannot carry.
    """
    beacons: list[TrueBeacon] = [*truth.beacons]
    beacons += [IgnoredBlob(one) for one in truth.distractors if one.kind in IGNORED_KINDS]
    for beacon in truth.beacons:
        frame.encode_bits(beacon.text or '')
    return score_scene(tracks, instants_ns, beacons, scene_time_ns(truth, origin_ns), span_ns, frame, text)


def scene_time_ns(truth: SceneTruth, origin_ns: int) -> int:
    """Return the scene time (ns) of sensor time ``origin_ns``, at which the recording's first event is."""
    start_ns = round(truth.start_s * NS_PER_S)
    if origin_ns >= truth.stamp_start_ns > 0:
        origin_ns -= truth.stamp_start_ns  # an EventArray's events bear the time of the stamps
    return start_ns + (origin_ns - start_ns) % _TURN_NS
