"""A scene: beacons and a background merged by event time into one event stream, and into EventPackets.

    beacon 0   ·· ··· ··  ·····           ┐
    beacon 1      ··· ·· ···· ····        ├─ by event time ─→ | 4 ms | 4 ms | 4 ms | …   seq 0, 1, 2 …
    background ························   ┘
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from beacon_comm.core.errors import ParameterError
from beacon_comm.core.events import NS_PER_S, EventBatch
from beacon_comm.recordings.packets import PacketMaker
from beacon_comm.recordings.sources import Background, Beacon
from beacon_comm.recordings.storage import Message

PACKET_PERIOD_S = 0.004
STAMP_START_NS = 1_700_000_000 * NS_PER_S  # fixed, so that the same scene gives the same bytes


@dataclass(frozen=True)
class Scene:
    """Beacons over an optional background.

    Attributes:
        beacons: at least one.
        width, height: the sensor's size (pixels).
        background: None for none.
        packet_period_ns: length of a packet in event time (ns).
        stamp_start_ns: ROS time at scene time 0 (ns).
        seed: seed of the pixels.
        frame_id: frame of the camera.

    Raises:
        ParameterError: no beacon, or the background is of another sensor size.
    """

    beacons: tuple[Beacon, ...]
    width: int
    height: int
    background: Background | None = None
    packet_period_ns: int = round(PACKET_PERIOD_S * NS_PER_S)
    stamp_start_ns: int = STAMP_START_NS
    seed: int = 0
    frame_id: str = 'event_camera'

    def __post_init__(self) -> None:
        if not self.beacons:
            raise ParameterError('a scene needs at least one beacon')
        if self.packet_period_ns < 1000:
            raise ParameterError(f'packet period {self.packet_period_ns} ns: must be at least 1 µs')
        sizes = [(beacon.disc.width, beacon.disc.height) for beacon in self.beacons]
        if self.background is not None:
            sizes.append((self.background.width, self.background.height))
        for width, height in sizes:
            if (width, height) != (self.width, self.height):
                raise ParameterError(
                    f'sensor {self.width}×{self.height}: a part of the scene is of {width}×{height}'
                )

    @property
    def end_ns(self) -> int:
        """Scene time at which its last beacon ends (ns)."""
        return max(beacon.end_ns for beacon in self.beacons)

    def batches(self, start_s: float = 0.0, duration_s: float | None = None) -> Iterator[EventBatch]:
        """Yield the merged events, one batch a packet period, empty ones too.

        Args:
            start_s: scene time to begin at (s); what is earlier is left out.
            duration_s: how long (s); None: to the end of the last beacon.  The background goes on beyond that.
        """
        start_ns, stop_ns = self._span(start_s, duration_s)
        beacons = self._beacon_events()
        background = _Pending(self.background.batches() if self.background is not None else iter(()))
        background.take_until(start_ns)
        at = int(np.searchsorted(beacons.t_ns, start_ns))
        for begin_ns in range(start_ns, stop_ns, self.packet_period_ns):
            end_ns = min(begin_ns + self.packet_period_ns, stop_ns)
            until = int(np.searchsorted(beacons.t_ns, end_ns))
            part = beacons.slice(at, until, end_ns)
            yield _merged([part, *background.take_until(end_ns)], end_ns)
            at = until

    def packets(self, start_s: float = 0.0, duration_s: float | None = None, loop: bool = False) -> Iterator[Message]:
        """Yield ``(recorded_ns, cdr)`` of EventPackets (evt3) with the merged events.

        Args:
            start_s, duration_s: see :meth:`batches`.
            loop: for ever; the clock, the stamps and ``seq`` run on.
        """
        maker = PacketMaker(self.width, self.height, self.stamp_start_ns, self.frame_id)
        shift_ns = 0
        while True:
            end_ns = begin_ns = self._span(start_s, duration_s)[0]
            for batch in self.batches(start_s, duration_s):
                shifted = EventBatch(
                    batch.x, batch.y, batch.polarity, batch.t_ns + shift_ns, batch.t_end_ns + shift_ns
                )
                yield maker.message(shifted, end_ns + shift_ns)
                end_ns = batch.t_end_ns
            if not loop or end_ns == begin_ns:
                return
            shift_ns += end_ns - begin_ns

    def packet_count(self, start_s: float = 0.0, duration_s: float | None = None) -> int:
        """Return how many packets one pass of :meth:`packets` has."""
        return len(range(*self._span(start_s, duration_s), self.packet_period_ns))

    def _span(self, start_s: float, duration_s: float | None) -> tuple[int, int]:
        start_ns = round(start_s * 1e6) * 1000
        return start_ns, self.end_ns if duration_s is None else start_ns + round(duration_s * 1e6) * 1000

    def _beacon_events(self) -> EventBatch:
        placed = []
        for index, beacon in enumerate(self.beacons):
            x, y = beacon.disc.pixels(beacon.t_ns, [self.seed, index])
            placed.append(EventBatch(x, y, beacon.polarity, beacon.t_ns, beacon.end_ns))
        return _merged(placed, self.end_ns)


class _Pending:
    """Events of a stream of batches, taken piecewise by time."""

    def __init__(self, batches: Iterator[EventBatch]) -> None:
        self._batches = batches
        self._waiting: list[EventBatch] = []
        self._known_ns = -1
        self._exhausted = False

    def take_until(self, t_ns: int) -> list[EventBatch]:
        """Return the next events before ``t_ns`` (ns), in order."""
        while not self._exhausted and self._known_ns < t_ns:
            batch = next(self._batches, None)
            if batch is None:
                self._exhausted = True
                break
            self._waiting.append(batch)
            self._known_ns = int(batch.t_ns[-1])
        taken, kept = [], []
        for batch in self._waiting:
            split = int(np.searchsorted(batch.t_ns, t_ns))
            taken.append(batch.slice(0, split, t_ns))
            if split < len(batch):
                kept.append(batch.slice(split, len(batch), batch.t_end_ns))
        self._waiting = kept
        return taken


def _merged(parts: list[EventBatch], t_end_ns: int) -> EventBatch:
    """Merge by time, in whole microseconds, which is what EVT3 carries; at the same time the first part comes first."""
    t_ns = np.concatenate([part.t_ns for part in parts]) // 1000 * 1000
    order = np.argsort(t_ns, kind='stable')
    return EventBatch(
        np.concatenate([part.x for part in parts])[order],
        np.concatenate([part.y for part in parts])[order],
        np.concatenate([part.polarity for part in parts])[order],
        t_ns[order],
        t_end_ns,
    )
