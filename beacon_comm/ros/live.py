"""The live receiver: one topic's messages in, characters with both clocks' times out.

::

    CDR bytes ─► EventStream ─► StreamTime ─► Receiver ─► Step ─► (the node publishes)
                     │                                     ▲
                     └── header.stamp, first event ─► ClockMap

It knows no ROS: the node gives it bytes and the time, and publishes what it returns.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection
from typing import NamedTuple

from beacon_comm.core.bearing import CameraModel
from beacon_comm.core.demodulator import decision_delay_bits
from beacon_comm.core.errors import CalibrationError
from beacon_comm.core.events import NS_PER_S, EventBatch
from beacon_comm.core.framing import CharacterFrame
from beacon_comm.core.parameters import Parameters
from beacon_comm.core.receiver import BeaconSnapshot, Output, Receiver
from beacon_comm.ros.clock_map import ClockMap
from beacon_comm.ros.stamped import Instant, StampedCharacter
from beacon_comm.ros.stream_time import StreamTime
from beacon_comm.wire.stream import NOTHING, Decoded, EventStream

_HURRIED_SHARE, _HURRIED_NS = 0.2, NS_PER_S
"""What is left of ``search_load`` while messages wait for long or are shed, and until so much of the stream (ns) has been read
without: searches that are cut by the next gap begin again, and would keep the node too slow for ever."""


class Step(NamedTuple):
    """What one message, one tick of a silent topic or the end of the stream gave.

    Attributes:
        at: the stream's time after it; of a part that is given early, that at its end.
        characters: in order of decision.
        lost: last snapshots of the tracks that were lost.
        confirmed_changed: the set of confirmed beacons is another one than before.
        problem: why the message was not read, None if it was.
        problem_kind: the kind it was counted under, '' if none.
        lost_packets: messages missing before this one.
        end_ns: the stream's time after the message (ns), None if it gave no events.
        due_ns: times of the stream (ns) at which those of the characters were due that fell due while they were being read:
            their ends and the receiver's decision delay.
    """

    at: Instant
    characters: tuple[StampedCharacter, ...] = ()
    lost: tuple[BeaconSnapshot, ...] = ()
    confirmed_changed: bool = False
    problem: str | None = None
    problem_kind: str = ''
    lost_packets: int = 0
    end_ns: int | None = None
    due_ns: tuple[int, ...] = ()


class LiveReceiver:
    """Reads one topic.  All ``now_ns`` are the node's clock (ns).

    Args:
        parameters: the receiver's.
        silent_after_ns, lag_ns: see :class:`StreamTime`.
        camera: calibration, None for pixels only.
    """

    def __init__(
        self, parameters: Parameters, silent_after_ns: int, lag_ns: int, camera: CameraModel | None = None
    ) -> None:
        self._parameters = parameters
        self._camera = camera
        self._stream: EventStream | None = None
        self._past_counts: Counter[str] = Counter()
        self._receiver: Receiver | None = None
        self._time = StreamTime(silent_after_ns, lag_ns)
        self._hurried_ns: int | None = None  # the stream's time when there was too little
        self._clock_map = ClockMap()
        self._gathered: list[StampedCharacter] = []
        self._due_ns: list[int] = []
        frame = CharacterFrame.from_parameters(parameters)
        self._bits_to_due = frame.length + decision_delay_bits(parameters)
        self._lost: list[BeaconSnapshot] = []
        self._confirmed_changed = False
        self.camera_problem = ''
        self.sensor_size: tuple[int, int] | None = None
        self.frame_id = ''

    @property
    def counts(self) -> Counter[str]:
        """Counts by kind, over all streams."""
        counts = self._past_counts.copy()
        if self._stream is not None:
            counts.update(self._stream.counts)
        counts['late_packets'] = self._time.late_packets
        if self._receiver is not None:
            counts['passed_over_candidates'] = self._receiver.passed_over
        return counts

    @property
    def confirmed(self) -> tuple[int, ...]:
        """Labels of the confirmed beacons."""
        return () if self._receiver is None else self._receiver.confirmed

    @property
    def track_ids(self) -> Collection[int]:
        """Labels of all tracks, and of the lost ones that characters may still come from."""
        return () if self._receiver is None else self._receiver.track_ids

    @property
    def calibrated(self) -> bool:
        """Whether bearings are known, not only pixels."""
        return self._camera is not None and not self.camera_problem

    @property
    def index_threshold(self) -> float:
        """What the index of a blob must reach now; clutter raises it."""
        return self._parameters.index_threshold if self._receiver is None else self._receiver.index_threshold

    @property
    def slots_full(self) -> bool:
        """Whether candidates wait because every slot is taken."""
        return self._receiver is not None and self._receiver.slots_full

    def open(self, message_type: str, now_ns: int) -> Step:
        """Read messages of this type from now on: another publisher, another stream; labels go on."""
        if self._stream is not None:
            self._past_counts.update(self._stream.counts)
        self._stream = EventStream(message_type)
        self._restart()
        return self._step(now_ns)

    def push(self, cdr: bytes, now_ns: int, give: Callable[[Step], None] | None = None) -> Step:
        """Take one message as it came over the wire.

        Args:
            cdr, now_ns: the message, and the node's clock (ns).
            give: takes characters as soon as they are there; a hop's work need not be waited for.  It must not raise.

        Returns:
            What was not given.
        """
        if self._stream is None:
            raise RuntimeError('no stream is open')
        decoded = self._stream.push(cdr)
        if decoded.restarted:
            self._restart()
        end_ns = None
        if decoded.batch is not None:
            receiver = self._follow(decoded)
            self._tie(decoded, decoded.batch, now_ns)
            batch = self._time.admit(decoded.batch, now_ns)
            for output in receiver.parts(batch):
                self._gather(output)
                if give is not None and self._gathered:
                    give(self._step(now_ns, batch.t_end_ns))
            self._calm_down(receiver)
            end_ns = batch.t_end_ns
        return self._step(now_ns, end_ns, decoded)

    def rest(self) -> bool:
        """Do a piece of what no message waits for, while none is there; return whether there was anything to do."""
        return self._receiver is not None and self._receiver.rest()

    def shed(self, now_ns: int) -> None:
        """Pass a message over unread: there was no time for it.  What was in it is missing, not silent."""
        if self._stream is not None:
            self._stream.shed()
        self._time.hear(now_ns)
        self.hurry()

    def hurry(self) -> None:
        """Search less for bit rates for a while: there is too little time."""
        if self._receiver is not None and self._receiver.t_ns is not None:
            self._hurried_ns = self._receiver.t_ns
            self._receiver.search_less(_HURRIED_SHARE)

    def messages_lost(self) -> None:
        """Hear from the middleware that messages were lost."""
        if self._stream is not None:
            self._stream.lost()

    def tick(self, now_ns: int, period_ns: int) -> Step | None:
        """Carry the time of a silent topic on; to be called every ``period_ns``."""
        if self._receiver is None or (batch := self._time.tick(now_ns, period_ns)) is None:
            return None
        self._gather(self._receiver.push(batch))
        return self._step(now_ns)

    def publisher_gone(self) -> None:
        """The topic's last publisher has gone: what is held need not wait for it any more."""
        self._time.publisher_gone()

    def flush(self, now_ns: int) -> Step:
        """End the stream: give out what is due by the clock, and what is still held."""
        if self._receiver is not None:
            batch = self._time.finish()
            if batch is not None:
                self._gather(self._receiver.push(batch))
            self._gather(self._receiver.flush())
        return self._step(now_ns)

    def clock_was_set(self) -> None:
        """Begin the clock map anew: ROS time has jumped back."""
        self._clock_map.renew()

    def set_camera(self, camera: CameraModel | None) -> None:
        """Take another calibration from now on."""
        self._camera = camera
        self._fit_camera()

    def beacons(self) -> tuple[BeaconSnapshot, ...]:
        """Return all tracks at the stream's time."""
        return () if self._receiver is None else self._receiver.beacons()

    def settled_ns(self, track_id: int) -> int | None:
        """Return since when a track has been read without interruption (ns, stream), None if it is not."""
        return None if self._receiver is None else self._receiver.settled_ns(track_id)

    def now(self, now_ns: int) -> Instant:
        """Return the stream's time; ROS time is the node's clock before the first event."""
        stream_ns = None if self._receiver is None else self._receiver.t_ns
        if stream_ns is None or not self._clock_map.ready:
            return Instant(now_ns, 0)
        sensor_ns = self._time.sensor_ns(stream_ns)
        return Instant(self._clock_map.header_ns(sensor_ns), sensor_ns)

    def instant(self, stream_ns: int) -> Instant:
        """Return a time of the stream (ns) on both clocks."""
        sensor_ns = self._time.sensor_ns(stream_ns)
        return Instant(self._clock_map.ros_ns(sensor_ns), sensor_ns)

    def _follow(self, decoded: Decoded) -> Receiver:
        """Follow what the message says about its sensor: seen for the first time, or of another size."""
        size = (decoded.width, decoded.height)
        if self._receiver is None:
            self._receiver = Receiver(self._parameters, size)
        elif size != self.sensor_size:
            self._gather(self._receiver.resize(size))
        self.frame_id = decoded.frame_id
        if size != self.sensor_size:
            self.sensor_size = size
            self._fit_camera()
        return self._receiver

    def _calm_down(self, receiver: Receiver) -> None:
        """Search for bit rates as before once there has been time enough for a while."""
        if self._hurried_ns is None or receiver.t_ns is None:
            return
        if not 0 <= receiver.t_ns - self._hurried_ns < _HURRIED_NS:
            self._hurried_ns = None
            receiver.search_less(1.0)

    def _fit_camera(self) -> None:
        """Give the receiver the calibration if it is of a sensor of this size; another one's bearings would be wrong."""
        self.camera_problem = ''
        if self._receiver is None or self.sensor_size is None:
            return
        camera = self._camera
        try:
            if camera is not None:
                camera.check_size(self.sensor_size)
        except CalibrationError as error:
            camera, self.camera_problem = None, str(error)
        self._receiver.set_camera(camera)

    def _restart(self) -> None:
        if self._receiver is not None:
            self._gather(self._receiver.reset())
        self._time.reset()
        self._clock_map.renew()

    def _tie(self, decoded: Decoded, batch: EventBatch, now_ns: int) -> None:
        """Tie the two clocks together; a driver without a clock stamps 0, then it is the time of arrival."""
        stamp_ns = decoded.stamp_ns if decoded.stamp_ns > 0 else now_ns
        if decoded.first_event_ns is not None:
            self._clock_map.observe(stamp_ns, decoded.first_event_ns)
        elif not self._clock_map.ready:
            self._clock_map.observe(stamp_ns, batch.t_end_ns)

    def _gather(self, output: Output) -> None:
        """Stamp what the core gave, while the maps are those it was made under."""
        for received in output.characters:
            character = received.character
            self._gathered.append(StampedCharacter(received.track_id, character, self.instant(character.t_ns)))
            due_ns = character.t_ns + round(self._bits_to_due * NS_PER_S / character.bit_rate_bps)
            settled_ns = self.settled_ns(received.track_id)
            if settled_ns is not None and due_ns > settled_ns:
                self._due_ns.append(due_ns)
        self._lost += output.lost
        self._confirmed_changed |= output.confirmed_changed

    def _step(self, now_ns: int, end_ns: int | None = None, decoded: Decoded = NOTHING) -> Step:
        characters, lost, changed = tuple(self._gathered), tuple(self._lost), self._confirmed_changed
        due_ns = () if end_ns is None else tuple(self._due_ns)  # what a silence or the end decides was held by no message
        self._gathered, self._lost, self._confirmed_changed, self._due_ns = [], [], False, []
        kind = decoded.problem_kind or ''
        return Step(
            self.now(now_ns), characters, lost, changed, decoded.problem, kind, decoded.lost_packets, end_ns, due_ns
        )
