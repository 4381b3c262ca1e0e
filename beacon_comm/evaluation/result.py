"""Results of an evaluation: one value a beacon, one a recording.

Times are *recording time*: ns since the recording's first event.  It goes on where a sensor was restarted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from beacon_comm.core.candidates import BeaconState
from beacon_comm.core.character import Character
from beacon_comm.evaluation.scoring import Transmission

if TYPE_CHECKING:
    from beacon_comm.evaluation.scene_score import SceneScore


@dataclass(frozen=True, slots=True)
class PathPoint:
    """Where a track was.

    Attributes:
        t_ns: recording time (ns).
        x_px, y_px: centre (px).
        extent_px: radius of the blob (px).
        confirmed: whether it was confirmed then.
        quiet: no events in the last window; the position is predicted.
        azimuth_rad, elevation_rad: bearing, None without calibration.
        covariance_px2: of the centre, as xx, xy, yy (px²); None: the receiver states none.
        covariance_rad2: of azimuth and elevation, likewise (rad²).
    """

    t_ns: int
    x_px: float
    y_px: float
    extent_px: float
    confirmed: bool = False
    quiet: bool = False
    azimuth_rad: float | None = None
    elevation_rad: float | None = None
    covariance_px2: tuple[float, float, float] | None = None
    covariance_rad2: tuple[float, float, float] | None = None


@dataclass(frozen=True, slots=True)
class BeaconResult:
    """What a recording gave of one track.

    Attributes:
        track_id: label.
        state: its last state.
        confirmed_at_ns: when it was first confirmed (recording time, ns), None: never.
        bit_rate_bps: last settled bit rate (bit/s), None: none.
        azimuth_rad, elevation_rad: last bearing, None without calibration.
        path: its positions, every 20 ms of event time (9 ms with a scene's truth); empty for a recording without pixels.
        characters: decoded characters in order of time, ``t_ns`` in recording time.
        transmissions: scores against the truth, in order of time; empty without a truth.
        received_ns: when each character was given out: the stream's time then (recording time, ns), ``characters``' order.
        confirmed_seen_ns: when the receiver first said that it is confirmed (recording time, ns), None: never.
    """

    track_id: int
    state: BeaconState
    confirmed_at_ns: int | None
    bit_rate_bps: float | None
    azimuth_rad: float | None
    elevation_rad: float | None
    path: tuple[PathPoint, ...]
    characters: tuple[Character, ...]
    transmissions: tuple[Transmission, ...] = ()
    received_ns: tuple[int, ...] = ()
    confirmed_seen_ns: int | None = None

    @property
    def text(self) -> str:
        """All decoded codes as text, whatever their status."""
        return ''.join(chr(character.code) for character in self.characters)


@dataclass(frozen=True, slots=True)
class RecordingResult:
    """What a recording gave.

    Attributes:
        recording: its path, as given.
        receiver: name of the demodulator.
        events: events evaluated.
        duration_ns: from the first to the end of what was evaluated (event time, ns).
        processing_s: how long that took (s).
        lost_packets: messages missing by their ``seq``.
        skipped_words: words of unknown code.
        beacons: tracks that were confirmed or gave characters, by label.
        silent_tracks: tracks that did neither.
        problem: what could not be read, None if all could.
        scene: scores against the scene's truth, None where there is none beside the recording.
        width, height: sensor size (px), None for a recording without pixels.
        silent: the other tracks.
        truth: the text that the transmissions were compared with, None without one.
    """

    recording: str
    receiver: str
    events: int
    duration_ns: int
    processing_s: float
    lost_packets: int
    skipped_words: int
    beacons: tuple[BeaconResult, ...]
    silent_tracks: int
    problem: str | None = None
    scene: SceneScore | None = None
    width: int | None = None
    height: int | None = None
    silent: tuple[BeaconResult, ...] = ()
    truth: str | None = None

    @property
    def mev_per_s(self) -> float:
        """Million events a second of processing time; 0 where nothing was processed."""
        return self.events / self.processing_s / 1e6 if self.processing_s > 0 else 0.0
