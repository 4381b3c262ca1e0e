"""The receiver: the stages of the paper's section III, one call a stage.

::

    events ──► routing ──► buffers, slots ──► filter ─► edges ─► synchronisation ─► characters ──► parity record
                 ▲                             └──────────── demodulator ──────────────────┘           │
                 │                                                                                     ▼
    index image ─► blobs ─► tracks ──► candidate slots ◄──────────────────────────── confirmed / demoted

Events are routed by the tracks as they stood at the last point of the *hop grid*, which is absolute in event time;
detection, tracking and the assignment of slots happen at its points.  A batch is therefore cut at the grid, and any
batching of the same events gives the same characters, tracks and states.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.bearing import CameraModel, azimuth_elevation
from beacon_comm.core.candidates import BeaconState, CandidateSlots, ReceivedCharacter
from beacon_comm.core.demodulator import make_demodulator
from beacon_comm.core.detection import Detector
from beacon_comm.core.events import NS_PER_S, EventBatch
from beacon_comm.core.index_image import hop_length_ns
from beacon_comm.core.meetings import Meetings
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.routing import RoutedEvents
from beacon_comm.core.signal_detection import WholeSignal
from beacon_comm.core.tracks import Covariance, Track, TrackChanges, is_same_rate


@dataclass(frozen=True, slots=True)
class BeaconSnapshot:
    """One track at one instant, from its first sight on.

    Attributes:
        track_id: label, never given twice by one receiver, but to what is taken for the one that was lost (``reacquire_s``).
        state: candidate (waiting, demodulating, demoted), confirmed or lost.
        quiet: no events in the last window; the position is predicted.
        t_ns: instant of the prediction (ns, sensor clock).
        x_px, y_px: predicted centre (px).
        vx_px_per_s, vy_px_per_s: image velocity (px/s).
        extent_px: radius of the blob (px).
        index: the paper's index I, mean over the blob's pixels.
        bit_rate_bps: settled bit rate (bit/s), None before.
        bit_rate_std_bps: its standard deviation (bit/s), None where it is not estimated.
        confirmed_at_ns: end of the character that confirmed it (ns, sensor clock), None if it is not confirmed.
        characters, characters_ok, parity_errors, framing_errors: counted since the slot was given.
        bearing: unit vector in the optical frame, ``(3,)`` float64, None without calibration.
        azimuth_rad, elevation_rad: see :func:`beacon_comm.core.bearing.azimuth_elevation`; None without calibration.
        pixel_covariance: of the centre (px²), ((xx, xy), (xy, yy)); None: unknown.
        angle_covariance: of azimuth and elevation (rad²), likewise; None: unknown, no calibration, or not confirmed.
        age_s: time since the last observation (s).
    """

    track_id: int
    state: BeaconState
    quiet: bool
    t_ns: int
    x_px: float
    y_px: float
    vx_px_per_s: float
    vy_px_per_s: float
    extent_px: float
    index: float
    bit_rate_bps: float | None
    bit_rate_std_bps: float | None
    confirmed_at_ns: int | None
    characters: int
    characters_ok: int
    parity_errors: int
    framing_errors: int
    bearing: NDArray[np.float64] | None
    azimuth_rad: float | None
    elevation_rad: float | None
    pixel_covariance: Covariance | None
    angle_covariance: Covariance | None
    age_s: float


class Output(NamedTuple):
    """What one push, or a part of it, gave.

    Attributes:
        characters: decoded characters, those of each track in order of time; the order between tracks depends on
            the batches.
        lost: last snapshots of the tracks that were lost; a few characters of theirs may come later, by some seconds.
        confirmed_changed: the set of confirmed beacons is another one than before.
    """

    characters: tuple[ReceivedCharacter, ...]
    lost: tuple[BeaconSnapshot, ...]
    confirmed_changed: bool


class Detection(Protocol):
    """What the receiver needs of detection: the image's, or that of a signal without pixels."""

    @property
    def tracks(self) -> Mapping[int, Track]: ...
    @property
    def index_threshold(self) -> float: ...
    @property
    def idle(self) -> bool: ...
    def route(self, segment: EventBatch) -> RoutedEvents: ...
    def hop(self, t_hop_ns: int) -> TrackChanges: ...
    def backlog(self, track_id: int) -> tuple[NDArray[np.int64], NDArray[np.int8]]: ...
    def disown(self, track_id: int) -> None: ...
    def exchange(self, track_id: int, other_id: int) -> None: ...
    def rest(self) -> bool: ...
    def resize(self, sensor_size: tuple[int, int]) -> TrackChanges: ...
    def reset(self) -> TrackChanges: ...


class Receiver:
    """Events of one camera in; characters, tracks, states and bearings out.

    Args:
        parameters: see :class:`Parameters`.
        sensor_size: width and height of the sensor (px).
        camera: calibration, None for pixels only.
        detection: replaces the detection on the image, see :class:`SignalReceiver`.
    """

    def __init__(
        self,
        parameters: Parameters,
        sensor_size: tuple[int, int],
        camera: CameraModel | None = None,
        detection: Detection | None = None,
    ) -> None:
        self._detection = Detector(parameters, sensor_size) if detection is None else detection
        self._slots = CandidateSlots(parameters, make_demodulator)
        self._camera = camera
        self._hop_ns = hop_length_ns(parameters)
        self._t_ns: int | None = None
        self._heard_ns: int | None = None  # up to when the stream was heard, where it was carried on since
        self._confirmed: tuple[int, ...] = ()
        self._settled_ns: dict[int, int] = {}
        self._meetings = Meetings(parameters.hop_s) if parameters.tracker == 'motion' else None

    def push(self, batch: EventBatch) -> Output:
        """Take the next events and return what they gave.

        Batches must follow one another in time (see :mod:`beacon_comm.core.events`).
        """
        before = self._confirmed
        parts = list(self.parts(batch))
        return Output(
            tuple(one for part in parts for one in part.characters),
            tuple(one for part in parts for one in part.lost),
            self._confirmed != before,
        )

    def parts(self, batch: EventBatch) -> Iterator[Output]:
        """Take the next events; give out the characters of a hop interval before the hop's own work, which takes its time.

        The paper's section III, one call a stage.  The events are taken once all parts have been asked for.
        """
        characters: list[ReceivedCharacter] = []
        lost: list[BeaconSnapshot] = []
        self._tell_what_is_unknown(batch)
        for segment, at_hop in self._segments(batch):
            routed = self._detection.route(segment)
            characters += self._slots.demodulate(routed, segment.t_end_ns)
            if at_hop:
                if characters:
                    yield self._output(characters, lost)
                    characters, lost = [], []
                changes = self._detection.hop(segment.t_end_ns)
                self._lose(changes, characters, lost)
                characters += self._slots.assign(self._detection.tracks, segment.t_end_ns, self._detection.backlog)
                self._compare_rates(segment.t_end_ns)
                self._tell_apart(segment.t_end_ns)
        yield self._output(characters, lost)

    def flush(self) -> Output:
        """End the stream: give out what is still held; the tracks stay."""
        return self._output(self._slots.flush(), [])

    def resize(self, sensor_size: tuple[int, int]) -> Output:
        """Go on with another sensor size ``(width, height)`` (px): all tracks are lost, labels go on."""
        return self._restart(self._detection.resize(sensor_size))

    def reset(self) -> Output:
        """Go on after the sensor's clock was restarted: all tracks are lost, labels go on, time starts anew."""
        output = self._restart(self._detection.reset())
        self._slots.forget_gaps()
        self._t_ns = self._heard_ns = None
        return output

    def rest(self) -> bool:
        """Do a piece of what no event waits for, while none is there; return whether there was anything to do.

        It makes no difference to what is given out.
        """
        return self._detection.rest()

    def search_less(self, share: float) -> None:
        """Spend only this share of ``search_load`` on looking for bit rates from the next hop on; 1: all of it again."""
        self._slots.search_share = share

    def set_camera(self, camera: CameraModel | None) -> None:
        """Take another calibration from now on."""
        self._camera = camera

    @property
    def t_ns(self) -> int | None:
        """The stream's time (ns, sensor clock), None before the first batch."""
        return self._t_ns

    @property
    def confirmed(self) -> tuple[int, ...]:
        """Labels of the beacons that are confirmed now, in ascending order."""
        return self._confirmed

    @property
    def track_ids(self) -> Collection[int]:
        """Labels of all tracks, and of the lost ones that characters may still come from."""
        return {*self._detection.tracks, *self._slots.looked_back_at}

    @property
    def index_threshold(self) -> float:
        """What the index of a blob must reach now."""
        return self._detection.index_threshold

    @property
    def passed_over(self) -> int:
        """How many lost tracks were not looked at for the last time: too many were lost."""
        return self._slots.passed_over

    @property
    def slots_full(self) -> bool:
        """Whether candidates wait because every slot is taken."""
        return self._slots.slots_full

    def settled_ns(self, track_id: int) -> int | None:
        """Return the point of the hop grid (ns) from which on a track has had its bit rate; None: it has none."""
        return self._settled_ns.get(track_id)

    def beacons(self, t_ns: int | None = None) -> tuple[BeaconSnapshot, ...]:
        """Return all tracks, predicted to ``t_ns`` (ns, sensor clock; default: the stream's time)."""
        t_ns = self._t_ns if t_ns is None else t_ns
        if t_ns is None:
            return ()
        return tuple(self._snapshot(track, t_ns) for track in self._detection.tracks.values())

    def _tell_what_is_unknown(self, batch: EventBatch) -> None:
        """Tell the slots what is missing before a batch, or that nobody vouches for it."""
        if self._t_ns is None:
            return
        heard_ns = self._t_ns if self._heard_ns is None else self._heard_ns
        if batch.carried_on:
            self._slots.carry_on(self._t_ns, batch.t_end_ns)
        elif batch.missing_until_ns is not None:
            self._slots.miss(heard_ns, batch.missing_until_ns)
        self._heard_ns = heard_ns if batch.carried_on else None

    def _segments(self, batch: EventBatch) -> Iterator[tuple[EventBatch, bool]]:
        """Cut a batch at the points of the hop grid; yield each piece and whether it ends at one."""
        hop = self._hop_ns
        if self._t_ns is None:
            self._t_ns = int(batch.t_ns[0]) if len(batch) else batch.t_end_ns
        start = 0
        while (t_hop := (self._t_ns // hop + 1) * hop) <= batch.t_end_ns:
            if self._detection.idle and not self._slots.looked_back_at:  # nothing can change before the next event
                next_ns = int(batch.t_ns[start]) if start < len(batch) else batch.t_end_ns
                t_hop = max(t_hop, next_ns // hop * hop)
            stop = int(np.searchsorted(batch.t_ns, t_hop, side='left'))
            self._t_ns = t_hop
            yield batch.slice(start, stop, t_hop), True
            start = stop
        self._t_ns = batch.t_end_ns
        yield batch.slice(start, len(batch), batch.t_end_ns) if start else batch, False

    def _tell_apart(self, t_ns: int) -> None:
        """Give the beacons that have exchanged their tracks their labels back."""
        if self._meetings is None:
            return
        detection = self._detection
        for one, other in self._meetings.exchanged(detection.tracks, self._slots.signature, detection.backlog, t_ns):
            detection.exchange(one, other)

    def _compare_rates(self, t_ns: int) -> None:
        """Tell the tracks their bit rates; take the label from one that has it of a lost one with another rate."""
        before_ns, self._settled_ns = self._settled_ns, {}
        for track_id, track in self._detection.tracks.items():
            rate_bps = self._slots.bit_rate_bps(track_id)
            if rate_bps is None:
                continue
            self._settled_ns[track_id] = before_ns.get(track_id, t_ns)
            track.bit_rate_bps = rate_bps
            if track.claimed_bps is not None:
                if is_same_rate(rate_bps, track.claimed_bps):
                    track.claimed_bps = None
                else:
                    self._detection.disown(track_id)

    def _lose(
        self, changes: TrackChanges, characters: list[ReceivedCharacter], lost: list[BeaconSnapshot]
    ) -> None:
        for track in changes.lost:
            snapshot = self._snapshot(track, self._t_ns or 0, BeaconState.LOST)
            characters += self._slots.forget(track.track_id, self._t_ns or 0)
            lost.append(snapshot)

    def _restart(self, changes: TrackChanges) -> Output:
        self._settled_ns = {}
        if self._meetings is not None:
            self._meetings.clear()
        lost = [self._snapshot(track, self._t_ns or 0, BeaconState.LOST) for track in changes.lost]
        return self._output(self._slots.end(), lost)

    def _output(self, characters: list[ReceivedCharacter], lost: list[BeaconSnapshot]) -> Output:
        confirmed = self._slots.confirmed
        changed = confirmed != self._confirmed
        self._confirmed = confirmed
        return Output(tuple(characters), tuple(lost), changed)

    def _snapshot(self, track: Track, t_ns: int, state: BeaconState | None = None) -> BeaconSnapshot:
        x_px, y_px = track.light_at(t_ns)
        pixel = track.covariance_at(t_ns)
        record = self._slots.record(track.track_id)
        bearing = azimuth = elevation = angle = None
        if self._camera is not None:
            bearing = self._camera.bearings(np.array([[x_px, y_px]]))[0]
            azimuth, elevation = azimuth_elevation(bearing)
            if pixel is not None and self._slots.state(track.track_id) is BeaconState.CONFIRMED:
                (aa, ab), (_, bb) = self._camera.angle_covariance((x_px, y_px), pixel).tolist()
                angle = (aa, ab), (ab, bb)
        return BeaconSnapshot(
            track_id=track.track_id,
            state=self._slots.state(track.track_id) if state is None else state,
            quiet=track.quiet,
            t_ns=t_ns,
            x_px=x_px,
            y_px=y_px,
            vx_px_per_s=track.vx_px_per_s,
            vy_px_per_s=track.vy_px_per_s,
            extent_px=track.extent_px,
            index=track.index,
            bit_rate_bps=self._slots.bit_rate_bps(track.track_id),
            bit_rate_std_bps=self._slots.bit_rate_std_bps(track.track_id),
            confirmed_at_ns=self._slots.confirmed_at_ns(track.track_id),
            characters=0 if record is None else record.characters,
            characters_ok=0 if record is None else record.ok,
            parity_errors=0 if record is None else record.parity_errors,
            framing_errors=0 if record is None else record.framing_errors,
            bearing=bearing,
            azimuth_rad=azimuth,
            elevation_rad=elevation,
            pixel_covariance=pixel,
            angle_covariance=angle,
            age_s=max(0, t_ns - track.last_seen_ns) / NS_PER_S,
        )


class SignalReceiver(Receiver):
    """Receiver of one beacon's aggregated events without pixels: detection is bypassed, the signal is one track."""

    def __init__(self, parameters: Parameters) -> None:
        super().__init__(parameters, (1, 1), detection=WholeSignal(parameters))

    def push_signal(self, t_ns: NDArray[np.int64], polarity: NDArray[np.int8], t_end_ns: int) -> Output:
        """Take the next events: times (ns) ``(n,)`` int64, ±1 ``(n,)`` int8, and the stream's time (ns)."""
        pixel = np.zeros(len(t_ns), np.uint16)
        return self.push(EventBatch(pixel, pixel, polarity, t_ns, t_end_ns))
