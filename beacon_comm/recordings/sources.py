"""What a scene is merged from: beacons on discs, and a looped background; all on the scene's clock (ns from 0).

    recording's clock   0 ──── start ═══ clip ═══ start + duration ──── end
    scene's clock                0 ═══ 1st ═══ | ═══ 2nd ═══ | …  (count times)
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beacon_comm.core.errors import ParameterError, RecordingError
from beacon_comm.core.events import NS_PER_S, EventBatch
from beacon_comm.recordings.bags import open_recording
from beacon_comm.recordings.disc import Disc
from beacon_comm.recordings.mat import DAY_S, read_mat
from beacon_comm.wire.stream import EventStream

_REPEAT_GRID_NS = 1_000_000
_MOST_EVENTS = 1 << 28


@dataclass(frozen=True, slots=True)
class Clip:
    """The part of a recording that is used: from ``start_s`` after its first event, ``duration_s`` long (None: to
    its end), ``count`` times in a row.

    Raises:
        ParameterError: a start or duration that is not between 0 s and a day, or no count.
    """

    start_s: float = 0.0
    duration_s: float | None = None
    count: int = 1

    def __post_init__(self) -> None:
        if not 0.0 <= self.start_s <= DAY_S:
            raise ParameterError(f'clip start {self.start_s:g}: must be 0 s or more, at most a day')
        if self.duration_s is not None and not 0.0 < self.duration_s <= DAY_S:
            raise ParameterError(f'clip duration {self.duration_s:g}: must be above 0 s, at most a day')
        if self.count < 1:
            raise ParameterError(f'clip count {self.count}: must be at least 1')

    @classmethod
    def parse(cls, text: str) -> Clip:
        """Read ``start[,duration[,count]]`` (s); an empty duration means to the end.

        Raises:
            ParameterError: not such a text, or values out of range.
        """
        parts = text.split(',')
        try:
            if len(parts) > 3:
                raise ValueError
            return cls(
                float(parts[0]),
                float(parts[1]) if len(parts) > 1 and parts[1] else None,
                int(parts[2]) if len(parts) > 2 else 1,
            )
        except ParameterError:
            raise
        except ValueError:
            raise ParameterError(f'clip {text!r}: must be start[,duration[,count]] in seconds') from None

    def apply(
        self, t_ns: NDArray[np.int64], polarity: NDArray[np.int8]
    ) -> tuple[NDArray[np.int64], NDArray[np.int8], int]:
        """Return the clip's events on the scene's clock, and the clip's end on it (ns).

        Args:
            t_ns: times of the recording (ns, non-decreasing), ``(n,)`` int64.
            polarity: ``(n,)`` int8.

        Raises:
            ParameterError: repeated, it is longer than a day, or of too many events.
        """
        since_start = t_ns - (t_ns[0] if len(t_ns) else 0) - round(self.start_s * NS_PER_S)
        if self.duration_s is not None:
            period = round(self.duration_s * NS_PER_S)
        else:
            last = int(since_start[-1]) if len(t_ns) else 0
            period = max(-(-(last + 1) // _REPEAT_GRID_NS) * _REPEAT_GRID_NS, 0)
        first, stop = np.searchsorted(since_start, [0, period])
        once, its_polarity = since_start[first:stop], polarity[first:stop]
        day_ns = DAY_S * NS_PER_S
        if self.count > 1 and (self.count * period > day_ns or self.count * max(1, len(once)) > _MOST_EVENTS):
            raise ParameterError(f'clip count {self.count}: more than a day, or than {_MOST_EVENTS} events')
        times = np.concatenate([once + k * period for k in range(self.count)])
        return times, np.tile(its_polarity, self.count), period * self.count


@dataclass(frozen=True)
class Beacon:
    """The events of one LED on a disc.

    Attributes:
        name: where they come from (a file name, or a description).
        kind: ``mat`` for a recording, ``simulated`` for the LED model.
        t_ns: scene time (ns, non-decreasing), ``(n,)`` int64.
        polarity: +1 / -1, ``(n,)`` int8.
        end_ns: scene time at which the source ends (ns).
        disc: where it is.
        clip: the part of the recording that is used.
        text: what it sends, where that is known.
        bit_rate_bps: at which rate, where that is known.
    """

    name: str
    kind: str
    t_ns: NDArray[np.int64] = field(repr=False)
    polarity: NDArray[np.int8] = field(repr=False)
    end_ns: int
    disc: Disc
    clip: Clip = Clip()
    text: str | None = None
    bit_rate_bps: float | None = None


def mat_beacon(path: str | Path, disc: Disc, clip: Clip = Clip()) -> Beacon:  # noqa: B008  (immutable)
    """Return a beacon with the events of a ``.mat`` recording.

    Raises:
        RecordingError: the file is unreadable, or the clip holds no event of it.
    """
    t_ns, polarity, end_ns = clip.apply(*read_mat(path))
    if len(t_ns) == 0:
        raise RecordingError(f'{path}: no events in the clip from {clip.start_s:g} s')
    return Beacon(Path(path).name, 'mat', t_ns, polarity, end_ns, disc, clip)


class Background:
    """The events of a bag, over and over, on a clock that never steps back; decoded from any supported encoding.

    Attributes:
        name: the bag's name.
        topic: the topic.
        width, height: its sensor's size (pixels).
    """

    def __init__(self, path: str | Path, topic: str | None = None) -> None:
        """Look into the bag.

        Raises:
            RecordingError: unreadable, no event topic, or no event can be decoded.
        """
        self.path = Path(path)
        self.name = self.path.name
        with open_recording(path) as bag:
            self.topic = bag.event_topic(topic).name
        for batch, width, height in self._one_pass():
            if len(batch):
                self.width, self.height = width, height
                return
        raise RecordingError(f'{path}: no events could be decoded from {self.topic}')

    def batches(self) -> Iterator[EventBatch]:
        """Yield its events for ever, the first at scene time 0; a pass begins where the one before ended.

        Raises:
            RecordingError: the bag is damaged.
        """
        end_ns = 0
        while True:
            shift_ns: int | None = None
            for batch, width, height in self._one_pass():
                if (width, height) != (self.width, self.height):
                    raise RecordingError(
                        f'{self.path}: the sensor changes from {self.width}×{self.height} to {width}×{height}'
                    )
                if shift_ns is None:
                    if not len(batch):
                        continue  # time before the pass's first event
                    shift_ns = end_ns - int(batch.t_ns[0])
                elif len(batch) and int(batch.t_ns[0]) + shift_ns < end_ns:
                    shift_ns = end_ns - int(batch.t_ns[0])  # the sensor was restarted within the recording
                t_ns = batch.t_ns + shift_ns
                # One µs after the last event at least: no event of the next pass joins this one's last instant.
                last_ns = int(t_ns[-1]) + 1000 if len(t_ns) else end_ns
                end_ns = max(end_ns, last_ns, batch.t_end_ns + shift_ns)
                if len(batch):
                    yield EventBatch(batch.x, batch.y, batch.polarity, t_ns, end_ns)

    def _one_pass(self) -> Iterator[tuple[EventBatch, int, int]]:
        with open_recording(self.path) as bag:
            topic = bag.event_topic(self.topic)
            stream = EventStream(topic.type)
            for _, cdr in bag.messages(topic):
                decoded = stream.push(cdr)
                if decoded.batch is not None:
                    yield decoded.batch, decoded.width, decoded.height
