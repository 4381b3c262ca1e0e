"""A bag's events as batches: from its first event on, cropped to a part, with what happened between them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from beacon_comm.cli.progress import progress
from beacon_comm.core.errors import RecordingError
from beacon_comm.core.events import EventBatch
from beacon_comm.recordings.bags import Bag
from beacon_comm.wire.stream import EventStream


@dataclass(frozen=True, slots=True)
class Piece:
    """A batch of a bag, and what happened before it.

    Attributes:
        batch: events in sensor time; empty where only time moves on.
        width, height: sensor size (px).
        origin_ns: sensor time at recording time 0.
        restarted, resized: the sensor's clock was restarted, its size changed.
    """

    batch: EventBatch
    width: int
    height: int
    origin_ns: int
    restarted: bool
    resized: bool


class BagPieces:
    """Reads one event topic of a bag; can be iterated more than once.

    Args:
        path: the bag's name, for the progress bar and problems.
        bag: the bag.
        topic: name of the topic, None: the only one with events.
        window_ns: begin and end of the wanted part in recording time (ns); end None: all.

    Attributes:
        counts: what the reader counted, by kind; see :data:`beacon_comm.wire.stream.COUNTS`.
        problem: what could not be read, None if all could; both are known at the end of an iteration.

    Raises:
        RecordingError: no such topic.
    """

    def __init__(self, path: str, bag: Bag, topic: str | None, window_ns: tuple[int, int | None]) -> None:
        self._path = path
        self._bag = bag
        self._topic = bag.event_topic(topic)
        self._begin_ns, self._end_ns = window_ns
        self.counts: dict[str, int] = {}
        self.problem: str | None = None

    def __iter__(self) -> Iterator[Piece]:
        stream = EventStream(self._topic.type)
        self.problem = None
        problems: list[str] = []
        origin_ns: int | None = None
        reached_ns = 0
        restarted = resized = False
        for cdr in self._messages():
            decoded = stream.push(cdr)
            if decoded.problem is not None:
                problems.append(decoded.problem)
            batch = decoded.batch
            if batch is None or (origin_ns is None and not len(batch)):
                continue
            if origin_ns is None:
                origin_ns = int(batch.t_ns[0])
            elif decoded.restarted:
                # Recording time goes on where it was.
                origin_ns = (int(batch.t_ns[0]) if len(batch) else batch.t_end_ns) - reached_ns
            restarted |= decoded.restarted
            resized |= decoded.resized
            reached_ns = batch.t_end_ns - origin_ns
            cropped = self._crop(batch, origin_ns)
            if cropped is not None:
                yield Piece(cropped, decoded.width, decoded.height, origin_ns, restarted, resized)
                restarted = resized = False
            if self._end_ns is not None and reached_ns >= self._end_ns:
                break
        self.counts = dict(stream.counts)
        if problems:
            unread = f'{self._path}: {len(problems)} messages not read, the first: {problems[0]}'
            self.problem = '; '.join(filter(None, (self.problem, unread)))

    def _messages(self) -> Iterator[bytes]:
        try:
            for _, cdr in progress(self._bag.messages(self._topic), self._path, self._topic.count):
                yield cdr
        except RecordingError as error:
            self.problem = str(error)

    def _crop(self, batch: EventBatch, origin_ns: int) -> EventBatch | None:
        """Return what lies in the wanted part, None if it lies outside."""
        begin_ns = origin_ns + self._begin_ns
        if batch.t_end_ns < begin_ns:
            return None
        a = int(np.searchsorted(batch.t_ns, begin_ns))
        if self._end_ns is None or batch.t_end_ns <= origin_ns + self._end_ns:
            return batch.slice(a, len(batch), batch.t_end_ns)
        end_ns = origin_ns + self._end_ns
        return batch.slice(a, max(a, int(np.searchsorted(batch.t_ns, end_ns))), end_ns)
